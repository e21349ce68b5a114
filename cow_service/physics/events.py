"""Worlds that were run, as the camera sees them: the path of each body in the image, and what bodies meet on it."""

import itertools
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cow_service.media.masks import CroppedMask
from cow_service.media.types import Floats, Mask
from cow_service.physics.ballistic import NEAREST_FREE, has_passed
from cow_service.physics.bodies import SeenBody
from cow_service.physics.draws import COLUMN
from cow_service.physics.engine import AT_START, TIPPED, RigidShape, WorldRun
from cow_service.physics.layout import Layout
from cow_service.physics.world import Worlds
from cow_service.records import Encounter, EncounterKind

NEVER = math.inf
DISPLACED = 0.1  # of a body's half width: what is displaced less was not set in motion
COVERED = 0.3  # share of a silhouette from which it counts as covered
ANY_PART = 0.06  # share from which a part of it is covered: less is an inexact outline
COVERED_SIGMA = 0.2  # of its logarithm: outlines are inexact, and so is what people call hidden
KINDS: tuple[EncounterKind, ...] = ("touches", "occludes", "occluded-by")
PerKind = dict[EncounterKind, Floats]  # [K, B] each
SAMPLES = 96  # points of a silhouette that are looked up in the other
CHUNK = 2048  # draws and frames at a time, to bound the memory


@dataclass(frozen=True)
class SeenPaths:
    """What one body does in the image, for draws [K] and recorded frames [F]."""

    points: Floats  # [K, F, 2] px
    depth: Floats  # [K, F] m
    scale: Floats  # [K, F]: apparent size, 1 as the image shows it
    passed: Mask  # [K, F]: it is at or behind the camera
    before: Floats | None = None  # [K, 2] px: where the image shows it, if it begins elsewhere

    @property
    def seen(self) -> Floats:
        """Points [K, 2] (px) at which the image shows it."""
        return self.points[:, 0] if self.before is None else self.before


def seen_paths(worlds: Worlds, body: int) -> SeenPaths:
    """A body's path in the image of every draw."""
    positions = np.stack([run.positions[body] for run in worlds.runs])
    points, depth = worlds.layout.cameras.project(positions)
    before, first = None, depth[:, :1]
    if worlds.seen is not None:
        shown = np.array([bodies[body].position for bodies in worlds.seen])
        before, first = worlds.layout.cameras.project(shown[:, None])
        before = before[:, 0]
    first = np.maximum(first, 1e-9)
    return SeenPaths(points, depth, first / np.maximum(depth, NEAREST_FREE * first), has_passed(depth, first), before)


def turned(turns: Floats, vector: Floats) -> Floats:
    """A vector [3] turned by quaternions [F, 4]."""
    axis, w = turns[:, :3], turns[:, 3:]
    across = np.cross(axis, vector)
    return vector + 2 * (w * across + np.cross(axis, across))


@dataclass(frozen=True)
class Shares:
    """Shares [K, F] of another body that the subject covers, and of the subject that the other body covers."""

    covers: Floats
    covered: Floats


def shares(subject: CroppedMask, path: SeenPaths, other: CroppedMask, other_path: SeenPaths) -> Shares:
    """By the silhouettes of the image; what is nearer covers what is farther."""
    covers, covered = np.zeros(path.depth.shape), np.zeros(path.depth.shape)
    boxes: list[tuple[Floats, Floats]] = []  # upper left and lower right corners [K, F, 2]
    for mask, along in ((subject, path), (other, other_path)):
        x0, y0, x1, y1 = mask.bbox
        low, high = (
            along.points + (np.array(corner) - along.seen[:, None]) * along.scale[..., None]
            for corner in ((x0, y0), (x1, y1))
        )
        boxes.append((low, high))
    (low, high), (other_low, other_high) = boxes
    meet = np.all((low < other_high) & (high > other_low), axis=2) & ~path.passed & ~other_path.passed
    nearer = path.depth < other_path.depth
    _fill(covers, meet & nearer, subject, path, other, other_path)
    _fill(covered, meet & ~nearer, other, other_path, subject, path)
    return Shares(covers, covered)


def _fill(
    found: Floats, where: Mask, front: CroppedMask, front_path: SeenPaths, back: CroppedMask, back_path: SeenPaths
) -> None:
    """Writes the share of the body at the back that the one in front covers, in some draws and frames [K, F]."""
    draws, frames = np.nonzero(where)
    if not len(draws):
        return
    rows, columns = np.nonzero(back.patch) if back.area else (np.zeros(1, int), np.zeros(1, int))
    # Every n-th pixel of a raster lines up in columns; a golden-ratio sequence does not.
    order = np.argsort(np.modf(np.arange(len(rows)) * 0.6180339887498949)[0])[:SAMPLES]
    points = np.stack([columns[order] + back.columns.start + 0.5, rows[order] + back.rows.start + 0.5], axis=1)
    height, width = front.patch.shape
    for start in range(0, len(draws), CHUNK):
        k, f = draws[start : start + CHUNK], frames[start : start + CHUNK]

        def ends(path: SeenPaths, k: NDArray[np.int64] = k, f: NDArray[np.int64] = f) -> tuple[Floats, Floats, Floats]:
            return path.seen[k][:, None], path.points[k, f][:, None], path.scale[k, f][:, None, None]

        (first, now, scale), (front_first, front_now, front_scale) = ends(back_path), ends(front_path)
        there = now + (points[None] - first) * scale
        at = front_first + (there - front_now) / front_scale  # where the body in front has these points
        x = np.floor(at[..., 0]).astype(np.int64) - front.columns.start
        y = np.floor(at[..., 1]).astype(np.int64) - front.rows.start
        inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
        covered = front.patch[np.clip(y, 0, height - 1), np.clip(x, 0, width - 1)] & inside
        found[k, f] = covered.mean(axis=1)


# --- events


def set_off(shapes: Sequence[RigidShape], run: WorldRun) -> dict[int, float]:
    """When each body of one world that moves was set in motion (s), in that order: 0 for what starts by itself."""
    moving = {i: 0.0 for i, shape in enumerate(shapes) if shape.starts or shape.follows is not None}
    moving.setdefault(0, 0.0)
    for meeting in sorted(run.meetings, key=lambda meeting: meeting.time):
        if meeting.b is None:
            continue
        for one, other in ((meeting.a, meeting.b), (meeting.b, meeting.a)):
            if one in moving and other not in moving and other in run.moved:
                moving[other] = meeting.time
    for late in sorted(run.moved - moving.keys()):  # what stood on something that was pushed away
        moving[late] = max(moving.values())
    return moving


def _first(happens: Mask, worlds: Worlds) -> Floats:
    """[K, B]: the time (s) of the first recorded frame in which something is so [K, B, F]."""
    clock = np.arange(happens.shape[2]) * (worlds.every / worlds.fps)
    return np.where(happens, clock, NEVER).min(axis=2)


@dataclass(frozen=True)
class Events:
    """Per kind of encounter, draw and body: the first time (s, infinity for never) and the largest share covered."""

    times: PerKind
    shares: PerKind  # 0 for touches
    eligible: Mask  # [B]: neither the subject, nor the mover, nor what the subject stands on, nor taken away
    partly: PerKind  # as times, where any part is covered
    subject: int = 0  # the body that meets the others

    def share(self, kind: EncounterKind, body: int, partly: bool = False) -> float:
        """Of the draws, in which the encounter happens; `partly`: also where any part is hidden."""
        return float(np.isfinite((self.partly if partly else self.times)[kind])[:, body].mean())


class _EventsOf(dict[int, Events]):
    """The events of each body, found when first asked for."""

    def __init__(self, worlds: Worlds, bodies: Sequence[SeenBody], draws: Floats, paths: Sequence[SeenPaths]) -> None:
        super().__init__()
        self.worlds, self.bodies, self.draws, self.paths = worlds, bodies, draws, paths

    def __missing__(self, subject: int) -> Events:
        worlds, path = self.worlds, self.paths[subject]
        on, count = worlds.layout.supports[subject], len(self.bodies)
        beneath = [] if on is None else [on]
        eligible = np.ones(count, bool)
        eligible[[0, subject, *beneath, *worlds.layout.absent]] = False
        ignored = {subject, *beneath, *worlds.layout.loads_of(subject)}
        touches = self.touches(subject, ignored)
        times: PerKind = {"touches": touches}
        partly: PerKind = {"touches": touches}
        most: PerKind = {"touches": np.zeros(touches.shape)}
        for kind in KINDS[1:]:
            times[kind], partly[kind] = (np.full(touches.shape, NEVER) for _ in range(2))
            most[kind] = np.zeros(touches.shape)
        enough = COVERED * np.exp(COVERED_SIGMA * self.draws[:, COLUMN["outline"]])[:, None]
        step = worlds.every / worlds.fps
        clock = np.arange(path.depth.shape[1]) * step
        for other in set(range(count)) - ignored - worlds.layout.absent:
            found = shares(self.bodies[subject].mask, path, self.bodies[other].mask, self.paths[other])
            before = clock[None] <= touches[:, other : other + 1] + step
            for kind, values in zip(KINDS[1:], (found.covers, found.covered), strict=True):
                seen = np.where(before, values, 0.0)
                most[kind][:, other] = seen.max(axis=1)
                times[kind][:, other] = np.where(seen >= enough, clock[None], NEVER).min(axis=1)
                partly[kind][:, other] = np.where(seen >= ANY_PART, clock[None], NEVER).min(axis=1)
        self[subject] = Events(times, most, eligible, partly, subject)
        return self[subject]

    def touches(self, subject: int, ignored: Collection[int]) -> Floats:
        """[K, B] s: when it first touches each other one that is not ignored, once it moves itself."""
        times = np.full((len(self.draws), len(self.bodies)), NEVER)
        for k, (shapes, run) in enumerate(zip(self.worlds.shapes, self.worlds.runs, strict=True)):
            since = set_off(shapes, run).get(subject, NEVER) if subject else 0.0
            for meeting in run.meetings:
                if meeting.b is None or subject not in (meeting.a, meeting.b) or meeting.time < since:
                    continue
                other = meeting.b if meeting.a == subject else meeting.a
                if other not in ignored:
                    times[k, other] = min(times[k, other], meeting.time)
        return times


@dataclass(frozen=True)
class WorldEvents:
    """What happens in worlds: the encounters of every moving body, and the end of each body."""

    of: Mapping[int, Events]  # by subject
    moved: Floats  # [K, B] s: when it is set in motion
    tipped: Floats  # [K, B] s: when it is knocked over; infinite where that was not looked for
    gone: Floats  # [K, B] s: when it leaves the image
    landed: Floats  # [K, B] s: when it first meets the floor
    placed: Floats | None = None  # [K] s: when the mover is where it was to be put; infinite where it does not fit
    order: tuple[int, ...] = (0,)  # of the first draw: what moves, in the order in which it is set in motion
    misread: Mask | None = None  # [K]: the mover began inside another body, or off its support


def find_world_events(worlds: Worlds, bodies: Sequence[SeenBody], draws: Floats, size: tuple[int, int]) -> WorldEvents:
    """The events of every draw [K, P] in an image of a size (width, height; px)."""
    runs, shapes, count = worlds.runs, worlds.shapes, len(bodies)
    started = set_off(shapes[0], runs[0])
    order = tuple(sorted(started, key=lambda body: (body != 0, started[body])))
    paths = [seen_paths(worlds, body) for body in range(count)]
    inside = [np.all((path.points >= 0) & (path.points < np.array(size)), axis=2) & ~path.passed for path in paths]
    # What is displaced from where it was has moved.
    positions = np.stack([run.positions for run in runs])
    away = np.linalg.norm(positions - positions[:, :, :1], axis=3)
    displaced = away > DISPLACED * np.array([[shape.half_width for shape in each] for each in shapes])[..., None]
    # What leans by more than 45 degrees has tipped over; spheres never do.
    leans = np.zeros(away.shape, bool)
    which = [(k, i) for k, run in enumerate(runs) for i in run.moved if shapes[k][i].shape != "sphere"]
    if which:
        turns = np.concatenate([runs[k].turns[i] for k, i in which])
        upright = turned(turns, np.array([0.0, 1.0, 0.0]))[:, 1].reshape(len(which), -1)
        leans[tuple(np.array(which).T)] = upright < TIPPED
    landed = np.full((len(runs), count), NEVER)
    for k, run in enumerate(runs):
        for meeting in run.meetings:
            if meeting.b is None:
                landed[k, meeting.a] = min(landed[k, meeting.a], meeting.time)
    return WorldEvents(
        of=_EventsOf(worlds, bodies, draws, paths),
        moved=_first(displaced, worlds),
        tipped=_first(leans, worlds),
        gone=_first(~np.stack(inside, axis=1), worlds),
        landed=landed,
        placed=None if worlds.placements is None else worlds.placements.times,
        order=order,
        misread=np.array([_is_misread(*world, worlds.layout) for world in zip(shapes, runs, strict=True)]),
    )


def _is_misread(shapes: Sequence[RigidShape], run: WorldRun, layout: Layout) -> bool:
    """Whether the mover of a world began at an impossible place: inside another body, or off its support."""
    mover, on, supports = shapes[0], layout.supports[0], layout.supports
    if mover.is_ghostly or layout.put or not mover.is_active or any(shape.pieces for shape in shapes):
        return False  # drawings show what touches
    if on is not None:
        away = np.array(mover.position) - shapes[on].position
        if math.hypot(away[0], away[2]) > max(shapes[on].half_width, shapes[on].half_depth):
            return True
    met = {each.b for each in run.meetings if each.a == 0 and each.b is not None and each.time < AT_START}
    return any(each != on and supports[each] != 0 for each in met)


def encounters(
    likeliest: WorldEvents,
    ensemble: WorldEvents | None,
    bodies: Sequence[SeenBody],
    fps: float,
    num_frames: int,
    partly: bool = False,
) -> tuple[Encounter, ...]:
    """Those of the likeliest world, in the order of their first frame, with their share of the ensemble's worlds.

    Of two that both move, the one that was set in motion first is the subject. `partly`: also where any part is hidden.
    What happens after the clip has its last frame.
    """
    found: list[Encounter] = []
    for (place, subject), kind in itertools.product(enumerate(likeliest.order), KINDS):
        events = likeliest.of[subject]
        times = (events.partly if partly else events.times)[kind][0]
        found += [
            Encounter(
                object=bodies[body].name,
                bbox=bodies[body].bbox,
                body=body,
                subject=subject,
                kind=kind,
                first_frame=min(math.ceil(times[body] * fps - 1e-6), num_frames - 1),
                time=float(times[body]),
                share=None if kind == "touches" else float(events.shares[kind][0, body]),
                probability=None if ensemble is None else ensemble.of[subject].share(kind, body, partly),
            )
            for body in np.nonzero(np.isfinite(times))[0].tolist()
            if body not in likeliest.order[:place]
        ]
    return tuple(sorted(found, key=lambda encounter: (encounter.first_frame, encounter.time)))
