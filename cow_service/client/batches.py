"""Batches: the outcome of each question, and whether an error is about the question or about the server."""

import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sized
from contextlib import ExitStack
from dataclasses import dataclass, fields, replace
from os import PathLike
from pathlib import Path
from typing import Any, Generic, Literal, Self, TypeVar

from cow_service import records
from cow_service.adaptive import AdaptiveLimit
from cow_service.client import CONCURRENCY, errors, protocol
from cow_service.client.journal import Journal, Question, QuestionLike, questions
from cow_service.client.progress import BatchProgress, describe_load, progress_shown
from cow_service.client.request import JobRequest, job_request

MAX_OUTAGE_SECONDS = 300.0  # without any response, after which a batch ends; it can be resumed
RETRY_SECONDS = 2.0  # before a question is sent again that the server could not accept
# Every other question would meet these, too.
_FATAL = (errors.Unauthorized, errors.OriginNotAllowed, errors.MethodNotAllowed, errors.NotFound)
TRANSIENT = (*protocol.RETRYABLE, errors.ServerUnreachable, errors.StorageUnavailable)

R_co = TypeVar("R_co", bound=records.Simulation | records.Answer, covariant=True)


@dataclass(frozen=True)
class BatchResult(Generic[R_co]):
    """What became of one question: a result, or the error that it failed with."""

    question: Question
    result: R_co | None
    error: errors.CowError | None
    seconds: float
    unsaved: errors.CowError | None = None  # why its pictures were not saved, where they were not

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
        """Its line of `results.jsonl`."""
        line: dict[str, Any] = {"status": self.status, "seconds": round(self.seconds, 3)}
        if (error := self.error) is not None:
            problem = {"code": error.code, **error.as_problem(), "request_id": error.request_id}
            line["problem"] = problem | ({"job_id": error.job_id} if isinstance(error, errors.WaitTimeout) else {})
        if self.unsaved is not None:
            line["unsaved"] = self.unsaved.detail
        if self.result is not None:
            line["result"] = self.result.model_dump(mode="json")
        return line


class OutageTimer:
    """How long a batch waits for a server that accepts nothing. One for all questions; thread-safe."""

    def __init__(
        self, seconds: float = MAX_OUTAGE_SECONDS, on_change: Callable[[errors.CowError | None], None] | None = None
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

    def pause_after(self, error: errors.CowError) -> float | None:
        """Seconds before the question is sent again; None if the error is about the question.

        Raises an error that all questions would meet, or that has lasted for too long.
        """
        proxy = isinstance(error, errors.BadResponse)
        if isinstance(error, _FATAL) or (proxy and 300 <= error.status < 500):
            raise error
        if not (isinstance(error, TRANSIENT) or (proxy and error.status >= 500)):
            self.reset()
            return None
        with self._lock:
            missing = isinstance(error, errors.ServerUnreachable) and not self._ever_answered
            if missing or time.monotonic() - self._last_response > self._seconds:
                raise error
            if self._on_change is not None:
                self._on_change(error)
        return RETRY_SECONDS


@dataclass(frozen=True)
class BatchOptions:
    """How the questions of a batch are asked (`Client.map`). Raises `ValueError` for what does not fit together."""

    concurrency: int = CONCURRENCY
    timeout: float | None = None
    fresh: bool = False
    minimal: bool = False
    out: str | PathLike[str] | None = None
    retry_failed: bool = False
    only_new: bool = False
    save: bool = False
    progress: bool = False

    def __post_init__(self) -> None:
        if self.concurrency < 1:
            raise ValueError(f"concurrency must be at least 1, got {self.concurrency}")
        if self.out is None and (self.retry_failed or self.save):
            raise ValueError("retry_failed and save need `out`, the folder of the batch")


class Batch:
    """One batch: its questions, how each is asked, and its results. A context that holds the folder."""

    def __init__(self, items: Iterable[QuestionLike], kind: records.JobKind, options: Mapping[str, Any]) -> None:
        """`options` has fields of `BatchOptions`; the others are fields of the request for questions without them."""
        own = {field.name for field in fields(BatchOptions)}
        self.options = BatchOptions(**{name: value for name, value in options.items() if name in own})
        self.journal: Journal | None = None
        self.pace = AdaptiveLimit(self.options.concurrency)
        self.outage = OutageTimer(on_change=self._show_outage)
        self._items = items
        self._kind: records.JobKind = kind
        self._defaults = {name: value for name, value in options.items() if name not in own}
        self._known: dict[str, Question] = {}  # questions with an earlier result that is to be yielded, by id
        self._progress = BatchProgress(len(items) if isinstance(items, Sized) else None)
        self._show: Callable[[], None] = lambda: None
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        """Raises what `Journal` raises."""
        options = self.options
        if options.out is not None:
            self.journal = Journal(Path(options.out), self._kind, retry_failed=options.retry_failed)
            self._stack.callback(self.journal.close)
        self._show = self._stack.enter_context(progress_shown(self._progress, options.progress))
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def pending(self) -> Iterator[Question]:
        """The questions without a result yet."""
        for question in questions(self._items, self._defaults):
            if self.journal is None or not self.journal.has(question):
                yield question
            else:
                if not self.options.only_new:
                    self._known[question.id] = question
                self._progress.count(self.journal.done[question.id][1] == "succeeded", earlier=True)

    def request(self, question: Question) -> JobRequest:
        """The request of a question, with a key that a batch which resumes after a kill uses again.

        Raises `ImageUnreadable` if its file cannot be read, and `InvalidRequest` where its image is none.
        """
        fresh, minimal = self.options.fresh, self.options.minimal
        try:
            request = job_request(self._kind, question.image, question.question, question.options, None, fresh, minimal)
        except OSError as error:
            raise errors.ImageUnreadable(f"'{question.image}' cannot be read: {error.strerror or error}.") from error
        if self.journal is None:
            return request
        return replace(request, key=self.journal.key(question, request.content, fresh=fresh))

    def folder_of(self, question: Question) -> Path | None:
        """Where the pictures of a question are saved; None if they are not."""
        if self.journal is None or not self.options.save:
            return None
        return self.journal.folder / "items" / question.folder

    def keep(
        self, question: Question, result: R_co | None, failed: errors.CowError | None, seconds: float
    ) -> BatchResult[R_co]:
        """The result of a question, which is written down; where only its pictures could not be saved, it stands."""
        self.outage.reset()
        error, unsaved = (failed, None) if result is None else (None, failed)
        kept = BatchResult(question, result, error, seconds, unsaved)
        if self.journal is not None:
            folder = {"folder": f"items/{question.folder}"} if self.options.save and kept.succeeded else {}
            self.journal.append(question, {**kept.line(), **folder})
        return kept

    def count(self, result: BatchResult[Any]) -> None:
        """Shows that one more has come."""
        self._progress.count(result.succeeded)
        self._show()

    def wants_load(self) -> bool:
        """Whether to ask the server what its jobs wait for."""
        return self.options.progress and self._progress.is_look_due()

    def show_load(self, workers: records.Workers) -> None:
        """Shows what the server's jobs wait for."""
        self._progress.load = describe_load(workers)

    def earlier_results(self, read: Callable[[records.JobKind, Any], R_co]) -> Iterator[BatchResult[R_co]]:
        """The results of earlier runs, each read from its JSON."""
        for line in self.journal.lines() if self.journal is not None and self._known else ():
            if (question := self._known.get(line["id"])) is None:
                continue
            if line["status"] == "succeeded":
                yield BatchResult(question, read(self._kind, line["result"]), None, line["seconds"])
                continue
            error = errors.error_from(line["problem"])
            error.request_id = line["problem"].get("request_id")
            if isinstance(error, errors.WaitTimeout):
                error.job_id = line["problem"].get("job_id", "")
            yield BatchResult(question, None, error, line["seconds"])

    def _show_outage(self, error: errors.CowError | None) -> None:
        note = "" if error is None else f"waiting for the server ({error.code})"
        if note != self._progress.note:
            self._progress.note = note
            self._show()
