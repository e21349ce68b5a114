"""The initial worlds of a result, for a program that runs them again elsewhere, as the page does while you drag.

Coordinates are metres right, above the floor and ahead, the camera above their origin. Of what differs between worlds
there is a list with a value for each, the likeliest world first; what is the same in all of them is one value.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from cow_service.media.types import Floats
from cow_service.physics import engine, events, lift
from cow_service.physics.ballistic import GRAVITY, Course
from cow_service.physics.bodies import SeenBody
from cow_service.physics.draws import COLUMN, ensemble, likeliest, quantiles
from cow_service.physics.engine import RigidShape
from cow_service.physics.ensemble import EVERY, OF_EACH, SURE, SURE_OF_MISS, Query
from cow_service.physics.layout import FARTHEST
from cow_service.physics.lift import LiftedBody
from cow_service.physics.world import CLOCK, DrawnWorlds, WorldInput

DIGITS = 6  # significant digits: the engine uses no more
CONSTANTS: dict[str, float] = {
    "gravity": GRAVITY,
    "clock": CLOCK,
    "every": EVERY,
    "engine_size": engine.ENGINE_SIZE,
    "most_gravity": engine.MOST_GRAVITY,
    "least_steps": engine.LEAST_STEPS,
    "least_steps_of_many": engine.LEAST_STEPS_OF_MANY,
    "floor_friction": engine.FLOOR_FRICTION,
    "floor_restitution": engine.FLOOR_RESTITUTION,
    "foreseen": engine.FORESEEN,
    "gap": engine.GAP,
    "least_waist": engine.LEAST_WAIST,
    "at_rest": engine.AT_REST,
    "at_start": engine.AT_START,
    "rests": engine.RESTS,
    "tipped": engine.TIPPED,
    "displaced": events.DISPLACED,
    "low": lift.LOW,
    "rise": lift.RISE,
    "rise_sigma": lift.RISE_SIGMA,
    "aimed": lift.AIMED,
    "aim_sigma": lift.AIM_SIGMA,
    "unusual": lift.UNUSUAL,
    "widest_turn": float(lift.TURNS[-1]),
    "turns": len(lift.TURNS),
    "turn_sigma": math.radians(lift.DIRECTION_DEVIATIONS["request"]),
    "sure": SURE,
    "sure_of_miss": SURE_OF_MISS,
    "farthest": FARTHEST,
}
"""What runs the worlds elsewhere computes with; the names are those of the constants here."""


def live_worlds(world: WorldInput, query: Query | None, size: int) -> dict[str, Any] | None:
    """The likeliest world and an ensemble of `size` worlds as JSON values; None of what no drag can change.

    That is what something is put somewhere in, what follows a path or passes through everything, what does not move
    along a direction, and what is taken to be as deep as its heading says.
    """
    motion = world.motion
    is_bound = world.placement is not None or world.placed_before or world.prescribed is not None
    has_heading = world.bodies[0].elongated and world.level is None and world.measured is None
    if is_bound or has_heading or motion.direction is None or motion.speed == 0:
        return None
    draws = likeliest() if size == 0 else np.concatenate([likeliest(), ensemble(size)])
    drawn = DrawnWorlds.of(world, draws, EVERY)
    layout, shapes = drawn.layout, drawn.shapes(slice(0, len(draws)))
    cameras, courses = layout.cameras, [shape[0].course for shape in shapes]
    return {
        "size": list(world.size),
        "fps": world.fps,
        "num_frames": world.num_frames,
        "horizon": world.horizon,
        "worlds": size,
        "constants": CONSTANTS,
        "cameras": {
            "focal": _column(cameras.focal),
            "axes": [_column(cameras.axes.reshape(len(draws), 9)[:, place]) for place in range(9)],
            "height": _column(cameras.height),
        },
        "bodies": [
            _body(seen, [shape[i] for shape in shapes], layout.supports[i]) for i, seen in enumerate(world.bodies)
        ],
        "mover": _mover(world, layout.bodies[0], draws),
        "course": _course([course for course in courses if course is not None]),
        "asked": _asked(query),
    }


def _mover(world: WorldInput, mover: LiftedBody, draws: Floats) -> dict[str, Any]:
    """How the mover sets out in each world."""
    motion, factors = world.motion, lift.speed_factors(world.motion, draws, "speed")
    return {
        "start": list(world.bodies[0].start),
        "foot": list(world.bodies[0].foot),
        "kind": motion.kind,
        "stands": mover.stands,
        "rises": motion.rises,
        "is_side_view": world.level is not None,
        "seen_half_width": _column(mover.half_width),
        "depth_share": _column(np.broadcast_to(mover.depth_share, len(draws))),
        "direction": list(motion.direction or ()),
        "depth": motion.depth,
        "metres_per_pixel": motion.metres_per_pixel.value,
        "depth_sigma": math.radians(motion.depth_deviation),
        "speed": _column(motion.speed * motion.metres_per_pixel.value * factors),
        "turn": _column(draws[:, COLUMN["turn"]]),
        "heading": _column(quantiles(draws[:, COLUMN["depth"]])),
    }


MEASURES = "half_width", "half_depth", "half_height", "yaw", "density", "friction", "restitution", "base", "waist"


def _body(seen: SeenBody, starts: list[RigidShape], support: int | None) -> dict[str, Any]:
    """A body as each world has it at the start."""
    first = starts[0]
    return {
        "name": seen.name,
        "bbox": list(seen.bbox),
        "shape": first.shape,
        **{name: _column([getattr(start, name) for start in starts]) for name in MEASURES},
        "middle": None if first.middle is None else _column([start.middle or 0.0 for start in starts]),
        "position": [_column([start.position[axis] for start in starts]) for axis in range(3)],
        "velocity": [_column([start.velocity[axis] for start in starts]) for axis in range(3)],
        "starts": first.starts,
        "glides": first.glides,
        "falls": first.falls,
        "fixed": first.fixed,
        "pieces": [np.round(corners, DIGITS).tolist() for corners in first.pieces],
        "support": support,
    }


def _course(courses: list[Course]) -> dict[str, Any] | None:
    """What the mover does until it meets something, where it has several legs or an end; null: a leg goes on."""
    if not courses:
        return None
    legs = zip(*(course.legs for course in courses), strict=True)
    return {
        "halts": courses[0].halts,
        "legs": [
            {
                "duration": None if math.isinf(leg[0].duration) else _column([each.duration for each in leg]),
                "velocity": [_column([each.velocity[axis] for each in leg]) for axis in range(3)],
            }
            for leg in legs
        ],
    }


def _asked(query: Query | None) -> dict[str, Any] | None:
    """What is asked, where the worlds themselves can tell."""
    if query is None or not query.is_decidable or query.asked.form in OF_EACH:
        return None
    asked = query.asked.model_dump(include={"relation", "form", "negated", "every", "within"})
    return asked | {"target": query.target, "subject": query.subject, "among": list(query.among)}


def _column(values: Floats | list[float]) -> Any:
    """One value where all are the same, else a list of them."""
    rounded = [float(f"{value:.{DIGITS}g}") for value in np.asarray(values, np.float64).tolist()]
    return rounded[0] if len(set(rounded)) == 1 else rounded
