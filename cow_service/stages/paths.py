"""Records of a world that was run: its camera, its bodies, their paths and contacts."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from cow_service.physics.anchors import points_inside
from cow_service.physics.bodies import SeenBody
from cow_service.physics.camera_fit import CameraFit
from cow_service.physics.events import WorldEvents
from cow_service.physics.floor_camera import FloorCamera
from cow_service.physics.projection import SeenPaths, rotation, rotation_where_put, seen_paths, states
from cow_service.physics.world import Worlds
from cow_service.records import BBox, Body, CameraDeviations, CameraEstimate, Contact, Path, Point
from cow_service.records.world import BAND_PERCENTILES
from cow_service.stages.shown import shown_body, was_put
from cow_service.vision.types import Floats

MOVED = 0.5  # px: what moves less in the image stays where it is
PUSHED = 2.0  # px: what something is put into or onto stays where it is if it moves less
SETTLED = 0.25  # px per frame: what moves less is at rest
LEAST_BOUNCE = 0.1  # m/s: a weaker contact with the floor is rolling or sliding
MAX_FUTURES = 8  # worlds of the ensemble whose paths of the mover are told
FUTURE_DECIMALS, BAND_DECIMALS, POINT_DECIMALS = 1, 2, 3  # px: more digits say nothing and are half of a result
STATE_DECIMALS, SCALE_DECIMALS, ROTATION_DECIMALS = 5, 6, 3  # m and m/s; of the size at first; degrees


def camera_record(fit: CameraFit, worlds: Worlds, around: Worlds | None) -> CameraEstimate:
    """The camera of the first draw; how far its height varies is seen in an ensemble around it."""
    cameras, deviation = worlds.scene.cameras, np.sqrt(np.diag(fit.covariance))
    right, up, _ = cameras.axes[0]
    focal = float(cameras.focal[0])
    return CameraEstimate(
        focal=focal,
        pitch=math.degrees(math.asin(float(np.clip(-up[2], -1, 1)))),
        roll=math.degrees(math.atan2(-float(right[1]), float(right[0]))),
        height=float(cameras.height[0]),
        source=fit.source,
        deviations=CameraDeviations(
            focal=focal * float(deviation[1]),
            pitch=math.degrees(float(deviation[0])),
            roll=math.degrees(fit.roll_sigma),
            height=0.0 if around is None else float(np.std(around.scene.cameras.height)),
        ),
    )


def body_records(bodies: Sequence[SeenBody], worlds: Worlds) -> tuple[Body, ...]:
    """Where the first draw has each body."""
    cameras, records = worlds.scene.cameras, []
    for index, (seen, shape, placed, on) in enumerate(
        zip(bodies, worlds.shapes[0], worlds.scene.bodies, worlds.scene.supports, strict=True)
    ):
        centre = np.array(shape.position) - np.array([0.0, cameras.height[0], 0.0])
        x, y, z = (float(v) for v in centre @ cameras.axes[0])
        stands = placed.stands and index not in worlds.scene.unsupported
        support = bodies[on].name if on is not None else "floor" if stands else "air"
        records.append(
            Body(
                object=seen.name,
                bbox=seen.bbox,
                shape=shape.shape,
                size=(2 * shape.half_width, 2 * shape.half_height, 2 * shape.half_depth),
                position=(x, y, z),
                support=support,
                rotation=rotation_where_put(worlds, index) if was_put(index, worlds) else 0.0,
                source=seen.source,
                confidence=seen.confidence,
            )
        )
    return tuple(records)


def path_records(
    bodies: Sequence[SeenBody], start: Point, worlds: Worlds, size: tuple[int, int], around: Worlds | None
) -> tuple[Path, ...]:
    """Paths of the mover, from its grounded point, and of what it set in motion; `around` are the ensemble's worlds.

    `bodies` are as the image shows them; of what was put elsewhere, the path begins there.
    """
    records: list[Path] = []
    moved = MOVED if worlds.placements is None else PUSHED
    for body in sorted({0} | worlds.runs[0].moved):
        seen = seen_paths(worlds, body)
        if body == 0 or float(np.linalg.norm(seen.points[0] - seen.points[0, :1], axis=1).max()) > moved:
            at = start_of(bodies, body, start)
            records.append(_path(bodies[body], body, np.array(at), worlds, seen, size, around))
    return tuple(records)


def with_times(paths: Sequence[Path], events: WorldEvents) -> tuple[Path, ...]:
    """The paths with the times at which their bodies are set in motion and knocked over in the first draw."""
    found: list[Path] = []
    for path in paths:
        moved, tipped = (float(times[0, path.body]) for times in (events.moved, events.tipped))
        times = {name: time for name, time in (("moved_at", moved), ("tipped_at", tipped)) if math.isfinite(time)}
        found.append(path.model_copy(update=times))
    return tuple(found)


def _path(
    seen: SeenBody,
    body: int,
    start: Floats,
    worlds: Worlds,
    path: SeenPaths,
    size: tuple[int, int],
    around: Worlds | None,
) -> Path:
    # The body's centre as placed and where its silhouette is differ a little: what is drawn starts where it is.
    points, scale, turned = path.points[0], path.scale[0], rotation(worlds, body)
    points = points + scale[:, None] * (start - path.seen[0])
    if worlds.seen is not None:
        seen = shown_body(seen, body, worlds)
        start, scale = points[0], scale / scale[0]
    band, futures = _spread(around, body, points - path.points[0])
    points, scale = np.round(points, POINT_DECIMALS), np.round(scale, SCALE_DECIMALS)
    turned = np.round(turned, ROTATION_DECIMALS)
    visible = np.all((points >= 0) & (points < np.array(size)), axis=1) & ~path.passed[0]
    return Path(
        body=body,
        states=tuple(tuple(state) for state in np.round(states(worlds, body), STATE_DECIMALS).tolist()),
        points=pairs(points),
        visible=tuple(visible.tolist()),
        scale=tuple(scale.tolist()),
        rotation=tuple(turned.tolist()) if np.abs(turned).max() > 0.05 else (),
        band=band,
        futures=futures,
        tracks=tuple(pairs(np.round(track, POINT_DECIMALS)) for track in tracks(seen, start, points, scale, turned)),
    )


def tracks(seen: SeenBody, start: Floats, points: Floats, scale: Floats, turned: Floats) -> list[Floats]:
    """Several points inside a body's mask, each [F, 2] px, moved, scaled and turned as the body is."""
    angle = np.radians(turned)
    cosine, sine = np.cos(angle), np.sin(angle)
    found: list[Floats] = []
    for x, y in points_inside(seen.mask, (float(start[0]), float(start[1]))):
        dx, dy = x - start[0], y - start[1]
        offset = np.stack([cosine * dx - sine * dy, sine * dx + cosine * dy], axis=1)
        found.append(points + scale[:, None] * offset)
    return found


def _spread(around: Worlds | None, body: int, shift: Floats) -> tuple[tuple[BBox, ...], tuple[tuple[Point, ...], ...]]:
    """The band of a body's path, and of the mover its futures; nothing without an ensemble."""
    if around is None:
        return (), ()
    worlds = seen_paths(around, body).points
    band = _band(worlds, around.every, shift)
    return band, _futures(worlds, around.every, shift) if body == 0 else ()


def _band(worlds: Floats, every: int, shift: Floats) -> tuple[BBox, ...]:
    """Per frame the 10th and 90th percentile over the worlds of the ensemble, as `_at_frames` takes them."""
    low, high = np.percentile(worlds, BAND_PERCENTILES, axis=0)
    edges = np.round(np.hstack([_at_frames(low, every, shift), _at_frames(high, every, shift)]), BAND_DECIMALS)
    return tuple((x0, y0, x1, y1) for x0, y0, x1, y1 in edges.tolist())


def _futures(worlds: Floats, every: int, shift: Floats) -> tuple[tuple[Point, ...], ...]:
    """Paths of some worlds, evenly from all of the ensemble, as `_at_frames` takes them."""
    chosen = np.linspace(0, len(worlds) - 1, min(MAX_FUTURES, len(worlds))).round().astype(int)
    return tuple(pairs(_at_frames(worlds[index], every, shift).round(FUTURE_DECIMALS)) for index in chosen)


def _at_frames(points: Floats, every: int, shift: Floats) -> Floats:
    """Points [F, 2] of each frame, of points that are recorded at every few of them, moved by `shift` [F, 2]."""
    frames, stamps = np.arange(len(shift)) / every, np.arange(len(points))
    return np.stack([np.interp(frames, stamps, points[:, axis]) for axis in (0, 1)], axis=1) + shift


def contact_records(worlds: Worlds, camera: FloorCamera) -> tuple[Contact, ...]:
    """Contacts of the first draw, in the order of their times; without those of bodies that stand where they are."""
    run, shapes = worlds.runs[0], worlds.shapes[0]
    records: list[Contact] = []
    for meeting in run.meetings:
        a, on_floor = meeting.a, meeting.b is None
        if a not in run.moved or (on_floor and (meeting.time == 0 or meeting.impulse < LEAST_BOUNCE)):
            continue
        frame = min(round(meeting.time * worlds.fps), run.positions.shape[1] - 1)
        where = run.positions[a, frame].copy()
        if meeting.b is None:
            where[1] = 0.0
        else:
            share = shapes[a].half_width / (shapes[a].half_width + shapes[meeting.b].half_width)
            where += share * (run.positions[meeting.b, frame] - where)
        x, y = camera.project(camera.from_floor(where[None]))[0].tolist()
        records.append(Contact(a=a, b=meeting.b, time=meeting.time, point=(x, y), impulse=meeting.impulse))
    return tuple(sorted(records, key=lambda contact: contact.time))


def moving_until(paths: Sequence[Path], fps: float) -> float:
    """Seconds from which nothing moves any more in the image, or the mover has left it."""
    seen = np.nonzero(np.array(paths[0].visible))[0]
    left = int(seen[-1]) + 1 if len(seen) else 0
    still = 0
    for path in paths:
        points = np.array(path.points)
        steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
        moving = np.nonzero((steps > SETTLED) | (np.abs(np.diff(np.array(path.scale))) > SETTLED / 100))[0]
        still = max(still, int(moving[-1]) + 1 if len(moving) else 0)
    return min(left, still) / fps


def start_of(bodies: Sequence[SeenBody], index: int, grounded: Point) -> Point:
    """Where the path of a body starts: the mover's at its grounded point, others' in the middle of their boxes."""
    body = bodies[index]
    return grounded if index == 0 else ((body.bbox[0] + body.bbox[2]) / 2, (body.bbox[1] + body.bbox[3]) / 2)


def pairs(points: Floats) -> tuple[tuple[float, float], ...]:
    """Rows [F, 2] as tuples."""
    return tuple((x, y) for x, y in points.tolist())
