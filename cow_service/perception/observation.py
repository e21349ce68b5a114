"""What one image shows, whatever is asked of it: found once, and never changed."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from threading import Lock
from typing import Any, TypeVar

import numpy as np

from cow_service.media.images import decode_own_mask
from cow_service.media.masks import (
    CroppedMask,
    bbox_of,
    dilated,
    iou,
    is_among,
    is_same_object,
    mask_iou,
    without_holes,
)
from cow_service.media.types import Floats, Image, Mask
from cow_service.perception.base import Find, ImageKey, Perception, Thing
from cow_service.perception.classical.arrows import Arrow, DrawnBox, find_arrows, find_boxes
from cow_service.perception.classical.contrast import VIEW
from cow_service.perception.classical.edges import find_segments
from cow_service.perception.classical.inpainting import erase_drawing
from cow_service.perception.classical.regions import find_regions, thing_of
from cow_service.perception.classical.segmentation import fault_of, is_bare, mask_from_bbox, mask_from_point
from cow_service.perception.classical.shadows import find_shadow
from cow_service.perception.classical.side_view import SideView, find_side_view
from cow_service.perception.classical.strokes import WorkingImage, find_strokes
from cow_service.perception.classical.trails import Trail, find_trails, trail_ending_at, without_earlier_positions
from cow_service.physics.bodies import Shadow
from cow_service.records import BBox, Grounding, LocatedObject, Point

SHARP_SIDE = 2 * VIEW.working_side  # px: in a larger image the outlines of things are coarse, and are cut again
OWN_SHARE = 0.2  # of the mover's area: something smaller that touches it is its shadow or a part of it
REACH = 1.5  # sizes of an object: an arrow further away is not its own
RIVAL = 0.6  # of a rival's distance: what is nearer than that is clearly the nearest
CLEAR_CUT = 0.9  # confidence of a thing from which its outline leaves no doubt
DOUBTFUL = 0.75  # confidence below which the same holds of a small thing that touches another obstacle
PART_OF = 0.5  # of its area: what lies in a thing that was outlined is no thing of its own
MOST_NOTES = 256  # measurements by box that an observation keeps: each may hold a mask

Found = TypeVar("Found")
NOT_MEASURED: Any = object()


@dataclass(frozen=True)
class Obstacle:
    """Another object of the image."""

    name: str
    bbox: BBox
    mask: CroppedMask
    confidence: float = 1.0  # 0..1: how sure it is that it is there as one thing with this mask; 1 for what is given


@dataclass(frozen=True, eq=False)
class Observation:
    """An upright RGB image [H, W, 3] and what it shows. It knows no question and no motion.

    What follows from it is computed when it is first asked for, and remembered. Safe to use from several threads.
    """

    image: Image
    arrows: tuple[Arrow, ...]  # drawn over the image, best fit first
    boxes: tuple[DrawnBox, ...]  # drawn over the image, largest first
    cues: Mask  # [H, W] of every arrow and box drawn over the image: cues for the reader, not part of the world
    undrawn: Image  # [H, W, 3] without arrows and boxes
    side_view: SideView | None  # the drawing seen from the side that it is; None for a picture that has depth
    find: Find  # what things are found by
    clean: Image  # [H, W, 3] without its cues: neither drawings nor earlier positions of a trail
    things: tuple[Thing, ...]  # largest first; empty if the image is too cluttered to tell
    trails: tuple[Trail, ...] = ()  # positions of one ball each, the present one last
    is_searched_for_trails: bool = False
    masks: Mapping[BBox, CroppedMask] = field(default_factory=dict[BBox, CroppedMask])  # of what was outlined already
    _notes: dict[Hashable, Any] = field(default_factory=dict[Hashable, Any], repr=False)

    def _once(self, key: Hashable, measure: Callable[[], Found]) -> Found:
        found = self._notes.get(key, NOT_MEASURED)
        if found is NOT_MEASURED:
            found = measure()
            if len(self._notes) >= MOST_NOTES:
                self._notes.clear()
            self._notes[key] = found
        return found

    @property
    def width(self) -> int:
        """Pixels."""
        return int(self.image.shape[1])

    @property
    def height(self) -> int:
        """Pixels."""
        return int(self.image.shape[0])

    @cached_property
    def segments(self) -> Floats:
        """Ends [N, 4] (x, y, x, y; px) of straight edges, longest first; none for a drawing without depth."""
        return np.zeros((0, 4)) if self.side_view else find_segments(self.undrawn, self.cues)

    # --- drawn arrows

    def arrows_near(self, bbox: BBox) -> list[Arrow]:
        """Arrows that start or end close to a box and at no other object, nearest first."""
        others = [thing.bbox for thing in self.things if not is_same_object(thing.bbox, bbox)]
        near: list[Arrow] = []
        for arrow in self.arrows:
            (x, y), gap = arrow.tail, arrow.gap(bbox)
            elsewhere = any(x0 <= x < x1 and y0 <= y < y1 for x0, y0, x1, y1 in others) and gap > REACH / 4
            near += [arrow] if gap <= REACH and not elsewhere else []
        return sorted(near, key=lambda arrow: arrow.gap(bbox))

    def arrow_at(self, bbox: BBox) -> Arrow | None:
        """The arrow of the object in a box: the only one near it, or the one clearly nearest."""
        near = self.arrows_near(bbox)
        gaps = [arrow.gap(bbox) for arrow in near]
        return near[0] if len(near) == 1 or (near and gaps[0] <= RIVAL * gaps[1]) else None

    def at_arrow(self, things: Sequence[Thing]) -> list[Thing]:
        """Of several things the one at which the only arrow stands, if it stands at one of them and clearly so."""
        if len(self.arrows) != 1:
            return []
        ranked = sorted((self.arrows[0].gap(thing.bbox), i) for i, thing in enumerate(self.things))
        nearest, found = ranked[0][0], self.things[ranked[0][1]]
        alone = len(ranked) == 1 or nearest < RIVAL * ranked[1][0]
        return [found] if found in things and nearest <= REACH and alone else []

    # --- what is in a box

    def thing_in(self, bbox: BBox) -> Thing | None:
        """The thing that a box [x0, y0, x1, y1] is about, if there is one."""
        return best_in(self.things, bbox)

    def shows_thing(self, bbox: BBox) -> bool:
        """Whether something stands in a box: what was found there, what can be cut out with a visible outline, or what
        has colours that its surroundings lack."""
        return self.fault_in(bbox) is None or not self._once(("bare", bbox), lambda: is_bare(self.clean, bbox))

    def fault_in(self, bbox: BBox) -> str | None:
        """Why what can be cut out in a box can be no whole object, in words; None for a thing that was found, too."""
        if self.thing_in(bbox) is not None:
            return None
        return self._once(("fault", bbox), lambda: self.fault_of(self.mask_in(bbox)))

    def fault_of(self, mask: CroppedMask) -> str | None:
        """Why what was cut out can be no whole object, in words."""
        return fault_of(self.clean, mask.full())

    def confidence_in(self, bbox: BBox) -> float:
        """How sure it is (0..1) that what is in a box is one separate thing with its outline; 1 for what is given.

        Where the outline of a thing leaves a doubt, it is cut out again by its box alone: the confidence is the share
        (IoU) of both cuts that is in both.
        """
        thing = self.thing_in(bbox)
        if thing is None or thing.bbox != bbox:  # the request, or another reader, says where it is
            return 1.0
        if thing.is_disc or thing.confidence >= CLEAR_CUT:
            return thing.confidence
        mask = thing.mask.full()
        return self._once(("confidence", bbox), lambda: mask_iou(mask, mask_from_bbox(self.clean, bbox)))

    def mask_in(self, bbox: BBox) -> CroppedMask:
        """Mask of the object in a box: as it was outlined, else cut from the image without its cues."""

        def cut() -> CroppedMask:
            thing = self.thing_in(bbox)
            if thing is not None and (thing.is_disc or max(self.width, self.height) <= SHARP_SIDE):
                return thing.mask
            guess = None if thing is None else thing.mask.full()
            return CroppedMask.of(mask_from_bbox(self.clean, bbox, guess))

        return self.masks.get(bbox) or self._once(("mask", bbox), cut)

    def mask_at(self, point: Point) -> CroppedMask:
        """Mask of what is at a point: of the smallest thing there, or else of what can be cut out around it."""
        x = min(self.width - 1, max(0, int(point[0])))
        y = min(self.height - 1, max(0, int(point[1])))
        under = [thing for thing in self.things if thing.mask.contains(x, y)]
        if under:
            return min(under, key=lambda thing: thing.mask.area).mask
        return self._once(("at", x, y), lambda: CroppedMask.of(mask_from_point(self.clean, (float(x), float(y)))))

    def shadow_below(self, bbox: BBox) -> Shadow | None:
        """The shadow on the floor of the thing in a box, if it is in the air and casts one that is clearly seen."""
        if self.thing_in(bbox) is None:
            return None
        masks = [thing.mask for thing in self.things]
        return self._once(("shadow", bbox), lambda: find_shadow(self.clean, masks, bbox))

    # --- what else is there

    def obstacles(self, mover: BBox, named: Sequence[LocatedObject] = ()) -> tuple[Obstacle, ...]:
        """The objects besides the mover in a box: first those that are named, then others, named by colour.

        Of things that were found their own mask is taken, which is cheaper than another cut, unless one was given.
        """
        return self._once(("obstacles", mover, tuple(named)), lambda: self._obstacles(mover, named))

    def _obstacles(self, mover: BBox, named: Sequence[LocatedObject]) -> tuple[Obstacle, ...]:
        body = self.mask_in(mover).full()
        least, whole, near = OWN_SHARE * np.count_nonzero(body), without_holes(body), dilated(body, 7)
        apart = [each for each in named if each.mask is not None or not is_same_object(each.bbox, mover)]
        obstacles = [self._obstacle_of(each) for each in apart]
        outlined = [self.mask_in(each.bbox) for each in named if each.mask is not None]
        of_named = [each.mask for each in obstacles]
        for thing in self.things:
            mask, area = thing.mask, thing.mask.area
            is_own = mask.shared_with(whole) > 0.5 * area or (area < least and mask.shared_with(near))
            is_known = is_among(thing.bbox, (mover, *(other.bbox for other in obstacles)))
            wholes = outlined if thing.confidence >= CLEAR_CUT else of_named
            if not (is_own or is_known or _is_part(thing, wholes, obstacles)):
                obstacles.append(Obstacle(f"{thing.colour} object", thing.bbox, mask, thing.confidence))
        return tuple(obstacles)

    def _obstacle_of(self, named: LocatedObject) -> Obstacle:
        thing = None if named.mask is not None else self.thing_in(named.bbox)
        if thing is None:
            return Obstacle(named.object, named.bbox, self.mask_in(named.bbox))
        is_found = thing.bbox == named.bbox  # here, not by the request or a reader
        return Obstacle(named.object, named.bbox, thing.mask, thing.confidence if is_found else 1.0)

    # --- the same with what else is known

    def with_masks(self, masks: Mapping[BBox, CroppedMask]) -> Observation:
        """The same with the outlines of the things in some boxes."""
        return replace(self, masks={**self.masks, **masks}, _notes={}) if masks else self

    def with_found(self, found: Sequence[Thing]) -> Observation:
        """The same with things that models found. What lies in one of them for the most part is no thing of its own."""
        own = [
            thing
            for thing in self.things
            if all(thing.mask.overlap(each.mask) <= PART_OF * thing.mask.area for each in found)
        ]
        return replace(self, things=_largest_first((*found, *own)), _notes={})

    def with_mover(self, bbox: BBox) -> Observation:
        """The same where its trails end as they are, else the one in which that of the ball in a box ends there."""
        own = trail_ending_at(self.trails, bbox)
        if own is None or any(own.positions == other.positions for other in self.trails):
            return self
        return _with_trails(self, (own, *(each for each in self.trails if set(each.positions) != set(own.positions))))

    def with_trails(self) -> Observation:
        """The same in which balls that look alike, one after another, are one."""
        if self.is_searched_for_trails:
            return self
        return _with_trails(self, () if self.side_view else find_trails(self.undrawn))

    def keeping(self, boxes: Sequence[BBox]) -> Observation:
        """The same in which none of the things in some boxes is taken for an annotation that is drawn over it."""

        def is_thing(drawing: Arrow | DrawnBox) -> bool:
            # What frames a thing, or lies over a part of it, is drawn.
            own = [bbox for bbox in boxes if is_same_object(bbox_of(drawing.mask), bbox)]
            return any(self.mask_in(bbox).shared_with(drawing.mask) > PART_OF * drawing.mask.sum() for bbox in own)

        arrows = tuple(each for each in self.arrows if not is_thing(each))
        drawn = tuple(each for each in self.boxes if not is_thing(each))
        if len(arrows) + len(drawn) == len(self.arrows) + len(self.boxes):
            return self
        found = _observed(self.image, arrows, drawn, self.find).with_masks(self.masks)
        return found.with_trails() if self.is_searched_for_trails else found


def look(image: Image, trails: bool = False, find: Find = find_regions) -> Observation:
    """What an upright RGB image [H, W, 3] shows; its trails where somebody speaks of one."""
    small = WorkingImage.of(image)
    strokes = tuple(find_strokes(small.pixels))
    found = _observed(image, find_arrows(small, strokes), find_boxes(small, strokes), find)
    return found.with_trails() if trails else found


def _observed(image: Image, arrows: tuple[Arrow, ...], boxes: tuple[DrawnBox, ...], find: Find) -> Observation:
    cues = np.zeros(image.shape[:2], bool)
    for drawing in (*arrows, *boxes):
        cues |= drawing.mask
    undrawn = erase_drawing(image, cues)
    side_view = find_side_view(undrawn)
    things = _things_in(undrawn, find, side_view, ())
    return Observation(image, arrows, boxes, cues, undrawn, side_view, find, undrawn, things)


def _with_trails(seen: Observation, trails: tuple[Trail, ...]) -> Observation:
    """The same with some trails: their earlier positions are taken out."""
    clean, things = seen.undrawn, seen.things
    for trail in trails:
        clean = without_earlier_positions(clean, trail)
    if trails:
        things = _things_in(clean, seen.find, seen.side_view, trails)
    return replace(seen, clean=clean, things=things, trails=trails, is_searched_for_trails=True, _notes={})


def _things_in(clean: Image, find: Find, side_view: SideView | None, trails: Sequence[Trail]) -> tuple[Thing, ...]:
    if side_view is not None:
        return _largest_first(thing_of(clean, shape) for shape in side_view.shapes)
    found = find(clean)
    for trail in trails:
        if best_in(found, trail.present.bbox) is None:
            ball = CroppedMask.of(trail.present.disc(clean.shape[:2]))
            found = (*found, replace(thing_of(clean, ball), roundness=1.0, is_disc=True))
    return _largest_first(found)


def best_in(things: Sequence[Thing], bbox: BBox) -> Thing | None:
    """Of some things the one that a box is about, if there is one."""
    best = max(things, key=lambda thing: iou(thing.bbox, bbox), default=None)
    return best if best is not None and is_same_object(best.bbox, bbox) else None


def _largest_first(things: Iterable[Thing]) -> tuple[Thing, ...]:
    return tuple(sorted(things, key=lambda thing: -thing.mask.area))


def _is_part(thing: Thing, outlined: Sequence[CroppedMask], obstacles: Sequence[Obstacle]) -> bool:
    """Whether a thing lies in one that was outlined, or is small, doubtful and touches another.

    Something doubtful is also a part of a named thing in whose mask it lies.
    """
    area = thing.mask.area
    if any(thing.mask.overlap(mask) > PART_OF * area for mask in outlined):
        return True
    larger = [other.mask for other in obstacles if area < OWN_SHARE * other.mask.area]
    is_doubtful = thing.confidence < DOUBTFUL
    return is_doubtful and any(thing.mask.shared_with(dilated(mask.full(), 7)) for mask in larger)


def arrow_fault(seen: Observation, grounding: Grounding) -> str:
    """Why none of the arrows is clearly that of the mover."""
    near = seen.arrows_near(grounding.bbox)
    ends = "; ".join(
        f"from ({a.tail[0]:.0f}, {a.tail[1]:.0f}) to ({a.tip[0]:.0f}, {a.tip[1]:.0f})" for a in near or seen.arrows
    )
    if not seen.arrows:
        fault = "no drawn arrow was found: looked for one flat colour with a straight shaft and a head"
    elif not near:
        fault = f"what was found stands elsewhere than the {grounding.object}: {ends}"
    else:
        fault = f"{len(near)} were found, and none is clearly that of the {grounding.object}: {ends}"
    return f"An arrow is to tell the direction, but {fault}."


MOST_IMAGES = 8
MOST_PIXELS = 13_000_000  # of all but the latest together: each holds some bytes per pixel


class SeenImages:
    """What images show, the latest used last. Safe to use from several threads."""

    def __init__(self, perception: Perception | None = None) -> None:
        """`perception`: the models of a server, of which its finder looks, too."""
        self._perception, self._lock = perception, Lock()
        self._kept: OrderedDict[tuple[ImageKey, bool], Observation] = OrderedDict()

    def look(self, key: ImageKey, image: Callable[[], Image], trails: bool = False) -> Observation:
        """What an image shows, found before or now; it is asked for only where it is new."""
        with self._lock:
            found = self._kept.get((key, trails))
        if found is None:  # its trails are looked for in what is known of it
            finder = None if self._perception is None else self._perception.finder
            find = find_regions if finder is None else finder.find
            found = self.look(key, image).with_trails() if trails else look(image(), find=find)
        with self._lock:
            self._kept[key, trails] = found
            self._kept.move_to_end((key, trails))
            while len(self._kept) > MOST_IMAGES or (
                len(self._kept) > 1 and sum(each.cues.size for each in self._kept.values()) > MOST_PIXELS
            ):
                self._kept.popitem(last=False)
        return found


class Sight:
    """One run's looks at its image, each made once. To be used with the CPU held.

    What is measured in a box is remembered for the run alone: of a large picture each mask takes megabytes.
    """

    def __init__(self, image: Image, key: ImageKey, shared: SeenImages) -> None:
        self.key = key
        self._image, self._shared, self._looks = image, shared, dict[Hashable, Observation]()

    def _once(self, key: Hashable, see: Callable[[], Observation]) -> Observation:
        if key not in self._looks:
            self._looks[key] = see()
        return self._looks[key]

    def look(self, trails: bool = False) -> Observation:
        """What the image shows before it is known what moves."""
        return self._once(trails, lambda: replace(self._shared.look(self.key, lambda: self._image, trails), _notes={}))

    def look_closer(
        self,
        mover: BBox,
        others: tuple[BBox, ...],
        trails: bool,
        masks: tuple[tuple[BBox, str], ...],
        read: Callable[[str], bytes],
    ) -> Observation:
        """What it shows once it is known what moves: neither that nor the other things are annotations, and where
        trails are spoken of, one ends at the mover. `masks` that were stored are read by their digests."""
        key = mover, others, trails
        closer = self._once(key, lambda: self.look(trails).keeping((mover, *others)).with_mover(mover))

        def with_masks() -> Observation:
            return closer.with_masks({box: CroppedMask.of(decode_own_mask(read(digest))) for box, digest in masks})

        return self._once((key, masks), with_masks)
