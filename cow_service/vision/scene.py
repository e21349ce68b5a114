"""Everything measured in one image without a model, each lazily and once."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from threading import Lock
from typing import Any, TypeVar

import numpy as np

from cow_service.records import BBox, Grounding, LocatedObject
from cow_service.vision.arrows import Arrow, DrawnBox, find_arrows, find_boxes
from cow_service.vision.contrast import VIEW
from cow_service.vision.edges import find_segments
from cow_service.vision.inpainting import erase_drawing
from cow_service.vision.masks import (
    CroppedMask,
    bbox_of,
    dilated,
    iou,
    is_among,
    is_same_object,
    mask_iou,
    without_holes,
)
from cow_service.vision.regions import Region, find_regions, known_region, region_of
from cow_service.vision.segmentation import fault_of, is_bare, mask_from_bbox, mask_from_point
from cow_service.vision.side_view import SideView, find_side_view
from cow_service.vision.strokes import Stroke, WorkingImage, find_strokes
from cow_service.vision.trail_removal import without_earlier_positions
from cow_service.vision.trails import Trail, find_trails, trail_ending_at
from cow_service.vision.types import Floats, Image, Mask

SHARP_SIDE = 2 * VIEW.working_side  # px: in a larger image the outlines of regions are coarse, and are cut again
OWN_SHARE = 0.2  # of the mover's area: something smaller that touches it is its shadow or a part of it
REACH = 1.5  # sizes of an object: an arrow further away is not its own
RIVAL = 0.6  # of a rival's distance: what is nearer than that is clearly the nearest
CLEAR_CUT = 0.9  # confidence of a region from which its outline leaves no doubt
DOUBTFUL = 0.75  # confidence below which the same holds of a small region that touches another obstacle


@dataclass(frozen=True)
class Obstacle:
    """Another object of the image."""

    name: str
    bbox: BBox
    mask: CroppedMask
    confidence: float = 1.0  # 0..1: how sure it is that it is there as one thing with this mask; 1 for what is given


Found = TypeVar("Found")
Measured = dict[str, Any]
"""Cached properties of a `Scene` by their names."""
PART_OF = 0.5  # of its area: what lies in a thing that was outlined is no thing of its own
# Neither mover nor words decide them.
OF_THE_IMAGE = ("_strokes", "arrows", "boxes", "cues", "undrawn", "side_view", "segments")
WITHOUT_TRAILS = ("clean", "regions")  # nor do they decide these, where no trail is named


@dataclass(frozen=True, eq=False)
class Scene:
    """An upright RGB image [H, W, 3] and what was measured in it. It knows no question and no motion.

    For one thread: it belongs to one run.
    """

    image: Image
    mover: BBox | None = None  # the present position of what moves, once it is known: it tells which end of a trail is
    trail_named: bool = False  # the question or the reader speaks of a trail: balls in a row are one over time
    _found: dict[Hashable, Any] = field(default_factory=dict[Hashable, Any], repr=False)
    _preset: dict[BBox, Callable[[], Mask]] = field(default_factory=dict, repr=False)

    def once(self, key: Hashable, measure: Callable[[], Found]) -> Found:
        """What `measure` finds in this image, found once for the same key."""
        if key not in self._found:
            self._found[key] = measure()
        return self._found[key]

    @property
    def width(self) -> int:
        """Pixels."""
        return int(self.image.shape[1])

    @property
    def height(self) -> int:
        """Pixels."""
        return int(self.image.shape[0])

    @cached_property
    def _strokes(self) -> tuple[WorkingImage, tuple[Stroke, ...]]:
        small = WorkingImage.of(self.image)
        return small, tuple(find_strokes(small.pixels))

    @cached_property
    def arrows(self) -> tuple[Arrow, ...]:
        """Arrows drawn over the image, best fit first."""
        return find_arrows(*self._strokes)

    @cached_property
    def boxes(self) -> tuple[DrawnBox, ...]:
        """Boxes drawn over the image, largest first."""
        return find_boxes(*self._strokes)

    @cached_property
    def cues(self) -> Mask:
        """Mask [H, W] of every arrow and box drawn over the image: cues for the reader, not part of the world."""
        mask = np.zeros((self.height, self.width), bool)
        for drawing in (*self.arrows, *self.boxes):
            mask |= drawing.mask
        return mask

    @cached_property
    def undrawn(self) -> Image:
        """The image [H, W, 3] without arrows and boxes."""
        return erase_drawing(self.image, self.cues)

    @cached_property
    def side_view(self) -> SideView | None:
        """The drawing seen from the side that the image is; None for a picture that has depth."""
        return find_side_view(self.undrawn)

    @cached_property
    def segments(self) -> Floats:
        """Ends [N, 4] (x, y, x, y; px) of straight edges, longest first; none for a drawing without depth."""
        return np.zeros((0, 4)) if self.side_view else find_segments(self.undrawn, self.cues)

    @cached_property
    def trails(self) -> tuple[Trail, ...]:
        """Several positions of one ball each, the present one last: at the mover, or as it shows, or as a guess.

        None where nobody speaks of a trail.
        """
        if not self.trail_named or self.side_view:
            return ()
        found = find_trails(self.undrawn)
        own = None if self.mover is None else trail_ending_at(found, self.mover)
        if own is None:
            return found
        return (own, *(trail for trail in found if set(trail.positions) != set(own.positions)))

    @cached_property
    def clean(self) -> Image:
        """The image [H, W, 3] without its cues: neither drawings nor earlier positions of a trail."""
        image = self.undrawn
        for trail in self.trails:
            image = without_earlier_positions(image, trail)
        return image

    @cached_property
    def regions(self) -> tuple[Region, ...]:
        """Objects of the image, largest first; empty if it is too cluttered to tell."""
        if self.side_view is not None:
            return _largest_first(known_region(self.clean, shape) for shape in self.side_view.shapes)
        found = find_regions(self.clean)
        for trail in self.trails:
            if region_of(found, trail.present.bbox) is None:
                ball = CroppedMask.of(trail.present.disc((self.height, self.width)))
                found = (*found, replace(known_region(self.clean, ball), roundness=1.0, is_disc=True))
        return _largest_first(found)

    def with_mover(self, bbox: BBox) -> Scene:
        """This scene where its trails end as they are, else the scene in which the one in a box ends there."""
        trail = trail_ending_at(self.trails, bbox)
        if trail is None or any(trail.positions == other.positions for other in self.trails):
            return self
        return self.once(
            ("mover", trail.positions), lambda: self._with(self._measured(OF_THE_IMAGE), mover=bbox, _preset={})
        )

    def with_trail_named(self) -> Scene:
        """The scene in which balls that look alike, one after another, are one; masks that were given stay."""
        if self.trail_named:
            return self
        return self.once("trail named", lambda: self._with(self._measured(OF_THE_IMAGE), trail_named=True))

    def keeping(self, things: Sequence[BBox]) -> Scene:
        """The scene in which none of some things, by their boxes, is taken for an annotation that is drawn over it."""

        def is_thing(drawing: Arrow | DrawnBox) -> bool:
            # What frames a thing, or lies over a part of it, is drawn.
            own = [bbox for bbox in things if is_same_object(bbox_of(drawing.mask), bbox)]
            return any((drawing.mask & self.silhouette(bbox)).sum() > PART_OF * drawing.mask.sum() for bbox in own)

        arrows = tuple(each for each in self.arrows if not is_thing(each))
        boxes = tuple(each for each in self.boxes if not is_thing(each))
        if len(arrows) + len(boxes) == len(self.arrows) + len(self.boxes):
            return self

        key = ("keeping", *(each.tail for each in arrows), *(each.bbox for each in boxes))
        return self.once(key, lambda: self._with({"arrows": arrows, "boxes": boxes}))

    def _with(self, measured: Measured, **changes: Any) -> Scene:
        """Another scene of which only this is measured yet, and with the masks that were given."""
        other = replace(self, **{"_found": {}, "_preset": dict(self._preset), **changes})
        other.__dict__.update(measured)  # where cached properties are kept
        return other

    def _measured(self, names: Sequence[str]) -> Measured:
        return {name: self.__dict__[name] for name in names if name in self.__dict__}

    def measured(self) -> Measured:
        """The measurements so far that depend only on the image; read-only."""
        return self._measured(OF_THE_IMAGE if self.trail_named else (*OF_THE_IMAGE, *WITHOUT_TRAILS))

    def take(self, measured: Measured) -> None:
        """Takes over what another scene of the same image has measured."""
        other = WITHOUT_TRAILS if self.trail_named else ()
        new = {key: value for key, value in measured.items() if key not in self.__dict__ and key not in other}
        self.__dict__.update(new)

    def arrows_near(self, bbox: BBox) -> list[Arrow]:
        """Arrows that start or end close to a box and at no other object, nearest first."""
        others = [region.bbox for region in self.regions if not is_same_object(region.bbox, bbox)]
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

    def at_arrow(self, regions: Sequence[Region]) -> list[Region]:
        """Of several regions the one at which the only arrow stands, if it stands at one of them and clearly so."""
        if len(self.arrows) != 1:
            return []
        ranked = sorted((self.arrows[0].gap(region.bbox), i) for i, region in enumerate(self.regions))
        nearest, found = ranked[0][0], self.regions[ranked[0][1]]
        alone = len(ranked) == 1 or nearest < RIVAL * ranked[1][0]
        return [found] if found in regions and nearest <= REACH and alone else []

    def region_of(self, bbox: BBox) -> Region | None:
        """The region that a box [x0, y0, x1, y1] is about, if there is one."""
        return region_of(self.regions, bbox)

    def shows_thing(self, bbox: BBox) -> bool:
        """Whether something stands in a box: what was found there, what can be cut out with a visible outline, or what
        has colours that its surroundings lack."""
        return self.fault_of(bbox) is None or not self.once(("bare", bbox), lambda: is_bare(self.clean, bbox))

    def fault_of(self, bbox: BBox) -> str | None:
        """Why what can be cut out in a box can be no whole object, in words; None for a region, too."""
        if self.region_of(bbox) is not None:
            return None
        return self.once(("fault", bbox), lambda: fault_of(self.clean, self.silhouette(bbox)))

    def confidence_of(self, bbox: BBox) -> float:
        """How sure it is (0..1) that what is in a box is one separate thing with its outline; 1 for what is given.

        Where the outline of a region leaves a doubt, the thing is cut out again by its box alone: the confidence is
        the share (IoU) of both cuts that is in both.
        """
        region = self.region_of(bbox)
        if region is None or region.bbox != bbox:  # the request, or another reader, says where it is
            return 1.0
        if region.is_disc or region.confidence >= CLEAR_CUT:
            return region.confidence
        mask = region.mask.full()
        return self.once(("confidence", bbox), lambda: mask_iou(mask, mask_from_bbox(self.clean, bbox)))

    def silhouette(self, bbox: BBox) -> Mask:
        """As `cropped`, of the whole image [H, W]: a new array."""
        return self.cropped(bbox).full()

    def cropped(self, bbox: BBox) -> CroppedMask:
        """Mask of the object in a box [x0, y0, x1, y1], cut from the image without its cues."""

        def cut() -> CroppedMask:
            if bbox in self._preset:
                return CroppedMask.of(self._preset[bbox]())
            region = self.region_of(bbox)
            if region is not None and (region.is_disc or max(self.width, self.height) <= SHARP_SIDE):
                return region.mask
            guess = None if region is None else region.mask.full()
            return CroppedMask.of(mask_from_bbox(self.clean, bbox, guess))

        return self.once(("mask", bbox), cut)

    def preset_mask(self, bbox: BBox, mask: Callable[[], Mask]) -> None:
        """Gives the mask that an earlier run segmented for a box; it may have been segmented from a point instead."""
        self._preset[bbox] = mask

    def with_found(self, things: Sequence[tuple[Mask, frozenset[str]]]) -> Scene:
        """The same with things that models found, by mask [H, W] and the nouns they are called by, as regions.

        What lies in one of them for the most part is no region of its own.
        """
        other = self.changed(self.image, self.clean)
        found = [
            replace(known_region(self.clean, CroppedMask.of(mask)), is_disc=False, called=called)
            for mask, called in things
        ]
        own = [
            region
            for region in self.regions
            if all(region.mask.shared_with(mask) <= PART_OF * region.mask.area for mask, _ in things)
        ]
        other.__dict__["regions"] = _largest_first((*found, *own))
        return other

    def changed(self, image: Image, clean: Image) -> Scene:
        """Another image of the same objects, with and without its cues; what was measured in this one stays so."""
        stays = {name: getattr(self, name) for name in ("cues", "arrows", "boxes", "side_view", "regions")}
        return self._with({**stays, "clean": clean}, image=image, _found=dict(self._found))

    def with_mask(self, bbox: BBox, mask: Mask) -> Scene:
        """The same with another mask [H, W] of the object in a box."""
        other = self.changed(self.image, self.clean)
        other._found["mask", bbox] = CroppedMask.of(mask)
        return other

    def obstacles(self, mover: BBox, named: Sequence[LocatedObject] = ()) -> tuple[Obstacle, ...]:
        """The objects besides the mover in a box: first those that are named, then others, named by colour.

        Found once for the same arguments. Of known regions their own mask is taken, which is cheaper than another
        silhouette, unless a mask was given.
        """
        return self.once(("obstacles", mover, tuple(named)), lambda: self._obstacles(mover, named))

    def _obstacles(self, mover: BBox, named: Sequence[LocatedObject]) -> tuple[Obstacle, ...]:
        body = self.silhouette(mover)
        least, whole, near = OWN_SHARE * np.count_nonzero(body), without_holes(body), dilated(body, 7)
        apart = [each for each in named if each.mask is not None or not is_same_object(each.bbox, mover)]
        obstacles = [self._obstacle_of(each) for each in apart]
        outlined = [self.cropped(each.bbox) for each in named if each.mask is not None]
        for region in self.regions:
            mask, area = region.mask, region.mask.area
            is_own = mask.shared_with(whole) > 0.5 * area or (area < least and mask.shared_with(near))
            is_known = is_among(region.bbox, (mover, *(other.bbox for other in obstacles)))
            if not is_own and not is_known and not _is_part(region, outlined, obstacles):
                obstacles.append(Obstacle(f"{region.colour} object", region.bbox, mask, region.confidence))
        return tuple(obstacles)

    def _obstacle_of(self, named: LocatedObject) -> Obstacle:
        region = None if named.mask is not None else self.region_of(named.bbox)
        if region is None:
            return Obstacle(named.object, named.bbox, self.cropped(named.bbox))
        is_found = region.bbox == named.bbox  # here, not by the request or a reader
        return Obstacle(named.object, named.bbox, region.mask, region.confidence if is_found else 1.0)

    def bbox_at(self, point: tuple[float, float]) -> BBox:
        """Tight box [x0, y0, x1, y1] of the object at a point [x, y]: the smallest region there, or else segmented."""
        x = min(self.width - 1, max(0, int(point[0])))
        y = min(self.height - 1, max(0, int(point[1])))
        under = [region for region in self.regions if region.mask.contains(x, y)]
        if under:
            return min(under, key=lambda region: region.mask.area).bbox
        mask = mask_from_point(self.clean, (float(x), float(y)))
        bbox = bbox_of(mask)
        self._found["mask", bbox] = CroppedMask.of(mask)
        return bbox


def _largest_first(regions: Iterable[Region]) -> tuple[Region, ...]:
    return tuple(sorted(regions, key=lambda region: -region.mask.area))


def _is_part(region: Region, outlined: Sequence[CroppedMask], obstacles: Sequence[Obstacle]) -> bool:
    """Whether a region lies in a thing that was outlined, or is small, doubtful and touches another."""
    area = region.mask.area
    near = [mask.full() for mask in outlined if iou(mask.bbox, region.bbox)]
    if any(region.mask.shared_with(mask) > PART_OF * area for mask in near):
        return True
    larger = [other.mask for other in obstacles if area < OWN_SHARE * other.mask.area]
    is_doubtful = region.confidence < DOUBTFUL
    return is_doubtful and any(region.mask.shared_with(dilated(mask.full(), 7)) for mask in larger)


def arrow_fault(scene: Scene, grounding: Grounding) -> str:
    """Why none of the arrows is clearly that of the mover."""
    near = scene.arrows_near(grounding.bbox)
    ends = "; ".join(
        f"from ({a.tail[0]:.0f}, {a.tail[1]:.0f}) to ({a.tip[0]:.0f}, {a.tip[1]:.0f})" for a in near or scene.arrows
    )
    if not scene.arrows:
        fault = "no drawn arrow was found: looked for one flat colour with a straight shaft and a head"
    elif not near:
        fault = f"what was found stands elsewhere than the {grounding.object}: {ends}"
    else:
        fault = f"{len(near)} were found, and none is clearly that of the {grounding.object}: {ends}"
    return f"An arrow is to tell the direction, but {fault}."


MOST_IMAGES = 8
ImageKey = tuple[str | None, str]
"""The owner of the image, so that timing does not reveal the images of others; and its SHA-256."""
MOST_PIXELS = 13_000_000  # of all of them together: each holds some bytes per pixel


class SeenImages:
    """The measurements of images, the latest used last. Safe to use from several threads."""

    def __init__(self) -> None:
        self._lock = Lock()
        self._kept: OrderedDict[ImageKey, tuple[int, Measured]] = OrderedDict()

    def recall(self, key: ImageKey, scene: Scene) -> None:
        """Gives a scene the known measurements of its image."""
        with self._lock:
            found = self._kept.get(key)
            if found is None:
                return
            self._kept.move_to_end(key)
        scene.take(found[1])

    def keep(self, key: ImageKey, scene: Scene) -> None:
        """Keeps what a scene has measured of its image."""
        measured = scene.measured()
        with self._lock:
            self._kept[key] = scene.width * scene.height, measured
            self._kept.move_to_end(key)
            while len(self._kept) > MOST_IMAGES or sum(pixels for pixels, _ in self._kept.values()) > MOST_PIXELS:
                self._kept.popitem(last=False)
