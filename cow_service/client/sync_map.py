"""`Client.map`: many questions at the same time, in threads that end with the process."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable, Iterator
from queue import SimpleQueue

from cow_service.client import calls
from cow_service.client.batches import Batch, Outcome, Patience, Plan, outcome_from
from cow_service.client.errors import WaitTimeout
from cow_service.client.questions import Question
from cow_service.client.results import Answer, Simulation, result_from
from cow_service.client.sync_connection import Connection
from cow_service.errors import CowError

Result = Simulation | Answer
LOOK = 0.2  # seconds between looks whether the batch was given up


def mapped(connection: Connection, begin: Callable[[], Batch], *, only_new: bool) -> Iterator[Outcome[Result]]:
    """The outcomes of a batch as they come, then those of before."""
    with begin() as batch:
        kind = batch.plan.kind
        for outcome in _asked(connection, batch.todo(), batch.plan):
            batch.count(outcome)
            yield outcome
        if not only_new:
            for question, line in batch.earlier():
                yield outcome_from(question, line, lambda body: result_from(kind, body, connection.artifact))


def _asked(connection: Connection, questions: Iterable[Question], plan: Plan) -> Iterator[Outcome[Result]]:
    """The outcomes, as they come; each is written down before it is handed out.

    Raises what no question could get past (`Patience`). Whoever stops in between leaves jobs on the server, which a
    batch with a journal finds again.
    """
    run = _Run(connection, iter(questions), plan)
    # Daemons: an interrupt must not wait for jobs that take minutes.
    threads = [threading.Thread(target=run.work, daemon=True) for _ in range(plan.concurrency)]
    for thread in threads:
        thread.start()
    try:
        at_work = len(threads)
        while at_work:
            came = run.came.get()
            if came is None:
                at_work -= 1
            elif isinstance(came, Outcome):
                yield came
                run.room.release()
            else:
                raise came
    finally:
        run.stop.set()


class _Run:
    """What the threads of one batch share."""

    def __init__(self, connection: Connection, questions: Iterator[Question], plan: Plan) -> None:
        self.came: SimpleQueue[Outcome[Result] | BaseException | None] = SimpleQueue()
        self.room = threading.Semaphore(2 * plan.concurrency)  # outcomes that nobody has taken yet fill the memory
        self.stop = threading.Event()
        self._connection, self._questions, self._plan = connection, questions, plan
        self._guard = threading.Lock()
        self._patience = Patience()

    def work(self) -> None:
        """One thread: question after question, until there is none or the batch is given up."""
        try:
            while (question := self._next()) is not None:
                outcome = self._outcome(question)
                if outcome is None:
                    break
                self._plan.keep(outcome)
                self.came.put(outcome)
        except BaseException as error:  # noqa: BLE001 - it is raised again, where the outcomes are taken
            self.came.put(error)
        finally:
            self.came.put(None)

    def _next(self) -> Question | None:
        while not self.room.acquire(timeout=LOOK):
            if self.stop.is_set():
                return None
        with self._guard:
            return None if self.stop.is_set() else next(self._questions, None)

    def _outcome(self, question: Question) -> Outcome[Result] | None:
        began = time.monotonic()
        while not self.stop.is_set():
            try:
                order = self._plan.order(question)
                result = self._connection.done(order, self._plan.timeout, progress=False, keep=self._plan.keeps)
                folder = self._plan.folder(question)
                if folder is not None:
                    result.save(folder)
            except CowError as error:
                if isinstance(error, WaitTimeout):
                    self._connection.run(calls.canceled(error.job_id, self._connection.retries))
                pause = self._patience.pause_after(error)
                if pause is None:
                    return Outcome(question, None, error, time.monotonic() - began)
                self.stop.wait(pause)
            else:
                self._patience.hear()
                return Outcome(question, result, None, time.monotonic() - began)
        return None
