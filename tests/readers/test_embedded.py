"""The embedded reader on drawn scenes: what it finds, and what it refuses and how it says so."""

from __future__ import annotations

from typing import Any

import cv2
import pytest
from drawn import DrawnArrow, angle_between, ball, block, floor, jpeg

from cow_service.errors import CannotGround, CannotReadDirection
from cow_service.physics.camera import depth_motion
from cow_service.readers.base import Quantity, ReaderInput, StepReading
from cow_service.readers.embedded.reader import EmbeddedReader
from cow_service.records import Grounding, ObjectPrior
from cow_service.vision.masks import iou
from cow_service.vision.scene import Scene

RED, BLUE, GREEN, ORANGE = (200, 30, 30), (50, 80, 200), (50, 150, 50), (235, 130, 40)
reader = EmbeddedReader()


def drawn(arrow: bool = True, against: bool = False) -> Scene:
    """A red ball left, a blue block right; an arrow from the ball to the right, or to the left."""
    image = block(ball(floor(), (150, 200), 40, RED), (430, 150, 520, 250), BLUE)
    if arrow:
        image = DrawnArrow((200, 200), 3.0 if against else 0.2, 110, 5, (30, 160, 30), "filled").on(image)
    return Scene(jpeg(image))


def read(scene: Scene, question: str):
    given = ReaderInput(scene, question)
    reading = reader.ground(given)
    box = reading.bbox
    point = ((box[0] + box[2]) / 2, (box[1] + box[3]) / 2)
    grounding = Grounding(object=reading.object, point=point, bbox=box, others=reading.others, source="embedded")
    return grounding, reader.read_motion(given, grounding, reading.hints)


def test_colour_and_arrow() -> None:
    grounding, motion = read(drawn(), "If the red ball moves in the direction of the arrow, will it hit the blue cube?")
    assert grounding.object == "red ball"
    assert iou(grounding.bbox, (110, 160, 190, 240)) > 0.8
    assert [other.object for other in grounding.others] == ["blue cube"]
    assert iou(grounding.others[0].bbox, (430, 150, 520, 250)) > 0.8
    assert (motion.kind, motion.cue, motion.along_arrow) == ("linear", "arrow", True)
    assert motion.direction is not None
    assert angle_between(motion.direction, DrawnArrow((0, 0), 0.2, 1, 1, RED, "").direction) < 2


def test_against_the_arrow() -> None:
    _, motion = read(
        drawn(against=True), "If the red ball rolls opposite to the direction of the arrow, will it hit the cube?"
    )
    assert motion.along_arrow is False
    assert motion.direction is not None
    assert motion.direction[0] > 0.9


@pytest.mark.parametrize(
    ("words", "direction"),
    [
        ("moves to the left", (-1, 0)),
        ("rolls to the right", (1, 0)),
        ("moves up", (0, -1)),
        ("slides downwards", (0, 1)),
        ("moves towards the blue cube", (1, 0)),
    ],
)
def test_directions_in_words(words: str, direction: tuple[float, float]) -> None:
    _, motion = read(drawn(arrow=False), f"If the red ball {words}, will it hit the blue cube?")
    assert motion.direction is not None
    assert angle_between(motion.direction, direction) < 2
    assert motion.cue == "text"


@pytest.mark.parametrize(("words", "sense"), [("towards the camera", -1.0), ("away from the camera", 1.0)])
def test_towards_and_away_from_the_camera(words: str, sense: float) -> None:
    _, motion = read(drawn(arrow=False), f"If the red ball moves {words}, will it hit the blue cube?")
    assert (motion.direction, motion.depth) == depth_motion(sense)


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("rolls slowly to the right", {"speed": "slow"}),
        ("is pushed hard to the right", {"speed": "fast"}),
        ("rolls right at 20 pixels per second for 5 seconds", {"speed": Quantity(20.0, "px/s"), "duration": 5.0}),
        ("rolls right at a speed of 2.5 m/s", {"speed": Quantity(2.5, "m/s")}),
        ("moves right by 50 pixels", {"distance": Quantity(50.0, "px")}),
        ("moves 10 centimetres to the right", {"distance": Quantity(0.1, "m")}),
        ("rolls right for half a second and then stops", {"duration": 0.5}),
        ("rolls right until it meets something", {"until": "contact"}),
    ],
)
def test_how_fast_how_far_how_long(words: str, expected: dict[str, object]) -> None:
    _, motion = read(drawn(arrow=False), f"If the red ball {words}, will it hit the blue cube?")
    assert motion.direction == (1.0, 0.0)
    said = {name: getattr(motion, name) for name in ("speed", "distance", "duration", "until")}
    assert {name: value for name, value in said.items() if value is not None} == expected


def test_a_part_of_the_way_is_told_from_its_end() -> None:
    told = "If the red ball rolls towards the blue cube but stops halfway, will it hit it?"
    _, motion = read(drawn(arrow=False), told)
    assert motion.distance is not None
    assert motion.distance.value == pytest.approx(162, abs=3)  # half of 150 to 475
    question = "If the red ball rolls right but stops halfway, will it hit the cube?"
    assert "not where to" in refusal(CannotReadDirection, drawn(False), question)


def test_several_legs_and_a_second_mover() -> None:
    told = "If the red ball moves down by 50 pixels, then right for 2 seconds, will it hit the blue cube?"
    _, motion = read(drawn(arrow=False), told)
    assert (motion.direction, motion.distance) == ((0.0, 1.0), Quantity(50.0, "px"))
    assert motion.steps == (StepReading((1.0, 0.0), 0.0, None, 2.0),)
    told = "If the red ball moves right and the blue cube moves left, will the ball hit the cube?"
    _, motion = read(drawn(arrow=False), told)
    (other,) = motion.others
    assert (other.object.object, other.direction, motion.direction) == ("blue cube", (-1.0, 0.0), (1.0, 0.0))


def test_falls_throws_and_rests() -> None:
    assert read(drawn(False), "If the red ball falls freely, will it land on the cube?")[1].kind == "fall"
    assert read(drawn(False), "If the red ball is thrown to the right, will it hit the cube?")[1].kind == "projectile"
    assert read(drawn(False), "If the red ball stays still, will it hit the cube?")[1].kind == "static"


@pytest.mark.parametrize(
    "words",
    ["tips over", "topples", "falls over", "falls over to the left", "is pushed over", "is blown over to the left"],
)
def test_what_falls_over_where_it_stands_is_not_dropped(words: str) -> None:
    for start in ("If", "If the red ball rolls left while", "If the red ball rolls left and"):
        told = f"{start} the blue cube {words}, what happens?"
        assert "fall over where it stands" in refusal(CannotReadDirection, drawn(False), told)


def test_a_fall_is_that_of_a_ball_or_of_what_is_in_the_air() -> None:
    def kind(words: str, **prior: Any) -> str:
        scene, told = drawn(False), f"If the {words}, what happens?"
        grounding, _ = read(scene, f"If the {' '.join(words.split()[:2])} moves left, what happens?")
        known = grounding.model_copy(update={"prior": ObjectPrior(**prior)})
        return reader.read_motion(ReaderInput(scene, told), known, None).kind

    for words in ("falls", "falls over the edge of the table", "falls over the blue cube"):
        assert kind(f"red ball {words}") == "fall"
    assert kind("red ball rolls over to the left") == "linear"
    for words in ("falls freely from its current position", "is dropped", "drops", "is let go"):
        assert kind(f"blue cube {words}") == "fall"
    assert kind("blue cube falls", stands_on="air") == "fall"
    assert "fall over" in refusal(
        CannotReadDirection, drawn(False), "If the blue cube moves left and topples, what then?"
    )
    for words in ("falls", "falls to the left", "tips off the shelf", "topples down"):
        told = refusal(CannotReadDirection, drawn(False), f"If the blue cube {words}, what happens?")
        assert "cannot see whether the blue cube stands or hangs" in told
    with pytest.raises(CannotReadDirection):
        kind("blue cube falls", stands_on="floor")


@pytest.mark.parametrize("words", ["falls upwards", "rises downwards"])
def test_a_verb_that_its_direction_contradicts_is_refused(words: str) -> None:
    assert "contradict" in refusal(CannotReadDirection, drawn(False), f"If the red ball {words}, what happens?")


def test_one_is_no_noun() -> None:
    image = ball(block(floor(), (430, 150, 520, 250), RED), (150, 200), 40, RED)
    assert "any of 2" in refusal(CannotGround, Scene(jpeg(image)), "If the red one slides left, what happens?")


def test_what_is_longer_than_high_is_the_vehicle() -> None:
    image = block(block(floor(), (400, 200, 540, 260), BLUE), (430, 160, 510, 202), BLUE)
    image = block(ball(image, (150, 200), 40, RED), (260, 150, 340, 240), GREEN)
    grounding, _ = read(Scene(jpeg(image)), "If the bus moves left, what happens?")
    assert grounding.point[0] == pytest.approx(470, abs=6)


def test_bare_names_are_found_together_and_what_is_not_there_is_refused() -> None:
    scene = Scene(jpeg(block(block(floor(), (110, 160, 200, 250), GREEN), (430, 130, 505, 250), BLUE)))
    grounding, _ = read(scene, "If the cube slides right, will it hit the cylinder?")
    assert grounding.point[0] == pytest.approx(155, abs=3)
    assert [(other.object, round(other.bbox[0], -1)) for other in grounding.others] == [("cylinder", 430)]
    given = ReaderInput(scene, "If the cylinder is removed and the cube slides right, what happens?")
    (removed,) = reader.ground(given).interventions
    assert removed.object.bbox == grounding.others[0].bbox
    assert "'vase' was not found" in refusal(CannotGround, scene, "If the vase slides right, what happens?")


def test_the_only_ball_needs_no_colour() -> None:
    grounding, _ = read(drawn(False), "If the ball moves left, what happens?")
    assert iou(grounding.bbox, (110, 160, 190, 240)) > 0.8


@pytest.mark.parametrize(
    ("words", "x"),
    [
        ("the ball on the left", 110), ("the leftmost ball", 110), ("the right ball", 480),
        ("the ball in the back", 300),
        ("the largest ball", 480), ("the smallest ball", 300), ("the ball in the middle", 300),
    ],
)  # fmt: skip
def test_words_of_place_and_size_single_one_out(words: str, x: int) -> None:
    image = ball(ball(ball(floor(), (110, 220), 40, RED), (300, 120), 30, RED), (480, 230), 55, RED)
    grounding, _ = read(Scene(jpeg(image)), f"If {words} moves up, what happens?")
    assert grounding.point[0] == pytest.approx(x, abs=4)


def test_a_noun_that_is_not_what_is_seen_is_warned_of() -> None:
    grounding = reader.ground(ReaderInput(drawn(False), "If the red ball rolls right, will it hit the blue cone?"))
    assert any("'blue cone' was not found" in warning for warning in grounding.warnings)
    assert grounding.others == ()  # what is not found is in no answer
    warnings = reader.ground(ReaderInput(drawn(False), "If the blue elephant moves right, what happens?")).warnings
    assert any("whether 'elephant' is right" in warning for warning in warnings)


@pytest.mark.parametrize(
    ("question", "words"),
    [
        ("The floor is slippery. If the red ball rolls right, will it hit the cube?", "'floor is slippery'"),
        ("If the red ball rolls wildly to the right, will it hit the cube?", "'wildly'"),
        ("If the red ball rolls right past the blue cube, what happens?", "'past the blue cube'"),
    ],
)
def test_words_that_are_passed_over_are_named(question: str, words: str) -> None:
    warnings = reader.ground(ReaderInput(drawn(False), question)).warnings
    assert any(words in warning for warning in warnings)


def test_of_two_balls_the_one_at_the_arrow_moves() -> None:
    image = ball(ball(floor(), (150, 200), 40, RED), (450, 200), 40, RED)
    scene = Scene(jpeg(DrawnArrow((500, 200), 0.0, 90, 5, (20, 60, 200), "open").on(image)))
    grounding, _ = read(scene, "If the ball moves in the direction of the arrow, where does it go?")
    assert grounding.point[0] > 400


def test_the_object_inside_the_box() -> None:
    image = ball(ball(floor(), (150, 200), 40, RED), (450, 200), 40, GREEN)
    cv2.rectangle(image, (395, 145), (505, 255), (230, 200, 20), 3)
    grounding, _ = read(Scene(jpeg(image)), "If the object inside the yellow box moves left, will it hit the red ball?")
    assert grounding.point[0] > 400


def test_an_arrow_not_spoken_of_is_followed_aloud() -> None:
    _, motion = read(drawn(), "If the red ball is thrown, will it hit the blue cube?")
    assert motion.cue == "arrow"
    assert motion.warnings


def refusal(error, scene: Scene, question: str) -> str:
    with pytest.raises(error) as caught:
        read(scene, question)
    return str(caught.value)


@pytest.mark.parametrize(("name", "is_doubtful"), [("grean ball", True), ("shiny ball", False), ("left ball", False)])
def test_what_is_nearly_a_colour_is_not_passed_over(name: str, is_doubtful: bool) -> None:
    found = reader.ground(ReaderInput(drawn(False), f"If the {name} moves left, will it hit the cube?"))
    assert found.is_doubtful is is_doubtful
    assert any("is no colour that is known" in each for each in found.warnings) is is_doubtful


def test_refusals_say_what_was_looked_for_what_was_seen_and_what_to_give() -> None:
    told = refusal(CannotGround, drawn(), "If the purple ball moves left, will it hit the cube?")
    assert "'purple ball'" in told
    assert "red at (1" in told
    assert "grounding.point" in told
    told = refusal(CannotGround, drawn(), "If the dragon moves left, will it hit the cube?")
    assert "'dragon' names no colour and no shape that is known here. Seen: " in told
    told = refusal(CannotGround, drawn(), "Is this nice?")
    assert "does not say in words what moves" in told
    twins = Scene(jpeg(ball(ball(ball(floor(), (150, 200), 40, RED), (450, 200), 40, RED), (300, 270), 30, BLUE)))
    assert "may be any of 2: red at" in refusal(CannotGround, twins, "If the red ball moves left, what happens?")
    told = "'red ball' may be any of 2: red at"
    assert told in refusal(CannotReadDirection, twins, "If the blue ball moves towards the red ball, what happens?")
    told = refusal(CannotReadDirection, drawn(False), "If the red ball moves along the arrow, will it hit the cube?")
    assert "no drawn arrow was found" in told
    assert "motion.direction" in told
    told = refusal(CannotReadDirection, drawn(False), "If the red ball moves, will it hit the cube?")
    assert "names no direction" in told
    told = refusal(CannotReadDirection, drawn(False), "If the red ball moves forward, will it hit the cube?")
    assert "only of vehicles with wheels which way they face" in told
    told = refusal(CannotReadDirection, drawn(False), "If the red ball moves towards the green vase, will it hit it?")
    assert "'green vase'" in told
    told = refusal(CannotGround, drawn(False), "If the object inside the box moves left, what happens?")
    assert "no box" in told


MUGS = block(
    block(ball(floor(), (150, 120), 35, (225, 200, 50)), (260, 230, 330, 330), (235, 235, 235)),
    (450, 150, 520, 250),
    BLUE,
)


@pytest.mark.parametrize(
    "question",
    [
        "If the green ball moves right, will it hit the mug?",
        "If the mug moves to the left, will it hit the ball?",
        "If the mugs move left, do they hit the ball?",
        "If the wind blows from the left, where does the yellow ball go?",
        "If the table is tilted to the right, where does the ball roll?",
        "If the yelow bal moves opsit to the arrow, will it hit the mug?",
        "If the yellow ball moves to the left of the blue mug, will it touch it?",
        "If the yellow ball comes from the left, will it hit the blue mug?",
        "If the yellow ball moves north-east, what happens?",
        "If the yellow ball does not move to the left but to the right, will it hit the mug?",
    ],
)
def test_what_was_not_understood_is_never_guessed(question: str) -> None:
    scene = Scene(jpeg(DrawnArrow((110, 110), 3.0, 80, 4, (220, 20, 20), "filled").on(MUGS)))
    with pytest.raises((CannotGround, CannotReadDirection)):
        read(scene, question)


def test_an_arrow_at_something_else_is_not_the_movers() -> None:
    image = ball(ball(floor(), (120, 80), 35, RED), (200, 300), 40, BLUE)
    scene = Scene(jpeg(DrawnArrow((205, 300), 0.0, 120, 5, (30, 160, 30), "filled").on(image)))
    told = refusal(CannotReadDirection, scene, "If the red ball moves along the arrow, will it hit the blue ball?")
    assert "stands elsewhere" in told


def test_two_arrows_that_could_both_be_meant_are_refused() -> None:
    scene = ball(floor(), (300, 200), 40, ORANGE)
    for start, angle in (((355, 200), 0.0), ((245, 200), 3.1)):
        scene = DrawnArrow(start, angle, 100, 5, (20, 60, 200), "filled").on(scene)
    told = refusal(CannotReadDirection, Scene(jpeg(scene)), "If the orange ball moves along the arrow, what happens?")
    assert "2 were found" in told
