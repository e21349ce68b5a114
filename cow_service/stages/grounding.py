"""Stage 1: which object moves and where it is, where the others are that matter, and what is asked of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
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
from cow_service.media.images import decode, encode_png
from cow_service.narration import same_name
from cow_service.readers.base import GroundingReading, NamedChange, WordReader
from cow_service.readers.options import plain
from cow_service.readers.remedies import GIVE_OBJECT
from cow_service.records import Artifact, Asked, BBox, Estimate, Grounding, Intervention, LocatedObject, ObjectPrior
from cow_service.requests import ImageArtifact, InterventionRequest, MaskRef, PlaceRequest, SimulateRequest
from cow_service.stages.keys import StageResult
from cow_service.stages.run import Run
from cow_service.vision.masks import bbox_of, iou
from cow_service.vision.regions import SAME_OBJECT_IOU
from cow_service.vision.scene import Scene
from cow_service.vision.types import Mask

DEFAULT_NAME = "object"
SAME_BOX_IOU = 0.95  # of two objects of one request: one thing given twice
WHITE = 128  # grey level from which a pixel of a mask is the object's
MAX_MASK_SHARE = 0.95  # of the image: more is no object, but an image without a mask


def ground(run: Run[SimulateRequest]) -> StageResult[Grounding]:
    """The mover, from the request where it says so, else from the reader; its mask [H, W] is stored as PNG.

    The others are those of the request, then those of the reader that are not among them, without what is taken away.
    Raises `InvalidRequest` and `CannotGround` for what the request says of places and for interventions that cannot be
    made, and what the reader raises.
    """
    with run.cpu():
        given, warnings = _given_objects(run)
        reading = _given_mover(run)
    source = "request" if reading is not None else run.reader.source
    if reading is None:
        names = (name for name in run.request.changed_names if not any(same_name(name, o.object) for o in given))
        reading = run.reader.ground(replace(run.reader_input("grounding"), known=given, sought=tuple(names)))
    shows_trail = run.question.trail_named or (reading.hints is not None and reading.hints.cue == "trail")
    with run.cpu():
        scene = run.scene_with(reading.bbox, shows_trail)
        mask = _store_mask(run, scene.silhouette(reading.bbox) if reading.mask is None else reading.mask)
        drawings = _drawings_not_named(scene, run.question.drawings_named)
    mover = LocatedObject(object=reading.object, bbox=reading.bbox, prior=reading.prior, source=source)
    others, taken_for_mover = _without_mover(given, reading.bbox)
    seen = tuple(
        other.model_copy(update={"source": other.source or source})
        for other in reading.others
        if not is_among(other.bbox, others)
    )
    interventions = _find_interventions(run, reading, (*others, *seen, mover))
    removed = [each.object for each in interventions if each.kind == "remove"]
    grounding = Grounding(
        object=reading.object,
        point=reading.point or ((mover.bbox[0] + mover.bbox[2]) / 2, (mover.bbox[1] + mover.bbox[3]) / 2),
        bbox=reading.bbox,
        mask=mask,
        others=tuple(other for other in (*others, *seen) if not is_among(other.bbox, removed)),
        interventions=interventions,
        prior=reading.prior,
        asked=reading.asked if run.request.asked is None else Asked(**dict(run.request.asked)),
        trail_named=run.question.trail_named,
        source=source,
    )
    return StageResult(
        value=understood(grounding, run.backends.words()),
        warnings=(*reading.warnings, *warnings, *taken_for_mover, *drawings),
        artifacts=(mask.sha256, *(other.mask.sha256 for other in others if other.mask is not None)),
        hints=reading.hints,
    )


# --- places that the request gives


@dataclass(frozen=True)
class Place:
    """Where an object is."""

    bbox: BBox  # px, inside the image
    mask: Mask | None = None  # [H, W], where it does not follow from the box
    warnings: tuple[str, ...] = ()


def _given_mover(run: Run[SimulateRequest]) -> GroundingReading | None:
    """What a request says of the mover, and its question in words; None where it leaves that to the reader."""
    given = run.request.place
    if given is None:
        return None
    # The first point of a path says less of the mover than a point that is given for it.
    place = _locate(run, given, "/grounding", may_guess=run.request.grounding is None)
    return GroundingReading(
        given.object or DEFAULT_NAME,
        place.bbox,
        prior=_prior_of(given),
        mask=place.mask,
        warnings=place.warnings,
        changes=() if run.request.interventions else run.question.changes,
        asked=run.question.asked,
    )


def _given_objects(run: Run[SimulateRequest]) -> tuple[tuple[LocatedObject, ...], tuple[str, ...]]:
    """The objects of a request, and warnings. Raises as `_locate` does, and for an object that is given twice."""
    found: list[LocatedObject] = []
    warnings: list[str] = []
    for index, given in enumerate(run.request.objects):
        run.check_canceled()
        place = _locate(run, given, f"/objects/{index}")
        warnings += place.warnings
        twin = next((at for at, other in enumerate(found) if iou(place.bbox, other.bbox) >= SAME_BOX_IOU), None)
        if twin is not None:
            detail = f"has the same box as `objects.{twin}`"
            raise InvalidRequest(
                f"`objects.{index}` {detail}: give each object once.", errors=(FieldError(f"/objects/{index}", detail),)
            )
        mask = None if place.mask is None else _store_mask(run, place.mask)
        prior = _prior_of(given)
        found.append(
            LocatedObject(
                object=given.object, bbox=place.bbox, role=given.role, mask=mask, prior=prior, source="request"
            )
        )
    return tuple(found), tuple(warnings)


def _locate(run: Run[SimulateRequest], given: PlaceRequest, pointer: str, *, may_guess: bool = False) -> Place:
    """The place of an object; `pointer` is the JSON Pointer to `given`.

    Raises `InvalidRequest` for a place outside the image and for a mask that is none of this image, and `CannotGround`
    where what can be cut out around a point is no object, unless `may_guess`.
    """
    scene, field = run.scene, field_of(pointer)
    if given.mask is not None:
        mask = _read_mask(run, given.mask, f"{pointer}/mask")
        scene.preset_mask(bbox_of(mask), lambda: mask)
        return Place(bbox_of(mask), mask)
    if given.bbox is not None:
        x0, y0, x1, y1 = given.bbox
        clipped = max(0.0, x0), max(0.0, y0), min(float(scene.width), x1), min(float(scene.height), y1)
        if clipped[2] - clipped[0] < 2 or clipped[3] - clipped[1] < 2:
            raise _outside(f"{pointer}/bbox", given.bbox, scene)
        return Place(clipped)
    x, y = given.point or (0.0, 0.0)
    if not (0 <= x < scene.width and 0 <= y < scene.height):
        raise _outside(f"{pointer}/point", (x, y), scene)
    cutout = scene.locate((x, y))
    if cutout.mask is None:
        return Place(cutout.bbox)
    if cutout.fault is not None and not may_guess:
        detail = f"No object could be cut out around the point [{x:.0f}, {y:.0f}]: {cutout.fault}"
        raise CannotGround(
            f"{detail}. Give its box as `{field}.bbox`, or its outline as `{field}.mask`.",
            errors=(FieldError(f"{pointer}/point", detail),),
        )
    box = ", ".join(f"{value:.0f}" for value in cutout.bbox)
    warning = f"The object around the point was guessed to be [{box}]; `{field}.bbox` says it for certain."
    return Place(cutout.bbox, cutout.mask, (warning,))


def _read_mask(run: Run[SimulateRequest], given: MaskRef, pointer: str) -> Mask:
    """The mask [H, W] of the image that a request names. Raises `InvalidRequest`."""
    assert isinstance(given, ImageArtifact), "the masks of a request are kept before its stages run"
    image, fault = run.image.info, ""
    try:
        data = run.backends.artifacts.read(given.artifact)
        picture = decode(data, max_megapixels=image.width * image.height / 1e6)
    except (ArtifactNotFound, ImageTooLarge, ImageTypeUnsupported, ImageUnreadable) as error:
        raise _mask_error(f"cannot be read: {error.detail}", pointer) from error
    mask = picture.pixels.min(axis=2) >= WHITE
    share = float(mask.mean())
    if (picture.info.width, picture.info.height) != (image.width, image.height):
        sizes = f"{picture.info.width} x {picture.info.height} px where the upright image has {image.width}"
        fault = f"has {sizes} x {image.height} px"
    elif not share:
        fault = "is empty: no pixel is white"
    elif share > MAX_MASK_SHARE:
        fault = f"covers {share:.0%} of the image: white, or transparent, is the object alone"
    if fault:
        raise _mask_error(fault, pointer)
    return mask


def _mask_error(fault: str, pointer: str) -> InvalidRequest:
    """What is wrong with the mask of a request."""
    return InvalidRequest(
        f"`{field_of(pointer)}` {fault}. Give a PNG of the upright image's size, white where the object is and black "
        "elsewhere.",
        errors=(FieldError(pointer, fault),),
    )


def _outside(pointer: str, value: Sequence[float], scene: Scene) -> InvalidRequest:
    detail = f"{list(value)} lies outside the upright image of {scene.width} x {scene.height} px."
    return InvalidRequest(f"{detail} Give pixels, x right and y down.", errors=(FieldError(pointer, detail),))


def _prior_of(given: PlaceRequest) -> ObjectPrior | None:
    """What a request says of an object beside its place, taken as exact."""
    if given.shape is None and given.size is None and given.stands_on is None:
        return None
    size = None if given.size is None else Estimate(value=given.size, deviation=0.0)
    return ObjectPrior(shape=given.shape, size=size, stands_on=given.stands_on)


def _store_mask(run: Run[SimulateRequest], mask: Mask) -> Artifact:
    return run.backends.artifacts.put(encode_png(mask), "image/png")


def _without_mover(given: Sequence[LocatedObject], mover: BBox) -> tuple[tuple[LocatedObject, ...], tuple[str, ...]]:
    """The objects beside the mover, and warnings: one at its place was taken for it."""
    at_mover = [index for index, each in enumerate(given) if is_same(each.bbox, mover)]
    told = (f"`objects.{i}` ('{given[i].object}') lies where the mover is, and was taken for it." for i in at_mover)
    return tuple(each for i, each in enumerate(given) if i not in at_mover), tuple(told)


def _drawings_not_named(scene: Scene, named: frozenset[str]) -> tuple[str, ...]:
    """A warning for arrows and boxes that were taken for drawn over the image."""
    places = [f"an arrow at ({a.tail[0]:.0f}, {a.tail[1]:.0f})" for a in scene.arrows if "arrow" not in named]
    places += [f"a box at ({b.bbox[0]:.0f}, {b.bbox[1]:.0f})" for b in scene.boxes if "box" not in named]
    if not places:
        return ()
    return (
        f"Taken for drawn over the image though the question speaks of none: {', '.join(places)}. "
        f"A generator that cleans cues takes them out; `generator_options.clean_cues: false` keeps them.",
    )


# --- interventions


def _find_interventions(
    run: Run[SimulateRequest], reading: GroundingReading, things: Sequence[LocatedObject]
) -> tuple[Intervention, ...]:
    """Those of the request, then those of the question that are not among them; the last of `things` is the mover.

    Raises `InvalidRequest` for an object that is not there, for what is done twice, for a thing that is put to itself,
    and for the mover taken away; `CannotGround` where the question says so.
    """
    found: list[Intervention] = []
    for index, wanted in enumerate(run.request.interventions):
        pointer = f"/interventions/{index}"
        each = _located(wanted, things, partial(_not_there, things, pointer))
        fault = _fault(each, things[-1], found)
        if fault is not None:
            raise InvalidRequest(f"`interventions.{index}`: {fault}", errors=(FieldError(pointer, fault),))
        found.append(each)
    of_question = [_located(change, things, _nobody_looks_for) for change in reading.changes]
    for each in (*reading.interventions, *of_question):
        if any(_is_same_change(each, other) for other in found):
            continue
        fault = _fault(each, things[-1], found)
        if fault is not None:
            raise CannotGround(f"{fault} Ask of another object, or state the change as `interventions`.")
        found.append(each)
    return tuple(found)


def _located(
    change: InterventionRequest | NamedChange,
    things: Sequence[LocatedObject],
    missing: Callable[[str, str], InvalidRequest],
) -> Intervention:
    """A change with its objects in the place of their names. Raises what is `missing` for a name and its field."""

    def named(words: str, field: str) -> LocatedObject:
        found = next((thing for thing in things if same_name(thing.object, words)), None)
        if found is None:
            raise missing(words, field)
        return found

    targets = tuple(named(name, f"targets/{at}") for at, name in enumerate(change.targets))
    return Intervention(
        kind=change.kind, object=named(change.object, "object"), relation=change.relation, targets=targets
    )


def _not_there(things: Sequence[LocatedObject], pointer: str, words: str, field: str) -> InvalidRequest:
    pointer = f"{pointer}/{field}"
    known = ", ".join(f"'{thing.object}'" for thing in things)
    detail = f"there is no '{words}' among the objects of the scene, which are {known}"
    return InvalidRequest(f"`{field_of(pointer)}`: {detail}. {GIVE_OBJECT}", errors=(FieldError(pointer, detail),))


def _nobody_looks_for(words: str, field: str) -> InvalidRequest:
    detail = f"the question changes '{words}', and with `grounding` given nobody looks for it"
    return InvalidRequest(f"`objects`: {detail}. {GIVE_OBJECT}", errors=(FieldError("/objects", detail),))


def _fault(each: Intervention, mover: LocatedObject, before: Sequence[Intervention]) -> str | None:
    """Why a change cannot be made, as a sentence."""
    name, box = each.object.object, each.object.bbox
    taken = [other.object for other in before if other.kind == "remove"]
    put = [other for other in before if other.kind == "place"]
    if each.kind == "remove":
        used = [thing for other in put for thing in (other.object, *other.targets)]
        faults = {
            f"'{name}' is what moves: it cannot be taken away.": is_same(box, mover.bbox),
            f"'{name}' is taken away twice: name each object once.": is_among(box, taken),
            f"'{name}' is put somewhere, or something is put to it: it cannot be taken away.": is_among(box, used),
        }
    else:
        relation = (each.relation or "to").replace("-", " ")
        gone = [thing.object for thing in (each.object, *each.targets) if is_among(thing.bbox, taken)]
        twice = is_among(box, [other.object for other in put])
        faults = {
            f"'{name}' cannot be put {relation} itself.": is_among(box, each.targets),
            f"'{name}' is put somewhere twice: name each object once.": twice,
            f"'{gone[0] if gone else ''}' is taken away: it cannot be put, nor anything to it.": bool(gone),
        }
    return next((fault for fault, holds in faults.items() if holds), None)


def _is_same_change(a: Intervention, b: Intervention) -> bool:
    alike = (a.kind, a.relation, len(a.targets)) == (b.kind, b.relation, len(b.targets))
    pairs = zip((a.object, *a.targets), (b.object, *b.targets), strict=False)
    return alike and all(is_same(one.bbox, other.bbox) for one, other in pairs)


def is_same(a: BBox, b: BBox) -> bool:
    """Whether two boxes are of one object."""
    return iou(a, b) >= SAME_OBJECT_IOU


def is_among(box: BBox, things: Sequence[LocatedObject]) -> bool:
    """Whether one of some things is in a box."""
    return any(is_same(box, thing.bbox) for thing in things)


# --- what a grounding says of its things


def placed_mover(grounding: Grounding) -> Intervention | None:
    """The intervention that puts the grounded object somewhere; None where it stays or moves by itself."""
    placed = (each for each in grounding.interventions if each.kind == "place")
    return next((each for each in placed if is_same(each.object.bbox, grounding.bbox)), None)


def others_of(grounding: Grounding) -> tuple[LocatedObject, ...]:
    """The other objects of a grounding, what is put somewhere and what it is put to among them."""
    found = list(grounding.others)
    for each in grounding.interventions:
        moved = [each.object] if each.kind == "place" and not is_same(each.object.bbox, grounding.bbox) else []
        found += [thing for thing in (*moved, *each.targets) if not is_among(thing.bbox, found)]
    return tuple(found)


def understood(grounding: Grounding, words: WordReader) -> Grounding:
    """The grounding with what the names of its things say of their shapes, and with the things that a kind means."""

    def described(thing: LocatedObject) -> LocatedObject:
        return thing.model_copy(update={"prior": _with_name(thing.prior, thing.object, words)})

    asked = grounding.asked
    if asked is not None and asked.among:
        apart = {plain(grounding.object), plain(asked.subject or "")}
        names = [other.object for other in others_of(grounding) if plain(other.object) not in apart]
        among = dict.fromkeys(name for said in asked.among for name in words.names_meant(said, names))
        asked = asked.model_copy(update={"among": tuple(among)})
    interventions = (
        each.model_copy(
            update={"object": described(each.object), "targets": tuple(described(target) for target in each.targets)}
        )
        for each in grounding.interventions
    )
    return grounding.model_copy(
        update={
            "others": tuple(described(other) for other in grounding.others),
            "interventions": tuple(interventions),
            "prior": _with_name(grounding.prior, grounding.object, words),
            "asked": asked,
        }
    )


def _with_name(prior: ObjectPrior | None, name: str, words: WordReader) -> ObjectPrior | None:
    """A prior, completed by what the object's name says; None where neither says anything."""
    said = {field: value for field, value in prior or () if value}
    completed = words.read_name(name).model_copy(update=said)
    return None if completed == ObjectPrior() else completed
