"""What is given, said, seen and read: the surest source decides, and what contradicts it is a doubt."""

from __future__ import annotations

import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
import pytest
from drawn import block, floor
from hypothesis import given
from hypothesis import strategies as st
from runs import run_of

from cow_service.errors import CowError, MllmBadReply
from cow_service.media.masks import CroppedMask
from cow_service.perception.base import Thing
from cow_service.physics.lift import DIRECTION_DEVIATIONS
from cow_service.readers.base import ReaderInput, ReadResult, WordsReading
from cow_service.readers.embedded.reader import EmbeddedReader
from cow_service.records import (
    Asked,
    BBox,
    Cue,
    GroundingRequest,
    InterventionRequest,
    MotionRequest,
    ObjectRequest,
    Reading,
    Vector,
)
from cow_service.stages.grounding import ground
from cow_service.stages.settling import (
    APART,
    SeenThings,
    SeenWay,
    angle,
    mover_of,
    settle_mover,
    settle_places,
    settle_question,
    settle_way,
)

RIGHT, LEFT, DOWN = (1.0, 0.0), (-1.0, 0.0), (0.0, 1.0)
MOVER = (100.0, 100.0, 140.0, 140.0)
VASE = (100.0, 300.0, 140.0, 380.0)
WORDS = EmbeddedReader()
READ = MotionRequest(kind="linear", direction=RIGHT, cue="orientation", direction_deviation=20.0)
NOTHING = MotionRequest()


def turned(degrees: float) -> tuple[float, float]:
    return math.cos(math.radians(degrees)), math.sin(math.radians(degrees))


class Rule(NamedTuple):
    """What is read instead of `READ`, said and seen; the direction it becomes, by what, and whether another stays."""

    direction: Vector | None
    cue: Cue
    read: Mapping[str, Any] = MappingProxyType({})
    said: MotionRequest = NOTHING
    seen: SeenWay = SeenWay()
    rival: Vector | None = None


ARROW, AGAINST, TO_THE_RIGHT = SeenWay(RIGHT), MotionRequest(along_arrow=False), MotionRequest(direction=RIGHT)
BY_ARROW: dict[str, Any] = {"cue": "arrow"}
AGAINST_IT: dict[str, Any] = {"cue": "arrow", "direction": None, "along_arrow": False}
STAYS: dict[str, Any] = {"kind": "static", "direction": None, "cue": "text", "direction_deviation": None}
TRAIL = SeenWay(RIGHT, trail=RIGHT)
UP = (0.0, -1.0)
AWAY = MotionRequest(direction=UP, depth=0.87)
FORWARD, BACKWARD = MotionRequest(forward=True), MotionRequest(forward=False)
TOWARDS, AT_VASE = MotionRequest(towards="vase"), SeenWay(goal=VASE)
AT_IT: dict[str, Any] = {"direction": None, "towards": "vase"}
RULES = {
    "what is not estimated stays": Rule(RIGHT, "orientation", {"direction_deviation": None}, seen=SeenWay(DOWN)),
    "nothing else tells": Rule(RIGHT, "orientation"),
    "an arrow is surer than what is read": Rule(RIGHT, "arrow", BY_ARROW | {"direction": turned(20)}, seen=ARROW),
    "an arrow that nobody speaks of": Rule(RIGHT, "orientation", {}, seen=SeenWay(DOWN)),
    "what is read tells the sense": Rule(LEFT, "arrow", BY_ARROW | {"direction": turned(160)}, seen=ARROW),
    "the reader says it": Rule(LEFT, "arrow", BY_ARROW | {"direction": turned(170), "along_arrow": False}, seen=ARROW),
    "the reader contradicts itself": Rule(LEFT, "arrow", BY_ARROW | {"along_arrow": False}, seen=ARROW, rival=RIGHT),
    "the words say it": Rule(LEFT, "arrow", {"direction": LEFT, "along_arrow": True}, AGAINST, ARROW),
    "the reader passes over the words": Rule(LEFT, "arrow", {}, AGAINST, ARROW, rival=RIGHT),
    "far from the arrow": Rule(RIGHT, "arrow", BY_ARROW | {"direction": turned(50)}, seen=ARROW, rival=turned(50)),
    "words tell the direction": Rule(RIGHT, "text", {"direction": turned(30)}, TO_THE_RIGHT),
    "far from the words": Rule(RIGHT, "text", {"direction": turned(50)}, TO_THE_RIGHT, rival=turned(50)),
    "an arrow that the words contradict": Rule(DOWN, "arrow", BY_ARROW, TO_THE_RIGHT, SeenWay(DOWN), rival=RIGHT),
    "an arrow that leads elsewhere than to the thing": Rule(
        RIGHT, "arrow", BY_ARROW, TOWARDS, SeenWay(RIGHT, goal=VASE), rival=DOWN
    ),
    "towards a thing": Rule(DOWN, "text", {"direction": DOWN}, TOWARDS, AT_VASE),
    "towards a thing that only the reader names": Rule(DOWN, "text", AT_IT, seen=AT_VASE),
    "towards a thing elsewhere": Rule(DOWN, "text", {}, TOWARDS, AT_VASE, rival=RIGHT),
    "as it faces": Rule(DOWN, "orientation", {"direction": turned(60)}, FORWARD, SeenWay(front=DOWN)),
    "backward from its front": Rule(UP, "orientation", {"direction": UP}, BACKWARD, SeenWay(front=DOWN)),
    "its front elsewhere": Rule(DOWN, "orientation", {}, FORWARD, SeenWay(front=DOWN), rival=RIGHT),
    "along a trail that is seen": Rule(LEFT, "trail", {"cue": "trail", "direction": LEFT}, seen=TRAIL),
    "words beside a trail": Rule(RIGHT, "text", {"cue": "trail", "direction": LEFT}, TO_THE_RIGHT, TRAIL, rival=LEFT),
    "it stays, where words have it move": Rule(None, "text", STAYS, TO_THE_RIGHT, rival=RIGHT),
    "against an arrow that is not seen": Rule(RIGHT, "orientation", {"along_arrow": True}, AGAINST, rival=LEFT),
    "straight away from the camera": Rule(UP, "text", {"direction": UP, "depth": -0.3}, AWAY),
    "only the arrow tells, not which end": Rule(DOWN, "arrow", {"direction": None}, seen=SeenWay(DOWN), rival=UP),
    "the arrow and its sense tell": Rule(UP, "arrow", AGAINST_IT, seen=SeenWay(DOWN)),
    "only the words tell": Rule(RIGHT, "text", {"direction": None}, TO_THE_RIGHT),
    "nobody says anything": Rule(None, "orientation", {"direction": None}),
}


@pytest.mark.parametrize("rule", RULES.values(), ids=RULES)
def test_the_surest_source_decides(rule: Rule) -> None:
    read = READ.model_copy(update=dict(rule.read))
    settled, objections = settle_way(read, rule.said, rule.seen, MOVER)
    assert settled.direction == rule.direction or angle(settled.direction or RIGHT, rule.direction or LEFT) < 1e-6
    assert (settled.cue, bool(objections)) == (rule.cue, rule.rival is not None)
    assert (settled.other_direction is None) is (rule.rival is None)
    assert rule.rival is None or angle(settled.other_direction or RIGHT, rule.rival) < 1e-6
    is_estimate = settled is read
    assert settled.direction_deviation in (None, read.direction_deviation)
    is_named = rule.said is TOWARDS or rule.read is AT_IT
    assert (settled.towards == "vase") is (is_named and rule.rival is None)
    assert is_estimate or settled.depth == pytest.approx(0.0 if not rule.said.depth else 0.87, abs=0.01)


@given(
    st.floats(-180, 180), st.floats(0, 360), st.sampled_from([None, True, False]), st.sampled_from([None, True, False])
)
def test_along_a_drawn_arrow_or_against_it_and_never_between(
    off: float, arrow: float, along: bool | None, said: bool | None
) -> None:
    read = READ.model_copy(update={"direction": turned(arrow + off), "along_arrow": along, "cue": "arrow"})
    settled, objections = settle_way(read, MotionRequest(along_arrow=said), SeenWay(turned(arrow)), MOVER)
    assert settled.direction is not None
    gap = angle(settled.direction, turned(arrow))
    assert gap < 1e-6 or gap > 180 - 1e-6
    assert said is None or (gap < 90) is said
    apart = APART * math.hypot(20.0, DIRECTION_DEVIATIONS["arrow"])
    assert bool(objections) is (angle(turned(arrow + off), settled.direction) > apart)


ASKED = Asked(relation="touches", target="vase")
WHICH = Asked(form="which", relation="covers", among=("the vase", "the red ball"))
ANYTHING = Asked(relation="touches")
WITHIN = ASKED.model_copy(update={"within": 2.0})
TAKEN, REMOVED = (InterventionRequest(kind="remove", object=name) for name in ("the vase", "vase"))
OTHER_GONE = InterventionRequest(kind="remove", object="red ball")


# What is read and said; what is asked by that, and whether a doubt is left.
QUESTIONS: dict[str, tuple[dict[str, Any], dict[str, Any], Asked | None, bool]] = {
    "as read, where the words were not understood": ({"asked": ASKED}, {"interventions": (TAKEN,)}, ASKED, False),
    "as the words say, where the reader says nothing": ({}, {"asked": ASKED}, ASKED, False),
    "both say the same": (
        {"asked": ASKED}, {"asked": ASKED.model_copy(update={"target": "the thing"})}, ASKED, False
    ),
    "the reader turns it round": ({"asked": ASKED.model_copy(update={"negated": True})}, {"asked": ASKED}, ASKED, True),
    "the reader asks something else": (
        {"asked": ASKED.model_copy(update={"relation": "covers"})}, {"asked": ASKED}, ASKED, True
    ),
    "the reader asks about another thing": (
        {"asked": ASKED}, {"asked": ASKED.model_copy(update={"target": "the red ball"})}, ASKED, True
    ),
    "the reader passes over a time": (
        {"asked": ASKED}, {"asked": WITHIN}, WITHIN, False
    ),
    "the reader has another time": (
        {"asked": ASKED.model_copy(update={"within": 5.0})}, {"asked": WITHIN}, WITHIN, True
    ),
    "both take one thing away": (
        {"interventions": (REMOVED,)}, {"asked": ASKED, "interventions": (TAKEN,)}, ASKED, False
    ),
    "the reader takes another thing away": (
        {"interventions": (REMOVED,)}, {"asked": ASKED, "interventions": (OTHER_GONE,)}, ASKED, True
    ),
    "the reader asks about anything": ({"asked": ANYTHING}, {"asked": ASKED}, ANYTHING, True),
    "the reader drops one of several": (
        {"asked": WHICH.model_copy(update={"among": ("vase",)})}, {"asked": WHICH},
        WHICH.model_copy(update={"among": ("vase",)}), True
    ),
    "the reader forgets what is taken away": ({}, {"asked": ASKED, "interventions": (TAKEN,)}, ASKED, True),
    "the reader takes something away": ({"interventions": (REMOVED,)}, {"asked": ASKED}, ASKED, True),
}  # fmt: skip


@pytest.mark.parametrize(("read", "said", "asked", "is_doubtful"), QUESTIONS.values(), ids=QUESTIONS)
def test_the_words_decide_what_they_say(
    read: dict[str, Any], said: dict[str, Any], asked: Asked | None, is_doubtful: bool
) -> None:
    objects = (named("vase", VASE),) if "interventions" in read else ()
    reading = found("ball", MOVER, *objects).model_copy(update=read)
    settled, objections = settle_question(reading, WordsReading(Reading(**said)), WORDS)
    assert (settled.asked, settled.question_is_doubtful, bool(objections)) == (asked, is_doubtful, is_doubtful)


def seen(bbox: BBox, colour: str) -> Thing:
    """A block of one colour."""
    x0, y0, x1, y1 = map(int, bbox)
    mask = np.zeros((400, 600), bool)
    mask[y0:y1, x0:x1] = True
    return Thing(CroppedMask.of(mask), colour, frozenset((colour,)), 0.8, 1.0, is_disc=False)


RED, BLUE = (100.0, 100.0, 140.0, 140.0), (300.0, 100.0, 380.0, 180.0)
REGIONS = (seen(RED, "red"), seen(BLUE, "blue"))


def named(name: str, bbox: BBox) -> ObjectRequest:
    return ObjectRequest(object=name, bbox=bbox)


def found(name: str, bbox: BBox, *others: ObjectRequest, **more: Any) -> Reading:
    """What moves, and the others."""
    return Reading(grounding=GroundingRequest(object=name, bbox=bbox, **more), objects=others)


@given(st.tuples(*[st.floats(-0.2, 0.2)] * 4), st.tuples(*[st.floats(-0.2, 0.2)] * 4))
def test_estimated_boxes_are_moved_onto_the_things_that_are_seen(
    first: tuple[float, ...], second: tuple[float, ...]
) -> None:
    def estimated(bbox: BBox, off: tuple[float, ...]) -> BBox:
        sides = (bbox[2] - bbox[0], bbox[3] - bbox[1]) * 2
        x0, y0, x1, y1 = (edge + side * share for edge, side, share in zip(bbox, sides, off, strict=True))
        return x0, y0, x1, y1

    read = found("red ball", estimated(RED, first), named("blue box", estimated(BLUE, second)), bbox_deviation=0.1)
    settled, objections, is_seen = settle_places(read, SeenThings(REGIONS))
    mover = mover_of(settled)
    assert (mover.bbox, settled.objects[0].bbox, mover.bbox_deviation, is_seen) == (RED, BLUE, None, True)
    assert not objections


def test_a_box_that_no_edges_tell_has_a_spread() -> None:
    half = (RED[0], RED[1], RED[0] + 20, RED[3])  # a part of what is seen, or what is seen a part of it
    read = found("duck", half, bbox_deviation=0.1)
    assert settle_places(read, SeenThings(REGIONS)) == (read, (), False)


ELSEWHERE = (450.0, 300.0, 500.0, 350.0)
# What is read and said of it; whether the mover, and the other thing, are in doubt.
PLACES: dict[str, tuple[Reading, str | None, bool, bool]] = {
    "as the words say": (found("red ball", RED), "the ball", False, False),
    "under another word": (found("red toy", RED), "the vehicle", False, False),
    "another thing than they say": (found("blue box", BLUE), "the red ball", True, False),
    "a thing that they tell apart": (
        found("toy", BLUE, named("duck", RED)), "the duck", True, False
    ),
    "on something of another colour": (found("red ball", BLUE), None, True, False),
    "on bare floor": (found("red ball", RED, named("vase", ELSEWHERE)), None, False, True),
}  # fmt: skip


@pytest.mark.parametrize(("read", "mover", "is_doubtful", "is_other_doubtful"), PLACES.values(), ids=PLACES)
def test_what_speaks_against_a_name_or_a_place_is_a_doubt(
    read: Reading, mover: str | None, is_doubtful: bool, is_other_doubtful: bool
) -> None:
    things = SeenThings(REGIONS, frozenset({ELSEWHERE}))
    settled, misplaced, _ = settle_places(read, things)
    said = WordsReading(Reading(grounding=None if mover is None else GroundingRequest(object=mover)))
    settled, misnamed = settle_mover(settled, said, WORDS)
    assert mover_of(settled).is_doubtful is is_doubtful
    assert any(each.is_doubtful for each in settled.objects) is is_other_doubtful
    assert bool(misplaced or misnamed) is (is_doubtful or is_other_doubtful)


def test_a_place_that_the_reader_labels_otherwise_is_a_doubt() -> None:
    said = WordsReading(Reading(grounding=GroundingRequest(object="the red ball")))
    settled, misnamed = settle_mover(found("red ball", RED), said, WORDS, label="red box")
    assert (mover_of(settled).is_doubtful, len(misnamed)) == (True, 1)


class Estimating:
    """A reader that may be wrong: its readings one after another, and what it was told against them."""

    source, heeds_objections = "mllm", True

    def __init__(self, *readings: Reading | CowError) -> None:
        self.left, self.objections = list(readings), list[tuple[str, ...]]()

    def read(self, given: ReaderInput) -> ReadResult:
        self.objections.append(given.objections)
        reading = self.left.pop(0)
        if isinstance(reading, CowError):
            raise reading
        return ReadResult(reading)


RIGHT_PLACE, BARE_PLACE = (
    found("red block", (98.0, 101.0, 141.0, 139.0)),
    found("red block", ELSEWHERE),
)
AGAIN = {
    "it looks again and finds it": (RIGHT_PLACE, False),
    "it stays": (BARE_PLACE, True),
    "its second reply cannot be used": (MllmBadReply("nothing usable"), True),
}


@pytest.mark.parametrize(("second", "is_doubtful"), AGAIN.values(), ids=AGAIN)
def test_a_reader_is_asked_once_more_with_what_speaks_against_it(second: Reading | CowError, is_doubtful: bool) -> None:
    image = np.ascontiguousarray(block(floor(), (100, 100, 140, 140), (200, 40, 40)))
    reader = Estimating(BARE_PLACE, second)
    told = ground(run_of(image, reader=lambda: reader, question="What happens?"))
    assert [len(each) for each in reader.objections] == [0, 1]
    assert told.value.is_doubtful is is_doubtful
    assert any("nothing stands" in warning for warning in told.warnings) is is_doubtful
    if not is_doubtful:
        assert told.value.bbox == (100.0, 100.0, 140.0, 140.0), "moved onto what is seen there"


def test_a_reading_that_nothing_speaks_against_is_not_asked_again() -> None:
    image = np.ascontiguousarray(block(floor(), (100, 100, 140, 140), (200, 40, 40)))
    reader = Estimating(RIGHT_PLACE)
    assert not ground(run_of(image, reader=lambda: reader, question="What happens?")).value.is_doubtful
