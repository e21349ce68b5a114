"""Says what becomes of a thing that is put somewhere."""

from __future__ import annotations

import numpy as np

from cow_service.readers.question.place_relations import PREPOSITIONS
from cow_service.readers.question.wording import bare_name
from cow_service.records import Intervention, PlacedBefore, Placement, PlacementResult, PlaceRelation

SURE = 0.9  # share of the worlds: where something is as it was meant in fewer, a warning says so
HARDLY_SEEN = 0.25  # share of a thing that is seen
_WHERE: dict[PlaceRelation, str] = {"into": "in", "onto": "on"}  # of what is there; else as it is put
_DOES_NOT_STAY: dict[PlacementResult, str] = {
    "overlaps": "there is no room for it, and it overlaps",
    "falls-off": "it does not stay there, but falls off",
    "tips": "it does not stay there: it tips over, or tips over what it is put to",
}
_NOT_AS_MEANT: dict[PlacementResult, str] = {
    "sticks-out": "goes in but sticks out",
    "on-the-rim": "does not go in, but lies on the rim",
}
_ENDS: dict[PlacementResult, str] = {
    "inside": "goes in and stays inside",
    "sticks-out": "goes in but sticks out",
    "on-the-rim": "does not go in and stays on the rim",
    "on-top": "stays on top",
    "beside": "stays there without overlapping",
    "overlaps": "has no room there and overlaps",
    "falls-off": "falls off",
    "tips": "tips over, or tips over what it was put to",
}


def placement_parts(placement: Placement) -> list[str]:
    """The parts of a sentence about it, after its name."""
    end = _ENDS[placement.result]
    if placement.result in ("inside", "sticks-out") and placement.above_rim:
        end = f"{end} with {round(100 * placement.above_rim)}% of its height above the rim"
    return ["is carried over", "is let go", end]


def placement_share(placement: Placement) -> float | None:
    """The share of the worlds with the result that is told; None without an ensemble."""
    return placement.probabilities.get(placement.result, 0.0) if placement.probabilities else None


def place_words(placed: Intervention) -> str:
    """Where something is put, as in: between the bowl and the cone."""
    to = " and ".join(f"the {bare_name(target.object)}" for target in placed.targets)
    return f"{PREPOSITIONS[placed.relation or 'into']} {to}"


def state_words(placed: Intervention) -> str:
    """What is where once it is put there, as in: the white mug next to the blue mug."""
    at = _WHERE.get(placed.relation or "into", "")
    where = place_words(placed)
    return f"the {bare_name(placed.object.object)} {f'{at} {where.split(maxsplit=1)[1]}' if at else where}"


def cannot_stay(placed: PlacedBefore) -> str:
    """Why something cannot be put somewhere, in a sentence."""
    faults: list[PlacementResult] = [result for result in _DOES_NOT_STAY if result in placed.probabilities]
    result = placed.result
    if result not in _DOES_NOT_STAY:
        result = faults[int(np.argmax([placed.probabilities[fault] for fault in faults]))]
    share = placed.probabilities.get(result)
    sure = "" if share is None else f" ({share:.0%} of the computed worlds)"
    return f"'{placed.object}' cannot be put {placed.place}: {_DOES_NOT_STAY[result]}{sure}."


def doubts_of(placed: PlacedBefore) -> tuple[str, ...]:
    """What is in doubt of something that is put somewhere, in sentences: whether it stays there, and is seen."""
    told, where = list[str](), f"'{placed.object}', put {placed.place},"
    if placed.result in _NOT_AS_MEANT:
        told.append(f"{where} {_NOT_AS_MEANT[placed.result]}.")
    elif placed.fits is not None and placed.fits < SURE:
        told.append(f"{where} is there as it was meant in {placed.fits:.0%} of the computed worlds.")
    if placed.visible < HARDLY_SEEN:
        told.append(f"{where} is hardly to be seen in the frames: others hide it there, or it is outside the image.")
    return tuple(told)
