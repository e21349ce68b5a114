"""The processes on a job database: what each reports about itself, and the state of all of them and the queues."""

import logging
import os
import platform
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from contextlib import closing
from functools import partial
from typing import Any, Literal, TypeVar

import sqlalchemy as sa

from cow_service import __version__
from cow_service.errors import CowError, NotReady
from cow_service.jobs.active import RestingThread
from cow_service.jobs.computing import Computer, EngineParts
from cow_service.jobs.database import Database
from cow_service.jobs.job_table import RATE_SECONDS, VERSION, JobTable, OpenCount
from cow_service.jobs.queues import LIGHT, known_queues, queue_of
from cow_service.jobs.schema import ALIVE_SECONDS, PROCESSES
from cow_service.observability.logging import rfc3339
from cow_service.records import ProcessInfo, ProcessRole, QueueInfo, Unserved, WorkerInfo, Workers
from cow_service.settings import Settings

TELL_SECONDS, QUIET_TELL_SECONDS = 2.0, 5.0  # between two rows, and while there are no jobs
FORGOTTEN_SECONDS = 3600.0  # after which a row is deleted
JOIN_TIMEOUT_SECONDS = 5.0  # a thread that waits for a database that is down does not keep the process
MAX_AGE_SECONDS = 1.0  # of an overview that is given out again

# What not every caller may know: where processes are, and the ids of others' jobs.
_OF_WORKERS = {"__all__": {"pid": True, "jobs": {"__all__": {"id": True}}}}
FOR_ADMINS: dict[str, Any] = {"processes": {"__all__": {"host": True, "pid": True, "workers": _OF_WORKERS}}}

Key = TypeVar("Key")

log = logging.getLogger("cow_service")


class ProcessTable:
    """One row for each process that runs an engine. Times are the database's: the clocks of machines differ.

    Every method raises `StorageUnavailable` where the database cannot be used.
    """

    def __init__(self, database: Database) -> None:
        self._database, self._now = database, database.now

    def write(self, info: ProcessInfo) -> None:
        """Records that a process is alive, and what it does; deletes rows of processes long gone."""
        row = self._database.insert(PROCESSES)
        row = row.values(executor=info.executor_id, seen=self._now, info=info.model_dump_json())
        kept = {"seen": row.excluded.seen, "info": row.excluded.info}
        with self._database.transaction() as connection:
            connection.execute(row.on_conflict_do_update(index_elements=["executor"], set_=kept))
            connection.execute(sa.delete(PROCESSES).where(PROCESSES.c.seen < self._now - FORGOTTEN_SECONDS))

    def remove(self, executor: str) -> None:
        """Deletes the row of a process that ends."""
        with self._database.transaction() as connection:
            connection.execute(sa.delete(PROCESSES).where(PROCESSES.c.executor == executor))

    def alive(self) -> tuple[ProcessInfo, ...]:
        """Those seen in the last `ALIVE_SECONDS`, by role, host and process id."""
        query = sa.select(PROCESSES.c.executor, PROCESSES.c.info)
        found: list[ProcessInfo] = []
        for executor, info in self._database.read(query.where(PROCESSES.c.seen > self._now - ALIVE_SECONDS)):
            try:
                found.append(ProcessInfo.model_validate_json(info, extra="ignore"))  # a later version has more fields
            except ValueError:
                log.warning("the process %s runs a version that this one does not understand", executor)
        return tuple(sorted(found, key=lambda one: (one.role, one.host or "", one.pid or 0)))


class Processes(RestingThread):
    """This process among those on the job database. A thread of its own: maintenance may take minutes."""

    def __init__(self, parts: EngineParts, computer: Computer, role: ProcessRole | None) -> None:
        """`role`: by default that of the settings."""
        super().__init__("cow-processes", parts.active, JOIN_TIMEOUT_SECONDS)
        self._parts, self._computer = parts, computer
        self._role: ProcessRole = role or parts.service.settings.role
        self._table = ProcessTable(parts.database)
        self.overview = Overview(parts.database, parts.service.settings)
        self._draining = False

    def start(self) -> None:
        """Begins to tell, and to count for the metrics."""
        self._draining = False
        metrics, overview = self._parts.service.metrics, self.overview
        metrics.workers = self.workers
        metrics.gauges |= {
            "cow_queue_depth": lambda: _sums(
                ((one.queue, one.generator, one.state), one.jobs) for one in overview.counts()
            ).items(),
            "cow_queue_oldest_seconds": lambda: [
                ((one.name,), one.oldest_seconds or 0.0) for one in overview.workers().queues
            ],
            "cow_queue_unserved": lambda: _sums(
                ((one.queue, one.reason), one.jobs) for one in overview.workers().unserved
            ).items(),
        }
        super().start()

    def drain(self) -> None:
        """The process takes no more jobs, and finishes those that it has."""
        self._draining = True

    def stop(self) -> None:
        """The process ends."""
        if self._thread is not None:
            super().stop()
            self._try(lambda: self._table.remove(self._parts.executor))

    def workers(self) -> tuple[WorkerInfo, ...]:
        """What computes jobs in this process and its worker processes."""
        return self._computer.workers(self._parts.active)

    def run(self) -> None:
        """Writes the row of this process, again and again."""
        names = known_queues(self._parts.service.settings)
        while not self._stop.is_set():
            capacities = ((name, self._computer.capacity(name)) for name in names)
            queues = {name: capacity for name, capacity in capacities if capacity > 0}
            info = ProcessInfo(
                executor_id=self._parts.executor,
                seen_at=rfc3339(time.time()),
                role=self._role,
                host=platform.node(),
                pid=os.getpid(),
                version=__version__,
                workflow_version=VERSION,
                queues={} if self._draining else queues,
                workers=self.workers(),
            )
            self._try(partial(self._table.write, info))
            self.rest(TELL_SECONDS, QUIET_TELL_SECONDS)

    def _try(self, work: Callable[[], None]) -> None:
        """Reports the process, and ignores failures: the report is for people, and no job depends on it."""
        try:
            work()
        except CowError as error:
            log.warning("the state of this process could not be reported: %s", error.detail)


class Overview:
    """Reads the picture, at most once a second however many ask. Safe to use from every thread."""

    def __init__(self, database: Database, settings: Settings) -> None:
        self._settings = settings
        self._table, self._jobs = ProcessTable(database), JobTable(database)
        self._lock = threading.Lock()
        self._picture: tuple[Workers, list[OpenCount]] = Workers(processes=(), queues=()), []
        self._read_at = -MAX_AGE_SECONDS

    def workers(self, *, for_admin: bool = True) -> Workers:
        """What `GET /workers` returns. Raises `StorageUnavailable`."""
        found = self._latest()[0]
        return found if for_admin else Workers.model_validate(found.model_dump(exclude=FOR_ADMINS))

    def counts(self) -> list[OpenCount]:
        """The jobs that wait or run. Raises `StorageUnavailable`."""
        return self._latest()[1]

    def check_served(self) -> None:
        """Raises `NotReady` if no process takes the jobs of the default request, or those of another version."""
        found, settings = self.workers(), self._settings
        queue = queue_of(settings.reader, settings.generator, settings)
        if settings.role == "api" and not _serving(found.processes, queue, VERSION):
            raise NotReady(remedy(Unserved(queue=queue, workflow_version=VERSION, jobs=1, reason="queue")))
        for one in found.unserved:
            if one.reason == "version":
                raise NotReady(f"{describe_unserved(one)} {remedy(one)}")

    def _latest(self) -> tuple[Workers, list[OpenCount]]:
        with self._lock:
            if time.monotonic() - self._read_at >= MAX_AGE_SECONDS:
                processes, counts = self._table.alive(), self._jobs.open_counts()
                queues = _queues(processes, counts, self._jobs.ended_lately())
                found = Workers(processes=processes, queues=queues, unserved=unserved(processes, counts))
                self._picture, self._read_at = (found, counts), time.monotonic()
            return self._picture


def unserved(processes: Sequence[ProcessInfo], counts: Iterable[OpenCount]) -> tuple[Unserved, ...]:
    """Queued jobs that none of these processes takes."""
    waiting = _sums(((one.workflow_version, one.queue), one.jobs) for one in counts if one.state == "queued")
    versions = {process.workflow_version for process in processes if process.queues}
    found: list[Unserved] = []
    for (version, queue), jobs in sorted(waiting.items()):
        if not _serving(processes, queue, version):
            reason: Literal["version", "queue"] = "queue" if version in versions else "version"
            found.append(Unserved(queue=queue, workflow_version=version, jobs=jobs, reason=reason))
    return tuple(found)


def unserved_jobs(settings: Settings) -> tuple[Unserved, ...]:
    """Queued jobs that no live process takes, of a database that is not changed. Raises `StorageUnavailable`."""
    with closing(Database(settings, read_only=True)) as database:
        if (database.file is not None and not database.file.exists()) or not database.schema():
            return ()  # no server has used it
        return unserved(ProcessTable(database).alive(), JobTable(database).open_counts())


def describe_unserved(one: Unserved) -> str:
    """Says that jobs wait in vain."""
    jobs, wait = ("1 job", "waits") if one.jobs == 1 else (f"{one.jobs} jobs", "wait")
    of = f"workflow version {one.workflow_version}" if one.reason == "version" else f"the queue {one.queue!r}"
    return f"{jobs} of {of} {wait}, and no process takes them."


def remedy(one: Unserved) -> str:
    """Says what to do about it."""
    if one.reason == "version":
        return (
            f"Start a server or worker of a COW with workflow version {one.workflow_version} on this job database "
            "until they are finished, or cancel them."
        )
    return (
        f"No process takes jobs of the queue {one.queue!r}: start `cow worker --queues {one.queue}` or a server on "
        "this job database, where the backend of that queue is installed."
    )


def _sums(numbers: Iterable[tuple[Key, int]]) -> Counter[Key]:
    """The numbers of each key together."""
    sums: Counter[Key] = Counter()
    for key, number in numbers:
        sums[key] += number
    return sums


def _serving(processes: Iterable[ProcessInfo], queue: str, version: str) -> bool:
    return any(queue in one.queues and one.workflow_version == version for one in processes)


def _queues(
    processes: Sequence[ProcessInfo], counts: Sequence[OpenCount], ended: dict[str, int]
) -> tuple[QueueInfo, ...]:
    jobs = _sums(((one.queue, one.state), one.jobs) for one in counts)
    waiting = [one for one in counts if one.state == "queued"]
    served = {name for process in processes for name in process.queues}
    names = {LIGHT} | served | {queue for queue, _ in jobs} | ended.keys()
    return tuple(
        QueueInfo(
            name=name,
            queued=jobs[name, "queued"],
            running=jobs[name, "running"],
            capacity=sum(process.queues.get(name, 0) for process in processes),
            oldest_seconds=max((one.oldest_seconds for one in waiting if one.queue == name), default=None),
            jobs_per_minute=ended.get(name, 0) * 60 / RATE_SECONDS,
        )
        for name in sorted(names, key=lambda name: (name != LIGHT, name))
    )
