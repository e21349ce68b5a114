"""Which way a vehicle faces: model cars drawn at known turns, an example, and what is refused."""

from __future__ import annotations

import json
import math

import cv2
import numpy as np
import pytest
from conftest import DATA, example
from drawn import angle_between, floor
from hypothesis import given, settings
from hypothesis import strategies as st
from runs import run_of

from cow_service.media.masks import bbox_of, iou
from cow_service.media.types import Image, Mask
from cow_service.perception.classical.facing import DARK, OTHER, PAINT, VehicleModel, facing
from cow_service.perception.observation import look
from cow_service.physics.camera import FloorCamera
from cow_service.readers.embedded.reader import EmbeddedReader
from cow_service.stages.grounding import ground
from cow_service.stages.motion import settle_motion

pytestmark = pytest.mark.slow

WIDTH, HEIGHT = 640, 400
COLOURS = {PAINT: (190, 40, 40), DARK: (18, 18, 18), OTHER: (110, 125, 145)}


def drawn_car(yaw: float, pitch: float) -> tuple[Image, Mask, tuple[float, float]]:
    """A picture of the model car, its mask, and the way that it faces."""
    camera = FloorCamera(WIDTH, HEIGHT, 0.95 * WIDTH, pitch, 0.0, 1.0)
    model = VehicleModel.fitted(camera, (250.0, 160.0, 420.0, 280.0), yaw)
    assert model is not None
    labels = model.drawn((0, 0), 1.0, (HEIGHT, WIDTH))
    image = floor(WIDTH, HEIGHT)
    for label, colour in COLOURS.items():
        image[labels == label] = colour
    x, y = model.ahead.tolist()
    return np.asarray(cv2.GaussianBlur(image, (3, 3), 0.8), np.uint8), labels > 0, (x, y)


@settings(max_examples=6)
@given(st.floats(0, 2 * math.pi), st.floats(math.radians(22), math.radians(36)))
def test_a_drawn_car_faces_the_way_that_it_was_turned(yaw: float, pitch: float) -> None:
    image, mask, way = drawn_car(yaw, pitch)
    told = facing(image, mask, bbox_of(mask))
    assert told is not None
    # Straight away from the camera, degrees of the turn are many in the image.
    assert angle_between(told, way) <= (6 if abs(math.cos(yaw)) > 0.5 else 40)


def test_paint_alone_does_not_tell_the_front() -> None:
    """Without glass, lamps and tyres, a block of one colour fits several ways as well as one."""
    image, mask = floor(WIDTH, HEIGHT), np.zeros((HEIGHT, WIDTH), bool)
    mask[170:280, 250:420] = True
    image[mask] = COLOURS[PAINT]
    assert facing(image, mask, bbox_of(mask)) is None


@pytest.mark.parametrize(("word", "sense"), [("forward", 1), ("backward", -1)])
def test_forward_and_backward_are_the_way_that_the_car_of_an_example_faces(word: str, sense: int) -> None:
    car = example("car-forward")
    run = run_of(
        car.pixels("image.jpg"),
        reader=EmbeddedReader,
        question=f"If the red toy car moves {word}, what happens?",
        grounding={"object": "red toy car", "bbox": car.meta["bbox"]},
    )
    motion = run.stage("motion", settle_motion, run.stage("grounding", ground), None)
    x, y = car.meta["direction"]
    assert motion.cue == "orientation"
    assert motion.direction is not None
    assert angle_between(motion.direction, (sense * x, sense * y)) <= 5


VEHICLES = DATA / "vehicles"  # rendered, with where they truly are and face
TRUTH = json.loads((VEHICLES / "truth.json").read_text())


@pytest.mark.parametrize("name", sorted(TRUTH))
def test_a_rendered_car_is_whole_and_faces_its_way(name: str) -> None:
    """Its wheels, and the shade between them, belong to it: else it would meet them where it stands."""
    truth = TRUTH[name]
    pixels = cv2.imread(str(VEHICLES / f"{name}.jpg"))
    assert pixels is not None
    scene = look(np.asarray(cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB), np.uint8))
    region = scene.thing_in(tuple(truth["bbox"]))
    assert region is not None
    assert iou(region.bbox, tuple(truth["bbox"])) > 0.8
    assert not any(iou(other.bbox, region.bbox) > 0 for other in scene.obstacles(region.bbox))
    way = facing(scene.clean, scene.mask_in(region.bbox).full(), region.bbox)
    assert way is not None
    assert angle_between(way, tuple(truth["direction"])) <= 10
