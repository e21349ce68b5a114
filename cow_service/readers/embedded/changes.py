"""Finds what a question takes away or puts somewhere. It refuses where that, or where it is put, is not found."""

from __future__ import annotations

from collections.abc import Sequence

from cow_service.errors import CannotGround
from cow_service.narration import same_name
from cow_service.readers.embedded.english.asked import read_asked
from cow_service.readers.embedded.english.interventions import InterventionWords
from cow_service.readers.embedded.english.lexicon import ObjectPhrase
from cow_service.readers.embedded.english.questions import Question
from cow_service.readers.embedded.matching import describe, match_both, match_one
from cow_service.readers.remedies import GIVE_OBJECT
from cow_service.records import Asked, BBox, Intervention, LocatedObject
from cow_service.vision.masks import iou
from cow_service.vision.regions import SAME_OBJECT_IOU, Region
from cow_service.vision.scene import Scene

Found = tuple[ObjectPhrase, BBox]


def check_changes(question: Question) -> None:
    """Raises `CannotGround` where the mover is taken away, or something is put into itself."""
    for change in question.interventions:
        if change.kind == "remove" and (change.then_moves or change.object == question.mover):
            raise CannotGround(
                f"The question takes '{change.object.text}' away and says that it moves: ask one of both."
            )
        asked = read_asked(question)
        if change.kind == "remove" and asked is not None and _is_asked_about(change.object, asked):
            raise CannotGround(
                f"The question takes '{change.object.text}' away and asks what becomes of it: ask one of both."
            )
        if change.object in change.targets:
            relation = change.relation or "beside"
            raise CannotGround(f"The question puts '{change.object.text}' {relation} itself: name another thing.")


def _is_plural(phrase: ObjectPhrase) -> bool:
    """ "Both mugs", "the mugs"."""
    last = phrase.text.lower().split()[-1]
    return phrase.text.lower().startswith("both ") or (last != phrase.head and last == f"{phrase.head}s")


def _is_asked_about(removed: ObjectPhrase, asked: Asked) -> bool:
    names = (asked.subject, asked.target, *asked.among)
    return any(name is not None and same_name(name, removed.text) for name in names)


def find_removed(scene: Scene, question: Question, given: Sequence[LocatedObject] = ()) -> tuple[Intervention, ...]:
    """What is taken away: `given` under that name, or where exactly one region fits. Raises `CannotGround`."""
    removed = [change.object for change in question.interventions if change.kind == "remove"]
    names = [each for each in (question.mover, *question.others, *removed) if each is not None and not _is_plural(each)]
    taken: list[LocatedObject] = []
    for phrase in removed:
        left = [each for each in scene.regions if all(each.bbox != one.bbox for one in taken)]
        others = [each for each in names if all(each.text != one.object for one in taken)]
        found = _both(left, phrase, others) if _is_plural(phrase) else _one(left, phrase, others, given)
        if not found:
            raise _not_found(scene, f"takes '{phrase.text}' away", phrase)
        taken += found
    return tuple(Intervention(kind="remove", object=each) for each in taken)


def given_as(phrase: ObjectPhrase, given: Sequence[LocatedObject]) -> LocatedObject | None:
    """The object that the caller gave under the words of a phrase."""
    return next((each for each in given if same_name(each.object, phrase.text)), None)


def _one(
    regions: Sequence[Region],
    phrase: ObjectPhrase,
    others: Sequence[ObjectPhrase],
    given: Sequence[LocatedObject],
) -> list[LocatedObject]:
    named, region = given_as(phrase, given), match_one(regions, phrase, others)
    if named is not None:
        return [named]
    return [] if region is None else [_located(phrase.text, region.bbox)]


def _both(regions: Sequence[Region], phrase: ObjectPhrase, others: Sequence[ObjectPhrase]) -> list[LocatedObject]:
    """ "Both cylinders", each under its colour."""
    found = match_both(regions, phrase, others)
    return [_located(f"{region.colour} {phrase.head or 'object'}", region.bbox) for region in found]


def without(regions: Sequence[Region], removed: Sequence[Intervention]) -> tuple[Region, ...]:
    """The regions of what is left."""
    boxes = [change.object.bbox for change in removed]
    return tuple(region for region in regions if all(iou(region.bbox, box) < SAME_OBJECT_IOU for box in boxes))


def find_placed(
    scene: Scene,
    regions: Sequence[Region],
    question: Question,
    mover: Found,
    given: Sequence[LocatedObject] = (),
) -> tuple[Intervention, ...]:
    """What is put somewhere, and where; what is `given` under its name is not looked for. Raises `CannotGround`."""
    changes = [change for change in question.interventions if change.kind == "place"]
    return tuple(_placed(scene, regions, change, mover, question.others, given) for change in changes)


def _placed(
    scene: Scene,
    regions: Sequence[Region],
    change: InterventionWords,
    mover: Found,
    others: Sequence[ObjectPhrase],
    given: Sequence[LocatedObject],
) -> Intervention:
    others = [*others, change.object]
    thing = _find(scene, regions, change.object, f"puts '{change.object.text}' somewhere", [mover], others, given)
    known = [mover, (change.object, thing.bbox)]
    targets: list[LocatedObject] = []
    for phrase in change.targets:
        if _is_plural(phrase) and change.relation == "between":
            targets += _both(without(regions, [Intervention(kind="remove", object=thing)]), phrase, others)
            continue
        told = f"puts '{change.object.text}' {change.relation} '{phrase.text}'"
        targets.append(_find(scene, regions, phrase, told, known, others, given))
        known.append((phrase, targets[-1].bbox))
    if change.relation == "between" and len(targets) != 2:
        raise _not_found(scene, f"puts '{change.object.text}' between", change.targets[0])
    return Intervention(kind="place", object=thing, relation=change.relation, targets=tuple(targets))


def _find(
    scene: Scene,
    regions: Sequence[Region],
    phrase: ObjectPhrase,
    told: str,
    known: Sequence[Found],
    others: Sequence[ObjectPhrase],
    given: Sequence[LocatedObject],
) -> LocatedObject:
    """A thing that is known already or was given, or the one region besides those that fits its words."""
    for other, bbox in known:
        if other == phrase:
            return _located(phrase.text, bbox)
    named = given_as(phrase, given)
    if named is not None:
        return named
    free = [region for region in regions if all(iou(region.bbox, bbox) < SAME_OBJECT_IOU for _, bbox in known)]
    region = match_one(free, phrase, [each for each in others if all(each != one for one, _ in known)])
    if region is None:
        raise _not_found(scene, told, phrase)
    return _located(phrase.text, region.bbox)


def _located(name: str, bbox: BBox) -> LocatedObject:
    return LocatedObject(object=name, bbox=bbox, source="embedded")


def _not_found(scene: Scene, told: str, phrase: ObjectPhrase) -> CannotGround:
    return CannotGround(
        f"The question {told}, and '{phrase.text}' was not found, or not for certain. Seen: {describe(scene.regions)}. "
        f"{GIVE_OBJECT}"
    )
