"""The responses of `/v1`: OpenAI's records, each with COW's own fields as `cow`.

Replies of an MLLM go on as they came: of those, these records say only what COW adds.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

from pydantic import BaseModel, Field

from cow_service.errors import FieldError, ModelNotFound, shortened
from cow_service.readers.mllm.contents import PLACEBOS, Content
from cow_service.records import Answer, Frame, FramePolicy, JobStatus, Record, Usage
from cow_service.service import Service


class ChatModel(Record):
    """A model: the answerer, with imagination or without."""

    id: str
    object: Literal["model"] = "model"
    created: int = Field(description="Seconds since 1970: when this server started.")
    owned_by: Literal["cow"] = "cow"


class ChatModels(Record):
    """What `GET /v1/models` returns."""

    object: Literal["list"] = "list"
    data: tuple[ChatModel, ...]


class ChatUsage(Record):
    """Tokens of everything that the multimodal LLM was asked: simulation, votes and baseline."""

    prompt_tokens: int
    completion_tokens: int
    total_tokens: int


class ChatReply(Record):
    """The answer as a message."""

    role: Literal["assistant"] = "assistant"
    content: str = Field(description='A letter; text for an open question; "Not sure" where `cow.answer` is null.')
    reasoning_content: str | None = Field(default=None, description="The MLLM's own, where there is one.")
    refusal: None = None


class ChatChoice(Record):
    """The only choice."""

    index: Literal[0] = 0
    message: ChatReply
    finish_reason: Literal["stop"] = "stop"
    logprobs: None = None


class ChatCompletion(Record):
    """What `POST /v1/chat/completions` returns."""

    id: str = Field(description="`chatcmpl-` and the id of the job.")
    object: Literal["chat.completion"] = "chat.completion"
    created: int = Field(description="Seconds since 1970.")
    model: str
    choices: tuple[ChatChoice]
    usage: ChatUsage
    cow: Answer = Field(description="The whole answer, as `POST /answer` returns it.")


class ChatImagination(Record):
    """What COW did with a chat before the MLLM was asked: `cow` of the reply of an MLLM."""

    imagined: bool = Field(description="Whether what `content` says was added to the last user message.")
    content: Content = Field(
        default="simulated",
        description="What the model's name has the MLLM shown beside the question: `simulated`, a control, or `none`.",
    )
    votes: dict[str, int] | None = Field(
        default=None, description="With `:vote-K`: how many replies gave each answer, by its letter."
    )
    reason: str | None = Field(
        default=None,
        description="Why not: `no-imagination` (the model's name says so), `no-question`, `no-image`, "
        "`several-images`, `other-parts` (a video, a file...), or the code of the problem that imagining came to.",
    )
    detail: str | None = Field(default=None, description="The same in a sentence.")
    simulation: str | None = Field(
        default=None, description="Id of the question's simulation and its job: `GET /jobs/{id}`."
    )
    frames: tuple[Frame, ...] = Field(default=(), description="The imagined frames that were added, in their order.")
    prompts: dict[str, int] = Field(default_factory=dict, description="Version of the note that introduces them.")
    usage: Usage = Field(default=Usage(), description="Of imagining alone; the reply's own is `usage` beside `cow`.")
    usage_total: Usage = Field(default=Usage(), description="What imagining would have cost without reuse.")
    reused: tuple[str, ...] = Field(default=(), description="Stages of the simulation that were cached.")
    warnings: tuple[str, ...] = ()


class MllmCompletion(BaseModel, extra="allow"):
    """What `POST /v1/chat/completions` returns of an MLLM: the reply as it came, and `cow`."""

    cow: ChatImagination


class ResponseReply(BaseModel, extra="allow"):
    """What `POST /v1/responses` returns: a response as OpenAI has it, and `cow` as in a chat."""

    id: str
    object: Literal["response"]
    status: Literal["completed", "incomplete"]
    output: list[dict[str, Any]]
    cow: Answer | ChatImagination


class ChatDelta(Record):
    """What a chunk adds to the message."""

    role: Literal["assistant"] | None = None
    content: str | None = None
    reasoning_content: str | None = None


class ChunkChoice(Record):
    """The only choice."""

    index: Literal[0] = 0
    delta: ChatDelta
    finish_reason: Literal["stop"] | None = None
    logprobs: None = None


class ChatProgress(Record):
    """How far the job is."""

    job: str = Field(description="Its id: `GET /jobs/{id}`.")
    status: JobStatus
    stage: str | None
    progress: float = Field(ge=0, le=1, description="Share of the work that is done.")


class ChatChunk(Record):
    """One event of a stream: progress, then the answer's reasoning and text, then its end."""

    id: str
    object: Literal["chat.completion.chunk"] = "chat.completion.chunk"
    created: int
    model: str
    choices: tuple[ChunkChoice, ...] = Field(description="Empty in the chunk that has `usage`.")
    usage: ChatUsage | None = None
    cow: ChatProgress | Answer | ChatImagination | None = Field(
        default=None,
        description="Progress; the answer in the last chunk; of an MLLM, what was imagined, before its first chunk.",
    )


class UpstreamError(BaseModel, extra="allow"):
    """An error of the MLLM's server, with its status, in OpenAI's form. Its words are only logged."""

    error: dict[str, Any] = Field(description="`message` of COW; `type`, `param` and `code` as the server gave them.")


PREFIX = "cow/"
WITHOUT = ":no-imagination"
MLLM_READERS = ("mllm", "local")  # they serve the MLLM of the settings, and are called after it
# What a suffix sets in an `Answerer`. A name holds at most one suffix for each field.
SUFFIXES: dict[str, tuple[str, Any]] = {
    WITHOUT[1:]: ("content", "none"),
    **{content: ("content", content) for content in (*PLACEBOS, "text")},
    **{policy: ("policy", policy) for policy in ("initial", "events")},
    **{f"vote-{votes}": ("votes", votes) for votes in range(2, 10)},
}
LISTED = (
    "",
    WITHOUT,
    *(f":{each}" for each in (*PLACEBOS, "text", "initial", "events", "vote-3")),
    f"{WITHOUT}:vote-3",
)


@dataclass(frozen=True)
class Answerer:
    """What a model's name stands for."""

    reader: str
    content: Content = "simulated"
    policy: FramePolicy | None = None  # of the frames; None: as the request says
    votes: int = 1

    @property
    def imagine(self) -> Literal["always", "never"]:
        """As a field of an `AnswerRequest`."""
        return "never" if self.content == "none" else "always"


def answerers(service: Service) -> dict[str, Answerer]:
    """The models that are listed, by name: the default reader first, as some callers take whatever comes first."""
    return {
        base + listed: answerer
        for base, reader in _readers(service).items()
        for listed in LISTED
        if (answerer := _with_suffixes(reader, listed.split(":")[1:])) is not None
    }


def find_answerer(service: Service, model: str) -> Answerer:
    """Who answers under that name, suffixes in any order. Raises `ModelNotFound`."""
    readers, found = _readers(service), None
    # Names of MLLMs may hold colons themselves.
    base = max((name for name in readers if f"{model}:".startswith(f"{name}:")), key=len, default=None)
    if base is not None:
        found = _with_suffixes(readers[base], model.removeprefix(base).split(":")[1:])
    if found is None:
        detail = f"There is no model '{shortened(model)}'. There are: {', '.join(answerers(service))}."
        raise ModelNotFound(detail, errors=(FieldError("/model", "no model has that name"),))
    return found


def _readers(service: Service) -> dict[str, str]:
    """Readers by the names of their models without suffixes."""
    settings = service.settings
    serving = settings.reader if settings.reader in MLLM_READERS else "mllm"  # whom the MLLM's name stands for
    found: dict[str, str] = {}
    for reader in sorted(service.readers.names(), key=lambda name: name != settings.reader):
        name = reader if reader not in MLLM_READERS else settings.mllm if reader == serving else None
        if name is not None:
            found[PREFIX + name] = reader
    return found


def _with_suffixes(reader: str, suffixes: Sequence[str]) -> Answerer | None:
    """The reader as the suffixes have it asked; None if one is unknown, or they contradict each other."""
    fields: dict[str, Any] = {}
    for suffix in suffixes:
        field, value = SUFFIXES.get(suffix, ("", None))
        if not field or field in fields:
            return None
        fields[field] = value
    found = Answerer(reader, **fields)
    without_frames = found.content == "none" and found.policy is not None
    without_mllm = reader not in MLLM_READERS and set(suffixes) - {WITHOUT[1:]}
    return None if without_frames or without_mllm else found
