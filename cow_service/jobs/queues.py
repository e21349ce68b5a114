"""Which queue a job waits in, and the threads that take jobs from the queues that this process serves.

Jobs of light generators share one queue; whatever computes on a device of its own has one of its name, so that no
photograph's frames wait for its clips. DBOS takes the jobs, by its own rules; here is only when it looks.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from functools import partial
from typing import Any

from dbos import DBOS
from dbos import _dbos as dbos_instances  # pyright: ignore[reportPrivateUsage]
from dbos import _queue as dbos_queue  # pyright: ignore[reportPrivateUsage]
from sqlalchemy.exc import SQLAlchemyError

from cow_service.settings import Settings, SettingsError
from cow_service.weights.manifests import find_manifest, load_manifests

LIGHT = "light"
PREFIX = "cow-"  # of the names of our queues in the job database
WEBHOOKS = "cow-webhook-receivers"  # in which every receiver has a share of its own: DBOS itself looks after it
POLL_SECONDS = 0.25  # a process looks at a queue, besides whenever it is woken
NEW_QUEUES_SECONDS = 1.0  # between two looks for queues

log = logging.getLogger("cow_service")


def queue_of(reader: str, generator: str, settings: Settings) -> str:
    """The queue of a job. A reader that computes on a device uses the same for the clips."""
    if places(reader) is not None:
        return reader
    return LIGHT if clips(generator, settings) is None else generator


def clips(generator: str, settings: Settings) -> int | None:
    """Clips at the same time of a generator that has a device or a limit of its own; None where it has none."""
    return settings.generator_concurrency.get(generator, places(generator))


def places(name: str) -> int | None:
    """Jobs at the same time of a backend that has a device of its own, as its manifest says."""
    manifest = find_manifest(name)
    return None if manifest is None else manifest.concurrency


def known_queues(settings: Settings) -> tuple[str, ...]:
    """The light queue, and those of backends that have a device or a limit of their own and can be imported here."""
    manifests = load_manifests().values()
    with_device = [one.name for one in manifests if one.concurrency is not None and not one.missing_modules()]
    return LIGHT, *dict.fromkeys([*with_device, *settings.generator_concurrency])


def check_queues(settings: Settings) -> None:
    """Raises `SettingsError` where COW_QUEUES names what is no queue here."""
    known = known_queues(settings)
    for name in settings.queues:
        if name in known:
            continue
        manifest = find_manifest(name)
        if manifest is None or manifest.concurrency is None:
            remedy = f"Known: {', '.join(known)}. Backends without a device of their own share {LIGHT}."
        else:
            remedy = f"{name} lacks {', '.join(manifest.missing_modules())}: {manifest.install_line()}."
        raise SettingsError(f"Bad settings: COW_QUEUES has no queue {name[:64]!r} here. {remedy}")


class QueuePolls:
    """Threads that take jobs from the queues of which this process has a capacity."""

    def __init__(self, capacity: Callable[[str], int], taken: Callable[[str], int]) -> None:
        """By the name of a queue: the jobs that are computed at the same time, and those that did not wait in it."""
        self._capacity, self._taken = capacity, taken
        self._polls: dict[str, tuple[threading.Thread, _Waking]] = {}
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        """Begins to take jobs. DBOS runs already."""
        self._stop.clear()
        self._thread = threading.Thread(target=self._look_for_queues, name="cow-queues", daemon=True)
        self._thread.start()

    def wake(self) -> None:
        """Has every queue looked at now: there is a new job, or one has ended."""
        for _, waking in tuple(self._polls.values()):
            waking.wake()

    def stop(self) -> None:
        """Takes no more jobs."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        for thread, waking in self._polls.values():
            waking.set()
            thread.join()
        self._polls.clear()

    def _look_for_queues(self) -> None:
        while True:
            try:
                for queue in DBOS.list_queues():
                    self._serve(queue.name)
            except SQLAlchemyError as error:
                log.warning("the queues could not be read: %s", type(error).__name__)
            if self._stop.wait(NEW_QUEUES_SECONDS):
                return

    def _serve(self, name: str) -> None:
        if name in self._polls or name == WEBHOOKS or not name.startswith(PREFIX):
            return
        capacity = self._capacity(name.removeprefix(PREFIX))
        if capacity == 0:
            return
        queue = _Queue(name, capacity, partial(self._taken, name.removeprefix(PREFIX)))
        waking = _Waking()
        given: tuple[Any, ...] = waking, dbos_instances._get_dbos_instance(), queue  # pyright: ignore[reportPrivateUsage]
        thread = threading.Thread(target=dbos_queue.queue_worker_thread, args=given, name=name, daemon=True)
        thread.start()
        self._polls[name] = thread, waking


class _Queue(dbos_queue.Queue):
    """A queue of this process alone: the capacity of one that DBOS reads from the database would be everybody's."""

    def __init__(self, name: str, capacity: int, taken: Callable[[], int]) -> None:
        self._taken = taken
        token = dbos_queue._INTERNAL_QUEUE_CONSTRUCTION  # pyright: ignore[reportPrivateUsage]
        super().__init__(name, worker_concurrency=capacity, polling_interval_sec=POLL_SECONDS, token=token)

    @property
    def _worker_concurrency(self) -> int | None:  # pyright: ignore[reportIncompatibleVariableOverride]
        """The capacity less the jobs that were started at once: DBOS counts only those from the queue."""
        return None if self._capacity is None else max(0, self._capacity - self._taken())

    @_worker_concurrency.setter
    def _worker_concurrency(self, capacity: int | None) -> None:
        self._capacity = capacity


class _Waking(threading.Event):
    """The stop event of a queue's thread, whose waits can be ended without setting it."""

    def __init__(self) -> None:
        super().__init__()
        self._woken = threading.Event()

    def wait(self, timeout: float | None = None) -> bool:
        """Until it is set or woken, at most so long; returns whether it is set."""
        self._woken.wait(timeout)
        self._woken.clear()
        return self.is_set()

    def set(self) -> None:
        """Ends the thread."""
        super().set()
        self._woken.set()

    def wake(self) -> None:
        """Ends the wait."""
        self._woken.set()
