"""Completes balls: a region is a disc if its outline lies on one circle and the circle on the strongest edges there.

By colour alone, a ball's region lacks its highlight and includes its contact shadow; the circle does neither.
"""

import itertools
import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from cow_service.media.masks import dilated, outer_contour, outline_of
from cow_service.media.types import Floats, Floats32, Mask
from cow_service.perception.classical.circles import fit_circle
from cow_service.perception.classical.contrast import VIEW, View
from cow_service.records import BBox


class DiscRules(NamedTuple):
    """When a part is a ball.

    Set by hand on balls, cubes and mugs of the first family of rendered scenes; without it 7 of 120 answers are lost.
    No single number has a measurement of its own.
    """

    tries: int = 120  # circles through three points of the outline
    near: float = 1.3  # px at the working size: an outline point this close lies on the circle
    on_circle: float = 0.5  # share of the outline
    # sum of that share and of the share of the rays from the middle whose strongest edge is the circle
    on_both: float = 1.17
    whole: float = 0.85  # share of the outline on the circle: with less, the next counts
    arc: float = 0.25  # so much of the circle must lie on edges in one run
    beyond_image: float = 0.85  # share of those rays for a circle that the image's border cuts
    ray: tuple[float, float] = (-0.3, 0.2)  # of the radius: how far inside and outside the circle a ray is searched
    ray_error: tuple[float, float] = (1.0, 0.03)  # px, and of the radius: how far off its strongest edge may lie
    on_edges: float = 0.8  # share of the circle
    filled: float = 0.72  # share of the disc that the region fills
    spilled: float = 0.25  # share of the region outside it
    cap_filled: float = 0.55  # share of the disc that a ball's lit cap fills
    cap_rays: float = 0.9  # where so many rays are strongest on the circle
    bled: float = 2.5  # px by which compression may have spread a colour beyond its outline
    samples: int = 72  # points tried on the circle
    radius: float = 5.0  # px, at least


DISC = DiscRules()
_ANGLES = np.linspace(0, 2 * np.pi, DISC.samples, endpoint=False)
_RAYS = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)])  # unit vectors


def as_disc(part: Mask, edges: Floats32, edge_threshold: float, grow: float = 0.0) -> Mask | None:
    """The disc [h, w] that a part is, or None. `edges` [h, w] are gradients, edges above `edge_threshold`.

    A part that ends before the edges, by up to `grow` px, gives the disc that reaches to the strongest.
    """
    circle = _best_circle(outer_contour(part)[:, 0].astype(np.float64))
    if circle is None:
        return None
    x, y, radius, on_circle = circle
    # The radius with the strongest median edge.
    radii = radius + np.arange(-DISC.bled, max(0.5, grow) + 0.01, 0.5)
    radius = float(radii[int(np.median(_along_rays(edges, x, y, radii), axis=0).argmax())])
    height, width = part.shape
    columns, rows = np.round(np.array([[x], [y]]) + radius * _RAYS).astype(int)
    seen = (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
    strong = dilated(edges > edge_threshold)
    if seen.mean() < 0.5 or strong[rows[seen], columns[seen]].mean() < DISC.on_edges:
        return None
    # On a ball's rays nothing is stronger than its outline; a circle around a cube or mug meets edges elsewhere.
    offsets = np.arange(DISC.ray[0] * radius, DISC.ray[1] * radius + 0.01, 0.5)
    strongest = np.abs(offsets[_along_rays(edges, x, y, radius + offsets).argmax(axis=1)])
    rays = strongest < max(DISC.ray_error[0], DISC.ray_error[1] * radius)
    sharpest = rays[seen].mean()
    # A polygon has many short runs of such rays; gaps of one ray are closed.
    twice = np.concatenate([rays, rays])
    closed = twice | (np.roll(twice, 1) & np.roll(twice, -1))
    longest = max((len(list(run)) for on, run in itertools.groupby(closed.tolist()) if on), default=0)
    if on_circle < DISC.whole and min(1.0, longest / len(rays)) < DISC.arc:
        return None
    if on_circle + sharpest < DISC.on_both or (not seen.all() and sharpest < DISC.beyond_image):
        return None
    ys, xs = np.mgrid[:height, :width]
    disc = np.hypot(xs - x, ys - y) <= radius + 0.5
    both = (disc & part).sum()
    filled = DISC.cap_filled if sharpest > DISC.cap_rays else DISC.filled
    return disc if both > filled * disc.sum() and both > (1 - DISC.spilled) * part.sum() else None


def _along_rays(edges: Floats32, x: float, y: float, radii: Floats) -> Floats32:
    """Values [DISC.samples, R] on rays from a place, at distances [R]."""
    columns, rows = x + np.outer(_RAYS[0], radii), y + np.outer(_RAYS[1], radii)
    values = cv2.remap(edges, columns.astype(np.float32), rows.astype(np.float32), cv2.INTER_LINEAR)
    return np.asarray(values, np.float32)


def _best_circle(outline: Floats) -> tuple[float, float, float, float] | None:
    """Centre and radius (px) of the circle on which most points [N, 2] lie, and their share; None if too few do."""
    if len(outline) < 20:
        return None
    rng = np.random.default_rng(0)  # the same outline must give the same circle
    a, b, c = np.moveaxis(outline[rng.integers(0, len(outline), (DISC.tries, 3))], 1, 0)  # [T, 2] each
    ab, ac = b - a, c - a
    doubled = 2 * (ab[:, 0] * ac[:, 1] - ab[:, 1] * ac[:, 0])
    ab2, ac2 = (ab**2).sum(axis=1), (ac**2).sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        x = (ac[:, 1] * ab2 - ab[:, 1] * ac2) / doubled
        y = (ab[:, 0] * ac2 - ac[:, 0] * ab2) / doubled
    # Not finite for three points on a line.
    circles = np.column_stack([a[:, 0] + x, a[:, 1] + y, np.hypot(x, y)])
    reach = float(np.ptp(outline, axis=0).max())
    circles = circles[np.isfinite(circles).all(axis=1) & (circles[:, 2] >= DISC.radius) & (circles[:, 2] <= reach)]
    if not len(circles):
        return None
    gaps = np.linalg.norm(outline[None] - circles[:, None, :2], axis=2) - circles[:, 2:]
    close = np.abs(gaps) < DISC.near
    best = int(close.sum(axis=1).argmax())
    if close[best].mean() < DISC.on_circle:
        return None
    return *fit_circle(*outline[close[best]].T), float(close[best].mean())


class DarkRules(NamedTuple):
    """Which dark part is a thing's wheels, or its top.

    Set by hand on toy cars and bottles of the first family of rendered scenes; no single number has a measurement of
    its own.
    """

    inside: float = 0.8  # of a dark part's box that lies in the thing's, grown by `beside` and by `low`
    beside: float = 0.08  # of the thing's height
    low: float = 0.22  # of the thing's height: so far from its lower end the dark part ends at most
    narrow: float = 0.7  # of the thing's width: what stands on it is narrower
    flat: float = 1.5  # width of a dark part over its height, at least


DARK = DarkRules()


def is_underside(part: BBox, thing: BBox) -> bool:
    """Whether the box [x0, y0, x1, y1] of a dark part lies at the lower end of a thing's, not before or next to it."""
    height = thing[3] - thing[1]
    width = min(part[2], thing[2] + DARK.beside * height) - max(part[0], thing[0] - DARK.beside * height)
    inside = width * (min(part[3], thing[3] + DARK.low * height) - max(part[1], thing[1]))
    low = abs(part[3] - thing[3]) <= DARK.low * height and part[1] + part[3] > thing[1] + thing[3]
    wide, high = part[2] - part[0], part[3] - part[1]
    return low and width > 0 and wide >= DARK.flat * high and inside >= DARK.inside * wide * high


def is_top(part: BBox, thing: BBox) -> bool:
    """Whether the box [x0, y0, x1, y1] of a dark part stands on a thing's, as the neck of a bottle does."""
    width, height = thing[2] - thing[0], thing[3] - thing[1]
    within = part[0] >= thing[0] - DARK.beside * width and part[2] <= thing[2] + DARK.beside * width
    return within and part[2] - part[0] < DARK.narrow * width and part[3] < thing[1] + DARK.low * height


class FaceRules(NamedTuple):
    """Which patches between edges are faces of something white or black.

    Set by hand on white and black things of the first family of rendered scenes; no single number has a measurement of
    its own.
    """

    bright_reach: float = 1.6  # Lab lightness above the surroundings: another lit face
    top: int = 20  # px of a bright top, at least
    white: int = 60  # px of one that is surely of something white
    face: int = 12  # px
    side: float = 0.1  # of the image: one shaded side, at most
    ratio: int = 12  # of the top's area: the same
    hangs: float = 0.7  # of a side's width that lies below the top
    sharp_top: float = 0.7  # of a top's outline that lies on edges: with less it is a shine on the floor
    shade: float = 0.8  # of the surroundings' light: a shadow has less
    same_chroma: float = 4.0  # Lab units from the surroundings' hue: a shadow has less
    strong_edge: float = 3.0  # Lab units per px: no soft shadow ends in so strong an edge
    lit_black: float = 0.85  # of the surroundings' light: the lit face of something black
    touched: float = 1.0  # of the side of a patch: so much of something black lies next to it
    texture_edge: float = 0.4  # of the surroundings' spread in lightness: weaker edges are texture
    weak_edges: tuple[float, float] = (0.45, 1.8)  # as `ViewRules.edges`, for the sides of something surely white


FACE = FaceRules()


_Box = tuple[int, int, int, int]  # x, y, width, height


def white_sides(view: View, core: Mask) -> Mask:
    """Patches enclosed by edges at a bright neutral top: the other faces of something white, lit or in shade.

    `core` [h, w] are the pixels that are surely of an object.
    """
    neutral = (view.chroma < 2 * VIEW.chroma_step) | (view.chroma_gap < VIEW.chroma_step)
    white = core & (view.bright > VIEW.bright_step) & neutral
    _, labels, tops, _ = cv2.connectedComponentsWithStats(white.astype(np.uint8), connectivity=8)
    if not (tops[1:, 4] >= FACE.top).any():
        return np.zeros(white.shape, bool)
    sides, surely_white = _lit_below(view, white, labels, tops)
    for thresholds in (*VIEW.edges, *([FACE.weak_edges] if surely_white else [])):
        weak = thresholds == FACE.weak_edges
        for near, patch, box in enclosed(view, *thresholds):
            light, gap, chroma, bright = (
                float(np.median(values[near][patch]))
                for values in (view.light, view.chroma_gap, view.chroma, view.bright)
            )
            is_shade = light < FACE.shade and gap < FACE.same_chroma
            if is_shade or (weak and chroma > VIEW.chroma_step):
                continue
            touched = set(np.unique(labels[near][dilated(patch, times=4)]).tolist()) - {0}
            area, is_lit = int(np.count_nonzero(patch)), bright > FACE.bright_reach
            if any(_has_side(tops[top], box, area, is_lit) for top in (touched & surely_white if weak else touched)):
                sides[near] |= dilated(patch, times=2)
    return sides


def _lit_below(view: View, white: Mask, labels: NDArray[Any], tops: NDArray[Any]) -> tuple[Mask, set[int]]:
    """What is slightly lit right below bright tops, and which of those are surely of something white.

    Tops are the patches of `white` [h, w], by their labels [h, w] and statistics [N, 5].
    """
    near_edges = dilated(view.edges > view.edge_threshold, 5)
    is_lit = (cv2.GaussianBlur(view.bright, (0, 0), 1.5) > FACE.bright_reach) & (view.chroma < 2 * VIEW.chroma_step)
    sides, surely_white = np.zeros(white.shape, bool), set[int]()
    for top, (x, y, w, h, area) in enumerate(tops.tolist()):
        around = slice(max(0, y - 1), y + h + 1), slice(max(0, x - 1), x + w + 1)
        own = labels[around] == top
        if top == 0 or area < FACE.top or float(np.mean(near_edges[around][outline_of(own)])) <= FACE.sharp_top:
            continue
        if 0.2 * w < h < 0.8 * w:  # pixels joined to it, no further down than it is wide
            window = slice(y, y + h + w), slice(x, x + w)
            _, patches = cv2.connectedComponents((is_lit | white)[window].astype(np.uint8), connectivity=4)
            sides[window] |= np.isin(patches, np.unique(patches[labels[window] == top]))
        if area >= FACE.white and float(np.median(view.chroma[around][own])) < VIEW.chroma_step:
            surely_white.add(top)
    return sides, surely_white


def _has_side(top: NDArray[Any], side: _Box, area: int, is_lit: bool) -> bool:
    """Whether a side belongs to a top, by its statistics: small compared with it, and lit or right below it."""
    x, y, w, _ = side
    tx, ty, tw, _, top_area = top.tolist()
    hangs = min(x + w, tx + tw + 3) - max(x, tx - 3) > FACE.hangs * w and y >= ty
    return top_area >= FACE.top and area < FACE.ratio * top_area and (is_lit or hangs)


def black_faces(view: View, black: Mask) -> Mask:
    """Black patches with the lit faces next to them: dark patches between strong edges."""
    faces = black.copy()
    if not black.any():
        return faces
    for near, patch, _ in enclosed(view, FACE.strong_edge, 0.0):
        touched = np.count_nonzero(dilated(patch, times=4) & black[near])
        is_beside = touched > FACE.touched * math.sqrt(np.count_nonzero(patch))
        if is_beside and np.median(view.light[near][patch]) < FACE.lit_black:
            faces[near] |= dilated(patch, times=2)
    return faces


def enclosed(view: View, floor: float, factor: float) -> Iterator[tuple[tuple[slice, slice], Mask, _Box]]:
    """Patches between edges that do not reach the image's border: where they lie, their mask there, and their box."""
    height, width = view.edges.shape
    edge_threshold = np.maximum(max(floor, factor * view.median_edge), FACE.texture_edge * view.spread)
    edges = cv2.morphologyEx((view.edges > edge_threshold).astype(np.uint8), cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    _, labels, stats, _ = cv2.connectedComponentsWithStats(1 - edges, connectivity=4)
    for i, (x, y, w, h, area) in enumerate(stats.tolist()):
        at_border = x == 0 or y == 0 or x + w == width or y + h == height
        if i and not at_border and FACE.face <= area <= FACE.side * height * width:
            near = slice(max(0, y - 4), y + h + 4), slice(max(0, x - 4), x + w + 4)
            yield near, labels[near] == i, (x, y, w, h)
