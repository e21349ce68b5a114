"""Answers without a model: what a question asks for, what decides it, and what `POST /answer` and `cow answer` say."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from conftest import EXAMPLES, all_scenes, example
from drawn import ball, block, floor
from hypothesis import given
from hypothesis import strategies as st

from cow_service.media.images import encode_png
from cow_service.readers.embedded.answers import choose_option
from cow_service.readers.question.choices import not_sure_option, option_saying, read_choices, says_not_sure
from cow_service.readers.question.relations import read_relation
from cow_service.readers.question.sentences import parse
from cow_service.records import Answer
from cow_service.requests import AnswerRequest
from cow_service.service import Service

YES_NO = read_choices("Will it? (A) Yes (B) No (C) Not sure", None)
IF = "If the red ball rolls left, "


@pytest.mark.parametrize(
    ("asked", "relation", "target"),
    [
        ("will it hit the yellow cube?", "touches", "yellow cube"),
        ("will it collide with the green cone?", "touches", "green cone"),
        ("does the ball bump into the vase?", "touches", "vase"),
        ("will the vase be hit by the ball?", "touches", "vase"),
        ("will it land on the cube?", "touches", "cube"),
        ("will it fall on the cube?", "touches", "cube"),
        ("will it make contact with the cube?", "touches", "cube"),
        ("will it hit anything?", "touches", None),
        ("will the red vase be occluded at some moment?", "covers", "red vase"),
        ("will it hide the vase?", "covers", "vase"),
        ("will the ball touch the cube at any point?", "touches", "cube"),
        ("will it come into contact with the cube?", "touches", "cube"),
        ("will it pass in front of the vase?", "covers", "vase"),
        ("will it be hidden behind the blue box?", "covered", "blue box"),
        ("will it disappear behind the blue box?", "covered", "blue box"),
        ("will it pass behind the vase?", "covered", "vase"),
        ("will it be occluded?", "covered", None),
    ],
)
def test_what_is_asked(asked: str, relation: str, target: str | None) -> None:
    told = read_relation(parse(IF + asked))
    assert told is not None
    assert (told.relation, told.target.text if told.target else None) == (relation, target)


@pytest.mark.parametrize(
    "asked",
    [
        "will it not hit the vase?",
        "will it miss the vase?",
        "which object will it hit first?",
        "will it hit the vase before it hits the cube?",
        "will it hit the vase or the cone?",
        "will the vase still be visible?",
        "where will it stop?",
        "will it hit the floor?",
        "will it fall off the table?",
        "will the blue cube hit the vase?",
        "will it turn green?",
        "what happens?",
        "will it fail to hit the vase?",
        "will it almost hit the vase?",
        "is it impossible for it to hit the vase?",
        "will it hit two objects?",
        "will it hit the vase twice?",
        "will it hit anything but the vase?",
        "will it hit the vase and the cube?",
        "will it hit the vase by bouncing off the wall?",
        "will it lose contact with the vase?",
        "will it knock over the vase?",
        "will the vase be hit by the cube?",
        "will the vase be hidden by the cup?",
        "will it hit the cup behind the vase?",
        "will it hit the vase within 2 seconds?",
        "will it be blocked by the vase?",
        "will it completely hide the vase?",
        "is it false that it hits the vase?",
    ],
)
def test_what_is_not_put_plainly_is_left_undecided(asked: str) -> None:
    assert read_relation(parse(IF + asked)) is None


@given(st.text(max_size=80))
def test_no_question_breaks_the_reading(text: str) -> None:
    read_relation(parse(text))
    for option in read_choices(text, None):
        assert option.letter


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


@pytest.mark.parametrize(
    ("options", "happens", "answer", "not_sure"),
    [
        (["Yes", "No", "Not sure"], True, "A", False),
        (["Yes", "No", "Not sure"], False, "B", False),
        (["Yes", "No", "Not sure"], None, "C", True),
        (["No, it misses", "Yes, it hits"], True, "B", False),
        (["Yes", "No"], None, None, True),
        (["the vase", "the mug"], True, None, True),
        (["Yes, at once", "Yes, later", "No"], True, None, True),
        (["Yes", "No", "No idea, not sure"], False, "B", False),
        (None, True, "Yes", False),
        (None, None, None, True),
    ],
)
def test_yes_and_no_as_the_options_word_them(options, happens, answer, not_sure) -> None:
    reading = choose_option(read_choices("?", options), happens)
    assert (reading.answer, reading.not_sure, reading.reasoning) == (answer, not_sure, "")


def answered(service: Service, image: bytes, question: str, **body) -> Answer:
    kept, _ = service.keep_image(image)
    request = {"image": {"artifact": kept.sha256}, "question": question, "video": False} | body
    return service.answer(AnswerRequest.model_validate(request))


def test_the_scenes_are_answered_right_or_not_at_all(service: Service) -> None:
    outcomes: list[str] = []
    for folder in all_scenes():
        meta = json.loads((folder / "meta.json").read_text())
        told = answered(service, (folder / "image.jpg").read_bytes(), meta["question"])
        outcomes.append("not sure" if told.not_sure else "right" if told.answer == meta["answer"] else "wrong")
    assert "wrong" not in outcomes
    assert outcomes.count("right") >= 0.75 * len(outcomes)


def test_a_car_whose_front_is_not_known_is_answered_only_where_both_ends_say_no(service: Service) -> None:
    scene = example("car-forward")
    told = answered(service, scene.image, scene.meta["question"])
    assert told.simulation is None
    assert any("axis" in warning or "Not sure, because" in warning for warning in told.warnings)
    assert "cannot-read-direction" in told.warnings[0]
    assert told.not_sure or told.answer == scene.meta["answer"]


def test_a_ball_thrown_without_a_shadow_is_not_guessed_about(service: Service) -> None:
    image = encode_png(block(ball(floor(), (150, 120), 40, (200, 30, 30)), (430, 200, 520, 300), (50, 80, 200)))
    told = answered(service, image, "If the red ball is thrown to the right, will it hit the blue cube? (A) Yes (B) No")
    assert (told.answer, told.not_sure, told.votes) == (None, True, {"not sure": 1})
    assert told.simulation is not None
    assert any("none was found" in warning for warning in told.warnings)


def test_a_rolling_ball_is_answered_from_its_encounters(service: Service) -> None:
    image = encode_png(block(ball(floor(), (150, 200), 40, (200, 30, 30)), (430, 150, 520, 250), (50, 80, 200)))
    question = "If the red ball rolls to the {}, will it hit the blue cube? (A) Yes (B) No (C) Not sure"
    right = answered(service, image, question.format("right"), votes=3, baseline=True)
    assert (right.answer, right.option, right.not_sure, right.votes) == ("A", "Yes", False, {"A": 3})
    assert right.reasoning == ""
    assert right.warnings == ("The embedded reader gives the same answer every time: more votes say no more.",)
    assert right.baseline is not None
    assert (right.baseline.answer, right.baseline.not_sure) == ("C", True)
    assert right.usage.calls == 0
    assert answered(service, image, question.format("left")).answer == "B"
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
        ({"votes": 0}, "greater than or equal to 1"),
        ({"votes": 33}, "less than or equal to 32"),
        ({"imagine": "maybe"}, "'always' or 'never'"),
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
    from test_cli import cow

    image = str(EXAMPLES / "ball-and-mug" / "image.jpg")
    question = "If the yellow ball moves opposite to the direction of the arrow, will it hit the blue mug?"
    said = cow(tmp_path, "answer", image, question, "--choice", "Yes", "--choice", "No", "--out", "out")
    assert "(A) Yes" in said.stdout
    assert "votes" not in said.stdout
    assert Answer.model_validate_json((tmp_path / "out" / "answer.json").read_text()).answer == "A"
    assert (tmp_path / "out" / "overlay.png").exists()
    said = cow(tmp_path, "answer", image, question, "--no-imagine", "--baseline", "--votes", "2", "--json")
    told = Answer.model_validate_json(said.stdout)
    assert (told.simulation, told.not_sure, told.votes) == (None, True, {"not sure": 2})
    assert sorted(path.name for path in tmp_path.iterdir() if path.is_dir()) == ["data", "out"]
