"""`Client.map`: many questions at the same time, in threads that end with the process."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import suppress
from itertools import islice
from queue import SimpleQueue

from cow_service.client import calls
from cow_service.client.batches import Batch, Outcome, Patience, Plan, outcome_from, outcome_of
from cow_service.client.errors import WaitTimeout
from cow_service.client.questions import Question
from cow_service.client.results import Answer, Simulation, result_from
from cow_service.client.sync_connection import Connection
from cow_service.errors import CowError
from cow_service.records import Job

Result = Simulation | Answer


class _GivenUp(BaseException):
    """The batch has ended before its question: nobody waits for its job any more."""


def mapped(connection: Connection, begin: Callable[[], Batch]) -> Generator[Outcome[Result]]:
    """The outcomes of a batch as they come, then those of before."""
    with begin() as batch:
        kind = batch.plan.kind
        for outcome in _asked(connection, batch.todo(), batch.plan, batch.patience()):
            batch.count(outcome)
            yield outcome
        for question, line in batch.earlier():
            yield outcome_from(question, line, lambda body: result_from(kind, body, connection.artifact))


def _asked(
    connection: Connection, questions: Iterator[Question], plan: Plan, patience: Patience
) -> Iterator[Outcome[Result]]:
    """The outcomes, as they come; each is written down before it is handed out.

    Raises what no question could get past (`Patience`). Whoever stops in between leaves jobs on the server which a
    batch with a journal finds again; without one they are ended.
    """
    run = _Run(connection, plan, patience)
    # Daemons: an interrupt must not wait for jobs that take minutes.
    threads = [threading.Thread(target=run.work, daemon=True) for _ in range(plan.concurrency)]
    for thread in threads:
        thread.start()
    try:
        # Questions are taken here, where the caller's iterator lives, and as few as keep the threads busy.
        at_work = run.feed(islice(questions, 2 * plan.concurrency))
        while at_work:
            came = run.came.get()
            if not isinstance(came, Outcome):
                raise came
            at_work += run.feed(islice(questions, 1)) - 1
            yield came
    finally:
        run.stop.set()
        for _ in threads:
            run.todo.put(None)


class _Run:
    """What the threads of one batch share."""

    def __init__(self, connection: Connection, plan: Plan, patience: Patience) -> None:
        self.todo: SimpleQueue[Question | None] = SimpleQueue()
        self.came: SimpleQueue[Outcome[Result] | BaseException] = SimpleQueue()
        self.stop = threading.Event()
        self._connection, self._plan, self._patience = connection, plan, patience

    def feed(self, questions: Iterable[Question]) -> int:
        """Hands questions to whichever threads are free; returns how many they are."""
        handed = list(questions)
        for question in handed:
            self.todo.put(question)
        return len(handed)

    def work(self) -> None:
        """One thread: question after question, until there is none or the batch is given up."""
        try:
            while (question := self.todo.get()) is not None and not self.stop.is_set():
                outcome = self._outcome(question)
                if outcome is None:
                    break
                self._plan.keep(outcome)
                self.came.put(outcome)
        except _GivenUp:
            pass
        except BaseException as error:  # noqa: BLE001 - it is raised again, where the outcomes are taken
            self.came.put(error)

    def _outcome(self, question: Question) -> Outcome[Result] | None:
        began = time.monotonic()
        while not self.stop.is_set():
            result, failed = None, None
            try:
                order = self._plan.order(question)
                result = self._connection.done(
                    order, self._plan.timeout, progress=False, keep=self._plan.keeps, hear=self._hear
                )
                folder = self._plan.folder(question)
                if folder is not None:
                    result.save(folder)
            except CowError as error:
                failed = error
                if isinstance(error, WaitTimeout):
                    with suppress(CowError):
                        self._connection.run(calls.canceled(error.job_id, self._connection.retries))
            pause = None if failed is None else self._patience.pause_after(failed)
            if pause is None:
                self._patience.hear()
                return outcome_of(question, result, failed, time.monotonic() - began)
            self.stop.wait(pause)
        return None

    def _hear(self, _: Job) -> None:
        self._patience.hear()
        if self.stop.is_set():
            raise _GivenUp
