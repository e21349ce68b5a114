"""Options and answers without a model: what a question offers, what the world decides, and the form of the reply."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence

import pytest
from conftest import EXAMPLES, example
from drawn import ball, block, floor, png_bytes
from outcomes import AT, CHOICES, COUNT, FIRST, HIT, NO, WHEN, YES, outcome, simulated
from refusals import refused
from sdk import SIMULATION

from cow_service.narration.words import phrases_of
from cow_service.readers.base import AnswerReading
from cow_service.readers.embedded.answers import answer_from, choose_option
from cow_service.readers.embedded.english.questions import parse
from cow_service.readers.options import (
    Reply,
    choices_source,
    not_sure_option,
    option_saying,
    read_choices,
    reply_text,
    says_not_sure,
)
from cow_service.records import Answer, AnswerOption, Asked, Outcome, Simulation
from cow_service.requests import AnswerRequest, OptionRequest
from cow_service.service import Service

YES_NO = read_choices("Will it? (A) Yes (B) No (C) Not sure", None)
EN = phrases_of("en")


# What a question offers


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
        ("?", [OptionRequest(letter="C", text="It  hits"), OptionRequest(letter="D", text="No")],
         [("C", "It hits"), ("D", "No")]),
    ],
)  # fmt: skip
def test_choices(question: str, given: list[str | AnswerOption] | None, expected: list[tuple[str, str]]) -> None:
    assert [(option.letter, option.text) for option in read_choices(question, given)] == expected


def test_texts_that_say_not_sure_and_where_options_stand() -> None:
    for text in ("Not sure", "I am not quite sure", "Cannot be determined", "can't tell", "Unknown"):
        assert says_not_sure(text)
    for text in ("No", "It surely does", "It cannot reach it", "Certainly"):
        assert not says_not_sure(text)
    assert [option_saying(YES_NO, text) for text in (" yes. ", "maybe", "")] == [YES_NO[0], None, None]
    assert not_sure_option(YES_NO) == YES_NO[2]
    sources = {"(A) Yes (B) No": "question-letters", "Options: yes or no": "question-list", "Yes or no?": "none"}
    assert {tail: choices_source(f"Will it? {tail}", None) for tail in sources} == sources
    assert choices_source("Will it? (A) Yes (B) No", ["Yes", "No"]) == "request"
    two = read_choices("", ["Yes", "Unknown", "Not sure"])
    assert not_sure_option(two) == two[1]


# What the world decides


def chosen(world: Outcome, options: Sequence[AnswerOption]) -> AnswerReading:
    return choose_option(options, world, simulated(world).narration, EN)


@pytest.mark.parametrize(("world", "options", "answer"), CHOICES)
def test_the_option_that_says_what_the_world_says(world: Outcome, options: list[str], answer: str | None) -> None:
    reading = chosen(world, read_choices("?", options))
    assert (reading.answer, reading.not_sure) == (answer, answer is None)
    unsure = chosen(world, read_choices("?", [*options, "Not sure"]))
    assert unsure.not_sure == (answer is None)
    assert unsure.answer == (answer or "ABCDEF"[len(options)] if "Not sure" not in options else unsure.answer)


def test_an_open_question_is_answered_in_words() -> None:
    for world, said in (
        (YES, "Yes"),
        (NO, "No"),
        (outcome(FIRST, first="red cube"), "red cube"),
        (outcome(FIRST), "Nothing"),
        (AT, "After about 1.1 s"),
        (outcome(WHEN, 0.04, time=0.9), "Never"),
        (outcome(COUNT, count=2), "2"),
    ):
        assert chosen(world, ()) == AnswerReading(said, False, simulated(world).narration.summary)
        unsure = world.model_copy(update={"sure": False})
        why = simulated(unsure).narration.summary
        assert chosen(unsure, ()) == AnswerReading(None, True, why)
        assert chosen(unsure, YES_NO) == AnswerReading("C", True, why)


def test_what_no_world_can_tell_is_said_so() -> None:
    """Each cause has its own words, and no answer."""

    def why(asked: Asked | None, simulation: Simulation | None) -> str:
        reading = answer_from(YES_NO, asked, simulation, EN)
        assert (reading.answer, reading.not_sure) == ("C", True)
        return reading.reasoning

    untold = outcome(HIT, probability=None, sure=False)
    causes = [
        why(None, simulated(YES)),
        why(HIT, None),
        why(HIT, Simulation.model_validate(SIMULATION)),
        why(HIT, simulated(untold, encounters_known=False)),
        why(HIT, simulated(untold, ensemble=0)),
    ]
    assert len(set(causes)) == len(causes)
    among = parse("If the ball rolls left, will it hit the red cube or the blue mug first?").alternatives
    other = answer_from((), FIRST, simulated(outcome(FIRST, first="green cone")), EN, among)
    assert (other.answer, other.not_sure) == (None, True)
    assert "green cone" in other.reasoning
    assert answer_from((), FIRST, simulated(outcome(FIRST, first="blue mug")), EN, among).answer == "blue mug"


# The form of the reply

LETTER = Reply("A", "Yes", "The ball meets the mug.", "question-letters")
LISTED = Reply("A", "Yes", "The ball meets the mug.", "question-list")
OPEN = Reply("After 1.1 s", None, "The ball meets the mug.", "none")
ASKED = "If the ball rolls left, will it hit the mug?"
PAPER = "Write your response into this json template: {'Reasoning': '<your reasons>', 'Answer': '<Your answer>'}"
ONLY = "The entire content of your response should be of the following format: 'ANSWER: $LETTER' (without quotes)"
LAST = "The last line of your response should be of the following format: 'ANSWER: $LETTER' (without quotes)"


@pytest.mark.parametrize(
    ("prompt", "reply", "said"),
    [
        (f"{ASKED} (A) Yes (B) No", LETTER, "A"),
        (f"{ASKED} (A) Yes (B) No\nAnswer with the option's letter from the given choices directly.", LETTER, "A"),
        (f"Answer the question. {ONLY} where LETTER is one of A,B.\n\n{ASKED}\n\nA) Yes\nB) No", LETTER, "ANSWER: A"),
        (f"{ASKED}\nA) Yes\nB) No\n{LAST}", LETTER, "The ball meets the mug.\n\nANSWER: A"),
        (f"{ASKED} (A) Yes (B) No. End: 'Final answer: <letter>'.", LETTER, f"{LETTER.reasoning}\n\nFinal answer: A"),
        (f"{ASKED} A. Yes B. No\nAnswer the question using a single word or phrase.", LETTER, "Yes"),
        (f"{ASKED} (A) Yes (B) No. Give the full text of the answer.", LETTER, "Yes"),
        (f"{ASKED} Choose between the following options: Yes or No", LISTED, "Yes"),
        (ASKED, OPEN, "After 1.1 s"),
        (f"{ASKED} Describe the set {{A, B}} in json.", LETTER, "A"),
    ],
)  # fmt: skip
def test_the_form_that_is_asked_for(prompt: str, reply: Reply, said: str) -> None:
    assert reply_text(prompt, reply) == said


@pytest.mark.parametrize(("reply", "answer"), [(LETTER, "A"), (LISTED, "Yes"), (OPEN, "After 1.1 s")])
def test_a_json_template_is_filled(reply: Reply, answer: str) -> None:
    told = json.loads(reply_text(f"{ASKED} (A) Yes, (B) No\n\n{PAPER}", reply))
    assert told == {"Reasoning": "The ball meets the mug.", "Answer": answer}
    template = 'Reply as JSON: {"choice": "<letter>", "confidence": <0-1>, "explanation": "..."}'
    told = json.loads(reply_text(f"{ASKED} {template}", reply))
    assert told == {"choice": answer, "confidence": None, "explanation": "The ball meets the mug."}


# From picture and question to answer


def answered(service: Service, image: bytes, question: str, **body) -> Answer:
    kept = service.keep_image(image)
    request = {"image": {"artifact": kept.sha256}, "question": question, "video": False} | body
    return service.answer(AnswerRequest.model_validate(request))


def test_a_rolling_ball_is_answered_from_its_world(service: Service) -> None:
    image = png_bytes(block(ball(floor(), (150, 200), 40, (200, 30, 30)), (430, 150, 520, 250), (50, 80, 200)))
    question = "If the red ball rolls to the {}, will it hit the blue cube? (A) Yes (B) No (C) Not sure"
    camera = {"pitch": 28}  # it is drawn without perspective, as if from far away
    right = answered(service, image, question.format("right"), votes=3, baseline=True, camera=camera)
    assert (right.answer, right.option, right.not_sure, right.votes) == ("A", "Yes", False, {"A": 3})
    assert len(right.warnings) == 1, "more votes say no more"
    assert right.simulation is not None
    assert right.reasoning == right.simulation.narration.summary
    assert right.baseline is not None
    assert (right.baseline.answer, right.baseline.not_sure) == ("C", True)
    assert right.usage.calls == 0
    left = answered(service, image, question.format("left"), camera=camera)
    assert (left.answer, left.warnings) == ("B", ())
    assert answered(service, image, question.format("right"), imagine="never").not_sure


def test_to_stay_where_it_is_put_is_to_end_there(service: Service) -> None:
    image = block(block(floor(640, 400), (120, 220, 320, 320), (40, 60, 200)), (420, 260, 470, 320), (40, 160, 60))
    question = "If the green cube is put onto the blue block, will it stay there?"
    told = answered(service, png_bytes(image), question, options=["Yes", "No"])
    assert told.simulation is not None
    outcome = told.simulation.trajectory.outcome
    assert outcome is not None
    assert (outcome.asked.relation, outcome.asked.negated) == ("inside", False)
    assert told.answer == "A" or told.not_sure


@pytest.mark.slow
def test_the_examples_are_answered_right(service: Service) -> None:
    folders = sorted(path.parent for path in EXAMPLES.glob("*/meta.json"))
    assert len(folders) >= 5
    for folder in folders:
        meta = json.loads((folder / "meta.json").read_text())
        found = answered(service, (folder / "image.jpg").read_bytes(), meta["question"])
        assert (found.answer, found.not_sure) == (meta["answer"], False), folder.name


def test_nothing_is_sure_of_what_looks_like_something_else(service: Service) -> None:
    called = example("ball-and-mug")
    told = answered(service, called.image, called.meta["question"].replace("mug", "dragon"))
    assert told.not_sure
    assert told.simulation is not None
    outcome = told.simulation.trajectory.outcome
    assert outcome is not None
    assert (outcome.probability or 0) >= 0.9, "the worlds agree: in doubt is whether these are the things meant"
    assert outcome.depends_on[0] == "identity"
    assert re.search("mug.*'dragon'", " ".join(told.warnings))


def test_nothing_meets_itself(service: Service) -> None:
    question = "If the yellow ball moves opposite to the direction of the arrow, will it hit itself?"
    told = answered(service, example("ball-and-mug").image, question)
    assert told.not_sure
    assert told.simulation is not None
    assert len(told.warnings) == 1


def test_a_car_whose_way_is_not_known_is_not_guessed_about(service: Service) -> None:
    scene = example("car-forward")
    told = answered(service, scene.image, scene.meta["question"].replace(" forward", ""))
    assert (told.simulation, told.not_sure) == (None, True)
    assert "cannot-read-direction" in told.warnings[0]


def test_what_is_wrong_with_the_request_is_not_fallen_back_from(service: Service) -> None:
    image = png_bytes(floor())
    with refused("invalid-request"):
        answered(service, image, "Will it move?", generator_options={"nonsense": 1})
    with refused("invalid-request"):
        answered(service, image, "Will it move?", reader="nobody")
