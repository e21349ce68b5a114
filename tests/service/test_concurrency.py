"""The priority semaphore: never more holders than permits, lowest priority first, no permit lost. Cores and rest."""

from __future__ import annotations

import os
import sys
import threading
import time
from contextlib import ExitStack, suppress
from types import SimpleNamespace

import psutil
import pytest
from waiting import eventually

from cow_service.concurrency import PrioritySemaphore, on_one_core
from cow_service.settings import WORKER_BYTES, usable_cores


class CanceledError(Exception):
    """A wait was canceled."""


def waiting(semaphore: PrioritySemaphore, priority: str, order: list[str]) -> threading.Thread:
    def work() -> None:
        with semaphore.held(priority):
            order.append(priority)

    thread = threading.Thread(target=work)
    thread.start()
    return thread


def take(semaphore: PrioritySemaphore, priority: str = "", weight: int = 1) -> ExitStack:
    """Permits, held until the stack is closed."""
    stack = ExitStack()
    stack.enter_context(semaphore.held(priority, weight=weight))
    return stack


def until_waiting(semaphore: PrioritySemaphore, count: int) -> None:
    eventually(lambda: semaphore.waiting == count)


def test_the_lowest_priority_comes_first_and_ties_in_their_order() -> None:
    semaphore, order = PrioritySemaphore(1), []
    held = take(semaphore)
    threads = []
    for place, priority in enumerate(("c", "a", "b", "a")):
        threads.append(waiting(semaphore, priority, order))
        until_waiting(semaphore, place + 1)
    held.close()
    for thread in threads:
        thread.join()
    assert order == ["a", "a", "b", "c"]


def test_a_released_permit_goes_to_a_waiter_and_not_to_a_later_thread() -> None:
    semaphore, order = PrioritySemaphore(1), []
    held = take(semaphore, "z")
    thread = waiting(semaphore, "m", order)
    until_waiting(semaphore, 1)
    held.close()
    with semaphore.held("a"):  # asked later: "m" was granted the permit already
        assert order == ["m"]
    thread.join()


def test_a_canceled_wait_leaves_its_permit_to_others(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also of who was canceled just before the permit came, and has not looked since."""
    semaphore, canceled, began = PrioritySemaphore(1), threading.Event(), threading.Event()
    held = take(semaphore)

    def check() -> None:
        if canceled.is_set():
            raise CanceledError

    def work() -> None:
        with suppress(CanceledError), semaphore.held("a", check):
            began.set()

    for seconds in (0.01, 60.0):
        monkeypatch.setattr("cow_service.concurrency.CANCEL_POLL_SECONDS", seconds)
        canceled.clear()
        thread = threading.Thread(target=work)
        thread.start()
        until_waiting(semaphore, 1)
        canceled.set()
        if seconds < 1:
            thread.join()
        held.close()
        thread.join()
        assert not began.is_set()
        held = take(semaphore, "b")


def test_who_waits_for_many_permits_is_passed_for_a_while(monkeypatch: pytest.MonkeyPatch) -> None:
    semaphore, order = PrioritySemaphore(3), []
    held = take(semaphore)

    def heavy() -> None:
        with semaphore.held("a", weight=99):  # more than there are: it takes all
            order.append("a")

    thread = threading.Thread(target=heavy)
    thread.start()
    until_waiting(semaphore, 1)
    waiting(semaphore, "b", order).join()
    assert order == ["b"], "what fits beside the other one does not wait"
    monkeypatch.setattr("cow_service.concurrency.PASSED_SECONDS", 0.0)
    last = waiting(semaphore, "c", order)
    until_waiting(semaphore, 2)
    held.close()
    for each in (thread, last):
        each.join()
    assert order == ["b", "a", "c"]
    take(semaphore, weight=3)  # no permit is lost


@pytest.mark.parametrize("permits", [1, 3])
def test_never_more_holders_than_permits(permits: int) -> None:
    semaphore, lock, holders, most = PrioritySemaphore(permits), threading.Lock(), 0, 0

    def counted(change: int) -> None:
        nonlocal holders, most
        with lock:
            holders += change
            most = max(most, holders)

    def work(priority: str) -> None:
        for _ in range(30):
            with semaphore.held(priority):
                counted(1)
                time.sleep(0.0002)
                counted(-1)

    threads = [threading.Thread(target=work, args=(str(i),)) for i in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert holders == 0
    assert 1 <= most <= permits
    held = [take(semaphore) for _ in range(permits)]  # none was lost
    last = waiting(semaphore, "a", [])
    until_waiting(semaphore, 1)  # none was made
    held[0].close()
    last.join()


@pytest.mark.skipif(sys.platform != "linux", reason="cores are chosen on Linux alone")
def test_a_thread_is_kept_on_one_core_for_a_while() -> None:
    cores, started = os.sched_getaffinity(0), list[set[int]]()
    with suppress(CanceledError), on_one_core():
        assert len(os.sched_getaffinity(0)) == 1
        thread = threading.Thread(target=lambda: started.append(os.sched_getaffinity(0)))
        thread.start()
        thread.join()
        assert started == [os.sched_getaffinity(0)]
        raise CanceledError
    assert os.sched_getaffinity(0) == cores


@pytest.mark.skipif(sys.platform != "linux", reason="cores are counted by what Linux says")
@pytest.mark.parametrize(("cores", "workers_in_memory", "expected"), [(4, 100, 4), (16, 3, 3), (2, 0, 1)])
def test_there_are_as_many_workers_as_cores_where_memory_allows(
    cores: int, workers_in_memory: int, expected: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    memory = SimpleNamespace(total=2 * WORKER_BYTES * workers_in_memory + 1)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(cores)))
    monkeypatch.setattr(psutil, "virtual_memory", lambda: memory)
    told = {"/sys/fs/cgroup/cpu.max": "max 100000", "/sys/fs/cgroup/memory.max": "max"}
    monkeypatch.setattr("cow_service.settings.Path.read_text", lambda path: told[str(path)])
    assert usable_cores() == expected
    told["/sys/fs/cgroup/cpu.max"] = "150000 100000"  # of a container
    assert usable_cores() == min(expected, 2)
    told["/sys/fs/cgroup/memory.max"] = f"{2 * WORKER_BYTES:.0f}"
    assert usable_cores() == 1
