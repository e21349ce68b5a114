"""The processes on a job database: what each reports about itself, and the state of all of them and the queues."""

import logging
import os
import platform
import threading
import time
from collections import Counter
from collections.abc import Iterable, Sequence
from contextlib import suppress
from typing import Any, Literal, TypeVar

import sqlalchemy as sa

from cow_service import __version__
from cow_service.errors import NotReady, StorageUnavailable
from cow_service.jobs.computing import Computer, EngineParts
from cow_service.jobs.database import Database
from cow_service.jobs.job_table import RATE_SECONDS, READABLE, VERSION, OpenCount
from cow_service.jobs.queues import LIGHT, known_queues, queue_of
from cow_service.jobs.schema import ALIVE_SECONDS, PROCESSES
from cow_service.observability.logging import rfc3339
from cow_service.records import ProcessInfo, ProcessRole, QueueInfo, Unserved, Workers

FORGOTTEN_SECONDS = 3600.0  # after which a row is deleted
MAX_AGE_SECONDS = 1.0  # of an overview that is given out again

# What not every caller may know: where processes are, and the ids of others' jobs.
_OF_WORKERS = {"__all__": {"pid": True, "jobs": {"__all__": {"id": True}}}}
FOR_ADMINS: dict[str, Any] = {"processes": {"__all__": {"host": True, "pid": True, "workers": _OF_WORKERS}}}

Key = TypeVar("Key")

log = logging.getLogger("cow_service")


class Processes:
    """This process among those on the job database, and the state of all of them. Safe to use from every thread.

    On PostgreSQL each has a row. Times are the database's: the clocks of machines differ.
    """

    def __init__(self, parts: EngineParts, computer: Computer, role: ProcessRole | None) -> None:
        """`role`: by default that of the settings."""
        self._parts, self._computer = parts, computer
        self._settings = parts.service.settings
        self._role: ProcessRole = role or self._settings.role
        self._draining = False
        self._lock = threading.Lock()
        self._picture: tuple[Workers, list[OpenCount]] = Workers(processes=(), queues=()), []
        self._read_at = -MAX_AGE_SECONDS

    def start(self) -> None:
        """Begins to count for the metrics."""
        self._draining = False
        metrics = self._parts.service.metrics
        metrics.workers = lambda: self._computer.workers(self._parts.active)
        metrics.gauges |= {
            "cow_queue_depth": lambda: _sums(
                ((one.queue, one.generator, one.state), one.jobs) for one in self._latest()[1]
            ).items(),
            "cow_queue_oldest_seconds": lambda: [
                ((one.name,), one.oldest_seconds or 0.0) for one in self.overview().queues
            ],
            "cow_queue_unserved": lambda: _sums(
                ((one.queue, one.reason), one.jobs) for one in self.overview().unserved
            ).items(),
        }

    def drain(self) -> None:
        """The process takes no more jobs, and finishes those that it has."""
        self._draining = True

    def stop(self) -> None:
        """The process ends."""
        if self._parts.database.is_shared:
            with suppress(StorageUnavailable), self._parts.database.transaction() as connection:
                connection.execute(sa.delete(PROCESSES).where(PROCESSES.c.executor == self._parts.executor))

    def tell(self) -> None:
        """Records that the process is alive, and what it does; deletes rows of processes long gone."""
        database = self._parts.database
        row = database.insert(PROCESSES)
        row = row.values(executor=self._parts.executor, seen=database.now, info=self._own().model_dump_json())
        kept = {"seen": row.excluded.seen, "info": row.excluded.info}
        with database.transaction() as connection:
            connection.execute(row.on_conflict_do_update(index_elements=["executor"], set_=kept))
            connection.execute(sa.delete(PROCESSES).where(PROCESSES.c.seen < database.now - FORGOTTEN_SECONDS))

    def overview(self, *, for_admin: bool = True) -> Workers:
        """What `GET /workers` returns, at most a second old however many ask. Raises `StorageUnavailable`."""
        found = self._latest()[0]
        return found if for_admin else Workers.model_validate(found.model_dump(exclude=FOR_ADMINS))

    def check_served(self) -> None:
        """Raises `NotReady` if no process takes the jobs of the default request, or those of another version."""
        found, settings = self.overview(), self._settings
        queue = queue_of(settings.reader, settings.generator, settings)
        own = (one for one in found.processes if one.workflow_version == VERSION)
        if settings.role == "api" and not any(queue in one.queues for one in own):
            raise NotReady(remedy(Unserved(queue=queue, workflow_version=VERSION, jobs=1, reason="queue")))
        for one in found.unserved:
            if one.reason == "version":
                raise NotReady(f"{describe_unserved(one)} {remedy(one)}")

    def _own(self) -> ProcessInfo:
        capacities = ((name, self._computer.capacity(name)) for name in known_queues(self._settings))
        return ProcessInfo(
            executor_id=self._parts.executor,
            seen_at=rfc3339(time.time()),
            role=self._role,
            host=platform.node(),
            pid=os.getpid(),
            version=__version__,
            workflow_version=VERSION,
            queues={} if self._draining else {name: number for name, number in capacities if number > 0},
            workers=self._computer.workers(self._parts.active),
        )

    def _latest(self) -> tuple[Workers, list[OpenCount]]:
        with self._lock:
            if time.monotonic() - self._read_at >= MAX_AGE_SECONDS:
                database, counts = self._parts.database, self._parts.jobs.open_counts()
                processes = alive(database) if database.is_shared else (self._own(),)
                queues = _queues(processes, counts, self._parts.jobs.ended_lately())
                found = Workers(processes=processes, queues=queues, unserved=unserved(processes, counts))
                self._picture, self._read_at = (found, counts), time.monotonic()
            return self._picture


def alive(database: Database) -> tuple[ProcessInfo, ...]:
    """The processes seen in the last `ALIVE_SECONDS`, by role, host and process id. Raises `StorageUnavailable`."""
    query = sa.select(PROCESSES.c.executor, PROCESSES.c.info).where(PROCESSES.c.seen > database.now - ALIVE_SECONDS)
    found: list[ProcessInfo] = []
    for executor, info in database.read(query):
        try:
            found.append(ProcessInfo.model_validate_json(info, extra="ignore"))  # a later version has more fields
        except ValueError:
            log.warning("the process %s runs a version that this one does not understand", executor)
    return tuple(sorted(found, key=lambda one: (one.role, one.host or "", one.pid or 0)))


def unserved(processes: Sequence[ProcessInfo], counts: Iterable[OpenCount]) -> tuple[Unserved, ...]:
    """Queued jobs that none of these processes takes."""
    waiting = _sums(((one.workflow_version, one.queue), one.jobs) for one in counts if one.state == "queued")
    found: list[Unserved] = []
    for (version, queue), jobs in sorted(waiting.items()):
        knowing = {version, VERSION} if version in READABLE else {version}  # versions of the processes that compute it
        able = [one for one in processes if one.workflow_version in knowing]
        if not any(queue in one.queues for one in able):
            reason: Literal["version", "queue"] = "queue" if any(one.queues for one in able) else "version"
            found.append(Unserved(queue=queue, workflow_version=version, jobs=jobs, reason=reason))
    return tuple(found)


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
        f"No process takes jobs of the queue {one.queue!r}: start a server or `cow worker` on "
        "this job database, where the backend of that queue is installed."
    )


def _sums(numbers: Iterable[tuple[Key, int]]) -> Counter[Key]:
    """The numbers of each key together."""
    sums: Counter[Key] = Counter()
    for key, number in numbers:
        sums[key] += number
    return sums


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
