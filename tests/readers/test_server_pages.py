"""The pages of docs/servers: the reader is set up as a page says, and asks a stand-in with the habits of its server.

Of each server these are what public reports say that it refuses, word for word where its words decide what COW learns.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import mllm_server as say
import numpy as np
import pytest
from conftest import ROOT
from drawn import ball, block, floor
from mllm_server import MllmServer
from outcomes import YES, simulated
from refusals import refused
from waiting import TIME_LIMIT

from cow_service.perception.observation import look
from cow_service.readers.base import Imagined, ReaderInput
from cow_service.readers.options import read_choices
from cow_service.requests import AnswerRequest
from cow_service.settings import Settings

PAGES = {path.stem: path.read_text() for path in sorted((ROOT / "docs" / "servers").glob("*.md"))}
BLOCK = re.compile(r"^```\w+\n(.*?)^```$", re.MULTILINE | re.DOTALL)
QUESTION = "If the red ball moves to the right, will it hit the blue cube?"
OPTIONS = read_choices("", ["Yes", "No", "Not sure"])
LIMIT = 3  # calls that may be lost to learning
PIXELS = np.ascontiguousarray(block(ball(floor(), (150, 200), 40, (210, 20, 20)), (430, 160, 510, 250), (50, 80, 200)))
SCENE = look(PIXELS)  # what is seen in it is seen once
# Where a provider's own client looks for another address than the provider's.
ADDRESSES = {"openai": "OPENAI_BASE_URL", "anthropic": "ANTHROPIC_BASE_URL", "google": "GOOGLE_GEMINI_BASE_URL"}

Refusal = tuple[int, object] | None


@dataclass(frozen=True)
class Habit:
    """What a server refuses, and what is known of it after one question."""

    page: str
    name: str
    refuses: Callable[[dict[str, Any]], Refusal]
    learned: dict[str, Any] = field(default_factory=dict)
    lost: int = 0  # calls
    as_reasoning: str = ""  # the field in which it replies instead of `content`
    line: int = 0  # of the page's commands that start COW


def count_images(body: dict[str, Any]) -> int:
    kinds = ('"type": "image_url"', '"type": "input_image"', '"type": "image"', '"inlineData"')
    return sum(json.dumps(body).count(kind) for kind in kinds)


def schema_of(body: dict[str, Any]) -> dict[str, Any]:
    """The schema to which the reply is to be held, in whatever protocol; {} where there is none."""
    chat = body.get("response_format", {}).get("json_schema", {})
    responses = body.get("text", {}).get("format", {})
    messages = body.get("output_config", {}).get("format", {})
    google = body.get("generationConfig", {}).get("responseJsonSchema", {})
    return chat.get("schema") or responses.get("schema") or messages.get("schema") or google


def parts_of(schema: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """A schema and all those in it."""
    yield schema
    below = (*schema.get("properties", {}).values(), *schema.get("anyOf", ()), *filter(None, [schema.get("items")]))
    for each in below:
        yield from parts_of(each)


def when(is_refused: Callable[[dict[str, Any]], object], code: int, body: object) -> Callable[..., Refusal]:
    return lambda asked: (code, body) if is_refused(asked) else None


def first_of(*habits: Callable[[dict[str, Any]], Refusal]) -> Callable[..., Refusal]:
    return lambda asked: next((refusal for habit in habits if (refusal := habit(asked))), None)


def nothing(_: dict[str, Any]) -> Refusal:
    return None


def vllm(message: str) -> dict[str, Any]:
    return {"error": {"message": message, "type": "BadRequestError", "param": None, "code": 400}}


def sglang(message: str) -> dict[str, Any]:
    return {"object": "error", "message": message, "type": "BadRequestError", "param": None, "code": 400}


def llama(message: str, code: int = 400, kind: str = "invalid_request_error") -> dict[str, Any]:
    return {"error": {"code": code, "message": message, "type": kind}}


def openai(message: str) -> dict[str, Any]:
    return {"error": {"message": message, "type": "invalid_request_error", "param": None, "code": None}}


def anthropic(message: str, kind: str = "invalid_request_error") -> dict[str, Any]:
    return {"type": "error", "error": {"type": kind, "message": message}}


def google(message: str) -> dict[str, Any]:
    return {"error": {"code": 400, "message": message, "status": "INVALID_ARGUMENT"}}


def has_format(kind: str) -> Callable[[dict[str, Any]], bool]:
    return lambda body: body.get("response_format", {}).get("type") == kind


def is_long(body: dict[str, Any]) -> bool:
    """More than the image and three frames at half its size would be: a small context."""
    return sum(each.size for each in say.images_of(body)) > 2 * PIXELS.size


def has_long_text(body: dict[str, Any]) -> bool:
    """A repetition that llama.cpp's grammars do not take."""
    return any(part.get("maxLength", 0) >= 2000 for part in parts_of(schema_of(body)))


def has_untyped_part(body: dict[str, Any]) -> bool:
    schema = schema_of(body)
    return bool(schema) and any(part.keys().isdisjoint(("type", "anyOf", "enum")) for part in parts_of(schema))


def has_bounds(body: dict[str, Any]) -> bool:
    bounds = {"minimum", "maximum", "minLength", "maxLength", "maxItems", "pattern"}
    return any(part.keys() & bounds for part in parts_of(schema_of(body)))


GRAMMAR = "Failed to initialize samplers: failed to parse grammar"
UNTYPED = when(
    has_untyped_part, 400, openai("Invalid schema for response_format 'reply': schema must have a 'type' key.")
)
HABITS = (
    Habit(
        "vllm", "four images",
        when(lambda body: count_images(body) > 4, 400, vllm("At most 4 image(s) may be provided in one prompt.")),
        {"images": 4}, 1,
    ),
    Habit(
        "vllm", "one image",
        when(
            lambda body: count_images(body) > 1, 422,
            vllm("You set image=1 (or defaulted to 1) in `--limit-mm-per-prompt`, but passed 5 image items."),
        ),
        {"images": 1}, 1,
    ),
    Habit(
        "vllm", "small context",
        when(is_long, 400, vllm("The decoder prompt (length 5230) is longer than the maximum model length of 4096.")),
        {"reduction": 1}, 1,
    ),
    Habit(
        "sglang", "two images",
        when(lambda body: count_images(body) > 2, 400, sglang("Image count 5 exceeds limit 2 per request.")),
        {"images": 2}, 1,
    ),
    Habit(
        "sglang", "no grammar backend",
        when(
            lambda body: "response_format" in body, 400,
            sglang("Grammar-based generation (json_schema, regex, ebnf, structural_tag) is not supported when the "
                   "server is launched with --grammar-backend none"),
        ),
        {"output": "prompt"}, 2,
    ),
    Habit("ollama", "all that it thought", nothing, as_reasoning="reasoning"),
    Habit(
        "ollama", "small context", when(is_long, 400, openai("the input length exceeds the context length")),
        {"reduction": 1}, 1,
    ),
    Habit("ollama", "no grammar", when(has_long_text, 400, openai(GRAMMAR)), {"output": "json_object"}, 1),
    Habit(
        "lm-studio", "no grammar, and no other format",
        first_of(
            when(has_long_text, 400, {"error": GRAMMAR}),
            when(has_format("json_object"), 400, {"error": "'response_format.type' must be 'json_schema' or 'text'"}),
        ),
        {"output": "prompt"}, 2,
    ),
    Habit("lm-studio", "all that it thought", nothing, as_reasoning="reasoning_content"),
    Habit(
        "lm-studio", "small context",
        when(
            is_long, 400,
            {"error": "Trying to keep the first 5230 tokens when context the overflows. However, the model is loaded "
                      "with context length of only 4096 tokens, which is not enough."},
        ),
        {"reduction": 1}, 1,
    ),
    Habit("llama-cpp", "no grammar", when(has_long_text, 400, llama(GRAMMAR)), {"output": "json_object"}, 1),
    Habit(
        "llama-cpp", "no grammar, of older ones",
        when(has_format("json_schema"), 500, llama("failed to parse grammar", 500, "server_error")),
        {"output": "json_object"}, 1,
    ),
    Habit(
        "llama-cpp", "small context",
        when(
            is_long, 400,
            llama("request (5230 tokens) exceeds the available context size (4096 tokens), try increasing it",
                  kind="exceed_context_size_error"),
        ),
        {"reduction": 1}, 1,
    ),
    Habit(
        "openai", "strict schemas, no temperature",
        first_of(UNTYPED, when(lambda body: "temperature" in body, 400, openai("Unsupported value: 'temperature'"))),
    ),
    Habit(
        "openai", "chat completions of reasoning models",
        first_of(
            UNTYPED,
            when(
                lambda body: "max_tokens" in body, 400,
                openai("Unsupported parameter: 'max_tokens' is not supported with this model. "
                       "Use 'max_completion_tokens' instead."),
            ),
        ),
        {"token_field": "max_completion_tokens"}, 1, line=1,
    ),
    Habit(
        "anthropic", "no bounds in schemas, no temperature",
        first_of(
            when(has_untyped_part, 400, anthropic("output_config.format.schema: Invalid schema")),
            when(has_bounds, 400, anthropic("output_config.format.schema: property 'maxLength' is not supported")),
            when(lambda body: "temperature" in body, 400, anthropic("`temperature` is deprecated for this model.")),
        ),
    ),
    Habit(
        "anthropic", "small body",
        when(
            lambda body: len(json.dumps(body)) > 160_000, 413,
            anthropic("Request exceeds the maximum size", "request_too_large"),
        ),
        {"reduction": 1}, 1,
    ),
    Habit(
        "google", "bounds, without a reason", when(has_bounds, 400, google("Request contains an invalid argument.")),
        {"output": "json_object"}, 1,
    ),
    Habit(
        "google", "a schema with too many states",
        when(
            lambda body: count_images(body) > 1 and schema_of(body), 400,
            google("The specified schema produces a constraint that has too many states for serving."),
        ),
        {"output": "json_object"}, 1,
    ),
)  # fmt: skip


@pytest.fixture(scope="module")
def mllm() -> Iterator[MllmServer]:
    with say.mllm_server() as server:
        yield server


def starts_of(page: str) -> list[dict[str, str]]:
    """The settings of each command of a page that starts COW."""
    lines = (line for block in BLOCK.findall(PAGES[page]) for line in block.replace("\\\n", " ").splitlines())
    return [dict(re.findall(r"\bCOW_(\w+)=(\S+)", line)) for line in lines if "cow serve" in line]


def settings_of(page: str, line: int, mllm: MllmServer, data_dir: Path, monkeypatch: pytest.MonkeyPatch) -> Settings:
    """The settings of a page, with the stand-in at the address of its server."""
    said: dict[str, Any] = {name.lower(): value for name, value in starts_of(page)[line].items()}
    assert said.keys() <= Settings.model_fields.keys()
    address = f"http://{urlsplit(mllm.address).netloc}"
    if "mllm_base_url" in said:
        url = urlsplit(said["mllm_base_url"])
        said["mllm_base_url"] = address + url.path
    else:
        monkeypatch.setenv(ADDRESSES[page], address + ("/v1" if page == "openai" else ""))
    said |= {"mllm_timeout": TIME_LIMIT, "mllm_budget": TIME_LIMIT, "data_dir": data_dir}
    return Settings(**said)


def reply_as(handler: Any, text: str, as_reasoning: str) -> None:
    """A reply in the protocol of the address that was asked."""
    path = handler.path.partition("?")[0]
    if path.endswith(":generateContent"):
        content = {"role": "model", "parts": [{"text": text}]}
        usage = {"promptTokenCount": 9, "candidatesTokenCount": 3, "totalTokenCount": 12}
        handler.send(200, {"candidates": [{"content": content, "finishReason": "STOP"}], "usageMetadata": usage})
    elif path == "/v1/messages":
        content = [{"type": "text", "text": text}]
        usage = {"input_tokens": 9, "output_tokens": 3}
        handler.send(200, {"id": "m", "type": "message", "role": "assistant", "model": "m", "usage": usage,
                           "content": content, "stop_reason": "end_turn", "stop_sequence": None})  # fmt: skip
    elif path == "/v1/responses":
        content = [{"type": "output_text", "text": text, "annotations": []}]
        message = {"type": "message", "id": "m", "role": "assistant", "status": "completed", "content": content}
        usage: dict[str, Any] = {"input_tokens": 9, "output_tokens": 3, "total_tokens": 12}
        usage |= {"input_tokens_details": {"cached_tokens": 0}, "output_tokens_details": {"reasoning_tokens": 0}}
        handler.send(200, {"id": "r", "object": "response", "created_at": 1, "model": "m", "status": "completed",
                           "parallel_tool_calls": False, "tool_choice": "auto", "tools": [], "output": [message],
                           "usage": usage})  # fmt: skip
    else:
        assert path == "/v1/chat/completions"
        body = say.completion(text)
        if as_reasoning:
            body["choices"][0]["message"] |= {"content": "", as_reasoning: f"I look. {text}"}
        handler.send(200, body)


@pytest.mark.parametrize("habit", HABITS, ids=lambda habit: f"{habit.page}: {habit.name}")
def test_a_question_is_answered_as_the_page_sets_it_up(
    habit: Habit, mllm: MllmServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from cow_service.readers.mllm.client import MllmClient
    from cow_service.readers.mllm.coordinates import encode
    from cow_service.readers.mllm.models import configure
    from cow_service.readers.mllm.reader import MllmReader

    settings = settings_of(habit.page, habit.line, mllm, tmp_path, monkeypatch)
    model = configure(settings)
    reader = MllmReader("mllm", MllmClient(model, settings))
    frame = encode(PIXELS, model.family).coordinate_frame
    boxes = {"red ball": ((110, 160), (190, 240)), "blue cube": ((430, 160), (510, 250))}
    objects = [{frame.coordinates.box: frame.write(*box), "label": label} for label, box in boxes.items()]
    ends = {"start": frame.write((150, 200)), "end": frame.write((600, 200)), "sense": None}
    replies = [
        {"object": "red ball", "others": ["blue cube"], "kind": "linear"},
        {"reasoning": "They stand there.", "objects": objects, **ends},
        {"reasoning": "It rolls there.", "answer": "A"},
    ]

    def served(handler: Any) -> None:
        refusal = habit.refuses(handler.body)
        if refusal is not None:
            handler.send(*refusal)
        else:
            reply_as(handler, json.dumps(replies.pop(0)), habit.as_reasoning)

    mllm.say(served)
    given = ReaderInput(SCENE.image, QUESTION, SCENE)
    imagined = Imagined(simulated(YES), (PIXELS,) * 4)
    try:
        mover = reader.read(given).reading.grounding
        (answer,) = reader.answer(given, OPTIONS, None, imagined, 1)
    finally:
        reader.close()
    assert mover is not None
    assert (mover.object, answer.answer, replies) == ("red ball", "A", [])
    assert mover.bbox == pytest.approx((110, 160, 190, 240), abs=2)
    assert len(mllm.asked) == 3 + habit.lost <= 3 + LIMIT
    (kept,) = (json.loads(path.read_text()) for path in (tmp_path / "mllm").iterdir())
    assert kept == model.first.model_dump() | habit.learned
    if habit.page not in ADDRESSES:  # one's own server: it serves the model under that name
        assert model.name in BLOCK.findall(PAGES[habit.page])[0]


def failed(page: str, status: int, body: object, code: str, reason: str) -> Any:
    return pytest.param(page, status, body, code, reason, id=f"{page}: {reason}")


NO_MODEL, NO_KEY, NO_CREDIT = "there is no model of that name", "it refused the key", "the account's quota is used up"
INVALID_KEY = [{"@type": "type.googleapis.com/google.rpc.ErrorInfo", "reason": "API_KEY_INVALID"}]


@pytest.mark.parametrize(
    ("page", "status", "body", "code", "reason"),
    [
        failed("vllm", 404, vllm("The model `x` does not exist."), "mllm-unavailable", NO_MODEL),
        failed("sglang", 404, sglang("The model `x` does not exist."), "mllm-unavailable", NO_MODEL),
        failed("ollama", 404, openai("model 'x' not found"), "mllm-unavailable", NO_MODEL),
        failed("ollama", 200, say.completion('{"reas', "length"), "mllm-bad-reply", "it was cut off"),
        failed("lm-studio", 200, say.completion(""), "mllm-bad-reply", "it was empty"),
        failed("lm-studio", 200, {"error": "no"}, "mllm-unavailable", "its reply could not be read"),
        failed("lm-studio", 400, {"error": "no"}, "mllm-refused", "it answered with status 400"),
        failed(
            "llama-cpp", 500, llama("image input is not supported - hint: provide the mmproj", 500, "server_error"),
            "mllm-unavailable", "it answered with status 500",
        ),
        failed("openai", 401, openai("Incorrect API key provided"), "mllm-unavailable", NO_KEY),
        failed("openai", 429, {"error": {"code": "insufficient_quota"}}, "mllm-unavailable", NO_CREDIT),
        failed("anthropic", 401, anthropic("invalid x-api-key", "authentication_error"), "mllm-unavailable", NO_KEY),
        failed("anthropic", 400, anthropic("Your credit balance is too low"), "mllm-unavailable", NO_CREDIT),
        failed("google", 400, {"error": {"code": 400, "details": INVALID_KEY}}, "mllm-refused", NO_KEY),
    ],
)  # fmt: skip
def test_a_failure_is_told_in_the_words_of_the_page(
    page: str, status: int, body: object, code: str, reason: str, mllm: MllmServer, tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    from cow_service.readers.mllm.reader import create

    settings = settings_of(page, 0, mllm, tmp_path, monkeypatch)
    budget = 0.5 if code == "mllm-unavailable" else TIME_LIMIT  # which is what repeats would take
    reader = create(settings.model_copy(update={"mllm_budget": budget}))
    mllm.say(lambda handler: handler.send(status, body))
    with refused(code) as caught:
        reader.read(ReaderInput(SCENE.image, QUESTION, SCENE))
    reader.close()
    assert reason in caught.value.detail
    assert f"| `{code}`: {reason}" in PAGES[page]


def test_every_page_has_a_stand_in_and_stands_in_the_table() -> None:
    assert {habit.page for habit in HABITS} == PAGES.keys()
    table = (ROOT / "docs" / "mllm.md").read_text()
    for page, text in PAGES.items():
        assert f"(servers/{page}.md)" in table
        first = " ".join(f"COW_{name}={value}" for name, value in starts_of(page)[0].items() if name != "MLLM_API_KEY")
        assert f"`{first}`" in table, first
        assert 25 <= len(text.splitlines()) <= 50


@pytest.mark.parametrize("page", PAGES)
def test_what_a_page_asks_can_be_asked(page: str) -> None:
    fields = dict(re.findall(r'-F (\w+)=(?:@(\S+)|"[^"]+")', PAGES[page]))
    assert {"image", "question"} <= fields.keys() <= AnswerRequest.model_fields.keys()
    assert (ROOT / fields["image"]).is_file()
