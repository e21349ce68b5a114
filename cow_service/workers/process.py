"""A worker process as seen by the process that started it."""

from __future__ import annotations

import contextlib
import logging
import subprocess
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from queue import Empty, SimpleQueue
from typing import Any, Literal

from cow_service.concurrency import spawn
from cow_service.errors import Canceled, CowError, JobTimeout, WorkerEnded
from cow_service.jobs.computing import KeyLocks, Outcome, Work
from cow_service.jobs.job_table import JobSpec, error_from_json
from cow_service.media.images import DecodedImage
from cow_service.records import GpuMemory
from cow_service.requests import Stage
from cow_service.settings import Settings

MODULE = "cow_service.workers"  # what a worker process runs

# To the worker.


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


# The first message are the settings of the worker, of which those of concurrency are its own share; None ends it.
ToWorker = Settings | Start | Cancel | KeyHeld | None
OfJob = Progressed | LookedFor | HoldKey | ReleaseKey | Succeeded | Failed
FromWorker = Loaded | Heartbeat | OfJob


POLL_SECONDS = 0.1  # how often a job at work is checked: whether it was canceled, whether its time is over
CANCEL_SECONDS = 5.0  # that a canceled job is given to end; then its process is ended
START_SECONDS = 60.0  # that a process is given to begin with its first job
END_SECONDS = 5.0  # that a process is given to end by itself

# Why a process ended: renewed and stopped in peace; timeout: it went on with a job that had to end.
EndReason = Literal["crashed", "frozen", "memory", "timeout", "renewed", "stopped"]

log = logging.getLogger("cow_service")


class WorkerGone(Exception):
    """The process ended, or was ended, while it had the job. The text says why.

    `is_final`: it would be the same in another process.
    """

    def __init__(self, reason: str, *, is_final: bool) -> None:
        super().__init__(reason)
        self.is_final = is_final


class Worker:
    """One worker process, from its start to its end. Safe to use from every thread."""

    def __init__(self, name: str, settings: Settings, on_end: Callable[[EndReason], None]) -> None:
        """`on_end` is called once, when the process has ended."""
        spawned = spawn(MODULE)
        self.name = name
        self.jobs_done = 0
        self.memory_bytes = 0
        self.gpus: tuple[GpuMemory, ...] = ()
        self.heard = time.monotonic()  # when it last sent a heartbeat
        self._job_timeout = settings.job_timeout
        self._process, self._pipe = spawned.process, spawned.pipe
        self._sending = threading.Lock()
        self._inboxes: dict[str, SimpleQueue[OfJob | None]] = {}
        self._loaded = threading.Event()
        self._load_error: CowError | None = None
        self._ended = threading.Event()
        self._reason, self._is_final, self._stopped = "crashed", False, False
        self._end_reason: EndReason = "crashed"
        self._on_end = on_end
        threading.Thread(target=self._listen, name=f"cow-{name}", daemon=True).start()
        self._send(settings)

    @property
    def pid(self) -> int:
        """The process."""
        return self._process.pid

    @property
    def is_alive(self) -> bool:
        """Whether it can be given jobs."""
        return not self._ended.is_set()

    @property
    def jobs(self) -> tuple[str, ...]:
        """The jobs that it has."""
        return tuple(self._inboxes)

    def wait_loaded(self, seconds: float | None = None) -> bool:
        """Waits until the default backends are loaded; returns whether they are. Raises the error of loading them."""
        loaded = self._loaded.wait(seconds)
        if self._load_error is not None:
            raise self._load_error
        return loaded and self.is_alive

    def run(self, work: Work, locks: KeyLocks) -> Outcome:
        """Computes a job. Raises the `CowError` that it fails with, `Canceled`, `JobTimeout`, `WorkerGone`."""
        inbox = self._inboxes[work.job_id] = SimpleQueue()
        try:
            with ExitStack() as stack:
                self._send(Start(work.job_id, work.spec, work.owner, work.image()))
                return self._follow(work, inbox, _Keys(self, work, locks, stack))
        finally:
            del self._inboxes[work.job_id]
            self.jobs_done += 1

    def kill(self, end_reason: EndReason, reason: str, *, is_final: bool = False) -> None:
        """Ends the process at once, also one that is stopped. Its jobs raise `WorkerGone`, which says the reason."""
        self._end_reason, self._reason, self._is_final = end_reason, reason, is_final
        self._process.kill()

    def close(self, end_reason: EndReason = "stopped") -> None:
        """Ends the process. It has no jobs."""
        self._stopped = True
        if self.is_alive:
            self._end_reason = end_reason
        self._send(None)
        try:
            self._process.wait(END_SECONDS)
        except subprocess.TimeoutExpired:
            self.kill(end_reason, "did not end")
            self._process.wait()
        self._ended.wait()
        self._pipe.close()

    def check_alive(self) -> None:
        """Raises `WorkerGone`."""
        if self._ended.is_set():
            code = self._process.wait()
            how = f"signal {-code}" if code < 0 else f"exit code {code}"
            raise WorkerGone(f"{self._reason} ({how})", is_final=self._is_final)

    def _follow(self, work: Work, inbox: SimpleQueue[OfJob | None], keys: _Keys) -> Outcome:
        until, canceled, begun = time.monotonic() + START_SECONDS + self._job_timeout, False, False
        while True:
            message = None
            try:
                if not canceled:
                    work.check()
                with contextlib.suppress(Empty):
                    message = inbox.get(timeout=POLL_SECONDS)
                if isinstance(message, HoldKey):
                    keys.hold(message.key)
                elif isinstance(message, Progressed) and not canceled:
                    work.progress(message.stage, message.done)
            except Canceled:
                canceled, until = True, time.monotonic() + CANCEL_SECONDS
                self._send(Cancel(work.job_id))
            if isinstance(message, Succeeded):
                return message.outcome
            self._note(message, work, keys)
            if message is not None and not (begun or canceled):  # a new process had to start before
                begun, until = True, time.monotonic() + self._job_timeout
            if time.monotonic() > until:
                raise self._too_late(canceled=canceled)

    def _note(self, message: OfJob | None, work: Work, keys: _Keys) -> None:
        """Does what a message asks for. Raises the error that the job failed with, `WorkerGone`."""
        match message:
            case Failed(error=error):
                raise error_from_json(error)
            case LookedFor(stage=stage, found=found):
                work.looked_for(stage, found)
            case ReleaseKey(key=key):
                keys.release(key)
            case None:
                self.check_alive()
            case _:
                pass

    def _too_late(self, *, canceled: bool) -> CowError:
        """Ends the process, as a job in it goes on after its time."""
        self.kill("timeout", "was ended, as another job of it had to end")
        if canceled:
            return Canceled("The job was canceled.")
        return JobTimeout(f"The job computed for more than {self._job_timeout:g} s, which COW_JOB_TIMEOUT allows.")

    def _send(self, message: ToWorker) -> None:
        with self._sending, contextlib.suppress(OSError):  # its end is noticed where its messages are read
            self._pipe.send(message)

    def _listen(self) -> None:
        """Hands each message to the job that it is about, until the process has ended."""
        with contextlib.suppress(EOFError, OSError):
            while True:
                match self._pipe.recv():
                    case Heartbeat(memory_bytes=memory_bytes, gpus=gpus):
                        self.heard, self.memory_bytes, self.gpus = time.monotonic(), memory_bytes, gpus
                    case Loaded(error=error):
                        self._load_error = None if error is None else error_from_json(error)
                        self._loaded.set()
                    case message:
                        if (inbox := self._inboxes.get(message.job_id)) is not None:
                            inbox.put(message)
        self._ended.set()
        if not self._loaded.is_set() and not self._stopped:
            self._load_error = WorkerEnded(f"A process that computes jobs {self._reason} while it loaded its backends.")
        self._loaded.set()
        for inbox in list(self._inboxes.values()):
            inbox.put(None)
        self._on_end(self._end_reason)


class _Keys:
    """The keys that a job holds; all are given back with `stack`."""

    def __init__(self, worker: Worker, work: Work, locks: KeyLocks, stack: ExitStack) -> None:
        self._worker, self._work, self._locks, self._stack = worker, work, locks, stack
        self._held: dict[str, ExitStack] = {}

    def hold(self, key: str) -> None:
        """Waits for a key and tells the worker. Raises `Canceled` and `WorkerGone`."""

        def check() -> None:
            self._worker.check_alive()
            self._work.check()

        held = self._held[key] = self._stack.enter_context(ExitStack())
        held.enter_context(self._locks.held(key, check))
        self._worker._send(KeyHeld(self._work.job_id))  # pyright: ignore[reportPrivateUsage]

    def release(self, key: str) -> None:
        """Gives a key back, if the job holds it."""
        if key in self._held:
            self._held.pop(key).close()
