"""What a reply says of how fast, how far and how long: numbers with units."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, cast, get_args

from cow_service.readers.base import Quantity, Unit
from cow_service.readers.mllm.coordinates import NUMBER
from cow_service.readers.mllm.replies import is_none, text_of
from cow_service.readers.mllm.schemas import Schema, nullable, one_of, words
from cow_service.records import Until

MAX_QUANTITY = 40  # characters
_UNITS: dict[str, tuple[Unit, float]] = {
    "px": ("px", 1.0), "pixel": ("px", 1.0), "m": ("m", 1.0), "metre": ("m", 1.0), "meter": ("m", 1.0),
    "cm": ("m", 0.01), "centimetre": ("m", 0.01), "centimeter": ("m", 0.01), "mm": ("m", 0.001), "inch": ("m", 0.0254),
}  # fmt: skip
_SECONDS = {"": 1.0, "s": 1.0, "sec": 1.0, "second": 1.0, "ms": 0.001, "minute": 60.0, "min": 60.0}
_PER_SECOND = re.compile(r"\s*(?:/|per)\s*(?:s|sec|second)$")
_QUANTITY = re.compile(rf"(?P<number>{NUMBER})\s*(?P<unit>[a-z]*)")
LENGTH_FIELDS: dict[str, Schema] = {
    "speed": words(MAX_QUANTITY),
    "distance": words(MAX_QUANTITY),
    "duration": words(MAX_QUANTITY),
    "until": nullable(one_of(*get_args(Until))),
}  # all of them optional


@dataclass(frozen=True)
class Lengths:
    """How fast, how far and how long, as far as the question says it."""

    speed: Quantity | None = None
    distance: Quantity | None = None
    duration: float | None = None  # s
    until: Until | None = None


NOT_SAID = Lengths()


def read_lengths(fields: Mapping[str, Any]) -> Lengths:
    """Numbers with units; what cannot be read is left out."""
    until = text_of(fields.get("until")).lower()
    return Lengths(
        speed=_quantity(fields.get("speed"), per_second=True),
        distance=read_distance(fields.get("distance")),
        duration=read_seconds(fields.get("duration")),
        until=next((known for known in cast("tuple[Until, ...]", get_args(Until)) if known == until), None),
    )


def read_distance(written: object) -> Quantity | None:
    """A length; None where it cannot be read."""
    return _quantity(written, per_second=False)


def _quantity(written: object, per_second: bool) -> Quantity | None:
    text = text_of(written).lower().strip(" .")
    plain = _PER_SECOND.sub("", text)
    found = _QUANTITY.fullmatch(plain)
    if is_none(written) or found is None or (plain != text) != per_second:
        return None
    unit = _UNITS.get(found["unit"]) or _UNITS.get(found["unit"].removesuffix("s"))
    number = float(found["number"])
    if unit is None or not number > 0:
        return None
    name, factor = unit
    speeds: dict[Unit, Unit] = {"px": "px/s", "m": "m/s"}
    return Quantity(number * factor, speeds[name] if per_second else name)


def read_seconds(written: object) -> float | None:
    """A time; None where it cannot be read."""
    found = _QUANTITY.fullmatch(text_of(written).lower().strip(" ."))
    factor = None if found is None else _SECONDS.get(found["unit"], _SECONDS.get(found["unit"].removesuffix("s")))
    seconds = 0.0 if found is None or factor is None else float(found["number"]) * factor
    return seconds if seconds > 0 else None
