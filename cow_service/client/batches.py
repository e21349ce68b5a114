"""Batches: what comes of each question, and which errors are about the question and which about the server."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sized
from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace
from functools import partial
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, Literal, Self, TypeVar

from cow_service.client.batch_progress import BatchProgress, progress_shown
from cow_service.client.errors import BadResponse, ServerUnreachable, WaitTimeout, error_from
from cow_service.client.job_request import JobRequest, job_request
from cow_service.client.journal import Journal
from cow_service.client.questions import Question, QuestionLike, questions
from cow_service.client.results import Answer, AsyncAnswer, AsyncSimulation, Simulation
from cow_service.client.steps import Blocking, Sleep, Steps
from cow_service.errors import (
    BodyTooSlow,
    CowError,
    ImageUnreadable,
    MethodNotAllowed,
    NotFound,
    NotReady,
    OriginNotAllowed,
    QueueFull,
    RateLimited,
    ShuttingDown,
    StorageUnavailable,
    Unauthorized,
)
from cow_service.records import JobKind

if TYPE_CHECKING:
    from cow_service.client.operations import Operations

MAX_OUTAGE_SECONDS = 300.0  # without any response, after which a batch ends; it can be resumed
RETRY_SECONDS = 2.0  # before a question is sent again that the server could not accept
_FATAL = (Unauthorized, OriginNotAllowed, MethodNotAllowed, NotFound)  # every other question would meet it, too
TRANSIENT = (ServerUnreachable, ShuttingDown, QueueFull, RateLimited, NotReady, StorageUnavailable, BodyTooSlow)

R_co = TypeVar("R_co", bound=Simulation | Answer | AsyncSimulation | AsyncAnswer, covariant=True)


@dataclass(frozen=True)
class Outcome(Generic[R_co]):
    """What came of one question: a result, or the error that it failed with."""

    question: Question
    result: R_co | None
    error: CowError | None
    seconds: float
    unsaved: CowError | None = None  # why its pictures were not saved, where they were not

    @property
    def id(self) -> str:
        """The question's id."""
        return self.question.id

    @property
    def succeeded(self) -> bool:
        """Whether there is a result."""
        return self.error is None

    @property
    def status(self) -> Literal["succeeded", "failed"]:
        """The same in a word, as in `results.jsonl`."""
        return "succeeded" if self.succeeded else "failed"

    def line(self) -> dict[str, Any]:
        """What is kept of it."""
        head = {"status": self.status, "seconds": round(self.seconds, 3)}
        if self.error is not None:
            problem = {"code": self.error.code, **self.error.as_problem()}
            job = {"job_id": self.error.job_id} if isinstance(self.error, WaitTimeout) else {}
            return {**head, "problem": {**problem, "request_id": self.error.request_id, **job}}
        assert self.result is not None
        if self.unsaved is not None:
            head["unsaved"] = self.unsaved.detail
        return {**head, "result": self.result.model_dump(mode="json")}


def outcome_from(question: Question, line: Mapping[str, Any], read: Callable[[dict[str, Any]], R_co]) -> Outcome[R_co]:
    """The outcome that a line of a journal keeps."""
    if line["status"] == "succeeded":
        return Outcome(question, read(line["result"]), None, line["seconds"])
    error = error_from(line["problem"])
    error.request_id = line["problem"].get("request_id")
    if isinstance(error, WaitTimeout):
        error.job_id = line["problem"].get("job_id", "")
    return Outcome(question, None, error, line["seconds"])


class OutageTimer:
    """How long a batch waits for a server that accepts nothing. One for all questions; thread-safe."""

    def __init__(
        self, seconds: float = MAX_OUTAGE_SECONDS, on_change: Callable[[CowError | None], None] | None = None
    ) -> None:
        """`on_change` is called with what the batch waits for, and with None when that is over."""
        self._seconds = seconds
        self._on_change = on_change
        self._lock = threading.Lock()
        self._last_response = time.monotonic()
        self._ever_answered = False

    def reset(self) -> None:
        """The server has responded."""
        with self._lock:
            self._last_response, self._ever_answered = time.monotonic(), True
            if self._on_change is not None:
                self._on_change(None)

    def pause_after(self, error: CowError) -> float | None:
        """Seconds before the question is sent again; None where the error is about the question.

        Raises an error that all questions would meet, or that has lasted for too long.
        """
        proxy = isinstance(error, BadResponse)
        if isinstance(error, _FATAL) or (proxy and 300 <= error.status < 500):
            raise error
        if not (isinstance(error, TRANSIENT) or (proxy and error.status >= 500)):
            self.reset()
            return None
        with self._lock:
            missing = isinstance(error, ServerUnreachable) and not self._ever_answered
            if missing or time.monotonic() - self._last_response > self._seconds:
                raise error
            if self._on_change is not None:
                self._on_change(error)
        return RETRY_SECONDS


@dataclass(frozen=True)
class BatchOptions:
    """How the questions of one batch are asked (`Client.map`). Raises `ValueError` for what does not fit together."""

    kind: JobKind
    concurrency: int
    timeout: float | None
    fresh: bool
    minimal: bool
    out: str | PathLike[str] | None
    retry_failed: bool
    only_new: bool
    save: bool
    progress: bool

    def __post_init__(self) -> None:
        if self.concurrency < 1:
            raise ValueError(f"concurrency must be at least 1, got {self.concurrency}")
        if self.out is None and (self.retry_failed or self.save):
            raise ValueError("retry_failed and save need `out`, the folder of the batch")


class Batch:
    """One batch: its questions, how each is asked, and its outcomes. A context that holds the folder."""

    def __init__(
        self,
        connection: Operations,
        items: Iterable[QuestionLike],
        defaults: Mapping[str, Any],
        options: BatchOptions,
    ) -> None:
        self.concurrency = options.concurrency
        self._connection, self._items, self._defaults, self._options = connection, items, defaults, options
        self._journal: Journal | None = None
        self._known: dict[str, Question] = {}  # questions with an earlier outcome that is to be yielded, by id
        self._progress = BatchProgress(len(items) if isinstance(items, Sized) else None)
        self._show: Callable[[], None] = lambda: None
        self._outage = OutageTimer(on_change=self._waiting_for)
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        """Raises what `Journal` raises."""
        options = self._options
        if options.out is not None:
            self._journal = Journal(Path(options.out), options.kind, retry_failed=options.retry_failed)
            self._stack.callback(self._journal.close)
        self._show = self._stack.enter_context(progress_shown(self._progress, options.progress))
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def pending(self) -> Iterator[Question]:
        """The questions without an outcome yet."""
        journal = self._journal
        for question in questions(self._items, self._defaults):
            if journal is None or not journal.has(question):
                yield question
            else:
                if not self._options.only_new:
                    self._known[question.id] = question
                self._progress.count(journal.done[question.id][1] == "succeeded", earlier=True)

    def ask(self, question: Question) -> Steps[Outcome[Any]]:
        """The steps to the outcome of a question, which is written down.

        Raises what no question could get past (`OutageTimer`).
        """
        began, timeout = time.monotonic(), self._options.timeout
        while True:
            result: Any = None
            failed: CowError | None = None
            try:
                request = yield Blocking(partial(self._request, question))  # files are read, pictures encoded
                result = yield from self._connection.complete_request(
                    request,
                    self._connection.endpoint.server_wait(timeout),
                    timeout,
                    lambda _: self._outage.reset(),
                    cancel_abandoned=self._journal is None,  # with a journal, the next start asks for the job again
                )
                if self._journal is not None and self._options.save:
                    yield from result.save_steps(self._journal.folder / "items" / question.folder)
            except CowError as error:
                failed = error
                if isinstance(error, WaitTimeout):
                    with suppress(CowError):
                        yield from self._connection.cancel_job(error.job_id)
            pause = None if failed is None else self._outage.pause_after(failed)
            if pause is None:
                self._outage.reset()
                # Where its pictures failed to be saved, the result stands.
                unanswered, unsaved = (failed, None) if result is None else (None, failed)
                outcome = Outcome(question, result, unanswered, time.monotonic() - began, unsaved)
                self._keep(outcome)
                return outcome
            yield Sleep(pause)

    def count(self, outcome: Outcome[Any]) -> None:
        """Shows that one more has come."""
        self._progress.count(outcome.succeeded)
        self._show()

    def earlier_outcomes(self) -> Iterator[Outcome[Any]]:
        """The outcomes that were there before."""
        if self._journal is not None and self._known:
            for line in self._journal.lines():
                if line["id"] in self._known:
                    read = partial(self._connection.result, self._options.kind)
                    yield outcome_from(self._known[line["id"]], line, read)

    def _request(self, question: Question) -> JobRequest:
        """The request of a question, with a key that a batch which resumes after a kill uses again.

        Raises `ImageUnreadable` where its file cannot be read, and `InvalidRequest` where its image is none.
        """
        kind, fresh, minimal = self._options.kind, self._options.fresh, self._options.minimal
        try:
            request = job_request(kind, question.image, question.question, question.options, None, fresh, minimal)
        except OSError as error:
            raise ImageUnreadable(f"'{question.image}' cannot be read: {error.strerror or error}.") from error
        if self._journal is None:
            return request
        return replace(request, key=self._journal.key(question, request.content, fresh=fresh))

    def _keep(self, outcome: Outcome[Any]) -> None:
        if self._journal is not None:
            saved = self._options.save and outcome.succeeded
            folder = {"folder": f"items/{outcome.question.folder}"} if saved else {}
            self._journal.append(outcome.question, {**outcome.line(), **folder})

    def _waiting_for(self, error: CowError | None) -> None:
        note = "" if error is None else f"waiting for the server ({error.code})"
        if note != self._progress.note:
            self._progress.note = note
            self._show()
