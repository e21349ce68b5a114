"""The other objects of a reply: those the question names, and those that could be hit, hide or be hidden."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from cow_service.readers.mllm.boxes import Place, places_in
from cow_service.readers.mllm.checks import covers_image
from cow_service.readers.mllm.coordinates import CoordinateFrame
from cow_service.readers.mllm.priors import read_prior
from cow_service.readers.mllm.replies import ReplyError, fields_of, is_none, name_words, text_of
from cow_service.readers.mllm.supports import is_floor
from cow_service.records import BBox, LocatedObject, ObjectPrior, ObjectRole
from cow_service.vision.masks import iou
from cow_service.vision.regions import SAME_OBJECT_IOU

MAX_OBSTACLES = 8
MAX_LABEL = 80  # characters


@dataclass(frozen=True)
class Surroundings:
    """The other objects of a reply, the prior of the mover among them, and warnings of what was left out."""

    others: tuple[LocatedObject, ...] = ()
    prior: ObjectPrior | None = None  # of the mover
    warnings: tuple[str, ...] = ()


def read_surroundings(
    values: Sequence[object], frame: CoordinateFrame, mover: str, fields: Mapping[str, object], targets: Sequence[str]
) -> Surroundings:
    """What a reply says besides the mover's place; what cannot be read is left out with a warning.

    `fields` are those of the mover. Targets come first, by the words in which they were asked for, then obstacles.
    """
    places = [place for value in values for place in places_in(fields_of(value).get("others"), frame)]
    warnings: list[str] = []
    boxes: list[tuple[str, ObjectRole, BBox, Place]] = []
    for name, role, place in _named([place for place in places if not is_none(place.box)], targets):
        try:
            bbox = frame.bbox(place.box)
        except ReplyError as error:  # the mover matters more than asking for this again
            warnings.append(f"The reader's box of '{name}' was left out: {error}.")
            continue
        if role == "obstacle" and covers_image(frame.width, frame.height, bbox):
            warnings.append(f"The reader's box of '{name}' was left out: it covers nearly the whole image.")
            continue
        boxes.append((name, role, bbox, place))
    names = [name for name, _, _, _ in boxes]
    prior, told = read_prior(fields, mover, names)
    warnings += told
    others: list[LocatedObject] = []
    for name, role, bbox, place in boxes:
        own, told = read_prior(place.fields, name, [mover, *names])
        warnings += told
        others.append(LocatedObject(object=name, bbox=bbox, role=role, prior=own, source="mllm"))
    return Surroundings(tuple(others), prior, tuple(warnings))


def separate_objects(mover: BBox, others: Sequence[LocatedObject]) -> tuple[tuple[LocatedObject, ...], tuple[str, ...]]:
    """The others without those that have the box of the mover or of one before them, and with few obstacles.

    A target that goes is told of in a warning.
    """
    kept: list[LocatedObject] = []
    warnings: list[str] = []
    for other in others:
        boxes = [mover, *(each.bbox for each in kept)]
        if any(iou(other.bbox, bbox) >= SAME_OBJECT_IOU for bbox in boxes):
            if other.role == "target":
                warnings.append(f"The reader's box of '{other.object}' was left out: it is that of another object.")
        elif other.role == "target" or sum(each.role == "obstacle" for each in kept) < MAX_OBSTACLES:
            kept.append(other)
    return tuple(kept), tuple(warnings)


def _named(places: Sequence[Place], targets: Sequence[str]) -> Iterator[tuple[str, ObjectRole, Place]]:
    """Each place with its name and role: the targets, each once, then all the rest but the floor."""
    left = list(places)
    for target in targets:
        wanted = set(name_words(target))
        labels = [(set(name_words(place.label)), place) for place in left]
        same = [place for held, place in labels if held == wanted]
        alike = [place for held, place in labels if held and (held < wanted or wanted < held)]
        for place in same[:1] or (alike if len(alike) == 1 else []):
            left = [other for other in left if other is not place]
            yield target, "target", place
    for place in left:
        label = text_of(place.label)[:MAX_LABEL]
        if label and not is_floor(label):
            yield label, "obstacle", place
