"""`POST /v1/chat/completions`, `GET /v1/models` and `GET /v1/models/{model}`: COW for clients of OpenAI's API."""

from __future__ import annotations

import time
from functools import partial
from typing import Annotated, Any

from anyio import to_thread
from fastapi import APIRouter, Path, Request, Response
from pydantic import BaseModel
from pydantic.json_schema import JsonSchemaMode

from cow_service import errors
from cow_service.api.openai.errors import ROOT, document_problems
from cow_service.api.openai.models import answerer, usable
from cow_service.api.openai.parsing import FIELDS_OF_CHAT, ParsedChat, parse_chat
from cow_service.api.openai.records import ChatChunk, ChatCompletion, ChatModel, ChatModels, ChatProblem
from cow_service.api.openai.replies import ChatAnswer
from cow_service.api.openai.requests import ChatRequest
from cow_service.api.openai.stream import stream
from cow_service.api.problems import documented
from cow_service.api.routes.simulate import ACCEPTED, FAILURES, PREFERENCES
from cow_service.api.submission import Submission, Submitter, json_response
from cow_service.errors import BodyTypeUnsupported, CowError, shortened
from cow_service.requests import AnswerRequest

SHOWN_CHARACTERS = 80  # of what the caller sent
EXTENSION = "ChatExtension"  # the schema of `cow` in a request
REFERENCE = "#/components/schemas/{model}"
TAG = "OpenAI-compatible"
EVENT: dict[str, Any] = {
    "type": "object",
    "required": ["data"],
    "properties": {
        "data": {
            "type": "string",
            "description": "A `ChatChunk`, or a `ChatProblem` at the end, as JSON; or `[DONE]`.",
        },
    },
}
RECORDS: tuple[tuple[type[BaseModel], JsonSchemaMode], ...] = (
    (ChatRequest, "validation"),
    (ChatChunk, "serialization"),
    (ChatProblem, "serialization"),
)


def chat_routes(submitter: Submitter) -> APIRouter:
    """The operations, bound to an engine."""
    router = APIRouter(prefix=ROOT.rstrip("/"), tags=[TAG])
    engine = submitter.engine
    created = int(time.time())

    @router.post(
        "/chat/completions",
        operation_id="chat",
        response_model=ChatCompletion,
        summary="Look, then answer a chat",
        responses={
            200: {
                "description": "The answer; with `stream` the chunks of it: progress first, and `data: [DONE]` last.",
                "content": {"text/event-stream": {"schema": EVENT}},
            },
            **ACCEPTED,
            **documented(*FAILURES, errors.ModelNotFound),
        },
        openapi_extra={
            "requestBody": {
                "required": True,
                "content": {"application/json": {"schema": {"$ref": REFERENCE.format(model=ChatRequest.__name__)}}},
            },
            "parameters": PREFERENCES,
        },
    )
    async def chat(request: Request) -> Response:
        """As `POST /answer`, for clients of OpenAI's API: one image and one question in messages, a letter out.

        `cow` in the request holds all else that `/answer` takes, and `cow` in the response all that it returns. A job
        that fails while it streams ends the stream with its problem as `data`.
        """
        submission = submitter.submission(request, "answer")
        body = await _body(request)
        parsed = await submitter.in_thread(partial(parse_chat, body, engine.service))
        try:
            return await _answered(submitter, request, submission, parsed)
        except CowError as error:
            raise parsed.pointers.translate_error(error) from error

    @router.get("/models", operation_id="chatModels", summary="Models to chat with")
    def models() -> ChatModels:
        """Every reader, with imagination and without (`:no-imagination`); the server's default comes first."""
        return ChatModels(data=tuple(ChatModel(id=name, created=created) for name in usable(engine.service)))

    @router.get(
        "/models/{model:path}",
        operation_id="chatModel",
        summary="A model to chat with",
        responses=documented(errors.ModelNotFound),
    )
    def model(model: Annotated[str, Path(description="Its `id`, slash and all.")]) -> ChatModel:
        """Whether there is one of that name. Why it might not run, a chat says."""
        answerer(engine.service, model)
        return ChatModel(id=model, created=created)

    return router


def document_chat(document: dict[str, Any]) -> None:
    """Adds to the contract what the framework does not see: chunks, problems, and what `cow` of a request holds."""
    schemas = document["components"]["schemas"]
    for record, mode in RECORDS:
        schema = record.model_json_schema(ref_template=REFERENCE, mode=mode)
        for name, part in (schema.pop("$defs", {}) | {record.__name__: schema}).items():
            schemas.setdefault(name, part)
    others = AnswerRequest.model_json_schema(ref_template=REFERENCE)["properties"]
    schemas[EXTENSION] = {
        "type": "object",
        "additionalProperties": False,
        "description": "An `AnswerRequest` without what messages and model say.",
        "properties": {name: schema for name, schema in others.items() if name not in FIELDS_OF_CHAT},
    }
    own = schemas[ChatRequest.__name__]["properties"]["cow"]
    own["anyOf"] = [{"$ref": REFERENCE.format(model=EXTENSION)}, {"type": "null"}]
    document_problems(document)


async def _body(request: Request) -> bytes:
    media_type = request.headers.get("content-type", "none").partition(";")[0].strip().lower()
    if media_type != "application/json" and not media_type.endswith("+json"):
        raise BodyTypeUnsupported(
            f"The body has the media type '{shortened(media_type, SHOWN_CHARACTERS)}'. Send application/json."
        )
    return await request.body()


async def _answered(submitter: Submitter, request: Request, submission: Submission, chat: ParsedChat) -> Response:
    """The response to a chat. Errors point into its `AnswerRequest`."""
    if chat.stream:
        created_at = await submitter.submit(submission, lambda: (chat.request, None))
        return stream(submitter, submission, chat, created_at)
    result = await submitter.result(request, submission, lambda: (chat.request, None))
    if result is None:
        return await submitter.accepted(submission)
    return json_response(await to_thread.run_sync(lambda: ChatAnswer.parse(chat, result).completion()))
