"""The motion that a trail shows, in the terms of the stages."""

from __future__ import annotations

import math

from cow_service.physics.dynamics import GRAVITY
from cow_service.physics.trail_fit import fit_throw, straight_direction
from cow_service.records import Grounding, Motion
from cow_service.requests import CameraRequest
from cow_service.stages.camera import camera_of
from cow_service.vision.scene import Scene
from cow_service.vision.trails import Trail, trail_of


def along_trail(
    scene: Scene, grounding: Grounding, motion: Motion, camera: CameraRequest | None, speed_given: bool
) -> Motion:
    """A motion read from a trail, with what the trail at the mover measures; others unchanged."""
    trail = trail_of(scene.trails, grounding.bbox) if motion.cue == "trail" else None
    if trail is None:
        return motion
    motion = motion.model_copy(update={"trail": tuple(position.centre for position in trail.older)})
    if motion.kind == "projectile":
        return _thrown(scene, grounding, motion, trail, camera, speed_given)
    if motion.kind == "linear":
        return motion.model_copy(update={"direction": straight_direction(trail.positions)})
    return motion


def _thrown(
    scene: Scene, grounding: Grounding, motion: Motion, trail: Trail, camera: CameraRequest | None, speed_given: bool
) -> Motion:
    """Speed, direction and depth of the throw at the present position, with their deviations."""
    fit = camera_of(scene, motion, camera, grounding.bbox, fixed_focal=False)
    throw = fit_throw(trail.positions, fit, (scene.width, scene.height))
    if throw is None:
        return motion
    measured: dict[str, object] = {
        "direction": throw.direction,
        "depth": math.sin(math.radians(throw.turn)),
        "depth_deviation": min(throw.turn_deviation, 90.0),
    }
    if not speed_given:
        x0, y0, x1, y1 = grounding.bbox
        radius = (x1 - x0 + y1 - y0) / 4  # px
        measured["speed"] = math.sqrt(throw.froude * GRAVITY * radius / motion.metres_per_pixel.value)
        measured["speed_deviation"] = min(throw.speed_deviation, 3.0)
    return motion.model_copy(update=measured)
