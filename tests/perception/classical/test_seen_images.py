"""What was seen in an image serves other questions about it, and changes no result."""

from __future__ import annotations

from contextlib import suppress

import numpy as np
import pytest
from drawn import ball, block, floor, trail
from runs import run_of

from cow_service.errors import CowError
from cow_service.generators.cutout.generator import CutoutGenerator
from cow_service.perception import observation
from cow_service.perception.observation import MOST_IMAGES, MOST_PIXELS, SeenImages, look
from cow_service.pipeline import simulate
from cow_service.readers.embedded.reader import EmbeddedReader
from cow_service.records import Simulation

BALL, BOX = (160, 250), (420, 220, 480, 280)
PICTURE = block(ball(floor(), BALL, 30, (200, 40, 40)), BOX, (40, 60, 200))
QUESTIONS = (
    "If the red ball moves right, will it hit the blue block?",
    "If the blue block moves left, will it hit the red ball?",
)


def asked(question: str, seen: SeenImages | None, pixels=PICTURE) -> Simulation:
    run = run_of(pixels, EmbeddedReader, CutoutGenerator, question=question, video=False, num_frames=17)
    run.share(seen)
    return simulate(run)


def told(simulation: Simulation) -> dict:
    return simulation.model_dump(exclude={"id", "created_at", "timings"})


@pytest.mark.slow
def test_other_questions_about_an_image_find_nothing_again(monkeypatch: pytest.MonkeyPatch) -> None:
    alone = [told(asked(question, None)) for question in QUESTIONS]
    seen = SeenImages()
    assert told(asked(QUESTIONS[0], seen)) == alone[0]
    for name in ("find_strokes", "find_regions"):
        monkeypatch.setattr(observation, name, lambda *_: pytest.fail("it was found before"))
    assert told(asked(QUESTIONS[1], seen)) == alone[1]


def test_trails_are_seen_apart_where_somebody_speaks_of_them() -> None:
    places = [(120.0, 250.0), (190.0, 250.0), (260.0, 250.0), (330.0, 250.0)]
    image = trail(floor(), places, [26.0] * 4, (200, 40, 40), [0.3, 0.5, 0.75, 1.0])
    seen = SeenImages()
    plain, with_trails = (seen.look(("mine", "a"), lambda: image, trails) for trails in (False, True))
    assert plain.trails == ()
    assert len(with_trails.trails) == 1
    assert len(plain.things) > len(with_trails.things)
    assert plain.clean is plain.undrawn is with_trails.undrawn is not with_trails.clean
    assert [seen.look(("mine", "a"), lambda: image, trails) for trails in (False, True)] == [plain, with_trails]


def test_only_the_latest_images_are_kept_each_for_its_owner_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    looked = list[tuple[int, ...]]()
    monkeypatch.setattr(observation, "look", lambda image, **_: looked.append(image.shape) or look(image))
    seen, tiny = SeenImages(), np.zeros((40, 60, 3), np.uint8)

    def is_kept(owner: str | None, digest: str) -> bool:
        looked.clear()
        seen.look((owner, digest), lambda: tiny)
        return not looked

    for number in range(MOST_IMAGES):
        assert not is_kept("mine", str(number))
    assert is_kept("mine", "0")  # which makes it the latest
    assert not is_kept("mine", "one more")
    assert [is_kept("mine", each) for each in ("0", "2", "one more", "1")] == [True, True, True, False]
    assert not is_kept(None, "0")
    large = np.broadcast_to(np.uint8(0), (1, MOST_PIXELS - 2400, 3))
    seen.look(("mine", "large"), lambda: large)
    assert [is_kept("mine", each) for each in ("0", "1")] == [False, False]


@pytest.mark.parametrize(
    "request_",
    [
        {},
        {"question": QUESTIONS[0].replace("hit the blue block", "hit the blue block if its trail is followed")},
        {"grounding": {"bbox": (130, 220, 190, 280)}, "objects": [{"object": "blue block", "bbox": BOX}]},
        {"question": "If the blue block is removed and the red ball moves right, will it hit the wall?"},
    ],
)
def test_no_run_changes_what_others_see(request_: dict) -> None:
    seen = SeenImages()
    run = run_of(
        PICTURE,
        EmbeddedReader,
        CutoutGenerator,
        **{"question": QUESTIONS[0], "video": False, "num_frames": 17} | request_,
    )
    run.share(seen)
    with suppress(CowError):
        simulate(run)
    found, fresh = seen.look((None, run.image.info.sha256), lambda: run.image.pixels), look(PICTURE)
    for name in ("image", "cues", "undrawn", "clean"):
        assert np.array_equal(getattr(found, name), getattr(fresh, name)), name
    assert [(each.bbox, each.colour, each.mask.area) for each in found.things] == [
        (each.bbox, each.colour, each.mask.area) for each in fresh.things
    ]
    assert (found.masks, found.trails, found.arrows, found.boxes) == ({}, (), (), ())
