"""Calls of webhooks, as the engine sees them: a server without COW_WEBHOOK_SECRET makes none.

Only where there is one is `webhooks.py` imported, with DBOS, which keeps the calls, and looks for some every second.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from cow_service.errors import WebhookNotAllowed

if TYPE_CHECKING:
    import sqlalchemy as sa

    from cow_service.jobs.job_table import JobTable


class Calls:
    """Of a server that makes none."""

    def check(self, url: str) -> None:
        """Raises `WebhookNotAllowed` for a URL that would not be called."""
        raise WebhookNotAllowed("This server calls no webhooks: COW_WEBHOOK_SECRET is not set. Poll the job instead.")

    def start(self, jobs: JobTable, executor: str, *, migrate: bool) -> None:
        """Makes the tables that it needs, or looks whether they are there, and begins. Raises `StorageUnavailable`."""

    def stop(self) -> None:
        """Ends. It may not have begun."""

    def enqueue(
        self, connection: sa.Connection, job_id: str, url: str, attempt: int = 1, delay: float | None = None
    ) -> None:
        """Adds an attempt, to be made `delay` seconds after the transaction of the connection."""

    def busy_executors(self) -> set[str]:
        """The processes that have calls in hand."""
        return set()

    def recover(self, ended: list[str]) -> None:
        """Has the calls of processes that have ended made by others."""

    def forget(self, jobs: list[str]) -> None:
        """Deletes the records of calls for some jobs. Raises `StorageUnavailable`."""

    def clean_up(self, before: float, stop: Callable[[], bool]) -> None:
        """Deletes the records of calls that ended before a time (Unix time, s), until `stop` says so."""
