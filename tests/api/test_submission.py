"""Requests before they are jobs: whose body is read next."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable

import pytest
from waiting import TIME_LIMIT, eventually_async

from cow_service.api.submission import FairThreads


def test_threads_are_shared_by_owner() -> None:
    began: list[str] = []
    release = threading.Semaphore(0)

    def work(owner: str) -> Callable[[], None]:
        def read() -> None:
            began.append(owner)
            assert release.acquire(timeout=TIME_LIMIT)

        return read

    async def have_begun(count: int) -> None:
        async def look() -> bool:
            return len(began) == count

        await eventually_async(look)

    async def callers() -> None:
        threads = FairThreads(4)
        flood = [asyncio.create_task(threads.run("busy", work("busy"))) for _ in range(8)]
        await have_begun(3)
        quiet = [asyncio.create_task(threads.run("quiet", work("quiet"))) for _ in range(2)]
        await have_begun(4)
        assert began[3] == "quiet", "a thread is left for it, whoever came first"
        flood.pop().cancel()  # one that waits
        release.release()
        await have_begun(5)
        assert began[4] == "quiet", "it has the fewest"
        for _ in range(8):
            release.release()
        await asyncio.gather(*flood, *quiet)
        assert sorted(began) == ["busy"] * 7 + ["quiet"] * 2

    asyncio.run(callers())


def test_without_keys_all_threads_are_everybodys_and_errors_free_them() -> None:
    async def callers() -> None:
        threads, barrier = FairThreads(4), threading.Barrier(4, timeout=TIME_LIMIT)
        await asyncio.gather(*(threads.run(None, barrier.wait) for _ in range(4)))
        for _ in range(5):
            with pytest.raises(ZeroDivisionError):
                await threads.run(None, lambda: 1 // 0)
        assert await threads.run(None, lambda: 7) == 7

    asyncio.run(callers())
