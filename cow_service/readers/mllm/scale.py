"""The prompt for what falls: how large the scene is, and which side of the image is down."""

from __future__ import annotations

import math
from dataclasses import dataclass

from cow_service.readers.coordinates import View
from cow_service.readers.mllm.schemas import Schema, nullable, numbers, object_of, one_of, words
from cow_service.readers.replies import ReplyError, fields_of, text_of, values_in, without_thinking
from cow_service.records import MetresPerPixel, Vector

DOWN: dict[str, Vector] = {"bottom": (0.0, 1.0), "top": (0.0, -1.0), "left": (-1.0, 0.0), "right": (1.0, 0.0)}
METRES = (0.001, 1000.0)  # lengths outside this are no lengths of things in a picture
LEAST_SPAN = 4.0  # px: measuring less is guessing


@dataclass(frozen=True)
class Scaled:
    """The scale of the scene at the object, null where nothing was known of any size, and which way things fall."""

    metres_per_pixel: MetresPerPixel | None
    down: Vector


def schema(view: View, reasoning_length: int) -> Schema:
    """JSON schema of the reply."""
    return object_of(
        reasoning=words(reasoning_length),
        reference=nullable(words(200)),
        metres=nullable({"type": "number", "minimum": METRES[0], "maximum": METRES[1]}),
        ends=nullable(numbers(view, 4)),
        down=nullable(one_of(*DOWN)),
    )


def read_scaled(reply: str, view: View) -> Scaled:
    """What a reply says of the scale. Raises `ReplyError`."""
    objects = [fields for value in values_in(without_thinking(reply)) if "ends" in (fields := fields_of(value))]
    if not objects:
        raise ReplyError("`ends` and `metres` are missing; give both, or null for both")
    fields = objects[-1]
    down = DOWN.get(text_of(fields.get("down")).lower(), DOWN["bottom"])
    metres, ends = fields.get("metres"), fields.get("ends")
    if metres is None or ends is None:
        return Scaled(None, down)
    if isinstance(metres, bool) or not isinstance(metres, int | float) or not METRES[0] <= metres <= METRES[1]:
        raise ReplyError(f"`metres` is {metres!r}; give the length in metres as a number from 0.001 to 1000")
    span = math.dist(*view.ends(ends))
    if span < LEAST_SPAN:
        raise ReplyError("`ends` are too close to measure by; take a longer thing")
    reference = text_of(fields.get("reference"))[:200] or "an object of known size"
    note = f"{reference}: {metres:g} m over {span:.0f} px"
    return Scaled(MetresPerPixel(value=metres / span, source="reference", note=note), down)
