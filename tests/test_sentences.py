"""The question parser: a wide table of wordings, the shared scenes where they are, and any text at all."""

from __future__ import annotations

import json
import math
import time

import pytest
from conftest import all_scenes
from hypothesis import given, settings
from hypothesis import strategies as st

from cow_service.readers.base import Quantity
from cow_service.readers.embedded.english import lexicon
from cow_service.readers.embedded.english.noun_phrases import parse_noun_phrase
from cow_service.readers.embedded.english.questions import Question, parse
from cow_service.readers.embedded.motions import quantities
from cow_service.readers.options import split_options

DIAGONAL = math.sqrt(0.5)
DIRECTIONS = {
    "left": (-1.0, 0.0),
    "right": (1.0, 0.0),
    "up": (0.0, -1.0),
    "down": (0.0, 1.0),
    "right-up": (DIAGONAL, -DIAGONAL),
    "right-down": (DIAGONAL, DIAGONAL),
    "left-up": (-DIAGONAL, -DIAGONAL),
    "left-down": (-DIAGONAL, DIAGONAL),
}

# A question, then its mover, the kind of motion and what else must hold. Of the motion's fields (arrow, direction,
# depth, forward, towards), of box and number, those not named must be empty.
TABLE = """
If the orange ball is thrown in the direction of the arrow, will it hit the yellow cube?
    orange ball | projectile | arrow: along | others: yellow cube
If the yellow ball moves opposite to the direction of the arrow, will it hit the blue mug?
    yellow ball | linear | arrow: against | others: blue mug
Will the small car, moving in the direction of the arrow, touch the blue bottle?
    small car | linear | arrow: along | others: blue bottle
Suppose the object inside the red box moves in the reverse direction of the arrow. Will it collide with the lamp?
    object inside the red box | linear | arrow: against | box: True | colour: None | others: lamp
When the coffee mug is pushed away from the camera along the arrow, will it occlude the vase?
    coffee mug | linear | arrow: along | depth: 1
If the toy car keeps moving away from where the arrow points will it reach the cone on the right?
    toy car | linear | arrow: against | others: cone on the right
After being launched in the opposite direction of the arrow, will the rocket collide with the tower?
    rocket | projectile | arrow: against | others: tower
If the ball in the red box moves as indicated by the red arrow, will it hit the object in the blue box?
    ball in the red box | linear | arrow: along | box: True | colour: None | others: object in the blue box
If the mug follows the path indicated by the arrow, will it crash into the teapot?
    mug | linear | arrow: along | others: teapot
If the mug goes in the arrow direction, will it crash into the gray teapot?
    mug | linear | arrow: along | others: gray teapot
If the light green mug is slid along the arrow’s direction, does it hit the teapot?
    light green mug | linear | arrow: along | colour: green
If the orange ball, which is next to the vase, is thrown against the direction of the blue arrow, will it hit the pin?
    orange ball | projectile | arrow: against | others: vase, pin
Will the ball that is thrown in the direction of the arrow land on the cone?
    ball | projectile | arrow: along | others: cone
Will the ball hit the cube or the cone if it is rolled in the arrow's opposite direction?
    ball | linear | arrow: against | others: cube, cone
If the ball moves in the direction opposite to the arrow, will it hit the cube?
    ball | linear | arrow: against
Is it possible that the red ball hits the wall if it is thrown opposite to where the arrow points?
    red ball | projectile | arrow: against | others:
If the boat sails in the direction indicated, does it hit the buoy?
    boat | linear | arrow: along | others: buoy
If the ball indicated by the arrow rolls to the left, will it hit the pin?
    ball | linear | direction: left | others: pin
The red ball is thrown along the arrow. Will it hit the cube?
    red ball | projectile | arrow: along | others: cube
If the couch is moved in the direction of the arrow, will it fit between the wall and the table?
    couch | linear | arrow: along | others: table
The vase slides to the left while the red ball drops. Do they meet?
    vase | linear | direction: left | others: red ball
If the ball keeps flying the way it has been flying, its last position being the one on the right, does it hit the mug?
    ball | projectile | others: mug
What happens if someone pushes the red cube to the left?
    red cube | linear | direction: left
Will the green ball hit the vase if it moves to the right?
    green ball | linear | direction: right | others: vase
Will the red vase be hidden by the yellow cylinder when it moves up and to the right?
    yellow cylinder | linear | direction: right-up | others: red vase
If the ball moves from left to right, will it hit the pole?
    ball | linear | direction: right
If the left ball moves right, will it hit the right ball?
    left ball | linear | direction: right | noun: ball | others: right ball
If the ball in the middle is rolled to the left, will it hit the ball on the left?
    ball in the middle | linear | direction: left | others: ball on the left
Assuming the ball labeled 5 is rolled to the left of the table, will it touch the ball labeled 2?
    ball labeled 5 | linear | direction: left | number: 5 | others: ball labeled 2
If the puck slides to the right of the goal, will it touch the net?
    puck | linear | others: goal, net
In the picture, a silver car is moving to the bottom-right. Will it hit the pedestrian?
    silver car | linear | direction: right-down | colour: grey
Can the ball reach the hole by rolling towards the bottom left corner?
    ball | linear | direction: left-down | others: hole
If the orange is thrown to the upper left, will it hit the painting on the wall?
    orange | projectile | direction: left-up | colour: orange | noun: orange | others: painting
Suppose I were to slide the blue mug 10 cm to the right. Would it touch the red mug?
    blue mug | linear | direction: right | others: red mug
Should the yellow duck slide rightwards, would it bump into the purple cone?
    yellow duck | linear | direction: right
If the bird flies from the tree toward the left edge of the image, will it hit the house?
    bird | projectile | direction: left | others: tree, house
Will the cube on the right be hit if the cube on the left is pushed right?
    cube on the left | linear | direction: right | others: cube on the right
If the ball rolls down the ramp, will it hit the box?
    ball | linear | others: ramp, box
Given that the turquoise balloon floats up, will it touch the lamp?
    turquoise balloon | linear | direction: up | colour: cyan
If the lift is lowered, does it hit the crate?
    lift | linear | direction: down
If the tennis balls to the left move up, will they hit the net?
    tennis balls | linear | direction: up | noun: tennis ball
If the fan blows the leaf to the left, will it reach the pond?
    leaf | linear | direction: left | others: pond
Push the red cube to the left. Does it hit the vase?
    red cube | linear | direction: left | others: vase
Does moving the cube to the left make it hit the sphere?
    cube | linear | direction: left | others: sphere
IF THE RED BALL MOVES LEFT, WILL IT HIT THE BLUE CUBE?
    RED BALL | linear | direction: left | colour: red | others: BLUE CUBE
if red ball moves left will it hit blue cube
    red ball | linear | direction: left | others: blue cube
Suppose the toy racing car zaps to the right. Will it hit the wall clock?
    toy racing car | none | direction: right | noun: toy car | others: wall clock
Imagine that the highlighted object slides closer to the camera; will it pass in front of the chair?
    highlighted object | linear | depth: -1 | box: True | others: chair
If the large white truck drives into the distance, will it be hidden by the trees?
    large white truck | linear | depth: 1 | others: trees
If a strong wind pushes the sailboat away from the viewer, will it go behind the island?
    sailboat | linear | depth: 1 | others: island
Would the green cylinder be blocked from view if the cube were pulled closer to us?
    cube | linear | depth: -1 | others: green cylinder
If the cart rolls to the left and away from the camera, will it hit the bin?
    cart | linear | direction: left | depth: 0.707
Does the white pawn bump the black king if the pawn moves forward?
    white pawn | linear | forward: True | others: black king
If the train moves along the track in the direction it is facing, will the signal be occluded?
    train | linear | forward: True | others: signal
Is the vase going to be hit when the ball rolls backwards?
    ball | linear | forward: False | others: vase
If the car moves in reverse, will it hit the bin?
    car | linear | forward: False
Will there be a collision between the bus and the truck if the bus drives forward?
    bus | linear | forward: True | others: truck
If ball number 3 rolls along the floor towards the green bottle, will it hit the 8 ball?
    ball number 3 | linear | number: 3 | towards: green bottle | others: green bottle, 8 ball
What if I throw the tennis ball at the window?
    tennis ball | projectile | towards: window | others: window
A red ball, a blue cube, a cone. Suppose the red ball is rolled straight towards the cone. Will it hit the cube?
    red ball | linear | towards: cone | others: blue cube, cone
Will the ball roll into the vase?
    ball | linear | others: vase
If the black ball falls freely from its current position, will it land on the orange cylinder?
    black ball | fall | others: orange cylinder
Will the black ball land on the orange cylinder if dropped?
    black ball | fall
If the dark-blue ball falls to the left, does it land on the table or on the book?
    dark-blue ball | fall | direction: left | colour: blue | others: book
If the wine glass tips over to the right, will it touch the plate?
    wine glass | fall | direction: right
Let the ball fall. Will it land in the basket?
    ball | fall | others: basket
If we let go of the apple, what will it land on?
    apple | fall | others:
Where will the teal ring land when it is released from its current position?
    teal ring | fall | colour: cyan
If the cup to the left of the vase is dropped, will it fall into the bowl?
    cup | fall | others: vase, bowl
If the ball comes down, will it hit the glasses?
    ball | fall | others: glasses
Will the black ball, when released, land on the cone?
    black ball | fall
If the ball does not move, will anything happen to it?
    ball | static | others:
If the chair stays still, will the dog hide it?
    chair | static | others: dog
If the knife isn't moved, does it touch the plate?
    knife | static | others: plate
Assume the camera stays still. If the ball moves left, will it hit the cube?
    ball | linear | direction: left
If the man throws the frisbee up, will it hit the tree?
    frisbee | projectile | direction: up | others: tree
If the ball is pushed by a person to the right, will it hit the pole?
    ball | linear | direction: right | others: pole
There is a red ball next to a blue cup. If it rolls left, will the cup be hit?
    red ball | linear | direction: left | others: blue cup
Which object will the purple ball hit if it moves left?
    purple ball | linear | direction: left | others:
Do you think the red ball will hit the vase if it is pushed to the right?
    red ball | linear | direction: right | others: vase
Will the light-blue travel mug that's moving hit the coffee mug's handle?
    light-blue travel mug | linear | noun: travel mug | others: coffee mug, handle
If the blue block moves along the arrow, will the wooden block block the red ball?
    blue block | linear | arrow: along | others: wooden block, red ball
If the billiard ball with the number 7 is shot left, will it strike the blue ball number 2?
    billiard ball with the number 7 | projectile | number: 7 | direction: left | others: blue ball number 2
If you roll the 8-ball left, will it hit the 3 ball?
    8-ball | linear | number: 8 | direction: left | others: 3 ball
If the bottle marked in a red circle moves left, will the bottle marked in a blue circle be occluded?
    bottle marked in a red circle | linear | box: True | direction: left | others: bottle marked in a blue circle
If the yellow striped ball moves up, which ball will it hit first?
    yellow striped ball | linear | direction: up | others:
Will the ball near the cake stand hit the wine glass when it moves up?
    ball | linear | direction: up | others: cake stand, wine glass
Will the toy car scratch the vase if it moves left?
    toy car | linear | direction: left | others: vase
"""


def rows() -> list[tuple[str, str, str, dict[str, str]]]:
    lines = TABLE.strip().splitlines()
    table: list[tuple[str, str, str, dict[str, str]]] = []
    for text, held in zip(lines[::2], lines[1::2], strict=True):
        mover, kind, *rest = held.strip().split(" | ")
        extra = dict(part.split(":", 1) for part in rest)
        table.append((text, mover, kind, {name: value.strip() for name, value in extra.items()}))
    return table


WORDINGS = rows()


def told(question: Question) -> dict[str, str]:
    """The parts of a parsed question in the words of the table, empty ones left out."""
    mover, motion = question.mover, question.motion
    assert mover is not None
    parts = {
        "arrow": motion.arrow,
        "depth": f"{motion.depth:.3g}" if motion.depth else None,
        "forward": motion.forward,
        "towards": motion.towards.text if motion.towards else None,
        "box": mover.inside_box or None,
        "number": mover.number,
    }
    return {name: str(part) for name, part in parts.items() if part is not None}


def check(question: Question, mover: str, kind: str, extra: dict[str, str]) -> None:
    phrase, motion = question.mover, question.motion
    assert phrase is not None
    assert (phrase.text, str(motion.kind).lower()) == (mover, kind)
    assert motion.direction == (pytest.approx(DIRECTIONS[extra["direction"]]) if "direction" in extra else None)
    found = {"others": ", ".join(other.text for other in question.others)}
    found |= {"colour": str(phrase.colour), "noun": str(phrase.noun)}
    found = {name: value for name, value in found.items() if name in extra}
    assert told(question) | found == {name: value for name, value in extra.items() if name != "direction"}


@pytest.mark.parametrize(("text", "mover", "kind", "extra"), WORDINGS, ids=[row[0][:60] for row in WORDINGS])
def test_wording(text: str, mover: str, kind: str, extra: dict[str, str]) -> None:
    check(parse(text), mover, kind, extra)


@pytest.mark.parametrize(("text", "mover", "kind", "extra"), WORDINGS, ids=[row[0][:60] for row in WORDINGS])
def test_options_change_nothing_else(text: str, mover: str, kind: str, extra: dict[str, str]) -> None:
    end = "" if text.endswith("?") else "."
    question = f"{text}{end} Answer by (A) Yes, the red lamp, (B) No or (C) Not sure."
    assert split_options(question)[0] == (("A", "Yes, the red lamp"), ("B", "No"), ("C", "Not sure"))
    check(parse(question), mover, kind, extra)


@pytest.mark.parametrize(
    ("tail", "options"),
    [
        ("(A) Yes, (B) No or (C) Not sure", ("Yes", "No", "Not sure")),
        ("A. Yes B. No", ("Yes", "No")),
        ("A: Yes; B: No", ("Yes", "No")),
        ("Options: A) the left B) the right, or C) none. Give one letter.", ("the left", "the right", "none")),
        ("(a) yes (b) no", ("yes", "no")),
        ("\nA. It hits the cup.\nB. It misses.\nAnswer with a letter.", ("It hits the cup", "It misses")),
        ("(A) 0.5 m (B) 1.5 m", ("0.5 m", "1.5 m")),
        ("A. Yes. B. No. C. Not Sure.Note that, the first image is the present.", ("Yes", "No", "Not Sure")),
        ("Choose between the following options: Yes or No", ("Yes", "No")),
        ("Options: yes, no, or not sure. Think first.", ("yes", "no", "not sure")),
        ("Answer with 'Yes' or 'No' only.", ("Yes", "No")),
        ("Please answer yes or no.", ("yes", "no")),
        ("Answer with a single word or phrase.", ()),
        ("Answer with the letter or the text of the option.", ()),
        ("Yes or no?", ()),
        ("Is it near (A)?", ()),
    ],
)
def test_options(tail: str, options: tuple[str, ...]) -> None:
    question = f"If the ball moves left, will it hit the vase? {tail}"
    assert split_options(question)[0] == tuple(zip("ABC", options, strict=False))
    assert [other.text for other in parse(question).others] == ["vase"]


@pytest.mark.parametrize(
    ("word", "colour"),
    [
        ("gray", "grey"),
        ("violet", "purple"),
        ("magenta", "pink"),
        ("aqua", "cyan"),
        ("navy", "blue"),
        ("golden", "yellow"),
        ("dark red", "red"),
        ("light blue", "blue"),
        ("orange-coloured", "orange"),
        ("shiny", None),
    ],
)
def test_colours(word: str, colour: str | None) -> None:
    mover = parse(f"If the {word} toy car moves left, will it stop?").mover
    assert mover is not None
    assert (mover.text, mover.colour, mover.noun, mover.head) == (f"{word} toy car", colour, "toy car", "car")


@pytest.mark.parametrize("word", ["balls", "boxes", "knives", "cherries", "glasses", "vases", "bus", "toes"])
def test_singular_is_settled(word: str) -> None:
    once = lexicon.singular(word)
    assert lexicon.singular(once) == once


def test_empty() -> None:
    question = parse("")
    assert (question.mover, question.others, question.items) == (None, (), ())
    assert (question.motion.kind, question.motion.verb, question.motion.direction) == (None, "", None)


@pytest.mark.parametrize(
    ("text", "colour"),
    [
        ("the red toy car", "red"),
        ("Red ball", "red"),
        ("a blue striped ball with the number 10", "blue"),
        ("the dark blue", "blue"),
        ("toy car", None),
        ("block 3", None),
    ],
)
def test_a_noun_phrase_alone(text: str, colour: str | None) -> None:
    phrase = parse_noun_phrase(text)
    assert phrase is not None
    assert phrase.colour == colour


def test_a_text_without_a_noun_phrase() -> None:
    assert parse_noun_phrase("") is None
    assert parse_noun_phrase("?!") is None


@pytest.mark.parametrize(
    ("text", "arrow", "direction"),
    [
        ("If the ball next to the arrow moves, what happens?", True, False),
        ("If the ball moves north-east, what happens?", False, True),
        ("If the ball rolls, is the gap too narrow?", False, False),
    ],
)
def test_words_that_are_there_whether_understood_or_not(text: str, arrow: bool, direction: bool) -> None:
    question = parse(text)
    assert (question.mentions_arrow, question.names_direction) == (arrow, direction)


def test_verb_is_in_its_base_form() -> None:
    assert parse("If the ball is thrown up, will it hit the lamp?").motion.verb == "throw"


def test_scenes() -> None:
    for folder in all_scenes():
        meta = json.loads((folder / "meta.json").read_text())
        question = parse(meta["question"])
        assert question.mover is not None
        assert (question.mover.text, question.motion.kind) == (meta["object"], meta["motion"]), meta["question"]
        assert [other.text for other in question.others] == [meta["target"]]
        along = (meta.get("arrow_style") or {}).get("along")
        assert question.motion.arrow == {True: "along", False: "against", None: None}[along]


ODDITIES = "(A) (B) A. B: , . ? ! a arrow 's n't no. #3 ² ٣ İ ß"
WORDS = sorted({word for row in WORDINGS for word in row[0].split()} | set(ODDITIES.split()))


@settings(deadline=None)
@given(st.one_of(st.text(), st.lists(st.sampled_from(WORDS), max_size=40).map(" ".join)))
def test_never_raises(text: str) -> None:
    question = parse(text)
    motion = question.motion
    assert motion.direction is None or math.hypot(*motion.direction) == pytest.approx(1)
    assert -1 <= motion.depth <= 1
    assert question.mover not in question.others
    assert len(set(question.others)) == len(question.others)


@pytest.mark.parametrize(
    "piece",
    [
        "ball ",
        "the ball ",
        "if the ball moves left ",
        "arrow ",
        "opposite to the arrow ",
        "(A) x ",
        "A. ",
        "a ",
        "and ",
        "will ",
        "' ",
        "n't",
        "no. ",
        "ball in the red box ",
        "it moves, ",
        "9",
        "-",
        "the thing by which ",
        "a" * 50 + " ",
        "thrown to the ",
    ],
)
def test_time_is_bounded(piece: str) -> None:
    text = (piece * (10_000 // len(piece) + 1))[:10_000]
    parse(piece)
    started = time.process_time()
    parse(text)
    assert time.process_time() - started < 2  # s: generous; quadratic work takes far longer


@pytest.mark.parametrize(
    ("text", "kind", "object", "relation"),
    [
        ("If the mug had never been there, does the ball hit the cube?", "remove", "mug", None),
        ("Clear away the mug. Does the ball hit the cube?", "remove", "mug", None),
        ("Pop the ball in the mug. Does it fit?", "place", "ball", "into"),
        (
            "Put the green can halfway between the cube and the mug. Does the ball hit it?",
            "place",
            "green can",
            "between",
        ),
    ],
)
def test_further_words_of_changes(text: str, kind: str, object: str, relation: str | None) -> None:
    (change,) = parse(text).interventions
    assert (change.kind, change.object.text, change.relation) == (kind, object, relation)


@pytest.mark.parametrize(("said", "widths"), [("twice its own width", 2.0), ("by half its width", 0.5)])
def test_lengths_of_its_own(said: str, widths: float) -> None:
    motion = parse(f"If the ball rolls left {said}, does it hit the mug?").motion
    assert [each.own_widths for each in motion.quantities] == [widths]
    box = (10.0, 20.0, 50.0, 100.0)
    assert quantities(motion.quantities, None, box)["distance"] == Quantity(40 * widths, "px")
