"""What was measured in an image serves other questions about it, and changes no result."""

from __future__ import annotations

import numpy as np
import pytest
from drawn import ball, block, floor, trail
from runs import run_of

from cow_service.generators.cutout.generator import CutoutGenerator
from cow_service.pipeline import simulate
from cow_service.readers.embedded.reader import EmbeddedReader
from cow_service.records import Simulation
from cow_service.vision import scene as scenes
from cow_service.vision.scene import MOST_IMAGES, Scene, SeenImages

BALL, BOX = (160, 250), (420, 220, 480, 280)
PICTURE = block(ball(floor(), BALL, 30, (200, 40, 40)), BOX, (40, 60, 200))
QUESTIONS = (
    "If the red ball moves right, will it hit the blue block?",
    "If the blue block moves left, will it hit the red ball?",
    "If the red ball moves down, what happens?",
)


def asked(question: str, seen: SeenImages | None, pixels=PICTURE) -> Simulation:
    one = run_of(pixels, EmbeddedReader, CutoutGenerator, question=question, video=False, num_frames=17)
    with one.with_images(seen) as run:
        return simulate(run)


def told(simulation: Simulation) -> dict:
    return simulation.model_dump(exclude={"id", "created_at", "timings"})


def test_other_questions_about_an_image_measure_nothing_again(monkeypatch: pytest.MonkeyPatch) -> None:
    alone = [told(asked(question, None)) for question in QUESTIONS]
    seen = SeenImages()
    assert told(asked(QUESTIONS[0], seen)) == alone[0]
    for name in ("find_strokes", "find_trails", "find_regions"):
        monkeypatch.setattr(scenes, name, lambda *_: pytest.fail("it was measured before"))
    assert [told(asked(question, seen)) for question in QUESTIONS] == alone


def test_a_trail_leaves_what_depends_on_its_end_to_each_question() -> None:
    places = [(120.0, 250.0), (190.0, 250.0), (260.0, 250.0), (330.0, 250.0)]
    scene = Scene(trail(floor(), places, [26.0] * 4, (200, 40, 40), [0.3, 0.5, 0.75, 1.0]))
    assert scene.trails
    assert scene.regions
    seen, other = SeenImages(), Scene(scene.image)
    seen.keep(("mine", "a"), scene)
    seen.recall(("mine", "a"), other)
    assert "_all_trails" in other.__dict__
    assert not {"clean", "regions", "trails"} & set(other.__dict__)


def test_only_the_latest_images_are_kept() -> None:
    seen = SeenImages()
    for number in range(MOST_IMAGES + 1):
        scene = Scene(np.full((40, 60, 3), number, np.uint8))
        assert scene.arrows == ()
        seen.keep((None, str(number)), scene)
    first, last = Scene(PICTURE), Scene(PICTURE)
    seen.recall((None, "0"), first)
    seen.recall((None, str(MOST_IMAGES)), last)
    assert ("arrows" in first.__dict__, "arrows" in last.__dict__) == (False, True)
    others = Scene(PICTURE)
    seen.recall(("another key", str(MOST_IMAGES)), others)
    assert "arrows" not in others.__dict__
