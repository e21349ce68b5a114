"""`AsyncClient.map`: many questions at the same time, as tasks of one event loop."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator, Callable, Iterable

from cow_service.client import calls
from cow_service.client.async_connection import AsyncConnection
from cow_service.client.batches import Batch, Outcome, Patience, Plan, outcome_from
from cow_service.client.errors import WaitTimeout
from cow_service.client.questions import Question
from cow_service.client.results import AsyncAnswer, AsyncSimulation, async_result_from
from cow_service.errors import CowError

Result = AsyncSimulation | AsyncAnswer


async def mapped(
    connection: AsyncConnection, begin: Callable[[], Batch], *, only_new: bool
) -> AsyncIterator[Outcome[Result]]:
    """The outcomes of a batch as they come, then those of before."""
    with begin() as batch:
        kind = batch.plan.kind
        async for outcome in _asked(connection, batch.todo(), batch.plan):
            batch.count(outcome)
            yield outcome
        if not only_new:
            for question, line in batch.earlier():
                yield outcome_from(question, line, lambda body: async_result_from(kind, body, connection.artifact))


async def _asked(
    connection: AsyncConnection, questions: Iterable[Question], plan: Plan
) -> AsyncIterator[Outcome[Result]]:
    """The outcomes, as they come; each is written down before it is handed out. See `sync_map`."""
    patience = Patience()
    waiting = iter(questions)
    tasks: set[asyncio.Task[Outcome[Result]]] = set()
    try:
        while True:
            while len(tasks) < plan.concurrency and (question := next(waiting, None)) is not None:
                tasks.add(asyncio.create_task(_kept(connection, question, plan, patience)))
            if not tasks:
                return
            done, tasks = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
            for task in done:
                yield task.result()
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


async def _kept(connection: AsyncConnection, question: Question, plan: Plan, patience: Patience) -> Outcome[Result]:
    outcome = await _outcome(connection, question, plan, patience)
    plan.keep(outcome)
    return outcome


async def _outcome(connection: AsyncConnection, question: Question, plan: Plan, patience: Patience) -> Outcome[Result]:
    began = time.monotonic()
    while True:
        try:
            order = plan.order(question)
            result = await connection.done(order, plan.timeout, progress=False, keep=plan.keeps)
            folder = plan.folder(question)
            if folder is not None:
                await result.save(folder)
        except CowError as error:
            if isinstance(error, WaitTimeout):
                await connection.run(calls.canceled(error.job_id, connection.retries))
            pause = patience.pause_after(error)
            if pause is None:
                return Outcome(question, None, error, time.monotonic() - began)
            await asyncio.sleep(pause)
        else:
            patience.hear()
            return Outcome(question, result, None, time.monotonic() - began)
