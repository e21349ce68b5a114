"""Answers without a model: what a question asks for, what decides it, and what `POST /answer` and `cow answer` say."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from pathlib import Path

import pytest
from conftest import EXAMPLES, all_scenes, example
from drawn import ball, block, floor, png_bytes
from hypothesis import given, settings
from hypothesis import strategies as st
from outcomes import AT, CHOICES, COUNT, FIRST, HIT, NO, WHEN, YES, outcome, simulated
from sdk import SIMULATION

from cow_service.media.images import encode_png
from cow_service.narration.words import phrases_of
from cow_service.readers.base import AnswerReading
from cow_service.readers.embedded.answers import answer_from, choose_option, count_of, says_it_happens, seconds_of
from cow_service.readers.embedded.english.asked import read_alternatives, read_asked
from cow_service.readers.embedded.english.questions import parse
from cow_service.readers.options import (
    choices_source,
    not_sure_option,
    option_saying,
    read_choices,
    says_not_sure,
)
from cow_service.records import Answer, AnswerOption, Asked, Outcome, Simulation
from cow_service.requests import AnswerRequest, OptionRequest
from cow_service.service import Service

YES_NO = read_choices("Will it? (A) Yes (B) No (C) Not sure", None)
IF = "If the red ball rolls left, "


def asked_of(text: str) -> Asked | None:
    return read_asked(parse(IF + text if text[0].islower() else text))


# What is asked, then form, relation, target (- for any) and "not" where it is negated.
ASKED = """
will it hit the yellow cube? | whether touches yellow cube
will it collide with the green cone? | whether touches green cone
does the ball bump into the vase? | whether touches vase
will the vase be hit by the ball? | whether touches vase
Will the vase be hit if the red ball rolls left? | whether touches vase
Is the vase going to be hit when the red ball rolls backwards? | whether touches vase
is the vase going to be knocked? | whether touches vase
does the vase get hit? | whether touches vase
will it land on the cube? | whether touches cube
will it fall on top of the cube? | whether touches cube
will it make contact with the cube? | whether touches cube
will it come into contact with the cube? | whether touches cube
will there be a collision between the ball and the cube? | whether touches cube
will the ball and the cube touch each other? | whether touches cube
will it reach the cube? | whether touches cube
will it crash into the cube? | whether touches cube
does it end up hitting the cube? | whether touches cube
do you think it will strike the cube? | whether touches cube
can you tell whether it will hit the cube? | whether touches cube
will it hit the cube or not? | whether touches cube
will the ball touch the cube at any point? | whether touches cube
will it land in the bowl? | whether inside bowl
will it roll into the bowl? | whether inside bowl
will the vase be hit by the red ball? | whether touches vase
will the vase be knocked over? | whether tips vase
will it knock over the vase? | whether tips vase
will it knock the vase over? | whether tips vase
will the vase fall over? | whether tips vase
will the vase topple? | whether tips vase
will it tip over? | whether tips red ball
will the vase move? | whether moves vase
will the vase stay where it is? | whether moves vase not
will it push the vase? | whether moves vase
will it leave the image? | whether leaves -
will it roll out of the picture? | whether leaves -
will it stay visible? | whether covered - not
is it true that it hits the vase? | whether touches vase
will it miss the vase, yes or no? | whether touches vase not
would the red ball rolling left collide with the vase? | whether touches vase
how long does it take the ball to reach the vase? | when touches vase
where does it come down? | where touches -
where will it land? | where touches -
where will the red ball stop? | where touches -
what happens? | what-happens touches -
what will happen to the vase? | what-happens touches vase
does the red ball go behind the vase? | whether covered vase
will it hit anything? | whether touches -
will it collide with anything? | whether touches -
will it collide? | whether touches -
will it come into contact with any of the objects? | whether touches -
will anything be hit? | whether touches -
will the red vase be occluded at some moment? | whether covers red vase
will it hide the vase? | whether covers vase
does the vase get hidden? | whether covers vase
will the vase be blocked from view? | whether covers vase
will it block the view of the vase? | whether covers vase
will it pass in front of the vase? | whether covers vase
will it be hidden behind the blue box? | whether covered blue box
will it disappear behind the blue box? | whether covered blue box
will the blue box hide it? | whether covered blue box
will it pass behind the vase? | whether covered vase
will it be occluded? | whether covered -
will it not hit the vase? | whether touches vase not
will it miss the vase? | whether touches vase not
will it avoid the vase? | whether touches vase not
will it avoid hitting the vase? | whether touches vase not
will it pass without touching the vase? | whether touches vase not
will it pass the vase without touching it? | whether touches vase not
will it hit nothing? | whether touches - not
will it not touch anything? | whether touches - not
will it avoid all the objects? | whether touches - not
will the vase stay visible? | whether covers vase not
will the vase not be hidden? | whether covers vase not
will it not be hidden by the vase? | whether covered vase not
which object will it hit first? | which-first touches -
what does it hit first? | which-first touches -
which object is the first to be hit? | which-first touches -
what is the first object it hits? | which-first touches -
Which object will the red ball hit if it moves left? | which-first touches -
which object will it hide first? | which-first covers -
will it hit the red cube or the blue mug first? | which-first touches -
when will it hit the vase? | when touches vase
after how many seconds will it hit the vase? | when touches vase
how long does it take to hit the vase? | when touches vase
how long until the vase is hit? | when touches vase
when exactly will it hit the vase? | when touches vase
when will it first touch anything? | when touches -
when will the vase be hidden? | when covers vase
how many objects will it hit? | how-many touches -
how many of the other objects are hit? | how-many touches -
how many objects does it hide? | how-many covers -
Will the small car, moving in the direction of the arrow, touch the blue bottle? | whether touches blue bottle
If the fan blows the leaf to the left, will it reach the pond? | whether touches pond
There is a red ball next to a blue cup. If it rolls left, will the cup be hit? | whether touches blue cup
If the red ball moves opposite to where the arrow points will it hit the vase? Answer yes or no. | whether touches vase
If the purple mug is removed and the black ball moves along the arrow, will it hit the cup? | whether touches cup
If the red ball rolls left without the vase, will it hit the cube? | whether touches cube
Suppose the vase were not there. If the red ball rolls left, will it hit the cube? | whether touches cube
If I put the cyan cube into the pink bowl, will it fit inside? | whether inside pink bowl
If the orange ball flies on along the trail of positions that is shown, will it hit the cube? | whether touches cube
will it cover any part of the vase? | whether covers vase
will it hide a part of the vase? | whether covers vase
will part of it be hidden behind the vase? | whether covered vase
will it be partly hidden by the vase? | whether covered vase
will it stay completely visible? | whether covered - not
will the vase remain fully visible? | whether covers vase not
will the vase be covered at any time? | whether covers vase
is it hidden for a moment? | whether covered -
when will it start to cover the vase? | when covers vase
does it get as far as the vase? | whether touches vase
will it touch any other object? | whether touches -
would it stay there? | whether moves red ball not
Has the red ball touched the vase if it rolls left? | whether touches vase
Sent straight towards the vase, does the red ball hit it? | whether touches vase
If the red ball slides halfway towards the blue one and stops, will it touch the blue ball? | whether touches blue ball
Red ball rolls left - hits the vase? | whether touches vase
Let go of the red ball. lands on the vase? | whether touches vase
The red ball rolls left and at the same time the blue ball goes up. Will the two collide? | whether touches blue ball
The red ball rolls left and the blue ball rolls right. Do they meet? | whether touches blue ball
Were the cup to vanish, would the red ball rolling along the green arrow hit the vase? | whether touches vase
How would its path change if it rolls left and the vase is removed? | changes touches -
Will it hit the vase if the red ball keeps rolling left? | whether touches vase
Will the red ball hit the vase if it kept going to the left? | whether touches vase
If the red ball rolls off to the left, does it hit the vase? | whether touches vase
If the red ball keeps on rolling to the left, does it hit the vase? | whether touches vase
Which mug is hit first by the red ball if it rolls left? | which-first touches -
How many objects will the red ball hit on its way along the arrow? | how-many touches -
True or false? If the red ball rolls left, it misses the vase. | whether touches vase not
True or false: the red ball hits the vase if it rolls left. | whether touches vase
The vase slides left by 20 pixels while the red ball drops. Does the ball land on the vase? | whether touches red ball
Will the falling ball hit the vase? | whether touches vase
True or false: sent straight towards the vase, the red ball hits it. | whether touches vase
Move the red ball 90 pixels to the left, then let it drop. Does it come down on the vase? | whether touches vase
"""

# What is asked of several things: among which, then "each" and "not" where that is asked.
OF_SEVERAL = """
will it hit both mugs? | both mugs | each
will it avoid both mugs? | both mugs | not
will either mug be hit? | either mug |
will it hit neither of the two cubes? | neither two cubes | not
is it hidden by any of the cones? | cones |
does it touch all the other balls? | other balls | each
will both cones stay visible? | both cones | not
will any of the cones stay visible? | cones | each not
will it hit a cube? | a cube |
There are a cube and a cone. If the red ball rolls left, which of the two does it hit first? | cube, cone |
"""


@pytest.mark.parametrize("row", OF_SEVERAL.strip().splitlines())
def test_what_is_asked_of_several_things(row: str) -> None:
    question, among, how = (part.strip() for part in row.split("|"))
    asked = asked_of(question)
    assert asked is not None
    assert asked.among == tuple(among.split(", "))
    assert (asked.every, asked.negated, asked.target) == ("each" in how, "not" in how, None)


@pytest.mark.parametrize("what", ["not hit both mugs", "hit any two of the mugs", "hit them", "miss neither mug"])
def test_what_is_open_of_several_things_is_not_read(what: str) -> None:
    assert asked_of(f"will it {what}?") is None


@pytest.mark.parametrize("row", ASKED.strip().splitlines())
def test_what_is_asked(row: str) -> None:
    question, told = row.split(" | ")
    form, relation, *target = told.split()
    negated = target[-1] == "not"
    name = " ".join(target[:-1] if negated else target)
    told = asked_of(question)
    assert told is not None
    expected = Asked.model_validate(
        {"form": form, "relation": relation, "target": None if name == "-" else name, "negated": negated}
    )
    assert told.model_copy(update={"among": (), "partly": False}) == expected


@pytest.mark.parametrize(
    ("question", "field", "value"),
    [
        ("will it cover any part of the vase?", "partly", True),
        ("will the vase remain fully visible?", "partly", True),
        ("will it hide the vase?", "partly", False),
        ("will it hit the vase within 2 seconds?", "within", 2.0),
        ("will it have hit the vase after two seconds?", "within", 2.0),
        ("will it hit the cup behind the vase?", "target", "cup"),
        ("will it hit the vase?", "within", None),
    ],
)
def test_limits_of_what_is_asked(question: str, field: str, value: object) -> None:
    told = asked_of(question)
    assert told is not None
    assert getattr(told, field) == value


@pytest.mark.parametrize(
    ("question", "named"),
    [
        ("will it hit the red cube or the blue mug first?", ["red cube", "blue mug"]),
        ("will it hit the red cube or the blue mug?", ["red cube", "blue mug"]),
        ("which will it hit first, the red cube or the blue mug?", ["red cube", "blue mug"]),
        ("Which of these will the red ball hit first if it moves left: a cube, a vase, or a mug?",
         ["cube", "vase", "mug"]),
        ("Which object does the red ball hit first if it falls? The cube or the mug?", ["cube", "mug"]),
        ("which ball will it hit first?", ["ball"]),
        ("Which mug is hit first by the ball if it rolls left, the blue or the white?", ["blue", "white"]),
        ("which cube will it hit first, the red one or the blue one?", ["red cube", "blue cube"]),
        ("which object will it hit first?", []),
        ("will it hit the vase?", []),
    ],
)  # fmt: skip
def test_among_which_things_the_first_is_asked_for(question: str, named: list[str]) -> None:
    parsed = parse(IF + question if question[0].islower() else question)
    assert [phrase.text for phrase in read_alternatives(parsed)] == named


UNREAD = """
will it hit the vase before it hits the cube?
will it hit the vase and the cube?
will it hit all the objects?
will it hit every object?
will it hit two objects?
will it hit one object?
will it hit the object?
will it hit the vase twice?
will it hit the vase hard?
will it hit the vase first?
will it hit anything but the vase?
will it hit the vase by bouncing off the wall?
will it almost hit the vase?
will it only hit the vase?
will it still hit the vase?
will it not miss the vase?
won't it hit the vase?
will it lose contact with the vase?
will it smash the vase?
will it be blocked by the vase?
will it completely hide the vase?
will the vase be hidden at the end?
will the vase still be visible?
will it hit the vase after two seconds?
will it disappear?
will it stop behind the vase?
will it land behind the cube?
will it come to rest on the cube?
will it turn green?
is it impossible for it to hit the vase?
is it false that it hits the vase?
is it likely to hit the vase?
how likely will it hit the vase?
how long will the vase be hidden?
when will it miss the vase?
how fast will it hit the vase?
at which speed will it hit the vase?
when precisely will it miss the vase?
will they collide?
when will it stop?
how many times will it hit the vase?
how many objects will it knock over?
which objects will it hit?
which object does it touch last?
which object will it hit second?
If the red ball rolls left, will the vase be hit? And will the cube be hit?
If the red ball moves left and the blue ball moves right, will it hit the cube?
If the red ball is rolled straight at the cup, will that then hit the cube?
The red ball rolls left and the vase slides right, both slowly. Do they meet?
If the red ball rolls left and hits the cube, will it hit the vase?
Will the red ball hit something if it rolls left, the vase or the cube?
"""


@pytest.mark.parametrize("question", UNREAD.strip().splitlines())
def test_what_is_not_put_plainly_is_left_undecided(question: str) -> None:
    assert asked_of(question) is None


def test_what_stands_on_the_floor_does_not_land_there(service: Service) -> None:
    image = encode_png(block(ball(floor(), (150, 200), 40, (200, 30, 30)), (430, 150, 520, 250), (50, 80, 200)))
    told = answered(service, image, "If the red ball rolls to the right, will it hit the floor?", options=["Yes", "No"])
    assert told.simulation is not None
    assert told.simulation.trajectory.outcome is not None
    assert (told.simulation.trajectory.outcome.asked.relation, told.not_sure) == ("lands", True)


VOCABULARY = sorted({word for line in (ASKED + UNREAD).splitlines() for word in re.findall(r"[\w']+|[?,.:]", line)})


@settings(deadline=None)
@given(st.one_of(st.text(max_size=80), st.lists(st.sampled_from(VOCABULARY), max_size=30).map(" ".join)))
def test_no_question_breaks_the_reading(text: str) -> None:
    read_asked(parse(text))
    read_alternatives(parse(text))
    for option in read_choices(text, None):
        assert option.letter
        says_it_happens(option.text, HIT)
        seconds_of(option.text)
        count_of(option.text)


EXTRA = ("not", "almost", "before", "and the cube", "twice", "unless it stops", "last", "hardly")


@given(st.sampled_from(EXTRA), st.integers(0, 4), st.sampled_from(["hit", "touch", "hide", "reach"]))
def test_no_further_word_is_passed_over(extra: str, place: int, verb: str) -> None:
    words = f"will it {verb} the vase".split()
    plain, asked = (
        asked_of(" ".join(words) + "?"),
        asked_of(" ".join([*words[: place + 1], extra, *words[place + 1 :]]) + "?"),
    )
    assert plain is not None
    assert asked is None or asked.negated or asked.target not in {"vase", None}


@pytest.mark.parametrize(
    ("question", "given", "expected"),
    [
        ("Will it? (A) Yes, (B) No or (C) Not sure.", None, [("A", "Yes"), ("B", "No"), ("C", "Not sure")]),
        ("Will it?\nA. Yes\nB. No", None, [("A", "Yes"), ("B", "No")]),
        ("Will it? (A) Yes (B) No", ["the vase", "the mug"], [("A", "the vase"), ("B", "the mug")]),
        ("Will it?", ["(A) Yes", "B. No", "C) Not sure"], [("A", "Yes"), ("B", "No"), ("C", "Not sure")]),
        ("Will it?", ["A car", "B-movie"], [("A", "A car"), ("B", "B-movie")]),
        ("Will it?", None, []),
        ("Does car (A) hit car (B)?", None, []),
        ("If the ball at point A. moves to point B. will it hit?", None, []),
        ("Will car (A) hit car (B) or car (C)? (A) Yes (B) No", None, [("A", "Yes"), ("B", "No")]),
        ("Will it?\n- A) Yes\n- B) No", None, [("A", "Yes"), ("B", "No")]),
        ("Will it? **A)** Yes **B)** No", None, [("A", "Yes"), ("B", "No")]),
        ("Will it?\na. Yes\nb. No", None, [("A", "Yes"), ("B", "No")]),
        ("Will it? (A) Yes (C) No (B) Not sure", None, []),
        ("When?", ["A.M.", "P.M."], [("A", "A.M."), ("B", "P.M.")]),
        ("Will it?", ["No\n(B) Yes", "Maybe"], [("A", "No (B) Yes"), ("B", "Maybe")]),
        ("Will it?", [], []),
    ],
)
def test_choices(question: str, given: list[str] | None, expected: list[tuple[str, str]]) -> None:
    assert [(option.letter, option.text) for option in read_choices(question, given)] == expected


@pytest.mark.parametrize(
    ("text", "unsure"),
    [
        ("Not sure", True),
        ("I am not quite sure", True),
        ("Cannot be determined", True),
        ("can't tell", True),
        ("Cannot tell from the image", True),
        ("Unknown", True),
        ("No", False),
        ("It surely does", False),
        ("It cannot reach it", False),
        ("Certainly", False),
    ],
)
def test_texts_that_say_not_sure(text: str, unsure: bool) -> None:
    assert says_not_sure(text) == unsure


def test_an_option_is_found_by_its_text_alone_only_where_it_is_one() -> None:
    assert option_saying(YES_NO, " yes. ") == YES_NO[0]
    assert option_saying(YES_NO, "maybe") is None
    assert option_saying(YES_NO, "") is None
    assert not_sure_option(YES_NO) == YES_NO[2]
    assert (
        not_sure_option(read_choices("", ["Yes", "Unknown", "Not sure"])) == read_choices("", ["?", "Unknown", "!"])[1]
    )


def test_options_come_with_letters_of_their_own_and_say_where_from() -> None:
    pairs = [OptionRequest(letter="C", text="It  hits"), OptionRequest(letter="D", text="No")]
    assert [(each.letter, each.text) for each in read_choices("?", pairs)] == [("C", "It hits"), ("D", "No")]
    asked = "Will it hit the vase? "
    sources = [choices_source(asked + tail, None) for tail in ("(A) Yes (B) No", "Options: yes or no", "Yes or no?")]
    assert [*sources, choices_source(asked, pairs)] == ["question-letters", "question-list", "none", "request"]


EN = phrases_of("en")


def chosen(world: Outcome, options: Sequence[AnswerOption]) -> AnswerReading:
    return choose_option(options, world, simulated(world).narration, EN)


@pytest.mark.parametrize(("world", "options", "answer"), CHOICES)
def test_the_option_that_says_what_the_world_says(world: Outcome, options: list[str], answer: str | None) -> None:
    reading = chosen(world, read_choices("?", options))
    assert (reading.answer, reading.not_sure) == (answer, answer is None)
    assert re.match("Not sure|Probably", reading.reasoning) is None or answer is None
    unsure = chosen(world, read_choices("?", [*options, "Not sure"]))
    assert unsure.not_sure == (answer is None)
    assert unsure.answer == (answer or "ABCDEF"[len(options)] if "Not sure" not in options else unsure.answer)


@pytest.mark.parametrize(
    ("world", "said", "why"),
    [
        (YES, "Yes", "Yes, it hits the vase. 47 of 50 simulated versions agree."),
        (NO, "No", "No, it misses the vase. 48 of 50 simulated versions agree."),
        (outcome(FIRST, first="red cube"), "red cube", "The red cube. 47 of 50 simulated versions agree."),
        (outcome(FIRST), "Nothing", "It hits nothing. 47 of 50 simulated versions agree."),
        (AT, "After about 1.1 s", "After about 1.1 s (1.0 to 1.3 s in most simulated versions). 47 of 50 simulated "
         "versions agree."),
        (outcome(WHEN, 0.04, time=0.9), "Never", "It misses the vase. 48 of 50 simulated versions agree."),
        (outcome(COUNT, count=2), "2", "2 objects. 47 of 50 simulated versions agree."),
        (outcome(COUNT, count=1), "1", "One object. 47 of 50 simulated versions agree."),
    ],
)  # fmt: skip
def test_an_open_question_is_answered_in_words(world: Outcome, said: str, why: str) -> None:
    assert chosen(world, ()) == AnswerReading(said, False, why)


@pytest.mark.parametrize(
    ("world", "why"),
    [
        (outcome(HIT, object=None, sure=False), "Not sure: what the question asks about was not found"),
        (outcome(HIT, None, sure=False), "Not sure: the objects in the image could not be told apart"),
        (
            outcome(HIT, 0.62, sure=False, depends_on=("heading", "speed")),
            "Not sure: in 31 of 50 simulated versions it hits the vase; it depends most on which way it heads in depth",
        ),
        (outcome(HIT, 0.18, sure=False), "Probably not: in 41 of 50 simulated versions it misses the vase."),
        (
            outcome(FIRST, 0.4, first="red cube", sure=False),
            "Not sure: in 20 of 50 simulated versions the first one is the red cube.",
        ),
    ],
)
def test_why_it_is_not_sure(world: Outcome, why: str) -> None:
    reading = chosen(world, YES_NO)
    assert (reading.answer, reading.not_sure) == ("C", True)
    assert reading.reasoning.startswith(why)


def test_what_no_world_can_tell_is_said_so() -> None:
    def why(asked: Asked | None, simulation: Simulation | None) -> str:
        return answer_from(YES_NO, asked, simulation, EN).reasoning

    assert "did not understand the question" in why(None, simulated(YES))
    assert "without a simulation" in why(HIT, None)
    assert "does not tell" in why(HIT, Simulation.model_validate(SIMULATION))
    untold = outcome(HIT, probability=None, sure=False)
    assert "told apart" in why(HIT, simulated(untold))
    assert "no versions were simulated" in why(HIT, simulated(untold, ensemble=0))
    among = read_alternatives(parse(IF + "will it hit the red cube or the blue mug first?"))
    other = answer_from((), FIRST, simulated(outcome(FIRST, first="green cone")), EN, among)
    assert other.not_sure
    assert "green cone" in other.reasoning
    assert answer_from((), FIRST, simulated(outcome(FIRST, first="blue mug")), EN, among).answer == "blue mug"


def answered(service: Service, image: bytes, question: str, **body) -> Answer:
    kept = service.keep_image(image)
    request = {"image": {"artifact": kept.sha256}, "question": question, "video": False} | body
    return service.answer(AnswerRequest.model_validate(request))


def test_to_stay_where_it_is_put_is_to_end_there(service: Service) -> None:
    image = block(block(floor(640, 400), (120, 220, 320, 320), (40, 60, 200)), (420, 260, 470, 320), (40, 160, 60))
    question = "If the green cube is put onto the blue block, will it stay there?"
    told = answered(service, png_bytes(image), question, options=["Yes", "No"])
    assert told.simulation is not None
    outcome = told.simulation.trajectory.outcome
    assert outcome is not None
    assert (outcome.asked.relation, outcome.asked.negated) == ("inside", False)
    assert told.answer == "A" or told.not_sure
    assert "stays on top" in told.simulation.narration.story


@pytest.mark.scaled
def test_the_scenes_are_answered_right_or_not_at_all(service: Service) -> None:
    outcomes: list[str] = []
    for folder in all_scenes():
        meta = json.loads((folder / "meta.json").read_text())
        told = answered(service, (folder / "image.jpg").read_bytes(), meta["question"])
        outcomes.append("not sure" if told.not_sure else "right" if told.answer == meta["answer"] else "wrong")
    assert "wrong" not in outcomes
    assert outcomes.count("right") >= 0.7 * len(outcomes)


@pytest.mark.parametrize(
    ("scene", "noun", "other"),
    [
        ("ball-and-mug", "mug", "dragon"),
        ("ball-and-mug", "ball", "horse"),
        ("bottle-passes-cylinder", "bottle", "lion"),
    ],
)
def test_nothing_is_sure_of_what_looks_like_something_else(service: Service, scene: str, noun: str, other: str) -> None:
    called = example(scene)
    question = called.meta["question"].replace(noun, other)
    told = answered(service, called.image, question)
    assert told.not_sure
    assert told.simulation is not None
    outcome = told.simulation.trajectory.outcome
    assert outcome is not None
    assert (outcome.probability or 0) >= 0.9, "the worlds agree: in doubt is whether these are the things meant"
    assert outcome.depends_on[0] == "identity"
    assert any(f"looks like a {noun}, not '{other}'" in warning for warning in told.warnings)


@pytest.mark.parametrize(
    ("scene", "noun", "other"),
    [("falling-ball", "cylinder", "bowl"), ("bottle-passes-cylinder", "cylinder", "gizmo")],
)
def test_nothing_is_sure_of_what_is_not_as_it_is_called(service: Service, scene: str, noun: str, other: str) -> None:
    called = example(scene)
    assert not answered(service, called.image, called.meta["question"]).not_sure
    told = answered(service, called.image, called.meta["question"].replace(noun, other))
    assert told.not_sure
    assert other in " ".join(told.warnings)


@pytest.mark.parametrize("itself", ["the yellow ball", "itself", "the ball"])
def test_nothing_meets_itself(service: Service, itself: str) -> None:
    question = f"If the yellow ball moves opposite to the direction of the arrow, will it hit {itself}?"
    told = answered(service, example("ball-and-mug").image, question)
    assert told.not_sure
    assert any("cannot hit itself" in warning for warning in told.warnings)
    assert not any("not understood" in warning for warning in told.warnings)


def test_a_car_whose_way_is_not_known_is_not_guessed_about(service: Service) -> None:
    scene = example("car-forward")
    told = answered(service, scene.image, scene.meta["question"].replace(" forward", ""))
    assert (told.simulation, told.not_sure) == (None, True)
    assert "cannot-read-direction" in told.warnings[0]
    assert "without a simulation" in told.reasoning


def test_a_rolling_ball_is_answered_from_its_world(service: Service) -> None:
    image = encode_png(block(ball(floor(), (150, 200), 40, (200, 30, 30)), (430, 150, 520, 250), (50, 80, 200)))
    question = "If the red ball rolls to the {}, will it hit the blue cube? (A) Yes (B) No (C) Not sure"
    camera = {"pitch": 28}  # it is drawn without perspective, as if from far away
    right = answered(service, image, question.format("right"), votes=3, baseline=True, camera=camera)
    assert (right.answer, right.option, right.not_sure, right.votes) == ("A", "Yes", False, {"A": 3})
    assert right.reasoning.startswith("Yes, it hits the blue cube after about ")
    assert right.warnings == ("The embedded reader gives the same answer every time: more votes say no more.",)
    assert right.baseline is not None
    assert right.simulation is not None
    assert right.reasoning == right.simulation.narration.summary
    assert (right.baseline.answer, right.baseline.not_sure) == ("C", True)
    assert right.usage.calls == 0
    assert answered(service, image, question.format("left"), camera=camera).answer == "B"
    assert answered(service, image, question.format("right"), imagine="never").not_sure


def test_what_is_wrong_with_the_request_is_not_fallen_back_from(service: Service) -> None:
    image = encode_png(floor())
    with pytest.raises(Exception, match="generator_options"):
        answered(service, image, "Will it move?", generator_options={"nonsense": 1})
    with pytest.raises(Exception, match="There is no reader"):
        answered(service, image, "Will it move?", reader="nobody")


@pytest.mark.parametrize(
    ("body", "told"),
    [
        ({"options": ["Yes"]}, "two or more"),
        ({"options": ["Yes", " yes "]}, "two or more"),
        ({"options": [{"letter": "A", "text": "Yes"}, {"letter": "A", "text": "No"}]}, "different letters"),
        ({"options": [{"letter": "A", "text": "Yes"}, "No"]}, "valid"),
        ({"votes": 0}, "greater than or equal to 1"),
        ({"votes": 33}, "less than or equal to 32"),
        ({"imagine": "maybe"}, "'always', 'auto' or 'never'"),
    ],
)
def test_requests_that_cannot_be_meant(body, told: str) -> None:
    with pytest.raises(ValueError, match=told):
        AnswerRequest.model_validate({"image": "data:,", "question": "?", **body})


def test_over_http(http) -> None:
    scene = EXAMPLES / "ball-and-mug"
    question = json.loads((scene / "meta.json").read_text())["question"]
    with (scene / "image.jpg").open("rb") as image:
        response = http.post("/answer", files={"image": image}, data={"question": question, "request": '{"votes": 2}'})
    told = Answer.model_validate(response.json())
    assert (told.answer, told.votes, told.timings.keys() >= {"answering"}) == ("A", {"A": 2}, True)
    assert told.simulation is not None
    assert http.get(told.simulation.frames[0].url).status_code == 200
    problem = http.post("/answer", json={"question": "?", "image": "data:,", "votes": "many"})
    assert (problem.status_code, problem.json()["errors"][0]["pointer"]) == (422, "/votes")


def test_the_folder_of_an_answer(tmp_path: Path) -> None:
    """`cow answer --out` leaves the simulation's files and answer.json; without it, nothing but words."""
    from command_line import cow_from_nothing as cow

    image = str(EXAMPLES / "ball-and-mug" / "image.jpg")
    question = "If the yellow ball moves opposite to the direction of the arrow, will it hit the blue mug?"
    said = cow(tmp_path, "answer", image, question, "--choice", "Yes", "--choice", "No", "--out", "out")
    assert "A (Yes)" in said.stdout
    assert "votes" not in said.stdout
    assert Answer.model_validate_json((tmp_path / "out" / "answer.json").read_text()).answer == "A"
    assert (tmp_path / "out" / "overlay.jpg").exists()
    said = cow(tmp_path, "answer", image, question, "--no-imagine", "--baseline", "--votes", "2", "--json")
    told = Answer.model_validate_json(said.stdout)
    assert (told.simulation, told.not_sure, told.votes) == (None, True, {"not sure": 2})
    assert sorted(path.name for path in tmp_path.iterdir() if path.is_dir()) == ["data", "out"]


@pytest.mark.parametrize(
    ("question", "told"),
    [
        ("If the ball moves left and the car moves right, will they collide?", Asked(relation="touches", target="car")),
        (
            "If the vase is removed and the ball rolls left, will it still hit the cup?",
            Asked(relation="touches", target="cup"),
        ),
        (
            "If the ball rolls left, would the outcome change if the vase were removed?",
            Asked(form="changes", relation="touches"),
        ),
        (
            "At 9 px/s, would the ball have hit the cup after 4 seconds of rolling to the left?",
            Asked(relation="touches", target="cup", within=4.0),
        ),
        (
            "If the ball rolls left, will the cube be hidden by the cup?",
            Asked(relation="covered", subject="cube", target="cup"),
        ),
        (
            "If the ball rolls left, will the cube be hit by the cup?",
            Asked(relation="touches", subject="cup", target="cube"),
        ),
    ],
)
def test_what_is_asked_of_others_than_the_mover(question: str, told: Asked) -> None:
    assert asked_of(question) == told
