"""Every word of a question is read, changes nothing, or is named; where it may turn the meaning, no answer is given."""

from __future__ import annotations

import pytest
from drawn import ball, block, floor, jpeg
from hypothesis import example, given, settings
from hypothesis import strategies as st

from cow_service.errors import CannotGround, CannotReadDirection
from cow_service.narration.words import phrases_of
from cow_service.readers.base import ReaderInput
from cow_service.readers.embedded.answers import answer_from
from cow_service.readers.embedded.english.asked import read_asked, unread
from cow_service.readers.embedded.english.questions import parse
from cow_service.readers.embedded.reader import EmbeddedReader
from cow_service.records import Grounding
from cow_service.vision.scene import Scene

RED, BLUE, GREEN = (200, 30, 30), (50, 80, 200), (50, 150, 50)

# Words that no rule reads, in the clause that asks or moves; the second group outside of it.
TURNING = """
If the ball rolls anywhere but left, does it hit the mug? | anywhere
If the ball does not roll left but hops, does it hit the mug? | does not
If the ball rolls right around the mug, does it hit the cone? | around the mug
If the ball rolls right twice as fast, does it hit the mug? | twice as fast
If the ball rolls right, does it hit the mug and the cube? | does it hit the mug and the cube
If the ball rolls right, does it hit the mug before the cube? | does it hit the mug before the cube
If the ball rolls right, will it hit the cone after 2 seconds? | will it hit the cone after 2 seconds
If the ball rolls left for the first second, does it hit the mug? | for the first second
If the ball rolls right, does it not hit both mugs? | does it not hit both mugs
The ball and the mug are on the table. If it rolls left, does it hit the cone? | it
The ball moves right, but the mug is glued to the floor. Does the mug move? | but the mug is glued
Replace the ball with the cube. If the mug slides left, does it hit the vase? | Replace the ball with the cube
Unless the ball rolls right, does it hit the mug? | Unless
If the ball is able to roll right, does it hit the mug? | is able
If the ball rolls right, won't it be able to hit the mug? | won't it be able to hit the mug
If the ball rolls right, will the ball at least hit the mug? | at least hit the mug
If the red ball hits the white ball, where will the white ball go? | hits the white ball
Only if the ball rolls right: will it touch the cube? | Only
The camera moves left. Does the ball hide the mug? | camera moves left
If the ball goes right while the mug goes left by 30 pixels, will they collide? | by 30 pixels
If the ball goes right while the mug goes left and then up, will they collide? | up
If the ball and the mug both move right by 30 pixels, do they touch? | and the mug both
If the ball rolls on the shelf to the left, does it hit the mug? | on the shelf
If the ball rolls along the arrow, is it hit on its way against the arrow? | is it hit on its way against the arrow
Is the mug hit first by the ball if it rolls left? | hit first by the ball
Which mug is hit by the cone first if the ball rolls left? | mug is hit by the cone first
The ball rolls left and strikes the cube. Does the ball hit the mug? | and strikes the cube
The ball rolls left and misses the cube. Does the cube hit the mug? | and misses the cube
First shift the ball left by 90 px, in the air, and only then release it. Will it hit the mug? | in the air
Nobody throws the cube. If the ball rolls left, does it hit the mug? | cube
If the ball rolls left by twice the width of the mug, does it hit the cube? | by twice the width of the mug
If the ball rolls right, does it still hit the mug at the end? | does it still hit the mug at the end
True or false? The mug is on the table. If the ball rolls left, it hits the mug. | True or false
If the ball and the mug move to the left, do they meet? | and the mug move
If the ball moves right and the blue cube to the left, will the ball hit the cube? | and the blue cube
If the ball rolls left, once the ball has bumped into the cup, will the cup tip the cube? | has bumped into the cup
If the ball is kicked into the air along the arrow, where will it land? | into the air
If the ball rolls left by half the image width, does it hit the mug? | by half the image width
If the ball rolls left until it leaves the picture, does it hit the mug? | until it leaves the picture
The ball flies on along its trail, the first of which is the leftmost. Is it hit? | first of which is the leftmost
The ball rolls left, then it goes for 2 seconds. Does it hit the mug? | for 2 seconds
"""
BESIDE = """
The floor is icy. If the ball rolls right, does it hit the mug? | floor is icy
The vase is very old. If the ball rolls right, does it hit the mug? | vase is very old
"""
PLAIN = """
If the ball rolls right, does it hit the mug?
There is a red ball and a blue mug. If the ball rolls right, does it hit the mug?
Please tell me: would the ball, rolling freely along the arrow on the floor, hit the mug?
Remove the vase and then roll the ball gently to the right by 20 px. Does it still hit the mug?
Excuse me, could you please tell me whether the ball is going to hit the mug if we give it a little push left?
OK so what I'd like to know is whether the ball, rolling left, gets past the mug without touching it.
The ball rolls left and strikes the bowl, right? Would the bowl be shoved into the cone by this?
As the ball goes rolling off to the left, is there any risk of it hitting the mug?
Given the direction of the arrow, would the ball manage to avoid the mug?
What if nobody throws the ball and it just falls straight down, is the mug safe from being hit?
Let's say the ball sets off to the left, though only by twice its own width. Has it gone out of the picture by then?
First the ball rolls left, then down. Does it hit the mug?
Within 2 seconds, will the ball rolling right reach the mug that is nearer to the camera?
"""


def rows(table: str) -> list[tuple[str, str]]:
    return [
        (text.strip(), words.strip()) for text, _, words in (row.partition("|") for row in table.strip().splitlines())
    ]


@pytest.mark.parametrize(("text", "words"), rows(TURNING))
def test_words_that_may_turn_the_meaning_are_named_and_not_answered(text: str, words: str) -> None:
    question = parse(text)
    assert words in unread(question).turning
    assert read_asked(question) is None
    why = answer_from((), None, None, phrases_of("en"), unread=unread(question)).reasoning
    assert words in why
    assert "English" in why


@pytest.mark.parametrize(("text", "words"), rows(BESIDE))
def test_words_beside_are_named_only(text: str, words: str) -> None:
    assert (unread(parse(text)).turning, unread(parse(text)).beside) == ((), (words,))
    assert read_asked(parse(text)) is not None


@pytest.mark.parametrize("text", PLAIN.strip().splitlines())
def test_of_plain_questions_every_word_is_read(text: str) -> None:
    assert (unread(parse(text)).turning, unread(parse(text)).beside) == ((), ())
    assert read_asked(parse(text)) is not None


WORDS = sorted({word for text, _ in rows(TURNING + BESIDE + PLAIN) for word in text.split()})


@settings(deadline=None, max_examples=50)
@example(
    "If the ball rolls left this arrow indicate line, will it hit the mug?"
)  # a half of "indicate line" is no adverbial
@given(st.one_of(st.text(max_size=80), st.lists(st.sampled_from(WORDS), max_size=30).map(" ".join)))
def test_never_raises(text: str) -> None:
    question = parse(text)
    assert not (unread(question).turning and read_asked(question) is not None)


def scene() -> Scene:
    image = ball(ball(floor(), (110, 200), 40, RED), (300, 200), 40, GREEN)
    return Scene(jpeg(block(image, (430, 150, 520, 250), BLUE)))


@pytest.mark.parametrize(
    ("said", "left"),
    [
        ("ball nearest to the cube", 260),
        ("ball to the left of the green ball", 70),
        ("ball that is farthest from the cube", 70),
        ("ball on the far left", 70),
        ("thing between", None),
    ],
)
def test_a_thing_is_singled_out_by_where_it_is(said: str, left: int | None) -> None:
    given = ReaderInput(scene(), f"If the {said} rolls down, will it hit the cube?")
    if left is None:
        with pytest.raises(CannotGround):
            EmbeddedReader().ground(given)
    else:
        assert EmbeddedReader().ground(given).bbox[0] == pytest.approx(left, abs=4)


def test_the_latter_is_not_guessed() -> None:
    question = "There is a red ball and a blue cube. If the latter slides left, does it hit the former?"
    with pytest.raises(CannotGround):
        EmbeddedReader().ground(ReaderInput(scene(), question))


@pytest.mark.parametrize("way", ["up and down", "left to the right", "left and stays still"])
def test_contradictions_are_refused(way: str) -> None:
    given = ReaderInput(scene(), f"If the red ball moves {way}, does it hit the cube?")
    grounding = Grounding(object="red ball", bbox=(70, 160, 150, 240), point=(110, 200), source="embedded")
    with pytest.raises(CannotReadDirection, match="contradict"):
        EmbeddedReader().read_motion(given, grounding, None)


def test_what_is_taken_away_is_not_asked_about() -> None:
    given = ReaderInput(scene(), "The blue cube is removed. The red ball rolls right. Does it hit the blue cube?")
    with pytest.raises(CannotGround, match="'blue cube' away and asks"):
        EmbeddedReader().ground(given)


def test_several_movers_at_once_are_refused() -> None:
    with pytest.raises(CannotGround, match="at once"):
        EmbeddedReader().ground(ReaderInput(scene(), "If both balls roll right, is the cube hit?"))


def test_the_things_of_a_kind_are_found_or_refused() -> None:
    found = EmbeddedReader().ground(ReaderInput(scene(), "If the blue cube slides left, does it hit both balls?"))
    assert {other.object for other in found.others} == {"red ball", "green ball"}
    assert not [said for said in found.warnings if "not found" in said]
    with pytest.raises(CannotGround, match="'all three balls'"):
        EmbeddedReader().ground(ReaderInput(scene(), "If the blue cube slides left, does it hit all three balls?"))


@pytest.mark.parametrize(
    "question", ["If the ball mvoes left, will it hit it?", "If the ball rolls to the rigth, is it hit?"]
)
def test_misspelt_words_are_not_guessed(question: str) -> None:
    told = parse(question).motion
    assert not told.verb or told.direction is None
    assert unread(parse(question)).turning


@given(st.text("bcdfghjklmnpqrstvwxz", min_size=6, max_size=12))
def test_no_sense_is_made_of_what_has_none(word: str) -> None:
    question = parse(f"If the red ball {word} left, does it hit the mug?")
    assert question.mover is not None
    named = " ".join(unread(question).turning).split()
    assert word in question.mover.text or word in named  # a noun nobody knows, or named as unread
