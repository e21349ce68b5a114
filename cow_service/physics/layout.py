"""Where the bodies of a scene stand or fly as the image shows them, and how they set out, for many draws at once.

Coordinates are metres right, above the floor and ahead, the camera above their origin. Arrays have a row per draw [K].
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np

from cow_service.physics.bodies import HANGS, SeenBody, supports_of
from cow_service.physics.camera import FLAT, HORIZON, CameraFit, axes_of
from cow_service.physics.draws import COLUMN, quantiles
from cow_service.physics.geometry import Footprint, Measurement
from cow_service.records import BBox, Cue, Motion, Shape
from cow_service.vision.types import Floats

MEASURED_SIGMA = 0.03  # of a body's size by its depth: of the logarithm
GOLDEN = math.pi * (3 - math.sqrt(5))  # radians between the mixtures of draws that two bodies take
ORDER = 17  # how far the draws of one body's depth are from those of the next
SIZE_SIGMA = 0.08  # of a body's width: boxes are inexact, and a thing is not as deep as wide
FOOT_SIGMA = 0.02  # of a body's height in the image: where it meets the floor
LEAST_FOOT = 0.002  # of the longer side of the image: no box is more exact
CUT = 0.3  # of the height of a body whose lower end the border of the image cuts off: how far that reaches beyond it
SLIMMEST, TALLEST = 0.2, 12.0  # half heights, in half widths
NEAREST, FARTHEST = 0.05, 40.0  # depths, in those of the first body: what seems to lie elsewhere is put there
BOX_SIDE = 0.82  # of the seen width of a box whose yaw is not known: its side
HUNG, MAYBE_HUNG = 4.0, 0.5  # how much likelier it hangs over that than where the camera's priors have it; in clutter
MAYBE_SIGMA = 0.8  # of the logarithm, further, of the height of what may stand on a thing that was not told apart
HUNG_SIGMA = 0.3  # of the mover's half width: how far ahead of the other it is
# Degrees, one standard deviation of a direction in the image, by where it was read.
TURN_SIGMA: dict[Cue, float] = {
    "arrow": 1.5, "trail": 1.5, "orientation": 6.0, "text": 4.0, "gravity": 0.0, "request": 1.0,
}  # fmt: skip
DEPTH_SIGMA = 0.3  # of the logarithm of the depth of what stands nowhere
TOWARDS_SIGMA = math.radians(2)  # of the heading of what moves towards another thing: it is aimed at its middle
RISE, RISE_SIGMA = math.radians(25), math.radians(15)  # above the horizontal: how things are thrown
AIMED, AIM_SIGMA = 4.0, math.radians(9)  # how much likelier a heading to what stands there is, and how exact
TURNS = np.linspace(-4, 4, 65)  # in deviations: turns out of the plane of the image that are weighed
LOW = 0.08  # sine of the angle between a ray and a horizontal plane below which the plane through the foot is taken
APART = 0.98  # of the distance of two bodies: together they are so wide at most
VEHICLE_WIDTH = 0.5  # of a vehicle's length
DEPTHS = 0.3, 2.0  # of an unknown thing, of its width
LEAST_SHRUNK = 0.5  # of its width: bodies that overlap more are left to the engine


@dataclass(frozen=True)
class Cameras:
    """Cameras [K] of one image, as the draws have them."""

    width: int  # px, of the image
    height_px: int
    focal: Floats  # [K] px
    axes: Floats  # [K, 3, 3]: rows right, up and ahead over the floor
    height: Floats  # [K] m above the floor

    @staticmethod
    def drawn(fit: CameraFit, size: tuple[int, int], draws: Floats) -> tuple[Cameras, Floats]:
        """Cameras 1 m above the floor, and the five fitted parameters [K, 5], for draws [K, P]."""
        names = ("pitch", "focal", "height", "slant_right", "slant_ahead")
        normal = draws[:, [COLUMN[name] for name in names]].copy()
        normal[:, :2] = np.clip(normal[:, :2], -FLAT, FLAT)  # no pitch and no focal length that no picture has
        parameters = fit.mean + normal @ np.linalg.cholesky(fit.covariance).T
        roll = fit.roll + fit.roll_sigma * draws[:, COLUMN["roll"]]
        pitch = np.clip(parameters[:, 0], -1.4, 1.4)
        focal = np.exp(np.clip(parameters[:, 1], -2, 3)) * size[0]
        return Cameras(*size, focal, axes_of(pitch, roll), np.ones(len(draws))), parameters

    def at_height(self, height: Floats) -> Cameras:
        """The same cameras at other heights [K] (m)."""
        return replace(self, height=height)

    def repeated(self, count: int, draw: int = 0) -> Cameras:
        """The camera of one draw so many times."""
        one = slice(draw, draw + 1)
        focal, axes, height = (np.repeat(values[one], count, axis=0) for values in (self.focal, self.axes, self.height))
        return replace(self, focal=focal, axes=axes, height=height)

    def rays(self, point: tuple[float, float] | Floats) -> Floats:
        """Rays [K, 3] through an image point (px), or through one each [K, 2]: right, up and ahead, of depth 1."""
        across = (np.asarray(point, np.float64) - np.array([self.width / 2, self.height_px / 2])) / self.focal[:, None]
        rays = np.concatenate([across, np.ones((len(self.focal), 1))], axis=1)
        return np.einsum("kij,kj->ki", self.axes, rays)

    def project(self, coordinates: Floats) -> tuple[Floats, Floats]:
        """Image points [K, ..., 2] (px) and depths [K, ...] (m) of coordinates [K, ..., 3]."""
        steps = (slice(None),) + (None,) * (coordinates.ndim - 2)
        from_camera = coordinates - np.array([0.0, 1.0, 0.0]) * self.height[(*steps, None)]
        position = np.einsum("k...i,kij->k...j", from_camera, self.axes)
        z = np.maximum(position[..., 2], 1e-3 * self.height[steps])
        points = position[..., :2] * (self.focal[steps] / z)[..., None]
        return points + np.array([self.width / 2, self.height_px / 2]), position[..., 2]

    def coordinates(self, positions: Floats) -> Floats:
        """Coordinates [K, 3] above the floor, of positions seen from the camera: right, up and ahead."""
        return positions + np.stack([np.zeros(len(self.height)), self.height, np.zeros(len(self.height))], axis=1)

    def depth(self, coordinates: Floats) -> Floats:
        """Depths [K] (m) of coordinates [K, 3]."""
        return self.project(coordinates)[1]


@dataclass(frozen=True)
class LiftedBody:
    """A body where the draws have it."""

    shape: Shape
    centre: Floats  # [K, 3]
    half_width: Floats  # [K]
    half_height: Floats  # [K]
    stands: bool  # on the floor or on another body; else it is in the air
    depth_share: Floats | float = 1.0  # [K]: how deep it is along the line of sight, of its width
    yaw: float | None = None  # radians from right to ahead, of its width, where that was measured

    def repeated(self, count: int) -> LiftedBody:
        """As the first draw has it, so many times."""
        centre, *halves = (np.repeat(v[:1], count, axis=0) for v in (self.centre, self.half_width, self.half_height))
        return replace(self, centre=centre, half_width=halves[0], half_height=halves[1])

    @property
    def top(self) -> Floats:
        """Height [K] of its upper end above the floor."""
        return self.centre[:, 1] + self.half_height


def above(
    cameras: Cameras,
    bbox: BBox,
    shape: Shape,
    draws: Floats,
    plane: Floats,
    depth_share: Floats | float = 1.0,
    taper: float = 1.0,
) -> LiftedBody | None:
    """A body that stands on a horizontal plane at a height [K] (m); None where its foot lies at or above the horizon.

    The foot is the middle of the box's lower edge; the body's middle lies half its depth there further away, which is
    `taper` of that at its top. A sphere's depth follows from its radius and its middle.
    """
    height = cameras.height - plane
    stretch = np.exp(SIZE_SIGMA * draws[:, COLUMN["size"]])
    x0, y0, x1, y1 = bbox
    if shape == "sphere":
        rays, radius = cameras.rays(((x0 + x1) / 2, (y0 + y1) / 2)), (x1 - x0 + y1 - y0) / 4
        sink = radius / cameras.focal - rays[:, 1]
        if not (sink[0] > HORIZON and height[0] > 0):
            return None
        z = height / np.maximum(sink, HORIZON)
        half = z * radius / cameras.focal
        return LiftedBody(shape, cameras.coordinates(rays * z[:, None]), half, half, True)
    off = draws[:, COLUMN["foot"]]
    if y1 > cameras.height_px - 1:
        foot = y1 + CUT * (y1 - y0) * np.abs(off)
    else:
        foot = y1 + max(FOOT_SIGMA * (y1 - y0), LEAST_FOOT * max(cameras.width, cameras.height_px)) * off
    rays = cameras.rays(np.stack([np.full(len(foot), (x0 + x1) / 2), foot], axis=1))
    if not (-rays[0, 1] > HORIZON and height[0] > 0):  # the likeliest ray meets the plane at no sane distance
        return None
    near = rays[:, [0, 2]] * (height / np.maximum(-rays[:, 1], HORIZON))[:, None]
    distance = np.linalg.norm(near, axis=1)
    way = near / distance[:, None]
    half, tall, centre = np.zeros(len(foot)), np.zeros(len(foot)), np.zeros((len(foot), 3))
    wide = (x1 - x0) / (2 * cameras.focal)
    upper = cameras.rays(((x0 + x1) / 2, y0))
    slope = upper[:, 1] / np.maximum(np.linalg.norm(upper[:, [0, 2]], axis=1), 1e-6)
    for _ in range(5):
        middle = near + way * (half * depth_share * taper)[:, None]
        # What is seen from above is widest at its top, which is nearer; a cone is at its foot.
        widest = plane + (0.0 if shape == "cone" else 2 * tall)
        depth = cameras.depth(np.stack([middle[:, 0], widest, middle[:, 1]], axis=1))
        half = wide / np.sqrt(1 + wide**2) * np.maximum(depth, 1e-3 * height)
        deep = half * depth_share
        # The upper edge of the box is the far rim of a top that is seen from above, else the near one.
        rim = np.zeros(len(deep)) if shape == "cone" else np.where(slope < 0, deep, -deep)
        top = cameras.height + slope * np.maximum(distance + deep * taper + rim, 1e-3)
        tall = np.clip((top - plane) / 2, SLIMMEST * deep, TALLEST * deep)
        centre = np.stack([middle[:, 0], plane + tall, middle[:, 1]], axis=1)
    return LiftedBody(shape, centre, half * stretch, tall, True, depth_share)


def in_the_air(cameras: Cameras, bbox: BBox, shape: Shape, depth: Floats) -> LiftedBody:
    """A body at depths [K] (m), as wide and high as its box."""
    x0, y0, x1, y1 = bbox
    rays = cameras.rays(((x0 + x1) / 2, (y0 + y1) / 2))
    half, tall = ((x1 - x0) * depth / cameras.focal / 2, (y1 - y0) * depth / cameras.focal / 2)
    if shape == "sphere":
        half = tall = (half + tall) / 2
    return LiftedBody(shape, cameras.coordinates(rays * depth[:, None]), half, tall, False)


@dataclass(frozen=True)
class Layout:
    """The bodies of a scene, the mover first, for draws [K]."""

    cameras: Cameras
    bodies: tuple[LiftedBody, ...]
    supports: tuple[int | None, ...]  # index of the body that each stands on; None: the floor, or nothing
    velocity: Floats  # [K, 3] m/s, of the mover
    further: tuple[Floats, ...]  # [K, 3] m/s, of the mover in each further leg
    others: dict[int, Floats]  # [K, 3] m/s, of other bodies that are set moving
    light: Floats  # [K, 2]: metres that a shadow lies to the right and ahead, per metre of height
    unsupported: frozenset[int] = frozenset()  # bodies whose support was taken away, or put elsewhere
    put: frozenset[int] = frozenset()  # bodies that were put where they are

    def first(self, count: int) -> Layout:
        """Without the bodies behind the first ones, which are taken away: what stood on them has no support."""
        loose: set[int] = set()
        for _ in range(count):  # what stands on something that falls falls, too
            loose |= {i for i in range(count) if (on := self.supports[i]) is not None and (on >= count or on in loose)}
        supports = tuple(None if on is None or on >= count else on for on in self.supports[:count])
        return replace(self, bodies=self.bodies[:count], supports=supports, unsupported=frozenset(loose))

    def loads_of(self, body: int) -> frozenset[int]:
        """What was put into or onto a body: that it is there is no encounter of the body that carries it."""
        return frozenset(i for i in self.put if self.supports[i] == body)

    def rearranged(self, on: Mapping[int, int | None]) -> Layout:
        """With some bodies put elsewhere, where they stand `on` others or the floor: what stood on them falls."""
        loose: set[int] = set()
        for _ in self.supports:
            loose |= {i for i, at in enumerate(self.supports) if i not in on and (at in on or at in loose)}
        supports = tuple(None if i in loose else on.get(i, at) for i, at in enumerate(self.supports))
        bodies = tuple(replace(body, stands=True) if i in on else body for i, body in enumerate(self.bodies))
        unsupported = (self.unsupported - on.keys()) | loose
        return replace(self, bodies=bodies, supports=supports, unsupported=unsupported, put=frozenset(on))


def lay_out(
    bodies: Sequence[SeenBody],
    motion: Motion,
    fit: CameraFit,
    size: tuple[int, int],
    draws: Floats,
    others: Mapping[int, Motion] = MappingProxyType({}),
    level: float | None = None,
    measured: Measurement | None = None,
) -> Layout:
    """Places bodies seen in an image of a size (width, height), px.

    `others` are motions of other bodies, by their places among `bodies`; `level` is the height in the image (px) of
    the floor of a drawing that is seen from the side; `measured` is what a depth map says.
    """
    cameras, parameters = Cameras.drawn(fit, size, draws)
    supports = supports_of(bodies, level) if measured is None else list(measured.supports)
    if measured is not None:
        cameras, placed = _Measured(bodies, supports, motion, draws, measured).placed(cameras, parameters, fit)
    elif level is None:
        cameras, placed = _Picture(bodies, supports, motion, draws).placed(cameras, parameters, fit)
    else:
        depth = cameras.focal * motion.metres_per_pixel.value
        cameras = cameras.at_height((level - size[1] / 2) * depth / cameras.focal)
        stands = [on != HANGS for on in supports]  # what is released may lie on a slope
        stands[0] = stands[0] if motion.kind == "fall" else not bodies[0].flies(motion)
        placed = [in_the_air(cameras, body.bbox, body.shape, depth) for body in bodies]
        placed = [replace(body, stands=each) for body, each in zip(placed, stands, strict=True)]
    if motion.rises:
        placed[0] = replace(placed[0], stands=False)
    places = {body.bbox: each for body, each in zip(bodies, placed, strict=True)}

    def velocity_of(body: int, motion: Motion, speed_name: str = "speed") -> Floats:
        goal = None if motion.towards is None else places.get(motion.towards.bbox)
        others = [each for index, each in enumerate(placed) if index != body]
        if level is not None:
            return _in_side_view(placed[body], motion, draws, goal, speed_name)
        return _velocity(placed[body], motion, cameras, draws, goal, others, speed_name)

    velocity = velocity_of(0, motion)
    turned = {"towards": None, "rises": motion.rises}
    legs = [motion.model_copy(update=turned | {"direction": s.direction, "depth": s.depth}) for s in motion.steps]
    further = tuple(velocity_of(0, leg) for leg in legs)
    also = {i: velocity_of(i, each, "other_speed") for i, each in others.items()}
    placed = placed if level is not None else _apart(placed)
    resting = tuple(on if each.stands and on != HANGS else None for on, each in zip(supports, placed, strict=True))
    return Layout(cameras, tuple(placed), resting, velocity, further, also, parameters[:, 3:5])


@dataclass(frozen=True)
class _Picture:
    """What the picture shows, as draws [K, P] have it."""

    bodies: Sequence[SeenBody]
    supports: list[int | None]
    motion: Motion
    draws: Floats

    def placed(self, cameras: Cameras, parameters: Floats, fit: CameraFit) -> tuple[Cameras, list[LiftedBody]]:
        """The cameras at the heights that the mover tells, and the bodies."""
        bodies, motion, draws = self.bodies, self.motion, self.draws
        mover, depth = bodies[0], cameras.focal * motion.metres_per_pixel.value
        if not mover.flies(motion):
            share = self.depth_share(cameras)
            unit = self.standing(0, cameras, draws, share)
            if unit is not None:
                cameras = cameras.at_height(depth / np.maximum(cameras.depth(unit.centre), 1e-6))
                return cameras, [self.body_at(i, cameras, depth, share if i == 0 else None) for i in range(len(bodies))]
        ball = in_the_air(cameras.at_height(np.zeros(len(draws))), mover.bbox, mover.shape, depth)
        height = np.exp(parameters[:, 2]) * (ball.half_width + ball.half_height) / 2 - ball.centre[:, 1]
        if not mover.stands_out and (mover.prior is None or mover.prior.height is None):
            height *= np.exp(MAYBE_SIGMA * draws[:, COLUMN["let_go_ahead"]])
        under = self.below() if motion.kind == "fall" else None
        if under is not None:
            below = self.standing(under, cameras.at_height(np.ones(len(draws))), draws)
            if below is not None:
                # In most draws it hangs over what is seen below it, at a distance of so many heights of the camera.
                # What a shadow tells of the height weighs against it.
                aside = HUNG_SIGMA * ball.half_width * draws[:, COLUMN["turn"]]
                aligned = (ball.centre[:, 2] + aside) / below.centre[:, 2]
                in_radii = 2 * (aligned[0] + ball.centre[0, 1]) / (ball.half_width[0] + ball.half_height[0])
                if in_radii > 0:
                    off = (np.log(in_radii) - fit.mean[2]) / np.sqrt(fit.covariance[2, 2])
                    weight = (HUNG if mover.stands_out else MAYBE_HUNG) * np.exp(-0.5 * off**2)
                    is_over = quantiles(draws[:, COLUMN["depth"]]) < weight / (1 + weight)
                    height = np.where(is_over, aligned, height)
        cameras = cameras.at_height(np.maximum(height, 0.02 * depth))
        flying = in_the_air(cameras, mover.bbox, mover.shape, depth)
        return cameras, [flying, *(self.body_at(i, cameras, depth) for i in range(1, len(bodies)))]

    def below(self) -> int | None:
        """The body that is seen below the mover: of several, the one that lies beneath its middle the most."""
        x = (self.bodies[0].bbox[0] + self.bodies[0].bbox[2]) / 2

        def off(index: int) -> float:
            x0, _, x1, _ = self.bodies[index].bbox
            return abs(x0 + x1 - 2 * x) / (x1 - x0)

        seen = [i for i, b in enumerate(self.bodies) if i and self.bodies[0].is_above(b) and not b.is_flying]
        return min(seen, key=off, default=None)

    def body_at(self, index: int, cameras: Cameras, depth: Floats, depth_share: Floats | None = None) -> LiftedBody:
        """A body where it stands, or else in the air, about at the depth [K] (m) of the mover."""
        body = self.bodies[index]
        said = None if body.prior is None else body.prior.height
        if body.is_flying and said is not None:
            height = np.clip(said.value + said.deviation * self.draws[:, COLUMN["foot"]], 0, 0.95 * cameras.height)
            hanging = above(cameras, body.core, body.shape, self.draws, height)
            if hanging is not None:
                return replace(hanging, stands=False)
        standing = None if body.is_flying else self.standing(index, cameras, self.draws, depth_share)
        if standing is not None and NEAREST < cameras.depth(standing.centre)[0] / depth[0] < FARTHEST:
            return standing
        guess = depth if index == 0 else depth * np.exp(DEPTH_SIGMA * self.draws[:, COLUMN["foot"]])
        return in_the_air(cameras, body.bbox, body.shape, guess)

    def standing(
        self, index: int, cameras: Cameras, draws: Floats, depth_share: Floats | None = None
    ) -> LiftedBody | None:
        """A body on the floor, or on the body that carries it, which stands on the floor."""
        body, on = self.bodies[index], self.supports[index]
        if depth_share is None:
            depth_share = self.depth_of(body, draws)
        # Errors of two feet have nothing to do with one another.
        draws, feet = draws.copy(), draws[:, [COLUMN["foot"], COLUMN["let_go_right"]]]
        draws[:, COLUMN["foot"]] = feet @ [math.cos(GOLDEN * index), math.sin(GOLDEN * index)]
        plane = np.zeros(len(draws))
        if on is not None:
            support = above(cameras, self.bodies[on].core, self.bodies[on].shape, draws, plane)
            if support is not None:
                plane = np.minimum(support.top, 0.95 * cameras.height)
        return above(cameras, body.core, body.shape, draws, plane, depth_share, body.taper)

    def depth_of(self, body: SeenBody, draws: Floats) -> Floats:
        """How deep a body is along the line of sight [K], of its width: nothing tells that of an unknown thing."""
        if body.is_form_known or any(self.bodies[on] is body for on in self.supports if on is not None):
            return np.ones(len(draws))  # what carries something is deep enough for it
        shallowest, deepest = np.log(DEPTHS)
        return np.exp(shallowest + (deepest - shallowest) * quantiles(draws[:, COLUMN["deep"]]))

    def depth_share(self, cameras: Cameras) -> Floats:
        """How deep the mover is along the line of sight, of its width: a vehicle is longer along its heading."""
        motion, first = self.motion, cameras.repeated(1)
        unit = self.standing(0, first, self.draws[:1]) if self.bodies[0].elongated else None
        if unit is None or motion.direction is None or motion.kind != "linear":
            return self.depth_of(self.bodies[0], self.draws)
        way = _along_floor(unit, motion, first, np.array([motion.direction]))[0]
        sight = unit.centre[0, [0, 2]] / np.linalg.norm(unit.centre[0, [0, 2]])
        along = abs(float(way[[0, 2]] @ sight))
        across = math.sqrt(max(0.0, 1 - along**2))
        share = (along + VEHICLE_WIDTH * across) / (across + VEHICLE_WIDTH * along)
        return np.full(len(self.draws), share)


@dataclass(frozen=True)
class _Measured(_Picture):
    """What a depth map shows; what it does not show is where the picture has it, by the camera over the same floor."""

    measured: Measurement

    def placed(self, cameras: Cameras, parameters: Floats, fit: CameraFit) -> tuple[Cameras, list[LiftedBody]]:
        """The cameras above the measured floor, and the bodies."""
        floor, footprints = self.measured.floor, self.measured.footprints
        depth, found = cameras.focal * self.motion.metres_per_pixel.value, dict[int, LiftedBody]()
        if footprints[0] is None:
            cameras, (found[0], *_) = super().placed(cameras, parameters, fit)
        elif (metres := self.measured.scale) is not None:
            cameras = cameras.at_height(np.full(len(depth), floor.height * metres))
        else:  # it has no unit: what is said or guessed of the mover's size fixes the scale
            cameras = cameras.at_height(floor.height * depth / float(floor.position(footprints[0].centre)[2]))
        scale = cameras.height / floor.height

        def place(index: int) -> LiftedBody:
            """A body, after what it stands on."""
            footprint, on = footprints[index], self.supports[index]
            if index not in found and footprint is None:
                found[index] = self.body_at(index, cameras, depth)
            elif index not in found and footprint is not None:
                flies = self.bodies[index].is_flying if index else self.bodies[0].flies(self.motion)
                plane = np.zeros(len(scale)) if on is None else place(on).top
                found[index] = self.at_footprint(index, footprint, cameras, scale, None if flies else plane)
            return found[index]

        return cameras, [place(index) for index in range(len(self.bodies))]

    def at_footprint(
        self, index: int, footprint: Footprint, cameras: Cameras, scale: Floats, plane: Floats | None
    ) -> LiftedBody:
        """A body where its footprint is, scaled [K], on a plane at a height [K] (m) or, for None, in the air."""
        x, y, z = self.measured.floor.position(footprint.centre).tolist()
        point = np.array([x, y]) / z * self.measured.focal + np.array([cameras.width, cameras.height_px]) / 2
        # Errors of two bodies' depths have nothing to do with one another: each takes the draws in another order.
        error = np.exp(footprint.deviation * np.roll(self.draws[:, COLUMN["foot"]], ORDER * index))
        size = scale * error * np.exp(MEASURED_SIGMA * self.draws[:, COLUMN["size"]])
        centre = cameras.coordinates(cameras.rays(point) * (z * scale * error)[:, None])
        half, tall, deep = footprint.half_width * size, footprint.half_height * size, footprint.half_depth * size
        if not footprint.depth_seen:  # what lies behind is not seen: the body reaches further back than its pixels
            shallowest, deepest = np.log(DEPTHS)
            drawn = half * np.exp(shallowest + (deepest - shallowest) * quantiles(self.draws[:, COLUMN["deep"]]))
            hidden = np.maximum(drawn - deep, 0.0)
            deep = deep + hidden
            back = np.array([-math.sin(footprint.yaw), 0.0, math.cos(footprint.yaw)])
            centre = centre + hidden[:, None] * back
        if plane is not None:
            centre[:, 1] = plane + tall
        yaw = None if footprint.shape == "sphere" else footprint.yaw
        share = deep / np.maximum(half, 1e-9)
        return LiftedBody(footprint.shape, centre, half, tall, plane is not None, share, yaw)


def _velocity(
    mover: LiftedBody,
    motion: Motion,
    cameras: Cameras,
    draws: Floats,
    goal: LiftedBody | None,
    others: Sequence[LiftedBody],
    speed_name: str,
) -> Floats:
    """[K, 3] m/s right, up and ahead; `goal` is what it moves towards, `others` are all other bodies."""
    if motion.direction is None or motion.speed == 0:
        return np.zeros((len(draws), 3))
    speed = motion.speed * motion.metres_per_pixel.value * speed_factors(motion, draws, speed_name)
    turn = np.radians(TURN_SIGMA[motion.cue]) * draws[:, COLUMN["turn"]]
    cosine, sine = np.cos(turn), np.sin(turn)
    dx, dy = motion.direction
    direction = np.stack([cosine * dx - sine * dy, sine * dx + cosine * dy], axis=1)
    if goal is not None and (mover.stands or motion.kind == "projectile"):
        way = _towards(mover, goal, motion, draws)
    elif motion.kind == "projectile":
        way = _thrown(mover, motion, cameras, draws, direction, others)
    elif motion.rises:
        way = _in_plane(mover, cameras, direction, np.full(len(draws), math.asin(motion.depth)))
    elif mover.stands:
        way = _along_floor(mover, motion, cameras, direction)
    else:
        way = _out_of_image(motion, cameras, direction)
    return way * speed[:, None]


def _in_side_view(mover: LiftedBody, motion: Motion, draws: Floats, goal: LiftedBody | None, speed_name: str) -> Floats:
    """[K, 3] m/s of what moves in a drawing that has no depth: along the floor where it stands."""
    dx, dy = motion.direction or (0.0, 0.0)
    direction = np.array([dx, -dy, 0.0]) if goal is None else goal.centre[0] - mover.centre[0]
    if mover.stands and motion.kind == "linear" and not motion.rises:
        direction = direction * np.array([1.0, 0.0, 0.0])
    speed = motion.speed * motion.metres_per_pixel.value * speed_factors(motion, draws, speed_name)
    return direction / max(float(np.linalg.norm(direction)), 1e-9) * speed[:, None]


def speed_factors(motion: Motion, draws: Floats, name: str = "speed") -> Floats:
    """[K]: speeds of draws, in likeliest ones."""
    return np.exp(motion.speed_deviation * draws[:, COLUMN[name]])


def _towards(mover: LiftedBody, goal: LiftedBody, motion: Motion, draws: Floats) -> Floats:
    """Unit vectors [K, 3] over the floor towards another body; of a throw, upwards at the angles of throws."""
    away = goal.centre - mover.centre
    heading = np.arctan2(away[:, 2], away[:, 0]) + TOWARDS_SIGMA * draws[:, COLUMN["turn"]]
    rise = np.zeros(len(draws))
    if motion.kind == "projectile":
        rise = RISE + RISE_SIGMA * draws[:, COLUMN["depth"]]
    return np.stack([np.cos(rise) * np.cos(heading), np.sin(rise), np.cos(rise) * np.sin(heading)], axis=1)


def _out_of_image(motion: Motion, cameras: Cameras, direction: Floats) -> Floats:
    """Unit vectors [K, 3] of directions [K, 2] in the image, turned out of its plane as the motion says."""
    depth = np.full((len(direction), 1), motion.depth)
    way = np.concatenate([direction * math.sqrt(1 - motion.depth**2), depth], axis=1)
    return np.einsum("kij,kj->ki", cameras.axes, way)


def _along_floor(mover: LiftedBody, motion: Motion, cameras: Cameras, direction: Floats) -> Floats:
    """Unit vectors [K, 3] over the floor whose image at the mover has the directions [K, 2]."""
    if motion.depth and motion.source == "request":  # readers' depth is that of the direction, which the floor tells
        way = _out_of_image(motion, cameras, direction)
    else:
        points, depth = cameras.project(mover.centre)
        step = cameras.focal / depth * mover.half_width * 0.05
        ends = [cameras.rays(points + side * step[:, None] * direction) for side in (-1.0, 1.0)]
        sink = -ends[0][:, 1] / np.linalg.norm(ends[0], axis=1)
        below = np.where(sink < LOW, mover.half_height, 0.0)
        drop = cameras.height - mover.centre[:, 1] + below
        hit = [ray * (drop / np.maximum(-ray[:, 1], 1e-3))[:, None] for ray in ends]
        way = hit[1] - hit[0]
    way[:, 1] = 0.0
    return way / np.maximum(np.linalg.norm(way, axis=1), 1e-12)[:, None]


def _thrown(
    mover: LiftedBody,
    motion: Motion,
    cameras: Cameras,
    draws: Floats,
    direction: Floats,
    others: Sequence[LiftedBody],
) -> Floats:
    """Unit vectors [K, 3] seen in directions [K, 2]: in a vertical plane, turned from that of the image by the depth.

    A drawn direction leaves the depth open. Small turns are likelier; so are throws that rise at the angle at which
    things are thrown, and throws that lead about to one of the things that stand there.
    """
    mean, sigma = math.asin(motion.depth), math.radians(motion.depth_deviation)
    turn = np.full(len(draws), mean)
    if sigma > 0:
        turns, count = mean + sigma * TURNS, len(TURNS)
        one, facing = mover.repeated(count), np.repeat(direction[:1], count, axis=0)
        weight = np.exp(-0.5 * TURNS**2)
        if motion.cue != "trail":  # along a trail it may have come to any point of its path
            rise = np.arcsin(np.clip(_in_plane(one, cameras.repeated(count), facing, turns)[:, 1], -1, 1))
            weight = weight * np.exp(-0.5 * ((rise - RISE) / RISE_SIGMA) ** 2)
        aimed = np.ones(count)
        for other in others:
            away = other.centre[0] - mover.centre[0]
            bearing = math.atan2(float(away[2]), float(np.sign(direction[0, 0]) * away[0]))
            aimed += AIMED * np.exp(-0.5 * ((turns - bearing) / AIM_SIGMA) ** 2)
        weight = weight * aimed
        below = (np.cumsum(weight) - weight / 2) / weight.sum()
        turn = np.interp(quantiles(draws[:, COLUMN["depth"]]), below, turns)
    return _in_plane(mover, cameras, direction, np.clip(turn, -1.5, 1.5))


def _in_plane(mover: LiftedBody, cameras: Cameras, direction: Floats, turn: Floats) -> Floats:
    """Unit vectors [K, 3], seen in directions [K, 2], in vertical planes turned from that of the image (radians)."""
    sense = np.where(direction[:, 0] < 0, -1.0, 1.0)
    level = np.stack([sense * np.cos(turn), np.zeros(len(turn)), np.sin(turn)], axis=1)
    up = np.tile(np.array([0.0, 1.0, 0.0]), (len(turn), 1))
    step = 1e-4 * mover.half_width[:, None]
    scale = (cameras.depth(mover.centre) / cameras.focal)[:, None]
    seen: list[Floats] = []  # image velocities [K, 2], to a common factor, of the mover going either way
    for way in (level, up):
        before, after = (cameras.project(mover.centre + side * step * way)[0] for side in (-1.0, 1.0))
        seen.append((after - before) / (2 * step) * scale)
    shares = np.linalg.solve(np.stack(seen, axis=2) + 1e-9 * np.eye(2), direction[:, :, None])[:, :, 0]
    way = shares[:, :1] * level + shares[:, 1:] * up
    return way / np.maximum(np.linalg.norm(way, axis=1), 1e-12)[:, None]


def _apart(placed: list[LiftedBody]) -> list[LiftedBody]:
    """Makes bodies slimmer that would overlap: boxes are wider than the things in them."""
    bodies = list(placed)
    centres = np.stack([body.centre for body in placed])
    farthest = np.stack([body.half_width * np.maximum(1.0, body.depth_share) for body in placed])
    heights = np.stack([body.half_height for body in placed])
    for i, a in enumerate(placed):
        gaps = np.linalg.norm(centres[i, :, [0, 2]].T - centres[i + 1 :, :, [0, 2]], axis=2)
        near = APART * gaps < farthest[i] + farthest[i + 1 :]  # of the many others only a few may overlap
        near &= np.abs(centres[i, :, 1] - centres[i + 1 :, :, 1]) < APART * (heights[i] + heights[i + 1 :])
        for j in (i + 1 + np.nonzero(near.any(axis=1))[0]).tolist():
            b = placed[j]
            between = a.centre[:, [0, 2]] - b.centre[:, [0, 2]]
            gap = np.linalg.norm(between, axis=1)
            level = np.abs(a.centre[:, 1] - b.centre[:, 1]) < APART * (a.half_height + b.half_height)
            share = np.where(level, APART * gap / np.maximum(_reach(a, between) + _reach(b, between), 1e-9), 1.0)
            if (share < 1).any():
                share = np.clip(share, LEAST_SHRUNK, 1.0)
                bodies[i], bodies[j] = _slimmer(bodies[i], a, share), _slimmer(bodies[j], b, share)
    return bodies


def _reach(body: LiftedBody, way: Floats) -> Floats:
    """Half the extent [K] of a body over the floor in the directions [K, 2]."""
    sight = body.centre[:, [0, 2]] / np.maximum(np.linalg.norm(body.centre[:, [0, 2]], axis=1), 1e-9)[:, None]
    along = np.einsum("ki,ki->k", way, sight) / np.maximum(np.linalg.norm(way, axis=1), 1e-9)
    return body.half_width * np.sqrt(1 + (body.depth_share**2 - 1) * along**2)


def _slimmer(body: LiftedBody, first: LiftedBody, share: Floats) -> LiftedBody:
    """A body of at most a share of its first width; a sphere that stands keeps its foot."""
    half = np.minimum(body.half_width, share * first.half_width)
    if first.shape != "sphere":
        return replace(body, half_width=half)
    centre = first.centre - np.array([0.0, 1.0, 0.0]) * (first.half_width - half)[:, None] * first.stands
    return replace(body, centre=centre, half_width=half, half_height=half)
