"""Processes, queues, and jobs that no process takes: one picture of a job database, for whoever asks."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterable, Sequence
from typing import Literal

import sqlalchemy as sa

from cow_service.errors import NotReady
from cow_service.jobs import workflows
from cow_service.jobs.process_table import ProcessTable
from cow_service.jobs.queue_counts import RATE_SECONDS, OpenCount, ended_lately, open_counts
from cow_service.jobs.queues import LIGHT, queue_of
from cow_service.records import ProcessInfo, QueueInfo, Unserved, Workers
from cow_service.settings import Settings

MAX_AGE_SECONDS = 1.0  # of a picture that is given out again


class Overview:
    """Reads the picture, at most once a second however many ask. Safe to use from every thread."""

    def __init__(self, engine: sa.Engine, settings: Settings) -> None:
        self._engine, self._settings = engine, settings
        self._table = ProcessTable(engine)
        self._lock = threading.Lock()
        self._counts: list[OpenCount] = []
        self._workers = Workers(processes=(), queues=())
        self._read_at = -MAX_AGE_SECONDS

    def workers(self) -> Workers:
        """What `GET /workers` returns. Raises `StorageUnavailable`."""
        with self._lock:
            self._read()
            return self._workers

    def counts(self) -> list[OpenCount]:
        """The jobs that wait or run. Raises `StorageUnavailable`."""
        with self._lock:
            self._read()
            return self._counts

    def check_served(self) -> None:
        """Raises `NotReady` where nobody takes the jobs of the default request, or those of another version."""
        found, settings = self.workers(), self._settings
        queue = queue_of(settings.reader, settings.generator, settings)
        if settings.role == "api" and not _serving(found.processes, queue, workflows.VERSION):
            raise NotReady(remedy(Unserved(queue=queue, workflow_version=workflows.VERSION, jobs=1, reason="queue")))
        for one in found.unserved:
            if one.reason == "version":
                raise NotReady(f"{told(one)} {remedy(one)}")

    def _read(self) -> None:
        if time.monotonic() - self._read_at < MAX_AGE_SECONDS:
            return
        alive = self._table.alive()
        counts, processes = open_counts(self._engine, alive.waiting), alive.processes
        if self._settings.api_keys:
            processes = tuple(map(_without_ids, processes))
        self._counts = counts
        self._workers = Workers(
            processes=processes,
            queues=_queues(processes, counts, ended_lately(self._engine)),
            unserved=unserved(processes, counts),
        )
        self._read_at = time.monotonic()


def unserved(processes: Sequence[ProcessInfo], counts: Iterable[OpenCount]) -> tuple[Unserved, ...]:
    """Queued jobs that none of these processes takes."""
    waiting: dict[tuple[str, str], int] = {}
    for one in counts:
        if one.state == "queued":
            key = one.workflow_version, one.queue
            waiting[key] = waiting.get(key, 0) + one.jobs
    versions = {process.workflow_version for process in processes if process.queues}
    found: list[Unserved] = []
    for (version, queue), jobs in sorted(waiting.items()):
        if not _serving(processes, queue, version):
            reason: Literal["version", "queue"] = "queue" if version in versions else "version"
            found.append(Unserved(queue=queue, workflow_version=version, jobs=jobs, reason=reason))
    return tuple(found)


def told(one: Unserved) -> str:
    """Says that jobs wait in vain."""
    jobs, wait = ("1 job", "waits") if one.jobs == 1 else (f"{one.jobs} jobs", "wait")
    of = f"workflow version {one.workflow_version}" if one.reason == "version" else f"the queue {one.queue!r}"
    return f"{jobs} of {of} {wait}, and no process takes them."


def remedy(one: Unserved) -> str:
    """Says what to do about it."""
    if one.reason == "version":
        return (
            f"Start a server or worker of a COW with workflow version {one.workflow_version} on this job database "
            "until they are done, or cancel them."
        )
    return (
        f"No process takes jobs of the queue {one.queue!r}: start `cow worker --queues {one.queue}` or a server on "
        "this job database, where the backend of that queue is installed."
    )


def _serving(processes: Iterable[ProcessInfo], queue: str, version: str) -> bool:
    return any(queue in one.queues and one.workflow_version == version for one in processes)


def _queues(
    processes: Sequence[ProcessInfo], counts: Iterable[OpenCount], ended: dict[str, int]
) -> tuple[QueueInfo, ...]:
    jobs = {"queued": dict[str, int](), "running": dict[str, int]()}
    oldest: dict[str, float] = {}
    for one in counts:
        jobs[one.state][one.queue] = jobs[one.state].get(one.queue, 0) + one.jobs
        if one.state == "queued":
            oldest[one.queue] = max(one.oldest_seconds, oldest.get(one.queue, 0.0))
    served = {name for process in processes for name in process.queues}
    names = {LIGHT} | served | jobs["queued"].keys() | jobs["running"].keys() | ended.keys()
    return tuple(
        QueueInfo(
            name=name,
            queued=jobs["queued"].get(name, 0),
            running=jobs["running"].get(name, 0),
            capacity=sum(process.queues.get(name, 0) for process in processes),
            oldest_seconds=oldest.get(name),
            jobs_per_minute=ended.get(name, 0) * 60 / RATE_SECONDS,
        )
        for name in sorted(names, key=lambda name: (name != LIGHT, name))
    )


def _without_ids(process: ProcessInfo) -> ProcessInfo:
    """Where there are keys, nobody is told the ids of others' jobs."""
    workers = tuple(
        worker.model_copy(update={"jobs": tuple(job.model_copy(update={"id": None}) for job in worker.jobs)})
        for worker in process.workers
    )
    return process.model_copy(update={"workers": workers})
