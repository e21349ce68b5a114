"""Following a job that goes away, and followers that do."""

from __future__ import annotations

import asyncio
from types import SimpleNamespace
from typing import Any

import httpx
import pytest
from engines import app_for, running_engine
from servers import BODY, events_of
from waiting import eventually_async

from cow_service.jobs.active import ActiveJobs
from cow_service.jobs.subscriptions import follow
from cow_service.records import Job
from cow_service.service import Service


def test_nobody_waits_for_a_follower_that_left(monkeypatch: pytest.MonkeyPatch) -> None:
    running = Job(id="job", kind="simulate", status="running", progress=0, created_at="", generator="cutout")
    monkeypatch.setattr("cow_service.jobs.subscriptions.state_of", lambda *_: (running, []))
    engine: Any = SimpleNamespace(active=ActiveJobs())

    async def heard() -> None:
        async for _ in follow(engine, "job", 0):
            pass

    async def is_followed() -> bool:
        return engine.active.awaited() == ["job"]

    async def leave() -> None:
        tasks = [asyncio.create_task(heard()) for _ in range(5)]
        await eventually_async(is_followed)
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        assert engine.active.awaited() == []

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
