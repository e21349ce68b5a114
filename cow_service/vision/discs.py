"""Completes balls: a region is a disc if its outline lies on one circle and the circle on the strongest edges there.

By colour alone, a ball's region lacks its highlight and includes its contact shadow; the circle does neither.
"""

from __future__ import annotations

import cv2
import numpy as np

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
FILLED, SPILLED = 0.72, 0.14  # share of the disc that the region fills; share of the region outside it
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
    radius = _radius_on_edges(edges, x, y, radius, grow)
    height, width = part.shape
    angles = np.linspace(0, 2 * np.pi, SAMPLES, endpoint=False)
    columns, rows = np.round(x + radius * np.cos(angles)).astype(int), np.round(y + radius * np.sin(angles)).astype(int)
    seen = (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
    strong = cv2.dilate((edges > edge_threshold).astype(np.uint8), np.ones((3, 3), np.uint8))
    if seen.mean() < 0.5 or strong[rows[seen], columns[seen]].mean() < ON_EDGES:
        return None
    rays = _strongest_on(edges, x, y, radius)
    sharpest = rays[seen].mean()
    if on_circle < WHOLE and _longest_arc(rays) < LEAST_ARC:
        return None
    if on_circle + sharpest < ON_BOTH or (not seen.all() and sharpest < BEYOND_IMAGE):
        return None
    ys, xs = np.mgrid[:height, :width]
    disc = np.hypot(xs - x, ys - y) <= radius + 0.5
    both = (disc & part).sum()
    filled = CAP_FILLED if sharpest > CAP_RAYS else FILLED
    return disc if both > filled * disc.sum() and both > (1 - SPILLED) * part.sum() else None


def _radius_on_edges(edges: Floats32, x: float, y: float, radius: float, grow: float) -> float:
    """The radius (px) of the circle with the strongest median edge: `BLED` smaller at most, or `grow` larger."""
    angles = np.linspace(0, 2 * np.pi, SAMPLES, endpoint=False)[:, None]
    radii = radius + np.arange(-BLED, max(0.5, grow) + 0.01, 0.5)[None]
    columns, rows = x + np.cos(angles) * radii, y + np.sin(angles) * radii
    values = np.asarray(cv2.remap(edges, columns.astype(np.float32), rows.astype(np.float32), cv2.INTER_LINEAR))
    return float(radii[0, int(np.median(values, axis=0).argmax())])


def _strongest_on(edges: Floats32, x: float, y: float, radius: float) -> Mask:
    """For each of the `SAMPLES` rays from the middle of a circle, whether the strongest edge near it lies on it.

    On a ball's rays nothing is stronger than its outline; a circle around a cube or mug meets edges elsewhere.
    """
    angles = np.linspace(0, 2 * np.pi, SAMPLES, endpoint=False)[:, None]
    offsets = np.arange(RAY[0] * radius, RAY[1] * radius + 0.01, 0.5)[None]
    columns, rows = x + np.cos(angles) * (radius + offsets), y + np.sin(angles) * (radius + offsets)
    values = cv2.remap(edges, columns.astype(np.float32), rows.astype(np.float32), cv2.INTER_LINEAR)
    strongest = np.abs(offsets[0][np.asarray(values).argmax(axis=1)])
    return strongest < max(RAY_ERROR[0], RAY_ERROR[1] * radius)


def _longest_arc(rays: Mask) -> float:
    """Share of the circle that the longest run of rays takes, gaps of one ray closed: a polygon has many short runs."""
    twice = np.concatenate([rays, rays])
    closed = twice | (np.roll(twice, 1) & np.roll(twice, -1))
    longest = length = 0
    for on in closed:
        length = length + 1 if on else 0
        longest = max(longest, length)
    return min(1.0, longest / len(rays))


def _best_circle(outline: Floats) -> tuple[float, float, float, float] | None:
    """Centre and radius (px) of the circle on which most points [N, 2] lie, and their share; None where too few do."""
    rng = np.random.default_rng(0)  # the same outline must give the same circle
    circles = _circles_through(outline[rng.integers(0, len(outline), (TRIES, 3))])
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
    a, b, c = np.linalg.lstsq(terms, (chosen**2).sum(axis=1), rcond=None)[0]
    return float(a), float(b), float(np.sqrt(max(c + a * a + b * b, 0.0))), float(close[best].mean())


def _circles_through(triples: Floats) -> Floats:
    """Circles [T, 3] (x, y, radius) through triples of points [T, 3, 2]; not finite where they lie on a line."""
    a, b, c = triples[:, 0], triples[:, 1], triples[:, 2]
    ab, ac = b - a, c - a
    doubled = 2 * (ab[:, 0] * ac[:, 1] - ab[:, 1] * ac[:, 0])
    ab2, ac2 = (ab**2).sum(axis=1), (ac**2).sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        x = (ac[:, 1] * ab2 - ab[:, 1] * ac2) / doubled
        y = (ab[:, 0] * ac2 - ac[:, 0] * ab2) / doubled
    return np.column_stack([a[:, 0] + x, a[:, 1] + y, np.hypot(x, y)])
