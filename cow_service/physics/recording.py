"""The trajectory of worlds that were run: camera, bodies, paths, contacts, placements."""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from cow_service import records
from cow_service.errors import CannotGround
from cow_service.media.masks import turning
from cow_service.media.types import Floats
from cow_service.narration.warnings import cannot_stay
from cow_service.physics import events
from cow_service.physics.ballistic import FreePath, latest, sampled
from cow_service.physics.bodies import SeenBody
from cow_service.physics.camera import FloorCamera
from cow_service.physics.ensemble import EnsembleResult
from cow_service.physics.placement import Placements
from cow_service.physics.tracks import POINT_DECIMALS, pairs, spread_anchors, swept, with_tracks
from cow_service.physics.world import Worlds
from cow_service.records import BBox, Path, Placement, Point, Trajectory
from cow_service.records.world import BAND_PERCENTILES
from cow_service.requests import TrajectoryRequest

LEANS = 1.0  # degrees: with less, the box of what leans stays that of what stands upright
MOST_LEAN = np.radians(25)
UPRIGHT = (0.0, 0.0, 0.0, 1.0)  # quaternion x, y, z, w
MOVED = 0.5  # px: what moves less in the image stays where it is
PUSHED = 2.0  # px: what something is put into or onto stays where it is if it moves less
SETTLED = 0.25  # px per frame: what moves less is at rest
LEAST_BOUNCE = 0.1  # m/s: a weaker contact with the floor is rolling or sliding
MAX_FUTURES = 8  # worlds of the ensemble whose paths of the mover are recorded
FUTURE_DECIMALS, BAND_DECIMALS = 1, 2  # px: more digits say nothing and are half of a result
STATE_DECIMALS, SCALE_DECIMALS, ROTATION_DECIMALS = 5, 6, 3  # m and m/s; of the size at first; degrees
TURN_DECIMALS, LEAST_TURN = 4, 0.002  # of quaternions: what turns less does not
LEAST_STAYING = 0.5  # of the worlds: what stays in fewer where it is put is refused


def record_trajectory(
    result: EnsembleResult,
    outcome: records.Outcome | None,
    path: FreePath | None,
    given: TrajectoryRequest | None,
    encounters_known: bool,
) -> Trajectory:
    """The record of one world that is shown, and of the ensemble around it.

    `path` is one that no contact changes, and `given` what the request says of it. Raises `CannotGround` for what does
    not stay where it is put.
    """
    shown, world = _Shown(result), result.world
    camera, light = shown.record_camera(), shown.worlds.layout.light
    placed = shown.record_placed()
    paths = shown.record_paths() if path is None else (shown.record_free_path(path, given),)
    trajectory = Trajectory(
        law="contact" if path is None else "ballistic",
        fps=world.fps,
        camera=camera,
        depth=world.depth,
        surfaces=shown.record_surfaces(camera),
        bodies=shown.record_bodies(),
        paths=paths,
        contacts=shown.record_contacts(camera),
        light=(float(light[0, 0]), float(light[0, 1])) if world.fit.source == "shadow" else None,
        moving_until=moving_until(paths, world.fps),
        tracks_given=given is not None and given.tracks is not None,
        anchors=shown.free_points(paths) if given is None or given.anchors is None else given.anchors,
        encounters=events.encounters(
            result.shown.events,
            None if result.ensemble is None else result.ensemble.events,
            shown.bodies,
            world.fps,
            world.num_frames,
            result.query is not None and result.query.asked.partly,
        ),
        encounters_known=encounters_known,
        outcome=outcome,
        placement=shown.record_placement(),
        placed=placed,
        faint=world.faint,
        ensemble=0 if shown.ensemble is None else len(shown.ensemble.runs),
    )
    if trajectory.tracks_given:
        return trajectory
    return with_tracks(trajectory, [body.mask for body in shown.bodies], shown.seen[0].start)


class _Shown:
    """The world that is shown, the first draw, as the camera sees it; and the ensemble around it."""

    def __init__(self, result: EnsembleResult) -> None:
        self.world = result.world
        self.clip = (self.world.num_frames - 1) / self.world.fps  # s
        self.worlds = result.shown.worlds.cut(self.world.num_frames, self.clip)
        self.events = result.shown.events
        self.ensemble = None if result.ensemble is None else result.ensemble.worlds
        self.seen = result.world.bodies  # as the image shows them
        self.paths = [events.seen_paths(self.worlds, index) for index in range(len(self.seen))]
        self.moving = sorted({0} | self.worlds.runs[0].moved)
        ensemble = self.ensemble
        self.spread = {} if ensemble is None else {i: events.seen_paths(ensemble, i).points for i in self.moving}
        # As they are when the motion begins: some are put elsewhere, or pushed away by that.
        self.put = {index for index in range(len(self.seen)) if self._was_put(index)}
        self.bodies = tuple(self._where_put(i) if i in self.put else body for i, body in enumerate(self.seen))

    def _was_put(self, index: int) -> bool:
        worlds, path = self.worlds, self.paths[index]
        away = float(np.linalg.norm(path.points[0, 0] - path.seen[0]))
        is_pushed = away > PUSHED and worlds.shapes[0][index].follows is None
        return worlds.seen is not None and (index in worlds.layout.put or is_pushed)

    def _where_put(self, index: int) -> SeenBody:
        """A body of the image with its box and mask where it is when the motion begins."""
        body, path, degrees = self.seen[index], self.paths[index], rotation_where_put(self.worlds, index)
        start, to, scale = path.seen[0], path.points[0, 0], float(path.scale[0, 0])
        mask, corners = body.mask, np.array(body.bbox).reshape(2, 2)
        if abs(degrees) > LEANS and mask.area:  # then its box is that of its pixels
            pixels = np.argwhere(mask.patch)[:, None, ::-1] + np.array([(0, 0), (0, 1), (1, 0), (1, 1)])
            corners = pixels.reshape(-1, 2) + np.array([mask.columns.start, mask.rows.start], np.float64)
        moved = to + (corners - start) @ turning(scale, degrees).T
        (x0, y0), (x1, y1) = moved.min(axis=0).tolist(), moved.max(axis=0).tolist()
        return replace(body, bbox=(x0, y0, x1, y1), mask=mask.moved(start, to, scale, degrees))

    def record_camera(self) -> records.CameraEstimate:
        """The camera; how far its height varies is seen in an ensemble."""
        fit, cameras = self.world.fit, self.worlds.layout.cameras
        (right, up, _), deviation = cameras.axes[0], np.sqrt(np.diag(fit.covariance))
        focal = float(cameras.focal[0])
        return records.CameraEstimate(
            focal=focal,
            pitch=math.degrees(math.asin(float(np.clip(-up[2], -1, 1)))),
            roll=math.degrees(math.atan2(-float(right[1]), float(right[0]))),
            height=float(cameras.height[0]),
            source=fit.source,
            deviations=records.CameraDeviations(
                focal=focal * float(deviation[1]),
                pitch=math.degrees(float(deviation[0])),
                roll=math.degrees(fit.roll_sigma),
                height=0.0 if self.ensemble is None else float(np.std(self.ensemble.layout.cameras.height)),
            ),
        )

    def record_bodies(self) -> tuple[records.Body, ...]:
        """Where each body is."""
        layout, found = self.worlds.layout, list[records.Body]()
        for index, (seen, shape) in enumerate(zip(self.bodies, self.worlds.shapes[0], strict=True)):
            centre = np.array(shape.position) - np.array([0.0, layout.cameras.height[0], 0.0])
            x, y, z = (float(v) for v in centre @ layout.cameras.axes[0])
            on = layout.supports[index]
            stands = layout.bodies[index].stands and index not in layout.unsupported
            found.append(
                records.Body(
                    object=seen.name,
                    bbox=seen.bbox,
                    shape=shape.shape,
                    size=(2 * shape.half_width, 2 * shape.half_height, 2 * shape.half_depth),
                    position=(x, y, z),
                    support=self.bodies[on].name if on is not None else "floor" if stands else "air",
                    rotation=rotation_where_put(self.worlds, index) if index in self.put else 0.0,
                    footprint=self.record_footprint(index),
                    source=seen.source,
                    confidence=seen.confidence,
                )
            )
        return tuple(found)

    def record_footprint(self, index: int) -> records.Footprint:
        """How a body stands in the likeliest world, and how far that varies."""
        shape, measured = self.worlds.shapes[0][index], self.world.measured
        seen, covariance = None if measured is None else measured.footprints[index], None
        if self.ensemble is not None:
            spots = np.array([shapes[index].position for shapes in self.ensemble.shapes])[:, [0, 2]]
            (a, b), (_, c) = np.cov(spots.T, bias=True).tolist()
            covariance = (a, b, c)
        return records.Footprint(
            centre=(shape.position[0], shape.position[2]),
            half_width=shape.half_width,
            half_depth=shape.half_depth,
            yaw=-math.degrees(shape.yaw),
            height=2 * shape.half_height,
            covariance=covariance,
            seen=None if measured is None else 0.0 if seen is None else seen.share,
        )

    def record_surfaces(self, estimate: records.CameraEstimate) -> tuple[records.Surface, ...]:
        """The floor, and the tops of the bodies that others stand on."""
        camera = FloorCamera.of(estimate, *self.world.size)
        x, y, z = camera.up.tolist()
        found = [records.Surface(body=None, normal=(x, y, z), distance=estimate.height)]
        for index in sorted({on for on in self.worlds.layout.supports if on is not None and on < len(self.bodies)}):
            shape = self.worlds.shapes[0][index]
            cosine, sine = abs(math.cos(shape.yaw)), abs(math.sin(shape.yaw))
            across = cosine * shape.half_width + sine * shape.half_depth
            along = sine * shape.half_width + cosine * shape.half_depth
            right, up, ahead = shape.position
            extent = (right - across, ahead - along, right + across, ahead + along)
            distance = estimate.height - up - shape.half_height
            found.append(records.Surface(body=index, normal=(x, y, z), distance=distance, extent=extent))
        return tuple(found)

    def record_contacts(self, estimate: records.CameraEstimate) -> tuple[records.Contact, ...]:
        """Contacts in the order of their times; without those of bodies that stand where they are."""
        run, shapes, camera = self.worlds.runs[0], self.worlds.shapes[0], FloorCamera.of(estimate, *self.world.size)
        found: list[records.Contact] = []
        for meeting in run.meetings:
            a, on_floor = meeting.a, meeting.b is None
            if a not in run.moved or (on_floor and (meeting.time == 0 or meeting.impulse < LEAST_BOUNCE)):
                continue
            frame = min(round(meeting.time * self.worlds.fps), run.positions.shape[1] - 1)
            where = run.positions[a, frame].copy()
            if meeting.b is None:
                where[1] = 0.0
            else:
                share = shapes[a].half_width / (shapes[a].half_width + shapes[meeting.b].half_width)
                where += share * (run.positions[meeting.b, frame] - where)
            x, y = camera.project(camera.from_floor(where[None]))[0].tolist()
            found.append(records.Contact(a=a, b=meeting.b, time=meeting.time, point=(x, y), impulse=meeting.impulse))
        return tuple(sorted(found, key=lambda contact: contact.time))

    # --- paths

    def record_paths(self) -> tuple[Path, ...]:
        """Paths of the mover, from its grounded point, and of bodies that it set in motion; from their put places."""
        moved = MOVED if self.worlds.placements is None else PUSHED
        ways = {i: self.paths[i].points[0] - self.paths[i].points[0, 0] for i in self.moving}
        return tuple(
            self._path(index)
            for index, way in ways.items()
            # What is set in motion after the clip has a path, too: it tells when.
            if index == 0 or float(np.linalg.norm(way, axis=1).max()) > moved or self.moves_later(index)
        )

    def moves_later(self, index: int) -> bool:
        """Whether a body is set in motion after the clip has ended."""
        return self.clip < float(self.events.moved[0, index]) < math.inf

    def _path(self, index: int) -> Path:
        worlds, path = self.worlds, self.paths[index]
        start, scale = np.array(self.seen[index].start), path.scale[0]
        # The body's centre as placed and where its silhouette is differ a little: what is drawn starts where it is.
        points = path.points[0] + scale[:, None] * (start - path.seen[0])
        if worlds.seen is not None:
            start, scale = points[0], scale / scale[0]
        band, futures = self._spread(index, points - path.points[0])
        points, scale = rounded(points, POINT_DECIMALS), rounded(scale, SCALE_DECIMALS)
        turned = rounded(rotation(worlds, index), ROTATION_DECIMALS)
        visible = np.all((points >= 0) & (points < np.array(self.world.size)), axis=1) & ~path.passed[0]
        moving = rounded(states(worlds, index), STATE_DECIMALS)
        return Path(
            body=index,
            states=tuple(tuple(state) for state in moving.tolist()),
            points=pairs(points),
            visible=tuple(visible.tolist()),
            scale=tuple(scale.tolist()),
            rotation=tuple(turned.tolist()) if np.abs(turned).max() > 0.05 else (),
            band=band,
            futures=futures,
            turns=self._turns(index),
            **self._times(index),
        )

    def _spread(self, index: int, shift: Floats) -> tuple[tuple[BBox, ...], tuple[tuple[Point, ...], ...]]:
        """Per frame the 10th and 90th percentile over the ensemble; and of the mover, paths of some of its worlds.

        They are moved by `shift` [F, 2]. Nothing without an ensemble.
        """
        if self.ensemble is None:
            return (), ()
        worlds = self.spread[index]
        stamps = np.arange(worlds.shape[1]) * (self.ensemble.every / self.ensemble.fps)
        frames = np.arange(len(shift)) / self.worlds.fps

        def at_frames(points: Floats) -> Floats:  # which are recorded at every few frames
            return np.stack([np.interp(frames, stamps, points[:, axis]) for axis in (0, 1)], axis=1) + shift

        low, high = np.percentile(worlds, BAND_PERCENTILES, axis=0)
        edges = rounded(np.hstack([at_frames(low), at_frames(high)]), BAND_DECIMALS)
        band = tuple((x0, y0, x1, y1) for x0, y0, x1, y1 in edges.tolist())
        chosen = np.linspace(0, len(worlds) - 1, min(MAX_FUTURES, len(worlds))).round().astype(int)
        futures = (pairs(rounded(at_frames(worlds[world]), FUTURE_DECIMALS)) for world in chosen)
        return band, tuple(futures) if index == 0 else ()

    def record_free_path(self, path: FreePath, given: TrajectoryRequest | None) -> Path:
        """The mover's path as it was given, or as the ballistic law has it."""
        times, seen, found = np.arange(len(path.points)) / self.world.fps, None, list[Floats]()
        if given is not None and given.tracks is not None:
            found = [sampled(np.array(track), given.fps, times) for track in given.tracks]
        if given is not None and given.tracks is not None and given.tracks_visible is not None:
            frames = latest(given, times)
            seen = tuple(tuple(track[frame] for frame in frames) for track in given.tracks_visible)
        return Path(
            states=tuple(tuple(state) for state in path.states.tolist()),
            points=pairs(path.points),
            visible=tuple(path.visible.tolist()),
            scale=tuple(path.scale.tolist()),
            tracks=tuple(pairs(track) for track in found),
            tracks_visible=seen,
            **self._times(0),
        )

    def _turns(self, index: int) -> tuple[tuple[float, float, float, float], ...]:
        """Quaternions of a body's turn since its first frame; empty for a sphere, or if it has not turned."""
        x, y, z, w = np.moveaxis(self.worlds.runs[0].turns[index], 1, 0)
        a, b, c, d = -x[0], -y[0], -z[0], w[0]  # the first one, inverted: each is followed from there
        since = np.stack([
            w * a + x * d + y * c - z * b, w * b - x * c + y * d + z * a, w * c + x * b - y * a + z * d,
            w * d - x * a - y * b - z * c,
        ], axis=1)  # fmt: skip
        if self.worlds.shapes[0][index].shape == "sphere" or np.abs(since[:, :3]).max() < LEAST_TURN:
            return ()
        return tuple(map(tuple, rounded(since, TURN_DECIMALS).tolist()))

    def _times(self, index: int) -> dict[str, Any]:
        """When a body is set in motion and knocked over, where it is: fields of its path."""
        times = {"moved_at": self.events.moved, "tipped_at": self.events.tipped}
        return {name: time for name, each in times.items() if math.isfinite(time := float(each[0, index]))}

    def free_points(self, paths: Sequence[Path]) -> tuple[Point, ...]:
        """Points off every body and off the way of all that moves."""
        starts = [np.array(path.points[0] if path.body in self.put else self.bodies[path.body].start) for path in paths]
        movable = swept([self.bodies[path.body].mask for path in paths], starts, paths)
        for body in self.bodies:
            body.mask.add_to(movable)
        return spread_anchors(movable)

    # --- what was put somewhere

    def record_placement(self) -> Placement | None:
        """What becomes of the mover, where it is put somewhere and no depth map of another scene says where."""
        worlds, depth = self.worlds, self.world.depth
        if worlds.placements is None or (depth is not None and not depth.is_of_scene):
            return None
        others = None if self.ensemble is None else self.ensemble.placements
        return _placement(self.seen[0].name, worlds.placements, others)

    def record_placed(self) -> tuple[records.PlacedBefore, ...]:
        """The result for each object put somewhere before the motion; empty for the unchanged world."""
        found: list[records.PlacedBefore] = []
        for number, goal in enumerate(self.world.placed_before):
            placements = self.worlds.before[number]
            others = None if self.ensemble is None else self.ensemble.before[number]
            placed = records.PlacedBefore(
                **dict(_placement(self.seen[goal.body].name, placements, others)),
                body=goal.body,
                place=goal.place,
                visible=self._visible_share(goal.body),
                by_heading=goal.by_heading,
            )
            if not placements.stays[0] or (others is not None and np.mean(others.stays) < LEAST_STAYING):
                raise CannotGround(f"{cannot_stay(placed)} Ask of another place, or of another thing.")
            found.append(placed)
        return tuple(found)

    def _visible_share(self, index: int) -> float:
        """Share of a body that is seen at the first frame."""
        path, (width, height) = self.paths[index], self.world.size
        x0, y0, x1, y1 = self.bodies[index].bbox
        inside = max(0.0, min(x1, width) - max(x0, 0)) * max(0.0, min(y1, height) - max(y0, 0))
        hidden = [
            float(events.shares(self.seen[index].mask, path, other.mask, self.paths[i]).covered[0, 0])
            for i, other in enumerate(self.seen)
            if i != index and self.worlds.layout.supports[index] != i
        ]
        within = inside / max((x1 - x0) * (y1 - y0), 1e-9)
        return 0.0 if bool(path.passed[0, 0]) else within * max(0.0, 1 - max(hidden, default=0.0))


def states(worlds: Worlds, body: int) -> Floats:
    """[F, 6] metres and m/s in the frame of the camera, of the first draw."""
    cameras, run = worlds.layout.cameras, worlds.runs[0]
    position = run.positions[body] - np.array([0.0, cameras.height[0], 0.0])
    return np.hstack([position @ cameras.axes[0], run.velocities[body] @ cameras.axes[0]])


def rotation(worlds: Worlds, body: int) -> Floats:
    """Degrees [F] that a body of the first draw has turned in the image, clockwise, since the first frame.

    A sphere turns by its spin about the line of sight. Of anything else the upright axis is followed: what turns about
    it looks the same.
    """
    run, cameras = worlds.runs[0], worlds.layout.cameras
    turns = run.turns[body]
    if worlds.shapes[0][body].shape == "sphere":
        sight = run.positions[body] - np.array([0.0, cameras.height[0], 0.0])
        sight = sight / np.maximum(np.linalg.norm(sight, axis=1), 1e-9)[:, None]
        # Right, up and ahead are a left-handed frame: there a positive turn about the line of sight is anticlockwise.
        before, after = turns[:-1], turns[1:]
        axis = before[:, 3:] * after[:, :3] - after[:, 3:] * before[:, :3] + np.cross(before[:, :3], after[:, :3])
        half = np.einsum("fi,fi->f", before, after)
        axis = axis * np.where(half < 0, -1.0, 1.0)[:, None]
        length = np.linalg.norm(axis, axis=1)
        steps = axis * (2 * np.arctan2(length, np.abs(half)) / np.maximum(length, 1e-12))[:, None]  # rotation vectors
        about = -np.einsum("fi,fi->f", steps, sight[1:])
        return np.concatenate([[0.0], np.degrees(np.cumsum(about))])
    return _leaned(worlds, run.positions[body], turns)


def rotation_where_put(worlds: Worlds, body: int) -> float:
    """Degrees, clockwise, that a body of the first draw is turned at its first frame against how the image shows it.

    A sphere looks the same wherever it is put.
    """
    if worlds.seen is None or worlds.shapes[0][body].shape == "sphere":
        return 0.0
    positions = np.array([worlds.seen[0][body].position, worlds.shapes[0][body].position])
    turn = worlds.shapes[0][body].turn
    return float(_leaned(worlds, positions, np.array([UPRIGHT, UPRIGHT if turn is None else turn]))[1])


def _leaned(worlds: Worlds, positions: Floats, turns: Floats) -> Floats:
    """Degrees [F], clockwise, that an upright axis has leaned since the first of positions [F, 3] and turns [F, 4]."""
    upright = np.tile(np.array([0.0, 1.0, 0.0]), (len(turns), 1))
    cameras, leans = worlds.layout.cameras, list[Floats]()
    step = 1e-3 * float(cameras.height[0])
    for axis in (events.turned(turns, upright[0]), upright):
        points, _ = cameras.repeated(1).project((positions + np.stack([axis, -axis]) * step)[None])
        way = points[0, 0] - points[0, 1]
        leans.append(np.unwrap(np.arctan2(way[:, 0], -way[:, 1])))
    leaning, plumb = leans
    angle = np.unwrap(leaning - plumb)
    # Verticals lean in the image as they come to its side; close to the camera they lean without bounds.
    return np.degrees(angle - angle[0] + np.clip(plumb - plumb[0], -MOST_LEAN, MOST_LEAN))


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


def rounded(values: Floats, decimals: int) -> Floats:
    """Values rounded to a number of decimals, without negative zeros."""
    return np.round(values, decimals) + 0.0
