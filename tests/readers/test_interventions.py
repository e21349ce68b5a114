"""What a question takes away or puts somewhere before anything moves, and the trail that it speaks of."""

from __future__ import annotations

from typing import Any

import pytest
from drawn import ball, block, floor, jpeg

from cow_service.errors import CannotGround
from cow_service.readers.base import ReaderInput
from cow_service.readers.embedded.english.asked import read_asked
from cow_service.readers.embedded.english.questions import parse
from cow_service.readers.embedded.reader import EmbeddedReader
from cow_service.records import LocatedObject
from cow_service.vision.scene import Scene

RED, BLUE, GREEN = (200, 30, 30), (50, 80, 200), (50, 150, 50)

# What is changed, then what moves and how.
CHANGES = """
If the vase is removed and the car moves forward, will it hit the mug? | remove vase | car move
If the car moves forward and the vase is removed, will it hit the mug? | remove vase | car move
If you take the vase away and push the car to the left, will it hit the mug? | remove vase | car push
Will the car hit the mug if the vase is taken away and it rolls left? | remove vase | car roll
Suppose the vase was not there. If the ball rolls left, will it hit the cube? | remove vase | ball roll
If there were no vase and the ball rolled left, would it hit the cube? | remove vase | ball roll
If the ball moves left without the vase, will it hit the cube? | remove vase | ball move
After removing the vase and the mug, the ball rolls left. Will it hit the cube? | remove vase, remove mug | ball roll
If I put the apple into the bowl, will it fit? | place apple into bowl | apple put
If the apple is placed on top of the red box, will it fall off? | place apple onto red box | apple put
If I put the box between the two cups, does it touch either of them? | place box between two cups | box put
If I put the box between the vase and the cup, does it touch the cup? | place box between vase & cup | box put
If the ball is put in front of the mug, will the mug be hidden? | place ball in-front-of mug | ball put
Were the vase to vanish, would the car, rolling left, hit the mug? | remove vase | car roll
If I set the ball down on the mug, would it stay there? | place ball onto mug | ball put
Put the mug on the cube; does it stay visible? | place mug onto cube | mug put
If someone lifted the ball and put it into the mug, would it fit? | place ball into mug | ball put
Will the apple fit into the bowl? | place apple into bowl | apple put
If the cup to the left of the vase is dropped, will it fall into the bowl? | | cup drop
If the ball rolls left, will it hit the vase? | | ball roll
"""


@pytest.mark.parametrize("row", CHANGES.strip().splitlines())
def test_changes(row: str) -> None:
    text, changes, motion = (part.strip() for part in row.split("|"))
    question = parse(text)
    said = [
        " ".join([each.kind, each.object.text, each.relation or "", " & ".join(t.text for t in each.targets)]).strip()
        for each in question.interventions
    ]
    assert ", ".join(said) == changes
    assert question.mover is not None
    assert f"{question.mover.text} {question.motion.verb}" == motion
    removed = {change.object.text for change in question.interventions if change.kind == "remove"}
    assert removed.isdisjoint(phrase.text for phrase in question.others)


def test_whose_collision_is_asked_about() -> None:
    asked = read_asked(parse("If the blue ball moves left, will the cyan ball hit the white ball?"))
    assert asked is not None
    assert (asked.subject, asked.relation, asked.target) == ("cyan ball", "touches", "white ball")


@pytest.mark.parametrize(
    ("said", "expected"),
    [
        ("the last of which is the one nearest to the pink cube", ("pink cube", None)),
        ("the last of which is the leftmost", (None, (-1.0, 0.0))),
        ("the latest of which is on the right", (None, (1.0, 0.0))),
    ],
)
def test_which_end_of_a_trail_is_the_present(said: str, expected: tuple[Any, ...]) -> None:
    question = parse(f"If the orange ball flies on along the trail of positions that is shown, {said}, will it land?")
    trail = question.motion.trail
    assert trail is not None
    assert (trail.near and trail.near.text, trail.side) == expected
    assert question.mover is not None
    assert (question.mover.text, question.motion.kind) == ("orange ball", "projectile")


def scene() -> Scene:
    image = ball(ball(floor(), (110, 200), 40, RED), (300, 200), 40, GREEN)
    return Scene(jpeg(block(image, (430, 150, 520, 250), BLUE)))


def test_what_is_taken_away_and_where_things_are_put() -> None:
    reading = EmbeddedReader().ground(
        ReaderInput(scene(), "If the green ball is removed and the ball rolls right, will it hit the blue cube?")
    )
    (removed,) = reading.interventions
    assert (removed.kind, removed.object.object) == ("remove", "green ball")
    assert removed.object.bbox[0] == pytest.approx(260, abs=4)
    assert reading.bbox[0] == pytest.approx(70, abs=4)  # of two balls, the one that is left
    assert [other.object for other in reading.others] == ["blue cube"]
    reading = EmbeddedReader().ground(ReaderInput(scene(), "If I put the red ball onto the blue cube, will it tip?"))
    (placed,) = reading.interventions
    assert (placed.kind, placed.relation, placed.targets[0].object) == ("place", "onto", "blue cube")
    assert placed.object.bbox == reading.bbox


def test_what_the_caller_has_located_is_not_looked_for() -> None:
    crate, bowl = (LocatedObject(object=name, bbox=(x, 20, x + 60, 70)) for name, x in (("Crate", 200), ("bowl", 300)))
    asked = "If the crate is removed and the red ball rolls right, will it hit the blue cube?"
    (removed,) = EmbeddedReader().ground(ReaderInput(scene(), asked, known=(crate, bowl))).interventions
    assert removed.object == crate
    asked = "If I put the red ball into the bowl, will it fit?"
    (placed,) = EmbeddedReader().ground(ReaderInput(scene(), asked, known=(crate, bowl))).interventions
    assert placed.targets == (bowl,)


def test_what_the_caller_changes_is_looked_for_under_its_name() -> None:
    asked = "If the red ball rolls right, will it hit the blue cube?"
    reading = EmbeddedReader().ground(ReaderInput(scene(), asked, sought=("green ball", "The Blue cube", "sofa")))
    assert {other.object for other in reading.others} == {"blue cube", "green ball"}


def test_both_of_a_kind_are_taken_away() -> None:
    image = block(ball(floor(), (110, 200), 40, RED), (250, 150, 330, 230), GREEN)
    image = block(image, (430, 150, 520, 235), BLUE)
    question = "If both cubes are taken away and the red ball rolls right, will it hit anything?"
    reading = EmbeddedReader().ground(ReaderInput(Scene(jpeg(image)), question))
    assert {change.object.object for change in reading.interventions} == {"green cube", "blue cube"}


@pytest.mark.parametrize(
    ("question", "named"),
    [
        ("If the white vase is removed and the red ball rolls right, will it hit the cube?", "'white vase'"),
        ("If I put the red ball into the pink bowl, will it fit?", "'pink bowl'"),
        ("If the red ball is removed and the red ball rolls right, will it hit the cube?", "'red ball' away"),
        ("If the red ball is taken away and then rolls right, does it hit the blue cube?", "'red ball' away"),
        ("If the red ball is removed and it rolls right, does it hit the blue cube?", "'red ball' away"),
        ("If I put the red ball into itself, will it fit?", "into itself"),
        ("If the three cubes are taken away and the red ball rolls right, will it hit anything?", "'three cubes'"),
    ],
)
def test_changes_that_cannot_be_are_refused_by_name(question: str, named: str) -> None:
    with pytest.raises(CannotGround) as caught:
        EmbeddedReader().ground(ReaderInput(scene(), question))
    assert named in caught.value.detail
