"""The workflows that DBOS runs and recovers. Their names, arguments and order of steps are stored in databases.

A change to the steps of a workflow needs a new name beside the old one, which stays until no database has jobs of it.
"""

from __future__ import annotations

from typing import Any, Protocol

from dbos import DBOS

VERSION = "1"  # of all workflows; jobs of another version wait for a server that has it
MAX_STARTS = 20  # of a job that ends its process each time


class Runner(Protocol):
    """Who does the work in this process."""

    def run(self, job_id: str, spec: dict[str, Any]) -> str:
        """Does the work of a job; returns the result as JSON."""
        ...

    def deliver(self, job_id: str, url: str, attempt: int) -> None:
        """Calls a webhook, and enqueues another attempt where that failed."""
        ...


_runner: Runner | None = None


def set_runner(runner: Runner | None) -> None:
    """Sets who does the work: DBOS calls functions, and one process has one engine."""
    global _runner  # noqa: PLW0603
    _runner = runner


def _current() -> tuple[Runner, str]:
    assert _runner is not None, "workflows run only while an engine does"
    return _runner, DBOS.workflow_id or ""


@DBOS.workflow(name="simulate", max_recovery_attempts=MAX_STARTS)
def simulate(spec: dict[str, Any]) -> str:
    """A job of `POST /simulate`."""
    runner, job_id = _current()
    return runner.run(job_id, spec)


@DBOS.workflow(name="answer", max_recovery_attempts=MAX_STARTS)
def answer(spec: dict[str, Any]) -> str:
    """A job of `POST /answer`."""
    runner, job_id = _current()
    return runner.run(job_id, spec)


@DBOS.workflow(name="webhook", max_recovery_attempts=MAX_STARTS)
def webhook(job_id: str, url: str, attempt: int) -> None:
    """One attempt to notify a webhook that a job has ended."""
    runner, _ = _current()
    runner.deliver(job_id, url, attempt)
