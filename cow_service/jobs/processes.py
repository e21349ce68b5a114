"""Tells the job database what this process does, every two seconds, and has it shown in its metrics."""

from __future__ import annotations

import logging
import os
import platform
import threading
import time
from collections.abc import Callable, Mapping

from dbos import DBOS

from cow_service import __version__
from cow_service.errors import CowError
from cow_service.jobs import workflows
from cow_service.jobs.active import share_done
from cow_service.jobs.computing import Computer, WorkerState
from cow_service.jobs.open_jobs import OpenJobs
from cow_service.jobs.overview import Overview
from cow_service.jobs.process_table import ProcessTable
from cow_service.jobs.queues import known_queues
from cow_service.observability.logging import rfc3339
from cow_service.records import ProcessInfo, ProcessRole, WorkerInfo, WorkerJob

TELL_SECONDS = 2.0  # between two rows
JOIN_TIMEOUT_SECONDS = 5.0  # a thread that waits for a database that is down does not keep the process

log = logging.getLogger("cow_service")


class Processes:
    """This process among those on the job database. A thread of its own: maintenance may take minutes."""

    def __init__(self, open_jobs: OpenJobs, computer: Computer, role: ProcessRole | None) -> None:
        """`role`: by default that of the settings."""
        self._open_jobs, self._computer = open_jobs, computer
        self._role: ProcessRole = role or open_jobs.service.settings.role
        self._table = ProcessTable(open_jobs.database.engine)
        self.overview = Overview(open_jobs.database.engine, open_jobs.service.settings)
        self._executor = ""
        self._queues: dict[str, int] = {}
        self._draining = False
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        """Begins to tell. DBOS runs already."""
        self._executor = DBOS.executor_id
        self._draining = False
        self._stop.clear()
        metrics = self._open_jobs.service.metrics
        metrics.queue_depth, metrics.queue_oldest = self._depth, self._oldest
        metrics.queue_unserved, metrics.workers = self._unserved, self.workers
        self._thread = threading.Thread(target=self._tell_on, name="cow-processes", daemon=True)
        self._thread.start()

    def drain(self) -> None:
        """The process takes no more jobs, and goes on with those that it has."""
        self._draining = True

    def stop(self) -> None:
        """The process ends."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join(JOIN_TIMEOUT_SECONDS)
            self._thread = None
            self._try(lambda: self._table.remove(self._executor))

    def workers(self) -> tuple[WorkerInfo, ...]:
        """What computes jobs in this process and its worker processes."""
        return tuple(map(self._info, self._computer.workers()))

    def _tell_on(self) -> None:
        capacities = ((name, self._computer.capacity(name)) for name in known_queues(self._open_jobs.service.settings))
        self._queues = {name: capacity for name, capacity in capacities if capacity > 0}
        while not self._stop.is_set():
            self._try(self._tell)
            self._stop.wait(TELL_SECONDS)

    def _tell(self) -> None:
        self._table.write(
            ProcessInfo(
                executor_id=self._executor,
                seen_at=rfc3339(time.time()),
                role=self._role,
                host=platform.node(),
                pid=os.getpid(),
                version=__version__,
                workflow_version=workflows.VERSION,
                queues={} if self._draining else self._queues,
                workers=self.workers(),
            ),
            self._open_jobs.active.ids_of_waiting(),
        )

    def _try(self, work: Callable[[], None]) -> None:
        """Does it, and goes on where it fails: what is told is for people, and no job depends on it."""
        try:
            work()
        except CowError as error:
            log.warning("what this process does could not be told: %s", error.detail)

    def _info(self, state: WorkerState) -> WorkerInfo:
        return WorkerInfo(
            name=state.name,
            queue=state.queue,
            pid=state.pid,
            memory_mb=round(state.memory_bytes / 1e6, 1),
            jobs_done=state.jobs_done,
            jobs=tuple(job for job_id in state.jobs if (job := self._job(job_id)) is not None),
            gpus=state.gpus,
        )

    def _job(self, job_id: str) -> WorkerJob | None:
        active = self._open_jobs.active.get(job_id)
        if active is None or active.begun is None:
            return None
        stage, done = active.at
        seconds = round(time.monotonic() - active.begun, 1)
        return WorkerJob(
            id=job_id, kind=active.kind, stage=stage, progress=share_done(active.kind, stage, done), seconds=seconds
        )

    def _depth(self) -> Mapping[tuple[str, str, str], int]:
        depth: dict[tuple[str, str, str], int] = {}
        for one in self.overview.counts():
            key = one.queue, one.generator, one.state
            depth[key] = depth.get(key, 0) + one.jobs
        return depth

    def _oldest(self) -> Mapping[str, float]:
        return {one.name: one.oldest_seconds or 0.0 for one in self.overview.workers().queues}

    def _unserved(self) -> Mapping[tuple[str, str], int]:
        unserved: dict[tuple[str, str], int] = {}
        for one in self.overview.workers().unserved:
            unserved[one.queue, one.reason] = unserved.get((one.queue, one.reason), 0) + one.jobs
        return unserved
