"""The workflows that DBOS runs and picks up again. Their names, arguments and order of steps are kept in databases.

A change to the steps of a workflow needs a new name beside the old one, which stays until no database has jobs of it.
"""

from __future__ import annotations

from typing import Any, Protocol

from dbos import DBOS

VERSION = "1"  # of all workflows together; jobs of another one would wait for a server that runs it
MOST_STARTS = 20  # a job that takes the process down each time is given up then


class Runner(Protocol):
    """Who does the work in this process."""

    def run(self, job_id: str, order: dict[str, Any]) -> str:
        """Does what an order says; returns the result as JSON."""
        ...

    def deliver(self, job_id: str, url: str, attempt: int) -> None:
        """Calls a webhook, and sees to another attempt where that failed."""
        ...


_runner: Runner | None = None


def set_runner(runner: Runner | None) -> None:
    """DBOS knows functions, not objects: the one engine of this process is told to them here."""
    global _runner  # noqa: PLW0603
    _runner = runner


def _current() -> tuple[Runner, str]:
    assert _runner is not None, "workflows run only while an engine does"
    return _runner, DBOS.workflow_id or ""


@DBOS.workflow(name="simulate", max_recovery_attempts=MOST_STARTS)
def simulate(order: dict[str, Any]) -> str:
    """A job of `POST /simulate`."""
    runner, job_id = _current()
    return runner.run(job_id, order)


@DBOS.workflow(name="answer", max_recovery_attempts=MOST_STARTS)
def answer(order: dict[str, Any]) -> str:
    """A job of `POST /answer`."""
    runner, job_id = _current()
    return runner.run(job_id, order)


@DBOS.workflow(name="webhook", max_recovery_attempts=MOST_STARTS)
def webhook(job_id: str, url: str, attempt: int) -> None:
    """One attempt to tell a webhook that a job has ended."""
    runner, _ = _current()
    runner.deliver(job_id, url, attempt)
