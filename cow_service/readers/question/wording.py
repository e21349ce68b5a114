"""Says a motion in words: the sentence that goes to a video generator as its prompt."""

from __future__ import annotations

import math
from collections.abc import Sequence

from cow_service.readers.options import plain
from cow_service.readers.prompts import load_prompt
from cow_service.records import MotionKind, Vector

MAX_OBJECT = 200  # characters
ALONG_AXIS = 0.95  # sine of the angle out of the image plane from which only the depth is worth a word
IN_PLANE = 0.3  # and up to which it is not

# 16 sectors of 22.5 degrees, from the right, turning upwards.
_QUARTERS = (("to the right", "up"), ("up", "to the left"), ("to the left", "down"), ("down", "to the right"))
_DETERMINERS = ("the ", "a ", "an ", "this ", "that ")


def direction_words(direction: Vector | None, depth: float) -> str:
    """A direction as a short phrase, such as "to the right and slightly up"; empty where there is none.

    `direction` is in image pixels, x right, y down, of any length; `depth` as in `Motion`.
    """
    flat = _flat_words(direction)
    away = "away from the camera" if depth > 0 else "towards the camera"
    if not flat or abs(depth) >= ALONG_AXIS:
        return away if abs(depth) > IN_PLANE else flat
    return f"{flat} and {away}" if abs(depth) > IN_PLANE else flat


def _flat_words(direction: Vector | None) -> str:
    if direction is None or math.hypot(*direction) == 0 or not all(map(math.isfinite, direction)):
        return ""
    sector = round(math.atan2(-direction[1], direction[0]) / (math.pi / 8)) % 16
    main, side = _QUARTERS[sector // 4]
    return (main, f"{main} and slightly {side}", f"{main} and {side}", f"{side} and slightly {main}")[sector % 4]


def motion_sentence(
    object: str,
    kind: MotionKind,
    direction: Vector | None,
    depth: float,
    sentence: str | None = None,
    further: Sequence[str] = (),
    stops: bool = False,
    also: Sequence[str] = (),
) -> str:
    """The motion in one line: a declarative `sentence` of a reader, or one made here; and that the camera stays.

    `further` are the directions of more legs in words, `also` what else moves, such as "car moves to the left".
    """
    prompt = load_prompt("motion-sentence")
    text = prompt.render(
        object=bare_name(object),
        kind=kind,
        words=direction_words(direction, depth),
        sentence="" if sentence is None else sentence.strip().rstrip(".") + ".",
        further=further,
        stops=stops,
        also=also,
    )
    return " ".join(text.split())


def same_name(one: str, other: str) -> bool:
    """Whether two texts name an object alike, whatever their determiners, letters' case and spaces."""
    return plain(bare_name(one)) == plain(bare_name(other)) != ""


def bare_name(object: str) -> str:
    """An object's name in one line, without its determiner."""
    name = " ".join(object.split())[:MAX_OBJECT].rstrip()
    determiner = next((word for word in _DETERMINERS if name.lower().startswith(word)), "")
    return name[len(determiner) :]
