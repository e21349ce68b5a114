"""What the service says of itself and of its jobs."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field

from cow_service.records.base import Record, Sha256
from cow_service.records.results import Answer, Problem, Simulation


class BackendInfo(Record):
    """A reader or generator: what it is, what it needs, whether it is ready."""

    name: str
    default: bool = Field(description="Used where a request names none.")
    ready: bool | None = Field(description="Null where nothing is known of it before it is used.")
    needs: tuple[str, ...] = Field(default=(), description="Python modules that it uses.")
    summary: str
    licence: str | None = None
    weights: str | None = Field(default=None, description="Repository of its weights; null where it has none.")
    missing: tuple[str, ...] = Field(
        default=(), description="Python modules that are not installed, and settings (COW_...) that are not set."
    )
    install: str | None = Field(default=None, description="The command that installs them.")
    pull: str | None = Field(
        default=None, description="The command that downloads its weights, where they are not here."
    )
    defaults: dict[str, bool | int | float | str] = Field(default_factory=dict)


class Models(Record):
    """What `GET /models` returns."""

    readers: tuple[BackendInfo, ...]
    generators: tuple[BackendInfo, ...]
    mllms: tuple[str, ...] = Field(default=(), description="Manifests of multimodal LLMs: what `COW_MLLM` may name.")


JobKind = Literal["simulate", "answer"]
JobStatus = Literal["queued", "running", "succeeded", "failed", "canceled"]
TERMINAL: tuple[JobStatus, ...] = ("succeeded", "failed", "canceled")


class Job(Record):
    """A request that was accepted. Once its status is succeeded, failed or canceled it never changes again."""

    id: str
    kind: JobKind
    status: JobStatus
    stage: str | None = Field(default=None, description="The stage that it is in, or was in when it ended.")
    progress: float = Field(ge=0, le=1, description="Share of the work that is done, all stages together.")
    question: str | None = Field(
        default=None,
        description="The request's; in lists at most 200 characters of it, the last of them `…` where it is longer. "
        "Null for jobs of earlier versions.",
    )
    image: Sha256 | None = Field(
        default=None, description="The artifact that the request's image is kept as; null for jobs of earlier versions."
    )
    created_at: str = Field(description="RFC 3339, UTC.")
    finished_at: str | None = Field(default=None, description="RFC 3339, UTC.")
    position: int | None = Field(
        default=None,
        ge=0,
        description="Jobs that are taken before it, while it is queued and asked for by its id; null otherwise.",
    )
    expected_wait: float | None = Field(
        default=None, ge=0, description="Seconds until it is taken, at the pace of the last minutes; null if not known."
    )
    generator: str = Field(description="Who makes its frames.")
    result: Simulation | Answer | None = Field(default=None, description="Of a succeeded job, but not in lists.")
    problem: Problem | None = Field(default=None, description="Of a failed job.")


class AcceptedRequest(Record):
    """The request that became a job."""

    kind: JobKind = Field(description="`simulate`: of `POST /simulate`; `answer`: of `POST /answer`.")
    request: dict[str, Any] = Field(
        description="The body, which can be sent again as it stands: image and masks as artifacts, without fields that "
        "have their default, and without the webhook."
    )


class JobPage(Record):
    """Some jobs, newest first."""

    jobs: tuple[Job, ...]
    next: str | None = Field(default=None, description="`cursor` of the page after this one; null on the last.")


ProcessRole = Literal["all", "api", "worker"]


class GpuMemory(Record):
    """Memory of one GPU."""

    device: str = Field(description="Such as cuda:0.")
    allocated_mb: float = Field(ge=0, description="In use by the process, MB.")
    reserved_mb: float = Field(ge=0, description="Held by the process, MB.")
    total_mb: float = Field(ge=0, description="Of the device, MB.")


class WorkerJob(Record):
    """A job that is being computed: how far it is, never what was asked nor who asked."""

    id: str | None = Field(default=None, description="Null where the server has keys.")
    kind: JobKind
    stage: str | None = None
    progress: float = Field(ge=0, le=1, description="Share of the work that is done, all stages together.")
    seconds: float = Field(ge=0, description="Since it began to be computed.")


class WorkerInfo(Record):
    """What computes jobs: a worker process, or the threads of the server itself (`COW_WORKERS=0`)."""

    name: str = Field(description="Its queue and a number.")
    queue: str | None = Field(description="Whose jobs it computes; null: of all queues.")
    pid: int
    memory_mb: float = Field(ge=0, description="Resident memory, MB (10^6 bytes).")
    jobs_done: int = Field(ge=0)
    jobs: tuple[WorkerJob, ...] = Field(default=(), description="At hand; several where jobs wait for an MLLM.")
    gpus: tuple[GpuMemory, ...] = Field(default=(), description="That it uses.")


class ProcessInfo(Record):
    """One process on the job database: a server, or `cow worker`."""

    executor_id: str
    seen_at: str = Field(description="RFC 3339, UTC, by the clock of that process.")
    role: ProcessRole
    host: str
    pid: int
    version: str = Field(description="Of COW.")
    workflow_version: str = Field(description="Jobs of this version are taken, no others.")
    queues: dict[str, int] = Field(
        default_factory=dict, description="Queues that it takes jobs from, and how many of each at the same time."
    )
    workers: tuple[WorkerInfo, ...] = ()


class QueueInfo(Record):
    """One queue."""

    name: str
    queued: int = Field(ge=0, description="Jobs that wait.")
    running: int = Field(ge=0, description="Jobs that are computed.")
    capacity: int = Field(ge=0, description="Jobs that all processes together take at the same time.")
    oldest_seconds: float | None = Field(default=None, ge=0, description="How long the oldest of `queued` has waited.")
    jobs_per_minute: float = Field(ge=0, description="That ended, over the last five minutes.")


class Unserved(Record):
    """Jobs that wait, and that no process takes."""

    queue: str
    workflow_version: str
    jobs: int = Field(gt=0)
    reason: Literal["version", "queue"] = Field(
        description="No process has their workflow version, or none of those that have it serves their queue."
    )


class Workers(Record):
    """What `GET /workers` returns."""

    processes: tuple[ProcessInfo, ...]
    queues: tuple[QueueInfo, ...]
    unserved: tuple[Unserved, ...] = ()
