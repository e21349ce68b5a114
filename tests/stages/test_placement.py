"""Objects put into, onto, between and next to others, on drawn scenes: the results, and how they are shown."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from drawn import Image, ball, block, bowl, floor
from refusals import refused
from runs import run_of
from staged import BLUE, GREEN, RED, computed, is_red

from cow_service.generators.base import GeneratorInput
from cow_service.generators.cutout import CutoutGenerator, CutoutOptions
from cow_service.readers.embedded.reader import EmbeddedReader
from cow_service.records import Asked, Grounding, Intervention, LocatedObject, Placement, Trajectory
from cow_service.stages.generation import scene_of
from cow_service.stages.grounding import understood
from cow_service.stages.motion import settle_motion
from cow_service.stages.seeing import obstacles_of
from cow_service.stages.trajectory import compute_trajectory

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


BLUE_BOWL, CUBE = located("blue bowl", BOWL), located("blue cube", NEAR)


def put(image: Image, relation: str, *targets: LocatedObject, mover=SMALL, asked: Asked | None = None, **request: Any):
    """Stages 2 and 3 of a ball that is put somewhere: the run and what the stages came to."""
    run = run_of(image, **({"num_frames": FRAMES, "ensemble": 20} | request))
    placed = Intervention(kind="place", object=located("red ball", mover), relation=relation, targets=targets)
    middle = (mover[0] + mover[2]) / 2, (mover[1] + mover[3]) / 2
    given = {"object": "red ball", "point": middle, "bbox": mover, "interventions": (placed,), "asked": asked}
    grounding = understood(Grounding(**given, source="request"), EmbeddedReader())
    motion = settle_motion(run, grounding, None).value
    return run, grounding, motion, compute_trajectory(run, grounding, motion).value


def result(*given: Any, **request: Any) -> tuple[Trajectory, Placement]:
    trajectory = put(*given, **request)[3]
    assert trajectory.placement is not None
    return trajectory, trajectory.placement


class TestInto:
    def test_a_small_ball_fits_into_a_bowl_behind_its_front_and_before_its_back(self) -> None:
        run, grounding, motion, trajectory = put(with_bowl(SMALL), "into", BLUE_BOWL)
        assert (motion.kind, motion.direction, motion.speed) == ("place", None, 0)
        assert "put into the blue bowl" in motion.sentence
        placement = trajectory.placement
        assert (placement.result, trajectory.outcome) == ("inside", None)
        assert placement.fits > 0.9
        assert sum(placement.probabilities.values()) == pytest.approx(1)
        assert placement.clearance == pytest.approx(1 - 50 / (0.9 * 140), abs=0.1)
        assert trajectory.ensemble < 20, "what all of the first worlds agree on is settled"
        assert trajectory.path.points[0] == (150, 290)
        assert [path.body for path in trajectory.paths] == [0]
        x, y = trajectory.path.points[-1]
        assert abs(x - 420) < 15
        assert 215 < y < 275
        assert min(point[1] for point in trajectory.path.points) < 200, "it comes from above"
        touched = next(each for each in trajectory.encounters if each.kind == "touches")
        assert touched.first_frame >= 15, "nothing is touched while it is carried"
        assert put(with_bowl(SMALL), "into", BLUE_BOWL)[3] == trajectory, "the same each time"
        seen = run.sight.look()
        obstacles, _ = obstacles_of(seen, grounding)
        scene = scene_of(seen, grounding, trajectory)
        given = GeneratorInput(scene, grounding, motion, trajectory, obstacles, 0, CutoutOptions())
        carried, last = CutoutGenerator().render(given, [8, FRAMES - 1], lambda done: None)
        assert is_red(last[int(y) - 8, int(x)])
        front = scene.image[285, 380:460].astype(int)  # the wall below the nearer rim
        assert np.abs(last[285, 380:460].astype(int) - front).max() < 12
        assert not is_red(last[290, 150]), "it is gone from its place"
        over_x, over_y = trajectory.path.points[8]
        assert is_red(carried[int(over_y), int(over_x)])

    def test_into_which_of_two_it_fits_is_told_of_each_and_seen_of_the_first(self) -> None:
        image = bowl(with_bowl(SMALL), (570, 290), 18, 30, GREEN)
        cup, things = (551.0, 280.0, 589.0, 326.0), ("blue bowl", "green cup")
        objects = [{"object": name, "bbox": box} for name, box in zip(things, (BOWL, cup), strict=True)]
        asked = {"form": "which", "relation": "inside", "among": things}
        given = {"grounding": {"object": "red ball", "bbox": SMALL}, "objects": objects, "num_frames": FRAMES}
        into_cup = ({"kind": "place", "object": "red ball", "relation": "into", "targets": ("green cup",)},)
        for put_there, result in (((), "inside"), (into_cup, "on-the-rim")):
            told = computed(run_of(image, **given, interventions=put_there, asked=asked)).value
            assert [(each.object, each.probability, each.sure) for each in told.outcome.candidates] == [
                ("blue bowl", 1.0, True), ("green cup", 0.0, True),
            ]  # fmt: skip
            assert (told.outcome.sure, told.outcome.object, told.placement.result) == (True, None, result)
        open_to_all = computed(run_of(image, **given, interventions=into_cup, asked=asked | {"among": ()})).value
        assert (open_to_all.outcome.probability, open_to_all.outcome.sure) == (None, False)

    def test_a_large_one_does_not(self) -> None:
        _, placement = result(with_bowl(BIG), "into", BLUE_BOWL, mover=BIG)
        assert placement.result == "on-the-rim"
        assert placement.fits < 0.1
        assert placement.clearance < 0
        assert placement.above_rim > 0.5

    @pytest.mark.parametrize(("width", "sure"), [(60, True), (116, False), (230, True)])
    def test_what_is_about_as_wide_as_the_opening_is_not_sure(self, width: int, sure: bool) -> None:
        """Two outlines at two depths do not tell which of two like widths is the larger."""
        box = (150 - width / 2, 290 - width / 2, 150 + width / 2, 290 + width / 2)
        asked = Asked(relation="inside", target="blue bowl")
        told, _ = result(with_bowl(box), "into", BLUE_BOWL, mover=box, asked=asked, ensemble=50)
        assert told.outcome.sure == sure
        assert sure or 0.1 < told.outcome.probability < 0.85

    @pytest.mark.parametrize("frames", [2, 9])
    def test_without_an_ensemble_a_short_clip_tells_the_same_and_no_probabilities(self, frames: int) -> None:
        told, placement = result(with_bowl(SMALL), "into", BLUE_BOWL, ensemble=0, num_frames=frames)
        assert (placement.result, placement.fits, placement.probabilities) == ("inside", None, {})
        assert len(told.path.points) == frames


class TestElsewhere:
    def test_next_to_is_where_there_is_room_and_between_is_in_the_gap(self) -> None:
        hidden = (300.0, 230.0, 375.0, 330.0)
        told, placement = result(blocks(NEAR, hidden), "next-to", CUBE, ensemble=0)
        assert placement.result == "beside"
        assert told.path.points[-1][0] > 460
        told, placement = result(blocks(NEAR, FAR), "between", CUBE, located("green cube", FAR))
        assert placement.result == "beside"
        assert placement.fits > 0.7
        assert 0 < placement.clearance < 1
        assert 460 < told.path.points[-1][0] < 520
        narrow = (485.0, 230.0, 565.0, 330.0)  # a gap of half the ball's width
        placement = result(blocks(NEAR, narrow), "between", CUBE, located("green cube", narrow))[1]
        assert placement.result == "overlaps"
        assert placement.fits < 0.1
        assert placement.clearance < 0


@pytest.mark.parametrize(
    ("relation", "targets"),
    [
        ("into", [CUBE]),
        ("into", [located("blue thing", NEAR)]),
        ("into", [located("red ball", SMALL)]),
        ("between", [CUBE, located("cube", NEAR)]),
        ("next-to", []),
    ],
    ids=["what is no container", "what may be closed", "itself", "one thing", "nothing"],
)
def test_where_it_cannot_be_put(relation: str, targets: list[LocatedObject]) -> None:
    with refused("cannot-ground"):
        put(blocks(NEAR), relation, *targets)


def test_nothing_says_where() -> None:
    run = run_of(with_bowl(SMALL), motion={"kind": "place"}, num_frames=FRAMES)
    grounding = Grounding(object="red ball", point=(150, 290), bbox=SMALL, source="request")
    motion = settle_motion(run, grounding, None).value
    with refused("cannot-ground"):
        compute_trajectory(run, grounding, motion)
