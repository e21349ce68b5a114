"""What a worker process and the process that started it tell each other, over a pipe of their own."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from cow_service.jobs.computing import Outcome
from cow_service.jobs.spec import JobSpec
from cow_service.media.images import DecodedImage
from cow_service.records import GpuMemory
from cow_service.requests import Stage
from cow_service.settings import Settings

# To the worker.


@dataclass(frozen=True)
class Configure:
    """The first message: the settings of this worker, of which those of concurrency are its own share."""

    settings: Settings


@dataclass(frozen=True)
class Start:
    """Compute a job."""

    job_id: str
    spec: JobSpec
    owner: str | None
    image: DecodedImage | None  # else it is read from the artifacts


@dataclass(frozen=True)
class Cancel:
    """Nobody wants the result any more."""

    job_id: str


@dataclass(frozen=True)
class KeyHeld:
    """The job holds the lock of the key that it asked for."""

    job_id: str


@dataclass(frozen=True)
class Stop:
    """The last message: the process ends."""


# From the worker.


@dataclass(frozen=True)
class Loaded:
    """The default backends are loaded, or the error, as JSON, for which they are not."""

    error: dict[str, Any] | None


@dataclass(frozen=True)
class Heartbeat:
    """The process is alive. `memory_bytes` is its resident set."""

    memory_bytes: int
    gpus: tuple[GpuMemory, ...]


@dataclass(frozen=True)
class Progressed:
    """A job has come so far in a stage, 0 to 1."""

    job_id: str
    stage: Stage | None
    done: float


@dataclass(frozen=True)
class LookedFor:
    """A stage was looked for among stored results."""

    job_id: str
    stage: Stage
    found: bool


@dataclass(frozen=True)
class HoldKey:
    """A job wants the lock of a key: what one job computes, another one waits for, whatever worker it has."""

    job_id: str
    key: str


@dataclass(frozen=True)
class ReleaseKey:
    """The job gives the lock of a key back."""

    job_id: str
    key: str


@dataclass(frozen=True)
class Succeeded:
    """The job is done."""

    job_id: str
    outcome: Outcome


@dataclass(frozen=True)
class Failed:
    """The job failed with an error, as JSON; `Canceled` where it was canceled."""

    job_id: str
    error: dict[str, Any]


ToWorker = Configure | Start | Cancel | KeyHeld | Stop
OfJob = Progressed | LookedFor | HoldKey | ReleaseKey | Succeeded | Failed
FromWorker = Loaded | Heartbeat | OfJob
