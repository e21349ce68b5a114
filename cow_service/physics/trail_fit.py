"""Fits the trail of a thrown ball: its speed relative to gravity, and its heading in depth.

The positions are taken to be equally far apart in time, by an interval that is not known. In radii of the ball and in
intervals, its place now, its velocity and its gravity are fitted to the centres and radii seen, together with pitch and
focal length, which have the priors of the camera, by Gauss-Newton. The first differences of a thrown ball's places are
v dt, the second ones g dt^2: so v^2 / (g R) follows, whatever the interval. Lengths are radii R; x right, y down, z
ahead of the camera.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cow_service.media.types import Floats
from cow_service.physics.bodies import Position
from cow_service.physics.camera import CameraFit, axes_of, gauss_newton

CENTRE_SIGMA = 0.35, 0.008  # px, and of the radius: of a position's centre; the larger counts
RADIUS_SIGMA = 0.35, 0.01  # px, and of the radius
SPEED_PRIOR, SPEED_SIGMA = 1.48, 0.5  # v / sqrt(g R) of a toy that is thrown; of its logarithm
TURN_SIGMA = math.radians(35)  # of a throw's plane out of that of the image, before anything is measured
MAX_COST = 12.0  # squared deviations per degree of freedom: positions that fit worse are not those of a throw
GOOD_COST = 1.5  # a worse fit than this widens the deviations
MAX_ITERATIONS = 30
FREE = 7  # place, velocity and gravity: what the positions must tell; the camera has priors


@dataclass(frozen=True)
class TrailFit:
    """The throw that a trail shows, at its last position."""

    froude: float  # v^2 / (g R)
    speed_deviation: float  # of the natural logarithm of the speed
    direction: tuple[float, float]  # unit vector in the image
    direction_deviation: float  # degrees
    turn: float  # degrees: of its vertical plane out of that of the image, positive away from the camera
    turn_deviation: float  # degrees


def fit_throw(positions: Sequence[Position], camera: CameraFit, size: tuple[int, int]) -> TrailFit | None:
    """The throw through positions, the oldest first, in an image of a size (width, height), px.

    None if there are fewer than three, or no throw leads through them.
    """
    if len(positions) < 3:
        return None
    x, y = size[0] / 2, size[1] / 2
    seen = np.array([(p.x - x, p.y - y, p.radius) for p in positions])
    centre = np.maximum(CENTRE_SIGMA[0], CENTRE_SIGMA[1] * seen[:, 2])
    radius = np.maximum(RADIUS_SIGMA[0], RADIUS_SIGMA[1] * seen[:, 2])
    problem = _Problem(seen, np.stack([centre, centre, radius], axis=1), camera, float(size[0]))
    parameters, slopes = gauss_newton(
        problem.residuals, problem.start(), step=1e-6, most=0.5, least=1e-5, iterations=MAX_ITERATIONS
    )
    rest = problem.residuals(parameters)[: 3 * len(positions)]
    cost = float((rest**2).sum()) / max(1, 3 * len(positions) - FREE)
    if not np.isfinite(cost) or cost > MAX_COST:
        return None
    covariance = np.asarray(np.linalg.inv(slopes.T @ slopes), np.float64) * max(1.0, cost / GOOD_COST)
    # The deviations of the throw, by first order.
    log_speed, angle, turn = now = problem.throw(parameters)
    steps = 1e-5 * np.eye(len(parameters))
    slopes = np.stack([(problem.throw(parameters + step) - now) / 1e-5 for step in steps], axis=1)
    deviation = np.sqrt(np.maximum(np.diag(slopes @ covariance @ slopes.T), 0.0))
    return TrailFit(
        froude=math.exp(2 * log_speed),
        speed_deviation=float(deviation[0]),
        direction=(math.cos(angle), math.sin(angle)),
        direction_deviation=math.degrees(deviation[1]),
        turn=math.degrees(turn),
        turn_deviation=math.degrees(deviation[2]),
    )


def straight_direction(positions: Sequence[Position]) -> tuple[float, float]:
    """Unit vector in the image along the straight line through positions, from the oldest on: of what rolls."""
    places = np.array([position.centre for position in positions])
    along = np.linalg.svd(places - places.mean(axis=0))[2][0]
    if along @ (places[-1] - places[0]) < 0:
        along = -along
    return float(along[0]), float(along[1])


def is_thrown(positions: Sequence[Position], down: tuple[float, float] = (0.0, 1.0)) -> bool:
    """Whether positions bend downwards as those of a throw do, by more than they are inexact."""
    places = np.array([position.centre for position in positions])
    bend = np.diff(places, 2, axis=0) @ np.array(down)
    sigma = max(CENTRE_SIGMA[0], CENTRE_SIGMA[1] * positions[-1].radius)
    return float(bend.mean()) > 3 * math.sqrt(6 / len(bend)) * sigma


@dataclass(frozen=True)
class _Problem:
    """Parameters: log depth now, its place across (2, radii), velocity (3), log gravity, pitch, log focal length."""

    seen: Floats  # [N, 3]: centre from the middle of the image and radius, px
    sigma: Floats  # [N, 3]
    camera: CameraFit
    width: float  # px, of the image

    def start(self) -> Floats:
        """As if the ball kept its distance."""
        across = self.seen[:, :2] / self.seen[:, 2:]
        steps = np.diff(across, axis=0)
        bend = np.diff(across, 2, axis=0).mean(axis=0)
        gravity = max(float(bend[1]), 0.02 * float(np.linalg.norm(steps[-1])))
        pitch, focal = self.camera.mean[:2]
        depth = math.exp(focal) * self.width / float(self.seen[:, 2].mean())
        velocity = steps[-1] + bend / 2
        return np.array([math.log(depth), *across[-1], *velocity, 0.0, math.log(gravity), pitch, focal])

    def places(self, parameters: Floats) -> tuple[Floats, Floats]:
        """Positions [N, 3] of the ball's centre, the present one last, and gravity [3]."""
        log_depth, x, y, *velocity, log_gravity, pitch, _ = parameters
        up = axes_of(np.array([pitch]), np.array([self.camera.roll]))[0][1]
        gravity = -up * math.exp(min(log_gravity, 5.0))
        times = np.arange(1 - len(self.seen), 1)[:, None]
        now = np.array([x, y, math.exp(min(log_depth, 9.0))])
        return now + times * np.array(velocity) + times**2 * gravity / 2, gravity

    def residuals(self, parameters: Floats) -> Floats:
        """Deviations from what was seen [3 N], and from the priors [4]."""
        places = self.places(parameters)[0]
        focal = math.exp(parameters[8]) * self.width
        depth = np.maximum(places[:, 2], 1.0)
        made = np.column_stack([places[:, :2] * (focal / depth)[:, None], focal / depth])
        pitch, log_focal = (parameters[7:] - self.camera.mean[:2]) / np.sqrt(np.diag(self.camera.covariance)[:2])
        log_speed, _, turn = self.throw(parameters)
        speed = (log_speed - math.log(SPEED_PRIOR)) / SPEED_SIGMA
        priors = np.array([speed, turn / TURN_SIGMA, pitch, log_focal])
        return np.concatenate([((made - self.seen) / self.sigma).ravel(), priors])

    def throw(self, parameters: Floats) -> Floats:
        """Log of v / sqrt(g R), angle in the image and turn out of its plane (radians), at the present position."""
        velocity, places = parameters[3:6], self.places(parameters)[0]
        x, y, z = places[-1]
        seen = velocity[:2] - np.array([x, y]) * velocity[2] / z
        right, _, ahead = axes_of(np.array([parameters[7]]), np.array([self.camera.roll]))[0] @ velocity
        turn = math.atan2(ahead, max(right * math.copysign(1.0, seen[0]), 1e-9))
        log_speed = math.log(max(float(velocity @ velocity), 1e-12)) / 2 - parameters[6] / 2
        return np.array([log_speed, math.atan2(seen[1], seen[0]), turn])
