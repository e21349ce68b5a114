"""`Client.map`: many questions at the same time, in threads that end with the process."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable, Iterator
from itertools import islice
from queue import SimpleQueue
from typing import Any

from cow_service.client.batches import Batch, Outcome
from cow_service.client.questions import Question
from cow_service.client.steps import Steps, Stopped

END_SECONDS = 0.5  # that threads are given to end before their connections are closed


def outcomes(run: Callable[[Steps[Any], threading.Event], Any], batch: Batch) -> Iterator[Outcome[Any]]:
    """The outcomes, as they come; each is written down before it is yielded.

    `run` performs steps until an event is set. Raises what no question could get past (`OutageTimer`). Whoever stops in
    between leaves jobs on the server which a batch with a journal finds again; without one they are canceled.
    """
    todo: SimpleQueue[Question | None] = SimpleQueue()
    done: SimpleQueue[Outcome[Any] | BaseException] = SimpleQueue()
    stop = threading.Event()

    def work() -> None:
        """One thread: question after question, until there is none or the batch has ended."""
        try:
            while (question := todo.get()) is not None and not stop.is_set():
                done.put(run(batch.ask(question), stop))
        except Stopped:
            pass
        except BaseException as error:  # noqa: BLE001 - it is raised again in the caller's thread
            done.put(error)

    def hand_out(questions: Iterable[Question]) -> int:
        handed_out = list(questions)
        for question in handed_out:
            todo.put(question)
        return len(handed_out)

    # Daemons: an interrupt must not wait for jobs that take minutes.
    threads = [threading.Thread(target=work, daemon=True) for _ in range(batch.concurrency)]
    for thread in threads:
        thread.start()
    try:
        # Questions are taken here, in the thread of the caller's iterator, and as few as keep the threads busy.
        pending = batch.pending()
        unfinished = hand_out(islice(pending, 2 * batch.concurrency))
        while unfinished:
            outcome = done.get()
            if not isinstance(outcome, Outcome):
                raise outcome
            unfinished += hand_out(islice(pending, 1)) - 1
            yield outcome
    finally:
        stop.set()
        for _ in threads:
            todo.put(None)
        until = time.monotonic() + END_SECONDS
        for thread in threads:
            thread.join(max(0.0, until - time.monotonic()))
