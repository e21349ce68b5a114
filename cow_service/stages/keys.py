"""What decides a stage's result: the table from which the key of each stored result is made.

A result is decided by the image, the results of the stages before it, the fields of the request in the table, and the
backend that does the work. Two runs with the same key come to the same result.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

from pydantic import BaseModel

from cow_service import __version__
from cow_service.records import Record, Simulation
from cow_service.requests import SimulateRequest, Stage
from cow_service.stages.results import digest_of

Backend = Literal["reader", "generator"]
FORMAT = 2  # of stored results; raised where what a stage means or stores changes


@dataclass(frozen=True)
class DecidedBy:
    """Names of what decides one stage, all of them attributes of the request."""

    fields: tuple[str, ...]
    backend: Backend | None = None
    given: tuple[str, ...] = ()  # where the request sets one of these, they decide alone: nobody is asked


READING = ("question", "seed", "left_to_reader")
TRACED = ("place", "motion", "trajectory", "question", "num_frames", "fps")
DECIDED_BY: dict[Stage, DecidedBy] = {
    "grounding": DecidedBy(READING, "reader", given=("place",)),
    "motion": DecidedBy(READING, "reader", given=("motion", "trajectory")),
    "trajectory": DecidedBy(TRACED),
    "generation": DecidedBy((*TRACED, "seed", "frames", "video"), "generator"),
    "answering": DecidedBy((*READING, "options", "votes", "baseline", "imagine"), "reader"),
}
# Of a simulation its id and times do not decide an answer.
_SEEN = {"grounding", "motion", "trajectory", "frames"}


def key_of(
    stage: Stage,
    image_sha256: str,
    request: SimulateRequest,
    inputs: tuple[Record | None, ...],
    identity_of: Callable[[Backend], Mapping[str, Any] | None],
) -> str | None:
    """The key (SHA-256, hexadecimal) of a stage's result; None where the backend does not say what decides it.

    `identity_of` a backend is all that decides its work, as JSON values; it is asked only where the table says so.
    """
    decided = DECIDED_BY[stage]
    known: dict[str, Any] = {
        "format": FORMAT,
        "version": __version__,
        "stage": stage,
        "image": image_sha256,
        "inputs": [_digest(value) for value in inputs],
    }
    given = {name: _plain(value) for name in decided.given if (value := getattr(request, name)) is not None}
    if given:
        return digest_of(known | {"given": given})
    known["request"] = {name: _plain(getattr(request, name)) for name in decided.fields}
    if decided.backend is not None:
        identity = identity_of(decided.backend)
        if identity is None:
            return None
        known["backend"] = identity
    return digest_of(known)


def _digest(value: Record | None) -> str | None:
    if isinstance(value, Simulation):
        return digest_of(value.model_dump(mode="json", include=_SEEN))
    return None if value is None else digest_of(value)


def _plain(value: Any) -> Any:
    if isinstance(value, frozenset):
        return sorted(value)
    return value.model_dump(mode="json") if isinstance(value, BaseModel) else value
