"""The shadows of a moving body, frame by frame: what is measured at the first frame moves over the floor.

A standing thing has the shadow beneath and beside it, which fades as it rises. A thing in the air casts one along the
light. And what comes down onto a surface takes that surface's light from the sky, as any sphere does: a point at a
distance d from the centre of a sphere of radius r, at a height h above a plane, loses h r^2 / d^3 of it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np

from cow_service.generators.cutout.ground import Ground, Surface
from cow_service.generators.cutout.shade import Shade, drawn, reach
from cow_service.generators.cutout.sprites import Window, clipped
from cow_service.records import Path, Vector
from cow_service.vision.masks import Floats, Floats32

FADED = 0.6  # of its height: a standing thing that has risen so far has no contact shadow any more
SKY, SHARPNESS = 1.5, 2.0  # so much of the power of that share is lost: light also comes in from beside
MOST_TAKEN = 0.85  # share of light
EXTENT = 2.5  # radii around the foot, within which a sphere's shade is drawn
CELLS = 40  # along the longer side: such a shade is smooth, and computed at so few cells
NO_SHADE = 0.01  # share of light


@dataclass(frozen=True)
class Drawn:
    """The share of light that is taken away in a window of the frame, on one surface."""

    window: Window
    dark: Floats32  # [a, b, 3]
    surface: int | None  # of `Trajectory.bodies`; None for the floor


class Shadow(Protocol):
    """A shadow of a moving body."""

    def at(self, frame: int, size: tuple[int, int]) -> Iterator[Drawn]:
        """As it is at a clip frame, inside frames of a size (width, height)."""
        ...


@dataclass(frozen=True)
class AttachedShadow:
    """Of a standing thing where no camera is known: it moves and grows as the thing does."""

    shade: Shade
    path: Path
    start: tuple[float, float]  # px of the clip
    factor: float  # clip px per image px

    def at(self, frame: int, size: tuple[int, int]) -> Iterator[Drawn]:
        """One shadow, on the floor."""
        matrix = np.eye(2) * self.path.scale[frame]
        to = self.factor * np.array(self.path.points[frame])
        yield from _drawn(self.shade, matrix, to, np.array(self.start), size, None, 1.0)


@dataclass(frozen=True)
class ContactShadow:
    """Of a thing that stands at the first frame."""

    ground: Ground
    path: Path
    shade: Shade
    support: int | None  # what it stands on, of `Trajectory.bodies`; None for the floor

    def at(self, frame: int, size: tuple[int, int]) -> Iterator[Drawn]:
        """On what lies beneath the thing; none once it has risen."""
        ground, body = self.ground, self.ground.bodies[self.path.body]
        first, there = (np.array(self.path.states[index][:3]) for index in (0, frame))
        lower = ground.lower_end(self.path.body)
        bottom = lower + ground.height(there) - ground.height(first)
        surface = ground.surface_below(there, bottom, body.size[1])
        if surface.body == self.support:
            surface = Surface(lower, self.support)
        strength = 1 - max(0.0, bottom - surface.height) / (FADED * body.size[1])
        if strength <= NO_SHADE:
            return
        start, foot = ground.foot(first, lower), ground.foot(there, surface.height)
        matrix = np.eye(2) * (ground.depth(start) / ground.depth(foot))
        yield from _drawn(
            self.shade, matrix, ground.project(foot), ground.project(start), size, surface.body, min(1.0, strength)
        )


@dataclass(frozen=True)
class CastShadow:
    """Of a thing in the air at the first frame: where the light through it meets the floor."""

    ground: Ground
    path: Path
    shade: Shade
    light: Vector  # m right and ahead per m of height

    def at(self, frame: int, size: tuple[int, int]) -> Iterator[Drawn]:
        """On the floor, or on the top of a still body."""
        ground = self.ground
        first, there = (np.array(self.path.states[index][:3]) for index in (0, frame))
        start = cast_onto(ground, first, self.light, 0.0)
        surface = _below_ray(ground, there, self.light, ground.bodies[self.path.body].size[1])
        to = cast_onto(ground, there, self.light, surface.height)
        if to[2] <= 0:
            return
        matrix = ground.shape_on_floor(to) @ np.linalg.inv(ground.shape_on_floor(start))
        yield from _drawn(self.shade, matrix, ground.project(to), ground.project(start), size, surface.body, 1.0)


@dataclass(frozen=True)
class SkyShadow:
    """Of a thing in the air at the first frame that comes near to a surface: computed as of a sphere."""

    ground: Ground
    path: Path

    def at(self, frame: int, size: tuple[int, int]) -> Iterator[Drawn]:
        """On the surface beneath; nothing from some height on."""
        ground, body = self.ground, self.ground.bodies[self.path.body]
        there = np.array(self.path.states[frame][:3])
        radius, height = body.size[1] / 2, ground.height(there)
        surface = ground.surface_below(there, height - radius, body.size[1])
        above = max(radius, height - surface.height)
        if SKY * (radius / above) ** (2 * SHARPNESS) <= NO_SHADE:
            return
        foot = ground.foot(there, surface.height)
        across = np.abs(ground.shape_on_floor(foot)).sum(axis=1) * EXTENT * radius
        centre = ground.project(foot)
        window = clipped(centre - across, centre + across, size)
        if window is not None and foot[2] > 0:
            dark = _sky_taken(ground, foot, window, radius, above)
            yield Drawn(window, np.asarray(cv2.merge((dark, dark, dark)), np.float32), surface.body)


def cast_onto(ground: Ground, position: Floats, light: Vector, height: float) -> Floats:
    """Where the light through a position [3] meets the plane at a height above the floor (m)."""
    fall = ground.height(position) - height
    across = light[0] * ground.camera.right + light[1] * ground.camera.ahead
    return ground.foot(position, height) + fall * across


def _below_ray(ground: Ground, position: Floats, light: Vector, size: float) -> Surface:
    """The floor, or the still body's top that the light through a position meets before."""
    for index in ground.still:
        body = ground.bodies[index]
        top = ground.height(np.array(body.position)) + body.size[1] / 2
        bottom = ground.height(position) - size / 2
        surface = ground.surface_below(cast_onto(ground, position, light, top), bottom, size)
        if surface.body == index:
            return surface
    return Surface(0.0, None)


def _drawn(
    shade: Shade, matrix: Floats, to: Floats, start: Floats, size: tuple[int, int], surface: int | None, strength: float
) -> Iterator[Drawn]:
    window = clipped(*reach(shade, matrix, to, start), size)
    if window is not None:
        yield Drawn(window, np.float32(strength) * drawn(shade, matrix, to, start, window), surface)


def _sky_taken(ground: Ground, foot: Floats, window: Window, radius: float, above: float) -> Floats32:
    """Share [a, b] of the sky's light that a sphere takes from the plane through `foot`, fading out at `EXTENT`."""
    rows, columns = window
    height, width = rows.stop - rows.start, columns.stop - columns.start
    scale = min(1.0, CELLS / max(width, height))
    cells_x, cells_y = max(1, round(width * scale)), max(1, round(height * scale))
    xs = columns.start + (np.arange(cells_x) + 0.5) * width / cells_x
    ys = rows.start + (np.arange(cells_y) + 0.5) * height / cells_y
    grid = np.stack(np.meshgrid(xs, ys), axis=2).reshape(-1, 2) / ground.factor
    rays = ground.camera.rays(grid)
    up = ground.camera.up
    sink = -rays @ up
    length = (ground.camera.height - ground.height(foot)) / np.where(sink > 1e-6, sink, 1.0)
    gap = ((rays * length[:, None] - foot) ** 2).sum(axis=1)
    taken = np.where(sink > 1e-6, above * radius**2 / (gap + above**2) ** 1.5, 0.0) ** SHARPNESS
    edge = (above * radius**2 / ((EXTENT * radius) ** 2 + above**2) ** 1.5) ** SHARPNESS
    cells = np.clip(SKY * (taken - edge), 0, MOST_TAKEN).reshape(cells_y, cells_x).astype(np.float32)
    return np.asarray(cv2.resize(cells, (width, height), interpolation=cv2.INTER_LINEAR), np.float32)
