"""Turns: as many as there are, the lowest rank first, and none is lost."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

import pytest

from cow_service.concurrency import Turns


class GoneError(Exception):
    """Somebody who waits is not wanted any more."""


def waiting(turns: Turns, rank: str, order: list[str]) -> threading.Thread:
    def work() -> None:
        with turns.held(rank):
            order.append(rank)

    thread = threading.Thread(target=work)
    thread.start()
    return thread


def settle(turns: Turns, many: int) -> None:
    while len(turns._waiting) < many:
        time.sleep(0.001)


def test_the_lowest_rank_comes_first_and_ties_in_their_order() -> None:
    turns, order = Turns(1), []
    turns.take()
    threads = []
    for place, rank in enumerate(("c", "a", "b", "a")):
        threads.append(waiting(turns, rank, order))
        settle(turns, place + 1)
    turns.give()
    for thread in threads:
        thread.join(5)
    assert order == ["a", "a", "b", "c"]


def test_who_comes_later_takes_no_turn_that_was_promised() -> None:
    turns, order = Turns(1), []
    turns.take("z")
    thread = waiting(turns, "m", order)
    settle(turns, 1)
    with turns.left("z"):  # the one who waits has it now
        thread.join(5)
        assert order == ["m"]
    turns.give()


def test_a_wait_that_ends_leaves_its_turn_to_others() -> None:
    turns = Turns(1)
    turns.take()

    def gone() -> None:
        raise GoneError

    with pytest.raises(GoneError):
        turns.take("a", gone)
    turns.give()
    turns.take("b")
    turns.give()


@pytest.mark.parametrize("at_once", [1, 3])
def test_never_more_than_there_are(at_once: int) -> None:
    turns, lock, here, most = Turns(at_once), threading.Lock(), 0, 0

    def counted(change: int) -> None:
        nonlocal here, most
        with lock:
            here += change
            most = max(most, here)

    def work(rank: str) -> None:
        for _ in range(30):
            with turns.held(rank):
                counted(1)
                time.sleep(0.0002)
                counted(-1)
                with turns.left(rank):
                    time.sleep(0.0001)

    run: Callable[[str], threading.Thread] = lambda rank: threading.Thread(target=work, args=(rank,))  # noqa: E731
    threads = [run(str(i)) for i in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(20)
    assert here == 0
    assert 1 <= most <= at_once
    assert turns._free == at_once
