"""Stage 1: which object moves and where it is, where the others are that matter, and what is asked of them."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial

from cow_service.errors import CannotGround, FieldError, InvalidRequest, MllmBadReply, MllmUnavailable, field_of
from cow_service.media.images import decode, encode_png
from cow_service.narration.story import OF_ITSELF, OF_TARGET
from cow_service.narration.words import same_name
from cow_service.perception.outlines import outlines_at, outlines_in
from cow_service.readers.base import GroundingReading, MotionHints, NamedChange, ReaderInput, SeenThing, WordReader
from cow_service.readers.options import plain
from cow_service.readers.remedies import GIVE_OBJECT, GIVE_PLACE
from cow_service.records import Asked, BBox, Grounding, Intervention, LocatedObject, ObjectPrior
from cow_service.requests import ImageArtifact, InterventionRequest, MaskRef, PlaceRequest, SimulateRequest
from cow_service.stages.keys import StageResult
from cow_service.stages.run import UNREADABLE, Run
from cow_service.stages.settling import SeenThings, settle_mover, settle_places, settle_question, things_of
from cow_service.vision.masks import CroppedMask, iou, is_among, is_same_object, mask_iou
from cow_service.vision.segmentation import mask_from_bbox

DEFAULT_NAME = "object"
SAME_BOX_IOU = 0.95  # of two objects of one request: one thing given twice
SAME_MASK = 0.5  # IoU from which two outlines are of one thing
MOST_FOUND = 24  # detections that are outlined, best first
WHITE = 128  # grey level from which a pixel of a mask is the object's
FLOOR = frozenset({"floor", "the floor", "ground", "the ground"})
MAX_SHARE = 0.95  # of the image that a box or a mask covers: more is no object


def ground(run: Run[SimulateRequest]) -> StageResult[Grounding]:
    """The mover, from the request where it says so, else from the reader; its mask [H, W] is stored as PNG.

    The others are those of the request, then those of the reader that are not among them, without what is taken away.
    Raises `InvalidRequest` and `CannotGround` for what the request says of places and for interventions that cannot be
    made, and what the reader raises.
    """
    request, question = run.request, run.question
    # Where things are: as the request says; the reader is asked for the rest.
    with run.cpu():
        given, masks, reading, warnings = _read_places(run)
    source = "request" if reading is not None else run.reader.source
    if reading is None:
        empty, changed = run.reader_input("grounding"), request.changed_names
        sought = tuple(name for name in changed if not any(same_name(name, each.object) for each in given))
        find = partial(_find, run) if "detector" in run.backends.perception.names else None
        reading = _read_and_settle(run, replace(empty, known=given, sought=sought, find=find, words=question))
        if run.can_segment:
            with run.cpu():
                reading = _outlined(run, reading)
    # What the image shows, now that it is known what moves.
    shows_trail = question.trail_named or (reading.hints is not None and reading.hints.cue == "trail")
    with run.cpu():
        scene = run.scene_with(reading.bbox, [each.bbox for each in (*given, *reading.others)], shows_trail)
        silhouette = scene.silhouette(reading.bbox) if reading.mask is None else reading.mask
        mask = run.backends.artifacts.put(encode_png(silhouette), "image/png")
        drawn = [("an arrow", each.tail) for each in scene.arrows if "arrow" not in question.drawings_named]
        drawn += [("a box", each.bbox[:2]) for each in scene.boxes if "box" not in question.drawings_named]
    # The others, and what is changed of all of them.
    asked = reading.asked if request.asked is None else Asked(**dict(request.asked))
    mover = LocatedObject(object=reading.object, bbox=reading.bbox, prior=reading.prior, source=source)
    beside = [each for each, mask in zip(given, masks, strict=True) if not _is_mover(each, mask, reading)]
    boxes = [each.bbox for each in beside]
    seen = (each for each in reading.others if not is_among(each.bbox, boxes))
    others = (*beside, *(each.model_copy(update={"source": each.source or source}) for each in seen))
    interventions = _find_interventions(request, reading, (*others, mover))
    removed = [each.object.bbox for each in interventions if each.kind == "remove"]
    grounding = Grounding(
        object=reading.object,
        point=reading.point or ((mover.bbox[0] + mover.bbox[2]) / 2, (mover.bbox[1] + mover.bbox[3]) / 2),
        bbox=reading.bbox,
        mask=mask,
        others=tuple(other for other in others if not is_among(other.bbox, removed)),
        objects_complete=request.objects_complete or reading.objects_complete,
        interventions=interventions,
        prior=reading.prior,
        asked=asked,
        question_is_doubtful=reading.asked_is_doubtful,
        trail_named=question.trail_named,
        bbox_deviation=reading.bbox_deviation,
        is_doubtful=reading.is_doubtful,
        language=reading.language,
        source=source,
    )
    grounding = put_into_first(understood(grounding, run.backends.words()), request, reading.hints)
    warnings = [*reading.warnings, *warnings]
    warnings += [
        f"`objects.{index}` ('{each.object}') lies where the moving object is, and was taken for it."
        for index, each in enumerate(given)
        if each not in beside and not same_name(each.object, reading.object)
    ]
    if drawn:
        places = ", ".join(f"{name} at ({x:.0f}, {y:.0f})" for name, (x, y) in drawn)
        warnings.append(
            f"Taken for annotations drawn over the image, although the question mentions none: {places}. "
            "They are removed from the frames; `generator_options.clean_cues: false` keeps them."
        )
    if name := asked_of_itself(grounding):
        warnings.append(
            f"Something cannot hit itself, so the question about '{name}' has no answer: ask about another object."
        )
    if request.asked is not None or source != "embedded":  # which warns of what it does not find
        known = [each.object for each in (mover, *others_of(grounding), *removed_of(grounding))]
        asked = grounding.asked
        named = () if asked is None else (asked.subject, asked.target, *asked.among)
        warnings += [
            f"The question asks about '{name}', which was not found in the image, so there is no outcome: give it in "
            "`objects` under this name."
            for name in named
            if name is not None and not any(same_name(name, each) for each in known)
        ]
    things = (*others_of(grounding), *removed_of(grounding))
    artifacts = (mask.sha256, *(each.mask.sha256 for each in things if each.mask is not None))
    return StageResult(value=grounding, warnings=tuple(warnings), artifacts=artifacts, hints=reading.hints)


def _read_and_settle(run: Run[SimulateRequest], given: ReaderInput) -> GroundingReading:
    """What the reader says of places and of what is asked, settled with the words and with what is seen.

    A reader that may be wrong is asked once more with what speaks against its reading, and not to rely on the words
    where that is what they say; a reply that cannot be used then leaves the first. Raises what the reader raises.
    """
    reading = run.reader.ground(given)
    if not run.reader.heeds_objections:
        return reading
    settled, objections, misread = _settled(run, reading, given.known)
    if objections:
        given = replace(given, objections=objections, words=None if misread else given.words)
        with suppress(CannotGround, MllmBadReply, MllmUnavailable):
            settled, objections, _ = _settled(run, run.reader.ground(given), given.known)
    return replace(settled, warnings=(*settled.warnings, *objections))


def _settled(
    run: Run[SimulateRequest], reading: GroundingReading, known: Sequence[LocatedObject]
) -> tuple[GroundingReading, tuple[str, ...], bool]:
    """The reading without what the request says: the places of things that are `known`, what is asked and changed.

    With what speaks against it, and whether that is what the words say of what moves or is asked.
    """
    words, question, request = run.backends.words(), run.question, run.request
    if request.interventions:
        question, reading = replace(question, changes=()), replace(reading, interventions=())
    others = (each for each in reading.others if not any(same_name(each.object, given.object) for given in known))
    if request.objects_complete:
        others = (each for each in others if each.role == "target")
    reading = replace(reading, others=tuple(others))
    with run.cpu():
        scene = run.scene
        boxes = [reading.bbox, *(each.bbox for each in things_of(reading))]
        bare = frozenset(bbox for bbox in boxes if not scene.shows_thing(bbox))
        placed, objections = settle_places(reading, SeenThings(scene.regions, bare))
    settled, misnamed = settle_mover(placed, question, words)
    settled, misread = settle_question(settled, question, words, is_given=request.asked is not None)
    return settled, (*objections, *misnamed, *misread), bool(misnamed or misread)


def _is_mover(thing: LocatedObject, mask: CroppedMask | None, mover: GroundingReading) -> bool:
    """Whether a thing is what moves. Two masks tell, however much their boxes overlap."""
    if mask is None or mover.mask is None:
        return is_same_object(thing.bbox, mover.bbox)
    return mask_iou(mask.full(), mover.mask) > SAME_MASK


# --- places that the request gives


@dataclass(frozen=True)
class Place:
    """Where an object is."""

    bbox: BBox  # px, inside the image
    mask: CroppedMask | None = None  # where it does not follow from the box
    warnings: tuple[str, ...] = ()
    is_doubtful: bool = False  # no two looks at it agree on its outline


def _read_places(
    run: Run[SimulateRequest],
) -> tuple[tuple[LocatedObject, ...], list[CroppedMask | None], GroundingReading | None, list[str]]:
    """The objects of a request with their masks, what it says of the mover and asks in words, and warnings.

    The third is None where the mover is left to the reader. Raises as `_locate` does, and for an object that is given
    twice.
    """
    request = run.request
    given = [(f"/objects/{index}", each) for index, each in enumerate(request.objects)]
    mover = [] if request.place is None else [("/grounding", request.place)]
    places = [_locate(run, each, pointer) for pointer, each in (*given, *mover)]
    masks = [place.mask for place in places[: len(given)]]
    objects, warnings = list[LocatedObject](), list[str]()
    for (pointer, each), place in zip(given, places, strict=False):
        twin = next((at for at, other in enumerate(objects) if iou(place.bbox, other.bbox) >= SAME_BOX_IOU), None)
        if twin is not None:
            detail = f"lies in the same box as `objects.{twin}`"
            message = f"`{field_of(pointer)}` {detail}: give each object once."
            raise InvalidRequest(message, errors=(FieldError(pointer, detail),))
        mask = None if place.mask is None else run.backends.artifacts.put(encode_png(place.mask.full()), "image/png")
        objects.append(
            LocatedObject(
                object=each.object,
                bbox=place.bbox,
                role=each.role,
                mask=mask,
                prior=each.prior,
                source="request",
                is_doubtful=place.is_doubtful,
            )
        )
        warnings += place.warnings
    if request.place is None:
        return tuple(objects), masks, None, warnings
    reading = GroundingReading(
        request.place.object or DEFAULT_NAME,
        places[-1].bbox,
        prior=request.place.prior,
        mask=None if places[-1].mask is None else places[-1].mask.full(),
        warnings=places[-1].warnings,
        changes=() if request.interventions else run.question.changes,
        asked=run.question.asked,
        is_doubtful=places[-1].is_doubtful,
    )
    return tuple(objects), masks, reading, warnings


def _locate(run: Run[SimulateRequest], given: PlaceRequest, pointer: str) -> Place:
    """The place of an object; `pointer` is the JSON Pointer to `given`.

    Raises `InvalidRequest` for a place outside the image or all over it and for a mask that is none of this image, and
    `CannotGround` where what can be cut out around a point is no object.
    """
    run.check_canceled()
    scene, field = run.scene, field_of(pointer)
    outside = f"lies outside the upright image of {scene.width} x {scene.height} px"
    if given.mask is not None:
        mask = _read_mask(run, given.mask, f"{pointer}/mask")
        scene.preset_mask(mask.bbox, mask.full)
        return Place(mask.bbox, mask)
    if given.bbox is not None:
        x0, y0, x1, y1 = given.bbox
        clipped = max(0.0, x0), max(0.0, y0), min(float(scene.width), x1), min(float(scene.height), y1)
        wide, high = clipped[2] - clipped[0], clipped[3] - clipped[1]
        if wide < 2 or high < 2:
            raise _misplaced(f"{pointer}/bbox", given.bbox, outside)
        if (share := wide * high / (scene.width * scene.height)) > MAX_SHARE:
            raise _misplaced(f"{pointer}/bbox", given.bbox, f"covers {share:.0%} of the image")
        beyond = f"`{field}.bbox` {list(given.bbox)} reaches beyond the image, so {list(clipped)} of it was taken."
        warnings = () if clipped == given.bbox else (beyond,)
        return _outlined_box(run, clipped, field, warnings) if run.can_segment else Place(clipped, warnings=warnings)
    x, y = given.point or (0.0, 0.0)
    if not (0 <= x < scene.width and 0 <= y < scene.height):
        raise _misplaced(f"{pointer}/point", (x, y), outside)
    # The first point of a path says less of the mover than a point that is given for it.
    may_guess = pointer == "/grounding" and run.request.grounding is None
    if run.can_segment:
        found = outlines_at(run.embedded(), (x, y))
        if len(found) == 1 or (found and may_guess):
            mask = CroppedMask.of(found[0].mask)
            scene.preset_mask(found[0].bbox, mask.full)
            return Place(found[0].bbox, mask)
        fault = (
            f"{len(found)} objects lie there, one inside the other."
            if found
            else "two attempts to outline it disagree."
        )
        if not may_guess:
            raise _not_cut_out(f"The object at the point [{x:.0f}, {y:.0f}] is not clear: {fault}", pointer)
    cutout = scene.locate((x, y))
    if cutout.mask is None:
        return Place(cutout.bbox)
    if cutout.fault is not None and not may_guess:
        raise _not_cut_out(f"No object could be cut out around the point [{x:.0f}, {y:.0f}]: {cutout.fault}.", pointer)
    box = ", ".join(f"{value:.0f}" for value in cutout.bbox)
    warning = f"The object around the point was guessed to be [{box}]; `{field}.bbox` says it for certain."
    return Place(cutout.bbox, CroppedMask.of(cutout.mask), (warning,))


def _not_cut_out(detail: str, pointer: str) -> CannotGround:
    field = field_of(pointer)
    return CannotGround(
        f"{detail} Give its box as `{field}.bbox`, or its outline as `{field}.mask`.",
        errors=(FieldError(f"{pointer}/point", detail),),
    )


def _outlined_box(run: Run[SimulateRequest], bbox: BBox, field: str, warnings: tuple[str, ...]) -> Place:
    """What the segmenter sees in a box that the request gives; where it is not sure of it, nothing else is."""
    (outline,) = outlines_in(run.embedded(), [bbox])
    if outline is None or not outline.is_sure:
        doubt = f"Two attempts to outline what is in `{field}.bbox` disagree: give its outline as `{field}.mask`."
        mask = None if outline is None else CroppedMask.of(outline.mask)
        return Place(bbox, mask, (*warnings, doubt), is_doubtful=True)
    mask = CroppedMask.of(outline.mask)
    run.scene.preset_mask(outline.bbox, mask.full)
    return Place(outline.bbox, mask, warnings)


def _find(run: Run[SimulateRequest], nouns: Sequence[str]) -> tuple[SeenThing, ...]:
    """What the detector finds for some nouns, outlined as well as can be. To be called with `cpu` held."""
    detector, scene = run.backends.perception.detector, run.scene
    assert detector is not None, "asked for only where there is a detector"
    found = detector.detect(scene.undrawn, nouns)[:MOST_FOUND] if nouns else ()
    if not run.can_segment:
        masks = [(each, mask_from_bbox(scene.clean, each.bbox)) for each in found]
        return tuple(SeenThing(each.phrase, mask, each.score) for each, mask in masks if mask.any())
    outlines = zip(found, outlines_in(run.embedded(), [each.bbox for each in found]), strict=True)
    return tuple(SeenThing(each.phrase, one.mask, each.score) for each, one in outlines if one and one.is_sure)


def _outlined(run: Run[SimulateRequest], reading: GroundingReading) -> GroundingReading:
    """The reading with its things outlined by the segmenter. To be called with `cpu` held.

    Raises `CannotGround` where no two looks agree on the outline of the mover: a scrap of it would be moved. Of others
    on which none agree, nothing is sure.
    """
    changed = [thing for each in reading.interventions for thing in (each.object, *each.targets)]
    located = [each for each in (*reading.others, *changed) if each.mask is None]
    boxes = dict.fromkeys((reading.bbox, *(each.bbox for each in located)))
    outlines = dict(zip(boxes, outlines_in(run.embedded(), list(boxes)), strict=True))
    own, doubted = outlines[reading.bbox], list[str]()
    if own is None or not own.is_sure:
        box = ", ".join(f"{value:.0f}" for value in reading.bbox)
        raise CannotGround(
            f"'{reading.object}' was looked for in [{box}], but two attempts to outline it disagree.", remedy=GIVE_PLACE
        )

    def outlined(thing: LocatedObject) -> LocatedObject:
        outline = outlines.get(thing.bbox) if thing.mask is None else None
        if thing.mask is not None:
            return thing
        if outline is not None and mask_iou(outline.mask, own.mask) > SAME_MASK:  # the mover, under another name
            return thing.model_copy(update={"bbox": own.bbox})
        if outline is None or not outline.is_sure:
            doubted.append(thing.object)
            return thing.model_copy(update={"is_doubtful": True})
        mask = run.backends.artifacts.put(encode_png(outline.mask), "image/png")
        return thing.model_copy(update={"bbox": outline.bbox, "bbox_deviation": 0.0, "mask": mask})

    others = tuple(outlined(each) for each in reading.others)
    interventions = tuple(
        each.model_copy(update={"object": outlined(each.object), "targets": tuple(map(outlined, each.targets))})
        for each in reading.interventions
    )
    doubts = [
        f"Two attempts to outline '{name}' disagree: give it in `objects`, with its `mask`."
        for name in dict.fromkeys(doubted)
    ]
    return replace(
        reading,
        bbox=own.bbox,
        bbox_deviation=0.0,
        mask=own.mask,
        others=others,
        interventions=interventions,
        warnings=(*reading.warnings, *doubts),
    )


def _misplaced(pointer: str, value: Sequence[float], fault: str) -> InvalidRequest:
    detail = f"{list(value)} {fault}."
    message = f"`{field_of(pointer)}`: {detail} Give pixels of the object alone, x right and y down."
    return InvalidRequest(message, errors=(FieldError(pointer, detail),))


def _read_mask(run: Run[SimulateRequest], given: MaskRef, pointer: str) -> CroppedMask:
    """The mask of the image that a request names. Raises `InvalidRequest`."""
    assert isinstance(given, ImageArtifact), "the masks of a request are kept before its stages run"
    image = run.image.info

    def refused(fault: str) -> InvalidRequest:
        return InvalidRequest(
            f"`{field_of(pointer)}` {fault}. Give a PNG of the upright image's size, white where the object is and "
            "black elsewhere.",
            errors=(FieldError(pointer, fault),),
        )

    try:
        data = run.backends.artifacts.read(given.artifact)
        picture = decode(data, max_megapixels=image.width * image.height / 1e6)
    except UNREADABLE as error:
        raise refused(f"cannot be read: {error.detail}") from error
    mask = picture.pixels.min(axis=2) >= WHITE
    share = float(mask.mean())
    if (picture.info.width, picture.info.height) != (image.width, image.height):
        given_size, size = (f"{each.width} x {each.height} px" for each in (picture.info, image))
        raise refused(f"has {given_size} where the upright image has {size}")
    if not share:
        raise refused("is empty: no pixel is white")
    if share > MAX_SHARE:
        raise refused(f"covers {share:.0%} of the image: white, or transparent, is the object alone")
    return CroppedMask.of(mask)


# --- interventions


def _find_interventions(
    request: SimulateRequest, reading: GroundingReading, things: Sequence[LocatedObject]
) -> tuple[Intervention, ...]:
    """Those of the request, else those of the question; the last of `things` is the mover.

    Raises `InvalidRequest` for an object that is not there, for what is done twice, for a thing that is put to itself,
    and for the mover taken away; `CannotGround` where the question says so.
    """
    mover, found = things[-1], list[Intervention]()
    given = [(f"/interventions/{index}", change) for index, change in enumerate(request.interventions)]
    read = [(None, change) for change in (*reading.interventions, *reading.changes)]
    for pointer, change in given or read:
        each = change if isinstance(change, Intervention) else _located(change, things, pointer)
        name, box, targets = each.object.object, each.object.bbox, [thing.bbox for thing in each.targets]
        taken = [other.object.bbox for other in found if other.kind == "remove"]
        put = [other for other in found if other.kind == "place"]
        if each.kind == "remove":
            used = [thing.bbox for other in put for thing in (other.object, *other.targets)]
            faults = {
                f"'{name}' is what moves: it cannot be taken away.": is_same_object(box, mover.bbox),
                f"'{name}' is taken away twice: name each object once.": is_among(box, taken),
                f"'{name}' takes part in another change: it cannot be taken away.": is_among(box, used),
            }
        else:
            relation = (each.relation or "to").replace("-", " ")
            gone = [thing.object for thing in (each.object, *each.targets) if is_among(thing.bbox, taken)]
            twice = is_among(box, [other.object.bbox for other in put])
            faults = {
                f"'{name}' cannot be put {relation} itself.": is_among(box, targets),
                f"'{name}' is put somewhere twice: name each object once.": twice,
                f"'{gone[0] if gone else ''}' is taken away: nothing can be put there, nor it elsewhere.": bool(gone),
            }
        fault = next((fault for fault, holds in faults.items() if holds), None)
        if fault is not None and pointer is None:
            raise CannotGround(f"{fault} Ask about another object, or state the change in `interventions`.")
        if fault is not None and pointer is not None:
            raise InvalidRequest(f"`{field_of(pointer)}`: {fault}", errors=(FieldError(pointer, fault),))
        found.append(each)
    return tuple(found)


def _located(
    change: InterventionRequest | NamedChange, things: Sequence[LocatedObject], pointer: str | None = None
) -> Intervention:
    """A change with its objects in the place of their names, of the request at a JSON Pointer or of the question.

    Raises `InvalidRequest` for a name that none of the things has.
    """
    found: list[LocatedObject] = []
    for field, name in (
        *((f"targets/{at}", name) for at, name in enumerate(change.targets)),
        ("object", change.object),
    ):
        thing = next((thing for thing in things if same_name(thing.object, name)), None)
        if thing is None:
            at, detail = "/objects", f"the question changes '{name}', which is not looked for when `grounding` is given"
            if pointer is not None:
                known = ", ".join(f"'{each.object}'" for each in things)
                detail = f"there is no '{name}' among the objects of the scene, which are {known}"
                at = f"{pointer}/{field}"
            raise InvalidRequest(f"`{field_of(at)}`: {detail}.", remedy=GIVE_OBJECT, errors=(FieldError(at, detail),))
        found.append(thing)
    return Intervention(kind=change.kind, object=found[-1], relation=change.relation, targets=tuple(found[:-1]))


# --- what a grounding says of its things


def placed_mover(grounding: Grounding) -> Intervention | None:
    """The intervention that puts the grounded object somewhere; None where it stays or moves by itself."""
    placed = (each for each in grounding.interventions if each.kind == "place")
    return next((each for each in placed if is_same_object(each.object.bbox, grounding.bbox)), None)


def put_into_first(grounding: Grounding, request: SimulateRequest, hints: MotionHints | None) -> Grounding:
    """With the mover put into the first of several things, if it is asked into which of them it fits and nothing says
    how it moves."""
    asked, mover = grounding.asked, LocatedObject(object=grounding.object, bbox=grounding.bbox, source=grounding.source)
    if asked is None or (asked.form, asked.relation, asked.subject) != ("which", "inside", None):
        return grounding
    given, kind = request.stated_motion, None if hints is None else hints.kind
    if grounding.source == "request" and request.trajectory is None:
        kind = "place" if given is None else given.stated_kind
    first = [each for each in others_of(grounding) if asked.among and same_name(each.object, asked.among[0])]
    if kind != "place" or not first or placed_mover(grounding) is not None:
        return grounding
    put = Intervention(kind="place", object=mover, relation="into", targets=tuple(first[:1]))
    return grounding.model_copy(update={"interventions": (*grounding.interventions, put)})


def asked_of_itself(grounding: Grounding) -> str | None:
    """The thing of which it is asked whether it meets, hides or holds itself: none can."""
    asked = grounding.asked
    if asked is None or asked.target is None or asked.relation in (*OF_TARGET, *OF_ITSELF):
        return None
    return asked.target if same_name(asked.target, asked.subject or grounding.object) else None


def others_of(grounding: Grounding) -> tuple[LocatedObject, ...]:
    """The other objects of a grounding, what is put somewhere and what it is put to among them."""
    found, mover = list(grounding.others), grounding.bbox
    for each in grounding.interventions:
        moved = [each.object] if each.kind == "place" and not is_same_object(each.object.bbox, mover) else []
        boxes = [thing.bbox for thing in found]
        found += [thing for thing in (*moved, *each.targets) if not is_among(thing.bbox, boxes)]
    return tuple(found)


def removed_of(grounding: Grounding) -> tuple[LocatedObject, ...]:
    """What is taken away."""
    return tuple(each.object for each in grounding.interventions if each.kind == "remove")


def understood(grounding: Grounding, words: WordReader) -> Grounding:
    """The grounding with what the names of its things say of their shapes, and with the things that a kind means."""

    def prior_of(thing: LocatedObject | Grounding) -> ObjectPrior | None:
        """Its prior, completed by what its name says; None where neither says anything."""
        said = {field: value for field, value in thing.prior or () if value}
        completed = words.read_name(thing.object).model_copy(update=said)
        return None if completed == ObjectPrior() else completed

    def described(thing: LocatedObject) -> LocatedObject:
        return thing.model_copy(update={"prior": prior_of(thing)})

    asked = grounding.asked
    if asked is not None and asked.among:
        apart = {plain(grounding.object), plain(asked.subject or "")}
        names = [other.object for other in others_of(grounding) if plain(other.object) not in apart]
        # Of what is met first the floor is what is left, where no thing is met.
        things = [said for said in asked.among if asked.form != "which-first" or plain(said) not in FLOOR]
        among = dict.fromkeys(name for said in things for name in words.names_meant(said, names))
        asked = asked.model_copy(update={"among": tuple(among)})
    interventions = (
        each.model_copy(update={"object": described(each.object), "targets": tuple(map(described, each.targets))})
        for each in grounding.interventions
    )
    return grounding.model_copy(
        update={
            "others": tuple(map(described, grounding.others)),
            "interventions": tuple(interventions),
            "prior": prior_of(grounding),
            "asked": asked,
        }
    )
