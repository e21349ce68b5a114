"""Paraphrases ask what plain questions ask; what would change the meaning is still not understood."""

from __future__ import annotations

import pytest

from cow_service.readers.embedded.english.asked import read_asked
from cow_service.readers.embedded.english.questions import parse

MOVES = "If the red ball rolls to the left, "
SAME = """
is there a moment when it blocks our view of the vase? | will it hide the vase?
can we still see the vase? | will the vase stay visible?
will it at some point be standing in front of the vase? | will it pass in front of the vase?
is there anything left for it to crash into? | will it hit anything?
is there any chance that it touches the vase? | will it touch the vase?
would you say that it hits the vase? | will it hit the vase?
is the vase safe? | will the vase not be hit?
will it clear the vase without touching it? | will it miss the vase?
the vase or the cube, which one does it crash into? | which does it hit first, the vase or the cube?
does it fall off the edge of the table? | will it land on the floor?
does it stay on the table? | will it not land on the floor?
does it stay on top of the vase? | will it not fall off the vase?
does it make any difference to what it hits? | does the outcome change?
"""
OTHER = """
does it hit exactly one mug?
is there no chance that it hits the vase?
is there a moment when it doesn't hide the vase?
will it almost hit the vase?
will it be in front of the vase or behind it?
will it roll over the edge of the vase?
does it avoid clearing the vase?
"""


@pytest.mark.parametrize("pair", SAME.strip().splitlines())
def test_a_paraphrase_asks_the_same(pair: str) -> None:
    said, plain = (read_asked(parse(MOVES + question)) for question in pair.split(" | "))
    assert plain is not None
    assert said is not None
    assert said.model_copy(update={"partly": plain.partly}) == plain


@pytest.mark.parametrize("question", OTHER.strip().splitlines())
def test_what_would_change_the_meaning_is_not_passed_over(question: str) -> None:
    assert read_asked(parse(MOVES + question)) is None


def test_what_something_falls_off_is_where_it_was() -> None:
    said, plain = (parse(f"If the red ball falls{off}, will it hit the vase?") for off in (" off the shelf", ""))
    assert read_asked(said) == read_asked(plain) is not None
    assert said.motion.kind == plain.motion.kind
