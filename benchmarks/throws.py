"""Measures how sure the world is: probabilities of throws with known truth, from geometry alone.

    python benchmarks/throws.py [--count N] [--seed N] [--wide] [--ensemble N] [--bound] [--json FILE]

Each throw is drawn at random: a camera, a ball in the air with its shadow, a target and other things on the floor, a
speed, a rise and a heading out of the plane of the image (15 degrees, one standard deviation; with `--wide` any up to
45 degrees, which nothing in the image tells). Half of the targets lie about on the ball's way, half anywhere. The
engine says with the true values whether the ball meets the target. Stage 3 sees what an image shows: boxes, the
shadow's ellipse and the direction in the image, each with a little noise; not camera, heights, depth or speed.
Printed are the Brier score (mean squared difference of probability and truth), that of always saying the base rate, and
how often answers are right. With `--bound` the same is printed of one who knows what no image tells: the camera, the
bodies and how these throws are drawn, so that only heading, rise and speed are open. No reader can be surer than that.
"""

from __future__ import annotations

import argparse
import json
import math
import statistics
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from cow_service.media.masks import CroppedMask
from cow_service.media.types import Floats
from cow_service.physics.bodies import SeenBody, Shadow
from cow_service.physics.camera import CameraFit, FloorCamera, fit_shadow, prior
from cow_service.physics.draws import ensemble, likeliest
from cow_service.physics.engine import RigidShape, run_worlds
from cow_service.physics.ensemble import SURE
from cow_service.physics.events import find_world_events
from cow_service.physics.lift import DIRECTION_DEVIATIONS
from cow_service.physics.world import WorldInput, run_world
from cow_service.records import BBox, MetresPerPixel, Motion, MotionRequest, Shape
from cow_service.stages.motion import SPEED_DEVIATIONS, THROW_DEPTH_DEVIATION, Units

WIDTH, HEIGHT = 832, 480  # px
RADIUS = 0.15  # m, of the ball
FPS, FRAMES = 16.0, 81
BOX_NOISE = 1.0  # px, one standard deviation of the edges of boxes
SHADOW_NOISE = 0.03  # of the ball's radius and of the shadow's width
DIRECTION_NOISE = 1.0  # degrees
TURN_SIGMA = 15.0  # degrees out of the plane of the image
SHAPES: tuple[tuple[Shape, float, float], ...] = (
    ("box", 0.15, 0.15),
    ("cylinder", 0.12, 0.15),
    ("cylinder", 0.1, 0.25),
    ("cone", 0.17, 0.22),
    ("sphere", 0.15, 0.15),
)  # half widths and heights, m


@dataclass(frozen=True)
class Throw:
    """A throw as it is, and as an image shows it. Coordinates are metres right, above the floor and ahead."""

    camera: FloorCamera
    bodies: tuple[RigidShape, ...]  # the ball, the target, others
    boxes: tuple[BBox, ...]
    shadow: Shadow
    direction: tuple[float, float]
    hits: bool


def draw_throw(rng: np.random.Generator, wide: bool = False) -> Throw | None:
    """A random throw, or None if not all of it is in the image."""
    pitch = math.radians(rng.uniform(16, 38))
    focal = WIDTH * rng.uniform(0.9, 1.15)
    distance = rng.uniform(2.9, 3.7)
    camera = FloorCamera(WIDTH, HEIGHT, focal, pitch, 0.0, distance * math.sin(pitch) + 0.1)
    middle = distance * math.cos(pitch)
    sense = rng.choice([-1.0, 1.0])
    ball = np.array([-sense * rng.uniform(0.4, 1.2), rng.uniform(0.5, 1.1), middle + rng.uniform(-0.4, 0.4)])
    turn = math.radians(rng.uniform(-45, 45) if wide else rng.normal(0, TURN_SIGMA))
    rise, speed = math.radians(rng.uniform(5, 32)), rng.uniform(1.2, 2.4)
    level = np.array([sense * math.cos(turn), 0.0, math.sin(turn)])
    velocity = speed * (math.cos(rise) * level + math.sin(rise) * np.array([0.0, 1.0, 0.0]))
    along, aside = rng.uniform(0.6, 1.8), rng.normal(0, 0.15)
    ahead = ball + along * level + aside * np.array([-level[2], 0.0, level[0]])
    anywhere = [np.array([rng.uniform(-1.2, 1.2), 0.0, middle + rng.uniform(-0.9, 0.9)]) for _ in range(3)]
    bodies = [_body("sphere", RADIUS, RADIUS, ball, velocity)]
    places = [ahead if rng.random() < 0.5 else anywhere[0], *anywhere[1:]]
    for place in places:
        shape, half, tall = SHAPES[rng.integers(len(SHAPES))]
        where = np.array([place[0], tall, place[2]])
        apart = [math.hypot(*(where - other.position)[[0, 2]]) > 0.4 for other in bodies[1:]]
        if all(apart):
            bodies.append(_body(shape, half, tall, where))
    boxes = [_box(camera, body) for body in bodies]
    if len(bodies) < 2 or any(box is None for box in boxes):
        return None
    run = run_worlds([bodies], FRAMES, FPS)[0]
    hits = any(meeting.a == 0 and meeting.b == 1 for meeting in run.meetings)
    noisy = [tuple(float(v) for v in np.array(box) + rng.normal(0, BOX_NOISE, 4)) for box in boxes if box is not None]
    ends = camera.project(camera.from_floor(np.stack([ball, ball + 0.001 * velocity])))
    angle = math.atan2(*(ends[1] - ends[0])[::-1]) + math.radians(rng.normal(0, DIRECTION_NOISE))
    slant = rng.uniform(-0.6, 0.6, 2)
    shadow = _shadow(camera, ball, slant, rng)
    direction = (math.cos(angle), math.sin(angle))
    return Throw(camera, tuple(bodies), tuple(noisy), shadow, direction, hits)  # type: ignore[arg-type]


def _body(shape: Shape, half: float, tall: float, where: Floats, velocity: Floats | None = None) -> RigidShape:
    x, y, z = where.tolist()
    going = (0.0, 0.0, 0.0) if velocity is None else tuple(velocity.tolist())
    return RigidShape(shape, half, half, tall, (x, y, z), velocity=going, starts=velocity is not None)


def _box(camera: FloorCamera, body: RigidShape) -> BBox | None:
    """The box of a body's outline; None if it leaves the image."""
    turns = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    if body.shape == "sphere":
        rise = np.linspace(-np.pi / 2, np.pi / 2, 21)
        rims = [(np.sin(r) * body.half_width, np.cos(r) * body.half_width) for r in rise]
    else:
        rims = [
            (-body.half_height, body.half_width),
            (body.half_height, 0.0 if body.shape == "cone" else body.half_width),
        ]
    if body.shape == "box":
        turns, rims = (
            turns[:4] * 0 + np.array([0.25, 0.75, 1.25, 1.75]) * np.pi,
            [(y, r * math.sqrt(2)) for y, r in rims],
        )
    rim = np.concatenate(
        [np.stack([r * np.cos(turns), np.full(len(turns), y), r * np.sin(turns)], axis=1) for y, r in rims]
    )
    points = camera.project(camera.from_floor(np.array(body.position) + rim))
    (x0, y0), (x1, y1) = points.min(axis=0), points.max(axis=0)
    inside = x0 > 0 and y0 > 0 and x1 < WIDTH and y1 < HEIGHT
    return (float(x0), float(y0), float(x1), float(y1)) if inside else None


def _shadow(camera: FloorCamera, ball: Floats, slant: Floats, rng: np.random.Generator) -> Shadow:
    """The ellipse of the ball's shadow under a light of a slant (right, ahead)."""
    turns = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    stretch = np.eye(2) + np.outer(slant, slant) / (1 + math.sqrt(1 + float(slant @ slant)))
    rim = RADIUS * np.stack([np.cos(turns), np.sin(turns)], axis=1) @ stretch
    middle = ball[[0, 2]] + ball[1] * slant
    floor = np.stack([middle[0] + rim[:, 0], np.zeros(len(turns)), middle[1] + rim[:, 1]], axis=1)
    points = camera.project(camera.from_floor(floor))
    radius = RADIUS * camera.focal / float(camera.from_floor(ball[None])[0, 2])
    centre = points.mean(axis=0) + rng.normal(0, SHADOW_NOISE * radius, 2)
    spread = np.cov(points.T, bias=True) / 2 * np.exp(rng.normal(0, 2 * SHADOW_NOISE))
    (x0, y0), (x1, y1) = points.min(axis=0), points.max(axis=0)
    return Shadow(
        (float(x0), float(y0), float(x1), float(y1)),
        (float(centre[0]), float(centre[1])),
        (float(spread[0, 0]), float(spread[1, 1]), float(spread[0, 1])),
        0.2,
    )


def probability(throw: Throw, size: int) -> tuple[float, bool]:
    """That the ball meets the target, by stage 3; and whether it does in the likeliest world."""
    mask = CroppedMask.of(np.zeros((HEIGHT, WIDTH), bool))
    names = ["ball", "target", "other", "another"]
    bodies = tuple(
        SeenBody(name, box, mask, body.shape) for name, box, body in zip(names, throw.boxes, throw.bodies, strict=False)
    )
    scale = MetresPerPixel(value=3.0 / WIDTH, source="default")
    box = throw.boxes[0]
    motion = Motion(
        kind="projectile",
        law="contact",
        direction=throw.direction,
        direction_deviation=DIRECTION_DEVIATIONS["arrow"],
        depth_deviation=THROW_DEPTH_DEVIATION,
        cue="arrow",
        speed=Units(scale, WIDTH, "contact").speed_of(MotionRequest(kind="projectile"), box)[0],
        speed_deviation=SPEED_DEVIATIONS["projectile"],
        metres_per_pixel=scale,
        sentence="",
        source="embedded",
    )
    fit: CameraFit = fit_shadow(prior(), box, throw.shadow, (WIDTH, HEIGHT)) or prior()
    world = WorldInput(bodies, motion, fit, (WIDTH, HEIGHT), FRAMES, FPS)
    shown, rows = likeliest(), ensemble(size)
    single = find_world_events(run_world(world, shown), bodies, shown, (WIDTH, HEIGHT)).of[0]
    found = find_world_events(run_world(world, rows, 2), bodies, rows, (WIDTH, HEIGHT)).of[0]
    return float(np.isfinite(found.times["touches"][:, 1]).mean()), bool(np.isfinite(single.times["touches"][0, 1]))


def best_probability(throw: Throw, size: int, rng: np.random.Generator) -> float:
    """That the ball meets the target, for one who knows everything of `draw_throw` but heading, rise and speed."""
    ball, *others = throw.bodies
    place, sense = np.array(ball.position), math.copysign(1.0, ball.velocity[0])
    seen = math.atan2(throw.direction[1], throw.direction[0])
    rises = np.radians(np.arange(5, 33))
    worlds, weights = list[tuple[RigidShape, ...]](), list[float]()
    deviations = np.linspace(-4, 4, size)
    for deviation, speed in zip(deviations, rng.uniform(1.2, 2.4, size), strict=True):
        turn = math.radians(TURN_SIGMA) * deviation
        level = np.array([sense * math.cos(turn), 0.0, math.sin(turn)])
        ways = np.cos(rises)[:, None] * level + np.sin(rises)[:, None] * np.array([0.0, 1.0, 0.0])
        ends = throw.camera.project(throw.camera.from_floor(np.concatenate([place[None], place + 1e-3 * ways])))
        step = ends[1:] - ends[0]
        off = (np.degrees(np.arctan2(step[:, 1], step[:, 0]) - seen) + 180) % 360 - 180
        fits = np.exp(-0.5 * (off / DIRECTION_NOISE) ** 2)
        if fits.sum() > 1e-9:
            way = ways[rng.choice(len(rises), p=fits / fits.sum())]
            worlds.append((replace(ball, velocity=tuple((speed * way).tolist())), *others))
            weights.append(
                float(fits.sum())
                * math.exp(-0.5 * deviation**2)
                * _target_density(np.array(others[0].position) - place, level)
            )
    hits = [
        any(meeting.a == 0 and meeting.b == 1 for meeting in run.meetings) for run in run_worlds(worlds, FRAMES, FPS, 2)
    ]
    return float(np.average(hits, weights=weights))


def _target_density(away: Floats, level: Floats) -> float:
    """Of a target at a place from the ball, for a heading: half lie about on the way, half anywhere."""
    along, aside = away[0] * level[0] + away[2] * level[2], away[2] * level[0] - away[0] * level[2]
    ahead = math.exp(-0.5 * (aside / 0.15) ** 2) / (0.15 * math.sqrt(2 * math.pi)) / 1.2 if 0.6 < along < 1.8 else 0.0
    return 0.5 * ahead + 0.5 / (2.4 * 1.8)


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--wide", action="store_true", help="headings of up to 45 degrees out of the image")
    parser.add_argument("--ensemble", type=int, default=100)
    parser.add_argument("--bound", action="store_true", help="also what one could know at best (not with --wide)")
    parser.add_argument("--json", type=Path, default=None, help="write the figures here")
    arguments = parser.parse_args()
    rng = np.random.default_rng(arguments.seed)
    throws: list[Throw] = []
    while len(throws) < arguments.count:
        throw = draw_throw(rng, arguments.wide)
        if throw is not None:
            throws.append(throw)
    told, shown, times = [], [], []
    for throw in throws:
        started = time.process_time()
        likely, single = probability(throw, arguments.ensemble)
        times.append(1000 * (time.process_time() - started))
        told.append(likely)
        shown.append(single)
    truth = np.array([throw.hits for throw in throws])
    figures = summarise(np.array(told), np.array(shown), truth)
    figures["CPU per throw, median (ms)"] = round(statistics.median(times), 1)
    if arguments.bound and not arguments.wide:
        best = np.array([best_probability(throw, 160, rng) for throw in throws])
        figures["Brier score at best"] = summarise(best, (best >= 0.5).astype(float), truth)["Brier score"]
    for name, value in figures.items():
        print(f"{name}: {value}")
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(figures, indent=2) + "\n")
    return 0


def summarise(told: Floats, shown: Floats, truth: Floats) -> dict[str, Any]:
    """Scores of probabilities against what happens, and how well they are calibrated."""
    rate = float(truth.mean())
    sure = (told >= SURE) | (told <= 1 - SURE)
    right = (told >= 0.5) == truth
    certain = (told >= 0.9) | (told <= 0.1)
    figures: dict[str, Any] = {
        "throws": len(truth),
        "hits": int(truth.sum()),
        "Brier score": round(float(((told - truth) ** 2).mean()), 4),
        "Brier score of the base rate": round(rate * (1 - rate), 4),
        "answers given": f"{int(sure.sum())} of {len(truth)}",
        "right where given": f"{int(right[sure].sum())} of {int(sure.sum())}",
        "wrong with more than 0.9": f"{int((~right[certain]).sum())} of {int(certain.sum())}",
        "likeliest world right": f"{int((shown == truth).sum())} of {len(truth)}",
    }
    for low in np.arange(0, 1, 0.2):
        inside = (told >= low) & (told < low + 0.2 + 1e-9 * (low > 0.7))
        if inside.any():
            told_rate = f"{told[inside].mean():.2f} told, {truth[inside].mean():.2f} true"
            figures[f"of {int(inside.sum())} told {low:.1f} to {low + 0.2:.1f}"] = told_rate
    return figures


if __name__ == "__main__":
    sys.exit(main())
