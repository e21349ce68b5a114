"""`POST /v1/chat/completions`, `POST /v1/responses`, `GET /v1/models`: COW for clients of OpenAI's API."""

from dataclasses import replace
from typing import Annotated, Any

from anyio import to_thread
from fastapi import APIRouter, Path, Request, Response
from pydantic import BaseModel

from cow_service import errors
from cow_service.api.openai import records
from cow_service.api.openai.answering import FIELDS_OF_CHAT
from cow_service.api.openai.chats import EXTENSION, Chat, ChatRequest, ResponsesRequest, as_json
from cow_service.api.openai.completer import Completer
from cow_service.api.openai.responses import as_response, chat_fields, response_of
from cow_service.api.openai.stream import EventsResponse, Streamed
from cow_service.api.problems import MEDIA_TYPE, OPENAI_ROOT, ChatProblem, documented
from cow_service.api.routes.simulate import ACCEPTED, FAILURES, PREFERENCES
from cow_service.api.submission import from_app, json_response
from cow_service.readers.chat import ChatTurn
from cow_service.requests import AnswerRequest

ANSWER_FIELDS = "ChatExtension"  # the schema of `cow` in a request
REFERENCE = "#/components/schemas/{model}"
UPSTREAM_ERRORS: dict[int | str, dict[str, Any]] = {
    "default": {
        "description": "What the server of the MLLM answered with: its status and code, in OpenAI's form.",
        "content": {"application/json": {"schema": {"$ref": REFERENCE.format(model=records.UpstreamError.__name__)}}},
    }
}
REQUESTS = (ChatRequest, ResponsesRequest)
REPLIES = (
    records.ChatChunk,
    records.ChatCompletion,
    records.ResponseReply,
    records.UpstreamError,
    ChatProblem,
)


_WAIT = (
    "`wait=N` (RFC 7240): calls of the imagination that the MLLM refuses (429) are repeated until N seconds after "
    "the chat arrived, 60 without it."
)
WAIT = {**PREFERENCES[0], "description": _WAIT}
CHAT_WAIT = {**WAIT, "description": f"With an MLLM, {_WAIT} Without one: {PREFERENCES[0]['description']}"}
ChatCompleter = Annotated[Completer, from_app("completer")]


def _body_of(record: type[BaseModel]) -> dict[str, Any]:
    schema = {"$ref": REFERENCE.format(model=record.__name__)}
    return {"required": True, "content": {"application/json": {"schema": schema}}}


def _reply(record: type[BaseModel], data: str) -> dict[str, Any]:
    event = {
        "type": "object",
        "required": ["data"],
        "properties": {"data": {"type": "string", "description": f"{data}, as JSON; or `[DONE]`."}},
    }
    whole = {"$ref": REFERENCE.format(model=record.__name__)}
    return {
        "description": "The reply; with `stream` the chunks of it, progress of imagining before them.",
        "content": {"application/json": {"schema": whole}, "text/event-stream": {"schema": event}},
    }


router = APIRouter(prefix=OPENAI_ROOT.rstrip("/"), tags=["OpenAI-compatible"])


@router.post(
    "/chat/completions",
    summary="The MLLM behind a model, seeing more",
    responses={
        200: _reply(records.ChatCompletion, "A `ChatChunk`, or a `ChatProblem` at the end"),
        **ACCEPTED,
        **documented(*FAILURES, errors.ModelNotFound),
        **UPSTREAM_ERRORS,
    },
    openapi_extra={"requestBody": _body_of(ChatRequest), "parameters": [CHAT_WAIT, *PREFERENCES[1:]]},
)
async def chat(request: Request, completer: ChatCompleter) -> Response:
    """Forwards the chat to the MLLM, and returns the MLLM's reply unchanged, with `cow` added.

    Where the last user message asks a what-if question about the only image, what would happen is simulated first,
    and the imagined frames are added behind that message. `cow.imagined` says whether. A model without an MLLM,
    such as `cow/embedded`, answers as `POST /answer`.
    """
    asked = Chat.parse(await completer.read_body(request))
    return await _respond(await completer.complete(request, asked), completer)


@router.post(
    "/responses",
    summary="The same, as OpenAI's responses",
    responses={
        200: _reply(records.ResponseReply, "An event of OpenAI's responses"),
        **documented(*FAILURES, errors.ModelNotFound),
        **UPSTREAM_ERRORS,
    },
    openapi_extra={"requestBody": _body_of(ResponsesRequest), "parameters": [WAIT, *PREFERENCES[2:]]},
)
async def responses(request: Request, completer: ChatCompleter) -> Response:
    """Text and images in, without state: what needs it (`previous_response_id`, `store`...) is refused by name.

    The input is turned into a chat, which is answered as above, and the reply into a response.
    """
    body = await completer.read_body(request)
    asked = Chat.parse(chat_fields(body))
    reply = await completer.complete(request, asked, stored=False)
    if isinstance(reply, Streamed):
        reply = as_response(reply, body, asked.model)
    elif isinstance(reply, ChatTurn) and reply.succeeded:
        reply = replace(reply, body=response_of(reply.body, body))
    return await _respond(reply, completer)


@router.get("/models", operation_id="chatModels", summary="Models to chat with")
def models(completer: ChatCompleter) -> records.ChatModels:
    """Every reader, the server's default first: with imagination and without (`:no-imagination`).

    Models with an MLLM also have controls, such as `:still`; suffixes of different kinds can be combined."""
    unready = {reader.name for reader in completer.service.models().readers if reader.ready is False}
    listed = records.answerers(completer.service).items()
    names = [name for name, answerer in listed if answerer.reader not in unready]
    return records.ChatModels(data=tuple(records.ChatModel(id=name, created=completer.started) for name in names))


@router.get(
    "/models/{model:path}",
    operation_id="chatModel",
    summary="A model to chat with",
    responses=documented(errors.ModelNotFound),
)
def model(
    model: Annotated[str, Path(description="Its `id`, slash and all.")], completer: ChatCompleter
) -> records.ChatModel:
    """Whether there is one of that name. Why it might not run, a chat says."""
    records.find_answerer(completer.service, model)
    return records.ChatModel(id=model, created=completer.started)


async def _respond(reply: ChatTurn | Streamed | Response, completer: Completer) -> Response:
    if isinstance(reply, Streamed):
        return EventsResponse(reply, completer.service.settings)
    if isinstance(reply, ChatTurn):
        return json_response(await to_thread.run_sync(as_json, reply.body), reply.status, reply.headers)
    return reply


def document_chat(document: dict[str, Any]) -> None:
    """Adds to the contract what the framework does not see: chunks, problems, and what `cow` of a request holds."""
    schemas = document["components"]["schemas"]
    for record in (*REQUESTS, *REPLIES):
        mode = "validation" if record in REQUESTS else "serialization"
        schema = record.model_json_schema(ref_template=REFERENCE, mode=mode)
        for name, part in (schema.pop("$defs", {}) | {record.__name__: schema}).items():
            schemas.setdefault(name, part)
    others = AnswerRequest.model_json_schema(ref_template=REFERENCE)["properties"]
    schemas[ANSWER_FIELDS] = {
        "type": "object",
        "additionalProperties": False,
        "description": "An `AnswerRequest` without what messages and model say; with an MLLM behind the model, a "
        "`SimulateRequest` without image and question.",
        "properties": {name: schema for name, schema in others.items() if name not in FIELDS_OF_CHAT},
    }
    for request in REQUESTS:
        own = schemas[request.__name__]["properties"][EXTENSION]
        own["anyOf"] = [{"$ref": REFERENCE.format(model=ANSWER_FIELDS)}, {"type": "null"}]
    for path, operations in document["paths"].items():
        for operation in operations.values() if path.startswith(OPENAI_ROOT) else ():
            for response in operation["responses"].values():
                if problem := response.get("content", {}).get(MEDIA_TYPE):
                    problem["schema"] = {"$ref": REFERENCE.format(model=ChatProblem.__name__)}
