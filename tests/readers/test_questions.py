"""Questions in English as records, by the parser alone: what moves, what is asked and changed, what is not read."""

from __future__ import annotations

import re

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from cow_service.narration.words import phrases_of
from cow_service.readers.embedded.answers import answer_from, says_it_happens, span_of
from cow_service.readers.embedded.english.questions import parse, rewordings
from cow_service.readers.options import read_choices, without_reply_form
from cow_service.records import Asked

IF = "If the red ball rolls left, "


def asked_of(text: str) -> Asked | None:
    return parse(IF + text if text[0].islower() else text).asked


def rows(table: str) -> list[tuple[str, ...]]:
    return [tuple(part.strip() for part in row.split("|")) for row in table.strip().splitlines()]


# What is asked, then form, relation, target (- for any) and "not" where it is negated.
ASKED = """
will it hit the yellow cube? | whether touches yellow cube
does the ball bump into the vase? | whether touches vase
will the vase be hit by the ball? | whether touches vase
will there be a collision between the ball and the cube? | whether touches cube
will it hit the cube or not? | whether touches cube
will it land in the bowl? | whether inside bowl
will it knock the vase over? | whether tips vase
will it tip over? | whether tips red ball
will the vase move? | whether moves vase
will the vase stay where it is? | whether moves vase not
will it leave the image? | whether leaves -
will it hit the floor? | whether lands -
will it stay visible? | whether covered - not
is it true that it hits the vase? | whether touches vase
where does it come down? | where touches -
what happens? | what-happens touches -
what will happen to the vase? | what-happens touches vase
will anything be hit? | whether touches -
will the red vase be occluded at some moment? | whether covers red vase
will it block the view of the vase? | whether covers vase
will the blue box hide it? | whether covered blue box
will it pass behind the vase? | whether covered vase
will it miss the vase, yes or no? | whether touches vase not
will it avoid hitting the vase? | whether touches vase not
will it pass the vase without touching it? | whether touches vase not
will it hit nothing? | whether touches - not
will the vase not be hidden? | whether covers vase not
will it not be hidden by the vase? | whether covered vase not
which object will it hit first? | which-first touches -
Which object will the red ball hit if it moves left? | which-first touches -
how long until the vase is hit? | when touches vase
when will the vase be hidden? | when covers vase
how many of the other objects are hit? | how-many touches -
There is a red ball next to a blue cup. If it rolls left, will the cup be hit? | whether touches blue cup
If the red ball moves opposite to where the arrow points will it hit the vase? Answer yes or no. | whether touches vase
Suppose the vase were not there. If the red ball rolls left, will it hit the cube? | whether touches cube
If I put the cyan cube into the pink bowl, will it fit inside? | whether inside pink bowl
If the orange ball flies on along the trail of positions that is shown, will it hit the cube? | whether touches cube
will part of it be hidden behind the vase? | whether covered vase
would it stay there? | whether moves red ball not
Sent straight towards the vase, does the red ball hit it? | whether touches vase
If the red ball slides halfway towards the blue one and stops, will it touch the blue ball? | whether touches blue ball
Red ball rolls left - hits the vase? | whether touches vase
The red ball rolls left and at the same time the blue ball goes up. Will the two collide? | whether touches blue ball
Which mug is hit first by the red ball if it rolls left? | which-first touches -
True or false? If the red ball rolls left, it misses the vase. | whether touches vase not
The vase slides left by 20 pixels while the red ball drops. Does the ball land on the vase? | whether touches red ball
Will the falling ball hit the vase? | whether touches vase
"""


@pytest.mark.parametrize(("question", "told"), rows(ASKED))
def test_what_is_asked(question: str, told: str) -> None:
    form, relation, *target = told.split()
    negated = target[-1] == "not"
    name = " ".join(target[:-1] if negated else target)
    expected = Asked.model_validate(
        {"form": form, "relation": relation, "target": None if name == "-" else name, "negated": negated}
    )
    asked = asked_of(question)
    assert asked is not None
    assert asked.model_copy(update={"among": (), "partly": False}) == expected


# What is asked of several things, of others than the mover, or within limits: the record's fields.
LIMITED = """
will it cover any part of the vase? | {"relation": "covers", "target": "vase", "partly": true}
will it hide the vase? | {"relation": "covers", "target": "vase"}
will it hit the vase within 2 seconds? | {"relation": "touches", "target": "vase", "within": 2}
will it hit both mugs? | {"relation": "touches", "among": ["both mugs"], "every": true}
will it avoid both mugs? | {"relation": "touches", "among": ["both mugs"], "negated": true}
will either mug be hit? | {"relation": "touches", "among": ["either mug"]}
will both cones stay visible? | {"relation": "covers", "among": ["both cones"], "negated": true}
will any of the cones stay visible? | {"relation": "covers", "among": ["cones"], "every": true, "negated": true}
will it hit a cube? | {"relation": "touches", "target": "cube"}
If the ball moves left and the car moves right, will they collide? | {"relation": "touches", "target": "car"}
If the vase is removed and it rolls left, will it still hit the cup? | {"relation": "touches", "target": "cup"}
would the outcome change if the vase were removed? | {"form": "changes", "relation": "touches"}
will the cube be hidden by the cup? | {"relation": "covered", "subject": "cube", "target": "cup"}
will the cube be hit by the cup? | {"relation": "touches", "subject": "cup", "target": "cube"}
will the cyan ball hit the cube? | {"relation": "touches", "subject": "cyan ball", "target": "cube"}
"""


@pytest.mark.parametrize(("question", "fields"), rows(LIMITED))
def test_limits_of_what_is_asked_several_things_and_others_than_the_mover(question: str, fields: str) -> None:
    assert asked_of(question) == Asked.model_validate_json(fields)


ALTERNATIVES = """
will it hit the red cube or the blue mug? | red cube, blue mug
which will it hit first, the red cube or the blue mug? | red cube, blue mug
Which of these will the red ball hit first if it moves left: a cube, a vase, or a mug? | cube, vase, mug
Which object does the red ball hit first if it falls? The cube or the mug? | cube, mug
Which mug is hit first by the ball if it rolls left, the blue or the white? | blue, white
which cube will it hit first, the green one or the blue one? | green cube, blue cube
which object will it hit first? |
"""


@pytest.mark.parametrize(("question", "named"), rows(ALTERNATIVES))
def test_among_which_things_the_first_is_asked_for(question: str, named: str) -> None:
    parsed = parse(IF + question if question[0].islower() else question)
    assert ", ".join(phrase.text for phrase in parsed.alternatives) == named


SAME = """
will it block our view of the vase? | will it hide the vase?
is the vase safe? | will the vase not be hit?
the vase or the cube, which one does it crash into? | which does it hit first, the vase or the cube?
does it fall off the edge of the table? | will it land on the floor?
does it make any difference to what it hits? | does the outcome change?
If the red ball falls off the shelf, will it hit the vase? | If the red ball falls, will it hit the vase?
"""


@pytest.mark.parametrize(("said", "plain"), rows(SAME))
def test_a_paraphrase_asks_the_same(said: str, plain: str) -> None:
    found, expected = asked_of(said), asked_of(plain)
    assert expected is not None
    assert found is not None
    assert found.model_copy(update={"partly": expected.partly}) == expected


UNREAD = """
will it hit the vase before it hits the cube?
will it hit all the objects?
will it hit the object?
will it hit anything but the vase?
will it hit the vase by bouncing off the wall?
will it not miss the vase?
will it be blocked by the vase?
will it hit the vase after two seconds?
will it disappear?
is it impossible for it to hit the vase?
how long will the vase be hidden?
how fast will it hit the vase?
will they collide?
when will it stop?
how many objects will it knock over?
which object does it touch last?
will it not hit both mugs?
is there a moment when it doesn't hide the vase?
can we still see the vase?
will it hit the cup behind the vase?
will it be in front of the vase or behind it?
will it roll over the edge of the vase?
does it avoid clearing the vase?
If the red ball moves left and the blue ball moves right, will it hit the cube?
If the red ball is rolled straight at the cup, will that then hit the cube?
The red ball rolls left and the vase slides right, both slowly. Do they meet?
If the red ball rolls left and hits the cube, will it hit the vase?
Will the red ball hit something if it rolls left, the vase or the cube?
"""


@pytest.mark.parametrize("question", UNREAD.strip().splitlines())
def test_what_is_not_put_plainly_is_left_undecided(question: str) -> None:
    assert asked_of(question) is None


# Words that no rule reads, in the clause that asks or moves.
TURNING = """
If the ball rolls anywhere but left, does it hit the mug? | anywhere
The ball and the mug are on the table. If it rolls left, does it hit the cone? | the ball and the mug are on the table
The ball moves right, but the mug is glued to the floor. Does the mug move? | but the mug is glued
Replace the ball with the cube. If the mug slides left, does it hit the vase? | replace the ball with the cube
Unless the ball rolls right, does it hit the mug? | unless
If the ball rolls right, will the ball at least hit the mug? | at least
If the red ball hits the white ball, where will the white ball go? | where will the white ball go
If the ball and the mug both move right by 30 pixels, do they touch? | and the mug both
If the ball rolls on the shelf to the left, does it hit the mug? | the shelf
First shift the ball left by 90 px, in the air, and only then release it. Will it hit the mug? | in the air
If the ball rolls left by twice the width of the mug, does it hit the cube? | by twice the width of the mug
The mug is on the shelf. If the ball rolls left, will it hit the mug? | the mug is on the shelf
The floor is icy. If the ball rolls right, does it hit the mug? | icy
If the ball mvoes left, will it hit it? | mvoes
"""
PLAIN = """
There is a red ball and a blue mug. If the ball rolls right, does it hit the mug?
Please tell me whether the ball would hit the mug if it rolls along the arrow on the floor.
Remove the vase and then roll the ball gently to the right by 20 px. Does it still hit the mug?
The ball rolls left and strikes the bowl, right? Would the bowl be shoved into the cone by this?
As the ball goes rolling off to the left, is there any risk of it hitting the mug?
Given the direction of the arrow, would the ball manage to avoid the mug?
If the ball just falls straight down, is the mug safe from being hit?
Let's say the ball sets off to the left, though only by twice its own width. Has it gone out of the picture by then?
Within 2 seconds, will the ball reach the mug if it rolls right?
"""


@pytest.mark.parametrize(("text", "words"), rows(TURNING))
def test_words_that_may_turn_the_meaning_are_named_and_not_answered(text: str, words: str) -> None:
    question = parse(text)
    assert words in "\n".join(question.unread)
    assert question.asked is None
    assert words in answer_from((), None, None, phrases_of("en"), unread=question.unread).reasoning


def test_other_words_are_read_or_named_and_change_nothing() -> None:
    for text in PLAIN.strip().splitlines():
        assert parse(text).unread == (), text
        assert parse(text).asked is not None, text


# What is changed, then what moves and how.
CHANGES = """
If you take the vase away and push the car to the left, will it hit the mug? | remove vase | car push
If there were no vase and the ball rolled left, would it hit the cube? | remove vase | ball roll
If the ball moves left without the vase, will it hit the cube? | remove vase | ball move
If the apple is placed on top of the red box, will it stay there? | place apple onto red box | apple put
If I put the box between the two cups, does it touch either of them? | place box between two cups | box put
If I put the box between the vase and the cup, does it touch the cup? | place box between vase & cup | box put
If the ball is put in front of the mug, will the mug be hidden? | place ball in-front-of mug | ball put
Were the vase to vanish, would the car, rolling left, hit the mug? | remove vase | car roll
Will the apple fit into the bowl? | place apple into bowl | apple put
"""


@pytest.mark.parametrize(("text", "changes", "motion"), rows(CHANGES))
def test_changes(text: str, changes: str, motion: str) -> None:
    question = parse(text)
    said = [
        " ".join([each.kind, each.object.text, each.relation or "", " & ".join(t.text for t in each.targets)]).strip()
        for each in question.changes
    ]
    assert ", ".join(said) == changes
    assert question.mover is not None
    assert f"{question.mover.text} {question.motion.verb}" == motion
    removed = {change.object.text for change in question.changes if change.kind == "remove"}
    assert removed.isdisjoint(phrase.text for phrase in question.others)


def test_words_that_belong_to_a_name_or_a_place_are_no_speed_and_no_distance() -> None:
    slow, halfway = (
        parse(f"If the {told}, will it hit the vase?")
        for told in ("slow red ball rolls left", "red ball is put halfway between the mug and the vase")
    )
    assert slow.mover is not None
    assert (slow.mover.text, slow.motion.quantities) == ("slow red ball", ())
    assert ([change.relation for change in halfway.changes], halfway.motion.quantities) == (["between"], ())


def test_which_end_of_a_trail_is_the_present() -> None:
    for said, side in (("the last of which is the leftmost", (-1, 0)), ("the latest of which is on the right", (1, 0))):
        question = parse(f"If the orange ball flies on along the trail of positions, {said}, will it land?")
        assert (question.motion.trail, question.motion.trail_end) == (True, side)
        assert question.mover is not None
        assert (question.mover.text, question.motion.kind) == ("orange ball", "projectile")


def test_what_says_how_to_reply_is_no_part_of_the_question() -> None:
    for form in (
        "The entire content of your response should be of the following format: 'ANSWER: $LETTER' (without quotes) "
        "where LETTER is one of A,B.",
        "Write your response into this json template: {'Reasoning': '<your reasons>', 'Answer': '<Your answer>'}",
        "Think. The last line of your response should be of the following format: 'ANSWER: $LETTER'.",
    ):
        plain = "If the ball rolls left, will it hit the mug?"
        for text in (f"{plain} {form}", f"{form}\n\n{plain}\n\nA) Yes\nB) No"):
            assert parse(text).asked == parse(plain).asked is not None
            assert parse(text).changes == ()
            assert parse(text).motion == parse(plain).motion
    assert without_reply_form("If your answer is read aloud, will it fall?").endswith("fall?")
    assert without_reply_form("It goes 0.5 m... Give your answer as JSON.") == "It goes 0.5 m... "


VOCABULARY = sorted({
    word for line in (ASKED + UNREAD + TURNING + PLAIN).splitlines() for word in re.findall(r"[\w']+|[?,.:]", line)
})  # fmt: skip


@settings(deadline=None, max_examples=40)
@example("If the ball rolls left this arrow indicate line, will it hit the mug?")  # half of a phrase is no adverbial
@given(st.one_of(st.text(max_size=80), st.lists(st.sampled_from(VOCABULARY), max_size=30).map(" ".join)))
def test_no_question_breaks_the_reading(text: str) -> None:
    question = parse(text)
    assert not (question.unread and question.asked is not None)
    assert without_reply_form(text) == text or re.search(r"your|json|\$|answer|reply|respond|question|yes", text, re.I)
    for option in read_choices(text, None):
        assert option.letter
        says_it_happens(option.text, Asked(relation="touches", target="vase"))
        span_of(option.text)


EXTRA = ("not", "almost", "before", "and the cube", "twice", "unless it stops", "last", "hardly")


@given(st.sampled_from(EXTRA), st.integers(0, 4), st.sampled_from(["hit", "touch", "hide", "reach"]))
def test_no_further_word_is_passed_over(extra: str, place: int, verb: str) -> None:
    words = f"will it {verb} the vase".split()
    asked = asked_of(" ".join([*words[: place + 1], extra, *words[place + 1 :]]) + "?")
    assert asked_of(" ".join(words) + "?") is not None
    assert asked is None or asked.negated or asked.target not in {"vase", None}


@given(st.text("bcdfghjklmnpqrstvwxz", min_size=6, max_size=12))
def test_no_sense_is_made_of_what_has_none(word: str) -> None:
    question = parse(f"If the red ball {word} left, does it hit the mug?")
    assert question.mover is not None
    named = " ".join(question.unread).split()
    assert word in question.mover.text or word in named  # a noun nobody knows, or named as unread


def test_words_that_were_not_read_are_no_names_in_the_questions_that_are_offered() -> None:
    assert rewordings(parse("If the lorry zigzags to the right, will it frobnicate the mug?")) == ()
    assert all("the dent" not in each for each in rewordings(parse("If the ball rolls left, will it dent the mug?")))
    assert "hit the mug" in rewordings(parse("If the ball rolls left, will it dent the mug?"))[0]
