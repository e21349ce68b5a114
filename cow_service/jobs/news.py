"""What the processes on one job database tell each other of jobs: queued, progress, ended, canceled.

PostgreSQL carries it (LISTEN, NOTIFY). On SQLite, whose processes are on one machine, the database is asked for the
jobs that somebody waits for. All of it only makes things quick: what counts is in the database.
"""

from __future__ import annotations

import json
import logging
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass
from typing import Literal, Protocol

import psycopg
import sqlalchemy as sa

from cow_service.errors import CowError
from cow_service.jobs.database import Database

CHANNEL = "cow_jobs"
RECONNECT_SECONDS = 1.0  # after a session was lost
LISTEN_SECONDS = 1.0  # of one wait, after which it is looked whether to stop
ASK_SECONDS = 0.05  # between two questions to SQLite, where somebody waits
ASK_SHARE = 20  # and so many times as long as one took
PROGRESS_SECONDS = 0.2  # between two messages on the progress of a job

log = logging.getLogger("cow_service")


@dataclass(frozen=True)
class JobNews:
    """What happened to a job. `stage` and `done` are those of its progress."""

    what: Literal["queued", "progress", "ended", "canceled"]
    job_id: str
    stage: str | None = None
    done: float = 0.0


Hear = Callable[[JobNews], None]


class News(Protocol):
    """Tells the other processes, and hears them."""

    def start(self, hear: Hear) -> None:
        """Begins to listen: `hear` is called with the news of every process, this one included."""
        ...

    def tell(self, news: JobNews) -> None:
        """Tells all processes. What cannot be told is found in the database later."""
        ...

    def stop(self) -> None:
        """Ends listening."""
        ...


class SessionNews:
    """On PostgreSQL."""

    def __init__(self, database: Database) -> None:
        self._database = database
        self._address = sa.make_url(database.url).set(drivername="postgresql").render_as_string(hide_password=False)
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self._told: dict[str, float] = {}  # when the progress of a job was last told

    def start(self, hear: Hear) -> None:
        """As the protocol says."""
        self._stop.clear()
        self._thread = threading.Thread(target=self._listen, args=(hear,), name="cow-news", daemon=True)
        self._thread.start()

    def tell(self, news: JobNews) -> None:
        """As the protocol says."""
        now = time.monotonic()
        if news.what == "progress" and now - self._told.get(news.job_id, 0.0) < PROGRESS_SECONDS:
            return
        if news.what == "progress":
            self._told[news.job_id] = now
        else:
            self._told.pop(news.job_id, None)
        with suppress(CowError):
            self._database.notify(CHANNEL, json.dumps(asdict(news)))

    def stop(self) -> None:
        """As the protocol says."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None

    def _listen(self, hear: Hear) -> None:
        while not self._stop.is_set():
            try:
                with psycopg.connect(self._address, autocommit=True, connect_timeout=4) as session:
                    session.execute(f"LISTEN {CHANNEL}")
                    while not self._stop.is_set():
                        for told in session.notifies(timeout=LISTEN_SECONDS):
                            with suppress(ValueError, TypeError):  # of another version
                                hear(JobNews(**json.loads(told.payload)))
            except psycopg.Error:
                self._stop.wait(RECONNECT_SECONDS)


class AskedNews:
    """On SQLite: asks for the end of jobs that are waited for here and run elsewhere."""

    def __init__(self, awaited: Callable[[], list[str]], ended: Callable[[list[str]], list[str]]) -> None:
        self._awaited, self._ended = awaited, ended
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    def start(self, hear: Hear) -> None:
        """As the protocol says."""
        self._stop.clear()
        self._thread = threading.Thread(target=self._ask, args=(hear,), name="cow-news", daemon=True)
        self._thread.start()

    def tell(self, news: JobNews) -> None:
        """Does nothing."""

    def stop(self) -> None:
        """As the protocol says."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None

    def _ask(self, hear: Hear) -> None:
        took = 0.0
        while not self._stop.wait(max(ASK_SECONDS, ASK_SHARE * took)):
            began = time.monotonic()
            if awaited := self._awaited():
                with suppress(CowError):
                    for job_id in self._ended(awaited):
                        hear(JobNews("ended", job_id))
            took = time.monotonic() - began


def news_of(database: Database, awaited: Callable[[], list[str]], ended: Callable[[list[str]], list[str]]) -> News:
    """The news of a database. The functions say which jobs are waited for here and run elsewhere, and which of them
    have ended."""
    return SessionNews(database) if database.file is None else AskedNews(awaited, ended)
