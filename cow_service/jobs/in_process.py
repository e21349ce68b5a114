"""Computes jobs in the process of their engine."""

from __future__ import annotations

import os

import psutil

from cow_service.jobs.computing import Outcome, Work, WorkerState, compute
from cow_service.jobs.open_jobs import OpenJobs
from cow_service.jobs.stage_cache import KeyLocks
from cow_service.observability.metrics import gpu_memory


class InProcess:
    """Computes jobs in the threads that ask for it."""

    def __init__(self, open_jobs: OpenJobs) -> None:
        self._open_jobs = open_jobs
        self._locks = KeyLocks()
        self._jobs_done = 0

    def start(self) -> None:
        """Does nothing."""

    def close(self) -> None:
        """Does nothing."""

    def capacity(self, queue: str) -> int:
        """Those that compute, and those that wait for an MLLM."""
        settings = self._open_jobs.service.settings
        return settings.concurrency + settings.mllm_concurrency

    def compute(self, work: Work) -> Outcome:
        """As the protocol says."""
        try:
            return compute(work, self._open_jobs.service, self._open_jobs.database, self._locks.held)
        finally:
            self._jobs_done += 1

    def workers(self) -> tuple[WorkerState, ...]:
        """The process itself."""
        memory = psutil.Process().memory_info().rss
        jobs = tuple(self._open_jobs.active.ids())
        return (WorkerState("server", None, os.getpid(), memory, self._jobs_done, jobs, gpu_memory()),)
