"""Many questions: what comes of each, and which errors are about the question and which about the server."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sized
from contextlib import ExitStack
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import Any, Generic, Literal, Self, TypeVar

from cow_service.client.batch_progress import Tally, shown
from cow_service.client.calls import Order, order_of
from cow_service.client.errors import BadResponse, ServerUnreachable, WaitTimeout, error_from
from cow_service.client.journal import Journal
from cow_service.client.questions import Question, QuestionLike, questions
from cow_service.client.results import Answer, AsyncAnswer, AsyncSimulation, Simulation
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

PATIENCE = 300.0  # seconds without any answer after which a batch gives up; it can be resumed
PAUSE = 2.0  # seconds before a question is sent again that the server could not take
CONCURRENCY = 8
_FINAL = (Unauthorized, OriginNotAllowed, MethodNotAllowed, NotFound)  # every other question would meet it, too
PASSING = (ServerUnreachable, ShuttingDown, QueueFull, RateLimited, NotReady, StorageUnavailable, BodyTooSlow)

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


def outcome_of(question: Question, result: R_co | None, failed: CowError | None, seconds: float) -> Outcome[R_co]:
    """The outcome of a question. Where its pictures failed to be saved, its result stands."""
    if result is None:
        return Outcome(question, None, failed, seconds)
    return Outcome(question, result, None, seconds, unsaved=failed)


def outcome_from(question: Question, line: Mapping[str, Any], read: Callable[[dict[str, Any]], R_co]) -> Outcome[R_co]:
    """The outcome that a line of a journal keeps."""
    if line["status"] == "succeeded":
        return Outcome(question, read(line["result"]), None, line["seconds"])
    error = error_from(line["problem"])
    error.request_id = line["problem"].get("request_id")
    if isinstance(error, WaitTimeout):
        error.job_id = line["problem"].get("job_id", "")
    return Outcome(question, None, error, line["seconds"])


class Patience:
    """How long a batch bears a server that takes nothing. One for all questions, safe to use from every thread."""

    def __init__(self, seconds: float = PATIENCE, waiting: Callable[[CowError | None], None] | None = None) -> None:
        """`waiting` is told what the batch waits for, and None when that is over."""
        self._seconds = seconds
        self._waiting = waiting
        self._guard = threading.Lock()
        self._heard = time.monotonic()
        self._answered = False

    def hear(self) -> None:
        """The server has answered."""
        with self._guard:
            self._heard, self._answered = time.monotonic(), True
            if self._waiting is not None:
                self._waiting(None)

    def pause_after(self, error: CowError) -> float | None:
        """Seconds before the question is sent again; None where the error is about the question.

        Raises an error that all questions would meet, or that has lasted for too long.
        """
        proxy = isinstance(error, BadResponse)
        if isinstance(error, _FINAL) or (proxy and 300 <= error.status < 500):
            raise error
        if not (isinstance(error, PASSING) or (proxy and error.status >= 500)):
            self.hear()
            return None
        with self._guard:
            missing = isinstance(error, ServerUnreachable) and not self._answered
            if missing or time.monotonic() - self._heard > self._seconds:
                raise error
            if self._waiting is not None:
                self._waiting(error)
        return PAUSE


@dataclass(frozen=True)
class Plan:
    """How the questions of one batch are asked."""

    kind: JobKind
    concurrency: int
    timeout: float | None
    fresh: bool
    journal: Journal | None
    save: bool

    def order(self, question: Question) -> Order:
        """The question as it is sent, with a key that a batch which goes on after a kill uses again.

        Raises `ImageUnreadable` where its file cannot be read, and `InvalidRequest` where its image is none.
        """
        try:
            order = order_of(self.kind, question.image, question.question, question.options, None, self.fresh)
        except OSError as error:
            raise ImageUnreadable(f"'{question.image}' cannot be read: {error.strerror or error}.") from error
        return (
            order
            if self.journal is None
            else replace(order, key=self.journal.key(question, order.content, fresh=self.fresh))
        )

    def folder(self, question: Question) -> Path | None:
        """Where a question's pictures are saved; None where they are not."""
        return self.journal.folder / "items" / question.folder if self.journal is not None and self.save else None

    @property
    def keeps(self) -> bool:
        """Whether jobs go on that the batch no longer waits for: the next start asks for them."""
        return self.journal is not None

    def keep(self, outcome: Outcome[Any]) -> None:
        """Writes an outcome down."""
        if self.journal is not None:
            folder = {"folder": f"items/{outcome.question.folder}"} if self.save and outcome.succeeded else {}
            self.journal.append(outcome.question, {**outcome.line(), **folder})


class Batch:
    """One batch from its questions to its outcomes, but for the asking. A context that holds the folder."""

    def __init__(
        self,
        plan: Plan,
        items: Iterable[QuestionLike],
        defaults: Mapping[str, Any],
        *,
        progress: bool,
        tells_earlier: bool,
    ) -> None:
        self.plan = plan
        self._tells_earlier = tells_earlier
        self.tally = Tally(len(items) if isinstance(items, Sized) else None)
        self._items, self._defaults, self._progress = items, defaults, progress
        self._known: dict[str, Question] = {}
        self._stack = ExitStack()
        self._tell: Callable[[], None] = lambda: None

    def __enter__(self) -> Self:
        if self.plan.journal is not None:
            self._stack.callback(self.plan.journal.close)
        self._tell = self._stack.enter_context(shown(self.tally, self._progress))
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def todo(self) -> Iterator[Question]:
        """The questions without an outcome yet."""
        journal = self.plan.journal
        for question in questions(self._items, self._defaults):
            if journal is None or not journal.has(question):
                yield question
            else:
                if self._tells_earlier:
                    self._known[question.id] = question
                self.tally.count(journal.done[question.id][1] == "succeeded", before=True)

    def patience(self) -> Patience:
        """A fresh one with the server; the bar tells when it is needed."""

        def wait(error: CowError | None) -> None:
            note = "" if error is None else f"waiting for the server ({error.code})"
            if note != self.tally.note:
                self.tally.note = note
                self._tell()

        return Patience(waiting=wait)

    def count(self, outcome: Outcome[Any]) -> None:
        """One more has come."""
        self.tally.count(outcome.succeeded)
        self._tell()

    def earlier(self) -> Iterator[tuple[Question, dict[str, Any]]]:
        """The questions that had an outcome before, with its line."""
        if self.plan.journal is not None and self._known:
            for line in self.plan.journal.lines():
                if line["id"] in self._known:
                    yield self._known[line["id"]], line


def batch_of(
    items: Iterable[QuestionLike],
    defaults: Mapping[str, Any],
    *,
    kind: JobKind,
    concurrency: int,
    timeout: float | None,
    fresh: bool,
    out: str | PathLike[str] | None,
    retry_failed: bool,
    save: bool,
    progress: bool,
    only_new: bool,
) -> Batch:
    """A batch that is about to begin. Raises `ValueError` for what does not fit together, and what `Journal` raises."""
    if concurrency < 1:
        raise ValueError(f"concurrency must be at least 1, got {concurrency}")
    if out is None and (retry_failed or save):
        raise ValueError("retry_failed and save need `out`, the folder of the batch")
    journal = None if out is None else Journal(Path(out), kind, retry_failed=retry_failed)
    plan = Plan(kind, concurrency, timeout, fresh, journal, save)
    return Batch(plan, items, defaults, progress=progress, tells_earlier=not only_new)
