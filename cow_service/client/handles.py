"""Handles of jobs on the server, for both clients."""

from __future__ import annotations

from collections.abc import AsyncIterator, Coroutine, Iterator
from typing import Any, Generic, TypeVar

from cow_service.client.events import Event
from cow_service.client.progress import ProgressLike
from cow_service.client.results import Answer, AsyncAnswer, AsyncSimulation, Simulation
from cow_service.records import AcceptedRequest, Job

ResultT_co = TypeVar("ResultT_co", covariant=True)
JobT_co = TypeVar("JobT_co", covariant=True)
RequestT_co = TypeVar("RequestT_co", covariant=True)
NoneT_co = TypeVar("NoneT_co", covariant=True)
EventsT_co = TypeVar("EventsT_co", covariant=True)
R_co = TypeVar("R_co", bound=Simulation | Answer, covariant=True)
AsyncR_co = TypeVar("AsyncR_co", bound=AsyncSimulation | AsyncAnswer, covariant=True)


class BaseJobHandle(Generic[ResultT_co, JobT_co, RequestT_co, NoneT_co, EventsT_co]):
    """The calls of both handles. The type parameters are what they return: values, or coroutines of them."""

    def __init__(self, connection: Any, job: Job) -> None:
        self._connection = connection
        self.job = job

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self.job.id}: {self.job.kind}, {self.job.status}>"

    @property
    def id(self) -> str:
        """The job's id, by which `Client.job` finds it again."""
        return self.job.id

    def refresh(self) -> JobT_co:
        """Gets the state of the job. Raises `JobNotFound` where it was deleted."""
        return self._connection.run(self._connection.refresh(self))

    def request(self) -> RequestT_co:
        """Gets the request that became the job: `client.submit(**request.request, kind=request.kind)` sends it again.

        Raises `JobNotFound` where the job was deleted.
        """
        return self._connection.run(self._connection.request_of(self))

    def wait(
        self, timeout: float | None = None, *, progress: ProgressLike = False, minimal: bool = False
    ) -> ResultT_co:
        """The job's result, once it has ended; `minimal` as for `Client.simulate`.

        Raises what it failed with (`errors.py`), `Canceled`, and `WaitTimeout` after `timeout` seconds.
        """
        return self._connection.run(self._connection.wait(self, timeout, progress, minimal))

    def cancel(self) -> JobT_co:
        """Cancels the job; work on it stops at the next step. One that has ended stays as it is."""
        return self._connection.run(self._connection.cancel(self))

    def delete(self) -> NoneT_co:
        """Cancels the job and removes it, with artifacts that no other job holds."""
        return self._connection.run(self._connection.delete(self))

    def events(self, after: int = 0) -> EventsT_co:
        """What happens to the job until its end, through broken connections.

        `after` leaves out events up to that number.
        """
        return self._connection.events(self, after)


class JobHandle(BaseJobHandle[R_co, Job, AcceptedRequest, None, Iterator[Event]]):
    """A job on the server, which goes on whether or not anybody holds this. `job` is its last known state."""


class AsyncJobHandle(
    BaseJobHandle[
        Coroutine[Any, Any, AsyncR_co],
        Coroutine[Any, Any, Job],
        Coroutine[Any, Any, AcceptedRequest],
        Coroutine[Any, Any, None],
        AsyncIterator[Event],
    ]
):
    """A job on the server, which goes on whether or not anybody holds this. `job` is its last known state."""
