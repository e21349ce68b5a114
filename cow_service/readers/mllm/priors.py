"""Optional fields of a reply: how large a thing is and on what it stands, how far its motion leads in depth, how fast.

They are estimates: each is a prior with a width. What cannot be is left out with a warning; nothing here fails.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from typing import Any, Literal, TypeVar, cast, get_args

from cow_service.readers.base import SpeedWord
from cow_service.readers.mllm.coordinates import HUGE, NUMBER
from cow_service.readers.mllm.replies import is_none, is_number, text_of
from cow_service.readers.mllm.schemas import Schema, one_of, words
from cow_service.readers.mllm.supports import support_named
from cow_service.records import Estimate, ObjectPrior, Shape

SIZE_DEVIATION = 0.3  # of the size
HEIGHT_DEVIATION = 0.5  # of the height above what a thing stands on
MIN_HEIGHT_DEVIATION = 0.05  # m
HEADING_DEVIATION = 20.0  # degrees of the angle out of the image plane
SPEED_DEVIATION = 0.4  # of the speed's natural logarithm: a word fits speeds half as high again
SIZES = (0.001, 1000.0)  # m: what is smaller or larger is not seen in a picture as one thing
HEIGHTS = (0.0, 1000.0)  # m
MAX_SUPPORT = 60  # characters

CameraSense = Literal["towards", "away"]
SHAPES: tuple[Shape, ...] = get_args(Shape)
SPEEDS: tuple[SpeedWord, ...] = get_args(SpeedWord)
OBJECT_FIELDS: dict[str, Schema] = {
    "size": {"type": "number", "minimum": SIZES[0], "maximum": SIZES[1]},
    "stands_on": words(MAX_SUPPORT),
    "height_above": {"type": "number", "minimum": HEIGHTS[0], "maximum": HEIGHTS[1]},
    "shape": one_of(*SHAPES),
}
MOTION_FIELDS: dict[str, Schema] = {
    "depth_degrees": {"type": "integer", "minimum": -90, "maximum": 90},
    "speed": one_of(*SPEEDS),
}

_METRES = {"": 1.0, "m": 1.0, "metre": 1.0, "meter": 1.0, "cm": 0.01, "mm": 0.001, "km": 1000.0}  # per unit
_LENGTH = re.compile(rf"(?P<number>{NUMBER})\s*(?P<unit>[a-z]*?)s?", re.IGNORECASE)
_SHAPE_WORDS: dict[str, Shape] = {
    "ball": "sphere", "spherical": "sphere", "round": "sphere", "cube": "box", "cuboid": "box", "block": "box",
    "rectangular": "box", "cylindrical": "cylinder", "tube": "cylinder", "conical": "cone", "pyramid": "cone",
}  # fmt: skip
_SPEED_WORDS: dict[str, SpeedWord] = {
    "slowly": "slow", "gentle": "slow", "gently": "slow", "medium": "normal", "moderate": "normal", "average": "normal",
    "quick": "fast", "quickly": "fast", "rapid": "fast", "high": "fast", "low": "slow",
}  # fmt: skip
_SENSES: dict[str, float] = {"towards": -1.0, "toward": -1.0, "away": 1.0}  # `Motion.depth` is positive away
_DEGREES: dict[str, float] = {"slightly": 20.0, "": 45.0, "straight": 90.0, "directly": 90.0}  # that a word stands for
_ACROSS = frozenset({"across", "sideways", "parallel", "lateral", "in the image plane"})
_DEPTH = re.compile(
    rf"(?P<degrees>{NUMBER})?\s*(?:°|deg|degrees?)?\s*(?P<much>slightly|straight|directly)?\s*"
    r"(?P<sense>towards?|away)?(?:\s+from)?(?:\s+(?:the )?(?:camera|viewer))?"
)
T = TypeVar("T")


def read_prior(fields: Mapping[str, Any], name: str, others: Sequence[str]) -> tuple[ObjectPrior | None, list[str]]:
    """What an object's fields say of it, null where they say nothing of use; and warnings of what was left out.

    `name` is the object's, `others` are those of all others: what it stands on may be one of them.
    """
    warnings: list[str] = []

    def kept(field: str, value: T | None, expected: str) -> T | None:
        """The value; where the field holds something that could not be read, a warning instead."""
        if value is None and not _is_open(fields.get(field)):
            warnings.append(_left_out(field, fields[field], expected, f" of '{name}'"))
        return value

    size = kept("size", _length(fields.get("size"), *SIZES), f"a length from {SIZES[0]:g} to {SIZES[1]:g} m")
    height = kept("height_above", _length(fields.get("height_above"), *HEIGHTS), f"a height from 0 to {HEIGHTS[1]:g} m")
    said = text_of(fields.get("stands_on"))[:MAX_SUPPORT]
    support = None if _is_open(said) else support_named(said, name, others)
    prior = ObjectPrior(
        shape=kept("shape", _one_of(fields.get("shape"), SHAPES, _SHAPE_WORDS), f"one of {', '.join(SHAPES)}"),
        size=None if size is None else Estimate(value=size, deviation=SIZE_DEVIATION * size),
        stands_on=kept("stands_on", support, "`floor`, `air` or another object"),
        height=None
        if height is None
        else Estimate(value=height, deviation=max(HEIGHT_DEVIATION * height, MIN_HEIGHT_DEVIATION)),
    )
    return (None if prior == ObjectPrior() else prior), warnings


def read_speed(written: object) -> tuple[SpeedWord | None, list[str]]:
    """The word for a speed, null where there is none; and a warning where it is another."""
    found = _one_of(written, SPEEDS, _SPEED_WORDS)
    if found is None and not _is_open(written):
        return None, [_left_out("speed", written, f"one of {', '.join(SPEEDS)}")]
    return found, []


def read_depth_degrees(written: object, camera: CameraSense | None) -> tuple[float | None, list[str]]:
    """Degrees out of the image plane, -90 (towards the camera) to 90 (away); and a warning where they cannot be.

    `camera` is what the reply says of the sense besides; it gives a number without sign its own.
    """
    if _is_open(written):
        return None, []
    degrees = _degrees(written)
    if degrees is not None and camera == "towards":
        degrees = -abs(degrees)
    if degrees is None or not -90 <= degrees <= 90 or (camera == "away" and degrees < 0):
        expected = (
            f"an angle from -90 (towards the camera) to 90 (away){' that leads away' if camera == 'away' else ''}"
        )
        return None, [_left_out("depth_degrees", written, expected)]
    return degrees, []


def _one_of(written: object, known: Sequence[T], synonyms: Mapping[str, T]) -> T | None:
    """The known word that was written, or of which a synonym was."""
    word = text_of(written).lower().strip(" .")
    return next((each for each in known if each == word), synonyms.get(word))


def _is_open(written: object) -> bool:
    """Whether a field says nothing."""
    return is_none(written) or text_of(written).lower() == "unknown"


def _degrees(written: object) -> float | None:
    if is_number(written):
        return float(written) if abs(written) < HUGE else None  # NaN is not less than anything
    text = text_of(written).lower().strip(" .")
    if text in _ACROSS:
        return 0.0
    found = _DEPTH.fullmatch(text)
    if found is None or not (found["degrees"] or found["sense"]):
        return None
    number = _DEGREES[found["much"] or ""] if found["degrees"] is None else float(found["degrees"])
    return number if found["sense"] is None else _SENSES[found["sense"]] * abs(number)


def _length(written: object, least: float, most: float) -> float | None:
    """Metres, also from text with a unit; None for what is no length within the limits."""
    if is_number(written):
        metres = float(written) if abs(written) < HUGE else math.nan
    else:
        found = _LENGTH.fullmatch(text_of(written))
        factor = _METRES.get(found["unit"].lower()) if found else None
        metres = math.nan if found is None or factor is None else float(found["number"]) * factor
    return metres if least <= metres <= most else None


def _left_out(field: str, written: object, expected: str, owner: str = "") -> str:
    value = " ".join(str(cast("Any", written)).split())[:40]
    return f"The reader's `{field}`{owner} was left out: '{value}' is not {expected}."
