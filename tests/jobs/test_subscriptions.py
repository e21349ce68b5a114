"""Following a job: the database is read once for all who do."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any

import httpx
import pytest
from engines import app_for, running_engine
from servers import BODY, events_of
from waiting import eventually_async

from cow_service.errors import StorageUnavailable
from cow_service.jobs.active import ActiveJobs
from cow_service.jobs.job_table import JobState
from cow_service.jobs.subscriptions import JobEvent, JobView, subscribed
from cow_service.records import Job
from cow_service.service import Service

LAST, FOLLOWERS = 5, 40
FOUND = JobState(Job(id="job", kind="simulate", status="running", progress=0, created_at="", generator="cutout"), None)


@pytest.fixture(autouse=True)
def polls_often(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("cow_service.jobs.subscriptions.POLL_SECONDS", 0.01)


def view(number: int) -> JobView:
    return JobView(None if number >= LAST else FOUND, (JobEvent("stage", number, None),))


async def followed(active: ActiveJobs, read: Callable[[], JobView]) -> list[int]:
    heard, number = [], 0
    with subscribed(active, "job", read) as subscription:
        while not heard or heard[-1] < LAST:
            found, number = await subscription.after(number)
            heard.append(found.events[0].number)
    return heard


def test_all_followers_hear_what_is_read_once() -> None:
    reads = []

    def read() -> JobView:
        reads.append(len(reads))
        return view(min(reads[-1] // 2, LAST))  # the same twice is no news

    async def all_of_them() -> list[list[int]]:
        active = ActiveJobs()
        first = await asyncio.gather(*(followed(active, read) for _ in range(FOLLOWERS)))
        assert active.awaited() == []
        return [*first, await followed(active, read)]

    *heard, later = asyncio.run(all_of_them())
    assert all(each == sorted(set(each)) and each[-1] == LAST for each in heard)
    assert later == [LAST], "who comes after the end reads anew"
    assert len(reads) == 2 * LAST + 2


def test_what_reading_raises_reaches_all() -> None:
    def read() -> JobView:
        raise StorageUnavailable("away")

    async def all_of_them() -> list[object]:
        active = ActiveJobs()
        return await asyncio.gather(*(followed(active, read) for _ in range(FOLLOWERS)), return_exceptions=True)

    assert {type(each) for each in asyncio.run(all_of_them())} == {StorageUnavailable}


def test_reading_ends_with_the_last_follower() -> None:
    reads = [0]

    def read() -> JobView:
        reads[0] += 1
        return view(0)

    async def leave() -> None:
        active = ActiveJobs()

        async def is_followed(followed: bool, beyond: int = 0) -> None:
            async def look() -> bool:
                return active.awaited() == (["job"] if followed else []) and reads[0] >= beyond

            await eventually_async(look)

        tasks = [asyncio.create_task(followed(active, read)) for _ in range(FOLLOWERS)]
        await is_followed(True)
        tasks[0].cancel()
        await asyncio.gather(tasks[0], return_exceptions=True)
        await is_followed(True, reads[0] + 3)  # it goes on
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        await is_followed(False)

    asyncio.run(leave())


def test_a_job_that_is_deleted_while_someone_begins_to_follow_it(
    service: Service, monkeypatch: pytest.MonkeyPatch
) -> None:
    app, engine = app_for(service), running_engine()
    find = engine.find

    async def follow() -> httpx.Response:
        transport = httpx.ASGITransport(app)
        async with httpx.AsyncClient(transport=transport, base_url="http://cow") as client:
            job = (await client.post("/simulate", json=BODY, headers={"Prefer": "respond-async"})).json()["id"]

            def find_and_delete(*arguments: Any, **more: Any) -> Any:
                monkeypatch.setattr(engine, "find", find)
                found = find(*arguments, **more)
                engine.delete(job, None)
                return found

            monkeypatch.setattr(engine, "find", find_and_delete)
            return await client.get(f"/jobs/{job}/events")

    response = asyncio.run(follow())
    assert (response.status_code, [event["event"] for event in events_of(response)]) == (200, ["deleted"])
