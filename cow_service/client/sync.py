"""`Client`: calls that wait. The same calls as `AsyncClient`, step for step (`calls.py`)."""

from __future__ import annotations

from collections.abc import Generator, Iterable, Iterator, Mapping, Sequence
from datetime import datetime
from functools import partial
from os import PathLike
from types import TracebackType
from typing import Any, Generic, Literal, Self, TypeVar, Unpack, cast, overload

import httpx

from cow_service.client import calls
from cow_service.client.batches import CONCURRENCY, Outcome, batch_of
from cow_service.client.calls import Tell, order_of
from cow_service.client.events import Event
from cow_service.client.inputs import ImageLike
from cow_service.client.options import AnswerOptions, SimulateOptions
from cow_service.client.progress import ProgressLike, told
from cow_service.client.questions import QuestionLike
from cow_service.client.results import Answer, Simulation
from cow_service.client.settings import DEFAULT_TIMEOUT, RETRIES, target_of
from cow_service.client.sync_connection import Connection
from cow_service.client.sync_map import mapped
from cow_service.records import Job, JobKind, JobStatus, Models

R_co = TypeVar("R_co", bound=Simulation | Answer, covariant=True)


class JobHandle(Generic[R_co]):
    """A job on the server, which goes on whether or not anybody holds this. `job` is what was last heard of it."""

    def __init__(self, connection: Connection, job: Job) -> None:
        self._connection = connection
        self.job = job

    def __repr__(self) -> str:
        return f"<JobHandle {self.job.id}: {self.job.kind}, {self.job.status}>"

    @property
    def id(self) -> str:
        """By which `Client.job` finds it again."""
        return self.job.id

    def refresh(self) -> Job:
        """Looks at it now. Raises `JobNotFound` where it was deleted."""
        self.job = self._connection.job(self.id)
        return self.job

    def wait(self, timeout: float | None = None, *, progress: ProgressLike = False) -> R_co:
        """Its result, once it has ended.

        Raises what it failed with (`errors.py`), `Canceled`, and `WaitTimeout` after `timeout` seconds.
        """
        with told(progress) as tell:
            return cast("R_co", self._connection.awaited(self.job, timeout, self._hearing(tell)))

    def cancel(self) -> Job:
        """Ends it; whoever works on it stops at the next step. One that has ended stays as it is."""
        self.job = self._connection.run(calls.canceled(self.id, self._connection.retries))
        return self.job

    def delete(self) -> None:
        """Ends it and removes it, with artifacts that no other job holds."""
        self._connection.run(calls.deleted(self.id, self._connection.retries))

    def events(self, after: int = 0) -> Iterator[Event]:
        """What happens to it until its end, through broken connections; `after` leaves out events up to that number."""
        for event in self._connection.events(self.id, after):
            self.job = event.job or self.job
            yield event

    def _hearing(self, tell: Tell | None) -> Tell:
        def hear(job: Job) -> None:
            self.job = job
            if tell is not None:
                tell(job)

        return hear


class Client:
    """A COW server.

    `base_url` and `api_key` come from COW_BASE_URL and COW_API_KEY where they are not given; without either the server
    is http://127.0.0.1:8000. `timeout` is how long the server may say nothing, in seconds; how long a job may take is
    said where one waits for it. `retries` is how often a call is sent again that may then succeed. `http_client` brings
    proxies, certificates, transports; it is not closed here. Safe to share between threads.

    >>> question = "If the yellow ball moves to the right, will it hit the blue mug? (A) Yes (B) No"
    >>> with Client(base_url) as client:
    ...     answer = client.answer("image.jpg", question)
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
        http_client: httpx.Client | None = None,
    ) -> None:
        http = http_client or httpx.Client(limits=httpx.Limits(max_connections=None))
        self._connection = Connection(target_of(base_url, api_key, timeout), retries, http, own=http_client is None)

    @property
    def base_url(self) -> str:
        """The server's address."""
        return self._connection.target.base_url

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Closes its connections."""
        self._connection.close()

    def simulate(
        self,
        image: ImageLike,
        question: str,
        *,
        timeout: float | None = None,
        progress: ProgressLike = False,
        idempotency_key: str | None = None,
        fresh: bool = False,
        **options: Unpack[SimulateOptions],
    ) -> Simulation:
        """Imagines the future of an image.

        `image` is a path, bytes, a PIL image, an array (height, width, 3) of uint8, a URL, or an artifact. `timeout` is
        in seconds, for everything together. `fresh` takes no results of earlier requests. An interrupt ends the job.
        Raises the errors of `errors.py`, `WaitTimeout` among them.
        """
        order = order_of("simulate", image, question, cast("Mapping[str, Any]", options), idempotency_key, fresh)
        return cast("Simulation", self._connection.done(order, timeout, progress))

    def answer(
        self,
        image: ImageLike,
        question: str,
        *,
        timeout: float | None = None,
        progress: ProgressLike = False,
        idempotency_key: str | None = None,
        fresh: bool = False,
        **options: Unpack[AnswerOptions],
    ) -> Answer:
        """Imagines the future of an image, looks at it, then answers. Arguments and errors as for `simulate`."""
        order = order_of("answer", image, question, cast("Mapping[str, Any]", options), idempotency_key, fresh)
        return cast("Answer", self._connection.done(order, timeout, progress))

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
    ) -> JobHandle[Simulation]: ...

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
    ) -> JobHandle[Answer]: ...

    def submit(
        self,
        image: ImageLike,
        question: str,
        *,
        kind: JobKind = "simulate",
        idempotency_key: str | None = None,
        fresh: bool = False,
        **options: Any,
    ) -> JobHandle[Simulation] | JobHandle[Answer]:
        """Hands in a simulation or an answer, and does not wait for it. Once this returns, the server keeps the job."""
        order = order_of(kind, image, question, options, idempotency_key, fresh)
        return JobHandle(self._connection, self._connection.run(calls.submitted(order, self._connection.retries)))

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
    ) -> Generator[Outcome[Answer]]: ...

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
    ) -> Generator[Outcome[Simulation]]: ...

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
    ) -> Generator[Outcome[Any]]:
        """Asks many questions, `concurrency` at the same time, and gives what comes of each as it comes.

        A question is a mapping with `image` and `question`, maybe an `id`, a `meta` that stands beside its outcome, and
        fields of the request, or a pair of image and question. `options` are for those that do not have them. One that
        fails is an outcome with an `error`; an error is raised where no question would get through, and when the server
        has taken none for five minutes.

        With `out` every outcome is a line of `results.jsonl` in that folder, and the same call goes on where one ended
        that was killed: nothing is asked twice. Outcomes of before come last, or not at all with `only_new`.
        `retry_failed` asks those again that failed. `save` writes the pictures of each into `items/` there.

        >>> question = "If the yellow ball falls, will it hit the blue mug?"
        >>> questions = [{"id": "q1", "image": "image.jpg", "question": question}]
        >>> [(outcome.id, outcome.succeeded) for outcome in client.map(questions, out="out")]
        [('q1', True)]
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

    def job(self, id: str) -> JobHandle[Simulation | Answer]:
        """A job that was handed in before. Raises `JobNotFound`."""
        return JobHandle(self._connection, self._connection.job(id))

    def jobs(
        self,
        *,
        status: Sequence[JobStatus] | JobStatus | None = None,
        kind: JobKind | None = None,
        created_after: datetime | None = None,
        created_before: datetime | None = None,
    ) -> Iterator[JobHandle[Simulation | Answer]]:
        """The jobs of this key, newest first, page by page as they are asked for. A time without a zone is local."""
        filters = {"status": status, "kind": kind, "created_after": created_after, "created_before": created_before}
        cursor: str | None = None
        while True:
            page = self._connection.run(calls.job_page(filters, cursor, self._connection.retries))
            yield from (JobHandle(self._connection, job) for job in page.jobs)
            cursor = page.next
            if cursor is None:
                return

    def artifact(self, sha256: str) -> bytes:
        """The bytes of an artifact; they are checked against its name."""
        return self._connection.artifact(sha256)

    def models(self) -> Models:
        """Readers and generators, what each needs, and whether it is ready."""
        return self._connection.run(calls.models(self._connection.retries))
