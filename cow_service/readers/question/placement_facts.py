"""Says what becomes of a thing that is put somewhere."""

from __future__ import annotations

from cow_service.records import Placement, PlacementResult

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
