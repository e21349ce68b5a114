"""`AsyncClient`: the calls of the SDK.

`sync_client.py` is made from this file when the package is installed or built.
"""

from __future__ import annotations

from collections.abc import AsyncGenerator, AsyncIterator, Iterable, Sequence
from typing import TYPE_CHECKING, Any, Literal, Self, Unpack, overload

if TYPE_CHECKING:
    from datetime import datetime

    import httpx

    from cow_service.client.async_results import AsyncAnswer, AsyncJobHandle, AsyncSimulation
    from cow_service.client.batches import BatchResult
    from cow_service.client.display import Models
    from cow_service.client.journal import QuestionLike
    from cow_service.client.options import AnswerBatchOptions, AnswerOptions, SimulateBatchOptions, SimulateOptions
    from cow_service.client.progress import ProgressLike
    from cow_service.client.request import ImageLike
    from cow_service.records import JobKind, JobStatus, Workers

DEFAULT_TIMEOUT = 60.0  # seconds without a word from the server
RETRIES = 5


class AsyncClient:
    """A COW server.

    `base_url` and `api_key` come from COW_BASE_URL and COW_API_KEY where they are not given; without either the server
    is http://127.0.0.1:8000. `timeout` is how long the server may say nothing, in seconds; how long a job may take is
    said where one waits for it. `retries` is how often a call is sent again that may then succeed. `http_client` brings
    proxies, certificates, transports; it is not closed here. Threads may share it;
    where it is awaited, it belongs to one event loop.

    >>> question = "If the yellow ball moves to the left, will it hit the blue mug? (A) Yes (B) No"
    >>> async with AsyncClient(base_url) as client:
    ...     answer = await client.answer("image.jpg", question)
    >>> answer.option
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
        from cow_service.client import async_results as results  # noqa: PLC0415 - httpx takes 0.3 s to import
        from cow_service.client.protocol import endpoint_of  # noqa: PLC0415

        self._connection = results.connect(endpoint_of(base_url, api_key, timeout), retries, http_client)
        self._run, self._iterate = results.run, results.iterate

    @property
    def base_url(self) -> str:
        """The server's address."""
        return self._connection.endpoint.base_url

    async def close(self) -> None:
        """Closes the client's connections."""
        await self._run(self._connection.io.close())

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    async def simulate(
        self,
        image: ImageLike,
        question: str,
        *,
        timeout: float | None = None,
        progress: ProgressLike = False,
        idempotency_key: str | None = None,
        fresh: bool = False,
        minimal: bool = False,
        **options: Unpack[SimulateOptions],
    ) -> AsyncSimulation:
        """Imagines the future of an image.

        `image` is a path, bytes, a PIL image, an array (height, width, 3) of uint8, a URL, or an artifact. `timeout` is
        in seconds, for everything together. `fresh` takes no results of earlier requests; `minimal` leaves out the long
        lists of the trajectory (`states`, `tracks`, `band`...). An interrupt cancels the job. Raises the errors of
        `errors.py`, `WaitTimeout` among them.
        """
        arguments = "simulate", image, question, options, idempotency_key, fresh, minimal
        return await self._run(self._connection.simulate_or_answer(timeout, progress, *arguments))

    async def answer(
        self,
        image: ImageLike,
        question: str,
        *,
        timeout: float | None = None,
        progress: ProgressLike = False,
        idempotency_key: str | None = None,
        fresh: bool = False,
        minimal: bool = False,
        **options: Unpack[AnswerOptions],
    ) -> AsyncAnswer:
        """Imagines the future of an image, looks at it, then answers. Arguments and errors as for `simulate`."""
        arguments = "answer", image, question, options, idempotency_key, fresh, minimal
        return await self._run(self._connection.simulate_or_answer(timeout, progress, *arguments))

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
    ) -> AsyncJobHandle[Any]:
        """Submits a simulation or an answer, and does not wait for it. Once this returns, the server keeps the job."""
        return await self._run(self._connection.submit(kind, image, question, options, idempotency_key, fresh))

    @overload
    def map(
        self,
        questions: Iterable[QuestionLike],
        *,
        kind: Literal["answer"] = "answer",
        **options: Unpack[AnswerBatchOptions],
    ) -> AsyncGenerator[BatchResult[AsyncAnswer]]: ...

    @overload
    def map(
        self, questions: Iterable[QuestionLike], *, kind: Literal["simulate"], **options: Unpack[SimulateBatchOptions]
    ) -> AsyncGenerator[BatchResult[AsyncSimulation]]: ...

    def map(
        self, questions: Iterable[QuestionLike], *, kind: JobKind = "answer", **options: Any
    ) -> AsyncGenerator[BatchResult[Any]]:
        """Asks many questions, and yields the result of each as it comes.

        A question is a mapping with `image` and `question`, maybe an `id`, a `meta` that stands next to its result, and
        fields of the request, or a pair of image and question. Fields of the request among `options` are for questions
        that do not have them; `timeout`, `fresh` and `minimal` are those of `simulate`, for each question. One that
        fails yields a result with an `error`; an error is raised where no question would get through, and when the
        server has accepted none for five minutes. As many are asked at the same time as the server takes without
        refusals, `concurrency` at most (64). `progress` shows a bar, and what limits the batch.

        With `out` every result is a line of `results.jsonl` in that folder, and the same call resumes a batch that was
        killed: nothing is asked twice. Earlier results come last, or not at all with `only_new`. `retry_failed` asks
        those again that failed. `save` writes the pictures of each into `items/` there, and `minimal` keeps the lines
        small.

        >>> question = "If the yellow ball falls, will it hit the blue mug?"
        >>> questions = [{"id": "q1", "image": "image.jpg", "question": question}]
        >>> [(result.id, result.succeeded) async for result in client.map(questions, out="out")]
        [('q1', True)]
        """
        from cow_service.client.batches import Batch  # noqa: PLC0415 - not needed to call a server once

        return self._iterate(self._connection.map(Batch(questions, kind, options)))

    async def job(self, id: str) -> AsyncJobHandle[AsyncSimulation | AsyncAnswer]:
        """A job that was submitted before. Raises `JobNotFound`."""
        return await self._run(self._connection.job(id))

    def jobs(
        self,
        *,
        status: Sequence[JobStatus] | JobStatus | None = None,
        kind: JobKind | None = None,
        created_after: datetime | None = None,
        created_before: datetime | None = None,
    ) -> AsyncIterator[AsyncJobHandle[AsyncSimulation | AsyncAnswer]]:
        """The jobs of this key, newest first, page by page as they are asked for. A time without a zone is local."""
        filters = {"status": status, "kind": kind, "created_after": created_after, "created_before": created_before}
        return self._iterate(self._connection.jobs(filters))

    async def artifact(self, sha256: str) -> bytes:
        """The bytes of an artifact; they are checked against its name."""
        return await self._run(self._connection.artifact(sha256))

    async def models(self) -> Models:
        """Readers and generators, what each needs, and whether it is ready."""
        from cow_service.client.display import Models  # noqa: PLC0415

        return await self._run(self._connection.get(Models, "/models"))

    async def workers(self) -> Workers:
        """The processes on the server's job database, what each computes, and the queues."""
        from cow_service.records import Workers  # noqa: PLC0415

        return await self._run(self._connection.get(Workers, "/workers"))
