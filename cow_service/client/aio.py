"""`AsyncClient`: calls that are awaited. The same calls as `Client`, step for step (`calls.py`)."""

from __future__ import annotations

from collections.abc import AsyncGenerator, AsyncIterator, Iterable, Mapping, Sequence
from contextlib import aclosing
from datetime import datetime
from functools import partial
from os import PathLike
from types import TracebackType
from typing import Any, Generic, Literal, Self, TypeVar, Unpack, cast, overload

import httpx

from cow_service.client import calls
from cow_service.client.async_connection import AsyncConnection
from cow_service.client.async_map import mapped
from cow_service.client.batches import CONCURRENCY, Outcome, batch_of
from cow_service.client.calls import Tell, order_of
from cow_service.client.events import Event
from cow_service.client.inputs import ImageLike
from cow_service.client.options import AnswerOptions, SimulateOptions
from cow_service.client.progress import ProgressLike, told
from cow_service.client.questions import QuestionLike
from cow_service.client.results import AsyncAnswer, AsyncSimulation
from cow_service.client.settings import DEFAULT_TIMEOUT, RETRIES, target_of
from cow_service.records import Job, JobKind, JobStatus, Models

R_co = TypeVar("R_co", bound=AsyncSimulation | AsyncAnswer, covariant=True)


class AsyncJobHandle(Generic[R_co]):
    """A job on the server, which goes on whether or not anybody holds this. `job` is what was last heard of it."""

    def __init__(self, connection: AsyncConnection, job: Job) -> None:
        self._connection = connection
        self.job = job

    def __repr__(self) -> str:
        return f"<AsyncJobHandle {self.job.id}: {self.job.kind}, {self.job.status}>"

    @property
    def id(self) -> str:
        """By which `Client.job` finds it again."""
        return self.job.id

    async def refresh(self) -> Job:
        """Looks at it now. Raises `JobNotFound` where it was deleted."""
        self.job = await self._connection.job(self.id)
        return self.job

    async def wait(self, timeout: float | None = None, *, progress: ProgressLike = False) -> R_co:
        """Its result, once it has ended.

        Raises what it failed with (`errors.py`), `Canceled`, and `WaitTimeout` after `timeout` seconds.
        """
        with told(progress) as tell:
            return cast("R_co", await self._connection.awaited(self.job, timeout, self._hearing(tell)))

    async def cancel(self) -> Job:
        """Ends it; whoever works on it stops at the next step. One that has ended stays as it is."""
        self.job = await self._connection.run(calls.canceled(self.id, self._connection.retries))
        return self.job

    async def delete(self) -> None:
        """Ends it and removes it, with artifacts that no other job holds."""
        await self._connection.run(calls.deleted(self.id, self._connection.retries))

    async def events(self, after: int = 0) -> AsyncIterator[Event]:
        """What happens to it until its end, through broken connections; `after` leaves out events up to that number."""
        async with aclosing(self._connection.events(self.id, after)) as events:
            async for event in events:
                self.job = event.job or self.job
                yield event

    def _hearing(self, tell: Tell | None) -> Tell:
        def hear(job: Job) -> None:
            self.job = job
            if tell is not None:
                tell(job)

        return hear


class AsyncClient:
    """A COW server.

    `base_url` and `api_key` come from COW_BASE_URL and COW_API_KEY where they are not given; without either the server
    is http://127.0.0.1:8000. `timeout` is how long the server may say nothing, in seconds; how long a job may take is
    said where one waits for it. `retries` is how often a call is sent again that may then succeed. `http_client` brings
    proxies, certificates, transports; it is not closed here. For one event loop.

    >>> async def ask(question):
    ...     async with AsyncClient(base_url) as client:
    ...         return (await client.answer("image.jpg", question)).option
    >>> asyncio.run(ask("If the yellow ball moves to the right, will it hit the blue mug? (A) Yes (B) No"))
    'No'
    """

    def __init__(
        self,
        base_url: str | None = None,
        *,
        api_key: str | None = None,
        timeout: float | httpx.Timeout | None = DEFAULT_TIMEOUT,
        retries: int = RETRIES,
        http_client: httpx.AsyncClient | None = None,
    ) -> None:
        http = http_client or httpx.AsyncClient(limits=httpx.Limits(max_connections=None))
        self._connection = AsyncConnection(
            target_of(base_url, api_key, timeout), retries, http, own=http_client is None
        )

    @property
    def base_url(self) -> str:
        """The server's address."""
        return self._connection.target.base_url

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.close()

    async def close(self) -> None:
        """Closes its connections."""
        await self._connection.close()

    async def simulate(
        self,
        image: ImageLike,
        question: str,
        *,
        timeout: float | None = None,
        progress: ProgressLike = False,
        idempotency_key: str | None = None,
        fresh: bool = False,
        **options: Unpack[SimulateOptions],
    ) -> AsyncSimulation:
        """Imagines the future of an image.

        `image` is a path, bytes, a PIL image, an array (height, width, 3) of uint8, a URL, or an artifact. `timeout` is
        in seconds, for everything together. `fresh` takes no results of earlier requests. An interrupt ends the job.
        Raises the errors of `errors.py`, `WaitTimeout` among them.
        """
        order = order_of("simulate", image, question, cast("Mapping[str, Any]", options), idempotency_key, fresh)
        return cast("AsyncSimulation", await self._connection.done(order, timeout, progress))

    async def answer(
        self,
        image: ImageLike,
        question: str,
        *,
        timeout: float | None = None,
        progress: ProgressLike = False,
        idempotency_key: str | None = None,
        fresh: bool = False,
        **options: Unpack[AnswerOptions],
    ) -> AsyncAnswer:
        """Imagines the future of an image, looks at it, then answers. Arguments and errors as for `simulate`."""
        order = order_of("answer", image, question, cast("Mapping[str, Any]", options), idempotency_key, fresh)
        return cast("AsyncAnswer", await self._connection.done(order, timeout, progress))

    @overload
    async def submit(
        self,
        image: ImageLike,
        question: str,
        *,
        kind: Literal["simulate"] = "simulate",
        idempotency_key: str | None = None,
        fresh: bool = False,
        **options: Unpack[SimulateOptions],
    ) -> AsyncJobHandle[AsyncSimulation]: ...

    @overload
    async def submit(
        self,
        image: ImageLike,
        question: str,
        *,
        kind: Literal["answer"],
        idempotency_key: str | None = None,
        fresh: bool = False,
        **options: Unpack[AnswerOptions],
    ) -> AsyncJobHandle[AsyncAnswer]: ...

    async def submit(
        self,
        image: ImageLike,
        question: str,
        *,
        kind: JobKind = "simulate",
        idempotency_key: str | None = None,
        fresh: bool = False,
        **options: Any,
    ) -> AsyncJobHandle[AsyncSimulation] | AsyncJobHandle[AsyncAnswer]:
        """Hands in a simulation or an answer, and does not wait for it. Once this returns, the server keeps the job."""
        order = order_of(kind, image, question, options, idempotency_key, fresh)
        return AsyncJobHandle(
            self._connection, await self._connection.run(calls.submitted(order, self._connection.retries))
        )

    @overload
    def map(
        self,
        questions: Iterable[QuestionLike],
        *,
        kind: Literal["answer"] = "answer",
        concurrency: int = CONCURRENCY,
        out: str | PathLike[str] | None = None,
        retry_failed: bool = False,
        only_new: bool = False,
        save: bool = False,
        timeout: float | None = None,
        fresh: bool = False,
        progress: bool = False,
        **options: Unpack[AnswerOptions],
    ) -> AsyncGenerator[Outcome[AsyncAnswer]]: ...

    @overload
    def map(
        self,
        questions: Iterable[QuestionLike],
        *,
        kind: Literal["simulate"],
        concurrency: int = CONCURRENCY,
        out: str | PathLike[str] | None = None,
        retry_failed: bool = False,
        only_new: bool = False,
        save: bool = False,
        timeout: float | None = None,
        fresh: bool = False,
        progress: bool = False,
        **options: Unpack[SimulateOptions],
    ) -> AsyncGenerator[Outcome[AsyncSimulation]]: ...

    def map(
        self,
        questions: Iterable[QuestionLike],
        *,
        kind: JobKind = "answer",
        concurrency: int = CONCURRENCY,
        out: str | PathLike[str] | None = None,
        retry_failed: bool = False,
        only_new: bool = False,
        save: bool = False,
        timeout: float | None = None,
        fresh: bool = False,
        progress: bool = False,
        **options: Any,
    ) -> AsyncGenerator[Outcome[Any]]:
        """Asks many questions, `concurrency` at the same time, and gives what comes of each as it comes.

        A question is a mapping with `image` and `question`, maybe an `id`, a `meta` that stands beside its outcome, and
        fields of the request, or a pair of image and question. `options` are for those that do not have them. One that
        fails is an outcome with an `error`; an error is raised where no question would get through, and when the server
        has taken none for five minutes.

        With `out` every outcome is a line of `results.jsonl` in that folder, and the same call goes on where one ended
        that was killed: nothing is asked twice. Outcomes of before come last, or not at all with `only_new`.
        `retry_failed` asks those again that failed. `save` writes the pictures of each into `items/` there.
        """
        begin = partial(
            batch_of,
            questions,
            options,
            kind=kind,
            concurrency=concurrency,
            timeout=timeout,
            fresh=fresh,
            out=out,
            retry_failed=retry_failed,
            save=save,
            progress=progress,
            only_new=only_new,
        )
        return mapped(self._connection, begin)

    async def job(self, id: str) -> AsyncJobHandle[AsyncSimulation | AsyncAnswer]:
        """A job that was handed in before. Raises `JobNotFound`."""
        return AsyncJobHandle(self._connection, await self._connection.job(id))

    async def jobs(
        self,
        *,
        status: Sequence[JobStatus] | JobStatus | None = None,
        kind: JobKind | None = None,
        created_after: datetime | None = None,
        created_before: datetime | None = None,
    ) -> AsyncIterator[AsyncJobHandle[AsyncSimulation | AsyncAnswer]]:
        """The jobs of this key, newest first, page by page as they are asked for. A time without a zone is local."""
        filters = {"status": status, "kind": kind, "created_after": created_after, "created_before": created_before}
        cursor: str | None = None
        while True:
            page = await self._connection.run(calls.job_page(filters, cursor, self._connection.retries))
            for job in page.jobs:
                yield AsyncJobHandle(self._connection, job)
            cursor = page.next
            if cursor is None:
                return

    async def artifact(self, sha256: str) -> bytes:
        """The bytes of an artifact; they are checked against its name."""
        return await self._connection.artifact(sha256)

    async def models(self) -> Models:
        """Readers and generators, what each needs, and whether it is ready."""
        return await self._connection.run(calls.models(self._connection.retries))
