"""Finds what a question takes away or puts somewhere. It refuses where that, or where it is put, is not found."""

from __future__ import annotations

from collections.abc import Sequence

from cow_service.errors import CannotGround
from cow_service.readers.embedded.matching import describe, match_both, match_one
from cow_service.readers.question.interventions import InterventionWords
from cow_service.readers.question.phrases import ObjectPhrase
from cow_service.readers.question.sentences import Question
from cow_service.readers.remedies import GIVE_PLACE
from cow_service.records import BBox, Intervention, LocatedObject
from cow_service.vision.masks import iou
from cow_service.vision.regions import SAME_OBJECT_IOU, Region
from cow_service.vision.scene import Scene

Found = tuple[ObjectPhrase, BBox]


def check_changes(question: Question) -> None:
    """Raises `CannotGround` where the mover is taken away, or something is put into itself."""
    for change in question.interventions:
        if change.kind == "remove" and (change.then_moves or change.object == question.mover):
            raise CannotGround(f"The question takes '{change.object.text}' away and says that it moves. {GIVE_PLACE}")
        if change.object in change.targets:
            relation = change.relation or "beside"
            raise CannotGround(
                f"The question puts '{change.object.text}' {relation} itself, which is not possible. {GIVE_PLACE}"
            )


def find_removed(scene: Scene, question: Question) -> tuple[Intervention, ...]:
    """What is taken away, where exactly one region fits. Raises `CannotGround`."""
    removed = [change.object for change in question.interventions if change.kind == "remove"]
    taken: list[tuple[str, Region]] = []
    for phrase in removed:
        left = [each for each in scene.regions if all(each is not region for _, region in taken)]
        found = _both(left, phrase) if phrase.text.lower().startswith("both ") else _one(left, phrase)
        if not found:
            raise _not_found(scene, f"takes '{phrase.text}' away", phrase)
        taken += found
    return tuple(
        Intervention(kind="remove", object=LocatedObject(object=name, bbox=region.bbox, source="embedded"))
        for name, region in taken
    )


def _one(regions: Sequence[Region], phrase: ObjectPhrase) -> list[tuple[str, Region]]:
    region = match_one(regions, phrase)
    return [] if region is None else [(phrase.text, region)]


def _both(regions: Sequence[Region], phrase: ObjectPhrase) -> list[tuple[str, Region]]:
    """ "Both cylinders", each under its colour."""
    return [(f"{region.colour} {phrase.head or 'object'}", region) for region in match_both(regions, phrase)]


def without(regions: Sequence[Region], removed: Sequence[Intervention]) -> tuple[Region, ...]:
    """The regions of what is left."""
    boxes = [change.object.bbox for change in removed]
    return tuple(region for region in regions if all(iou(region.bbox, box) < SAME_OBJECT_IOU for box in boxes))


def find_placed(scene: Scene, regions: Sequence[Region], question: Question, mover: Found) -> tuple[Intervention, ...]:
    """What is put somewhere, and where. Raises `CannotGround`."""
    changes = [change for change in question.interventions if change.kind == "place"]
    return tuple(_placed(scene, regions, change, mover) for change in changes)


def _placed(scene: Scene, regions: Sequence[Region], change: InterventionWords, mover: Found) -> Intervention:
    thing = _find(scene, regions, change.object, f"puts '{change.object.text}' somewhere", [mover])
    known = [mover, (change.object, thing.bbox)]
    targets: list[LocatedObject] = []
    for phrase in change.targets:
        told = f"puts '{change.object.text}' {change.relation} '{phrase.text}'"
        targets.append(_find(scene, regions, phrase, told, known))
        known.append((phrase, targets[-1].bbox))
    return Intervention(kind="place", object=thing, relation=change.relation, targets=tuple(targets))


def _find(
    scene: Scene, regions: Sequence[Region], phrase: ObjectPhrase, told: str, known: Sequence[Found]
) -> LocatedObject:
    """A thing that is known already, or the one region besides those that fits its words."""
    for other, bbox in known:
        if other == phrase:
            return _located(phrase, bbox)
    free = [region for region in regions if all(iou(region.bbox, bbox) < SAME_OBJECT_IOU for _, bbox in known)]
    region = match_one(free, phrase)
    if region is None:
        raise _not_found(scene, told, phrase)
    return _located(phrase, region.bbox)


def _located(phrase: ObjectPhrase, bbox: BBox) -> LocatedObject:
    return LocatedObject(object=phrase.text, bbox=bbox, source="embedded")


def _not_found(scene: Scene, told: str, phrase: ObjectPhrase) -> CannotGround:
    return CannotGround(
        f"The question {told}, and '{phrase.text}' was not found, or not for certain. Seen: {describe(scene.regions)}. "
        f"{GIVE_PLACE}"
    )
