"""Objects put into, onto, between and next to others, on drawn scenes: the results, and how they are shown."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from drawn import Image, ball, block, bowl, floor
from runs import run_of

from cow_service.errors import CannotGround
from cow_service.generators.base import GeneratorInput
from cow_service.generators.cutout import CutoutGenerator, CutoutOptions
from cow_service.narration.summary import narrate
from cow_service.readers.embedded.reader import EmbeddedReader
from cow_service.records import Asked, Grounding, Intervention, LocatedObject, Motion, Trajectory
from cow_service.stages.grounding import understood
from cow_service.stages.motion import read_motion
from cow_service.stages.reconstruction import obstacles_of
from cow_service.stages.run import Run
from cow_service.stages.trajectory import compute_trajectory

RED, BLUE, GREEN = (200, 30, 30), (40, 60, 200), (40, 160, 60)
SMALL, BIG = (125.0, 265.0, 175.0, 315.0), (60.0, 180.0, 250.0, 370.0)
BOWL = (349.0, 204.0, 492.0, 309.0)
NEAR, FAR = (380.0, 230.0, 460.0, 330.0), (520.0, 230.0, 600.0, 330.0)
FRAMES = 49


def ball_at(image: Image, box: tuple[float, float, float, float]) -> Image:
    return ball(image, ((box[0] + box[2]) / 2, (box[1] + box[3]) / 2), (box[2] - box[0]) / 2, RED)


def with_bowl(box: tuple[float, float, float, float]) -> Image:
    return ball_at(bowl(floor(), (420, 240), 70, 50, BLUE), box)


def blocks(*boxes: tuple[float, float, float, float]) -> Image:
    image = floor()
    for box, colour in zip(boxes, (BLUE, GREEN), strict=False):
        image = block(image, tuple(int(side) for side in box), colour)
    return ball_at(image, SMALL)


def located(name: str, bbox: tuple[float, float, float, float]) -> LocatedObject:
    return LocatedObject(object=name, bbox=bbox, source="request")


def put(
    image: Image,
    relation: str,
    *targets: LocatedObject,
    mover=SMALL,
    name: str = "red ball",
    asked: Asked | None = None,
    **request: Any,
) -> tuple[Run, Grounding, Motion, Trajectory]:
    """Stages 2 and 3 of a ball that is put somewhere."""
    run = run_of(image, **({"num_frames": FRAMES, "ensemble": 20} | request))
    placed = Intervention(kind="place", object=located(name, mover), relation=relation, targets=targets)
    middle = (mover[0] + mover[2]) / 2, (mover[1] + mover[3]) / 2
    grounding = Grounding(object=name, point=middle, bbox=mover, interventions=(placed,), source="request")
    grounding = grounding.model_copy(update={"asked": asked})
    grounding = understood(grounding, EmbeddedReader())
    motion = read_motion(run, grounding, None).value
    return run, grounding, motion, compute_trajectory(run, grounding, motion).value


def frame(told: tuple[Run, Grounding, Motion, Trajectory], index: int) -> Image:
    run, grounding, motion, trajectory = told
    obstacles, _ = obstacles_of(run.scene, grounding)
    given = GeneratorInput(run.scene, grounding, motion, trajectory, obstacles, 0, CutoutOptions())
    return next(CutoutGenerator().render(given, [index], lambda done: None))


def is_red(pixel: Any) -> bool:
    return int(pixel[0]) > int(pixel[2]) + 40


class TestInto:
    def test_a_small_ball_fits_into_a_bowl(self) -> None:
        _, _, motion, told = put(with_bowl(SMALL), "into", located("blue bowl", BOWL))
        assert (motion.kind, motion.direction, motion.speed) == ("place", None, 0)
        assert "put into the blue bowl" in motion.sentence
        assert told.placement is not None
        assert told.placement.result == "inside"
        assert told.placement.fits is not None
        assert told.placement.fits > 0.9
        assert sum(told.placement.probabilities.values()) == pytest.approx(1)
        assert told.placement.clearance == pytest.approx(1 - 50 / (0.9 * 140), abs=0.1)
        assert told.path.points[0] == (150, 290)
        assert [path.body for path in told.paths] == [0]
        x, y = told.path.points[-1]
        assert abs(x - 420) < 15
        assert 215 < y < 275
        assert min(point[1] for point in told.path.points) < 200  # it comes from above
        touched = next(each for each in told.encounters if each.kind == "touches")
        assert touched.first_frame >= 15  # nothing is touched while it is carried

    def test_it_is_told_in_a_sentence(self) -> None:
        _, grounding, _, told = put(with_bowl(SMALL), "into", located("blue bowl", BOWL))
        narration = narrate(grounding, told, "en")
        assert narration.story.startswith("The red ball is carried over, is released and goes in and stays inside")
        assert told.ensemble < 20, "what all of the first worlds agree on is settled"
        assert narration.summary.endswith(f" All {told.ensemble} simulated versions agree.")

    def test_a_large_one_does_not(self) -> None:
        _, _, _, told = put(with_bowl(BIG), "into", located("blue bowl", BOWL), mover=BIG)
        assert told.placement is not None
        assert told.placement.result == "on-the-rim"
        assert told.placement.fits is not None
        assert told.placement.fits < 0.1
        assert told.placement.clearance is not None
        assert told.placement.clearance < 0
        assert told.placement.above_rim is not None
        assert told.placement.above_rim > 0.5

    @pytest.mark.parametrize(("width", "sure"), [(60, True), (116, False), (140, False), (230, True)])
    def test_what_is_about_as_wide_as_the_opening_is_not_sure(self, width: int, sure: bool) -> None:
        """Two outlines at two depths do not tell which of two like widths is the larger."""
        box = (150 - width / 2, 290 - width / 2, 150 + width / 2, 290 + width / 2)
        asked = Asked(relation="inside", target="blue bowl")
        told = put(with_bowl(box), "into", located("blue bowl", BOWL), mover=box, asked=asked, ensemble=50)[3]
        assert told.outcome is not None
        assert told.outcome.sure == sure
        assert sure or 0.1 < (told.outcome.probability or 0.0) < 0.85

    def test_without_an_ensemble_nothing_is_said_of_probabilities(self) -> None:
        told = put(with_bowl(SMALL), "into", located("blue bowl", BOWL), ensemble=0)[3]
        assert told.placement is not None
        assert (told.placement.result, told.placement.fits, told.placement.probabilities) == ("inside", None, {})

    def test_the_same_request_gives_the_same_trajectory(self) -> None:
        first, again = (put(with_bowl(SMALL), "into", located("blue bowl", BOWL))[3] for _ in range(2))
        assert first == again

    @pytest.mark.parametrize("frames", [2, 9])
    def test_a_short_clip_tells_the_same(self, frames: int) -> None:
        told = put(with_bowl(SMALL), "into", located("blue bowl", BOWL), num_frames=frames)[3]
        assert told.placement is not None
        assert told.placement.result == "inside"
        assert len(told.path.points) == frames

    def test_it_is_drawn_behind_the_front_wall_and_before_the_back(self) -> None:
        told = put(with_bowl(SMALL), "into", located("blue bowl", BOWL))
        last, image = frame(told, FRAMES - 1), told[0].scene.image
        x, y = told[3].path.points[-1]
        assert is_red(last[int(y) - 8, int(x)])
        front = image[285, 380:460].astype(int)  # the wall below the nearer rim
        assert np.abs(last[285, 380:460].astype(int) - front).max() < 12
        assert not is_red(last[290, 150])  # it is gone from its place
        carried = frame(told, 8)
        over_x, over_y = told[3].path.points[8]
        assert is_red(carried[int(over_y), int(over_x)])


class TestElsewhere:
    def test_on_top_it_stays_and_from_a_ball_it_falls(self) -> None:
        told = put(blocks(NEAR), "onto", located("blue cube", NEAR))[3]
        assert told.placement is not None
        assert told.placement.result == "on-top"
        assert told.path.points[-1][1] < 260
        round_one = ball(ball_at(floor(), SMALL), (420, 280), 50, BLUE)
        fallen = put(round_one, "onto", located("blue ball", (370.0, 230.0, 470.0, 330.0)))[3]
        assert fallen.placement is not None
        assert fallen.placement.result == "falls-off"
        assert fallen.placement.fits == 0

    def test_a_gap_holds_what_is_narrower(self) -> None:
        targets = located("blue cube", NEAR), located("green cube", FAR)
        told = put(blocks(NEAR, FAR), "between", *targets)[3]
        assert told.placement is not None
        assert told.placement.result == "beside"
        assert told.placement.clearance is not None
        assert 0 < told.placement.clearance < 1
        assert 460 < told.path.points[-1][0] < 520
        closer = (470.0, 230.0, 550.0, 330.0)
        narrow = put(blocks(NEAR, closer), "between", located("blue cube", NEAR), located("green cube", closer))[3]
        assert narrow.placement is not None
        assert narrow.placement.result == "overlaps"
        assert narrow.placement.fits == 0

    @pytest.mark.parametrize(
        ("relation", "across", "lower"),
        [("left-of", -1, 0), ("right-of", 1, 0), ("in-front-of", 0, 1), ("behind", 0, -1), ("next-to", -1, 0)],
    )
    def test_beside_is_as_the_camera_sees_it(self, relation: str, across: int, lower: int) -> None:
        told = put(blocks(NEAR), relation, located("blue cube", NEAR))[3]
        assert told.placement is not None
        assert told.placement.result == "beside"
        assert "touches" not in {each.kind for each in told.encounters}
        (x, y), scale = told.path.points[-1], told.path.scale[-1]
        foot = y + 25 * scale
        assert np.sign(round((x - 420) / 45)) == across
        if lower:
            assert np.sign(foot - 330) == lower

    def test_next_to_is_where_there_is_room(self) -> None:
        hidden = (300.0, 230.0, 375.0, 330.0)
        told = put(blocks(NEAR, hidden), "next-to", located("blue cube", NEAR))[3]
        assert told.placement is not None
        assert told.placement.result == "beside"
        assert told.path.points[-1][0] > 460


class TestWhatCannotBe:
    def test_into_what_is_no_container(self) -> None:
        with pytest.raises(CannotGround, match="'blue cube' is not an open container"):
            put(blocks(NEAR), "into", located("blue cube", NEAR))

    def test_into_what_shows_no_opening(self) -> None:
        with pytest.raises(CannotGround, match="'blue thing' shows no opening"):
            put(blocks(NEAR), "into", located("blue thing", NEAR))

    def test_an_opening_that_is_seen_needs_no_noun(self) -> None:
        told = put(with_bowl(SMALL), "into", located("blue thing", BOWL))[3]
        assert told.placement is not None
        assert told.placement.result == "inside"

    def test_into_itself(self) -> None:
        with pytest.raises(CannotGround, match="itself"):
            put(with_bowl(SMALL), "into", located("red ball", SMALL))

    def test_between_one_thing(self) -> None:
        with pytest.raises(CannotGround, match="at one place"):
            put(blocks(NEAR), "between", located("blue cube", NEAR), located("cube", NEAR))

    def test_nowhere(self) -> None:
        run = run_of(with_bowl(SMALL), motion={"kind": "place"}, num_frames=FRAMES)
        grounding = Grounding(object="red ball", point=(150, 290), bbox=SMALL, source="request")
        motion = read_motion(run, grounding, None).value
        with pytest.raises(CannotGround, match="Nothing says where 'red ball' goes"):
            compute_trajectory(run, grounding, motion)
