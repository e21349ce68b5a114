"""Interventions: finds what a request or a reader wants taken away or put in among the objects of the scene."""

from __future__ import annotations

from collections.abc import Sequence

from cow_service.errors import CannotGround, FieldError, InvalidRequest
from cow_service.readers.question.sentences import parse
from cow_service.readers.question.wording import same_name
from cow_service.readers.remedies import GIVE_OBJECT
from cow_service.records import BBox, Intervention, LocatedObject
from cow_service.requests import InterventionRequest
from cow_service.vision.masks import iou
from cow_service.vision.regions import SAME_OBJECT_IOU


def locate_interventions(
    wanted: Sequence[InterventionRequest],
    read: Sequence[Intervention],
    mover: LocatedObject,
    given: Sequence[LocatedObject],
    seen: Sequence[LocatedObject],
) -> tuple[Intervention, ...]:
    """Those of the request, then those of the reader that are not among them.

    The objects of a request's interventions are looked for by name, first among the objects `given` with it, then
    among those `seen` by the reader. Raises `InvalidRequest` for an object that is not there, for what is done twice,
    for a thing that is put to itself, and for the mover taken away; `CannotGround` where the reader says so.
    """
    places = (*given, *seen, mover)
    found: list[Intervention] = []
    for index, request in enumerate(wanted):
        pointer = f"/interventions/{index}"
        located = Intervention(
            kind=request.kind,
            object=_named(request.object, places, f"{pointer}/object"),
            relation=request.relation,
            targets=tuple(_named(name, places, f"{pointer}/targets/{at}") for at, name in enumerate(request.targets)),
        )
        fault = _fault(located, mover, found)
        if fault is not None:
            raise InvalidRequest(f"`interventions.{index}`: {fault}", errors=(FieldError(pointer, fault),))
        found.append(located)
    for each in read:
        if any(_same_change(each, other) for other in found):
            continue
        fault = _fault(each, mover, found)
        if fault is not None:
            raise CannotGround(f"{fault} Ask of another object, or state the change as `interventions`.")
        found.append(each)
    return tuple(found)


def stated_changes(question: str, places: Sequence[LocatedObject]) -> tuple[Intervention, ...]:
    """The changes that a question names, where no reader looks for their objects: they must be among those given.

    Raises `InvalidRequest` for one that is not.
    """

    def named(words: str) -> LocatedObject:
        found = next((place for place in places if same_name(place.object, words)), None)
        if found is None:
            detail = f"the question changes '{words}', and with `grounding` given nobody looks for it"
            raise InvalidRequest(f"`objects`: {detail}. {GIVE_OBJECT}", errors=(FieldError("/objects", detail),))
        return found

    return tuple(
        Intervention(
            kind=change.kind,
            object=named(change.object.text),
            relation=change.relation,
            targets=tuple(named(target.text) for target in change.targets),
        )
        for change in parse(question).interventions
    )


def without_removed(
    others: Sequence[LocatedObject], interventions: Sequence[Intervention]
) -> tuple[LocatedObject, ...]:
    """The objects that are not taken away."""
    removed = [each.object.bbox for each in interventions if each.kind == "remove"]
    return tuple(other for other in others if not _is_among(other.bbox, removed))


def _named(words: str, places: Sequence[LocatedObject], pointer: str) -> LocatedObject:
    """The object of a name, whatever its letters' case, its spaces and its article. Raises `InvalidRequest`."""
    found = next((place for place in places if same_name(place.object, words)), None)
    if found is not None:
        return found
    known = ", ".join(f"'{place.object}'" for place in places)
    detail = f"there is no '{words}' among the objects of the scene, which are {known}"
    raise InvalidRequest(
        f"`{pointer[1:].replace('/', '.')}`: {detail}. {GIVE_OBJECT}",
        errors=(FieldError(pointer, detail),),
    )


def _fault(each: Intervention, mover: LocatedObject, before: Sequence[Intervention]) -> str | None:
    """Why a change cannot be made, as a sentence."""
    name, place = each.object.object, each.object.bbox
    taken = [other.object.bbox for other in before if other.kind == "remove"]
    put = [other for other in before if other.kind == "place"]
    if each.kind == "remove":
        used = [thing.bbox for other in put for thing in (other.object, *other.targets)]
        faults = {
            f"'{name}' is what moves: it cannot be taken away.": _is_among(place, [mover.bbox]),
            f"'{name}' is taken away twice: name each object once.": _is_among(place, taken),
            f"'{name}' is put somewhere, or something is put to it: it cannot be taken away.": _is_among(place, used),
        }
    else:
        targets = [target.bbox for target in each.targets]
        relation = (each.relation or "to").replace("-", " ")
        gone = [thing.object for thing in (each.object, *each.targets) if _is_among(thing.bbox, taken)]
        faults = {
            f"'{name}' cannot be put {relation} itself.": _is_among(place, targets),
            f"'{name}' is put somewhere twice: name each object once.": _is_among(
                place, [other.object.bbox for other in put]
            ),
            f"'{gone[0] if gone else ''}' is taken away: it cannot be put, nor anything to it.": bool(gone),
        }
    return next((fault for fault, holds in faults.items() if holds), None)


def _is_among(bbox: BBox, boxes: Sequence[BBox]) -> bool:
    return any(_same(bbox, other) for other in boxes)


def _same_change(a: Intervention, b: Intervention) -> bool:
    pairs = zip((a.object, *a.targets), (b.object, *b.targets), strict=False)
    alike = a.kind == b.kind and a.relation == b.relation and len(a.targets) == len(b.targets)
    return alike and all(_same(one.bbox, other.bbox) for one, other in pairs)


def _same(a: BBox, b: BBox) -> bool:
    return iou(a, b) >= SAME_OBJECT_IOU
