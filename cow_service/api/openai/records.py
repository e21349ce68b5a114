"""What COW adds to OpenAI's records: the models, and `cow` of the replies of `/v1`."""

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


class ChatProgress(Record):
    """How far the job is."""

    job: str = Field(description="Its id: `GET /jobs/{id}`.")
    status: JobStatus
    stage: str | None
    progress: float = Field(ge=0, le=1, description="Share of the work that is done.")


class ChatCompletion(BaseModel, extra="allow"):
    """OpenAI's chat completion, of an MLLM as it came. Without an MLLM `id` is `chatcmpl-` and the id of the job."""

    cow: Answer | ChatImagination = Field(description="Without an MLLM the whole answer, as `POST /answer` returns it.")


class ResponseReply(BaseModel, extra="allow"):
    """OpenAI's response, and `cow` as in a chat completion."""

    cow: Answer | ChatImagination


class ChatChunk(BaseModel, extra="allow"):
    """OpenAI's chunk of a chat completion, an event of a stream: progress, then reasoning and text, then the end."""

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
