"""The main program of a worker, on one end of a pipe.

It ends as soon as the pipe does, whatever it is doing: the process that started it is gone then, and another one takes
its jobs.
"""

from __future__ import annotations

import logging
import os
import threading
import time
from collections.abc import Callable, Generator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection

import cv2
import psutil
from pydantic_core import to_json

from cow_service.concurrency import free_memory, leave_decisions_to_the_parent, return_large_blocks
from cow_service.errors import CowError, unforeseen
from cow_service.jobs.active import QUIET_SECONDS, ActiveJob
from cow_service.jobs.computing import Work, compute
from cow_service.jobs.database import Database
from cow_service.jobs.job_table import TakenJob, error_as_json
from cow_service.jobs.opening import open_database
from cow_service.jobs.readiness import warm_up
from cow_service.observability import logging as context
from cow_service.observability import tracing
from cow_service.observability.metrics import gpu_memory
from cow_service.records import Stage, is_ahead
from cow_service.service import Service
from cow_service.settings import WORKER_BYTES, Settings
from cow_service.workers import messages
from cow_service.workers.messages import FromWorker

HEARTBEAT_SECONDS = 2.0
CANCEL_POLL_SECONDS = 0.1  # how often a job that waits for a key checks whether it was canceled
MIN_PROGRESS = 0.005  # of a stage, between two messages

log = logging.getLogger("cow_service")


class _Job:
    """One job at work here."""

    def __init__(self, job: TakenJob, send: Callable[[FromWorker], None]) -> None:
        self.job, self._send = job, send
        self.active, self.key_held = ActiveJob(job.spec.kind), threading.Event()

    def compute(self, service: Service, database: Database) -> messages.Succeeded | messages.Failed:
        """Its end, to be sent."""
        run, spec = self.job.run, self.job.spec
        self._send(messages.Progressed(run, None, 0.0))  # from here on the job may be what ends the process

        def looked_for(stage: Stage, found: bool) -> None:
            self._send(messages.LookedFor(run, stage, found))

        work = Work(self.job, self._progress, self.active.check, looked_for)
        try:
            with (
                context.bound(request=spec.request_id, job=self.job.id),
                tracing.span("compute", parent=spec.traceparent, job_id=self.job.id),
            ):
                return messages.Succeeded(run, compute(work, service, database, self._hold_key))
        except CowError as error:
            return messages.Failed(run, error_as_json(error))
        except Exception:
            log.exception("job %s failed", self.job.id)
            return messages.Failed(run, error_as_json(unforeseen()))

    def _progress(self, stage: Stage | None, done: float) -> None:
        self.active.check()
        current, reached = self.active.at
        if is_ahead((stage, done), (current, reached if done >= 1.0 else reached + MIN_PROGRESS)):
            self.active.at = stage, done
            self._send(messages.Progressed(self.job.run, stage, done))

    @contextmanager
    def _hold_key(self, key: str, check_canceled: Callable[[], None]) -> Generator[None]:
        self.key_held.clear()
        self._send(messages.HoldKey(self.job.run, key))
        try:
            while not self.key_held.wait(CANCEL_POLL_SECONDS):
                check_canceled()
            yield
        finally:
            self._send(messages.HoldKey(self.job.run, None))


class WorkerProcess:
    """Computes the jobs that come over a pipe, each in a thread."""

    def __init__(self, pipe: messages.Pipe, settings: Settings) -> None:
        self._pipe = pipe
        self._sending = threading.Lock()
        self._service = Service(settings)
        self._database = open_database(settings)
        self._jobs: dict[str, _Job] = {}
        self._busy_at, self._this = time.monotonic(), psutil.Process()
        self._threads = ThreadPoolExecutor(max_workers=1024, thread_name_prefix="job")

    def run(self) -> None:
        """Works until the pipe ends."""
        threading.Thread(target=self._beat, name="heartbeat", daemon=True).start()
        threading.Thread(target=self._load, name="load", daemon=True).start()
        while True:
            match messages.TO_WORKER.validate_json(self._pipe.recv_bytes()):
                case messages.Start(job=job):
                    self._jobs[job.run] = _Job(job, self._send)
                    self._threads.submit(self._work, job.run)
                case messages.ToJob(run, kind):
                    if (job := self._jobs.get(run)) is not None:  # else it has just ended
                        (job.active.cancel_requested if kind == "cancel" else job.key_held).set()
                case None:
                    return

    def _send(self, message: FromWorker) -> None:
        """Does nothing once the pipe has ended, which `run` sees as well."""
        with self._sending, suppress(OSError):
            self._pipe.send_bytes(to_json(message))

    def _beat(self) -> None:
        while True:
            if not self._jobs and time.monotonic() - self._busy_at > QUIET_SECONDS:
                self._database.close_idle()
            self._send(messages.Heartbeat(self._this.memory_info().rss, gpu_memory(), self._service.load()))
            time.sleep(HEARTBEAT_SECONDS)

    def _load(self) -> None:
        failure = None
        try:
            self._service.check()
        except CowError as error:
            failure = error_as_json(error)
        except Exception:
            log.exception("the default backends could not be loaded")
            failure = error_as_json(unforeseen())
        self._send(messages.Loaded(failure))
        if failure is None and self._service.settings.warmup:
            warm_up(self._service.settings)

    def _work(self, run: str) -> None:
        end = self._jobs[run].compute(self._service, self._database)
        del self._jobs[run]
        self._busy_at = time.monotonic()
        self._send(end)
        if self._this.memory_info().rss > WORKER_BYTES:  # it takes 10 ms
            free_memory()


def main(descriptor: int) -> None:
    """Works on the pipe of a file descriptor until it ends."""
    leave_decisions_to_the_parent()
    return_large_blocks()
    work(Connection(descriptor))
    tracing.stop()
    os._exit(0)  # threads may be at work; their results are not wanted


def work(pipe: messages.Pipe) -> None:
    """Works on a pipe until it ends. Jobs may still be at work then; their results are not wanted."""
    cv2.setNumThreads(1)  # a process for each core: threads of their own would take a quarter more time, all together
    with suppress(EOFError, OSError):
        settings = Settings.model_validate_json(pipe.recv_bytes())
        context.set_up(settings)
        tracing.start()
        WorkerProcess(pipe, settings).run()
