"""Optional fields of a reply: how large a thing is, what it stands on, how fast, how far and how long it moves.

They are read as leniently as they are written. What cannot be is left out, of estimates with a warning; nothing here
fails.
"""

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal, cast, get_args

from pydantic import PlainValidator, ValidationInfo, WithJsonSchema

from cow_service.readers.base import Quantity, SpeedWord, Unit
from cow_service.readers.mllm.coordinates import HUGE, NUMBER, CoordinateFrame
from cow_service.readers.mllm.replies import Schema, is_none, is_number, number, one_of, text_of, words
from cow_service.records import Shape

SIZE_DEVIATION = 0.3  # of the size
HEIGHT_DEVIATION = 0.5  # of the height above what a thing stands on
MIN_HEIGHT_DEVIATION = 0.05  # m
HEADING_DEVIATION = 20.0  # degrees of the angle out of the image plane
SPEED_DEVIATION = 0.4  # of the speed's natural logarithm: a word fits speeds half as high again
SIZES = (0.001, 1000.0)  # m: what is smaller or larger is not seen in a picture as one thing
HEIGHTS = (0.0, 1000.0)  # m
MAX_SUPPORT = 60  # characters
MAX_QUANTITY = 40  # characters
FLOOR, AIR = "floor", "air"  # what `ObjectPrior.stands_on` calls them

CameraSense = Literal["towards", "away"]
CAMERA: dict[str, CameraSense] = {
    "towards": "towards", "toward": "towards", "towards the camera": "towards", "toward the camera": "towards",
    "away": "away", "away from the camera": "away",
}  # fmt: skip
SHAPES: Mapping[str, Any] = {shape: shape for shape in get_args(Shape)} | {
    "ball": "sphere", "spherical": "sphere", "round": "sphere", "cube": "box", "cuboid": "box", "block": "box",
    "rectangular": "box", "cylindrical": "cylinder", "tube": "cylinder", "conical": "cone", "pyramid": "cone",
}  # fmt: skip
SPEEDS: Mapping[str, Any] = {speed: speed for speed in get_args(SpeedWord)} | {
    "slowly": "slow", "gentle": "slow", "gently": "slow", "medium": "normal", "moderate": "normal", "average": "normal",
    "quick": "fast", "quickly": "fast", "rapid": "fast", "high": "fast", "low": "slow",
}  # fmt: skip
_UNITS = {
    "": ("", 1.0), "px": ("px", 1.0), "pixel": ("px", 1.0), "m": ("m", 1.0), "metre": ("m", 1.0), "meter": ("m", 1.0),
    "cm": ("m", 0.01), "centimetre": ("m", 0.01), "centimeter": ("m", 0.01), "mm": ("m", 0.001), "inch": ("m", 0.0254),
    "km": ("m", 1000.0), "s": ("s", 1.0), "sec": ("s", 1.0), "second": ("s", 1.0), "ms": ("s", 0.001),
    "minute": ("s", 60.0), "min": ("s", 60.0),
}  # fmt: skip
_MEASURED = re.compile(
    rf"(?P<number>{NUMBER})\s*(?P<unit>[a-z]*)(?P<rate>\s*(?:/|per)\s*s(?:ec|econd)?)?", re.IGNORECASE
)
_ACROSS = frozenset({"across", "sideways", "parallel", "lateral", "in the image plane"})
_DEGREES: dict[str, float] = {"slightly": 20.0, "": 45.0, "straight": 90.0, "directly": 90.0}  # that a word stands for
_DEPTH = re.compile(
    rf"(?P<degrees>{NUMBER})?\s*(?:°|deg|degrees?)?\s*(?P<much>slightly|straight|directly)?\s*"
    r"(?P<sense>towards?|away)?(?:\s+from)?(?:\s+(?:the )?(?:camera|viewer))?"
)
# The plane on which the things of a picture stand, be it that of a room, a street or a table.
_FLOOR = frozenset({
    "floor", "ground", "surface", "table top", "tabletop", "table surface", "desk top", "countertop",
    "counter top", "worktop", "ground plane", "ground surface", "floor surface", "flat surface", "road", "street",
    "pavement", "grass", "lawn", "carpet",
    "boden", "fußboden", "fussboden", "erde", "tischplatte", "sol", "plancher", "suelo", "piso", "pavimento", "chão",
    "пол", "земля", "地面", "地板", "桌面", "床面",
})  # fmt: skip
_AIR = frozenset({
    "air", "mid air", "midair", "sky", "space", "thin air", "floating", "flying", "hovering", "suspended", "airborne",
    "luft", "aire", "aria", "ar", "воздух", "воздухе", "空中", "空気", "空气",
})  # fmt: skip
_FUNCTION_WORDS = frozenset({
    "the", "a", "an", "in", "on", "at", "of", "upon",
    "der", "die", "das", "dem", "den", "auf", "le", "la", "les", "l", "sur", "dans", "el", "los", "en", "sobre",
    "il", "lo", "sul", "nell", "o", "no", "на", "в",
})  # fmt: skip
_PARTS = frozenset({"top", "surface", "upper", "edge"})  # of an object that others stand on


@dataclass
class ReadingContext:
    """What validators need besides the reply: whose fields these are, and where warnings and faults go."""

    owner: str = ""  # the object that the fields are of; empty for the motion
    others: Sequence[str] = ()  # names of all other objects
    warnings: list[str] = field(default_factory=list[str])
    faults: list[str] = field(default_factory=list[str])  # parts that are asked for again once, then left out

    @property
    def left_out(self) -> tuple[str, ...]:
        """Warnings of all that is left out."""
        again = "The reader was asked again for a part of its reply, which then was left out"
        return (*self.warnings, *(f"{again}: {fault}." for fault in self.faults))


@dataclass
class PlacesContext(ReadingContext):
    """With the image whose coordinates are read."""

    frame: CoordinateFrame = field(kw_only=True)


def context_of(info: ValidationInfo) -> ReadingContext:
    """The context with which a reply is read."""
    return cast("ReadingContext", info.context)


def frame_of(info: ValidationInfo) -> CoordinateFrame:
    """The image whose coordinates are read."""
    return cast("PlacesContext", info.context).frame


def estimate(expected: str, schema: Schema, read: Callable[[object, ValidationInfo], object]) -> tuple[Any, Any]:
    """The annotations of an optional field. What is there and cannot be read is left out with a warning."""

    def validated(written: object, info: ValidationInfo) -> object:
        value = None if _is_open(written) else read(written, info)
        if value is None and not _is_open(written):
            context = context_of(info)
            owner = f" of '{context.owner}'" if context.owner else ""
            shown = " ".join(str(written).split())[:40]
            context.warnings.append(
                f"The reader's `{info.field_name}`{owner} was left out: '{shown}' is not {expected}."
            )
        return value

    return PlainValidator(validated), WithJsonSchema(schema)


def word(known: Mapping[str, Any]) -> tuple[Any, Any]:
    """The annotations of one of some words; the values of `known` are the words, its keys their synonyms, too."""
    words_known = tuple(dict.fromkeys(known.values()))
    return estimate(
        f"one of {', '.join(words_known)}",
        one_of(*words_known),
        lambda written, _: known.get(text_of(written).lower().strip(" .")),
    )


def _metres(what: str, least: float, most: float) -> tuple[Any, Any]:
    def read(written: object, _: ValidationInfo) -> float | None:
        metres = metres_of(written)
        return metres if metres is not None and least <= metres <= most else None

    return estimate(f"a {what} from {least:g} to {most:g} m", number(least, most), read)


def _depth_degrees(written: object, info: ValidationInfo) -> float | None:
    """Degrees out of the image plane, -90 (towards the camera) to 90 (away).

    What the reply says of the sense besides gives a number without sign its own; it cannot turn one round.
    """
    text, camera = text_of(written).lower().strip(" ."), info.data.get("camera")
    found = _DEPTH.fullmatch(text)
    if is_number(written):
        degrees = float(written) if abs(written) < HUGE else math.nan
    elif text in _ACROSS:
        degrees = 0.0
    elif found is not None and (found["degrees"] or found["sense"]):
        degrees = _DEGREES[found["much"] or ""] if found["degrees"] is None else float(found["degrees"])
        if found["sense"] is not None:
            degrees = abs(degrees) if found["sense"] == "away" else -abs(degrees)
    else:
        return None
    if not -90 <= degrees <= 90 or (camera == "away" and degrees < 0):
        return None
    return -abs(degrees) if camera == "towards" else degrees


Size = Annotated[float | None, *_metres("length", *SIZES)]
Height = Annotated[float | None, *_metres("height", *HEIGHTS)]
Support = Annotated[
    str | None,
    *estimate(
        "`floor`, `air` or another object",
        words(MAX_SUPPORT),
        lambda written, info: support_named(
            text_of(written)[:MAX_SUPPORT], context_of(info).owner, context_of(info).others
        ),
    ),
]
KnownShape = Annotated[Shape | None, *word(SHAPES)]
KnownSpeed = Annotated[SpeedWord | None, *word(SPEEDS)]
DepthDegrees = Annotated[
    float | None,
    *estimate("an angle from -90 (towards the camera) to 90 (away)", number(-90, 90, "integer"), _depth_degrees),
]


def measured(written: object) -> tuple[float, str] | None:
    """A number and its unit: px, m, s, px/s, m/s, or nothing where none is given."""
    if is_number(written):
        return (float(written), "") if abs(written) < HUGE else None  # NaN is not less than anything
    found = _MEASURED.fullmatch(text_of(written).strip(" ."))
    named = "" if found is None else found["unit"].lower()
    unit = _UNITS.get(named) or _UNITS.get(named.removesuffix("s"))
    if found is None or unit is None:
        return None
    return float(found["number"]) * unit[1], unit[0] + ("/s" if found["rate"] else "")


def metres_of(written: object) -> float | None:
    """A length; without a unit it is in metres."""
    found = measured(written)
    return found[0] if found is not None and found[1] in ("", "m") else None


def _quantity(*units: Unit) -> tuple[Any, Any]:
    def read(written: object, _: ValidationInfo) -> Quantity | None:
        found = measured(written)
        if found is None or found[1] not in units or not found[0] > 0:
            return None
        return Quantity(found[0], found[1])

    return estimate(f"a number with {' or '.join(units)}", words(MAX_QUANTITY), read)


def seconds_of(written: object) -> float | None:
    """A time; without a unit it is in seconds. None for what is none."""
    found = measured(written)
    return found[0] if found is not None and found[1] in ("", "s") and found[0] > 0 else None


Distance = Annotated[Quantity | None, *_quantity("px", "m")]
Speed = Annotated[Quantity | None, *_quantity("px/s", "m/s")]
Seconds = Annotated[
    float | None, *estimate("a time in seconds", words(MAX_QUANTITY), lambda written, _: seconds_of(written))
]


def support_named(said: str, own: str, others: Sequence[str]) -> str | None:
    """`floor`, `air`, the name of one of the other objects, or what was said; None if it names nothing but `own`.

    An object comes before the floor: where a table was located, a table top is that table.
    """
    named = _content_words(said)
    phrase, thing = " ".join(named), set(named) - _PARTS
    if not re.search(r"[^\W\d_]", phrase):
        return None
    itself = set(_content_words(own))
    candidates = {other: found for other in others if (found := set(_content_words(other))) and found != itself}
    same = [other for other, found in candidates.items() if found == thing]
    alike = [other for other, found in candidates.items() if thing and (thing < found or found < thing)]
    if same or len(alike) == 1:
        return (same or alike)[0]
    if phrase in _FLOOR:
        return FLOOR
    if phrase in _AIR:
        return AIR
    return None if thing == itself else said


def _content_words(text: str) -> list[str]:
    return [word for word in re.findall(r"[^\W_]+", text.lower()) if word not in _FUNCTION_WORDS]


def _is_open(written: object) -> bool:
    """Whether a field says nothing."""
    return is_none(written) or text_of(written).lower() == "unknown"
