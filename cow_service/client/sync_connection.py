"""How `Client` does what calls say: requests sent, pauses slept, events followed."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Generator
from typing import TypeVar

import httpx
from httpx_sse import EventSource

from cow_service.client import calls
from cow_service.client.calls import Order, Pause, Placed, Send, Steps, Tell
from cow_service.client.errors import closed, unreachable
from cow_service.client.events import Event, Following, streams
from cow_service.client.progress import ProgressLike, told
from cow_service.client.results import Answer, Simulation, result_from
from cow_service.client.settings import Contact, Target
from cow_service.errors import CowError
from cow_service.records import Job

T = TypeVar("T")


class Connection:
    """A server, and the way to it. `own` says whether the way is closed with it."""

    def __init__(self, target: Target, retries: int, http: httpx.Client, *, own: bool) -> None:
        self.target = target
        self.retries = retries
        self._http = http
        self._own = own
        self._contact = Contact()

    def close(self) -> None:
        """Closes the connections that were made here."""
        if self._own:
            self._http.close()

    def artifact(self, sha256: str) -> bytes:
        """The bytes of an artifact."""
        return self.run(calls.artifact(sha256, self.retries))

    def job(self, job_id: str) -> Job:
        """A job as it is."""
        return calls.job_in(self.run(calls.looked_at(job_id, self.retries)))

    def done(
        self,
        order: Order,
        timeout: float | None,
        progress: ProgressLike,
        *,
        keep: bool = False,
        hear: Tell | None = None,
    ) -> Simulation | Answer:
        """The result of an order, waited for. An interrupt ends its job, unless `keep`; `hear` is told of each look."""
        patience = self.target.patience(timeout) if progress is False else 0
        placed = Placed(order)
        with told(progress) as tell:
            try:
                body = self.run(calls.done(placed, patience, timeout, hear or tell, self.retries))
            except CowError:
                raise
            except BaseException:
                if not keep:
                    with contextlib.suppress(Exception):
                        self.run(calls.withdrawn(placed))
                raise
        return result_from(order.kind, body, self.artifact)

    def awaited(self, job: Job, timeout: float | None, tell: Tell | None) -> Simulation | Answer:
        """The result of a job, once it has ended."""
        body = self.run(calls.awaited(job.id, timeout, calls.deadline(timeout), tell, self.retries))
        return result_from(job.kind, body, self.artifact)

    def run(self, steps: Steps[T]) -> T:
        """Does what a call says, to its end."""
        came: httpx.Response | httpx.HTTPError | None = None
        while True:
            try:
                step = steps.send(came)
            except StopIteration as end:
                return end.value
            if isinstance(step, Pause):
                time.sleep(step.seconds)
                came = None
            else:
                came = self._sent(step)
                if self._contact.missing(came) and isinstance(came, httpx.HTTPError):
                    raise unreachable(came) from came

    def events(self, job_id: str, after: int) -> Generator[Event]:
        """The events of a job after a number, through broken connections."""
        following = Following(after, self.retries)
        send = calls.events_of(job_id)
        url, limit = self.target.url(send.path), self.target.following
        while not following.ended:
            headers = self.target.headers(send) | following.headers
            try:
                with self._http.stream("GET", url, headers=headers, timeout=limit) as response:
                    outcome: httpx.Response | httpx.HTTPError = response
                    if streams(response):
                        for sent in EventSource(response).iter_sse():
                            if (event := following.take(sent)) is not None:
                                yield event
                            if following.ended:
                                break
                    else:
                        response.read()
            except httpx.HTTPError as error:
                outcome = error
            if not following.ended:
                time.sleep(following.pause_after(outcome))

    def _sent(self, send: Send) -> httpx.Response | httpx.HTTPError:
        if self._http.is_closed:
            raise closed()
        try:
            return self._http.request(
                send.method,
                self.target.url(send.path),
                headers=self.target.headers(send),
                params=send.params,
                content=send.content,
                timeout=self.target.limited(send.limit),
            )
        except httpx.HTTPError as error:
            return error
