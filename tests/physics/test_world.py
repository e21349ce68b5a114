"""Worlds of placed bodies: who touches, covers and is covered by whom, what is set in motion, falls over or leaves."""

from __future__ import annotations

import itertools
import math
from typing import Any

import cv2
import numpy as np
import pytest
from floors import known, outline
from hypothesis import given
from hypothesis import strategies as st
from worlds import CAMERA, FPS, FRAMES, HALF, SPEED, ball, happened, post, rigid, rolling, seen

from cow_service.media.masks import CroppedMask
from cow_service.physics.bodies import SeenBody
from cow_service.physics.draws import ensemble, likeliest
from cow_service.physics.engine import Meeting, RigidShape, WorldRun, run_worlds
from cow_service.physics.ensemble import Query, answers_of, run_ensemble
from cow_service.physics.events import Events, WorldEvents, encounters, find_world_events, seen_paths, set_off
from cow_service.physics.recording import rotation, states
from cow_service.physics.world import DrawnWorlds, WorldInput, run_world
from cow_service.records import Asked


def kinds(events: Events, body: int = 1) -> set[str]:
    return {kind for kind in events.times if np.isfinite(events.times[kind][0, body])}


def answer(events: WorldEvents, relation: Any, **of: Any) -> int:
    form = of.pop("form", "whether")
    return answers_of(Query(Asked(form=form, relation=relation), **of), events)[0]


class TestRolling:
    def roll(self, *others: SeenBody, **more: Any) -> Events:
        return happened(ball(-1.2), *others, **more)[1].of[0]

    def test_what_stands_on_the_way_is_touched_when_the_rims_meet(self) -> None:
        bodies = [ball(-1.2), post(0.2)]
        worlds, found = happened(*bodies)
        time = found.of[0].times["touches"][0, 1]
        assert time == pytest.approx((1.4 - 0.24) / SPEED, abs=0.1)
        assert worlds.runs[0].moved == {0, 1}
        (met,) = (each for each in encounters(found, None, bodies, FPS, FRAMES) if each.kind == "touches")
        assert (met.first_frame, met.time, met.subject, met.body) == (math.ceil(time * FPS), time, 0, 1)
        (late,) = (each for each in encounters(found, None, bodies, FPS, 9) if each.kind == "touches")
        assert (late.first_frame, late.time) == (8, time)

    def test_before_it_it_covers_and_behind_it_it_is_covered(self) -> None:
        assert kinds(self.roll(post(0.2, 3.4, half=0.1, height=0.12))) == {"occludes"}
        events = self.roll(post(0.2, 2.5, height=0.5))
        assert kinds(events) == {"occluded-by"}
        assert events.shares["occluded-by"][0, 1] > 0.8
        assert events.times["occluded-by"][0, 1] == pytest.approx((1.2 + 0.2 * 3 / 2.5 - 0.2) / SPEED, abs=0.25)
        assert kinds(self.roll(post(0.2, 6.0, height=0.2))) == set(), "far behind its way"
        assert kinds(self.roll(post(-2.0))) == set(), "it rolls away from it"

    def test_a_ball_turns_as_it_rolls_and_states_agree_with_points(self) -> None:
        worlds, _ = happened(ball(-1.2))
        rolled = np.degrees(SPEED * np.arange(FRAMES) / FPS / HALF)
        assert rotation(worlds, 0)[16] == pytest.approx(rolled[16], rel=0.15), "clockwise: it is seen from above"
        found = states(worlds, 0)
        points = found[:, :2] / found[:, 2:3] * CAMERA.focal + np.array([320, 200])
        assert points == pytest.approx(seen_paths(worlds, 0).points[0], abs=0.01)
        assert np.diff(found[:17, :3], axis=0) * FPS == pytest.approx(found[1:17, 3:], abs=0.15)


class TestFalling:
    @pytest.mark.parametrize(("right", "hit"), [(0.0, True), (0.6, False)])
    def test_it_lands_on_what_is_below_and_not_on_what_is_beside(self, right: float, hit: bool) -> None:
        motion = rolling(0.0, above=0.9, kind="fall", direction=None)
        worlds, found = happened(ball(0.0, above=0.9), post(right, half=0.2, height=0.3), motion=motion, above=0.9)
        time = found.of[0].times["touches"][0, 1]
        assert time == (pytest.approx(math.sqrt(2 * 0.6 / 9.81), abs=0.1) if hit else math.inf)
        heights = worlds.runs[0].positions[0, :, 1]
        assert heights[0] == pytest.approx(0.9 + HALF, rel=0.05)
        assert heights.min() > 0.9 * HALF
        assert found.landed[0, 0] == (math.inf if hit else pytest.approx(math.sqrt(2 * 0.9 / 9.81), abs=0.05))

    def test_a_throw_flies_as_far_as_the_closed_form_says(self) -> None:
        motion = rolling(2.5, above=0.5, kind="projectile", direction=(math.cos(0.4), -math.sin(0.4)))
        run = happened(ball(-1.0, above=0.5), motion=motion, above=0.5)[0].runs[0]
        forward, rise, _ = run.velocities[0, 0]
        assert np.linalg.norm(run.velocities[0, 0]) == pytest.approx(2.5, rel=0.02)
        lands = (rise + math.sqrt(rise**2 + 2 * 9.81 * 0.5)) / 9.81
        bounce = next(meeting for meeting in run.meetings if meeting.b is None)
        assert bounce.time == pytest.approx(lands, abs=0.05)
        frame = int(lands * FPS) - 1
        assert run.positions[0, frame, 0] - run.positions[0, 0, 0] == pytest.approx(forward * frame / FPS, rel=0.01)

    def test_the_table_is_no_encounter_and_the_ball_rolls_off_it(self) -> None:
        table = post(-0.6, half=0.5, height=0.4, name="table", shape="box")
        worlds, found = happened(ball(-0.6, above=0.4), table, motion=rolling(above=0.4))
        assert worlds.layout.supports == (1, None)
        assert found.of[0].eligible.tolist() == [False, False]
        heights = worlds.runs[0].positions[0, :, 1]
        # Of a table the box alone is known: its near edge looks wider, so that its far one is taken to be farther.
        assert heights[0] == pytest.approx(0.4 + HALF, rel=0.25)
        assert heights[-1] == pytest.approx(float(worlds.layout.bodies[0].half_height[0]), rel=0.1), "on the floor"


def test_worlds_run_in_batches_are_those_run_at_once() -> None:
    rows, bodies = ensemble(9), (ball(-1.2), post(0.2))
    world = WorldInput(bodies, rolling(), known(CAMERA, 0.02), CAMERA.size, FRAMES, FPS)
    drawn = DrawnWorlds.of(world, rows, 2)
    parts = drawn.run(slice(0, 4)), drawn.run(slice(4, 9))
    joined, at_once = parts[0].joined(parts[1], drawn.layout.of(slice(0, 9))), run_world(world, rows, 2)
    assert len({run.positions.shape for run in joined.runs}) == 1, "the batch that rests sooner is continued"
    for one, other in zip(joined.runs, at_once.runs, strict=True):
        frames = min(one.positions.shape[1], other.positions.shape[1])
        np.testing.assert_allclose(one.positions[:, :frames], other.positions[:, :frames], atol=0.05)
    touches = [find_world_events(each, bodies, rows, CAMERA.size).of[0].times["touches"] for each in (joined, at_once)]
    assert np.isfinite(touches[1][:, 1]).any()
    np.testing.assert_allclose(touches[0], touches[1], atol=0.07)


class TestChains:
    def test_the_first_of_three_balls_hits_the_second_which_hits_the_third(self) -> None:
        bodies = [ball(-0.9), ball(-0.2, name="two"), ball(0.4, name="three")]
        _, events = happened(*bodies)
        assert events.order == (0, 1, 2)
        assert answer(events, "touches", subject=1, target=2) == 1
        assert answer(events, "touches", subject=2, target=1) == 1, "either may be the subject"
        assert events.of[1].times["touches"][0, 2] > events.of[0].times["touches"][0, 1]
        assert answer(events, "touches", form="which-first") == 1
        assert answer(events, "touches", form="which-first", subject=1) == 2, "the mover, which hit it, does not count"
        assert answer(events, "touches", form="which-first", among=(2,)) == -1
        assert answer(events, "moves", target=2) == 1
        found = encounters(events, events, bodies, FPS, FRAMES)
        touched = [(each.subject, each.body, each.probability) for each in found if each.kind == "touches"]
        assert touched == [(0, 1, 1.0), (1, 2, 1.0)]
        assert len({(frozenset((each.subject, each.body)), each.kind) for each in found}) == len(found)
        _, beside = happened(*bodies[:2], ball(0.4, 3.8, name="three"))
        assert answer(beside, "touches", subject=1, target=2) == 0
        assert (answer(beside, "moves", target=2), answer(beside, "moves", target=1)) == (0, 1)

    @given(st.floats(-0.16, 0.16))
    def test_a_struck_ball_goes_along_the_line_between_the_middles(self, aside: float) -> None:
        run = happened(ball(-0.9), ball(0.0, 3.0 + aside))[0].runs[0]
        gone = (run.positions[1, -1] - run.positions[1, 0])[[0, 2]]
        drop = run.positions[1, 0, 2] - run.positions[0, 0, 2]
        normal = math.asin(max(-1.0, min(1.0, drop / (2 * HALF))))
        assert math.atan2(gone[1], gone[0]) == pytest.approx(normal, abs=math.radians(6))

    def test_who_set_what_in_motion_and_when(self) -> None:
        shapes = [rigid(starts=True), *[rigid()] * 5]
        met = [(1.0, 1, 2), (0.5, 0, 1), (0.2, 2, 3), (0.1, 0, None)]
        meetings = [Meeting(time, a, b, 0.0) for time, a, b in met]
        run = WorldRun(np.zeros((6, 1, 3)), np.zeros((6, 1, 3)), np.zeros((6, 1, 4)), meetings, {0, 1, 2, 5})
        assert set_off(shapes, run) == {0: 0.0, 1: 0.5, 2: 1.0, 5: 1.0}, "the last stood on something"

    @pytest.mark.parametrize("speed", [2.5, 0.1])
    def test_it_leaves_the_image_where_it_ends_however_long_the_clip_is(self, speed: float) -> None:
        rights = np.linspace(0, 4, 400)
        across = CAMERA.seen(np.array([[right, HALF, 3.0] for right in rights]))[:, 0]
        edge = float(rights[np.argmax(across > CAMERA.size[0])])
        _, alone = happened(ball(-0.9), motion=rolling(speed))
        assert alone.gone[0, 0] == pytest.approx((0.9 + edge) / speed, rel=0.02, abs=1 / FPS)
        assert answer(alone, "leaves") == 1
        assert answer(happened(ball(-0.9), motion=rolling(0.0))[1], "leaves") == 0


class TestRemoval:
    def test_what_stood_on_it_falls(self) -> None:
        raised = outline("cylinder", (0.6, 3.2), 0.08, 0.16) + np.array([0.0, 0.4, 0.0])
        bodies = (ball(-1.2), seen("cup", "cylinder", CAMERA.box(raised)))
        table = post(0.6, 3.2, half=0.4, height=0.4, name="table", shape="box")
        still = rolling(0.0, kind="static", direction=None)
        world = WorldInput(bodies, still, known(CAMERA), CAMERA.size, 33, FPS, removed=(table,))
        assert run_world(world.as_it_is(), likeliest()).layout.supports[1] == 2
        worlds = run_world(world, likeliest())
        fallen, kept = (each.runs[0].positions[1, :, 1] for each in (worlds, run_world(world.as_it_is(), likeliest())))
        assert fallen[0] == pytest.approx(kept[0])
        assert fallen[-1] < fallen[0] - 0.3
        assert kept[-1] == pytest.approx(kept[0], abs=0.01)
        assert np.isfinite(find_world_events(worlds, bodies, likeliest(), CAMERA.size).moved[0, 1])

    @pytest.mark.parametrize(("negated", "likely"), [(False, 1.0), (True, 0.0)])
    def test_whether_it_makes_a_difference(self, negated: bool, likely: float) -> None:
        target, vase, far = post(0.9), post(-0.2, name="vase"), post(0.0, 4.2, name="far")
        asked = Asked(form="changes", relation="touches", target="post", negated=negated)
        for taken, other, changes in ((vase, far, likely), (far, vase, 1 - likely)):
            bodies = (ball(-1.2), target, other)
            world = WorldInput(bodies, rolling(), known(CAMERA), CAMERA.size, FRAMES, FPS, removed=(taken,))
            changed, factual = run_ensemble(world, Query(asked, target=1), 9)
            assert (changed.decided.probability, changed.decided.sure) == (changes, True)
            assert factual.query.asked.form == "whether"


class TestEachTakenAway:
    """A ball rolls towards a vase, behind which there is a post; another post stands aside."""

    ROW = (ball(-1.2), post(0.9), post(0.0, 4.2, name="far"), post(-0.2, name="vase"))

    def told(
        self, *among: int, target: int | None = 1, bodies=ROW, motion=None, **asked: Any
    ) -> tuple[dict[int, float], Any]:
        question = Asked(form="which-to-remove", **({"relation": "touches"} | asked))
        world = WorldInput(bodies, motion or rolling(), known(CAMERA), CAMERA.size, FRAMES, FPS)
        (result,) = run_ensemble(world, Query(question, target, among=among, meets_more=not among), 9)
        return {each.body: each.probability for each in result.decided.candidates}, result

    def test_each_has_the_worlds_that_are_left_without_it(self) -> None:
        so_that_it_is_met, result = self.told(2, 3, negated=True)
        assert so_that_it_is_met == {2: 0.0, 3: 1.0}
        assert (result.decided.as_it_is, result.decided.sure) == (1.0, True)
        assert len(result.shown.worlds.runs[0].positions) == 4, "what is shown has all of them"
        # The same worlds as where it is taken away beforehand.
        taken = WorldInput(self.ROW[:3], rolling(), known(CAMERA), CAMERA.size, FRAMES, FPS, removed=self.ROW[3:])
        changed, _ = run_ensemble(taken, Query(Asked(relation="touches"), 1), 9)
        own = result.decided.candidates[1].told
        np.testing.assert_array_equal(own.touches[:, 1], changed.ensemble.events.of[0].times["touches"][:, 1])
        assert not np.isfinite(own.touches[:, 3]).any()

    def test_what_is_hit_is_not_when_it_is_gone_and_something_else_may_be(self) -> None:
        assert self.told(3, 2, target=3)[0] == {3: 1.0, 2: 0.0}
        told, result = self.told(target=None)
        assert told == {3: 0.0}, "those that are met, and behind it stands the next"
        assert result.decided.as_it_is == 1.0
        assert self.told(target=None, bodies=(self.ROW[0], *self.ROW[2:]))[0] == {2: 1.0}

    def test_it_hides_nothing_without_what_it_hides(self) -> None:
        bodies = (ball(-1.2), post(0.2, 3.4, half=0.1, height=0.12), post(-2.0, name="behind"))
        told, result = self.told(1, 2, target=None, bodies=bodies, relation="covers")
        assert {body: round(share) for body, share in told.items()} == {1: 1, 2: 0}, "although it touches nothing"
        assert result.decided.as_it_is > 0.8

    def test_what_stood_on_it_falls(self) -> None:
        raised = outline("cylinder", (0.6, 3.2), 0.08, 0.16) + np.array([0.0, 0.4, 0.0])
        table = post(0.6, 3.2, half=0.4, height=0.4, name="table", shape="box")
        bodies = (ball(-1.2), seen("cup", "cylinder", CAMERA.box(raised)), table, self.ROW[2])
        still = rolling(0.0, kind="static", direction=None)
        told, _ = self.told(2, 3, target=1, bodies=bodies, motion=still, relation="moves", negated=True)
        assert told == {2: 1.0, 3: 0.0}


# Radius and height of the rims from the floor up, m.
VASE = [(0.07, 0.0), (0.13, 0.08), (0.15, 0.2), (0.12, 0.3), (0.07, 0.4), (0.11, 0.5)]
BOTTLE = [(0.1, 0.0), (0.1, 0.3), (0.04, 0.4), (0.04, 0.55)]
CAN, DISC = [(0.12, 0.0), (0.12, 0.35)], [(0.2, 0.0), (0.2, 0.1)]


def turned_to(profile: list[tuple[float, float]], right: float, name: str = "it") -> SeenBody:
    """What turns to a profile, as the camera sees it three metres ahead."""
    angles, mask = np.linspace(0, 2 * np.pi, 48), np.zeros((400, 640), np.uint8)
    rings = [
        CAMERA.seen(np.stack([right + r * np.cos(angles), np.full(48, h), 3.0 + r * np.sin(angles)], axis=1))
        for r, h in profile
    ]
    for low, high in itertools.pairwise(rings):
        hull = cv2.convexHull(np.concatenate([low, high]).astype(np.float32))
        cv2.fillConvexPoly(mask, hull.round().astype(np.int32), 1)
    rows, columns = np.nonzero(mask)
    box = (float(columns.min()), float(rows.min()), float(columns.max() + 1), float(rows.max() + 1))
    return SeenBody(name, box, CroppedMask.of(mask > 0), "cylinder")


class TestTipping:
    def test_an_outline_tells_on_what_a_thing_stands_and_where_its_weight_is(self) -> None:
        vase, bottle, can = (turned_to(profile, 0.0) for profile in (VASE, BOTTLE, CAN))
        sine = 1.5 / math.hypot(1.5, 3.0)
        base, waist = vase.stance(sine)
        assert base == pytest.approx(0.07 / 0.15, abs=0.12)
        assert 0.02 < waist < 0.2
        assert [each.stance(sine)[0] for each in (bottle, can)] == pytest.approx([1.0, 1.0], abs=0.05)
        assert bottle.middle < can.middle - 0.05

    def test_a_narrow_foot_and_a_high_centre_of_mass_make_a_thing_fall(self) -> None:
        def falls_over(body: RigidShape, speed: float) -> bool:
            ball = rigid(velocity=(speed, 0.0, 0.0), starts=True, glides=True)
            turns = run_worlds([[ball, body]], 65, 16.0)[0].turns[1]
            return bool((1 - 2 * (turns[:, 0] ** 2 + turns[:, 2] ** 2) < math.cos(math.pi / 4)).any())

        wide = rigid("cylinder", 0.12, 0.3, position=(0.6, 0.3, 0.0), middle=0.5)
        narrow = rigid("cylinder", 0.12, 0.3, position=(0.6, 0.3, 0.0), middle=0.5, base=0.4, waist=0.1)
        heavy_above = rigid("cylinder", 0.12, 0.3, position=(0.6, 0.3, 0.0), middle=0.75)
        assert [falls_over(body, 1.5) for body in (wide, narrow)] == [False, True]
        speeds = [1.0, 1.5, 2.0, 2.5, 3.0, 3.5]
        assert sum(falls_over(heavy_above, v) for v in speeds) > sum(falls_over(wide, v) for v in speeds)
        for body in (wide, narrow, heavy_above):
            stands = run_worlds([[body]], 17, 16.0)[0].positions[0, -1]
            assert stands == pytest.approx(body.position, abs=0.01)

    def test_a_candle_is_knocked_over_and_a_crate_is_pushed(self) -> None:
        for other, tips in ((post(0.0, half=0.05, height=0.6), 1), (post(0.0, half=0.25, height=0.2, shape="box"), 0)):
            _, events = happened(ball(-0.9), other, motion=rolling(2.5), turns_wanted=True)
            assert (answer(events, "tips", target=1), answer(events, "moves", target=1)) == (tips, 1)

    def test_turns_of_an_ensemble_are_recorded_only_where_they_are_wanted(self) -> None:
        candle = post(0.0, half=0.05, height=0.6)
        for wanted in (True, False):
            _, events = happened(
                ball(-0.9), candle, motion=rolling(3.6), draws=ensemble(4), every=2, turns_wanted=wanted
            )
            assert np.isfinite(events.tipped[:, 1]).all() == wanted
            assert not np.isfinite(events.tipped[:, 0]).any(), "a ball never does"

    def test_worlds_disagree_on_whether_a_vase_falls(self) -> None:
        shares: list[float] = []
        for profile in (VASE, DISC):
            bodies = turned_to([(0.12, 0.0), (0.12, 0.3)], -0.8), turned_to(profile, 0.3)
            motion = rolling(1.8, speed_deviation=0.25)
            world = WorldInput(bodies, motion, known(CAMERA, 0.02), CAMERA.size, FRAMES, FPS, turns_wanted=True)
            decided = run_ensemble(world, Query(Asked(relation="tips", target="it"), 1), 60)[0].decided
            assert decided is not None
            shares.append(decided.probability)
        assert 0.1 < shares[0] < 0.9
        assert shares[1] < 0.1
