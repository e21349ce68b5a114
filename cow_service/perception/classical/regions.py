"""Finds the objects of an uncluttered image: coloured, white or black things on a floor, a table or a wall.

A pixel that differs from its wide surroundings in colour, is brighter, or is nearly black, belongs to an object; so
does a patch enclosed by edges below a bright top: the shaded side of a white object. Shadows, darker but of the same
hue, are left out. Where the surroundings vary too much (most photographs), no region is returned instead of wrong ones.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from cow_service.media import masks
from cow_service.media.masks import CroppedMask
from cow_service.media.types import Floats32, Image, Mask
from cow_service.perception.base import Thing
from cow_service.perception.classical.completion import as_disc, black_faces, is_top, is_underside, white_sides
from cow_service.perception.classical.contrast import VIEW, View, colour_name, colour_names, view_of
from cow_service.records import BBox


class RegionRules(NamedTuple):
    """When what differs from its surroundings is a thing, and where it ends.

    Set by hand on the first family of rendered scenes, and on the textured floors and shadows of the second; no single
    number has a measurement of its own.
    """

    sharp_share: float = 0.65  # of an outline that must lie on edges
    out_of_texture: float = 1.7  # of the surroundings' spread in lightness: the least step in an outline, per px
    spreads: float = 3.0  # of that spread: what is so much darker is no texture
    bright_spreads: float = 3.7  # and what is so much brighter
    black: float = 0.61  # of the surroundings' light: below it something may be black
    black_light: float = 0.47  # the same of the darker part of what is black
    blackest_light: float = 0.375  # the same of what may be shadow
    blackest: float = 16.5  # Lab lightness of the darker part of what is black and may be shadow
    same_light: float = 0.05  # of two shadows, at most
    same_chroma: float = 4.0  # Lab units between a shadow and the floor that it lies on
    least_shadow: float = 0.05  # of the area of what may be another shadow
    most_shadow: float = 3.0  # of the area of the thing that casts it
    black_share: float = 0.5  # of the surroundings' lightness: below it is black, not shade
    halfway: float = 0.35  # of the largest step nearby
    min_area: float = 0.0003  # of the image
    max_area: float = 0.25  # the same, at most
    most: int = 40  # the largest are kept: the work that follows grows with their number
    clutter: float = 0.30  # share of the image that may differ from its surroundings before it counts as cluttered
    split_hue: float = 36.0  # degrees: another colour, hence another object
    own_area: int = 250  # px at the working size: a patch of another colour this large is no part of a thing
    edge_band: float = 4.0  # px: half the width of an edge as it is measured
    min_rest: float = 0.05  # of a component: less is no part of its own
    hidden: float = 0.2  # of its outline, along which something else lies in front
    own_width: float = 0.55  # of the narrowest colour: black narrower than this is a neck or a wheel
    mask_sigma: float = 0.8  # px at the working size, smooths the stairs of an enlarged mask
    disc: float = 0.93  # roundness from which a drawn shape is a disc
    dark: float = 28.0  # lightness below which a part may be the underside of another
    sure_contrast: float = 20.0  # Lab units: from here on contrast takes nothing from the confidence
    sure_area: float = 300.0  # px at the working size, from which the size takes nothing


REGION = RegionRules()


_DISC = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (7, 7))


@dataclass(frozen=True)
class _Found:
    """One object at the working size."""

    mask: Mask  # [h, w]
    lab: Floats32  # [N, 3]: the Lab colours of its pixels, as it was found
    confidence: float
    is_disc: bool

    def region(self, size: tuple[int, int], is_hidden: bool) -> Thing:
        """It as a region of the image (height and width)."""
        soft = self.mask.astype(np.float32)
        near = masks.window_of(self.mask, round(6 * REGION.mask_sigma))
        if near is not None:
            soft[near] = cv2.GaussianBlur(soft[near], (0, 0), REGION.mask_sigma)
        mask = masks.enlarged(soft, size)
        roundness = masks.roundness_of(mask.patch)
        return Thing(mask, *_names(self.lab), roundness, self.confidence, self.is_disc, is_hidden and not self.is_disc)


def find_regions(image: Image) -> tuple[Thing, ...]:
    """Things of an RGB image [H, W, 3] without drawings on it, largest first; none in a cluttered image."""
    height, width = image.shape[:2]
    view = view_of(masks.scaled(image, min(1.0, VIEW.working_side / max(height, width))))
    solid = _solid(view)
    border = np.ones(solid.shape, bool)
    border[1:-1, 1:-1] = False
    found: list[_Found] = []
    _, labels, stats, _ = cv2.connectedComponentsWithStats(solid, connectivity=8)
    for i, (x, y, w, h, _) in enumerate(stats.tolist()):
        if i == 0 or _is_background(stats[i], solid.shape):
            continue
        pad = 6 + max(w, h) // 3  # a ball may have lost as much to a highlight
        window = slice(max(0, y - pad), y + h + pad), slice(max(0, x - pad), x + w + pad)
        near = view.crop(window)
        for part in _parts(near, labels[window] == i):
            disc = as_disc(part, near.edges, near.edge_threshold)
            if disc is None and not _stands_out(near, part):
                continue
            shape = part if disc is None else disc
            whole = np.zeros(solid.shape, bool)
            whole[window] = shape
            confidence = _confidence(near, shape, border[window], disc is not None)
            found.append(_Found(whole, near.lab[part], confidence, disc is not None))
    found = _with_undersides(found)
    pairs = zip(found, _hidden(found), strict=True)
    regions = [one.region((height, width), is_hidden) for one, is_hidden in pairs]
    return tuple(sorted(regions, key=lambda region: -region.mask.area)[: REGION.most])


def _solid(view: View) -> NDArray[np.uint8]:
    """Where [h, w] things are, 1 or 0; nowhere in a cluttered image."""
    # What is surely of an object: of another hue, clearly brighter, or nearly black.
    coloured = view.chroma_gap > VIEW.chroma_step
    body = coloured | (view.bright > np.maximum(VIEW.bright_step, REGION.bright_spreads * view.spread))
    core = body | _black(view, body)
    # Blur and the compression of colour spread a thing by a few px: its outline lies halfway up to its own colour.
    step = np.maximum(view.chroma_gap, np.abs(view.bright))
    low = step < REGION.halfway * cv2.dilate(step, np.ones((7, 7), np.uint8))
    core &= ~(low & masks.dilated(~core, 5))
    if core.mean() > REGION.clutter:
        return np.zeros(core.shape, np.uint8)
    solid = (core | white_sides(view, core)).astype(np.uint8)
    return np.asarray(cv2.morphologyEx(solid, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)), np.uint8)


def _black(view: View, body: Mask) -> Mask:
    """What is black. `body` [h, w] is surely of things: what is dark next to it is a part of it inside its outline.

    Outside it is the thing's shadow, unless it is as dark as black things are and large, or lies below it as wheels
    do. What is dark elsewhere is a shadow, too, if it gets as little light as those.
    """
    dark = (view.light < REGION.black).astype(np.uint8)
    dark = cv2.morphologyEx(dark, cv2.MORPH_OPEN, _DISC) > 0  # contact shadows are thin
    outlines, near, black = np.zeros((3, *body.shape), bool)
    things: list[tuple[Mask, int]] = []
    for thing in _blobs(body, REGION.min_area * body.size):
        things.append((masks.dilated(thing, 7), int(np.count_nonzero(thing))))
        near |= things[-1][0]
        outlines |= masks.dilated(masks.hull(thing), 5)
    shadows: list[tuple[float, int]] = []
    alone: list[tuple[float, Mask]] = []
    for blob in _blobs(dark & ~outlines, 0):
        area, light = int(np.count_nonzero(blob)), float(np.percentile(view.light[blob], 30))
        beside = [masks.bbox_of(t) for t, size in things if area < REGION.most_shadow * size and (t & blob).any()]
        is_black = light <= REGION.black_light and _is_black(view, blob, light < REGION.blackest_light, beside)
        if is_black is None:
            alone.append((light, blob))
        elif is_black:
            black |= blob
        else:
            shadows.append((light, area))
    for light, blob in alone:
        least = REGION.least_shadow * np.count_nonzero(blob)
        if not any(abs(light - shade) < REGION.same_light and area > least for shade, area in shadows):
            black |= blob
    return black | (black_faces(view, black) & ~near) | (dark & outlines)


def _is_black(view: View, blob: Mask, is_darkest: bool, beside: Sequence[BBox]) -> bool | None:
    """Whether a dark blob is black and no shadow of the things beside it; None where there are none."""
    if np.median(view.bright[blob]) > -REGION.spreads * np.median(view.spread[blob]):
        return False  # it is texture
    box = masks.bbox_of(blob)
    if np.median(view.chroma_gap[blob]) > REGION.same_chroma or any(is_top(box, thing) for thing in beside):
        return True  # a shadow keeps the floor's hue
    if not beside:
        return None
    if not is_darkest or np.percentile(view.lab[blob, 0], 30) >= REGION.blackest:
        return False
    return bool(np.count_nonzero(blob) > REGION.own_area) or any(is_underside(box, thing) for thing in beside)


def _stands_out(view: View, part: Mask) -> bool:
    """Whether its outline lies on edges, unlike that of a patch of light, and on larger ones than texture has."""
    outline = masks.outline_of(part)
    strong = cv2.dilate(view.edges, np.ones((5, 5), np.uint8))[outline] > view.edge_threshold
    if np.mean(strong) <= REGION.sharp_share:
        return False
    if float(np.median(view.chroma_gap[part])) > VIEW.strong_chroma_step:
        return True
    steps = cv2.dilate(view.edges, np.ones((3, 3), np.uint8))[outline]
    return float(np.median(steps)) > REGION.out_of_texture * float(np.median(view.spread[outline]))


def thing_of(image: Image, mask: CroppedMask) -> Thing:
    """A thing of an RGB image [H, W, 3] whose mask is certain; a disc where that is round."""
    roundness = masks.roundness_of(mask.patch)
    names = _names(masks.lab_of(image[mask.rows, mask.columns][mask.patch][None])[0])
    return Thing(mask, *names, roundness, confidence=1.0, is_disc=roundness > REGION.disc)


def _is_background(stats: NDArray[np.int32], shape: tuple[int, ...]) -> bool:
    """Whether a component is no thing by its size, or a strip of wall or floor along an edge of the image."""
    (x, y, w, h, area), (height, width) = stats.tolist(), shape
    if not REGION.min_area * height * width <= area <= REGION.max_area * height * width:
        return True
    on_side, on_top, on_bottom = x == 0 or x + w == width, y == 0, y + h == height
    spans = w > 0.5 * width or h > 0.75 * height
    sliver = (on_top or on_side) and (area < 0.45 * w * h or min(w, h) < 0.12 * max(w, h))
    return spans or sliver or (on_side and (on_top or on_bottom))


def _parts(view: View, component: Mask) -> list[Mask]:
    """Splits a component into white balls and by colour; wheels, necks and lights stay with what they sit on."""
    # Discs among the pale patches between the edges: white balls before or on something white.
    pale = component & (np.minimum(view.chroma_gap, view.chroma) < VIEW.chroma_step) & (view.bright > -12)
    balls, taken = list[Mask](), np.zeros(component.shape, bool)
    for factor in (1.0, 2.5):  # compression leaves weak edges across a ball
        for patch in _blobs(pale & (view.edges < factor * view.edge_threshold), 0.5 * REGION.own_area):
            disc = as_disc(masks.dilated(patch, times=2), view.edges, view.edge_threshold, grow=REGION.edge_band)
            if disc is not None and not (disc & taken).any():
                taken |= disc
                balls.append(disc)
    rest = _blobs(component & ~taken, REGION.min_rest * component.sum())
    if balls:  # what is left along the edge of a ball is blur
        rest = [blob for blob in rest if masks.half_width(blob) > REGION.edge_band]
    return balls + [part for blob in rest for part in _coloured_parts(view, blob)]


def _coloured_parts(view: View, component: Mask) -> list[Mask]:
    area = int(component.sum())
    lab, chroma = view.lab, view.chroma
    hue = np.degrees(np.arctan2(lab[..., 2], lab[..., 1]))
    coloured = component & (view.chroma_gap > VIEW.chroma_step) & (chroma > VIEW.chroma_step)
    least = min(0.12 * area, REGION.own_area)
    seeds: list[Mask] = []
    rest = coloured.copy()
    while rest.sum() > least and len(seeds) < 6:
        values = hue[rest]
        histogram, _ = np.histogram(values % 360, bins=36, range=(0, 360), weights=chroma[rest])
        wrapped = histogram + np.roll(histogram, 1) + np.roll(histogram, -1)
        middle = 10 * int(wrapped.argmax()) + 5
        alike = rest & (np.abs((hue - middle + 180) % 360 - 180) < REGION.split_hue)
        seeds.extend(_blobs(alike, least))
        rest &= ~alike
    neutral = component & ~coloured
    bright = neutral & (view.bright > -12) & (lab[..., 0] > 40)
    black = neutral & (lab[..., 0] < REGION.black_share * view.around)
    dark = _blobs(black, min(0.35 * area, REGION.own_area))
    broad = min((masks.half_width(seed) for seed in seeds), default=0.0) if dark else 0.0
    seeds.extend(_blobs(bright, min(0.3 * area, REGION.own_area)))
    seeds += [seed for seed in dark if masks.half_width(seed) > REGION.own_width * broad or seed.sum() > 0.35 * area]
    if len(seeds) <= 1:
        return [component]
    distances = np.stack([cv2.distanceTransform((~seed).astype(np.uint8), cv2.DIST_L2, 3) for seed in seeds])
    owner = distances.argmin(axis=0)
    parts = [component & (owner == i) for i in range(len(seeds))]
    # A piece that lies apart from the seed it is nearest to, such as half a cap beside a ball, is of what it lies at.
    for seed, part in zip(seeds, parts, strict=True):
        for piece in (each for each in _blobs(part, 0) if not (each & seed).any()):
            near = masks.dilated(piece) & ~part
            at = max(parts, key=lambda other: np.count_nonzero(near & other))
            part[piece], at[piece] = False, True
    return parts


def _hidden(found: Sequence[_Found]) -> list[bool]:
    """Which of them have much of their outline along one thing of another colour that ends lower in the image."""
    things = [
        (masks.bbox_of(one.mask)[3], _names(one.lab)[1], masks.outline_of(one.mask), masks.dilated(one.mask, 5))
        for one in found
    ]
    return [
        any(
            low > own_low and not colours & own and near[outline].mean() > REGION.hidden
            for low, colours, _, near in things
        )
        for own_low, own, outline, _ in things
    ]


def _blobs(mask: Mask, least: float) -> list[Mask]:
    """Connected blobs of at least a number of pixels."""
    _, labels = cv2.connectedComponents(mask.astype(np.uint8), connectivity=8)
    areas = np.bincount(labels.ravel())  # OpenCV's statistics take longer than the components
    return [labels == i for i in (np.nonzero(areas[1:] >= max(least, 12))[0] + 1).tolist()]


def _confidence(view: View, part: Mask, border: Mask, is_disc: bool) -> float:
    """How sure it is that a part is one separable thing with this outline: a product of four shares, each 0..1.

    Edges: the share of its outline, image border aside, that lies on edges; a disc was fitted to them. Contrast: its
    median distance from the surroundings in Lab over `sure_contrast`, but for a disc: a circle that fits is no chance.
    Size: its area over `sure_area`, of a disc over half of it (square roots of all). Border: 1 less half the share of
    its outline along the image's border, beyond which it may go on.
    """
    outline = masks.outline_of(part)
    inner = outline & ~border
    nearby = cv2.dilate(view.edges, np.ones((3, 3), np.uint8))
    sharp = float(np.mean(nearby[inner] > view.edge_threshold)) if inner.any() else 0.0
    contrast = float(np.median(np.hypot(view.chroma_gap[part], view.bright[part]))) / REGION.sure_contrast
    size = float(np.count_nonzero(part)) / REGION.sure_area
    cut_off = 1 - float(np.count_nonzero(inner)) / max(1, int(np.count_nonzero(outline)))
    if is_disc:
        sharp, contrast, size = max(sharp, 0.9), 1.0, 2 * size
    return sharp * min(1.0, contrast**0.5) * min(1.0, size**0.5) * (1 - cut_off / 2)


def _with_undersides(found: Sequence[_Found]) -> list[_Found]:
    """Joins dark lower ends, such as a car's wheels with the shade between them, with what they carry."""
    dark, whole = list[_Found](), list[_Found]()
    for one in found:
        lightness, a, b = np.median(one.lab, axis=0).tolist()
        is_dark = lightness < REGION.dark and colour_name(lightness, a, b) in {"black", "brown"}
        (dark if is_dark and not one.is_disc else whole).append(one)
    for part in dark:
        box, near = masks.bbox_of(part.mask), masks.dilated(part.mask)
        touched = [i for i, one in enumerate(whole) if (one.mask & near).any()]
        match [i for i in touched if is_underside(box, masks.bbox_of(whole[i].mask))]:
            case [i]:
                whole[i] = replace(whole[i], mask=whole[i].mask | part.mask)
            case _:
                whole.append(part)
    return whole


def _names(lab: Floats32) -> tuple[str, frozenset[str]]:
    """The name of the colour of pixels [N, 3] (Lab), and all that people may use for it."""
    chroma = np.hypot(lab[:, 1], lab[:, 2])
    sample = lab[chroma >= np.percentile(chroma, 40)] if np.median(chroma) > VIEW.chroma_step / 2 else lab
    lightness, a, b = np.median(sample, axis=0).tolist()
    return colour_name(lightness, a, b), colour_names(lightness, a, b)
