"""The calls of `Client` and `AsyncClient`: signatures and documentation, once for both."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any, Generic, Literal, TypeVar, Unpack, overload

from cow_service.client.options import CONCURRENCY, DEFAULT_TIMEOUT, RETRIES, AnswerOptions, SimulateOptions

if TYPE_CHECKING:
    from datetime import datetime
    from os import PathLike

    import httpx

    from cow_service.client.inputs import ImageLike
    from cow_service.client.progress import ProgressLike
    from cow_service.client.questions import QuestionLike
    from cow_service.records import JobKind, JobStatus

HttpClientT = TypeVar("HttpClientT")
SimulationT = TypeVar("SimulationT")
AnswerT = TypeVar("AnswerT")
SimulationHandleT = TypeVar("SimulationHandleT")
AnswerHandleT = TypeVar("AnswerHandleT")
HandleT = TypeVar("HandleT")
HandlesT = TypeVar("HandlesT")
SimulationsT = TypeVar("SimulationsT")
AnswersT = TypeVar("AnswersT")
BytesT = TypeVar("BytesT")
ModelsT = TypeVar("ModelsT")
WorkersT = TypeVar("WorkersT")
NoneT = TypeVar("NoneT")


class BaseClient(
    Generic[
        HttpClientT,
        SimulationT,
        AnswerT,
        SimulationHandleT,
        AnswerHandleT,
        HandleT,
        HandlesT,
        SimulationsT,
        AnswersT,
        BytesT,
        ModelsT,
        WorkersT,
        NoneT,
    ]
):
    """The calls of both clients. The type parameters are what they return: values, or coroutines of them."""

    def __init__(
        self,
        base_url: str | None = None,
        *,
        api_key: str | None = None,
        timeout: float | httpx.Timeout | None = DEFAULT_TIMEOUT,
        retries: int = RETRIES,
        http_client: HttpClientT | None = None,
    ) -> None:
        self._connection = self._connect(base_url, api_key, timeout, retries, http_client)

    def _connect(self, *arguments: Any) -> Any:
        """The `Connection` or `AsyncConnection` that does the work."""
        raise NotImplementedError

    def _run(self, steps: Any) -> Any:
        return self._connection.run(steps)

    def _completed(self, *arguments: Any) -> Any:
        return self._run(self._connection.complete(*arguments))

    @property
    def base_url(self) -> str:
        """The server's address."""
        return self._connection.endpoint.base_url

    def close(self) -> NoneT:
        """Closes the client's connections."""
        return self._connection.close()

    def simulate(
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
    ) -> SimulationT:
        """Imagines the future of an image.

        `image` is a path, bytes, a PIL image, an array (height, width, 3) of uint8, a URL, or an artifact. `timeout` is
        in seconds, for everything together. `fresh` takes no results of earlier requests; `minimal` leaves out the long
        lists of the trajectory (`states`, `tracks`, `band`...). An interrupt cancels the job. Raises the errors of
        `errors.py`, `WaitTimeout` among them.
        """
        return self._completed("simulate", image, question, options, timeout, progress, idempotency_key, fresh, minimal)

    def answer(
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
    ) -> AnswerT:
        """Imagines the future of an image, looks at it, then answers. Arguments and errors as for `simulate`."""
        return self._completed("answer", image, question, options, timeout, progress, idempotency_key, fresh, minimal)

    @overload
    def submit(
        self,
        image: ImageLike,
        question: str,
        *,
        kind: Literal["simulate"] = "simulate",
        idempotency_key: str | None = None,
        fresh: bool = False,
        **options: Unpack[SimulateOptions],
    ) -> SimulationHandleT: ...

    @overload
    def submit(
        self,
        image: ImageLike,
        question: str,
        *,
        kind: Literal["answer"],
        idempotency_key: str | None = None,
        fresh: bool = False,
        **options: Unpack[AnswerOptions],
    ) -> AnswerHandleT: ...

    def submit(
        self,
        image: ImageLike,
        question: str,
        *,
        kind: JobKind = "simulate",
        idempotency_key: str | None = None,
        fresh: bool = False,
        **options: Any,
    ) -> Any:
        """Submits a simulation or an answer, and does not wait for it. Once this returns, the server keeps the job."""
        return self._run(self._connection.submit(kind, image, question, options, idempotency_key, fresh))

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
        minimal: bool = False,
        progress: bool = False,
        **options: Unpack[AnswerOptions],
    ) -> AnswersT: ...

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
        minimal: bool = False,
        progress: bool = False,
        **options: Unpack[SimulateOptions],
    ) -> SimulationsT: ...

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
        minimal: bool = False,
        progress: bool = False,
        **options: Any,
    ) -> Any:
        """Asks many questions, `concurrency` at the same time, and yields the outcome of each as it comes.

        A question is a mapping with `image` and `question`, maybe an `id`, a `meta` that stands beside its outcome, and
        fields of the request, or a pair of image and question. `options` are for those that do not have them. One that
        fails is an outcome with an `error`; an error is raised where no question would get through, and when the server
        has accepted none for five minutes.

        With `out` every outcome is a line of `results.jsonl` in that folder, and the same call resumes a batch that was
        killed: nothing is asked twice. Earlier outcomes come last, or not at all with `only_new`. `retry_failed` asks
        those again that failed. `save` writes the pictures of each into `items/` there, and `minimal` keeps the lines
        small.

        >>> question = "If the yellow ball falls, will it hit the blue mug?"
        >>> questions = [{"id": "q1", "image": "image.jpg", "question": question}]
        >>> [(outcome.id, outcome.succeeded) for outcome in client.map(questions, out="out")]
        [('q1', True)]
        """
        from cow_service.client.batches import Batch, BatchOptions  # noqa: PLC0415 - not needed to call a server once

        settings = BatchOptions(kind, concurrency, timeout, fresh, minimal, out, retry_failed, only_new, save, progress)
        return self._connection.map(Batch(self._connection, questions, options, settings))

    def job(self, id: str) -> HandleT:
        """A job that was submitted before. Raises `JobNotFound`."""
        return self._run(self._connection.job(id))

    def jobs(
        self,
        *,
        status: Sequence[JobStatus] | JobStatus | None = None,
        kind: JobKind | None = None,
        created_after: datetime | None = None,
        created_before: datetime | None = None,
    ) -> HandlesT:
        """The jobs of this key, newest first, page by page as they are asked for. A time without a zone is local."""
        filters = {"status": status, "kind": kind, "created_after": created_after, "created_before": created_before}
        return self._connection.jobs(filters)

    def artifact(self, sha256: str) -> BytesT:
        """The bytes of an artifact; they are checked against its name."""
        return self._run(self._connection.artifact(sha256))

    def models(self) -> ModelsT:
        """Readers and generators, what each needs, and whether it is ready."""
        return self._run(self._connection.models())

    def workers(self) -> WorkersT:
        """The processes on the server's job database, what each computes, and the queues."""
        return self._run(self._connection.workers())
