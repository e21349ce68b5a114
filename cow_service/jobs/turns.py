"""Whose job comes next: keys take turns, by their weights, and within a key the jobs of higher priority come first.

Start-time fair queuing: a job's turn lies behind those of its key by a step that is the shorter the greater the weight
of the key, and no earlier than the first turn that is open of anybody in the queue.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from cow_service.requests import PRIORITIES, Priority

STEP = 100  # between two jobs of a key of weight 1
LAST = 2**31 - 2  # DBOS' greatest priority number is one more


class Queued(Protocol):
    """An open job, as far as its turn is concerned."""

    @property
    def owner(self) -> str | None:
        """Whose it is."""
        ...

    @property
    def turn(self) -> int:
        """The lower comes first."""
        ...

    @property
    def priority(self) -> Priority:
        """Among the jobs of its owner."""
        ...


def step_of(weight: float) -> int:
    """Between two turns of a key."""
    return max(1, round(STEP / weight))


def below(priority: Priority) -> tuple[Priority, ...]:
    """The priorities that are lower."""
    return PRIORITIES[: PRIORITIES.index(priority)]


def next_turn(jobs: Sequence[Queued], owner: str | None, priority: Priority, step: int) -> int:
    """The turn of an owner's new job among the open jobs of its queue.

    A job of higher priority takes the first turn of the lower ones of its owner: these move back by a step (`moves`),
    so that the share of the key stays what it is.
    """
    lower = below(priority)
    now = min((job.turn for job in jobs), default=0)
    own = [job for job in jobs if job.owner == owner]
    after = max((job.turn + step for job in own if job.priority not in lower), default=0)
    first = min((job.turn for job in own if job.priority in lower), default=0)
    return min(LAST, max(now, after, first))


def moves(job: Queued, owner: str | None, priority: Priority, turn: int) -> bool:
    """Whether an open job of the queue moves back by a step where a new one takes this turn."""
    return job.owner == owner and job.turn >= turn and job.priority in below(priority)
