"""Which queue a job waits in, and whose job comes next.

Jobs of light generators share one queue; whatever computes on a device of its own has one of its name, so that no
photograph's frames wait for its clips.

Within a queue keys share by start-time fair queuing, by their weights: a job's turn lies behind those of its key by a
step that is the shorter the greater the weight of the key, and no earlier than the first turn that is open of anybody.
Within a key the jobs of higher priority come first.
"""

from collections.abc import Sequence
from typing import Protocol

from cow_service.requests import PRIORITIES, Priority
from cow_service.settings import Settings
from cow_service.weights.manifests import find_manifest, load_manifests

LIGHT = "light"
STEP = 100  # between two jobs of a key of weight 1
LAST = 2**31 - 2  # the greatest turn


def queue_of(reader: str, generator: str, settings: Settings) -> str:
    """The queue of a job. A reader that computes on a device uses the same for the clips."""
    if places(reader) is not None:
        return reader
    return LIGHT if clips(generator, settings) is None else generator


def clips(generator: str, settings: Settings) -> int | None:
    """Clips at the same time of a generator that has a device or a limit of its own; None if it has none."""
    return settings.generator_concurrency.get(generator, places(generator))


def places(name: str) -> int | None:
    """Jobs at the same time of a backend that has a device of its own, as its manifest says."""
    manifest = find_manifest(name)
    return None if manifest is None else manifest.concurrency


def known_queues(settings: Settings) -> tuple[str, ...]:
    """The light queue, and those of backends that have a device or a limit of their own and can be imported here."""
    with_device = [one for one in load_manifests().values() if one.concurrency is not None]
    here = [one.name for one in with_device if settings.ray is not None or not one.missing_modules()]
    return LIGHT, *dict.fromkeys([*here, *settings.generator_concurrency])


class Queued(Protocol):
    """An open job, as far as its turn is concerned."""

    owner: str | None
    turn: int  # the lower comes first
    priority: Priority  # among the jobs of its owner


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
