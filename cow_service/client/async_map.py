"""`AsyncClient.map`: many questions at the same time, as tasks of one event loop."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncGenerator, Callable, Iterable
from contextlib import aclosing, suppress

from cow_service.client import calls
from cow_service.client.async_connection import AsyncConnection
from cow_service.client.batches import Batch, Outcome, Patience, Plan, outcome_from, outcome_of
from cow_service.client.errors import WaitTimeout
from cow_service.client.questions import Question
from cow_service.client.results import AsyncAnswer, AsyncSimulation, async_result_from
from cow_service.errors import CowError

Result = AsyncSimulation | AsyncAnswer


async def mapped(connection: AsyncConnection, begin: Callable[[], Batch]) -> AsyncGenerator[Outcome[Result]]:
    """The outcomes of a batch as they come, then those of before."""
    with begin() as batch:
        kind = batch.plan.kind
        async with aclosing(_asked(connection, batch.todo(), batch.plan, batch.patience())) as outcomes:
            async for outcome in outcomes:
                batch.count(outcome)
                yield outcome
        for question, line in batch.earlier():
            yield outcome_from(question, line, lambda body: async_result_from(kind, body, connection.artifact))


async def _asked(
    connection: AsyncConnection, questions: Iterable[Question], plan: Plan, patience: Patience
) -> AsyncGenerator[Outcome[Result]]:
    """The outcomes, as they come; each is written down before it is handed out. See `sync_map`."""
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
        result, failed = None, None
        try:
            order = await asyncio.to_thread(plan.order, question)  # files are read, pictures encoded
            result = await connection.done(
                order, plan.timeout, progress=False, keep=plan.keeps, hear=lambda _: patience.hear()
            )
            folder = plan.folder(question)
            if folder is not None:
                await result.save(folder)
        except CowError as error:
            failed = error
            if isinstance(error, WaitTimeout):
                with suppress(CowError):
                    await connection.run(calls.canceled(error.job_id, connection.retries))
        pause = None if failed is None else patience.pause_after(failed)
        if pause is None:
            patience.hear()
            return outcome_of(question, result, failed, time.monotonic() - began)
        await asyncio.sleep(pause)
