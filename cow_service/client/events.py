"""The events of a job as they happen: of `GET /jobs/{id}/events`, through broken connections."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Literal, TypeAlias, cast, get_args

import httpx
from httpx_sse import ServerSentEvent

from cow_service.client.errors import error_of, unreachable
from cow_service.client.retries import pause_before_retry
from cow_service.client.serialization import read
from cow_service.records import Job

EventName: TypeAlias = Literal["queued", "running", "stage", "progress", "succeeded", "failed", "canceled", "deleted"]
FINAL: frozenset[str] = frozenset({"succeeded", "failed", "canceled", "deleted"})
OK, NO_CONTENT = 200, 204


@dataclass(frozen=True)
class Event:
    """One thing that happened to a job.

    `number` is the same however often events are read, and None for `progress`, which is not repeated. `job` is the
    job as it then was, without its result; None where it was deleted.
    """

    name: EventName
    number: int | None
    job: Job | None


class EventCursor:
    """The position of one reader in the events of a job, and its retries. Does no I/O."""

    def __init__(self, after: int, retries: int) -> None:
        self.position = after
        self.ended = False
        self._retries, self._attempts = retries, 0

    @property
    def headers(self) -> dict[str, str]:
        """The header that tells the server where to go on."""
        return {"Last-Event-ID": str(self.position)} if self.position else {}

    def take(self, sent: ServerSentEvent) -> Event | None:
        """The event that was sent; None for one that came before, or whose kind this version does not know.

        Raises `BadResponse` for one that cannot be read.
        """
        self._attempts = 0
        if sent.event not in get_args(EventName):
            return None
        name = cast("EventName", sent.event)
        # An event without an id of its own repeats the last one (the HTML standard's rule).
        number = int(sent.id) if name != "progress" and sent.id.isdecimal() else None
        job = _job_in(sent)
        self.ended = name in FINAL
        if number is not None and number <= self.position:
            return None
        self.position = number or self.position
        return Event(name, number, job)

    def pause_after(self, outcome: httpx.Response | httpx.HTTPError) -> float:
        """Seconds before the next connection, after one that broke, was refused or ended before the job.

        Raises the error for which no other is made.
        """
        self._attempts += 1
        if isinstance(outcome, httpx.Response) and outcome.status_code == NO_CONTENT:
            self.ended = True
            return 0.0
        if isinstance(outcome, httpx.Response) and is_event_stream(outcome):
            outcome = httpx.RemoteProtocolError("the stream ended before the job", request=outcome.request)
        pause = pause_before_retry(outcome, self._attempts) if self._attempts <= self._retries else None
        if pause is not None:
            return pause
        if isinstance(outcome, httpx.Response):
            raise error_of(outcome)
        raise unreachable(outcome) from outcome


def is_event_stream(response: httpx.Response) -> bool:
    """Whether a response is a stream of events."""
    media_type = response.headers.get("content-type", "").partition(";")[0].strip().lower()
    return response.status_code == OK and media_type == "text/event-stream"


def _job_in(sent: ServerSentEvent) -> Job | None:
    try:
        body = json.loads(sent.data)
    except ValueError:
        body = sent.data
    return read(Job, {**body, "result": None} if isinstance(body, dict) else body) if body != {} else None
