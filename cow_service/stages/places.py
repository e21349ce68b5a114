"""Where things are: as a request gives it, and as a reader or a detector says it, outlined as well as can be."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cow_service.errors import CannotGround, FieldError, InvalidRequest, field_of
from cow_service.media.images import decode, encode_png
from cow_service.media.masks import CroppedMask, iou, is_same_object, mask_iou
from cow_service.perception.base import Embedded, Thing
from cow_service.perception.observation import Observation
from cow_service.perception.outlines import find_named, outlines_at, outlines_in
from cow_service.readers.base import GIVE_PLACE
from cow_service.records import BBox, GroundingRequest, LocatedObject, MaskRef, ObjectRequest, Reading, kept_mask
from cow_service.requests import SimulateRequest
from cow_service.stages.run import UNREADABLE, Run
from cow_service.stages.settling import box_of, mover_of

DEFAULT_NAME = "object"
SAME_BOX_IOU = 0.95  # of two objects of one request: one thing given twice
SAME_MASK = 0.5  # IoU from which two outlines are of one thing
OWN_MASK = 0.5  # share of a mask that must lie in the box given with it
WHITE = 128  # grey level from which a pixel of a mask is the object's
LEAST_SIDE = 2  # px, of a mask
MAX_SHARE = 0.95  # of the image that a box or a mask covers: more is no object


@dataclass(frozen=True)
class Located:
    """A thing that was located: what is said of it, its box with it, and its mask."""

    said: GroundingRequest | ObjectRequest
    mask: CroppedMask | None = None  # where it does not follow from the box
    warnings: tuple[str, ...] = ()

    @staticmethod
    def at(
        said: GroundingRequest | ObjectRequest,
        bbox: BBox,
        mask: CroppedMask | None = None,
        warnings: tuple[str, ...] = (),
    ) -> Located:
        """What is said of a thing, in the box where it was found."""
        return Located(said.model_copy(update={"bbox": bbox}), mask, warnings)

    @property
    def bbox(self) -> BBox:
        """px, inside the image."""
        return box_of(self.said)

    @property
    def name(self) -> str:
        """As it is called."""
        return self.said.object or DEFAULT_NAME

    def is_same_as(self, mover: Located) -> bool:
        """Whether it is what moves. Two masks tell, however much their boxes overlap."""
        if self.mask is None or mover.mask is None:
            return is_same_object(self.bbox, mover.bbox)
        return mask_iou(self.mask.full(), mover.mask.full()) > SAME_MASK

    def stored(self, run: Run[SimulateRequest]) -> LocatedObject:
        """As a result reports it, its mask stored."""
        put, said = run.backends.artifacts.put, self.said
        return LocatedObject(
            object=self.name,
            bbox=self.bbox,
            role=said.role if isinstance(said, ObjectRequest) else "target",
            mask=None if self.mask is None else put(encode_png(self.mask.full()), "image/png"),
            prior=said.prior,
            source=said.source,
            bbox_deviation=said.bbox_deviation or 0.0,
            is_doubtful=said.is_doubtful,
        )


def locate_given(run: Run[SimulateRequest], observation: Observation) -> tuple[list[Located], Located | None]:
    """The objects of a request, and its mover; None where that is left to the reader.

    Raises as `_locate` does, and for an object that is given twice.
    """
    request, found = run.request, list[Located]()
    for index, each in enumerate(request.objects):
        place = _locate(run, observation, each, pointer := f"/objects/{index}")
        twin = next((at for at, other in enumerate(found) if iou(place.bbox, other.bbox) >= SAME_BOX_IOU), None)
        if twin is not None:
            detail = f"lies in the same box as `objects.{twin}`"
            message = f"`{field_of(pointer)}` {detail}: give each object once."
            raise InvalidRequest(message, errors=(FieldError(pointer, detail),))
        found.append(place)
    return found, None if request.place is None else _locate(run, observation, request.place, "/grounding")


def _locate(
    run: Run[SimulateRequest], observation: Observation, given: GroundingRequest | ObjectRequest, pointer: str
) -> Located:
    """The place of an object; `pointer` is the JSON Pointer to `given`.

    Raises `InvalidRequest` for a place outside the image or all over it and for a mask that is none of this image, and
    `CannotGround` where what can be cut out around a point is no object.
    """
    run.check_canceled()
    field, width, height = field_of(pointer), observation.width, observation.height
    outside = f"lies outside the upright image of {width} x {height} px"
    if given.mask is not None:
        mask = read_mask(run, given.mask, f"{pointer}/mask")
        bbox = mask.bbox if given.bbox is None else given.bbox
        x0, y0, x1, y1 = (max(0, round(value)) for value in bbox)
        inside = np.count_nonzero(mask.full()[y0:y1, x0:x1]) / mask.area
        if inside < OWN_MASK:
            raise _misplaced(f"{pointer}/bbox", bbox, f"holds {inside:.0%} of the `mask` beside it")
        return Located.at(given, bbox, mask)
    if given.bbox is not None:
        x0, y0, x1, y1 = given.bbox
        clipped = max(0.0, x0), max(0.0, y0), min(float(width), x1), min(float(height), y1)
        wide, high = clipped[2] - clipped[0], clipped[3] - clipped[1]
        if wide < 2 or high < 2:
            raise _misplaced(f"{pointer}/bbox", given.bbox, outside)
        if (share := wide * high / (width * height)) > MAX_SHARE:
            raise _misplaced(f"{pointer}/bbox", given.bbox, f"covers {share:.0%} of the image")
        beyond = f"`{field}.bbox` {list(given.bbox)} reaches beyond the image, so {list(clipped)} of it was taken."
        warnings = () if clipped == given.bbox else (beyond,)
        if run.can_segment:
            return outlined_box(run, observation, given, clipped, field, warnings)
        return Located.at(given, clipped, warnings=warnings)
    x, y = given.point or (0.0, 0.0)
    if not (0 <= x < width and 0 <= y < height):
        raise _misplaced(f"{pointer}/point", (x, y), outside)
    # The first point of a path says less of the mover than a point that is given for it.
    may_guess = pointer == "/grounding" and run.request.grounding is None
    if run.can_segment:
        found = outlines_at(_embedded(run, observation), (x, y))
        if len(found) == 1 or (found and may_guess):
            return Located.at(given, found[0].bbox, found[0].mask)
        fault = (
            f"{len(found)} objects lie there, one inside the other."
            if found
            else "two attempts to outline it disagree."
        )
        if not may_guess:
            raise _not_cut_out(f"The object at the point [{x:.0f}, {y:.0f}] is not clear: {fault}", pointer)
    mask = observation.mask_at((x, y))
    bbox, fault = mask.bbox, observation.fault_of(mask)
    if observation.thing_in(bbox) is not None:
        return Located.at(given, bbox)
    if fault is not None and not may_guess:
        raise _not_cut_out(f"No object could be cut out around the point [{x:.0f}, {y:.0f}]: {fault}.", pointer)
    box = ", ".join(f"{value:.0f}" for value in bbox)
    warning = f"The object around the point was guessed to be [{box}]; `{field}.bbox` says it for certain."
    return Located.at(given, bbox, mask, (warning,))


def _not_cut_out(detail: str, pointer: str) -> CannotGround:
    field = field_of(pointer)
    return CannotGround(
        f"{detail} Give its box as `{field}.bbox`, or its outline as `{field}.mask`.",
        errors=(FieldError(f"{pointer}/point", detail),),
    )


def _embedded(run: Run[SimulateRequest], observation: Observation) -> Embedded:
    """The image as the segmenter sees it, which the server must have: what is drawn over things is none of them."""
    run.check_canceled()
    owner, digest = run.sight.key
    key = owner, digest + (" clean" if observation.cues.any() else "")
    return run.backends.perception.embed(key, lambda: observation.undrawn)


def outlined_box(
    run: Run[SimulateRequest],
    observation: Observation,
    given: GroundingRequest | ObjectRequest,
    bbox: BBox,
    field: str,
    warnings: tuple[str, ...],
) -> Located:
    """What the segmenter sees in a box that the request gives; where it is not sure of it, nothing else is."""
    (outline,) = outlines_in(_embedded(run, observation), [bbox])
    if outline is None or not outline.is_sure:
        doubt = f"Two attempts to outline what is in `{field}.bbox` disagree: give its outline as `{field}.mask`."
        doubted = given.model_copy(update={"is_doubtful": True})
        return Located.at(doubted, bbox, None if outline is None else outline.mask, (*warnings, doubt))
    return Located.at(given, outline.bbox, outline.mask, warnings)


def find_things(run: Run[SimulateRequest], observation: Observation, names: Sequence[str]) -> tuple[Thing, ...]:
    """What the models of the server find by some names. To be called with `cpu` held."""
    detector, embedded = run.backends.perception.detector, _embedded(run, observation) if run.can_segment else None
    assert detector is not None, "asked for only where there is a detector"
    return find_named(detector, embedded, observation.undrawn, observation.clean, names)


def bare(
    run: Run[SimulateRequest], observation: Observation, reading: Reading
) -> tuple[Located, tuple[Located, ...], tuple[str, ...]]:
    """The things of a reading by their boxes alone, but for a mover that was only pointed at."""
    mover = mover_of(reading)
    pointed = None if mover.point is None else observation.mask_at(mover.point)
    is_cut = pointed is not None and pointed.bbox == mover.bbox and observation.thing_in(pointed.bbox) is None
    return Located(mover, pointed if is_cut else None), tuple(map(Located, reading.objects)), ()


def outlined(
    run: Run[SimulateRequest], observation: Observation, reading: Reading
) -> tuple[Located, tuple[Located, ...], tuple[str, ...]]:
    """The things of a reading outlined by the segmenter, and doubts. To be called with `cpu` held.

    Raises `CannotGround` where no two looks agree on the outline of the mover: a scrap of it would be moved. Of others
    on which none agree, nothing is sure.
    """
    mover = mover_of(reading)
    boxes = dict.fromkeys(box_of(each) for each in (mover, *reading.objects))
    outlines = dict(zip(boxes, outlines_in(_embedded(run, observation), list(boxes)), strict=True))
    own, doubted = outlines[box_of(mover)], list[str]()
    if own is None or not own.is_sure:
        box = ", ".join(f"{value:.0f}" for value in box_of(mover))
        raise CannotGround(
            f"'{mover.object}' was looked for in [{box}], but two attempts to outline it disagree.", remedy=GIVE_PLACE
        )
    others = list[Located]()
    for thing in reading.objects:
        outline = outlines[box_of(thing)]
        if (
            outline is not None and mask_iou(outline.mask.full(), own.mask.full()) > SAME_MASK
        ):  # the mover, under another name
            others.append(Located.at(thing, own.bbox))
        elif outline is None or not outline.is_sure:
            doubted.append(thing.object)
            others.append(Located(thing.model_copy(update={"is_doubtful": True})))
        else:
            exact = thing.model_copy(update={"bbox_deviation": None})
            others.append(Located.at(exact, outline.bbox, outline.mask))
    doubts = tuple(
        f"Two attempts to outline '{name}' disagree: give it in `objects`, with its `mask`."
        for name in dict.fromkeys(doubted)
    )
    exact = mover.model_copy(update={"bbox_deviation": None})
    return Located.at(exact, own.bbox, own.mask), tuple(others), doubts


def _misplaced(pointer: str, value: Sequence[float], fault: str) -> InvalidRequest:
    detail = f"{list(value)} {fault}."
    message = f"`{field_of(pointer)}`: {detail} Give pixels of the object alone, x right and y down."
    return InvalidRequest(message, errors=(FieldError(pointer, detail),))


def read_mask(run: Run[SimulateRequest], given: MaskRef, pointer: str) -> CroppedMask:
    """The mask of the image that a request names. Raises `InvalidRequest`."""
    kept, image = kept_mask(given), run.image.info

    def refused(fault: str) -> InvalidRequest:
        return InvalidRequest(
            f"`{field_of(pointer)}` {fault}. Give a PNG of the upright image's size, white where the object is and "
            "black elsewhere.",
            errors=(FieldError(pointer, fault),),
        )

    try:
        data = run.backends.artifacts.read(kept.artifact)
        picture = decode(data, max_megapixels=image.width * image.height / 1e6)
    except UNREADABLE as error:
        raise refused(f"cannot be read: {error.detail}") from error
    mask = picture.pixels.min(axis=2) >= WHITE
    share = float(mask.mean())
    if (picture.info.width, picture.info.height) != (image.width, image.height):
        given_size, size = (f"{each.width} x {each.height} px" for each in (picture.info, image))
        raise refused(f"has {given_size} where the upright image has {size}")
    if min(np.count_nonzero(mask.any(axis=axis)) for axis in (0, 1)) < LEAST_SIDE:
        raise refused("is empty, or less than 2 px wide or high")
    if share > MAX_SHARE:
        raise refused(f"covers {share:.0%} of the image: white, or transparent, is the object alone")
    return CroppedMask.of(mask)
