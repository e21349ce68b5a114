"""Runs a world in MuJoCo: 480 steps and 30 samples per second for 2 s."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache

import mujoco
import numpy as np

from ..stepping import ContactLog, Touch, carried
from ..world import FPS, GONE, SAMPLES, Run, World
from .shapes import Solid, shapes

RATE = 480
GAP_REACH = 2.0
"""Metres within which the closest approach is measured."""
STIFFNESS = 300.0
"""Radians per second of a contact's spring, which is as good as rigid."""


@dataclass(frozen=True)
class Fixture:
    """A ramp or a step on the floor: its middle (m), yaw (radians), length, width and height (m).

    A ramp is highest at its back and reaches the floor at its front, which is where the yaw points.
    """

    name: str
    centre: tuple[float, float]
    yaw: float
    size: tuple[float, float, float]

    @property
    def corners(self) -> np.ndarray:
        """Its corners (n, 3) in the world: six of a ramp, eight of a step."""
        length, width, height = self.size
        tops = (-1,) if self.name == "ramp" else (-1, 1)
        ground = [(x, y, 0.0) for x in (-1, 1) for y in (-1, 1)]
        points = np.array([*ground, *((x, y, 1.0) for x in tops for y in (-1, 1))]) * (length / 2, width / 2, height)
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        return points @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) + (*self.centre, 0)


@dataclass(frozen=True)
class Matter:
    """Friction and nominal restitution of every touch; `sliding` is the mover's friction if it has one of its own."""

    friction: float
    restitution: float
    sliding: float | None = None


@dataclass(frozen=True)
class Variation:
    """A slightly other motion: degrees about z, factors of speed, friction and restitution, a step to the side.

    `aside` is in radii of the mover.
    """

    turn: float = 0.0
    speed: float = 1.0
    friction: float = 1.0
    restitution: float = 1.0
    aside: float = 0.0


VARIATIONS = (
    Variation(turn=-2.5, aside=-0.06), Variation(turn=2.5, aside=0.06), Variation(speed=0.93), Variation(speed=1.07),
    Variation(friction=0.7), Variation(friction=1.4), Variation(restitution=0.6), Variation(restitution=1.3),
)  # fmt: skip
"""An answer has to be the same under all of them."""


@dataclass(frozen=True)
class OtherWorld(World):
    """A world of the second family."""

    fixtures: tuple[Fixture, ...] = ()
    matter: Matter = Matter(0.6, 0.4)

    @property
    def fixed(self) -> tuple[str, ...]:
        """Names of what is seen, has an id and never moves."""
        return tuple(f.name for f in self.fixtures)

    def varied(self, by: Variation, fine: float) -> "OtherWorld":
        """The same world with a slightly other motion; `fine` scales the turn."""
        mover = self.thing(self.mover)
        turned = self.turned(by.turn * fine, by.speed)
        way = np.array(self.velocity[:2]) if any(self.velocity[:2]) else np.array([1.0, 0.0])
        step = by.aside * fine * mover.radius * np.array([-way[1], way[0], 0]) / np.linalg.norm(way)
        things = tuple(replace(t, centre=tuple(np.array(t.centre) + step)) if t is mover else t for t in self.things)
        matter = self.matter
        matter = Matter(
            matter.friction * by.friction, min(0.9, matter.restitution * by.restitution),
            None if matter.sliding is None else matter.sliding * by.friction,
        )  # fmt: skip
        spin = tuple(float(s * by.speed) for s in self.spin)
        carry_to = self.carry_to and tuple(float(c) for c in np.array(self.carry_to) + step)
        return replace(turned, things=things, matter=matter, spin=spin, carry_to=carry_to)


def numbers(values: object) -> str:
    """Numbers as MuJoCo's XML wants them."""
    return " ".join(f"{v:.9g}" for v in np.ravel(np.asarray(values, float)))


def solid_xml(thing: Solid, k: int) -> tuple[str, str]:
    """Meshes and body of an object: the pieces that touch others."""
    shape, scale = shapes()[thing.shape], thing.scale
    if shape.primitive:
        kind, size = shape.primitive
        meshes, geoms = "", f'<geom type="{kind}" size="{numbers(np.array(size) * scale)}" density="{shape.density}"/>'
    else:
        lowered = [(piece - (0, 0, shape.height / 2)) * scale for piece in shape.pieces]
        meshes = "".join(f'<mesh name="{k}.{i}" vertex="{numbers(p)}"/>' for i, p in enumerate(lowered))
        geoms = "".join(
            f'<geom type="mesh" mesh="{k}.{i}" density="{shape.density}"/>' for i in range(len(lowered))
        )  # fmt: skip
    return meshes, f'<body name="{thing.name}"><freejoint/>{geoms}</body>'


@lru_cache(4)
def compiled(things: tuple[tuple[str, str, float], ...], fixtures: tuple[Fixture, ...]) -> mujoco.MjModel:
    """The model of objects (shape, colour, scale) and fixtures, wherever they are."""
    solids = [
        solid_xml(Solid(shape, colour, (0, 0, 0), 0, scale), k) for k, (shape, colour, scale) in enumerate(things)
    ]
    meshes = "".join(m for m, _ in solids) + "".join(
        f'<mesh name="{f.name}" vertex="{numbers(f.corners)}"/>' for f in fixtures
    )
    fixed = "".join(f'<body name="{f.name}"><geom type="mesh" mesh="{f.name}"/></body>' for f in fixtures)
    bodies = "".join(b for _, b in solids)
    return mujoco.MjModel.from_xml_string(
        f'<mujoco><option timestep="{1 / RATE!r}" cone="elliptic" impratio="10" integrator="implicitfast"/>'
        f'<asset>{meshes}</asset><worldbody><body name="floor"><geom type="plane" size="0 0 1"/></body>'
        f"{fixed}{bodies}</worldbody></mujoco>"
    )


def set_matter(model: mujoco.MjModel, world: OtherWorld) -> None:
    """Friction and restitution of a world; what is removed touches nothing.

    A contact is a spring with a damper, whose ratio follows from the restitution (MuJoCo's documentation, chapter
    Modeling, Restitution). That formula is for a contact that also pulls; MuJoCo's do not, and bounces are higher.
    """
    logarithm = np.log(world.matter.restitution)
    damping = -logarithm / np.hypot(np.pi, logarithm)
    model.geom_solref[:] = 1 / (STIFFNESS * damping), damping
    model.geom_friction[:] = world.matter.friction, 0.002, 0.0001
    model.geom_priority[:] = 0
    model.geom_contype[:] = model.geom_conaffinity[:] = 1
    owner = np.array([model.body(b).name for b in model.geom_bodyid])
    if world.matter.sliding is not None:
        model.geom_friction[owner == world.mover, 0] = world.matter.sliding
        model.geom_priority[owner == world.mover] = 1
    if world.removed:
        model.geom_contype[owner == world.removed] = model.geom_conaffinity[owner == world.removed] = 0


def touches_now(model: mujoco.MjModel, data: mujoco.MjData, names: list[str]) -> Iterator[Touch]:
    """What touches after a step."""
    contact = data.contact
    near = np.flatnonzero((contact.dist <= 0.001) & (contact.efc_address >= 0))
    bodies, forces = model.geom_bodyid[contact.geom[near]].tolist(), data.efc_force[contact.efc_address[near]].tolist()
    # With elliptic cones a contact's first constraint is its normal force.
    for (a, b), force, at in zip(bodies, forces, contact.pos[near], strict=True):
        yield names[a], names[b], force, at


def gap_now(model: mujoco.MjModel, data: mujoco.MjData, a: int, b: int, least: float) -> float:
    """The distance of two bodies in metres, if it is below `least`."""
    ours, theirs = (np.flatnonzero(model.geom_bodyid == body) for body in (a, b))
    apart = np.linalg.norm(data.geom_xpos[ours][:, None] - data.geom_xpos[theirs], axis=-1)
    apart -= model.geom_rbound[ours][:, None] + model.geom_rbound[theirs]
    for k in np.argsort(apart, axis=None):
        g, h = np.unravel_index(k, apart.shape)
        if apart[g, h] >= least:
            break
        found = mujoco.mj_geomDistance(model, data, int(ours[g]), int(theirs[h]), GAP_REACH, None)
        least = min(least, max(0.0, found))
    return least


def start(model: mujoco.MjModel, world: OtherWorld) -> mujoco.MjData:
    """The state at t = 0."""
    data = mujoco.MjData(model)
    for thing in world.things:
        joint = data.joint(int(model.body(thing.name).jntadr[0]))
        joint.qpos[:] = *thing.centre, np.cos(thing.yaw / 2), 0, 0, np.sin(thing.yaw / 2)
        if thing.name == world.mover:
            # A free joint's velocity is the world's, its spin the body's.
            c, s = np.cos(thing.yaw), np.sin(thing.yaw)
            x, y, z = world.spin
            joint.qvel[:] = *world.velocity, c * x + s * y, c * y - s * x, z
    return data


def simulate(world: OtherWorld) -> Run:
    """Run a world for 2 s; the same world gives the same numbers."""
    model = compiled(tuple((t.shape, t.colour, t.scale) for t in world.things), world.fixtures)
    set_matter(model, world)
    data = start(model, world)
    mujoco.mj_forward(model, data)
    names = [model.body(b).name for b in range(model.nbody)]
    moving = [t.name for t in world.things if t.name != world.removed]
    centres = {t.name: np.tile(np.array(GONE), (SAMPLES, 1)) for t in world.things}
    turns = {t.name: np.tile(np.array([0.0, 0, 0, 1]), (SAMPLES, 1)) for t in world.things}
    log, gaps = ContactLog(RATE), dict.fromkeys((t.name for t in world.things if t.name != world.mover), GAP_REACH)
    hand = data.joint(int(model.body(world.mover).jntadr[0]))
    for sample in range(SAMPLES):
        for k in range(RATE // FPS if sample else 0):
            step = (sample - 1) * (RATE // FPS) + k + 1
            held = carried(world, step / RATE)
            if held:
                yaw = world.thing(world.mover).yaw / 2
                hand.qpos[:], hand.qvel[:] = (*held, np.cos(yaw), 0, 0, np.sin(yaw)), 0
            mujoco.mj_step(model, data)
            log.step(touches_now(model, data, names), step)
        for name in moving:
            body = data.body(name)
            centres[name][sample], turns[name][sample] = body.xpos, np.roll(body.xquat, -1)
            if name != world.mover:
                gaps[name] = gap_now(model, data, model.body(world.mover).id, model.body(name).id, gaps[name])
    touched = {name for c in log.contacts() if world.mover in {c.a, c.b} for name in (c.a, c.b)}
    return Run(centres, turns, log.contacts(), {n: 0.0 if n in touched else gap for n, gap in gaps.items()})
