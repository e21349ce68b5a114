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
from cow_service.vision.scene import MOST_IMAGES, MOST_PIXELS, Scene, SeenImages

BALL, BOX = (160, 250), (420, 220, 480, 280)
PICTURE = block(ball(floor(), BALL, 30, (200, 40, 40)), BOX, (40, 60, 200))
QUESTIONS = (
    "If the red ball moves right, will it hit the blue block?",
    "If the blue block moves left, will it hit the red ball?",
)


def asked(question: str, seen: SeenImages | None, pixels=PICTURE) -> Simulation:
    one = run_of(pixels, EmbeddedReader, CutoutGenerator, question=question, video=False, num_frames=17)
    with one.with_images(seen) as run:
        return simulate(run)


def told(simulation: Simulation) -> dict:
    return simulation.model_dump(exclude={"id", "created_at", "timings"})


@pytest.mark.slow
def test_other_questions_about_an_image_measure_nothing_again(monkeypatch: pytest.MonkeyPatch) -> None:
    alone = [told(asked(question, None)) for question in QUESTIONS]
    seen = SeenImages()
    assert told(asked(QUESTIONS[0], seen)) == alone[0]
    for name in ("find_strokes", "find_regions"):
        monkeypatch.setattr(scenes, name, lambda *_: pytest.fail("it was measured before"))
    assert told(asked(QUESTIONS[1], seen)) == alone[1]


def test_a_trail_leaves_what_depends_on_its_end_to_each_question() -> None:
    places = [(120.0, 250.0), (190.0, 250.0), (260.0, 250.0), (330.0, 250.0)]
    scene = Scene(trail(floor(), places, [26.0] * 4, (200, 40, 40), [0.3, 0.5, 0.75, 1.0]), trail_named=True)
    assert scene.trails
    assert scene.regions
    seen, other = SeenImages(), Scene(scene.image, trail_named=True)
    seen.keep(("mine", "a"), scene)
    seen.recall(("mine", "a"), other)
    assert other.measured() == scene.measured() != {}
    assert not {"clean", "regions", "trails"} & set(other.measured())
    without = Scene(scene.image)
    assert len(without.regions) > len(scene.regions)
    seen.keep(("mine", "a"), without)
    seen.recall(("mine", "a"), again := Scene(scene.image, trail_named=True))
    assert len(again.regions) == len(scene.regions)


def recalled(seen: SeenImages, owner: str | None, digest: str) -> bool:
    scene = Scene(PICTURE)
    seen.recall((owner, digest), scene)
    return scene.measured() != {}


def test_only_the_latest_images_are_kept_each_for_its_owner_alone() -> None:
    seen, tiny = SeenImages(), Scene(np.zeros((40, 60, 3), np.uint8))
    assert tiny.arrows == ()
    for number in range(MOST_IMAGES):
        seen.keep(("mine", str(number)), tiny)
    assert recalled(seen, "mine", "0")  # which makes it the latest
    seen.keep(("mine", "one more"), tiny)
    assert [recalled(seen, "mine", each) for each in ("0", "1", "2", "one more")] == [True, False, True, True]
    assert not recalled(seen, None, "0")
    large = Scene(np.broadcast_to(np.uint8(0), (1, MOST_PIXELS - 2400, 3)))
    seen.keep(("mine", "large"), large)
    assert [recalled(seen, "mine", each) for each in ("2", "one more")] == [False, True]
