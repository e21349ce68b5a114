"""Following a job: the database is read once for all who do."""

from __future__ import annotations

import asyncio

import pytest

from cow_service.errors import StorageUnavailable
from cow_service.jobs.active import ActiveJobs
from cow_service.jobs.watches import Watches

LAST, FOLLOWERS = 5, 40


async def followed(watches: Watches[int], active: ActiveJobs, read) -> list[int]:
    heard, number = [], 0
    with watches.following(active, "job", read, lambda news: news >= LAST) as watch:
        while not heard or heard[-1] < LAST:
            news, number = await watch.after(number)
            heard.append(news)
    return heard


def test_all_followers_hear_what_is_read_once() -> None:
    reads = []

    def read() -> int:
        reads.append(len(reads))
        return min(reads[-1] // 2, LAST)  # the same twice is no news

    async def all_of_them() -> list[list[int]]:
        watches, active = Watches[int](0.01), ActiveJobs()
        first = await asyncio.gather(*(followed(watches, active, read) for _ in range(FOLLOWERS)))
        assert active.awaited() == []
        return [*first, await followed(watches, active, read)]

    *heard, later = asyncio.run(all_of_them())
    assert all(each == sorted(set(each)) and each[-1] == LAST for each in heard)
    assert later == [LAST], "who comes after the end reads anew"
    assert len(reads) == 2 * LAST + 2


def test_what_reading_raises_reaches_all() -> None:
    def read() -> int:
        raise StorageUnavailable("away")

    async def all_of_them() -> list[object]:
        watches, active = Watches[int](0.01), ActiveJobs()
        return await asyncio.gather(
            *(followed(watches, active, read) for _ in range(FOLLOWERS)), return_exceptions=True
        )

    assert {type(each) for each in asyncio.run(all_of_them())} == {StorageUnavailable}


@pytest.mark.parametrize("leaving", [1, FOLLOWERS])
def test_reading_ends_with_the_last_follower(leaving: int) -> None:
    async def leave() -> list[str]:
        watches, active = Watches[int](0.01), ActiveJobs()
        tasks = [asyncio.create_task(followed(watches, active, lambda: 0)) for _ in range(FOLLOWERS)]
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
