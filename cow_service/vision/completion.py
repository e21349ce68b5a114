"""Completes balls: a region is a disc if its outline lies on one circle and the circle on the strongest edges there.

By colour alone, a ball's region lacks its highlight and includes its contact shadow; the circle does neither.
"""

import itertools
import math
from collections.abc import Iterator

import cv2
import numpy as np

from cow_service.records import BBox
from cow_service.vision.contrast import VIEW, View
from cow_service.vision.masks import dilated, outline_of
from cow_service.vision.types import Floats, Floats32, Mask

TRIES = 120  # circles through three points of the outline
NEAR = 1.3  # px at the working size: an outline point this close lies on the circle
ON_CIRCLE = 0.5  # share of the outline
ON_BOTH = 1.17  # sum of that share and of the share of the rays from the middle whose strongest edge is the circle
WHOLE, LEAST_ARC = 0.85, 0.25  # less of the outline than the first: so much of the circle must lie on edges in one run
BEYOND_IMAGE = 0.85  # share of those rays for a circle that the image's border cuts
RAY = (-0.3, 0.2)  # of the radius: how far inside and outside the circle a ray is searched
RAY_ERROR = (1.0, 0.03)  # px, and of the radius: how near the circle its strongest edge must lie; the larger counts
ON_EDGES = 0.8  # share of the circle
FILLED, SPILLED = 0.72, 0.25  # share of the disc that the region fills; share of the region outside it
CAP_FILLED, CAP_RAYS = 0.55, 0.9  # the same share where so many rays are strongest on the circle: a ball's lit cap
BLED = 2.5  # px by which compression may have spread a colour beyond its outline
SAMPLES = 72  # points tried on the circle
LEAST_RADIUS = 5.0  # px


def as_disc(part: Mask, edges: Floats32, edge_threshold: float, grow: float = 0.0) -> Mask | None:
    """The disc [h, w] that a part is, or None. `edges` [h, w] are gradients, edges above `edge_threshold`.

    A part that ends before the edges, by up to `grow` px, gives the disc that reaches to the strongest.
    """
    contours, _ = cv2.findContours(part.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    outline = np.asarray(max(contours, key=len)[:, 0], np.float64)
    if len(outline) < 20:
        return None
    circle = _best_circle(outline)
    if circle is None:
        return None
    x, y, radius, on_circle = circle
    # The radius with the strongest median edge.
    radii = radius + np.arange(-BLED, max(0.5, grow) + 0.01, 0.5)
    radius = float(radii[int(np.median(_along_rays(edges, x, y, radii), axis=0).argmax())])
    height, width = part.shape
    angles = np.linspace(0, 2 * np.pi, SAMPLES, endpoint=False)
    columns, rows = np.round(x + radius * np.cos(angles)).astype(int), np.round(y + radius * np.sin(angles)).astype(int)
    seen = (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
    strong = dilated(edges > edge_threshold)
    if seen.mean() < 0.5 or strong[rows[seen], columns[seen]].mean() < ON_EDGES:
        return None
    # On a ball's rays nothing is stronger than its outline; a circle around a cube or mug meets edges elsewhere.
    offsets = np.arange(RAY[0] * radius, RAY[1] * radius + 0.01, 0.5)
    strongest = np.abs(offsets[_along_rays(edges, x, y, radius + offsets).argmax(axis=1)])
    rays = strongest < max(RAY_ERROR[0], RAY_ERROR[1] * radius)
    sharpest = rays[seen].mean()
    # A polygon has many short runs of such rays; gaps of one ray are closed.
    twice = np.concatenate([rays, rays])
    closed = twice | (np.roll(twice, 1) & np.roll(twice, -1))
    longest = max((len(list(run)) for on, run in itertools.groupby(closed.tolist()) if on), default=0)
    if on_circle < WHOLE and min(1.0, longest / len(rays)) < LEAST_ARC:
        return None
    if on_circle + sharpest < ON_BOTH or (not seen.all() and sharpest < BEYOND_IMAGE):
        return None
    ys, xs = np.mgrid[:height, :width]
    disc = np.hypot(xs - x, ys - y) <= radius + 0.5
    both = (disc & part).sum()
    filled = CAP_FILLED if sharpest > CAP_RAYS else FILLED
    return disc if both > filled * disc.sum() and both > (1 - SPILLED) * part.sum() else None


def _along_rays(edges: Floats32, x: float, y: float, radii: Floats) -> Floats32:
    """Values [SAMPLES, R] on rays from a place, at distances [R]."""
    angles = np.linspace(0, 2 * np.pi, SAMPLES, endpoint=False)[:, None]
    columns, rows = x + np.cos(angles) * radii[None], y + np.sin(angles) * radii[None]
    values = cv2.remap(edges, columns.astype(np.float32), rows.astype(np.float32), cv2.INTER_LINEAR)
    return np.asarray(values, np.float32)


def _best_circle(outline: Floats) -> tuple[float, float, float, float] | None:
    """Centre and radius (px) of the circle on which most points [N, 2] lie, and their share; None if too few do."""
    rng = np.random.default_rng(0)  # the same outline must give the same circle
    a, b, c = np.moveaxis(outline[rng.integers(0, len(outline), (TRIES, 3))], 1, 0)  # [T, 2] each: not finite on a line
    ab, ac = b - a, c - a
    doubled = 2 * (ab[:, 0] * ac[:, 1] - ab[:, 1] * ac[:, 0])
    ab2, ac2 = (ab**2).sum(axis=1), (ac**2).sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        x = (ac[:, 1] * ab2 - ab[:, 1] * ac2) / doubled
        y = (ab[:, 0] * ac2 - ac[:, 0] * ab2) / doubled
    circles = np.column_stack([a[:, 0] + x, a[:, 1] + y, np.hypot(x, y)])
    reach = float(np.ptp(outline, axis=0).max())
    circles = circles[np.isfinite(circles).all(axis=1) & (circles[:, 2] >= LEAST_RADIUS) & (circles[:, 2] <= reach)]
    if not len(circles):
        return None
    gaps = np.linalg.norm(outline[None] - circles[:, None, :2], axis=2) - circles[:, 2:]
    close = np.abs(gaps) < NEAR
    best = int(close.sum(axis=1).argmax())
    if close[best].mean() < ON_CIRCLE:
        return None
    chosen = outline[close[best]]
    terms = np.column_stack([2 * chosen, np.ones(len(chosen))])  # x^2 + y^2 = 2ax + 2by + c, least squares
    u, v, w = np.linalg.lstsq(terms, (chosen**2).sum(axis=1), rcond=None)[0].tolist()
    return u, v, math.sqrt(max(w + u * u + v * v, 0.0)), float(close[best].mean())


def _joined(mask: Mask, seeds: Mask, connectivity: int) -> Mask:
    """The connected patches of a mask [h, w] in which seeds [h, w] lie."""
    _, labels = cv2.connectedComponents(mask.astype(np.uint8), connectivity=connectivity)
    touched = np.unique(labels[seeds])
    return np.isin(labels, touched[touched > 0])


INSIDE = 0.8  # of a dark part's box that lies in the thing's, grown by `BESIDE` and by `LOW`
BESIDE = 0.08  # of the thing's height
LOW = 0.22  # of the thing's height: so far from its lower end the dark part ends at most
NARROW = 0.7  # of the thing's width: what stands on it is narrower
FLAT = 1.5  # width of a dark part over its height, at least


def is_underside(part: BBox, thing: BBox) -> bool:
    """Whether the box [x0, y0, x1, y1] of a dark part lies at the lower end of a thing's, not before or next to it."""
    height = thing[3] - thing[1]
    width = min(part[2], thing[2] + BESIDE * height) - max(part[0], thing[0] - BESIDE * height)
    inside = width * (min(part[3], thing[3] + LOW * height) - max(part[1], thing[1]))
    low = abs(part[3] - thing[3]) <= LOW * height and part[1] + part[3] > thing[1] + thing[3]
    wide, high = part[2] - part[0], part[3] - part[1]
    return low and width > 0 and wide >= FLAT * high and inside >= INSIDE * wide * high


def is_top(part: BBox, thing: BBox) -> bool:
    """Whether the box [x0, y0, x1, y1] of a dark part stands on a thing's, as the neck of a bottle does."""
    width, height = thing[2] - thing[0], thing[3] - thing[1]
    within = part[0] >= thing[0] - BESIDE * width and part[2] <= thing[2] + BESIDE * width
    return within and part[2] - part[0] < NARROW * width and part[3] < thing[1] + LOW * height


BRIGHT_REACH = 1.6  # Lab lightness above the surroundings: another lit face
LEAST_TOP, LEAST_WHITE = 20, 60  # px: a bright top, and one that is surely of something white
LEAST_FACE_SIDE = 12  # px
MAX_SIDE, MAX_RATIO = 0.1, 12  # of the image, and of the top's area: one shaded side
HANGS = 0.7  # of a side's width that lies below the top
SHARP_TOP = 0.7  # of a top's outline that lies on edges: with less it is a shine on the floor
SHADE, SAME_CHROMA = 0.8, 4.0  # of the surroundings' light, and Lab units from their hue: a shadow
STRONG_EDGE = 3.0  # Lab units per px: no soft shadow ends in so strong an edge
LIT_BLACK = 0.85  # of the surroundings' light: the lit face of something black
LEAST_TOUCHED = 1.0  # of the side of a patch: so much of something black lies next to it
TEXTURE_EDGE = 0.4  # of the surroundings' spread in lightness: weaker edges are texture
WEAK_EDGES = (0.45, 1.8)  # as `ViewRules.edges`: the sides of something surely white stand out by as little

_Box = tuple[int, int, int, int]  # x, y, width, height


def white_sides(view: View, core: Mask) -> Mask:
    """Patches enclosed by edges at a bright neutral top: the other faces of something white, lit or in shade.

    `core` [h, w] are the pixels that are surely of an object.
    """
    neutral = (view.chroma < 2 * VIEW.chroma_step) | (view.chroma_gap < VIEW.chroma_step)
    white = core & (view.bright > VIEW.bright_step) & neutral
    _, labels, tops, _ = cv2.connectedComponentsWithStats(white.astype(np.uint8), connectivity=8)
    if not (tops[1:, 4] >= LEAST_TOP).any():
        return np.zeros(white.shape, bool)
    near_edges = dilated(view.edges > view.edge_threshold, 5)
    lit_too = (
        (cv2.GaussianBlur(view.bright, (0, 0), 1.5) > BRIGHT_REACH) & (view.chroma < 2 * VIEW.chroma_step)
    ) | white
    sides, surely_white = np.zeros(white.shape, bool), set[int]()
    for top, (x, y, w, h, area) in enumerate(tops.tolist()):
        around = slice(max(0, y - 1), y + h + 1), slice(max(0, x - 1), x + w + 1)
        if top == 0 or area < LEAST_TOP:
            continue
        if float(np.mean(near_edges[around][outline_of(labels[around] == top)])) <= SHARP_TOP:
            continue
        if 0.2 * w < h < 0.8 * w:  # slightly lit pixels joined to it, right below and no further down than it is wide
            window = slice(y, y + h + w), slice(x, x + w)
            sides[window] |= _joined(lit_too[window], labels[window] == top, 4)
        own = labels[y : y + h, x : x + w] == top
        if area >= LEAST_WHITE and float(np.median(view.chroma[y : y + h, x : x + w][own])) < VIEW.chroma_step:
            surely_white.add(top)

    def has_side(top: int, side: _Box, area: int, lit: bool) -> bool:
        """Whether a side belongs to a top: small compared with it, and lit or right below it."""
        x, y, w, _ = side
        tx, ty, tw, _, top_area = tops[top].tolist()
        hangs = min(x + w, tx + tw + 3) - max(x, tx - 3) > HANGS * w and y >= ty
        return top_area >= LEAST_TOP and area < MAX_RATIO * top_area and (lit or hangs)

    for thresholds in (*VIEW.edges, *([WEAK_EDGES] if surely_white else [])):
        weak = thresholds == WEAK_EDGES
        for near, patch, box in enclosed(view, *thresholds):
            is_shade = (
                np.median(view.light[near][patch]) < SHADE and np.median(view.chroma_gap[near][patch]) < SAME_CHROMA
            )
            if is_shade or (weak and float(np.median(view.chroma[near][patch])) > VIEW.chroma_step):
                continue
            touched = set(np.unique(labels[near][dilated(patch, times=4)]).tolist()) - {0}
            lit = len(touched) > 0 and float(np.median(view.bright[near][patch])) > BRIGHT_REACH
            area = int(np.count_nonzero(patch))
            if any(has_side(top, box, area, lit) for top in (touched & surely_white if weak else touched)):
                sides[near] |= dilated(patch, times=2)
    return sides


def black_faces(view: View, black: Mask) -> Mask:
    """Black patches with the lit faces next to them: dark patches between strong edges."""
    faces = black.copy()
    if not black.any():
        return faces
    for near, patch, _ in enclosed(view, STRONG_EDGE, 0.0):
        touched = np.count_nonzero(dilated(patch, times=4) & black[near])
        if (
            touched > LEAST_TOUCHED * math.sqrt(np.count_nonzero(patch))
            and np.median(view.light[near][patch]) < LIT_BLACK
        ):
            faces[near] |= dilated(patch, times=2)
    return faces


def enclosed(view: View, floor: float, factor: float) -> Iterator[tuple[tuple[slice, slice], Mask, _Box]]:
    """Patches between edges that do not reach the image's border: where they lie, their mask there, and their box."""
    height, width = view.edges.shape
    edge_threshold = np.maximum(max(floor, factor * view.median_edge), TEXTURE_EDGE * view.spread)
    edges = cv2.morphologyEx((view.edges > edge_threshold).astype(np.uint8), cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    _, labels, stats, _ = cv2.connectedComponentsWithStats(1 - edges, connectivity=4)
    for i, (x, y, w, h, area) in enumerate(stats.tolist()):
        at_border = x == 0 or y == 0 or x + w == width or y + h == height
        if i and not at_border and LEAST_FACE_SIDE <= area <= MAX_SIDE * height * width:
            near = slice(max(0, y - 4), y + h + 4), slice(max(0, x - 4), x + w + 4)
            yield near, labels[near] == i, (x, y, w, h)
