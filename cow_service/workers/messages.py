"""Messages between a server and its worker processes: JSON, so that neither executes what the other one sends.

A worker decodes images and runs models, and may be taken over by one of them. All that the server takes from it is
data: of a limited size, and checked. `run` names an attempt (`TakenJob`): two of one job may be at work for a moment.
"""

from dataclasses import dataclass
from typing import Annotated, Any, Literal, Protocol

from pydantic import Field, TypeAdapter

from cow_service.jobs.computing import JobOutcome
from cow_service.jobs.job_table import TakenJob
from cow_service.records import GpuMemory, Stage, WorkerLoad

MAX_MESSAGE_BYTES = 512_000_000  # a larger one ends the connection


class Pipe(Protocol):
    """What messages go through, of one thread at a time. Raises `OSError` or `EOFError` once the other end is gone."""

    def send_bytes(self, buf: bytes, /) -> None:
        """Sends one message."""

    def recv_bytes(self, maxlength: int | None = None, /) -> bytes:
        """Waits for the next message. Raises `OSError` for one that is longer."""
        ...


# To the worker, behind its settings.


@dataclass(frozen=True)
class Start:
    """Compute a job."""

    job: TakenJob
    kind: Literal["start"] = "start"


@dataclass(frozen=True)
class ToJob:
    """The result of a job is no longer wanted, or the job holds the lock of the key that it asked for."""

    run: str
    kind: Literal["cancel", "key-held"]


# From the worker.


@dataclass(frozen=True)
class Loaded:
    """The default backends are loaded, or the error, as JSON, why they are not."""

    error: dict[str, Any] | None
    kind: Literal["loaded"] = "loaded"


@dataclass(frozen=True)
class Heartbeat:
    """The process is alive. `memory_bytes` is its resident set."""

    memory_bytes: int
    gpus: tuple[GpuMemory, ...]
    load: WorkerLoad
    kind: Literal["heartbeat"] = "heartbeat"


@dataclass(frozen=True)
class Progressed:
    """The job of an attempt has come so far in a stage, 0 to 1. Without a stage: it has begun."""

    run: str
    stage: Stage | None
    done: float
    kind: Literal["progressed"] = "progressed"


@dataclass(frozen=True)
class LookedFor:
    """A stage was looked for among stored results."""

    run: str
    stage: Stage
    found: bool
    kind: Literal["looked-for"] = "looked-for"


@dataclass(frozen=True)
class HoldKey:
    """A job wants the lock of a key: what one job computes, another one waits for, whatever worker it has.

    It has one at a time. None gives it back.
    """

    run: str
    key: str | None
    kind: Literal["hold-key"] = "hold-key"


@dataclass(frozen=True)
class Succeeded:
    """The job is done."""

    run: str
    outcome: JobOutcome
    kind: Literal["succeeded"] = "succeeded"


@dataclass(frozen=True)
class Failed:
    """The job failed with an error, as JSON; `Canceled` if it was canceled."""

    run: str
    error: dict[str, Any]
    kind: Literal["failed"] = "failed"


ToWorker = Start | ToJob | None  # None is the last: the worker has no jobs, and ends
OfJob = Progressed | LookedFor | HoldKey | Succeeded | Failed
FromWorker = Loaded | Heartbeat | OfJob

# Validating raises `ValidationError` for what is no message.
TO_WORKER: TypeAdapter[ToWorker] = TypeAdapter(ToWorker)
FROM_WORKER: TypeAdapter[FromWorker] = TypeAdapter(Annotated[FromWorker, Field(discriminator="kind")])
