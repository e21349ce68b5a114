"""What is given, said, seen and read: the surest source decides, and what contradicts it is a doubt."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import Any, NamedTuple

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cow_service.physics.lift import DIRECTION_DEVIATIONS
from cow_service.readers.base import GroundingReading, MotionReading, NamedChange, QuestionReading, WayReading
from cow_service.records import Asked, Cue, Intervention, LocatedObject, Vector
from cow_service.stages.settling import APART, SeenWay, angle, settle_question, settle_way

RIGHT, LEFT, DOWN = (1.0, 0.0), (-1.0, 0.0), (0.0, 1.0)
MOVER = (100.0, 100.0, 140.0, 140.0)
VASE = LocatedObject(object="vase", bbox=(100.0, 300.0, 140.0, 380.0))
READ = MotionReading("linear", RIGHT, "orientation", direction_deviation=20.0, sentence="The ball rolls on.")


def turned(degrees: float) -> tuple[float, float]:
    return math.cos(math.radians(degrees)), math.sin(math.radians(degrees))


class Rule(NamedTuple):
    """What is read instead of `READ`, said and seen; the direction it becomes, by what, and whether in doubt."""

    direction: Vector | None
    cue: Cue
    read: Mapping[str, Any] = MappingProxyType({})
    said: WayReading = WayReading()
    seen: SeenWay = SeenWay()
    is_doubtful: bool = False


ARROW, AGAINST, TO_THE_RIGHT = SeenWay(RIGHT), WayReading(along_arrow=False), WayReading(direction=RIGHT)
TOWARDS, AT_VASE = WayReading(towards="vase"), SeenWay(goal=VASE)
RULES = {
    "what is not estimated stays": Rule(RIGHT, "orientation", {"direction_deviation": None}, seen=SeenWay(DOWN)),
    "nothing else tells": Rule(RIGHT, "orientation"),
    "an arrow is surer than what is read": Rule(RIGHT, "arrow", {"direction": turned(20)}, seen=ARROW),
    "what is read tells the sense": Rule(LEFT, "arrow", {"direction": turned(160)}, seen=ARROW),
    "the reader says it": Rule(LEFT, "arrow", {"direction": turned(170), "along_arrow": False}, seen=ARROW),
    "the reader contradicts itself": Rule(LEFT, "arrow", {"along_arrow": False}, seen=ARROW, is_doubtful=True),
    "the words say it": Rule(LEFT, "arrow", {"direction": LEFT, "along_arrow": True}, AGAINST, ARROW),
    "the reader passes over the words": Rule(LEFT, "arrow", {}, AGAINST, ARROW, is_doubtful=True),
    "far from the arrow": Rule(RIGHT, "arrow", {"direction": turned(50)}, seen=ARROW, is_doubtful=True),
    "words tell the direction": Rule(RIGHT, "text", {"direction": turned(30)}, TO_THE_RIGHT),
    "far from the words": Rule(RIGHT, "text", {"direction": turned(50)}, TO_THE_RIGHT, is_doubtful=True),
    "an arrow that the words contradict": Rule(DOWN, "arrow", {}, TO_THE_RIGHT, SeenWay(DOWN), is_doubtful=True),
    "towards a thing": Rule(DOWN, "text", {"direction": DOWN}, TOWARDS, AT_VASE),
    "towards a thing elsewhere": Rule(DOWN, "text", {}, TOWARDS, AT_VASE, is_doubtful=True),
    "only the arrow tells": Rule(DOWN, "arrow", {"direction": None}, seen=SeenWay(DOWN)),
    "only the words tell": Rule(RIGHT, "text", {"direction": None}, TO_THE_RIGHT),
    "nobody says anything": Rule(None, "orientation", {"direction": None}),
}


@pytest.mark.parametrize("rule", RULES.values(), ids=RULES)
def test_the_surest_source_decides(rule: Rule) -> None:
    read = replace(READ, **rule.read)
    settled = settle_way(read, rule.said, rule.seen, MOVER)
    assert settled.direction == rule.direction or angle(settled.direction or RIGHT, rule.direction or LEFT) < 1e-6
    assert (settled.cue, settled.is_doubtful, bool(settled.warnings)) == (rule.cue, rule.is_doubtful, rule.is_doubtful)
    assert (settled.sentence is None) is rule.is_doubtful, "its sentence was worded for another direction"
    assert settled.direction_deviation == (None if rule.cue != read.cue else read.direction_deviation)
    assert settled.towards == (VASE if rule.said.towards else None)


@given(
    st.floats(-180, 180), st.floats(0, 360), st.sampled_from([None, True, False]), st.sampled_from([None, True, False])
)
def test_along_a_drawn_arrow_or_against_it_and_never_between(
    off: float, arrow: float, along: bool | None, said: bool | None
) -> None:
    read = replace(READ, direction=turned(arrow + off), along_arrow=along)
    settled = settle_way(read, WayReading(along_arrow=said), SeenWay(turned(arrow)), MOVER)
    assert settled.direction is not None
    gap = angle(settled.direction, turned(arrow))
    assert gap < 1e-6 or gap > 180 - 1e-6
    assert said is None or (gap < 90) is said
    apart = APART * math.hypot(20.0, DIRECTION_DEVIATIONS["arrow"])
    assert settled.is_doubtful is (angle(turned(arrow + off), settled.direction) > apart)


ASKED = Asked(relation="touches", target="vase")
TAKEN = NamedChange("remove", "box")
REMOVED = Intervention(kind="remove", object=VASE)


# What is given, read and said; what becomes of it, and whether a doubt is left.
QUESTIONS: dict[str, tuple[Asked | None, dict[str, Any], dict[str, Any], Asked | None, bool]] = {
    "as read, where the words were not understood": (None, {"asked": ASKED}, {}, ASKED, False),
    "as the words say, where the reader says nothing": (None, {}, {"asked": ASKED}, ASKED, False),
    "both say the same": (None, {"asked": ASKED}, {"asked": ASKED.model_copy(update={"target": "it"})}, ASKED, False),
    "the reader turns it round": (
        None, {"asked": ASKED.model_copy(update={"negated": True})}, {"asked": ASKED}, ASKED, True
    ),
    "the reader asks something else": (
        None, {"asked": ASKED.model_copy(update={"relation": "covers"})}, {"asked": ASKED}, ASKED, True
    ),
    "what is given": (ASKED, {"asked": Asked(relation="covers")}, {"asked": Asked(relation="tips")}, ASKED, False),
    "both take one thing away": (None, {"interventions": (REMOVED,)}, {"changes": (TAKEN,)}, None, False),
    "the reader forgets what is taken away": (None, {}, {"changes": (TAKEN,)}, None, True),
    "the reader takes something away": (None, {"interventions": (REMOVED,)}, {}, None, True),
}  # fmt: skip


@pytest.mark.parametrize(("given_asked", "read", "said", "asked", "is_doubtful"), QUESTIONS.values(), ids=QUESTIONS)
def test_the_words_decide_what_they_say(
    given_asked: Asked | None, read: dict[str, Any], said: dict[str, Any], asked: Asked | None, is_doubtful: bool
) -> None:
    settled, doubts = settle_question(given_asked, GroundingReading("ball", MOVER, **read), QuestionReading(**said))
    assert (settled, bool(doubts)) == (asked, is_doubtful)
