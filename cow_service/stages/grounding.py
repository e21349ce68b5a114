"""Stage 1: which object moves and where it is, and where the others are that matter."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

from cow_service.errors import FieldError, InvalidRequest
from cow_service.media.images import decode_own, encode_png
from cow_service.readers.base import GroundingReading
from cow_service.readers.question.wording import same_name
from cow_service.records import Artifact, BBox, Grounding, LocatedObject, Point, Source
from cow_service.requests import GroundingRequest, SimulateRequest
from cow_service.stages.interventions import locate_interventions, stated_changes, without_removed
from cow_service.stages.places import place_of, prior_of
from cow_service.stages.results import StageResult
from cow_service.stages.run import Run
from cow_service.vision.masks import iou
from cow_service.vision.regions import SAME_OBJECT_IOU
from cow_service.vision.types import Mask

DEFAULT_NAME = "object"
SAME_BOX_IOU = 0.95  # of two objects of one request: one thing given twice


def ground(run: Run[SimulateRequest]) -> StageResult[Grounding]:
    """The mover, from the request where it says so, else from the reader; its mask [H, W] is stored as PNG.

    The others are those of the request, then those of the reader that are not among them, without what is taken away.
    Raises `InvalidRequest` and `CannotGround` for what the request says of places (`place_of`) and for interventions
    that cannot be made (`locate_interventions`), and what the reader raises.
    """
    place = run.request.place
    source: Source = "request"
    with run.cpu():
        all_given, told_of_given = _given_objects(run)
    if place is None:
        sought = (name for name in run.request.changed_names if not any(same_name(name, o.object) for o in all_given))
        asked = replace(run.reader_input("grounding"), known=all_given, sought=tuple(sought))
        reading, source = run.reader.ground(asked), run.reader.source
    else:
        with run.cpu():
            reading = _given(run, place)
    with run.cpu():
        run.place_mover(reading.bbox, None if reading.hints is None else reading.hints.cue)
        mask = _store_mask(run, reading.bbox)
    given, warnings = _without_mover(all_given, reading.bbox)
    warnings = (*told_of_given, *warnings)
    read = (other.model_copy(update={"source": other.source or source}) for other in reading.others)
    seen = [other for other in read if not any(_same(other.bbox, one.bbox) for one in given)]
    mover = LocatedObject(object=reading.object, bbox=reading.bbox, prior=reading.prior, source=source)
    changes = reading.interventions
    if place is not None and not run.request.interventions:
        changes = stated_changes(run.request.question, (*given, mover))
    interventions = locate_interventions(run.request.interventions, changes, mover, given, seen)
    grounding = Grounding(
        object=reading.object,
        point=reading.point or _centre(reading.bbox),
        bbox=reading.bbox,
        mask=mask,
        others=without_removed((*given, *seen), interventions),
        interventions=interventions,
        prior=reading.prior,
        source=source,
    )
    masks = (mask.sha256, *(one.mask.sha256 for one in given if one.mask is not None))
    told = (*reading.warnings, *warnings)
    return StageResult(value=grounding, warnings=told, artifacts=masks, hints=reading.hints)


def use_stored_masks(run: Run[SimulateRequest], grounding: Grounding) -> None:
    """Has the scene use the stored masks of a grounding that was found again.

    A mask cut again from its box may differ from one that was cut around a point, or given.
    """
    run.place_mover(grounding.bbox, None if run.hints is None else run.hints.cue)
    changed = (thing for each in grounding.interventions for thing in (each.object, *each.targets))
    for placed in (grounding, *grounding.others, *changed):
        if placed.mask is not None:
            run.scene.preset_mask(placed.bbox, partial(_stored, run, placed.mask))


def _stored(run: Run[SimulateRequest], mask: Artifact) -> Mask:
    return decode_own(run.backends.artifacts.read(mask.sha256))[..., 0] > 0


def _store_mask(run: Run[SimulateRequest], bbox: BBox) -> Artifact:
    return run.backends.artifacts.put(encode_png(run.scene.silhouette(bbox)), "image/png")


def _given(run: Run[SimulateRequest], given: GroundingRequest) -> GroundingReading:
    """What a request says of the mover. The first point of a path says less of it than a point that is given for it."""
    derived = run.request.grounding is None
    place = place_of(run.scene, given, run.backends.artifacts, "/grounding", may_guess=derived)
    return GroundingReading(given.object or DEFAULT_NAME, place.bbox, prior=prior_of(given), warnings=place.warnings)


def _given_objects(run: Run[SimulateRequest]) -> tuple[tuple[LocatedObject, ...], tuple[str, ...]]:
    """The objects of a request, and warnings.

    Raises as `place_of` does, and `InvalidRequest` for an object that is given twice.
    """
    found: list[LocatedObject] = []
    boxes: list[BBox] = []
    warnings: list[str] = []
    for index, given in enumerate(run.request.objects):
        run.check_canceled()
        place = place_of(run.scene, given, run.backends.artifacts, f"/objects/{index}")
        warnings += place.warnings
        _check_new(place.bbox, boxes, index)
        boxes.append(place.bbox)
        found.append(
            LocatedObject(
                object=given.object,
                bbox=place.bbox,
                role=given.role,
                mask=_store_mask(run, place.bbox) if place.has_mask else None,
                prior=prior_of(given),
                source="request",
            )
        )
    return tuple(found), tuple(warnings)


def _without_mover(given: Sequence[LocatedObject], mover: BBox) -> tuple[tuple[LocatedObject, ...], tuple[str, ...]]:
    """The objects beside the mover, and warnings: one at its place was taken for it."""
    at_mover = [index for index, each in enumerate(given) if _same(each.bbox, mover)]
    told = (f"`objects.{i}` ('{given[i].object}') lies where the mover is, and was taken for it." for i in at_mover)
    return tuple(each for i, each in enumerate(given) if i not in at_mover), tuple(told)


def _check_new(bbox: BBox, boxes: Sequence[BBox], index: int) -> None:
    """Raises `InvalidRequest` for an object that stands before in the request."""
    twin = next((place for place, other in enumerate(boxes) if iou(bbox, other) >= SAME_BOX_IOU), None)
    if twin is not None:
        detail = f"has the same box as `objects.{twin}`"
        raise InvalidRequest(
            f"`objects.{index}` {detail}: give each object once.", errors=(FieldError(f"/objects/{index}", detail),)
        )


def _same(a: BBox, b: BBox) -> bool:
    return iou(a, b) >= SAME_OBJECT_IOU


def _centre(bbox: BBox) -> Point:
    return (bbox[0] + bbox[2]) / 2, (bbox[1] + bbox[3]) / 2
