"""Finds the things of a kind that a question asks about. It refuses where the image does not tell which those are."""

from __future__ import annotations

from collections.abc import Sequence

from cow_service.errors import CannotGround
from cow_service.readers.embedded.english.asked import read_alternatives, read_asked
from cow_service.readers.embedded.english.nouns import Kind, kind_of
from cow_service.readers.embedded.english.options_said import may_name
from cow_service.readers.embedded.english.questions import Question
from cow_service.readers.embedded.english.tokens import ObjectPhrase
from cow_service.readers.embedded.matching import describe, match_all, match_some
from cow_service.readers.remedies import GIVE_OBJECT
from cow_service.records import BBox, LocatedObject
from cow_service.vision.masks import iou
from cow_service.vision.regions import SAME_OBJECT_IOU, Region


def things_of_kinds(
    regions: Sequence[Region], question: Question, mover: BBox, given: Sequence[LocatedObject]
) -> tuple[LocatedObject, ...]:
    """Those of the regions, but for the mover's, each under its colour; none of a kind that the caller has `given`.

    Raises `CannotGround`.
    """
    asked, found = read_asked(question), list[LocatedObject]()
    left = [region for region in regions if iou(region.bbox, mover) < SAME_OBJECT_IOU]
    for name in () if asked is None else asked.among:
        kind = kind_of(name)
        if kind is None or any(may_name(kind.phrase, each.object) for each in given):
            continue
        fitting = _of_kind(left, kind, [other for other in question.others if not is_kind_asked(other, question)])
        if not fitting:
            raise CannotGround(
                f"The question asks about '{name}', and which things those are the image does not tell for certain. "
                f"Seen: {describe(regions)}. {GIVE_OBJECT}"
            )
        found += _named(fitting, kind)
    return (*found, *_alternatives(left, question, given))


def _alternatives(regions: Sequence[Region], question: Question, given: Sequence[LocatedObject]) -> list[LocatedObject]:
    """Those of the kind in "which mug does it hit first"; none where the image does not tell which those are."""
    asked, found = read_asked(question), list[LocatedObject]()
    for phrase in read_alternatives(question):
        kind = kind_of(phrase.text) or Kind(phrase, None)
        listed = asked is None or phrase.text in asked.among or phrase.colour is not None or kind.phrase.head is None
        if not listed and not any(may_name(kind.phrase, each.object) for each in given):
            found += _named(_of_kind(regions, kind, ()), kind)
    return found


def _named(regions: Sequence[Region], kind: Kind) -> list[LocatedObject]:
    names = [f"{region.colour} {kind.phrase.head}" for region in regions]
    return [
        LocatedObject(object=name, bbox=region.bbox, source="embedded")
        for name, region in zip(names, regions, strict=True)
    ]


def _of_kind(regions: Sequence[Region], kind: Kind, others: Sequence[ObjectPhrase]) -> list[Region]:
    """The regions of a kind; none where others may be of it, too, or where they are not as many as is said."""
    if kind.count is not None:
        return match_some(regions, kind.phrase, others, kind.count)
    return match_all(regions, kind.phrase, others)


def is_kind_asked(phrase: ObjectPhrase, question: Question) -> bool:
    """Whether a phrase is that of a kind asked about, and of no one thing."""
    asked = read_asked(question)
    return asked is not None and any(kind_of(name) and name.endswith(phrase.text.lower()) for name in asked.among)
