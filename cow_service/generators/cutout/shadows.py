"""The shadows of a moving body, frame by frame: what is measured at the first frame moves over the floor.

A standing thing has the shadow beneath and beside it, which fades as it rises. A thing in the air casts one along the
light. And what comes down onto a surface takes that surface's light from the sky, as any sphere does: a point at a
distance d from the centre of a sphere of radius r, at a height h above a plane, loses h r^2 / d^3 of it.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np

from cow_service.generators.base import GeneratorInput
from cow_service.generators.cutout.bodies import Ground, MovingBody, StillBody, Surface, Window, clipped
from cow_service.generators.cutout.shade import LEAST_SHADE, Shade, cast_shade, contact_shade, strongest
from cow_service.media.masks import bbox_of, eroded, three_channels
from cow_service.media.types import Floats, Floats32, Image, Mask
from cow_service.records import Path, Vector

FADED = 0.6  # of its height: a standing thing that has risen so far has no contact shadow any more
SKY, SHARPNESS = 1.5, 2.0  # the part of that share that is lost: light also comes in from the side
MOST_TAKEN = 0.85  # share of light
EXTENT = 2.5  # radii around the foot, within which a sphere's shade is drawn
CELLS = 40  # along the longer side: such a shade is smooth, and computed at so few cells
NO_SHADE = 0.01  # share of light
DEEP = 0.55  # share of light: with more taken away, noise is all that dividing brings back
PAINTED = 0.15  # share of light: where an inpainter paints the hole, it does better than dividing from here on
LEAST_SPREAD, TEXTURE = 0.02, 2.5  # of the lightness, deviations of the texture: so far a lit floor's colours spread
RIM = 2  # px around an object, where its colours mix with those of the floor
STRETCH = 1.25  # of a sphere's radius: how far its shadow reaches from its middle


@dataclass(frozen=True)
class ShadePatch:
    """The share of light that is taken away in a window of the frame, on one surface."""

    window: Window
    dark: Floats32  # [a, b, 3]
    surface: int | None  # of `Trajectory.bodies`; None for the floor


MovingShadow = Callable[[int, tuple[int, int]], ShadePatch | None]
"""A shadow of a moving body: as it is at a clip frame, inside frames of a size (width, height), where it is seen."""


def _attached_shadow(
    shade: Shade, path: Path, start: Floats, factor: float, frame: int, size: tuple[int, int]
) -> ShadePatch | None:
    """Of a standing thing where no camera is known: it moves and grows as the thing does.

    `start` [2] is in px of the clip, `factor` clip px per image px.
    """
    to = factor * np.array(path.points[frame])
    return _patch(shade, np.eye(2) * path.scale[frame], to, start, size, None)


def _contact_shadow(
    ground: Ground, path: Path, shade: Shade, support: int | None, frame: int, size: tuple[int, int]
) -> ShadePatch | None:
    """Of a thing that stands at the first frame, on what lies beneath it; none once it has risen.

    `support` is what it stands on, of `Trajectory.bodies`; None for the floor.
    """
    body = ground.bodies[path.body]
    first, there = (np.array(path.states[index][:3]) for index in (0, frame))
    # Heights of its lower end above the floor, first and now.
    lower = 0.0 if body.support == "floor" else ground.height(np.array(body.position)) - body.size[1] / 2
    bottom = lower + ground.height(there) - ground.height(first)
    surface = ground.surface_below(there, bottom, body.size[1])
    if surface.body == support:
        surface = Surface(lower, support)
    strength = 1 - max(0.0, bottom - surface.height) / (FADED * body.size[1])
    if strength <= NO_SHADE:
        return None
    start, foot = ground.foot(first, lower), ground.foot(there, surface.height)
    matrix = np.eye(2) * (ground.depth(start) / ground.depth(foot))
    ends = ground.project(foot), ground.project(start)
    return _patch(shade, matrix, *ends, size, surface.body, min(1.0, strength))


def _cast_shadow(
    ground: Ground, path: Path, shade: Shade, light: Vector, frame: int, size: tuple[int, int]
) -> ShadePatch | None:
    """Of a thing in the air at the first frame: where the light through it meets the floor or the top of a still body.

    `light` is in m right and ahead per m of height.
    """
    first, there = (np.array(path.states[index][:3]) for index in (0, frame))
    start = cast_onto(ground, first, light, 0.0)
    surface, length = Surface(0.0, None), ground.bodies[path.body].size[1]
    for index in ground.still:  # whose top the light through it meets before the floor
        top = ground.height(np.array(ground.bodies[index].position)) + ground.bodies[index].size[1] / 2
        reached = cast_onto(ground, there, light, top)
        below = ground.surface_below(reached, ground.height(there) - length / 2, length)
        if below.body == index:
            surface = below
            break
    to = cast_onto(ground, there, light, surface.height)
    if to[2] <= 0:
        return None
    matrix = ground.shape_on_floor(to) @ np.linalg.inv(ground.shape_on_floor(start))
    return _patch(shade, matrix, ground.project(to), ground.project(start), size, surface.body)


def _sky_shadow(ground: Ground, path: Path, frame: int, size: tuple[int, int]) -> ShadePatch | None:
    """Of a thing in the air at the first frame, on the surface that it comes near to: computed as of a sphere."""
    body, there = ground.bodies[path.body], np.array(path.states[frame][:3])
    radius, height = body.size[1] / 2, ground.height(there)
    surface = ground.surface_below(there, height - radius, body.size[1])
    above = max(radius, height - surface.height)
    if SKY * (radius / above) ** (2 * SHARPNESS) <= NO_SHADE:
        return None
    foot = ground.foot(there, surface.height)
    across = np.abs(ground.shape_on_floor(foot)).sum(axis=1) * EXTENT * radius
    centre = ground.project(foot)
    window = clipped(centre - across, centre + across, size)
    if window is None or foot[2] <= 0:
        return None
    # The share of the sky's light that a sphere takes from the plane through `foot`, fading out at `EXTENT`.
    rows, columns = window
    high, wide = rows.stop - rows.start, columns.stop - columns.start
    scale = min(1.0, CELLS / max(wide, high))
    cells_x, cells_y = max(1, round(wide * scale)), max(1, round(high * scale))
    xs = columns.start + (np.arange(cells_x) + 0.5) * wide / cells_x
    ys = rows.start + (np.arange(cells_y) + 0.5) * high / cells_y
    rays = ground.camera.rays(np.stack(np.meshgrid(xs, ys), axis=2).reshape(-1, 2) / ground.factor)
    sink = -rays @ ground.camera.up
    length = (ground.camera.height - ground.height(foot)) / np.where(sink > 1e-6, sink, 1.0)
    gap = ((rays * length[:, None] - foot) ** 2).sum(axis=1)
    taken = np.where(sink > 1e-6, above * radius**2 / (gap + above**2) ** 1.5, 0.0) ** SHARPNESS
    edge = (above * radius**2 / ((EXTENT * radius) ** 2 + above**2) ** 1.5) ** SHARPNESS
    cells = np.clip(SKY * (taken - edge), 0, MOST_TAKEN).reshape(cells_y, cells_x).astype(np.float32)
    dark = np.asarray(cv2.resize(cells, (wide, high), interpolation=cv2.INTER_LINEAR), np.float32)
    return ShadePatch(window, three_channels(dark), surface.body)


def cast_onto(ground: Ground, position: Floats, light: Vector, height: float) -> Floats:
    """Where the light through a position [3] meets the plane at a height above the floor (m)."""
    fall = ground.height(position) - height
    across = light[0] * ground.camera.right + light[1] * ground.camera.ahead
    return ground.foot(position, height) + fall * across


def _patch(
    shade: Shade,
    matrix: Floats,
    to: Floats,
    start: Floats,
    size: tuple[int, int],
    surface: int | None,
    strength: float = 1.0,
) -> ShadePatch | None:
    window = clipped(*shade.corners(matrix, to, start), size)
    if window is None:
        return None
    return ShadePatch(window, np.float32(strength) * shade.darkness(window, matrix, to, start), surface)


@dataclass(frozen=True)
class UnshadedScene:
    """A scene without the shadows of what moves."""

    image: Image  # [h, w, 3]
    noisy: dict[int, Mask]  # by `Path.body`: where a body with a contact shadow has left too little to divide
    unmeasured: frozenset[int]  # by `Path.body`: what stands and moves, with a shadow, if any, that is still there
    shadows: tuple[MovingShadow, ...]


def take_shadows(
    given: GeneratorInput,
    image: Image,
    moving: Sequence[MovingBody],
    still: Sequence[StillBody],
    ground: Ground | None,
    factor: float,
) -> UnshadedScene:
    """The scene [h, w, 3] without the shadows of the bodies that move, and these shadows."""
    objects = np.logical_or.reduce([body.mask for body in (*moving, *still)])
    floor, shadows, noisy = eroded(~objects, 2 * RIM + 1), list[MovingShadow](), dict[int, Mask]()
    unmeasured: set[int] = set()
    for body in moving:
        index = body.path.body
        if body.stays:
            continue
        if ground is not None and ground.bodies[index].support == "air":
            shadows.append(partial(_sky_shadow, ground, body.path))
            light = _light_through(given, body, ground)
            if light is not None and (shade := _shade_in_light(image, body, ground, light, floor)) is not None:
                shadows.append(partial(_cast_shadow, ground, body.path, shade, light))
                image, _ = _without_shade(image, shade, ~objects)
            continue
        if body.airborne:
            continue
        # Of a table all that nothing else hides: its shaded part may be missing from its mask.
        masks = [other.mask | (other.outline & ~objects) for other in still if other.index == body.support]
        beside = eroded(masks[0], 2 * RIM + 1) if masks else floor
        shade = contact_shade(image, body.mask, bbox_of(body.mask), beside)
        if shade is None:
            unmeasured.add(index)
            continue
        if ground is None:
            shadows.append(partial(_attached_shadow, shade, body.path, factor * body.start, factor))
        else:
            shadows.append(partial(_contact_shadow, ground, body.path, shade, body.support))
        deep = DEEP if given.inpainter is None else PAINTED
        image, noisy[index] = _without_shade(image, shade, masks[0] if masks else ~objects, deep)
    return UnshadedScene(image, noisy, frozenset(unmeasured), tuple(shadows))


def _light_through(given: GeneratorInput, body: MovingBody, ground: Ground) -> Vector | None:
    """The light (m right and ahead per m of height): as it is known, or as a shadow is found below the mover."""
    first, light = np.array(body.path.states[0][:3]), given.trajectory.light
    if light is None and body.path.body == 0:
        found, high = given.scene.shadow, ground.height(first)
        there = None if found is None else ground.camera.floor_points(np.array([found.centre]))
        if there is not None and np.isfinite(there).all() and high > 0:
            gap = ground.camera.to_floor(there)[0] - ground.camera.to_floor(first[None])[0]
            light = float(gap[0]) / high, float(gap[2]) / high
    return light


def _shade_in_light(image: Image, body: MovingBody, ground: Ground, light: Vector, floor: Mask) -> Shade | None:
    """The shadow on the floor of a thing in the air, at the first frame."""
    middle = cast_onto(ground, np.array(body.path.states[0][:3]), light, 0.0)
    angles = np.linspace(0, 2 * np.pi, 24, endpoint=False)[:, None]
    ring = np.cos(angles) * ground.camera.right + np.sin(angles) * ground.camera.ahead
    outline = ground.bodies[body.path.body].size[0] / 2 * STRETCH * ring
    points = np.array([ground.project(middle + step) for step in outline])
    height, width = floor.shape
    (x0, y0), (x1, y1) = points.min(axis=0), points.max(axis=0)
    if middle[2] <= 0 or x1 < 2 or y1 < 2 or x0 > width - 2 or y0 > height - 2:
        return None
    ellipse = np.zeros(floor.shape, np.uint8)
    inner = 0.7 * points + 0.3 * points.mean(axis=0)
    cv2.fillConvexPoly(ellipse, np.rint(inner).astype(np.int32), 1)
    seed = (ellipse > 0) & floor
    return cast_shade(image, seed, (float(x0), float(y0), float(x1), float(y1)), floor)


def _without_shade(image: Image, shade: Shade, where: Mask, most: float = DEEP) -> tuple[Image, Mask]:
    """The image [h, w, 3] with a shade taken out of it in a mask, and a mask of where it took more than `most`."""
    deep = np.zeros_like(where)
    window = clipped(*shade.corners(), (image.shape[1], image.shape[0]))
    if window is None:
        return image, deep
    dark = np.where(where[window][..., None], shade.darkness(window), np.float32(0))
    result = image.copy()
    lit = image[window] / (1 - dark)
    # At a sharp edge of the shadow a pixel more or less would leave a line: nothing differs more than its texture.
    floor, spread = shade.lit_floor(window), max(LEAST_SPREAD, TEXTURE * shade.texture)
    bounded = np.clip(lit, (1 - spread) * floor, (1 + spread) * floor)
    shaded = np.clip(cv2.dilate(strongest(dark), np.ones((5, 5), np.uint8)) / LEAST_SHADE, 0, 1)[..., None]
    result[window] = np.clip(shaded * bounded + (1 - shaded) * lit + 0.5, 0, 255).astype(np.uint8)
    deep[window] = dark @ np.full(3, 1 / 3, np.float32) > most
    return result, deep
