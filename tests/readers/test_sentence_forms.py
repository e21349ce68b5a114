"""The sentence forms: those that the documentation lists, and those of the CausalSpatial benchmark with other nouns."""

from __future__ import annotations

import json
import re

import pytest
from conftest import ROOT
from drawn import ball, block, floor, jpeg
from refusals import refused

from cow_service.readers.base import ReaderInput
from cow_service.readers.embedded.english.questions import parse, rewordings
from cow_service.readers.embedded.reader import EmbeddedReader
from cow_service.records import LocatedObject
from cow_service.vision.scene import Scene


def rows(table: str) -> list[tuple[str, ...]]:
    return [tuple(part.strip() for part in row.split("|")) for row in table.strip().splitlines()]


def documented() -> list[tuple[str, str]]:
    text = (ROOT / "docs" / "questions.md").read_text(encoding="utf-8")
    return re.findall(r"^\| (.+?) \| `(\{.*\})` \|$", text, re.MULTILINE)


def test_the_documentation_lists_what_is_read() -> None:
    assert len(documented()) > 30
    for question, told in documented():
        read = parse(question)
        assert read.unread == (), question
        assert read.asked is not None, question
        assert read.asked.model_dump(mode="json", exclude_defaults=True) == json.loads(told), question


# What moves, how, what is taken away or put, and what is asked: form, relation, subject > target or (among), not.
BENCHMARK = """
If the tennis ball moves forward, will it collide with the lamp? | tennis ball | forward | | touches lamp
If the wooden train moves in this direction, will it run into the lamp? | wooden train | along | | touches lamp
Will the train touch a lamp when it rolls in the direction the arrow points? | train | along | | touches lamp
If the train drives opposite to the direction of the arrow, would it bump into it? | train | against | | -
If the train is pushed in the direction shown, can it hit the lamp? | train | along | | touches lamp
If the train moves towards this direction, will a collision occur? | train | along | | touches
If the train moves backward, will there be a collision between the train and the lamp? | train | backward | | touches lamp
If the kettle moves in this direction, which object should be removed to avoid the collision? (A) the box (B) the lamp (C) Not sure | kettle | along | | which-to-remove touches (box, lamp)
The kettle moves in this direction and will collide with the lamp. Which object should be removed to avoid the collision? | kettle | along | | which-to-remove touches lamp
Which of the box and the lamp should be taken away so that the kettle does not hit the vase? | kettle | | | which-to-remove touches vase (box, lamp)
If the kettle moves forward, can the collision be avoided by removing the lamp? | kettle | forward | remove lamp | touches not
If the kettle moves forward, would removing the lamp avoid the collision with the vase? | kettle | forward | remove lamp | touches vase not
Is it possible to avoid the collision by removing the cup if the kettle moves forward? | kettle | forward | remove cup | touches not
If the lamp is removed and the kettle moves in this direction, will it still hit the vase? | kettle | along | remove lamp | touches vase
If the lamp is removed, will it still hit the vase? | - | | remove lamp | touches vase
Will the vase be occluded if the kettle moves towards this direction? | kettle | along | | covers vase
Will the vase be occluded by the kettle if the kettle moves in this direction? | kettle | along | | covers vase
Will the bottle be hidden behind the book if it is moved to the right? | bottle | right | | covered book
If the kettle moves in this direction, which of the vase and the lamp will it occlude? | kettle | along | | which covers (vase, lamp)
If the kettle moves in this direction, which of the vase and the lamp will it hit first? | kettle | along | | which-first touches
If the pear falls freely from its current position, will it land on the plate? | pear | fall | | touches plate
If the pear falls freely from its current position, will it fit into the bucket? "Fit into" means that it does not go over the plane of the opening. | pear | fall | | inside bucket
There is an apple falling down. Will it hit the plate? | apple | fall | | touches plate
I want to put the lemon into the mug, will it fit inside? | lemon | place | place lemon | inside mug
I want to put the lemon into a container. Into which of the mug and the bowl does it fit? | lemon | place | place lemon | which inside (mug, bowl)
If the basketball is thrown in this direction, will it go into the hoop? | basketball | along | | inside hoop
If the cue ball moves in the direction of the arrow, which ball is hit first? | cue ball | along | | which-first touches
If the cue ball moves along the arrow and strikes the yellow striped ball, will the yellow striped ball then hit the red ball before it reaches a cushion? | cue ball | along | | touches yellow striped ball > red ball
If the cue ball strikes the yellow ball, will the yellow ball then hit the red ball? | cue ball | towards yellow ball | | touches yellow ball > red ball
If the cue ball moves along the arrow and strikes the yellow ball, will it then hit the red ball? | cue ball | along | | -
If the ball inside the red box moves to the left, will it hit the lamp? | ball inside the red box | left | | touches lamp
If the ball at the start of the path moves along the arrow, will it hit the lamp? | ball at the start of the path | along | | touches lamp
If the white pawn moves forward, will it hit the black one? | white pawn | forward | | touches black pawn
If the red ball moves toward the green block, will it hit it? | red ball | towards green block | | touches green block
If the red ball moves toward the green block, will it push it? | red ball | towards green block | | moves green block
If the red ball moves toward the green block, will it miss it? | red ball | towards green block | | touches green block not
If the red ball moves toward the green block, will it knock it over? | red ball | towards green block | | tips green block
If the red ball moves toward the green block, will it hit that? | red ball | towards green block | | touches green block
If the red ball moves toward the green block, will they collide? | red ball | towards green block | | touches green block
If the red ball moves to the right, will it hit it? | red ball | right | | -
If the red ball moves to the right, will it hit them? | red ball | right | | -
What if I roll the yellow ball to the right? | yellow ball | right | | what-happens touches
Push the red ball to the right. | red ball | right | | what-happens touches
"""


@pytest.mark.parametrize(("question", "mover", "way", "changes", "asked"), rows(BENCHMARK))
def test_the_benchmark_asks(question: str, mover: str, way: str, changes: str, asked: str) -> None:
    check(question, (), mover, way, changes, asked)


GIVEN = "toy truck with a blue cab", "black vase with cream dots", "stack of books", "Rubik's cube", "orange", "black mug"
NAMED = """
If the toy truck with a blue cab moves forward, will it hit the cube? | toy truck with a blue cab | forward | | touches Rubik's cube
If the truck moves forward, will it hit the vase? | toy truck with a blue cab | forward | | touches black vase with cream dots
Does the orange fit into the black mug? | orange | place | place orange | inside black mug
If the stack of books is removed and the orange moves forward, will it hit the mug? | orange | forward | remove stack of books | touches black mug
If the vase moves in this direction, will the stack of books be occluded by it at some moment? | black vase with cream dots | along | | covers stack of books
"""


@pytest.mark.parametrize(("question", "mover", "way", "changes", "asked"), rows(NAMED))
def test_given_names_are_names_whatever_their_words(
    question: str, mover: str, way: str, changes: str, asked: str
) -> None:
    check(question, GIVEN, mover, way, changes, asked)


def check(question: str, names: tuple[str, ...], mover: str, way: str, changes: str, asked: str) -> None:
    read = parse(question, names)
    assert (read.mover.text if read.mover else "-") == mover
    motion = read.motion
    ways = {(-1.0, 0.0): "left", (1.0, 0.0): "right"}
    towards = f"towards {motion.towards.text}" if motion.towards else ""
    said = {True: "along", False: "against"}.get(motion.along_arrow) or {True: "forward", False: "backward"}.get(
        motion.forward
    )
    kind = motion.kind if motion.kind in {"fall", "place"} else ""
    assert (said or towards or kind or ways.get(motion.direction or (0.0, 0.0), "")) == way
    assert ", ".join(f"{each.kind} {each.object.text}" for each in read.changes) == changes
    if asked == "-":
        assert read.asked is None
        assert read.unread
        return
    found = read.asked
    assert found is not None
    words = [] if found.form == "whether" else [found.form]
    words += [found.relation, f"{found.subject} > {found.target}" if found.subject else found.target or ""]
    words += [f"({', '.join(found.among)})" if found.among else "", "not" if found.negated else ""]
    assert " ".join(word for word in words if word) == asked


def test_the_other_one_is_what_is_left_of_two() -> None:
    for names, target in (((), "other one"), (("red ball", "lamp"), "lamp"), (("red ball", "lamp", "cup"), None)):
        asked = parse("If the red ball moves to the right, will it hit the other one?", names).asked
        assert (asked and asked.target) == target


def test_what_is_not_read_is_refused_with_questions_that_are() -> None:
    scene = Scene(jpeg(block(ball(floor(), (150, 200), 40, (200, 30, 30)), (430, 150, 520, 250), (50, 80, 200))))
    question = "If the red ball waddles left, will the blue cube be thwarted?"
    assert parse(question).asked is None
    assert any("thwarted" in words for words in parse(question).unread)
    with refused("cannot-ground") as caught:
        EmbeddedReader().ground(ReaderInput(scene, "Can the red ball thwart the blue cube?"))
    assert "'can the red ball thwart the blue cube'" in caught.value.detail.lower()
    for like in rewordings(parse("Can the red ball thwart the blue cube?")):
        assert parse(like).asked is not None
        assert like in caught.value.detail


def test_what_is_given_is_not_parsed_for() -> None:
    scene = Scene(jpeg(block(ball(floor(), (150, 200), 40, (200, 30, 30)), (430, 150, 520, 250), (50, 80, 200))))
    known = (LocatedObject(object="gizmo", bbox=(110, 160, 190, 240)),)
    nothing = {"asked_wanted": False, "changes_wanted": False, "motion_wanted": False}
    reading = EmbeddedReader().ground(ReaderInput(scene, "The gizmo, does it flummox?", known=known, **nothing))
    assert (reading.object, reading.bbox) == ("gizmo", known[0].bbox)
    assert (reading.warnings, reading.is_doubtful) == ((), False)
    with refused("cannot-ground"):
        EmbeddedReader().ground(ReaderInput(scene, "The gizmo, does it flummox?", known=known))
