"""Second prompt: where the object is, which way it moves, and what tells so."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from cow_service.readers.mllm.boxes import Place, chosen, places_in, tagged_places
from cow_service.readers.mllm.client import PromptCall
from cow_service.readers.mllm.coordinates import CoordinateFrame
from cow_service.readers.mllm.directions import Line, line_in
from cow_service.readers.mllm.identify import MAX_OTHERS
from cow_service.readers.mllm.images import EncodedImage
from cow_service.readers.mllm.replies import ReplyError, fields_of, is_none, name_words, values_in, without_thinking
from cow_service.readers.mllm.schemas import Schema, nullable, numbers, object_of, one_of, words
from cow_service.records import BBox, LocatedObject, Point

CUES = ("arrow", "trail", "text", "orientation", "none")
MAX_LABEL = 120  # characters


@dataclass(frozen=True)
class Located:
    """Where the object is (px of the upright image) and which way it moves; parts that were not asked for are None.

    A reply may give a point instead of a box. `label` is what the reply calls it.
    """

    bbox: BBox | None = None
    point: Point | None = None
    label: str = ""
    clipped: bool = False  # the box reached over the image's edge
    others: tuple[LocatedObject, ...] = ()
    line: Line | None = None


def locate_call(
    question: str,
    image: EncodedImage,
    name: str,
    bbox: BBox | None,
    others: Sequence[str],
    wants_direction: bool,
    reasoning_length: int,
) -> PromptCall[Located | None]:
    """The call that asks where the object `name` is, unless its box is known, and which way it moves."""
    frame, wants_box = image.coordinate_frame, bbox is None
    inputs: dict[str, object] = {
        "question": question,
        "object": " ".join(name.split()),
        "others": tuple(others),
        "bbox": "" if bbox is None else str(frame.write((bbox[0], bbox[1]), (bbox[2], bbox[3]))),
        "units": frame.units,
        "box_key": frame.coordinates.box,
        "box_order": frame.box_order,
        "line_order": frame.line_order,
        "wants_box": wants_box,
        "wants_direction": wants_direction,
    }
    shape = schema(frame, bool(others), wants_box, wants_direction, reasoning_length)
    return PromptCall(
        "locate",
        inputs,
        (image.jpeg,),
        shape,
        lambda reply: read_located(reply, frame, name, others, wants_box, wants_direction),
    )


def schema(
    frame: CoordinateFrame, others: bool, wants_box: bool, wants_direction: bool, reasoning_length: int
) -> Schema:
    """JSON schema of the reply."""
    box_key, box = frame.coordinates.box, numbers(frame, 4)
    fields: dict[str, Schema] = {"reasoning": words(reasoning_length)}
    if wants_box:
        fields |= {"label": words(MAX_LABEL), box_key: nullable(box)}
        if others:
            item = object_of(**{"label": words(MAX_LABEL), box_key: box})
            fields["others"] = {"type": "array", "items": item, "maxItems": MAX_OTHERS}
    if wants_direction:
        fields |= {
            "cue": one_of(*CUES),
            "along_arrow": nullable({"type": "boolean"}),
            "camera": nullable(one_of("towards", "away")),
            "direction": nullable(numbers(frame, 4)),
        }
    return object_of(**fields)


def read_located(
    reply: str, frame: CoordinateFrame, wanted: str, others: Sequence[str], wants_box: bool, wants_direction: bool
) -> Located | None:
    """What a reply says of the object `wanted`; None where it says that it does not see it. Raises `ReplyError`."""
    said = without_thinking(reply)
    values = values_in(said)
    place = _place(values, said, frame, wanted) if wants_box else None
    if wants_box and place is None:
        return None
    line = line_in(values, said, frame) if wants_direction else None
    if place is None:
        return Located(line=line)
    found = _others(values, frame, others)
    if not is_none(place.box):
        return Located(frame.bbox(place.box), None, place.label, frame.overshoots(place.box), found, line)
    return Located(None, frame.point(place.point), place.label, False, found, line)


def _place(values: Sequence[object], said: str, frame: CoordinateFrame, wanted: str) -> Place | None:
    """The place that the reply gives for the object; None where it says that it does not see it."""
    places = [place for value in values for place in places_in(value, frame)] or list(tagged_places(said))
    if not places:
        if any(is_none(value) for value in values):
            return None
        raise ReplyError(
            f"`{frame.coordinates.box}` is missing; give the box of '{wanted}', or null if it is not there"
        )
    place = chosen(places, wanted)
    return None if is_none(place.box) and is_none(place.point) else place


def _others(values: Sequence[object], frame: CoordinateFrame, wanted: Sequence[str]) -> tuple[LocatedObject, ...]:
    """Boxes of the other objects that were asked for; one that cannot be read is left out."""
    found: dict[str, LocatedObject] = {}
    for value in values:
        for place in places_in(fields_of(value).get("others"), frame):
            name = next((name for name in wanted if name_words(name) == name_words(place.label)), None)
            if name is not None and place.box is not None:
                try:
                    found.setdefault(name, LocatedObject(object=name, bbox=frame.bbox(place.box)))
                except ReplyError:
                    continue  # the mover matters more than asking for this again
    return tuple(found.values())
