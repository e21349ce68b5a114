"""Replies in the forms that the prompts of public harnesses ask for."""

from __future__ import annotations

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cow_service.readers.embedded.english.asked import read_asked
from cow_service.readers.embedded.english.questions import parse, without_reply_form
from cow_service.readers.options import Reply, reply_text

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


@pytest.mark.parametrize("form", [ONLY + " where LETTER is one of A,B.", LAST + ".", PAPER, "Think. " + LAST + "."])
def test_what_says_how_to_reply_is_no_part_of_the_question(form: str) -> None:
    for text in (f"{ASKED} {form}", f"{form}\n\n{ASKED}\n\nA) Yes\nB) No"):
        assert read_asked(parse(text)) == read_asked(parse(ASKED)) is not None
        assert parse(text).interventions == ()
        assert parse(text).motion == parse(ASKED).motion
    assert without_reply_form("If your answer is read aloud, will it fall?").endswith("fall?")
    assert without_reply_form("It goes 0.5 m... Give your answer as JSON.") == "It goes 0.5 m... "


@given(st.text(max_size=300))
def test_no_text_breaks_it(text: str) -> None:
    assert without_reply_form(text) == text or "your" in text or "json" in text.lower() or "$" in text
    assert reply_text(text, OPEN)


@pytest.mark.parametrize(("reply", "answer"), [(LETTER, "A"), (LISTED, "Yes"), (OPEN, "After 1.1 s")])
def test_a_json_template_is_filled(reply: Reply, answer: str) -> None:
    told = json.loads(reply_text(f"{ASKED} (A) Yes, (B) No\n\n{PAPER}", reply))
    assert told == {"Reasoning": "The ball meets the mug.", "Answer": answer}
    template = 'Reply as JSON: {"choice": "<letter>", "confidence": <0-1>, "explanation": "..."}'
    told = json.loads(reply_text(f"{ASKED} {template}", reply))
    assert told == {"choice": answer, "confidence": None, "explanation": "The ball meets the mug."}
