"""The processes on a job database, their workers, and the queues: what `GET /workers` returns."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from cow_service.records.base import Record
from cow_service.records.service import JobKind

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
