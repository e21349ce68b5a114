"""Computes jobs in the process of their engine."""

from __future__ import annotations

from cow_service.jobs.computing import Outcome, Work, compute
from cow_service.jobs.open_jobs import OpenJobs
from cow_service.jobs.stage_cache import KeyLocks


class InProcess:
    """Computes jobs in the threads that ask for it."""

    def __init__(self, open_jobs: OpenJobs) -> None:
        self._open_jobs = open_jobs
        self._locks = KeyLocks()

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
        return compute(work, self._open_jobs.service, self._open_jobs.database, self._locks.held)
