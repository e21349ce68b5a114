"""What the processes on one job database tell each other of jobs: queued, progress, ended, canceled.

All of it only makes things quick: what counts is in the database.
"""

from __future__ import annotations

import time
from abc import abstractmethod
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from cow_service.errors import CowError
from cow_service.jobs.active import RestingThread
from cow_service.jobs.computing import EngineParts
from cow_service.requests import Stage

if TYPE_CHECKING:
    import sqlalchemy as sa

POLL_SECONDS = 0.05  # between two looks at SQLite, while a caller waits
QUIET_POLL_SECONDS = 20.0  # while no caller waits; a new one ends this pause
POLL_SHARE = 20  # and so many times as long as one took


@dataclass(frozen=True)
class Notification:
    """What happened to a job. `stage` and `done` are those of its progress."""

    what: Literal["queued", "progress", "ended", "canceled"]
    job_id: str = ""  # empty for queued jobs
    stage: Stage | None = None
    done: float = 0.0


Receive = Callable[[Notification], None]


class Notifications(RestingThread):
    """Sends to the other processes, and receives from them in a thread of its own."""

    def __init__(self, parts: EngineParts, receive: Receive) -> None:
        """`receive` is called with what other processes send."""
        super().__init__("cow-notifications", parts.active)
        self._parts, self._receive = parts, receive

    @abstractmethod
    def send(self, notification: Notification) -> None:
        """Notifies all processes. A lost message is found in the database later."""

    @abstractmethod
    def send_within(self, connection: sa.Connection, notification: Notification) -> None:
        """The same once the transaction of a connection is committed."""


class PolledNotifications(Notifications):
    """On SQLite, whose processes are on one machine: polls for the end of jobs that callers wait for."""

    def send(self, notification: Notification) -> None:
        """Does nothing."""

    def send_within(self, connection: sa.Connection, notification: Notification) -> None:
        """Does nothing."""

    def run(self) -> None:
        """Looks the more rarely, the longer a look takes."""
        took = 0.0
        while self.rest(max(POLL_SECONDS, POLL_SHARE * took), QUIET_POLL_SECONDS):
            began = time.monotonic()
            if awaited := self._parts.active.awaited_elsewhere():
                with suppress(CowError):
                    for job_id in self._parts.jobs.ended_of(awaited):
                        self._receive(Notification("ended", job_id))
            took = time.monotonic() - began
