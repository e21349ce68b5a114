"""Says in one sentence what happens where something is changed first, and what happens in the scene as it is."""

from __future__ import annotations

from collections.abc import Sequence

from cow_service.readers.question.facts import facts_of, named
from cow_service.readers.question.placement_facts import state_words
from cow_service.records import Intervention, Trajectory


def facts_of_both(changes: Sequence[Intervention], mover: str, changed: Trajectory, factual: Trajectory) -> str:
    """As in: without the vase, the car slides to the right and meets the mug after 1.2 s; with it, ...

    Or: with the cup next to the mug, the car slides to the right; without that change, ...
    """
    removed = [named(each.object.object, "the") for each in changes if each.kind == "remove"]
    placed = [state_words(each) for each in changes if each.kind == "place"]
    without = [f"without {' and '.join(removed)}"] if removed else []
    given = " and ".join([*without, *([f"with {' and '.join(placed)}"] if placed else [])])
    if placed:
        back = "without that change" if len(changes) == 1 else "without these changes"
    else:
        back = "with it" if len(removed) == 1 else "with them"
    told, otherwise = _within(facts_of(mover, changed)), _within(facts_of(mover, factual))
    return f"{given[0].upper()}{given[1:]}, {told}; {back}, {otherwise}."


def _within(sentence: str) -> str:
    """A sentence as a part of another one."""
    bare = sentence.rstrip(".")
    return bare[0].lower() + bare[1:]
