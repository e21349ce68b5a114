"""Says in one sentence what happens where something is taken away, and what happens in the scene as it is."""

from __future__ import annotations

from collections.abc import Sequence

from cow_service.readers.question.facts import facts_of, named
from cow_service.records import Trajectory


def facts_of_both(removed: Sequence[str], mover: str, changed: Trajectory, factual: Trajectory) -> str:
    """As in: without the vase, the car slides to the right and meets the mug after 1.2 s; with it, ..."""
    names = " and ".join(named(name, "the") for name in removed)
    pronoun = "it" if len(removed) == 1 else "them"
    return f"Without {names}, {_within(facts_of(mover, changed))}; with {pronoun}, {_within(facts_of(mover, factual))}."


def _within(sentence: str) -> str:
    """A sentence as a part of another one."""
    bare = sentence.rstrip(".")
    return bare[0].lower() + bare[1:]
