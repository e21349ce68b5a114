"""Finds trails: three or more positions of one ball in one image, faded or as opaque as in a multiple exposure.

Two circles that look alike are the start; others that look like them are sought between and beyond them, on a path
along which place and size change smoothly. Balls that merely look alike are no trail by themselves: only where the
question or the reader speaks of one is a picture searched.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from cow_service.media.masks import iou, window_of
from cow_service.media.types import Floats, Floats32, Image, Mask
from cow_service.perception.classical.circles import BINS, Circle, Edges
from cow_service.perception.classical.inpainting import fill_hole
from cow_service.physics.bodies import Position
from cow_service.records import BBox, Point, Vector


class TrailRules(NamedTuple):
    """When circles are positions of one ball.

    Set by hand on trails of the first family of rendered scenes and on drawn ones, with bottles and rows of balls that
    must not pass; no single number has a measurement of its own.
    """

    unlike: float = 0.3  # difference of appearance over the contrast, at most
    contrast: float = 12.0  # grey levels of that contrast, at least
    opacity: float = 0.08  # at least
    unrest: float = 12.0  # grey levels of a background's variation that are allowed for
    end_support: float = 0.5  # of the circumference of an end, on edges: the next position hides the rest
    pale_support: float = 0.4  # of the circumference of a pale one that a path leads to
    predicted: float = 0.2  # radii: how near to where a path leads a pale position must lie
    sure_support: float = 0.3  # of the circumference: with more, no better circle is sought nearby
    seen_support: float = 0.75  # of what the other positions leave to be seen of a circumference, on edges
    notched: float = 0.35  # of the depth of the notch between two circles: less is a straight side
    sizes: float = 1.35  # between the radii of neighbours, at most
    faded: float = 0.85  # of the opacity of the most opaque: with less, a position was faded
    spacing: tuple[float, float] = (0.5, 2.0)  # between neighbouring gaps
    bend: float = math.radians(65)  # between neighbouring legs, at most
    least_gap: float = 0.35  # radii between neighbours, at least
    most_gap: float = 5.0  # the same, at most
    sag: float = 0.3  # of the distance of two positions: how far those between may lie off the line
    positions: int = 12  # at most
    pairs: int = 6  # circles that look alike, between and beyond which others are sought
    same_iou: float = 0.4  # from which a box is that of a position


TRAIL = TrailRules()


Chain = tuple[Circle, ...]  # along a path, in order


def _ring(turns: Floats, *radii: float) -> Floats:
    """Points [N, 2] around the origin."""
    return np.concatenate([radius * np.stack([np.cos(turns), np.sin(turns)], axis=1) for radius in radii])


RIM = _ring((np.arange(BINS) + 0.5) * 2 * math.pi / BINS, 1.0)  # the middles of a circumference's bins, radii
# Offsets from a centre (radii): where appearances are compared, inside and around a rim, and where circles are sought.
INSIDE = _ring(np.linspace(0, 2 * math.pi, 24, endpoint=False), 0.25, 0.5, 0.7, 0.85)
AROUND_RIM = _ring(np.linspace(0, 2 * math.pi, 48, endpoint=False), 1.15, 1.3)
AROUND = np.array([(0, 0), (0.25, 0), (-0.25, 0), (0, 0.25), (0, -0.25)])


@dataclass(frozen=True)
class Trail:
    """Positions of one ball along its path, the oldest first and the present one last."""

    positions: tuple[Position, ...]
    end_known: bool  # which end is the present one: told by their opacity, or named

    @property
    def present(self) -> Position:
        """Where the ball is now."""
        return self.positions[-1]

    @property
    def older(self) -> tuple[Position, ...]:
        """Where it was, the oldest first."""
        return self.positions[:-1]

    @property
    def heading(self) -> Vector:
        """Image velocity at the present position, px per interval between positions."""
        c, b, a = (position.centre for position in self.positions[-1:-4:-1])
        return (3 * c[0] - 4 * b[0] + a[0]) / 2, (3 * c[1] - 4 * b[1] + a[1]) / 2

    def ending(self, near: BBox | None = None, side: Vector | None = None) -> Trail:
        """The same positions with the present one at the end nearest to a box, or farthest to a side, else as it shows.

        A side is a direction in the image: (-1, 0) for the leftmost.
        """
        ends = self.positions[0], self.positions[-1]
        if near is not None:
            x0, y0, x1, y1 = near
            gaps = [math.dist(position.centre, ((x0 + x1) / 2, (y0 + y1) / 2)) for position in ends]
        elif side is not None:
            gaps = [-position.x * side[0] - position.y * side[1] for position in ends]
        else:
            return self
        is_last = gaps[1] <= gaps[0]
        return Trail(self.positions if is_last else self.positions[::-1], True)


def trail_of(trails: Sequence[Trail], bbox: BBox) -> Trail | None:
    """The trail that has a position in a box [x0, y0, x1, y1]."""
    return next((trail for trail in trails if any(iou(p.bbox, bbox) >= TRAIL.same_iou for p in trail.positions)), None)


def trail_ending_at(trails: Sequence[Trail], bbox: BBox) -> Trail | None:
    """The trail whose present position lies in a box, turned round where its first position does."""
    for trail in trails:
        for positions in (trail.positions, trail.positions[::-1]):
            if iou(positions[-1].bbox, bbox) >= TRAIL.same_iou:
                return Trail(positions, True)
    return None


def find_trails(image: Image) -> tuple[Trail, ...]:
    """Trails of balls in an RGB image [H, W, 3] without drawings on it, the longest first."""
    edges = Edges.of(image)
    if edges is None:
        return ()
    search = _Search(edges, image)
    ends = [c for c in edges.circles() if c.support >= TRAIL.end_support and search.contrast(c) >= TRAIL.contrast]
    trails: list[Trail] = []
    alike = (pair for pair in _pairs(ends) if _are_apart(pair, trails) and search.are_alike(pair))
    for a, b in itertools.islice(alike, TRAIL.pairs):
        trail = search.trail_through(a, b)
        trails += [] if trail is None else [trail]
    whole: list[Trail] = []
    for trail in sorted(trails, key=lambda trail: -len(trail.positions)):
        if _are_apart(trail.positions, whole):
            whole.append(trail)
    return tuple(whole)


def _are_apart(places: Sequence[Circle | Position], trails: Sequence[Trail]) -> bool:
    """Whether none of some places is a position of a trail."""
    pairs = ((p, q) for trail in trails for p in places for q in trail.positions)
    return all(math.dist(p.centre, q.centre) >= 0.6 * max(p.radius, q.radius) for p, q in pairs)


@dataclass(frozen=True, eq=False)
class _Search:
    """Looks for circles along a path in an RGB image [H, W, 3] that look like one ball, faded or not."""

    edges: Edges
    image: Image

    def trail_through(self, a: Circle, b: Circle) -> Trail | None:
        """The trail through two positions; None if fewer than three lie along a path.

        Its more opaque end is the last; if both are alike, the end that is less hidden.
        """
        best: Chain = ()
        for inner in range(3 * TRAIL.positions // 4):
            chain = self.between(a, b, inner)
            if chain is None:
                continue
            chain = self.extended(self.extended(chain)[::-1])
            if len(chain) > max(2, len(best)) and _is_path(chain) and self.are_alike(chain) and self.is_outlined(chain):
                best = chain
        if not best:
            return None
        chain = self.extended(self.extended(best, compared=False)[::-1], compared=False)[::-1]
        shares = self.opacities(chain, compared=False)
        if shares is None:
            return None
        opacity = np.clip(shares / shares.max(), 0, 1)
        positions = tuple(Position(c.x, c.y, c.radius, float(o)) for c, o in zip(chain, opacity, strict=True))
        known = abs(float(opacity[0] - opacity[-1])) > 1 - TRAIL.faded
        rank = (opacity[0], opacity[-1]) if known else (chain[0].support, chain[-1].support)
        ordered = positions if rank[1] >= rank[0] else positions[::-1]
        return Trail(ordered, known)

    def between(self, a: Circle, b: Circle, inner: int) -> Chain | None:
        """Two circles with others between them, evenly along an arc that bulges to one side or the other."""
        apart = math.dist(a.centre, b.centre)
        gap, mean = apart / (inner + 1), (a.radius + b.radius) / 2
        if not TRAIL.least_gap * mean < gap < TRAIL.most_gap * mean:
            return None
        start, end, across = np.array(a.centre), np.array(b.centre), np.array([a.y - b.y, b.x - a.x]) / apart
        most = TRAIL.sag * apart if inner else 0.0
        for bulge in sorted([0.0, *np.arange(-most, most + 1e-9, 0.35 * mean).tolist()], key=abs):
            chain = [a]
            for t in np.arange(1, inner + 1) / (inner + 1):
                x, y = (start * (1 - t) + end * t + 4 * t * (1 - t) * bulge * across).tolist()
                found = _fit_near(self.edges, x, y, a.radius ** (1 - t) * b.radius**t)
                if found is None or any(found.is_same(other) for other in (*chain, b)):
                    break
                chain.append(found)
            whole = (*chain, b)
            if len(whole) == inner + 2 and _is_path(whole) and self.are_alike(whole):
                return whole
        return None

    def extended(self, chain: Chain, compared: bool = True) -> Chain:
        """A chain with what goes on after its last circle.

        Where it is not compared with the others, for it may be too pale or too much overlaid, it must lie exactly where
        the path of three or more leads.
        """
        while len(chain) < TRAIL.positions:
            last, before, seeds = chain[-1], chain[-2], _next_places(chain)
            for x, y in seeds if compared else seeds[:1]:
                found = _fit_near(self.edges, x, y, last.radius**2 / before.radius if compared else last.radius)
                if found is None or any(found.is_same(other) for other in chain) or not _is_path((*chain, found)):
                    continue
                is_predicted = math.dist(found.centre, (x, y)) < TRAIL.predicted * found.radius
                is_seen = found.support >= TRAIL.pale_support and self.contrast(found) >= TRAIL.contrast / 2
                if self.are_alike((*chain, found)) if compared else is_predicted and is_seen:
                    chain = (*chain, found)
                    break
            else:
                break
        return chain

    def is_outlined(self, chain: Chain) -> bool:
        """Whether edges show as much of each circle as the others leave to be seen, and the notches between them.

        Circles that were fitted into a bottle do not pass.
        """
        notches = [notch for a, b in pairwise(chain) if (notch := self.edges.notch(a, b)) is not None]
        if notches and float(np.median(notches)) < TRAIL.notched:
            return False
        for i, circle in enumerate(chain):
            seen = _is_free(chain, i, RIM, 1.0)
            on = np.isin(np.arange(BINS), list(circle.on_edges))
            if np.count_nonzero(on & seen) < TRAIL.seen_support * max(1, np.count_nonzero(seen)):
                return False
        return min(chain[0].support, chain[-1].support) >= TRAIL.end_support

    def contrast(self, circle: Circle) -> float:
        """Lower quartile of the steps from inside to outside over the edges on a circle, grey levels."""
        rim = RIM[sorted(circle.on_edges)]
        inside, outside = (self.colours(circle, factor * rim) for factor in (0.85, 1.15))
        return float(np.percentile(np.linalg.norm(inside - outside, axis=1), 25))

    def are_alike(self, chain: Chain) -> bool:
        """Whether all look like the first or the last, faded or not."""
        return self.opacities(chain) is not None

    def opacities(self, chain: Chain, compared: bool = True) -> Floats | None:
        """Opacity [N] of each circle against one that is the most opaque; None if they do not look alike.

        Without `compared` they are known to.
        """
        about, unrest, inner, free = list[Floats](), list[float](), list[Floats](), list[Mask]()
        for i, circle in enumerate(chain):
            outside = _is_free(chain, i, AROUND_RIM, 1.1)
            ring = self.colours(circle, AROUND_RIM[outside] if outside.sum() > 8 else AROUND_RIM)
            about.append(np.median(ring, axis=0))
            unrest.append(float(np.median(np.linalg.norm(ring - about[i], axis=1))))
            inner.append(self.colours(circle, INSIDE))
            free.append(_is_free(chain, i, INSIDE, 1.05))
        strength = [float(np.abs(v[f] - b).mean()) if f.any() else 0.0
                    for v, b, f in zip(inner, about, free, strict=True)]  # fmt: skip
        model = max((0, len(chain) - 1), key=lambda i: strength[i])
        shares: list[float] = []
        for i in range(len(chain)):
            both = free[i] & free[model]
            if np.count_nonzero(both) < 6:
                both = free[i] | free[model]
            if not both.any():  # each lies behind the others
                return None
            seen, wanted = inner[i][both], inner[model][both]
            share = _opacity(seen - about[i], wanted - about[model], seen - wanted, unrest[i] if compared else math.inf)
            if share is None:
                return None
            shares.append(share)
        return np.array(shares)

    def colours(self, circle: Circle, offsets: Floats) -> Floats:
        """Colours [N, 3] at offsets [N, 2] (radii) from a circle's centre."""
        return sampled(self.image, circle, offsets[:, 0], offsets[:, 1]).astype(np.float64)


def sampled(image: Image, of: Circle | Position, u: Floats | Floats32, v: Floats | Floats32) -> Image:
    """Colours [..., 3] at offsets [...] (radii) right and down from a centre, or next to them in the image."""
    xs = np.clip(of.x + of.radius * u, 0, image.shape[1] - 1).astype(int)
    ys = np.clip(of.y + of.radius * v, 0, image.shape[0] - 1).astype(int)
    return image[ys, xs]


def _opacity(seen: Floats, model: Floats, plain: Floats, unrest: float) -> float | None:
    """The share of a model's contrast [N, 3] that is seen [N, 3]; None if what is seen is no share of it.

    `plain` [N, 3] are the differences of the colours themselves, which do not depend on the background; `unrest`
    is how much that varies (grey levels), infinite where they are known to be alike.
    """
    contrast = float(np.median(np.linalg.norm(model, axis=1)))
    if contrast < TRAIL.contrast:
        return None
    if float(np.median(np.linalg.norm(plain, axis=1))) < TRAIL.unlike * contrast / 2:
        return 1.0
    share = float((seen * model).sum() / (model**2).sum())
    rest = float(np.median(np.linalg.norm(seen - share * model, axis=1)))
    if math.isinf(unrest):
        return min(max(share, TRAIL.opacity), 1.0)
    allowed = min(unrest, TRAIL.unrest)
    if not TRAIL.opacity < share < 1.15 or rest > TRAIL.unlike * contrast * share + allowed:
        return None
    return min(share, 1.0)


def _is_free(chain: Chain, i: int, offsets: Floats, factor: float) -> Mask:
    """Which offsets [N, 2] (radii) of a circle lie in none of the others, whose radii are multiplied."""
    points = np.array(chain[i].centre) + chain[i].radius * offsets
    others = np.array([(other.x, other.y, other.radius) for other in (*chain[:i], *chain[i + 1 :])])
    away = np.hypot(points[:, :1] - others[:, 0], points[:, 1:] - others[:, 1])
    return np.all(away >= factor * others[:, 2], axis=1)


def _fit_near(edges: Edges, x: float, y: float, radius: float) -> Circle | None:
    """The circle with most edges on it within half a radius of a place."""
    near: list[Circle] = []
    for column, row in (np.array([x, y]) + radius * AROUND).tolist():
        found = edges.fit(column, row, radius)
        if found is None or not 1 / TRAIL.sizes < found.radius / radius < TRAIL.sizes:
            continue
        if math.dist(found.centre, (x, y)) < 0.6 * radius:
            near.append(found)
            if found.support > TRAIL.sure_support:
                break
    return max(near, key=lambda circle: circle.support, default=None)


def _pairs(ends: Sequence[Circle]) -> Iterator[tuple[Circle, Circle]]:
    """Those that may be positions of one ball, with others between or beyond them."""
    for a, b in itertools.combinations(ends, 2):
        apart, mean = math.dist(a.centre, b.centre), (a.radius + b.radius) / 2
        small, large = sorted((a.radius, b.radius))
        if 0.25 * mean < apart < TRAIL.most_gap * 3 * mean and large < TRAIL.sizes**3 * small:
            yield a, b


def _next_places(chain: Chain) -> list[Point]:
    """Where the next circle of a chain may lie, the likeliest first: on along its bend, or straight on, or turned."""
    last, before = chain[-1], chain[-2]
    dx, dy = last.x - before.x, last.y - before.y
    if len(chain) > 2:
        bent = 3 * last.x - 3 * before.x + chain[-3].x, 3 * last.y - 3 * before.y + chain[-3].y
        return [bent, (last.x + dx, last.y + dy)]
    turns = [(math.cos(angle), math.sin(angle)) for angle in (0, -0.35, 0.35, -0.7, 0.7)]
    return [(last.x + dx * c - dy * s, last.y + dx * s + dy * c) for c, s in turns]


def _is_path(chain: Chain) -> bool:
    """Whether place and size change smoothly along circles."""
    places = np.array([c.centre for c in chain])
    legs = np.diff(places, axis=0)
    gaps = np.linalg.norm(legs, axis=1)
    radii = np.array([c.radius for c in chain])
    ratio = radii[1:] / radii[:-1]
    if (ratio > TRAIL.sizes).any() or (ratio < 1 / TRAIL.sizes).any() or (gaps < TRAIL.least_gap * radii[1:]).any():
        return False
    if len(chain) < 3:
        return True
    turns = np.arctan2(legs[:-1, 0] * legs[1:, 1] - legs[:-1, 1] * legs[1:, 0], (legs[:-1] * legs[1:]).sum(axis=1))
    if (np.abs(turns) > TRAIL.bend).any() or ((turns > 0.15).any() and (turns < -0.15).any()):
        return False
    uneven = np.abs(np.diff(np.log(radii), 2)).max()
    spread = gaps[1:] / gaps[:-1]
    return bool(uneven < 0.12 and (spread > TRAIL.spacing[0]).all() and (spread < TRAIL.spacing[1]).all())


# --- taking earlier positions out


class PositionRules(NamedTuple):
    """How earlier positions are taken out.

    Set by hand on trails of the first family of rendered scenes; no single number has a measurement of its own.
    """

    rim: float = 0.06  # of the radius: around a position, mixed with the background
    least_rim: float = 2.0  # px: the same, at least
    apart: float = 0.03  # radii outside all earlier positions: there a pixel is surely the present one's


POSITION = PositionRules()


def without_earlier_positions(image: Image, trail: Trail) -> Image:
    """The image [H, W, 3] with the present position of a trail alone."""
    shape, present = (image.shape[0], image.shape[1]), trail.present
    earlier = np.any(
        [each.disc(shape, max(POSITION.least_rim, POSITION.rim * each.radius)) for each in trail.older], axis=0
    )
    reached = present.disc(shape, max(POSITION.least_rim, POSITION.rim * present.radius))
    hidden = earlier & reached
    filled = fill_hole(image, earlier | reached if hidden.any() else earlier)
    result = image.copy()
    result[earlier] = filled[earlier]
    window = window_of(hidden)
    if window is not None:
        share, colours = _completed(image, trail, window)
        mixed = share * colours + (1 - share) * filled[window]
        result[window] = np.where(hidden[window][..., None], np.round(mixed), result[window]).astype(np.uint8)
    return result


def _completed(image: Image, trail: Trail, window: tuple[slice, slice]) -> tuple[Floats32, Floats32]:
    """How much of each pixel of a window the present position takes [h, w, 1], and its colours [h, w, 3].

    What an earlier position may hide of it is copied from the earlier one of which the same part is seen best: they
    are the same ball. A faded position hides nothing, and nothing is copied from it.
    """
    rows, columns = window
    ys, xs = np.mgrid[rows, columns].astype(np.float32) + np.float32(0.5)
    present = trail.present
    u, v = (xs - present.x) / present.radius, (ys - present.y) / present.radius
    away = np.hypot(u, v)
    share = np.clip((1 - away) * present.radius + 0.5, 0, 1).astype(np.float32)
    solid = [position for position in trail.older if position.opacity > TRAIL.faded]
    # On the very rim a pixel shows the background as well: taken from just inside.
    inward = np.minimum(1, (1 - 1.2 / present.radius) / np.maximum(away, 1e-6))
    u, v = u * inward, v * inward
    best, colours = _freedom(present, solid, u, v), sampled(image, present, u, v).astype(np.float32)
    own = best > POSITION.apart
    for donor in solid:
        margin = _freedom(donor, [present, *(position for position in solid if position is not donor)], u, v)
        better = ~own & (margin > best)
        colours = np.where(better[..., None], sampled(image, donor, u, v), colours)
        best = np.where(better, margin, best)
    return share[..., None], colours


def _freedom(of: Position, others: Sequence[Position], u: Floats32, v: Floats32) -> Floats32:
    """By how many radii places at offsets (radii) from a position lie outside all others; negative inside one."""
    x, y = of.x + of.radius * u, of.y + of.radius * v
    away = [np.hypot(x - other.x, y - other.y) / other.radius for other in others]
    return np.min([np.full_like(x, 9.0), *away], axis=0) - np.float32(1)
