"""Stage 1: which object moves and where it is, and where the others are that matter."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

from cow_service.errors import (
    ArtifactNotFound,
    CannotGround,
    FieldError,
    ImageTooLarge,
    ImageTypeUnsupported,
    ImageUnreadable,
    InvalidRequest,
    field_of,
)
from cow_service.media.artifacts import ArtifactStore
from cow_service.media.images import decode, decode_own, encode_png
from cow_service.readers.base import GroundingReading
from cow_service.readers.embedded.english.questions import parse
from cow_service.readers.question.wording import same_name
from cow_service.readers.remedies import GIVE_OBJECT
from cow_service.records import (
    Artifact,
    BBox,
    Estimate,
    Grounding,
    Intervention,
    LocatedObject,
    ObjectPrior,
    Point,
    Source,
)
from cow_service.requests import (
    GroundingRequest,
    ImageArtifact,
    InterventionRequest,
    MaskRef,
    PlaceRequest,
    SimulateRequest,
)
from cow_service.stages.keys import StageResult
from cow_service.stages.run import Run
from cow_service.vision.masks import CroppedMask, Mask, bbox_of, iou
from cow_service.vision.regions import SAME_OBJECT_IOU
from cow_service.vision.scene import Scene
from cow_service.vision.segmentation import cut_quality


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


WHITE = 128  # grey level from which a pixel of a mask is the object's
MAX_MASK_SHARE = 0.95  # of the image: more is no object, but an image without a mask
# What is cut out around a point is taken for an object from here on. Objects of scenes with known truth have an area
# of 0.009 and more; of their good cuts one in twenty has less on edges, most tufts of fur or grass have.
LEAST_AREA = 0.0025  # of the square of the image's shorter side
LEAST_ON_EDGE = 0.75  # of the outline
LEAST_SOLIDITY = 0.5


@dataclass(frozen=True)
class Place:
    """Where an object is."""

    bbox: BBox  # px, inside the image
    has_mask: bool  # its outline does not follow from its box: the scene holds it, and it has to be stored
    warnings: tuple[str, ...] = ()


def place_of(
    scene: Scene, given: PlaceRequest, artifacts: ArtifactStore, pointer: str, *, may_guess: bool = False
) -> Place:
    """The place of an object; the scene knows its silhouette afterwards. `pointer` is the JSON Pointer to `given`.

    Raises `InvalidRequest` for a place outside the image and for a mask that is none of this image, and `CannotGround`
    where what can be cut out around a point is no object, unless `may_guess`.
    """
    if given.mask is not None:
        mask = _read_mask(scene, given.mask, artifacts, f"{pointer}/mask")
        bbox, cropped = bbox_of(mask), CroppedMask.of(mask)
        scene.preset_mask(bbox, cropped.full)
        return Place(bbox, has_mask=True)
    if given.point is not None:
        return _around(scene, given.point, pointer, may_guess=may_guess)
    x0, y0, x1, y1 = given.bbox or (0.0, 0.0, 0.0, 0.0)
    clipped = max(0.0, x0), max(0.0, y0), min(float(scene.width), x1), min(float(scene.height), y1)
    if clipped[2] - clipped[0] < 2 or clipped[3] - clipped[1] < 2:
        raise _outside(f"{pointer}/bbox", [x0, y0, x1, y1], scene)
    return Place(clipped, has_mask=False)


def prior_of(given: PlaceRequest) -> ObjectPrior | None:
    """What a request says of an object beside its place, taken as exact."""
    if given.shape is None and given.size is None and given.stands_on is None:
        return None
    size = None if given.size is None else Estimate(value=given.size, deviation=0.0)
    return ObjectPrior(shape=given.shape, size=size, stands_on=given.stands_on)


def _around(scene: Scene, point: Point, pointer: str, *, may_guess: bool) -> Place:
    """The object at a point, with a warning where its outline had to be guessed. Raises as `place_of` does."""
    x, y = point
    if not (0 <= x < scene.width and 0 <= y < scene.height):
        raise _outside(f"{pointer}/point", [x, y], scene)
    bbox = scene.bbox_at(point)
    if scene.region_of(bbox) is not None:
        return Place(bbox, has_mask=False)
    field = field_of(pointer)
    fault = None if may_guess else _fault_of_cut(scene, bbox)
    if fault is not None:
        detail = f"No object could be cut out around the point [{x:.0f}, {y:.0f}]: {fault}"
        raise CannotGround(
            f"{detail}. Give its box as `{field}.bbox`, or its outline as `{field}.mask`.",
            errors=(FieldError(f"{pointer}/point", detail),),
        )
    box = ", ".join(f"{value:.0f}" for value in bbox)
    warning = f"The object around the point was guessed to be [{box}]; `{field}.bbox` says it for certain."
    return Place(bbox, has_mask=True, warnings=(warning,))


def _fault_of_cut(scene: Scene, bbox: BBox) -> str | None:
    """Why what was cut out is no object, in words."""
    quality = cut_quality(scene.clean, scene.silhouette(bbox))
    if quality.area < LEAST_AREA:
        return f"what lies there is only {bbox[2] - bbox[0]:.0f} x {bbox[3] - bbox[1]:.0f} px large"
    if quality.on_edge < LEAST_ON_EDGE:
        return f"only {quality.on_edge:.0%} of the outline of what lies there can be seen"
    if quality.solidity < LEAST_SOLIDITY:
        return "what lies there is ragged, and looks like a part of something"
    return None


def _read_mask(scene: Scene, given: MaskRef, artifacts: ArtifactStore, pointer: str) -> Mask:
    """The mask [H, W] of the image that a request names. Raises `InvalidRequest`."""
    assert isinstance(given, ImageArtifact), "the masks of a request are kept before its stages run"
    try:
        picture = decode(artifacts.read(given.artifact), max_megapixels=scene.width * scene.height / 1e6)
    except (ArtifactNotFound, ImageTooLarge, ImageTypeUnsupported, ImageUnreadable) as error:
        raise mask_error(f"cannot be read: {error.detail}", pointer) from error
    width, height = picture.info.width, picture.info.height
    if (width, height) != (scene.width, scene.height):
        size = f"{scene.width} x {scene.height} px"
        raise mask_error(f"has {width} x {height} px where the upright image has {size}", pointer)
    mask = picture.pixels.min(axis=2) >= WHITE
    share = float(mask.mean())
    if not share:
        raise mask_error("is empty: no pixel is white", pointer)
    if share > MAX_MASK_SHARE:
        raise mask_error(f"covers {share:.0%} of the image: white, or transparent, is the object alone", pointer)
    return mask


def mask_error(fault: str, pointer: str) -> InvalidRequest:
    """What is wrong with the mask of a request."""
    field = field_of(pointer)
    return InvalidRequest(
        f"`{field}` {fault}. Give a PNG of the upright image's size, white where the object is and black elsewhere.",
        errors=(FieldError(pointer, fault),),
    )


def _outside(pointer: str, value: list[float], scene: Scene) -> InvalidRequest:
    detail = f"{value} lies outside the upright image of {scene.width} x {scene.height} px."
    return InvalidRequest(f"{detail} Give pixels, x right and y down.", errors=(FieldError(pointer, detail),))


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


def _centre(bbox: BBox) -> Point:
    return (bbox[0] + bbox[2]) / 2, (bbox[1] + bbox[3]) / 2
