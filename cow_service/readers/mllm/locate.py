"""Second prompt: where the object is and what is around it, which way it moves, and what tells so."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from cow_service.readers.mllm.boxes import Place, chosen, places_in, tagged_places
from cow_service.readers.mllm.client import PromptCall
from cow_service.readers.mllm.coordinates import CoordinateFrame
from cow_service.readers.mllm.directions import Line, line_in
from cow_service.readers.mllm.identify import MAX_OTHERS
from cow_service.readers.mllm.images import EncodedImage
from cow_service.readers.mllm.others import MAX_LABEL, MAX_OBSTACLES, read_surroundings
from cow_service.readers.mllm.priors import MOTION_FIELDS, OBJECT_FIELDS
from cow_service.readers.mllm.replies import ReplyError, is_none, values_in, without_thinking
from cow_service.readers.mllm.schemas import Schema, nullable, numbers, object_of, one_of, words
from cow_service.records import BBox, LocatedObject, ObjectPrior, Point

CUES = ("arrow", "trail", "text", "orientation", "none")


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
    prior: ObjectPrior | None = None
    line: Line | None = None
    warnings: tuple[str, ...] = ()  # of optional fields and other boxes that were left out


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
        "max_obstacles": MAX_OBSTACLES,
    }
    shape = schema(frame, wants_box, wants_direction, reasoning_length)
    return PromptCall(
        "locate",
        inputs,
        (image.jpeg,),
        shape,
        lambda reply: read_located(reply, frame, name, others, wants_box, wants_direction),
    )


def schema(frame: CoordinateFrame, wants_box: bool, wants_direction: bool, reasoning_length: int) -> Schema:
    """JSON schema of the reply. What only priors are made of may be left out."""
    box_key, box = frame.coordinates.box, numbers(frame, 4)
    fields: dict[str, Schema] = {"reasoning": words(reasoning_length)}
    if wants_box:
        item = object_of(OBJECT_FIELDS, **{"label": words(MAX_LABEL), box_key: box}, **OBJECT_FIELDS)
        fields |= {"label": words(MAX_LABEL), box_key: nullable(box)} | OBJECT_FIELDS
        fields["others"] = {"type": "array", "items": item, "maxItems": MAX_OTHERS + MAX_OBSTACLES}
    if wants_direction:
        fields |= {
            "cue": one_of(*CUES),
            "along_arrow": nullable({"type": "boolean"}),
            "camera": nullable(one_of("towards", "away")),
            "direction": nullable(numbers(frame, 4)),
        } | MOTION_FIELDS
    return object_of(OBJECT_FIELDS | MOTION_FIELDS, **fields)


def read_located(
    reply: str, frame: CoordinateFrame, wanted: str, others: Sequence[str], wants_box: bool, wants_direction: bool
) -> Located | None:
    """What a reply says of the object `wanted`; None where it says that it does not see it. Raises `ReplyError`.

    `others` are the things that the question names besides.
    """
    said = without_thinking(reply)
    values = values_in(said)
    place = _place(values, said, frame, wanted) if wants_box else None
    if wants_box and place is None:
        return None
    line = line_in(values, said, frame) if wants_direction else None
    told = () if line is None else line.warnings
    if place is None:
        return Located(line=line, warnings=told)
    bbox = None if is_none(place.box) else frame.bbox(place.box)
    around = read_surroundings(values, frame, wanted, place.fields, others)
    return Located(
        bbox=bbox,
        point=frame.point(place.point) if bbox is None else None,
        label=place.label,
        clipped=bbox is not None and frame.overshoots(place.box),
        others=around.others,
        prior=around.prior,
        line=line,
        warnings=(*around.warnings, *told),
    )


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
