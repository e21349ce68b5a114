"""The prompt for what falls: how large the scene is, and which side of the image is down."""

from __future__ import annotations

import math
from dataclasses import dataclass

from cow_service.readers.mllm.client import PromptCall
from cow_service.readers.mllm.coordinates import CoordinateFrame
from cow_service.readers.mllm.images import EncodedImage
from cow_service.readers.mllm.replies import (
    ReplyError,
    fields_of,
    first_of,
    is_none,
    is_number,
    text_of,
    values_in,
    without_thinking,
)
from cow_service.readers.mllm.schemas import Schema, nullable, numbers, object_of, one_of, words
from cow_service.records import MetresPerPixel, Vector

DOWN: dict[str, Vector] = {"bottom": (0.0, 1.0), "top": (0.0, -1.0), "left": (-1.0, 0.0), "right": (1.0, 0.0)}
_SIDES = {side: side for side in DOWN} | {"down": "bottom", "below": "bottom", "up": "top", "above": "top"}
METRES = (0.001, 1000.0)  # lengths outside this are no lengths of things in a picture
LEAST_SPAN = 4.0  # px: measuring less is guessing


@dataclass(frozen=True)
class Scaled:
    """The scale of the scene at the object, null where nothing was known of any size, and which way things fall."""

    metres_per_pixel: MetresPerPixel | None = None
    down: Vector = DOWN["bottom"]


def scale_call(image: EncodedImage, name: str, reasoning_length: int) -> PromptCall[Scaled]:
    """The call that asks how large the scene is at the object `name`, and which way is down."""
    frame = image.coordinate_frame
    inputs: dict[str, object] = {"object": " ".join(name.split()), "units": frame.units, "line_order": frame.line_order}
    return PromptCall(
        "scale", inputs, (image.jpeg,), schema(frame, reasoning_length), lambda reply: read_scaled(reply, frame)
    )


def schema(frame: CoordinateFrame, reasoning_length: int) -> Schema:
    """JSON schema of the reply."""
    return object_of(
        reasoning=words(reasoning_length),
        reference=nullable(words(200)),
        metres=nullable({"type": "number", "minimum": METRES[0], "maximum": METRES[1]}),
        ends=nullable(numbers(frame, 4)),
        down=nullable(one_of(*DOWN)),
    )


def read_scaled(reply: str, frame: CoordinateFrame) -> Scaled:
    """What a reply says of the scale. Raises `ReplyError`."""
    objects = [fields for value in values_in(without_thinking(reply)) if "ends" in (fields := fields_of(value))]
    if not objects:
        raise ReplyError("`ends` and `metres` are missing; give both, or null for both")
    if len(objects) > 1:
        raise ReplyError("several references are given; give one")
    fields = objects[0]
    down = _down(fields.get("down"))
    metres, ends = _metres(first_of(fields, "metres", "meters", "length")), fields.get("ends")
    if metres is None or is_none(ends):
        return Scaled(down=down)
    span = math.dist(*frame.ends(ends))
    if span < LEAST_SPAN:
        raise ReplyError("`ends` are too close to measure by; take a longer thing")
    reference = text_of(fields.get("reference"))[:200] or "an object of known size"
    note = f"{reference}: {metres:g} m over {span:.0f} px"
    return Scaled(MetresPerPixel(value=metres / span, source="reference", note=note), down)


def _down(written: object) -> Vector:
    if is_none(written):
        return DOWN["bottom"]
    side = _SIDES.get(text_of(written).lower().removesuffix(" side"))
    if side is None:
        raise ReplyError(f"`down` is {written!r}; give the side of the image to which things fall: {', '.join(DOWN)}")
    return DOWN[side]


def _metres(written: object) -> float | None:
    """A length in metres, also as text."""
    if is_none(written):
        return None
    try:
        metres = float(written) if is_number(written) or isinstance(written, str) else math.nan
    except (ValueError, OverflowError):
        metres = math.nan
    if not METRES[0] <= metres <= METRES[1]:
        raise ReplyError(f"`metres` is {str(written)[:40]}; give the length in metres as a number from 0.001 to 1000")
    return metres
