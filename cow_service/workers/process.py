"""A worker as seen by the process that started it: a process of this machine, or what another `Link` leads to."""

import logging
import math
import subprocess
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from queue import Empty, SimpleQueue
from typing import Literal, Protocol

from pydantic import ValidationError
from pydantic_core import to_json

from cow_service.concurrency import spawn
from cow_service.errors import Canceled, CowError, JobTimeout
from cow_service.jobs.computing import JobOutcome, KeyLocks, Work
from cow_service.jobs.job_table import error_from_json
from cow_service.records import GpuMemory, WorkerLoad
from cow_service.settings import Settings
from cow_service.workers import messages

MODULE = "cow_service.workers"  # what a worker process runs

POLL_SECONDS = 0.1  # how often a job at work is checked: whether it was canceled, whether its time is over
CANCEL_SECONDS = 5.0  # that a canceled job is given to end; then its process is ended
END_SECONDS = 5.0  # that a process is given to end by itself

# Why a process ended: renewed and stopped in peace; timeout: it went on with a job that had to end; load: it was not
# done with loading in time.
EndReason = Literal["crashed", "frozen", "load", "memory", "timeout", "renewed", "stopped"]

log = logging.getLogger("cow_service")


class WorkerGone(Exception):
    """The process ended, or was ended, while it had the job. The text says why.

    `is_final`: it would be the same in another process. `is_blameless`: the job has no part in it. The process was not
    done with loading, and had not begun the job, or the way to it was lost.
    """

    def __init__(self, reason: str, *, is_final: bool, is_blameless: bool) -> None:
        super().__init__(reason)
        self.is_final, self.is_blameless = is_final, is_blameless


class Link(messages.Pipe, Protocol):
    """The way to a worker: messages, and its end."""

    @property
    def pid(self) -> int:
        """Its process."""
        ...

    @property
    def is_lost(self) -> bool:
        """Whether only the way to it has ended, whatever became of the worker."""
        ...

    def kill(self) -> None:
        """Ends it at once."""

    def wait(self, seconds: float | None = None) -> str:
        """Waits until it has ended; returns how. Raises `TimeoutError`."""
        ...

    def close(self) -> None:
        """Releases what leads to a worker that has ended."""


class Child:
    """The way to a child process, a `Link`."""

    is_lost = False

    def __init__(self) -> None:
        self._process, self._pipe = spawn(MODULE)
        self.pid, self.kill, self.close = self._process.pid, self._process.kill, self._pipe.close
        self.send_bytes, self.recv_bytes = self._pipe.send_bytes, self._pipe.recv_bytes

    def wait(self, seconds: float | None = None) -> str:
        """As `Link` says."""
        try:
            code = self._process.wait(seconds)
        except subprocess.TimeoutExpired as error:
            raise TimeoutError from error
        return f"signal {-code}" if code < 0 else f"exit code {code}"


class Worker:
    """One worker, from its start to its end. Safe to use from every thread."""

    def __init__(
        self, name: str, settings: Settings, on_end: Callable[["Worker", EndReason], None], link: Link | None = None
    ) -> None:
        """`on_end` is called once, when it has ended. `link`: by default a new child process."""
        self.link: Link = Child() if link is None else link
        self.name = name
        self.jobs_done = 0
        self.memory_bytes = self.idle_bytes = 0  # resident; when it last had no job
        self.gpus: tuple[GpuMemory, ...] = ()
        self.load: WorkerLoad | None = None
        self.started = self.heard = time.monotonic()  # `heard`: when it last sent a heartbeat
        self._job_timeout = settings.job_timeout
        self._sending = threading.Lock()
        self._inboxes: dict[str, SimpleQueue[messages.OfJob | None]] = {}  # by attempt
        self._jobs: dict[str, str] = {}  # likewise
        self.load_error: CowError | None = None
        self.is_loaded = False  # or could not load them: it goes on with what needs others
        self._ended = threading.Event()
        self._end_reason: EndReason = "crashed"
        self._reason: str = self._end_reason
        self._on_end = on_end
        threading.Thread(target=self._listen, name=f"cow-{name}", daemon=True).start()
        with suppress(OSError):
            self.link.send_bytes(settings.dump_secrets().encode())

    @property
    def is_alive(self) -> bool:
        """Whether it can be given jobs."""
        return not self._ended.is_set()

    @property
    def jobs(self) -> tuple[str, ...]:
        """The jobs that it has."""
        return tuple(self._jobs.values())

    @property
    def end_reason(self) -> str:
        """Why it ended, or how, in words that go on after "the process"."""
        return f"{self._reason} ({self.link.wait()})"

    def run(self, work: Work, locks: KeyLocks) -> JobOutcome:
        """Computes a job. Raises the `CowError` that it fails with, `Canceled`, `JobTimeout`, `WorkerGone`."""
        self._inboxes[work.job.run], self._jobs[work.job.run] = SimpleQueue(), work.job.id
        try:
            with ExitStack() as keys:
                self._send(messages.Start(work.job))
                return self._follow(work, locks, keys)
        finally:
            del self._inboxes[work.job.run], self._jobs[work.job.run]
            self.jobs_done += 1

    def kill(self, end_reason: EndReason, reason: str) -> None:
        """Ends the process at once, also one that is stopped. Its jobs raise `WorkerGone`, which says the reason."""
        self._end_reason, self._reason = end_reason, reason
        self.link.kill()

    def close(self, end_reason: EndReason = "stopped") -> None:
        """Ends the process. It has no jobs."""
        if self.is_alive:
            self._end_reason = end_reason
        self._send(None)
        try:
            self.link.wait(END_SECONDS)
        except TimeoutError:
            self.kill(end_reason, "did not end")
        self._ended.wait()
        self.link.close()

    def _follow(self, work: Work, locks: KeyLocks, keys: ExitStack) -> JobOutcome:
        """Does what the messages about a job ask for, until its outcome. `keys` holds the lock of its key, if any."""
        until, canceled, begun = math.inf, False, False  # its time does not begin while the process loads
        inbox = self._inboxes[work.job.run]

        def check() -> None:
            self._check_alive(begun)
            work.check()

        while True:
            message = None
            try:
                if not canceled:
                    work.check()
                with suppress(Empty):
                    message = inbox.get(timeout=POLL_SECONDS)
                    begun |= message is not None
                if isinstance(message, messages.HoldKey):
                    keys.close()
                    if message.key is not None:
                        keys.enter_context(locks.held(message.key, check))
                        self._send(messages.ToJob(work.job.run, "key-held"))
                elif isinstance(message, messages.Progressed) and not canceled:
                    work.progress(message.stage, message.done)
                elif isinstance(message, messages.LookedFor):
                    work.looked_for(message.stage, message.found)
            except Canceled:
                canceled, until = True, time.monotonic() + (CANCEL_SECONDS if begun else 0.0)
                self._send(messages.ToJob(work.job.run, "cancel"))
            if isinstance(message, messages.Succeeded):
                return message.outcome
            if isinstance(message, messages.Failed):
                raise error_from_json(message.error)
            if message is None:
                self._check_alive(begun)
            if until == math.inf and (begun or self.is_loaded):
                until = time.monotonic() + self._job_timeout
            if time.monotonic() > until:
                raise self._overdue(begun, canceled)

    def _overdue(self, begun: bool, canceled: bool) -> CowError:
        """The error of a job past its time limit. A process still computing it is ended; one still loading is not."""
        if begun:
            self.kill("timeout", "was ended, as another job of it had to end")
        if canceled:
            return Canceled("The job was canceled.")
        return JobTimeout(f"The job computed for more than {self._job_timeout:g} s, which COW_JOB_TIMEOUT allows.")

    def _check_alive(self, begun: bool) -> None:
        """Raises `WorkerGone`."""
        if self._ended.is_set():
            is_blameless = self.link.is_lost or not (begun or self.is_loaded)
            raise WorkerGone(self.end_reason, is_final=self._end_reason == "memory", is_blameless=is_blameless)

    def _send(self, message: messages.ToWorker) -> None:
        with self._sending, suppress(OSError):  # its end is noticed where its messages are read
            self.link.send_bytes(to_json(message))

    def _listen(self) -> None:
        """Hands each message to the job that it is about, until the process has ended."""
        try:
            while True:
                match messages.FROM_WORKER.validate_json(self.link.recv_bytes(messages.MAX_MESSAGE_BYTES)):
                    case messages.Heartbeat(memory_bytes, gpus, load):
                        self.heard, self.memory_bytes, self.gpus, self.load = time.monotonic(), memory_bytes, gpus, load
                        if not self._inboxes:
                            self.idle_bytes = memory_bytes
                    case messages.Loaded(error=error):
                        self.load_error = None if error is None else error_from_json(error)
                        self.heard, self.is_loaded = time.monotonic(), True
                    case message:
                        if (inbox := self._inboxes.get(message.run)) is not None:
                            inbox.put(message)
        except (EOFError, OSError):
            self.link.kill()  # also where it sent a message that is too long
        except ValidationError:
            log.exception("the worker %s sent an invalid message", self.name)
            self.kill("crashed", "sent an invalid message, and was ended")
        self._ended.set()
        for inbox in list(self._inboxes.values()):
            inbox.put(None)
        self._on_end(self, self._end_reason)
