"""The body of `POST /v1/chat/completions`: OpenAI's fields, those that nothing here does included."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, GetCoreSchemaHandler, GetJsonSchemaHandler, model_validator
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema, core_schema

from cow_service.records import Record
from cow_service.requests import Finite, Flag, Whole

MAX_MESSAGES = 1000
MAX_PARTS = 1000  # of one message
MAX_NAME = 300  # characters of a model's name

Role = Literal["system", "developer", "user", "assistant"]
PartType = Literal["text", "image_url"]


@dataclass(frozen=True)
class Only:
    """A field that OpenAI has and that takes only the values that ask for nothing here; `remedy` says what to do."""

    remedy: str
    values: tuple[Any, ...] = ()

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.no_info_after_validator_function(self._check, core_schema.any_schema())

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        return {"enum": [*self.values, None]}

    def _check(self, value: Any) -> Any:
        for each in (*self.values, None):
            if value == each and isinstance(value, bool) == isinstance(each, bool):
                return value
        raise ValueError(self.remedy)


class Neutral:
    """Values of a parameter that is not used for which no warning is given: they ask for nothing."""

    def __init__(self, *values: Any) -> None:
        self.values = values


def _listed(made: Callable[[str], Any]) -> Callable[[Any], Any]:
    """A text alone as a list of one."""
    return lambda value: [made(value)] if isinstance(value, str) else value


class ChatImage(Record):
    """Where an image is."""

    url: str = Field(description="data:image/png;base64,... (PNG, JPEG or WebP), or https://... where COW allows it.")
    detail: Literal["auto", "low", "high", "original"] | None = Field(default=None, description="Not used.")


class ChatPart(Record):
    """A part of a message: a text or an image."""

    type: PartType
    text: str | None = None
    image_url: ChatImage | None = None

    @model_validator(mode="after")
    def _as_its_type_says(self) -> ChatPart:
        given = {name for name in ("text", "image_url") if getattr(self, name) is not None}
        if given != {self.type}:
            raise ValueError(f"a part of the type `{self.type}` holds `{self.type}`, and nothing else")
        return self


Parts = Annotated[tuple[ChatPart, ...], Field(fail_fast=True, max_length=MAX_PARTS)]
Content = Annotated[
    Parts | None,
    BeforeValidator(
        _listed(lambda text: {"type": "text", "text": text}), json_schema_input_type=str | tuple[ChatPart, ...] | None
    ),
]
Stops = Annotated[
    tuple[str, ...] | None,
    BeforeValidator(_listed(str), json_schema_input_type=str | tuple[str, ...] | None),
]
NO_TOOLS = "COW calls no tools: leave it out"


class ChatMessage(Record):
    """One message. Answers may be sent back as they came."""

    role: Role
    content: Content = Field(default=None, description="Text, or parts. Needed but of `assistant`.")
    name: str | None = None
    reasoning_content: str | None = None
    refusal: str | None = None
    annotations: Annotated[Any, Only("COW reads none: leave it out", ([],))] = None
    audio: Annotated[Any, Only("COW hears nothing: leave it out")] = None
    tool_calls: Annotated[Any, Only(NO_TOOLS, ([],))] = None
    function_call: Annotated[Any, Only(NO_TOOLS)] = None

    @model_validator(mode="after")
    def _says_something(self) -> ChatMessage:
        if self.content is None and self.role != "assistant":
            raise ValueError(f"a message of the role `{self.role}` needs `content`")
        return self


class StreamOptions(Record):
    """What else a stream holds."""

    include_usage: Flag | None = Field(default=None, description="A last chunk with the tokens.")
    include_obfuscation: Flag | None = Field(default=None, description="Not used.")


NOT_USED: Any = Field(default=None, description="Not used.")


class ChatRequest(Record):
    """A question about one image, as OpenAI's chat completions have it. The question is the last user message.

    Any MLLM is asked in COW's own words and with COW's own settings, so that most parameters are not used; where one
    asks for something, a warning in `cow.warnings` of the answer says that it was not done.
    """

    model: str = Field(max_length=MAX_NAME, description="One of `GET /v1/models`.")
    messages: tuple[ChatMessage, ...] = Field(
        max_length=MAX_MESSAGES,
        description="With exactly one image, in a user message.",
        json_schema_extra={"minItems": 1},  # checked with the image: one wrong message must not look like none
    )
    stream: Flag | None = Field(default=None, description="Answer with server-sent events.")
    stream_options: StreamOptions | None = None
    seed: Whole | None = Field(default=None, description="`seed` of `AnswerRequest`.")
    cow: dict[str, Any] | None = Field(default=None, description="Any other fields of `AnswerRequest`.")

    n: Annotated[Any, Only("takes only 1: `cow.votes` has the model asked more often", (1,))] = None
    tools: Annotated[Any, Only(NO_TOOLS, ([],))] = None
    tool_choice: Annotated[Any, Only(NO_TOOLS, ("none", "auto"))] = None
    parallel_tool_calls: Flag | None = NOT_USED
    functions: Annotated[Any, Only(NO_TOOLS, ([],))] = None
    function_call: Annotated[Any, Only(NO_TOOLS, ("none", "auto"))] = None
    logprobs: Annotated[Any, Only("COW knows no probabilities: leave it out; `cow.votes` gives a split", (False,))] = (
        None
    )
    top_logprobs: Annotated[Any, Only("COW knows no probabilities: leave it out", (0,))] = None
    response_format: Annotated[
        Any, Only('takes only {"type": "text"}: the answer is a letter or a text, and `cow` has the rest as JSON',
                  ({"type": "text"},))
    ] = None  # fmt: skip
    modalities: Annotated[Any, Only('takes only ["text"]', (["text"],))] = None
    audio: Annotated[Any, Only("COW says nothing aloud: leave it out")] = None
    web_search_options: Annotated[Any, Only("COW searches nothing: leave it out")] = None
    moderation: Annotated[Any, Only("COW moderates nothing: leave it out")] = None

    temperature: Annotated[Finite | None, Neutral(0, 1)] = NOT_USED
    top_p: Annotated[Finite | None, Neutral(1)] = NOT_USED
    top_k: Annotated[Whole | None, Neutral(-1, 0, 1)] = NOT_USED
    min_p: Annotated[Finite | None, Neutral(0)] = NOT_USED
    presence_penalty: Annotated[Finite | None, Neutral(0)] = NOT_USED
    frequency_penalty: Annotated[Finite | None, Neutral(0)] = NOT_USED
    repetition_penalty: Annotated[Finite | None, Neutral(1)] = NOT_USED
    logit_bias: Annotated[dict[str, Any] | None, Neutral({})] = NOT_USED
    stop: Annotated[Stops, Neutral(())] = NOT_USED
    max_tokens: Whole | None = Field(default=None, description="Not used: answers are not cut.")
    max_completion_tokens: Whole | None = Field(default=None, description="Not used: answers are not cut.")
    reasoning_effort: Annotated[str | None, Neutral("medium")] = NOT_USED
    verbosity: Annotated[str | None, Neutral("medium")] = NOT_USED
    prediction: Any = NOT_USED
    user: str | None = NOT_USED
    safety_identifier: str | None = NOT_USED
    metadata: dict[str, Any] | None = NOT_USED
    store: Flag | None = NOT_USED
    service_tier: str | None = NOT_USED
    prompt_cache_key: str | None = NOT_USED
    prompt_cache_options: Any = NOT_USED
    prompt_cache_retention: str | None = NOT_USED
