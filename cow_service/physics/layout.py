"""Where the bodies of a scene stand or fly as the image shows them, and how they set out, for many draws at once.

Coordinates are metres right, above the floor and ahead, the camera above their origin. Arrays have a row per draw [K].
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np

from cow_service.media.types import Floats
from cow_service.physics.bodies import HANGS, SeenBody, supports_of
from cow_service.physics.camera import CameraFit
from cow_service.physics.draws import COLUMN, quantiles
from cow_service.physics.geometry import Footprint, Measurement
from cow_service.physics.lift import (
    SLIMMEST,
    Cameras,
    LiftedBody,
    above,
    along_floor,
    in_the_air,
    velocity_in_side_view,
    velocity_towards,
)
from cow_service.records import Motion

MEASURED_SIGMA = 0.03  # of a body's size by its depth: of the logarithm
GOLDEN = math.pi * (3 - math.sqrt(5))  # radians between the mixtures of draws that two bodies take
ORDER = 17  # how far the draws of one body's depth are from those of the next
NEAREST, FARTHEST = 0.05, 40.0  # depths, in those of the first body: what seems to lie elsewhere is put there
BOX_SIDE = 0.82  # of the seen width of a box whose yaw is not known: its side
HUNG, MAYBE_HUNG = 4.0, 0.5  # how much likelier it hangs over that than where the camera's priors have it; in clutter
MAYBE_OFF = 1.3  # deviations added to the height of an object that, in clutter, may stand on an unnamed one
HUNG_SIGMA = 0.3  # of the mover's half width: how far ahead of the other it is
DEPTH_SIGMA = 0.3  # of the logarithm of the depth of what stands nowhere
APART = 0.98  # of the distance of two bodies: together they are so wide at most
VEHICLE_WIDTH = 0.5  # of a vehicle's length
DEPTHS = 0.3, 2.0  # of an unknown thing, of its width
BOX_DEPTHS = 0.4, 1.25  # of what is called a box, or by a word for one
LEAST_SHRUNK = 0.5  # of its width: bodies that overlap more are left to the engine


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
    absent: frozenset[int] = frozenset()  # bodies that were taken away, and keep their places in the lists

    def of(self, draws: slice) -> Layout:
        """That of some draws."""
        return replace(
            self,
            cameras=self.cameras.of(draws),
            bodies=tuple(body.of(draws) for body in self.bodies),
            velocity=self.velocity[draws],
            further=tuple(leg[draws] for leg in self.further),
            others={body: velocity[draws] for body, velocity in self.others.items()},
            light=self.light[draws],
        )

    def first(self, count: int) -> Layout:
        """The first bodies, without those behind them, which are taken away."""
        kept = self.without(range(count, len(self.bodies)))
        return replace(kept, bodies=kept.bodies[:count], supports=kept.supports[:count], absent=self.absent)

    def loosened(self, gone: Collection[int]) -> set[int]:
        """What stood on bodies that are gone: what stands on something that falls falls, too."""
        loose: set[int] = set()
        for _ in self.supports:
            loose |= {i for i, on in enumerate(self.supports) if i not in gone and (on in gone or on in loose)}
        return loose

    def without(self, taken: Collection[int]) -> Layout:
        """With some bodies taken away: what stood on them has no support."""
        loose = self.loosened(taken)
        supports = tuple(None if on in taken else on for on in self.supports)
        unsupported = (self.unsupported | loose).difference(taken)
        return replace(self, supports=supports, unsupported=unsupported, absent=self.absent.union(taken))

    def loads_of(self, body: int) -> frozenset[int]:
        """What was put into or onto a body: that it is there is no encounter of the body that carries it."""
        return frozenset(i for i in self.put if self.supports[i] == body)

    def rearranged(self, on: Mapping[int, int | None]) -> Layout:
        """With some bodies put elsewhere, where they stand `on` others or the floor: what stood on them falls."""
        loose = self.loosened(on)
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
        view = _Measured(bodies, supports, motion, draws, measured)
    elif level is None:
        view = _Picture(bodies, supports, motion, draws)
    else:
        view = _Drawing(bodies, supports, motion, draws, level - size[1] / 2)
    cameras, placed = view.placed(cameras, parameters, fit)
    if motion.rises:
        placed[0] = replace(placed[0], stands=False)
    turned = {"towards": None, "rises": motion.rises}
    legs = [motion.model_copy(update=turned | {"direction": s.direction, "depth": s.depth}) for s in motion.steps]
    velocity, *further = [view.velocity(cameras, placed, 0, leg, "speed") for leg in (motion, *legs)]
    also = {i: view.velocity(cameras, placed, i, each, "other_speed") for i, each in others.items()}
    placed = placed if level is not None else _apart(placed)
    resting = tuple(on if each.stands and on != HANGS else None for on, each in zip(supports, placed, strict=True))
    return Layout(cameras, tuple(placed), resting, velocity, tuple(further), also, parameters[:, 3:5])


def drawn_depths(body: SeenBody, draws: Floats) -> Floats:
    """How deep a thing whose depth is not seen is along the line of sight [K], of its width."""
    shallowest, deepest = np.log(BOX_DEPTHS if body.shape == "box" and body.is_form_known else DEPTHS)
    return np.exp(shallowest + (deepest - shallowest) * quantiles(draws[:, COLUMN["deep"]]))


@dataclass(frozen=True)
class _Picture:
    """What the picture shows, as draws [K, P] have it."""

    bodies: Sequence[SeenBody]
    supports: list[int | None]
    motion: Motion
    draws: Floats

    def placed(self, cameras: Cameras, parameters: Floats, fit: CameraFit) -> tuple[Cameras, list[LiftedBody]]:
        """The cameras at the heights that follow from the mover, and the bodies."""
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
        if not mover.stands_out:
            height *= np.exp(MAYBE_OFF * math.sqrt(fit.covariance[2, 2]) * draws[:, COLUMN["let_go_ahead"]])
        under = self.below() if motion.kind == "fall" else None
        if under is not None:
            below = self.standing(under, cameras.at_height(np.ones(len(draws))), draws)
            if below is not None:
                # In most draws it hangs over the object below it, at a distance of this many camera heights.
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

    def velocity(
        self, cameras: Cameras, placed: Sequence[LiftedBody], index: int, motion: Motion, speed_name: str
    ) -> Floats:
        """[K, 3] m/s right, up and ahead, with which one of the placed bodies sets out."""
        others = [each for other, each in enumerate(placed) if other != index]
        goal = self.goal_of(motion, placed)
        return velocity_towards(placed[index], motion, cameras, self.draws, goal, others, speed_name)

    def goal_of(self, motion: Motion, placed: Sequence[LiftedBody]) -> LiftedBody | None:
        """What a motion leads towards, if it is a body."""
        if motion.towards is None:
            return None
        goals = {body.bbox: each for body, each in zip(self.bodies, placed, strict=True)}
        return goals.get(motion.towards.bbox)

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
        said = body.prior.height
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
        seen = above(cameras, body.core, body.shape, draws, plane, depth_share, body.taper, body.bbox_deviation)
        if seen is None or not body.bbox_deviation:
            return seen
        sides = draws[:, [COLUMN["let_go_ahead"], COLUMN["opening"]]]
        aside = sides @ [math.cos(GOLDEN * index), math.sin(GOLDEN * index)]
        shift = math.sqrt(2) * body.bbox_deviation * seen.half_width * aside  # two edges, each as exact as that
        return replace(seen, centre=seen.centre + cameras.axes[:, :, 0] * shift[:, None])

    def depth_of(self, body: SeenBody, draws: Floats) -> Floats:
        """Depth of a body along the line of sight [K], relative to its width; for an unknown object it is a guess."""
        if body.is_depth_known or any(self.bodies[on] is body for on in self.supports if on is not None):
            return np.ones(len(draws))  # what carries something is deep enough for it
        return drawn_depths(body, draws)

    def depth_share(self, cameras: Cameras) -> Floats:
        """How deep the mover is along the line of sight, of its width: a vehicle is longer along its heading."""
        motion = self.motion
        unit = self.standing(0, cameras, self.draws) if self.bodies[0].elongated else None
        if unit is None or motion.direction is None or motion.kind != "linear":
            return self.depth_of(self.bodies[0], self.draws)
        way = along_floor(unit, motion, cameras, np.tile(motion.direction, (len(self.draws), 1)))[:, [0, 2]]
        sight = unit.centre[:, [0, 2]] / np.linalg.norm(unit.centre[:, [0, 2]], axis=1, keepdims=True)
        along = np.abs((way * sight).sum(axis=1))
        across = np.sqrt(np.maximum(0.0, 1 - along**2))
        return (along + VEHICLE_WIDTH * across) / (across + VEHICLE_WIDTH * along)


@dataclass(frozen=True)
class _Drawing(_Picture):
    """A drawing that is seen from the side: all bodies are equally far away."""

    level: float  # px below the middle of the image: its floor

    def placed(self, cameras: Cameras, parameters: Floats, fit: CameraFit) -> tuple[Cameras, list[LiftedBody]]:
        """The cameras above the floor, and the bodies."""
        depth = cameras.focal * self.motion.metres_per_pixel.value
        cameras = cameras.at_height(self.level * depth / cameras.focal)
        stands = [on != HANGS for on in self.supports]  # what is released may lie on a slope
        stands[0] = stands[0] if self.motion.kind == "fall" else not self.bodies[0].flies(self.motion)
        placed = (in_the_air(cameras, body.bbox, body.shape, depth) for body in self.bodies)
        return cameras, [replace(body, stands=each) for body, each in zip(placed, stands, strict=True)]

    def velocity(
        self, cameras: Cameras, placed: Sequence[LiftedBody], index: int, motion: Motion, speed_name: str
    ) -> Floats:
        """[K, 3] m/s right and up."""
        return velocity_in_side_view(placed[index], motion, self.draws, self.goal_of(motion, placed), speed_name)


@dataclass(frozen=True)
class _Measured(_Picture):
    """Bodies as a depth map shows them; those that it does not show are placed by the camera over the same floor."""

    measured: Measurement

    def placed(self, cameras: Cameras, parameters: Floats, fit: CameraFit) -> tuple[Cameras, list[LiftedBody]]:
        """The cameras above the measured floor, and the bodies."""
        floor, footprints = self.measured.floor, self.measured.footprints
        depth, found = cameras.focal * self.motion.metres_per_pixel.value, dict[int, LiftedBody]()
        # With another focal length the same map has another floor: upright things are less high in it, and the camera.
        narrower = (self.measured.focal / cameras.focal) ** math.cos(floor.pitch) ** 2
        height = floor.height * narrower * np.exp(floor.sigma[2] * self.draws[:, COLUMN["height"]])
        if (metres := self.measured.scale) is not None:
            cameras = cameras.at_height(height * metres)
        elif footprints[0] is None:
            cameras, (found[0], *_) = super().placed(cameras, parameters, fit)
        else:  # it has no unit: what is said or guessed of the mover's size fixes the scale
            cameras = cameras.at_height(height * depth / float(floor.position(footprints[0].centre)[2]))
        scale = cameras.height / height

        def place(index: int) -> LiftedBody:
            """Places a body, after its support."""
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
        seen = size * self.measured.focal / cameras.focal  # across the line of sight
        half, tall, deep = footprint.half_width * seen, footprint.half_height * seen, footprint.half_depth * size
        deep = np.maximum(deep + footprint.bend / 2 * scale * self.draws[:, COLUMN["base"]], SLIMMEST / 2 * half)
        if not footprint.depth_seen:  # what lies behind is not seen: the body reaches further back than its pixels
            hidden = np.maximum(half * drawn_depths(self.bodies[index], self.draws) - deep, 0.0)
            deep = deep + hidden
            back = np.array([-math.sin(footprint.yaw), 0.0, math.cos(footprint.yaw)])
            centre = centre + hidden[:, None] * back
        if plane is not None:  # from there to its top
            tall = (
                np.maximum(footprint.top * seen - plane, SLIMMEST * half) / 2 if footprint.shape != "sphere" else tall
            )
            centre[:, 1] = plane + tall
        yaw = None if footprint.shape == "sphere" else footprint.yaw
        share = deep / np.maximum(half, 1e-9)
        return LiftedBody(footprint.shape, centre, half, tall, plane is not None, share, yaw)


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
    if body.yaw is not None:
        sight = np.array([[-math.sin(body.yaw), math.cos(body.yaw)]])
        sight = np.repeat(sight, len(way), axis=0)
    along = np.einsum("ki,ki->k", way, sight) / np.maximum(np.linalg.norm(way, axis=1), 1e-9)
    return body.half_width * np.sqrt(1 + (body.depth_share**2 - 1) * along**2)


def _slimmer(body: LiftedBody, first: LiftedBody, share: Floats) -> LiftedBody:
    """A body of at most a share of its first width; a sphere that stands keeps its foot."""
    half = np.minimum(body.half_width, share * first.half_width)
    if first.shape != "sphere":
        return replace(body, half_width=half)
    centre = first.centre - np.array([0.0, 1.0, 0.0]) * (first.half_width - half)[:, None] * first.stands
    return replace(body, centre=centre, half_width=half, half_height=half)
