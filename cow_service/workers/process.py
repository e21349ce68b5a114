"""A worker process as seen by the process that started it, and what the two tell each other."""

import subprocess
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from queue import Empty, SimpleQueue
from typing import Any, Literal, NamedTuple

from cow_service.concurrency import spawn
from cow_service.errors import Canceled, CowError, JobTimeout, WorkerEnded
from cow_service.jobs.computing import JobOutcome, KeyLocks, Work
from cow_service.jobs.job_table import TakenJob, error_from_json
from cow_service.media.images import DecodedImage
from cow_service.records import GpuMemory
from cow_service.requests import Stage
from cow_service.settings import Settings

MODULE = "cow_service.workers"  # what a worker process runs

# To the worker.


class Start(NamedTuple):
    """Compute a job."""

    job: TakenJob
    image: DecodedImage | None  # else it is read from the artifacts


class Cancel(NamedTuple):
    """Nobody wants the result any more."""

    job_id: str


class KeyHeld(NamedTuple):
    """The job holds the lock of the key that it asked for."""

    job_id: str


# From the worker.


class Loaded(NamedTuple):
    """The default backends are loaded, or the error, as JSON, for which they are not."""

    error: dict[str, Any] | None


class Heartbeat(NamedTuple):
    """The process is alive. `memory_bytes` is its resident set."""

    memory_bytes: int
    gpus: tuple[GpuMemory, ...]


class Progressed(NamedTuple):
    """A job has come so far in a stage, 0 to 1."""

    job_id: str
    stage: Stage | None
    done: float


class LookedFor(NamedTuple):
    """A stage was looked for among stored results."""

    job_id: str
    stage: Stage
    found: bool


class HoldKey(NamedTuple):
    """A job wants the lock of a key: what one job computes, another one waits for, whatever worker it has."""

    job_id: str
    key: str


class ReleaseKey(NamedTuple):
    """The job gives the lock of a key back."""

    job_id: str
    key: str


class Succeeded(NamedTuple):
    """The job is done."""

    job_id: str
    outcome: JobOutcome


class Failed(NamedTuple):
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

    def run(self, work: Work, locks: KeyLocks) -> JobOutcome:
        """Computes a job. Raises the `CowError` that it fails with, `Canceled`, `JobTimeout`, `WorkerGone`."""
        inbox = self._inboxes[work.job.id] = SimpleQueue()
        try:
            with ExitStack() as keys:
                self._send(Start(work.job, work.image))
                return self._follow(work, inbox, locks, keys)
        finally:
            del self._inboxes[work.job.id]
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

    def _follow(self, work: Work, inbox: SimpleQueue[OfJob | None], locks: KeyLocks, keys: ExitStack) -> JobOutcome:
        """Does what the messages about a job ask for, until its outcome. `keys` gives back those it still holds."""
        until, canceled, begun = time.monotonic() + START_SECONDS + self._job_timeout, False, False
        held: dict[str, ExitStack] = {}

        def check() -> None:
            self._check_alive()
            work.check()

        while True:
            message = None
            try:
                if not canceled:
                    work.check()
                with suppress(Empty):
                    message = inbox.get(timeout=POLL_SECONDS)
                if isinstance(message, HoldKey):
                    held[message.key] = keys.enter_context(ExitStack())
                    held[message.key].enter_context(locks.held(message.key, check))
                    self._send(KeyHeld(work.job.id))
                elif isinstance(message, Progressed) and not canceled:
                    work.progress(message.stage, message.done)
            except Canceled:
                canceled, until = True, time.monotonic() + CANCEL_SECONDS
                self._send(Cancel(work.job.id))
            if isinstance(message, Succeeded):
                return message.outcome
            if isinstance(message, Failed):
                raise error_from_json(message.error)
            if isinstance(message, LookedFor):
                work.looked_for(message.stage, message.found)
            elif isinstance(message, ReleaseKey) and message.key in held:
                held.pop(message.key).close()
            elif message is None:
                self._check_alive()
            if message is not None and not (begun or canceled):  # a new process had to start before
                begun, until = True, time.monotonic() + self._job_timeout
            if time.monotonic() > until:
                self.kill("timeout", "was ended, as another job of it had to end")  # this one goes on in it
                late = f"The job computed for more than {self._job_timeout:g} s, which COW_JOB_TIMEOUT allows."
                raise Canceled("The job was canceled.") if canceled else JobTimeout(late)

    def _check_alive(self) -> None:
        """Raises `WorkerGone`."""
        if self._ended.is_set():
            code = self._process.wait()
            how = f"signal {-code}" if code < 0 else f"exit code {code}"
            raise WorkerGone(f"{self._reason} ({how})", is_final=self._is_final)

    def _send(self, message: ToWorker) -> None:
        with self._sending, suppress(OSError):  # its end is noticed where its messages are read
            self._pipe.send(message)

    def _listen(self) -> None:
        """Hands each message to the job that it is about, until the process has ended."""
        with suppress(EOFError, OSError):
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
