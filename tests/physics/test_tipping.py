"""What a hit knocks over: narrow feet, high centres of mass, and how uncertain worlds are of them."""

from __future__ import annotations

import itertools
import math

import cv2
import numpy as np
import pytest
from floors import TrueCamera, known
from worlds import rigid

from cow_service.physics.bodies import SeenBody
from cow_service.physics.engine import RigidShape, run_worlds
from cow_service.physics.ensemble import Query, run_ensemble
from cow_service.physics.world import WorldInput
from cow_service.records import Asked, MetresPerPixel, Motion
from cow_service.vision.masks import CroppedMask

CAMERA = TrueCamera(pitch=25, height=1.5)
# Radius and height of the rims from the floor up, m.
VASE = [(0.07, 0.0), (0.13, 0.08), (0.15, 0.2), (0.12, 0.3), (0.07, 0.4), (0.11, 0.5)]
BOTTLE = [(0.1, 0.0), (0.1, 0.3), (0.04, 0.4), (0.04, 0.55)]
CAN = [(0.12, 0.0), (0.12, 0.35)]


def turned(name: str, profile: list[tuple[float, float]], right: float, ahead: float) -> SeenBody:
    """What turns to a profile, as the camera sees it."""
    angles, mask = np.linspace(0, 2 * np.pi, 48), np.zeros((400, 640), np.uint8)
    rings = [
        CAMERA.seen(np.stack([right + r * np.cos(angles), np.full(48, h), ahead + r * np.sin(angles)], axis=1))
        for r, h in profile
    ]
    for low, high in itertools.pairwise(rings):
        hull = cv2.convexHull(np.concatenate([low, high]).astype(np.float32))
        cv2.fillConvexPoly(mask, hull.round().astype(np.int32), 1)
    rows, columns = np.nonzero(mask)
    box = (float(columns.min()), float(rows.min()), float(columns.max() + 1), float(rows.max() + 1))
    return SeenBody(name, box, CroppedMask.of(mask > 0), "cylinder")


def sine_at(ahead: float) -> float:
    return 1.5 / math.hypot(1.5, ahead)


def test_an_outline_tells_on_what_a_thing_stands_and_where_its_weight_is() -> None:
    vase, bottle, can = (turned("it", profile, 0.0, 3.0) for profile in (VASE, BOTTLE, CAN))
    base, waist = vase.stance(sine_at(3.0))
    assert base == pytest.approx(0.07 / 0.15, abs=0.12)
    assert 0.02 < waist < 0.2
    assert bottle.stance(sine_at(3.0))[0] == pytest.approx(1.0, abs=0.05)
    assert can.stance(sine_at(3.0))[0] == pytest.approx(1.0, abs=0.05)
    assert bottle.middle < can.middle - 0.05


def falls_over(body: RigidShape, speed: float) -> bool:
    ball = rigid(velocity=(speed, 0.0, 0.0), starts=True, glides=True)
    turns = run_worlds([[ball, body]], 65, 16.0)[0].turns[1]
    return bool((1 - 2 * (turns[:, 0] ** 2 + turns[:, 2] ** 2) < math.cos(math.pi / 4)).any())


def test_a_narrow_foot_and_a_high_centre_of_mass_make_a_thing_fall() -> None:
    wide = rigid("cylinder", 0.12, 0.3, position=(0.6, 0.3, 0.0), middle=0.5)
    narrow = rigid("cylinder", 0.12, 0.3, position=(0.6, 0.3, 0.0), middle=0.5, base=0.4, waist=0.1)
    heavy_above = rigid("cylinder", 0.12, 0.3, position=(0.6, 0.3, 0.0), middle=0.75)
    assert [falls_over(body, 1.5) for body in (wide, narrow)] == [False, True]
    speeds = [1.0, 1.5, 2.0, 2.5, 3.0, 3.5]
    assert sum(falls_over(heavy_above, v) for v in speeds) > sum(falls_over(wide, v) for v in speeds)
    for body in (wide, narrow, heavy_above):
        assert run_worlds([[body]], 17, 16.0)[0].positions[0, -1] == pytest.approx(body.position, abs=0.01), "it stands"


def test_worlds_disagree_on_whether_a_vase_falls() -> None:
    mover = turned("can", [(0.12, 0.0), (0.12, 0.3)], -0.8, 3.0)
    answers: dict[str, float] = {}
    for name, profile in (("vase", VASE), ("disc", [(0.2, 0.0), (0.2, 0.1)])):
        scale = CAMERA.positions(np.array([[-0.8, 0.15, 3.0]]))[0, 2] / CAMERA.focal
        motion = Motion(
            kind="linear", law="contact", direction=(1.0, 0.0), cue="request", speed=1.8 / scale, sentence="",
            speed_deviation=0.25, metres_per_pixel=MetresPerPixel(value=scale, source="request"), source="request",
        )  # fmt: skip
        bodies = mover, turned(name, profile, 0.3, 3.0)
        world = WorldInput(bodies, motion, known(CAMERA, 0.02), CAMERA.size, 65, 16.0, turns_wanted=True)
        query = Query(Asked(relation="tips", target=name), 1)
        decided = run_ensemble(world, query, 60)[0].decided
        assert decided is not None
        answers[name] = decided.probability or 0.0
    assert 0.1 < answers["vase"] < 0.9
    assert answers["disc"] < 0.1
