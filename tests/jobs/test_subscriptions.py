"""Following a job: the database is read once for all who do."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any

import httpx
import pytest
from engines import app_for, running_engine
from servers import BODY, events_of

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


@pytest.mark.parametrize("leaving", [1, FOLLOWERS])
def test_reading_ends_with_the_last_follower(leaving: int) -> None:
    async def leave() -> list[str]:
        active = ActiveJobs()
        tasks = [asyncio.create_task(followed(active, lambda: view(0))) for _ in range(FOLLOWERS)]
        await asyncio.sleep(0.05)
        for task in tasks[:leaving]:
            task.cancel()
        await asyncio.gather(*tasks[:leaving], return_exceptions=True)
        await asyncio.sleep(0.05)
        followed_still = active.awaited()
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        return followed_still

    assert asyncio.run(leave()) == ([] if leaving == FOLLOWERS else ["job"])


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
