"""The embedded reader on drawn scenes: what it finds, how it says that things move, and what it refuses."""

from __future__ import annotations

from contextlib import suppress
from functools import cache
from typing import Any

import cv2
import pytest
from drawn import DrawnArrow, angle_between, ball, block, floor, jpeg
from hypothesis import given, settings
from hypothesis import strategies as st
from refusals import refused
from runs import run_of

from cow_service.errors import CowError
from cow_service.media.masks import iou
from cow_service.perception.observation import Observation, look
from cow_service.physics.camera import depth_motion
from cow_service.readers.base import ReaderInput, ReadResult
from cow_service.readers.embedded.reader import EmbeddedReader
from cow_service.records import (
    MAX_OBJECTS,
    BBox,
    Distance,
    GroundingRequest,
    InterventionRequest,
    Motion,
    MotionRequest,
    MotionStepRequest,
    ObjectRequest,
    Reading,
    Speed,
)
from cow_service.stages.grounding import ground
from cow_service.stages.motion import settle_motion
from cow_service.stages.run import Run

RED, BLUE, GREEN, ORANGE = (200, 30, 30), (50, 80, 200), (50, 150, 50), (235, 130, 40)
reader = EmbeddedReader()


@cache
def drawn(arrow: float | None = None) -> Observation:
    """A red ball left, a blue block right; an arrow at the ball to the right (0.2) or to the left (3.0)."""
    image = block(ball(floor(), (150, 200), 40, RED), (430, 150, 520, 250), BLUE)
    if arrow is not None:
        image = DrawnArrow((200, 200), arrow, 110, 5, (30, 160, 30), "filled").on(image)
    return look(jpeg(image))


@cache
def three() -> Observation:
    """A red ball left, a green one in the middle, a blue block right."""
    image = ball(ball(floor(), (110, 200), 40, RED), (300, 200), 40, GREEN)
    return look(jpeg(block(image, (430, 150, 520, 250), BLUE)))


def said(scene: Observation, question: str, **known: Any) -> ReadResult:
    return reader.read(ReaderInput(scene.image, question, scene, given=Reading(**known)))


def found(scene: Observation, question: str, **known: Any) -> Reading:
    return said(scene, question, **known).reading


def mover_box(reading: Reading) -> BBox:
    assert reading.grounding is not None
    assert reading.grounding.bbox is not None
    return reading.grounding.bbox


def names(reading: Reading) -> list[str]:
    return [each.object for each in reading.objects]


def settled(scene: Observation, question: str) -> tuple[Run, Motion]:
    """What the stages make of what is read."""
    run = run_of(scene.image, reader=lambda: reader, question=question)
    grounding = run.stage("grounding", ground)
    return run, run.stage("motion", settle_motion, grounding, run.read_motion)


def asking(words: str) -> str:
    return f"If the red ball {words}, will it hit the blue cube?"


def motion_of(words: str, scene: Observation | None = None) -> Motion:
    return settled(scene or drawn(), asking(words))[1]


# What moves


def test_colour_and_arrow() -> None:
    run, motion = settled(drawn(0.2), asking("moves in the direction of the arrow"))
    grounding = run.grounding
    assert grounding is not None
    assert grounding.object == "red ball"
    assert iou(grounding.bbox, (110, 160, 190, 240)) > 0.8
    assert [other.object for other in grounding.others] == ["blue cube"]
    assert iou(grounding.others[0].bbox, (430, 150, 520, 250)) > 0.8
    assert (motion.kind, motion.cue, motion.along_arrow) == ("linear", "arrow", True)
    assert motion.direction is not None
    assert angle_between(motion.direction, DrawnArrow((0, 0), 0.2, 1, 1, RED, "").direction) < 2
    motion = motion_of("rolls opposite to the direction of the arrow", drawn(3.0))
    assert motion.along_arrow is False
    assert motion.direction is not None
    assert motion.direction[0] > 0.9
    run, motion = settled(drawn(0.2), asking("is thrown"))
    assert motion.cue == "arrow"
    assert any("arrow" in warning for warning in run.warnings("motion")), "one not spoken of is followed aloud"


@cache
def five() -> Observation:
    """Three red balls of different sizes and heights in the image, a green one and a blue block."""
    image = ball(ball(ball(floor(), (110, 220), 40, RED), (300, 120), 30, RED), (480, 230), 55, RED)
    return look(jpeg(block(ball(image, (210, 330), 36, GREEN), (560, 60, 620, 130), BLUE)))


def test_words_of_place_and_size_single_one_out() -> None:
    for words, x in {
        "ball on the left": 110, "right ball": 480, "ball in the back": 300, "largest ball": 480,
        "smallest ball": 300, "red ball in the middle": 300, "front ball": 210,
    }.items():  # fmt: skip
        reading = found(five(), f"If the {words} moves up, what happens?")
        assert mover_box(reading)[0] == pytest.approx(x - 40, abs=20), words


def test_what_singles_a_thing_out() -> None:
    assert iou(mover_box(found(drawn(), "If the ball moves left, what happens?")), (110, 160, 190, 240)) > 0.8
    twins = ball(ball(floor(), (150, 200), 40, RED), (450, 200), 40, RED)
    at_arrow = look(jpeg(DrawnArrow((500, 200), 0.0, 90, 5, (20, 60, 200), "open").on(twins)))
    at_it = found(at_arrow, "If the ball moves in the direction of the arrow, where does it go?")
    assert mover_box(at_it)[0] > 400
    boxed = ball(ball(floor(), (150, 200), 40, RED), (450, 200), 40, GREEN)
    cv2.rectangle(boxed, (395, 145), (505, 255), (230, 200, 20), 3)
    asked = "If the object inside the yellow box moves left, will it hit the red ball?"
    assert mover_box(found(look(jpeg(boxed)), asked))[0] > 400
    image = block(block(floor(), (400, 200, 540, 260), BLUE), (430, 160, 510, 202), BLUE)
    vehicle = look(jpeg(block(ball(image, (150, 200), 40, RED), (260, 150, 340, 240), GREEN)))
    x0, _, x1, _ = mover_box(found(vehicle, "If the bus moves left, what happens?"))  # what is longer than high
    assert (x0 + x1) / 2 == pytest.approx(470, abs=6)


def test_a_thing_is_meant_by_evidence_and_never_because_it_is_left() -> None:
    """A lone noun is no name of the only thing there is, unless the outline is that of the noun."""
    block_alone = look(jpeg(block(floor(), (430, 130, 505, 250), RED)))
    for name in ("soccer ball", "kettle", "vase"):
        with refused("cannot-ground"):
            found(block_alone, f"If the {name} slides right, what happens?")
    result = said(drawn(), "If the red ball rolls right, will it hit the kettle?")
    assert result.reading.objects == ()
    assert any("'kettle'" in warning for warning in result.warnings)
    assert names(found(drawn(), "If the red ball rolls right, will it hit the other one?")) == ["other one"]
    assert names(found(three(), "If the red ball rolls right, will it hit the other one?")) == []


def test_what_is_not_as_it_is_called_is_doubted() -> None:
    told = {"grean ball": True, "blue elephant": True, "shiny ball": False, "red ball": False}
    for name, is_doubtful in told.items():
        result = said(drawn(), f"If the {name} moves left, will it hit the cube?")
        assert result.reading.grounding is not None
        assert result.reading.grounding.is_doubtful is is_doubtful
        assert any(f"'{name}' was taken for" in warning for warning in result.warnings) is is_doubtful


def test_words_that_are_passed_over_and_things_that_are_not_found_are_named() -> None:
    for question, named in {
        "If the red ball rolls right, will it hit the blue cone?": "blue cone",  # what is not found is in no answer
        "The plate is slippery. If the red ball rolls right, will it hit the cube?": "the plate is slippery",
    }.items():
        result = said(drawn(), question)
        assert named not in names(result.reading)
        assert any(f"'{named}'" in warning for warning in result.warnings)
    with refused("cannot-read-direction") as caught:
        said(drawn(), "If the red ball rolls right past the blue cube, what happens?")
    assert "'past the blue cube'" in caught.value.detail


def test_what_the_caller_looks_for_and_all_of_a_kind_are_found() -> None:
    asked = "If the red ball rolls right, will it hit the blue cube?"
    sought = tuple(ObjectRequest(object=name) for name in ("green ball", "The Blue cube", "sofa"))
    assert set(names(found(three(), asked, objects=sought))) == {"blue cube", "green ball"}
    result = said(three(), "If the blue cube slides left, does it hit both balls?")
    assert set(names(result.reading)) == {"red ball", "green ball"}
    assert result.warnings == ()


# What is changed before it moves


def test_what_is_taken_away_and_where_things_are_put() -> None:
    reading = found(three(), "If the green ball is removed and the red ball rolls right, will it hit the blue cube?")
    assert reading.interventions == (InterventionRequest(kind="remove", object="green ball"),)
    boxes = {each.object: each.bbox or (0.0,) for each in reading.objects}
    assert boxes.keys() == {"green ball", "blue cube"}
    assert boxes["green ball"][0] == pytest.approx(260, abs=4)
    reading = found(three(), "If I put the red ball onto the blue cube, will it tip?")
    put = InterventionRequest(kind="place", object="red ball", relation="onto", targets=("blue cube",))
    assert reading.interventions == (put,)
    assert reading.grounding is not None
    assert reading.grounding.object == "red ball"
    image = block(ball(floor(), (110, 200), 40, RED), (250, 150, 330, 230), GREEN)
    both = look(jpeg(block(image, (430, 150, 520, 235), BLUE)))
    reading = found(both, "If both cubes are taken away and the red ball rolls right, will it hit anything?")
    assert {change.object for change in reading.interventions} == {"green cube", "blue cube"}


def test_things_of_one_kind_and_colour_have_names_of_their_own() -> None:
    """A change names what it is about: two red cubes are told apart."""
    image = block(ball(floor(), (110, 300), 40, GREEN), (250, 150, 330, 230), RED)
    twins = look(jpeg(block(image, (430, 150, 510, 230), RED)))
    reading = found(twins, "If both cubes are taken away and the green ball rolls right, will it hit anything?")
    assert len({change.object for change in reading.interventions}) == 2
    reading = found(twins, "If I put the green ball between the cubes, will it fit?")
    (put,) = reading.interventions
    boxes = {each.object: each.bbox or (0.0,) for each in reading.objects}
    assert sorted(boxes[name][0] for name in put.targets) == pytest.approx([250, 430], abs=4)


def test_what_the_caller_has_located_is_not_looked_for() -> None:
    crate, bowl = (ObjectRequest(object=name, bbox=(x, 20, x + 60, 70)) for name, x in (("Crate", 200), ("bowl", 300)))
    asked = "If the crate is removed and the red ball rolls right, will it hit the blue cube?"
    reading = found(three(), asked, objects=(crate, bowl))
    assert [each.object for each in reading.interventions] == ["Crate"]
    assert names(reading) == ["blue cube"]
    reading = found(three(), "If I put the red ball into the bowl, will it fit?", objects=(crate, bowl))
    (placed,) = reading.interventions
    assert placed.targets == ("bowl",)
    assert names(reading) == []


@pytest.mark.parametrize(
    "question",
    [
        "If the white vase is removed and the red ball rolls right, will it hit the cube?",
        "If I put the red ball into the pink bowl, will it fit?",
        "If the red ball is taken away and then rolls right, does it hit the blue cube?",
        "The blue cube is removed. The red ball rolls right. Does it hit the blue cube?",
        "If I put the red ball into itself, will it fit?",
        "If the three cubes are taken away and the red ball rolls right, will it hit anything?",
        "If both balls roll right, is the cube hit?",
        "If the blue cube slides left, does it hit all three balls?",
        "If the thing between rolls down, will it hit the cube?",
        "There is a red ball and a blue cube. If the latter slides left, does it hit the former?",
        "If the ball moves left, will it hit the cube?",  # which of two
        "If the object inside the box moves left, what happens?",
        "If the green ball is removed and the ball rolls right, will it hit the blue cube?",
        "If the table is tilted to the right, where does the ball roll?",
        "If the balls move left, do they hit the cube?",
        "Is this nice?",
    ],
)
def test_what_cannot_be_found_or_changed_is_refused(question: str) -> None:
    with refused("cannot-ground") as caught:
        found(three(), question)
    assert caught.value.remedy or "away" in question or "removed" in question or "itself" in question


def test_a_refusal_says_what_was_looked_for_and_what_is_seen() -> None:
    with refused("cannot-ground") as caught:
        found(drawn(), "If the purple ball moves left, will it hit the cube?")
    assert "'purple ball'" in caught.value.detail
    assert "red at (1" in caught.value.detail
    assert "grounding.point" in caught.value.remedy
    image = ball(block(floor(), (430, 150, 520, 250), RED), (150, 200), 40, RED)
    with refused("cannot-ground"):  # "one" is no noun
        found(look(jpeg(image)), "If the red one slides left, what happens?")


# How it moves


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("moves up", {"direction": (0, -1)}),
        ("slides downwards", {"direction": (0, 1), "depth": depth_motion(-1.0)[1]}),
        ("moves towards the camera", dict(zip(("direction", "depth"), depth_motion(-1.0), strict=True))),
        ("moves away from the camera", dict(zip(("direction", "depth"), depth_motion(1.0), strict=True))),
        ("is raised upwards", {"direction": (0, -1), "rises": True}),
        ("falls freely", {"kind": "fall", "direction": None, "cue": None}),
        ("is thrown to the right", {"kind": "projectile"}),
        ("stays still", {"kind": "static", "direction": None, "cue": None}),
        ("rolls over to the left", {"direction": (-1, 0)}),
        ("rolls slowly to the right", {"speed": "slow"}),
        ("is pushed hard to the right", {"speed": "fast"}),
        (
            "rolls right at 20 pixels per second for 5 seconds",
            {"speed": Speed(value=20.0, unit="px/s"), "duration": 5.0},
        ),
        ("rolls right at a speed of 2.5 m/s", {"speed": Speed(value=2.5, unit="m/s")}),
        ("moves right by 50 pixels", {"distance": Distance(value=50.0, unit="px")}),
        ("moves 10 centimetres to the right", {"distance": Distance(value=0.1, unit="m")}),
        ("rolls right for half a second and then stops", {"duration": 0.5}),
        ("rolls right until it meets something", {"until": "contact"}),
        (
            "moves down by 50 pixels, then right for 2 seconds",
            {
                "direction": (0, 1),
                "distance": Distance(value=50.0, unit="px"),
                "steps": (MotionStepRequest(direction=(1.0, 0.0), duration=2.0),),
            },
        ),
    ],
)
def test_how_the_words_say_that_it_moves(words: str, expected: dict[str, Any]) -> None:
    wanted: dict[str, Any] = {"kind": "linear", "direction": (1, 0), "cue": "text"} | expected
    told = MotionRequest(**{name: value for name, value in wanted.items() if value is not None})
    assert found(drawn(), asking(words)).motion == told, "and nothing else is said"


def test_towards_a_thing_a_part_of_the_way_and_a_second_mover() -> None:
    motion = motion_of("rolls towards the blue cube but stops halfway")
    assert motion.distance == pytest.approx(162, abs=3)  # half of 150 to 475
    assert motion.towards is not None
    assert motion.towards.object == "blue cube"
    assert motion.direction is not None
    assert angle_between(motion.direction, (1, 0)) < 4
    told = "If the red ball moves right and the blue cube moves left, will the ball hit the cube?"
    _, motion = settled(drawn(), told)
    (other,) = motion.others
    assert (other.object.object, other.direction, motion.direction) == ("blue cube", (-1.0, 0.0), (1.0, 0.0))


def test_of_what_is_given_the_words_or_the_arrow_alone_tell_the_motion() -> None:
    """Neither a goal nor a mover need be named as one that was located."""
    place = {"object": "red ball", "bbox": (110, 160, 190, 240)}

    def motion(scene: Observation, question: str) -> Motion:
        run = run_of(scene.image, reader=lambda: reader, question=question, grounding=place)
        return run.stage("motion", settle_motion, run.stage("grounding", ground), None)

    told = motion(drawn(), "If the red ball rolls towards the blue cube, will it hit it?")
    assert told.direction is not None
    assert angle_between(told.direction, (1, 0)) < 4
    assert "towards the blue cube" in told.sentence
    told = motion(drawn(0.2), "Trifft die Kugel den Würfel?")
    assert (told.cue, told.along_arrow) == ("arrow", True)
    with refused("cannot-read-direction"):
        motion(drawn(), "Trifft die Kugel den Würfel?")


def test_a_fall_is_that_of_a_ball_or_of_what_is_in_the_air() -> None:
    place = GroundingRequest(object="blue cube", bbox=(430, 150, 520, 250))

    def kind(words: str, stands_on: str | None = None) -> str | None:
        known = place.model_copy(update={"stands_on": stands_on})
        motion = found(drawn(), f"If the blue cube {words}, what happens?", grounding=known).motion
        return motion and motion.kind

    for words in ("falls freely from its current position", "is dropped", "drops", "is let go"):
        assert kind(words) == "fall"
    assert kind("falls", stands_on="air") == "fall"
    for words in ("falls", "falls to the left", "tips off the shelf", "topples down", "moves left and topples"):
        with refused("cannot-read-direction"):
            kind(words, stands_on="floor")


@pytest.mark.parametrize(
    "words", ["tips over", "falls over to the left", "is pushed over", "is blown over to the left"]
)
def test_what_falls_over_where_it_stands_is_not_dropped(words: str) -> None:
    for start in ("If", "If the red ball rolls left while", "If the red ball rolls left and"):
        with refused("cannot-read-direction"):
            settled(drawn(), f"{start} the blue cube {words}, what happens?")


@pytest.mark.parametrize(
    "words",
    [
        "falls upwards",
        "rises downwards",
        "moves up and down",
        "moves left and stays still",
        "rolls right but stops halfway",
        "moves along the arrow",
        "moves forward",
        "moves towards the green vase",
        "flies on along its trail",
        "moves opsit to the arrow",
        "moves to the left of the blue cube",
        "comes from the left",
        "moves north-east",
        "does not move to the left but to the right",
    ],
)
def test_a_way_that_is_not_said_or_contradicts_itself_is_refused(words: str) -> None:
    with refused("cannot-read-direction") as caught:
        motion_of(words)
    assert "motion.direction" in caught.value.remedy


def test_arrows_that_may_not_be_the_movers_are_not_followed() -> None:
    image = ball(ball(floor(), (120, 80), 35, RED), (200, 300), 40, BLUE)
    elsewhere = DrawnArrow((205, 300), 0.0, 120, 5, (30, 160, 30), "filled").on(image)
    two = ball(floor(), (300, 200), 40, RED)
    for start, angle in (((355, 200), 0.0), ((245, 200), 3.1)):
        two = DrawnArrow(start, angle, 100, 5, (20, 60, 200), "filled").on(two)
    for scene in (elsewhere, two):
        with refused("cannot-read-direction"):
            settled(look(jpeg(scene)), "If the red ball moves along the arrow, what happens?")
    run, motion = settled(drawn(0.2), asking("moves along the arrow to the left"))  # the arrow does not point there
    assert (motion.cue, motion.other_direction) == ("arrow", (-1.0, 0.0))
    assert any("contradict the arrow" in warning for warning in run.warnings("motion"))
    motion = motion_of("moves along the arrow to the right", drawn(0.2))
    assert motion.direction == pytest.approx(DrawnArrow((0, 0), 0.2, 1, 1, RED, "").direction, abs=0.03)
    assert motion.other_direction is None
    twins = look(jpeg(ball(ball(ball(floor(), (150, 200), 40, RED), (450, 200), 40, RED), (300, 270), 30, BLUE)))
    with refused("cannot-read-direction"):
        settled(twins, "If the blue ball moves towards the red ball, what happens?")


@pytest.mark.parametrize(
    ("name", "shape", "opening"),
    [
        ("blue mug", "cylinder", "round"),
        ("wooden box", "box", "square"),
        ("brick", "box", "none"),
        ("tray", None, "square"),
        ("gizmo", None, None),
    ],
)
def test_a_name_says_what_its_noun_does(name: str, shape: str | None, opening: str | None) -> None:
    read = reader.read_name(name)
    assert (read.shape, read.opening) == (shape, opening)


MANY = ", the ".join(f"{colour} {noun}" for noun in ("mug", "cone", "cup") for colour in ("red", "blue", "green"))
WORDS = st.one_of(
    st.text(max_size=40),
    st.sampled_from(
        ("red ball", "blue cube", "both balls", "cubes", "one", "ball " + "x" * 250, "very " * 50 + "ball")
    ),
    st.just(MANY),
)
NUMBERS = st.one_of(st.integers(), st.floats(), st.sampled_from(("0", "-0.0", "1e9", "½", "two", "half a", "9" * 20)))
UNITS = st.sampled_from(
    ("pixels", "px", "m", "cm", "km", "s", "seconds", "hours", "ms", "m/s", "km/h", "px/s", "%", "")
)
FORMS = (
    "{one}",
    "If the {one} rolls right by {n} {unit}, will it hit the {two}?",
    "If the red ball rolls right for {n} {unit}, then left at {n} {unit}, will it hit the {two} within {n} {unit}?",
    "If the red ball rolls towards the {one} at a speed of {n} {unit}, does it hit the {two} or the blue cube first?",
    "If the {one} is removed and the red ball falls at {n} {unit}, will it hit the {two}?",
    "If I put the red ball between the {one} and the {two}, will it fit?",
    "If the {one} is put onto the {two} and the red ball rolls right, which of the {one}, the {two} does it hit?",
    "If the red ball rolls right and the {one} moves towards the {two} at {n} {unit}, will they collide?",
)


@settings(max_examples=150, deadline=None)
@given(st.sampled_from(FORMS), WORDS, WORDS, NUMBERS, UNITS)
def test_whatever_is_asked_is_read_or_refused(form: str, one: str, two: str, number: object, unit: str) -> None:
    """Names, numbers and lists beyond the limits of a request among them."""
    question = form.format(one=one, two=two, n=number, unit=unit)
    assert len(reader.read_question(question).reading.objects) <= MAX_OBJECTS
    with suppress(CowError):
        Reading.model_validate(said(three(), question).reading.model_dump())
