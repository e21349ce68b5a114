"""The trajectory of worlds that were run: camera, bodies, paths, contacts, placements."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from cow_service.errors import CannotGround
from cow_service.narration import cannot_stay, place_words
from cow_service.physics.ballistic import FreePath, latest, sampled
from cow_service.physics.bodies import SeenBody
from cow_service.physics.camera import CameraFit, FloorCamera
from cow_service.physics.ensemble import EnsembleResult
from cow_service.physics.events import WorldEvents, encounters
from cow_service.physics.placement import Placements
from cow_service.physics.projection import (
    SeenPaths,
    points_inside,
    rotation,
    rotation_where_put,
    seen_paths,
    shares,
    spread_anchors,
    states,
    swept,
)
from cow_service.physics.world import Worlds
from cow_service.records import (
    BBox,
    Body,
    CameraDeviations,
    CameraEstimate,
    Contact,
    Path,
    PlacedBefore,
    Placement,
    Point,
    Trajectory,
)
from cow_service.records.world import BAND_PERCENTILES
from cow_service.stages.reconstruction import Situation, placed_before
from cow_service.vision.masks import CroppedMask, turning
from cow_service.vision.types import Floats

UPRIGHT = 1.0  # degrees: with less, the box of what leans stays that of what stands upright
MOVED = 0.5  # px: what moves less in the image stays where it is
PUSHED = 2.0  # px: what something is put into or onto stays where it is if it moves less
SETTLED = 0.25  # px per frame: what moves less is at rest
LEAST_BOUNCE = 0.1  # m/s: a weaker contact with the floor is rolling or sliding
MAX_FUTURES = 8  # worlds of the ensemble whose paths of the mover are told
FUTURE_DECIMALS, BAND_DECIMALS, POINT_DECIMALS = 1, 2, 3  # px: more digits say nothing and are half of a result
STATE_DECIMALS, SCALE_DECIMALS, ROTATION_DECIMALS = 5, 6, 3  # m and m/s; of the size at first; degrees
LEAST_STAYING = 0.5  # of the worlds: what stays in fewer where it is put is refused


def record_trajectory(situation: Situation, result: EnsembleResult, path: FreePath | None) -> Trajectory:
    """The record of one world that is shown, and of the ensemble around it; `path` is one that no contact changes.

    Raises `CannotGround` for what does not stay where it is put.
    """
    world, shown, request = result.world, result.shown.worlds, situation.request
    grounding, around = situation.grounding, None if result.ensemble is None else result.ensemble.worlds
    camera = camera_record(world.fit, shown, around)
    bodies = tuple(shown_body(body, index, shown) for index, body in enumerate(world.bodies))
    if path is None:
        paths = path_records(world.bodies, grounding.point, shown, situation.size, around)
    else:
        paths = (_free_record(world.bodies[0], situation, path),)
    paths = _with_times(paths, result.shown.events)
    light = shown.layout.light
    return Trajectory(
        law="contact" if path is None else "ballistic",
        fps=request.fps,
        camera=camera,
        bodies=body_records(bodies, shown),
        paths=paths,
        contacts=contact_records(shown, FloorCamera.of(camera, *situation.size)),
        light=(float(light[0, 0]), float(light[0, 1])) if world.fit.source == "shadow" else None,
        moving_until=moving_until(paths, request.fps),
        anchors=_anchors(bodies, situation, paths, shown),
        encounters=encounters(
            result.shown.events,
            None if result.ensemble is None else result.ensemble.events,
            bodies,
            request.fps,
            request.num_frames,
            result.query is not None and result.query.asked.partly,
        ),
        encounters_known=situation.is_separated,
        placement=None
        if shown.placements is None
        else _placement(grounding.object, shown.placements, None if around is None else around.placements),
        placed=_placed_records(situation, result),
        ensemble=request.ensemble,
    )


def _free_record(mover: SeenBody, situation: Situation, path: FreePath) -> Path:
    """The mover's path as it was given, or as the ballistic law has it."""
    given, times = situation.request.trajectory, np.arange(len(path.points)) / situation.request.fps
    if given is not None and given.tracks is not None:
        found = [sampled(np.array(track), given.fps, times) for track in given.tracks]
    else:
        start = np.array(situation.grounding.point)
        found = tracks(mover, start, path.points, path.scale, np.zeros(len(times)))
    seen = None
    if given is not None and given.tracks_visible is not None:
        frames = latest(given, times)
        seen = tuple(tuple(track[frame] for frame in frames) for track in given.tracks_visible)
    return Path(
        states=tuple(tuple(state) for state in path.states.tolist()),
        points=pairs(path.points),
        visible=tuple(path.visible.tolist()),
        scale=tuple(path.scale.tolist()),
        tracks=tuple(pairs(track) for track in found),
        tracks_visible=seen,
    )


def _anchors(
    bodies: Sequence[SeenBody], situation: Situation, paths: Sequence[Path], worlds: Worlds
) -> tuple[tuple[float, float], ...]:
    """Points off every body and off the way of all that moves, unless the request gives them."""
    given = situation.request.trajectory
    if given is not None and given.anchors is not None:
        return given.anchors
    point = situation.grounding.point
    starts = [
        np.array(path.points[0] if was_put(path.body, worlds) else start_of(bodies, path.body, point)) for path in paths
    ]
    movable = swept([bodies[path.body].mask for path in paths], starts, paths)
    for body in bodies:
        body.mask.add_to(movable)
    return spread_anchors(movable)


# --- what was put somewhere


def _placed_records(situation: Situation, result: EnsembleResult) -> tuple[PlacedBefore, ...]:
    """What becomes of each thing that is put somewhere before the motion; nothing of the world as it is."""
    world, shown = result.world, result.shown.worlds
    interventions, found = placed_before(situation.grounding, situation.motion), list[PlacedBefore]()
    for number, goal in enumerate(world.placed_before):
        each, placements = interventions[number], shown.before[number]
        others = None if result.ensemble is None else result.ensemble.worlds.before[number]
        placed = PlacedBefore(
            **dict(_placement(each.object.object, placements, others)),
            body=goal.body,
            place=place_words(each),
            visible=visible_share(world.bodies, goal.body, shown, world.size),
            by_heading=goal.by_heading,
        )
        if not placements.stays[0] or (others is not None and np.mean(others.stays) < LEAST_STAYING):
            raise CannotGround(f"{cannot_stay(placed)} Ask of another place, or of another thing.")
        found.append(placed)
    return tuple(found)


def _placement(name: str, shown: Placements, ensemble: Placements | None) -> Placement:
    counted = Counter(()) if ensemble is None else Counter(ensemble.results)
    clearance, above_rim = (float(values[0]) for values in (shown.clearance, shown.above_rim))
    return Placement(
        object=name,
        result=shown.results[0],
        probabilities={result: count / counted.total() for result, count in sorted(counted.items())},
        fits=None if ensemble is None else float(np.mean(ensemble.fits)),
        clearance=clearance if math.isfinite(clearance) else None,
        above_rim=above_rim if math.isfinite(above_rim) else None,
    )


def shown_body(body: SeenBody, index: int, worlds: Worlds) -> SeenBody:
    """A body of the image with its box and mask where the first draw has it when the motion begins."""
    if not was_put(index, worlds):
        return body
    path, degrees = seen_paths(worlds, index), rotation_where_put(worlds, index)
    start, to, scale = path.seen[0], path.points[0, 0], float(path.scale[0, 0])
    bbox = _moved_box(body, start, to, turning(scale, degrees), leans=abs(degrees) > UPRIGHT)
    return replace(body, bbox=bbox, mask=body.mask.moved(start, to, scale, degrees))


def was_put(index: int, worlds: Worlds) -> bool:
    """Whether a body of the first draw is not where the image shows it: put elsewhere, or pushed away by that."""
    if worlds.seen is None:
        return False
    path = seen_paths(worlds, index)
    away = float(np.linalg.norm(path.points[0, 0] - path.seen[0]))
    led = worlds.shapes[0][index].follows is not None
    return index in worlds.layout.put or (away > PUSHED and not led)


def visible_share(bodies: Sequence[SeenBody], index: int, worlds: Worlds, size: tuple[int, int]) -> float:
    """Share of a body that is seen at the first frame of the first draw, in an image of a size (width, height; px).

    `bodies` are as the image shows them.
    """
    path = seen_paths(worlds, index)
    x0, y0, x1, y1 = shown_body(bodies[index], index, worlds).bbox
    inside = max(0.0, min(x1, size[0]) - max(x0, 0)) * max(0.0, min(y1, size[1]) - max(y0, 0))
    hidden = [
        float(shares(bodies[index].mask, path, other.mask, seen_paths(worlds, i)).covered[0, 0])
        for i, other in enumerate(bodies)
        if i != index and worlds.layout.supports[index] != i
    ]
    within = inside / max((x1 - x0) * (y1 - y0), 1e-9)
    return 0.0 if bool(path.passed[0, 0]) else within * max(0.0, 1 - max(hidden, default=0.0))


def _moved_box(body: SeenBody, start: Floats, to: Floats, turn: Floats, *, leans: bool) -> BBox:
    """The box of a body whose point `start` has gone `to`: of its outline where it leans."""
    points = _outline(body.mask) if leans else np.array(body.bbox).reshape(2, 2)
    moved = to + (points - start) @ turn.T
    (x0, y0), (x1, y1) = moved.min(axis=0).tolist(), moved.max(axis=0).tolist()
    return x0, y0, x1, y1


def _outline(mask: CroppedMask) -> Floats:
    """Corners [N, 2] (px) of the first and last pixel in each row of a mask."""
    rows = np.nonzero(mask.patch.any(axis=1))[0]
    if not len(rows):
        return np.array(mask.bbox).reshape(2, 2)
    first = mask.patch[rows].argmax(axis=1)
    last = mask.patch.shape[1] - mask.patch[rows, ::-1].argmax(axis=1)
    x, y = np.concatenate([first, last]), np.concatenate([rows, rows])
    corners = np.concatenate([np.stack([x, y], axis=1), np.stack([x, y + 1], axis=1)])
    return corners + np.array([mask.columns.start, mask.rows.start], np.float64)


# --- camera, bodies, paths and contacts


def camera_record(fit: CameraFit, worlds: Worlds, ensemble: Worlds | None) -> CameraEstimate:
    """The camera of the first draw; how far its height varies is seen in an ensemble ensemble it."""
    cameras, deviation = worlds.layout.cameras, np.sqrt(np.diag(fit.covariance))
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
            height=0.0 if ensemble is None else float(np.std(ensemble.layout.cameras.height)),
        ),
    )


def body_records(bodies: Sequence[SeenBody], worlds: Worlds) -> tuple[Body, ...]:
    """Where the first draw has each body."""
    cameras, records = worlds.layout.cameras, []
    for index, (seen, shape, placed, on) in enumerate(
        zip(bodies, worlds.shapes[0], worlds.layout.bodies, worlds.layout.supports, strict=True)
    ):
        centre = np.array(shape.position) - np.array([0.0, cameras.height[0], 0.0])
        x, y, z = (float(v) for v in centre @ cameras.axes[0])
        stands = placed.stands and index not in worlds.layout.unsupported
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
    bodies: Sequence[SeenBody], start: Point, worlds: Worlds, size: tuple[int, int], ensemble: Worlds | None
) -> tuple[Path, ...]:
    """Paths of the mover, from its grounded point, and of what it set in motion; `ensemble` are the ensemble's worlds.

    `bodies` are as the image shows them; of what was put elsewhere, the path begins there.
    """
    records: list[Path] = []
    moved = MOVED if worlds.placements is None else PUSHED
    for body in sorted({0} | worlds.runs[0].moved):
        seen = seen_paths(worlds, body)
        if body == 0 or float(np.linalg.norm(seen.points[0] - seen.points[0, :1], axis=1).max()) > moved:
            at = start_of(bodies, body, start)
            records.append(_path(bodies[body], body, np.array(at), worlds, seen, size, ensemble))
    return tuple(records)


def _with_times(paths: Sequence[Path], events: WorldEvents) -> tuple[Path, ...]:
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
    ensemble: Worlds | None,
) -> Path:
    # The body's centre as placed and where its silhouette is differ a little: what is drawn starts where it is.
    points, scale, turned = path.points[0], path.scale[0], rotation(worlds, body)
    points = points + scale[:, None] * (start - path.seen[0])
    if worlds.seen is not None:
        seen = shown_body(seen, body, worlds)
        start, scale = points[0], scale / scale[0]
    band, futures = _spread(ensemble, body, points - path.points[0])
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


def _spread(
    ensemble: Worlds | None, body: int, shift: Floats
) -> tuple[tuple[BBox, ...], tuple[tuple[Point, ...], ...]]:
    """The band of a body's path, and of the mover its futures; nothing without an ensemble."""
    if ensemble is None:
        return (), ()
    worlds = seen_paths(ensemble, body).points
    band = _band(worlds, ensemble.every, shift)
    return band, _futures(worlds, ensemble.every, shift) if body == 0 else ()


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
