"""A world before and after it is run. These records hold no picture and no engine."""

from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np

from .catalogue import BOWL_OPENING, HEIGHT, RADIUS
from .meshes import surface_of

FPS = 30
SAMPLES = 61
SUBSTEPS = 8
"""Bullet's steps per sample: 240 Hz."""

GONE = (0.0, 0.0, -9.0)
"""Where an object that was taken away is said to be."""


@dataclass(frozen=True)
class Thing:
    """One object: shape and colour by name, scale, centre in metres (z up, floor at 0), yaw in radians."""

    shape: str
    colour: str
    centre: tuple[float, float, float]
    yaw: float = 0.0
    scale: float = 1.0

    @property
    def name(self) -> str:
        """Colour and shape: unique within a world."""
        return f"{self.colour} {self.shape}"

    @property
    def radius(self) -> float:
        """Metres: the circle around the footprint."""
        return RADIUS[self.shape] * self.scale

    @property
    def height(self) -> float:
        """Metres."""
        return HEIGHT[self.shape] * self.scale

    @property
    def surface(self) -> tuple[np.ndarray, np.ndarray]:
        """The drawn mesh at scale 1: vertices (n, 3) about the centre, triangles (m, 3)."""
        return surface_of(self.shape)

    @property
    def width(self) -> float:
        """Metres: the narrowest round opening that it passes."""
        return self.height

    @property
    def opening(self) -> float:
        """Metres: the width of a container's opening."""
        return 2 * BOWL_OPENING * self.scale


@dataclass(frozen=True)
class Table:
    """A solid box 0.7 m square on the floor: centre (m), height (m), yaw (radians)."""

    centre: tuple[float, float]
    height: float
    yaw: float
    side: float = 0.7


@dataclass(frozen=True)
class World:
    """Everything Bullet needs. `velocity` (m/s) and `spin` (rad/s) are the mover's at t = 0.

    `carry_to` is where the mover is carried by hand, in an arc of 0.6 s, before it is released.
    """

    things: tuple[Thing, ...]
    mover: str
    velocity: tuple[float, float, float] = (0.0, 0.0, 0.0)
    spin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    frictionless: frozenset[str] = frozenset()
    table: Table | None = None
    removed: str | None = None
    carry_to: tuple[float, float, float] | None = None

    @property
    def fixed(self) -> tuple[str, ...]:
        """Names of what is seen, has an id and never moves."""
        return ("table",) if self.table else ()

    def thing(self, name: str) -> Thing:
        """The object of that name."""
        return next(t for t in self.things if t.name == name)

    def turned(self, degrees: float, factor: float) -> Self:
        """The same world with the mover's velocity turned about z and scaled: a slightly other push."""
        a = np.radians(degrees)
        x, y, z = self.velocity
        v = (x * np.cos(a) - y * np.sin(a), x * np.sin(a) + y * np.cos(a), z)
        return replace(self, velocity=tuple(float(c * factor) for c in v))


@dataclass(frozen=True)
class Contact:
    """Two objects begin to touch: time (s), point (m), impulse (N s), first sample at or after it."""

    a: str
    b: str
    time: float
    point: tuple[float, float, float]
    impulse: float
    sample: int


@dataclass(frozen=True)
class Run:
    """What happened: per object centres (61, 3) in metres and turns (61, 4) as quaternions x, y, z, w.

    `contacts` also has touches of `floor` and `table` that begin after t = 0; `gaps` is the mover's closest
    approach to each other object over the whole run in metres, 0 if they touch.
    """

    centres: dict[str, np.ndarray]
    turns: dict[str, np.ndarray]
    contacts: tuple[Contact, ...]
    gaps: dict[str, float] = field(default_factory=dict)

    def first(self, a: str, b: str) -> Contact | None:
        """The first contact between two objects."""
        return next((c for c in self.contacts if {c.a, c.b} == {a, b}), None)
