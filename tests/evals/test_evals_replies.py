"""Which option a reply chooses, by our rules and by those of the paper's public script, each difference as it is."""

from __future__ import annotations

import tomllib

import pytest
from conftest import ROOT

from cow_service.records import AnswerOption

OPTIONS = tuple(
    AnswerOption(letter=letter, text=text) for letter, text in zip("ABC", ("Yes", "No", "Not sure"), strict=True)
)
pytestmark = pytest.mark.slow  # what reads replies takes seconds to import
SAME: dict[str, str | None] = {
    "{'Reasoning': 'It rolls on.', 'Answer': 'A'}": "A",
    "{'Reasoning': 'It rolls on.', 'Answer': '(B)'}": "B",
    '```json\n{"Reasoning": "It stops.", "Answer": "(A) Yes"}\n```': "A",
    '{"reasoning": "x", "answer": "a"}': "A",
    "Reasoning: it misses.\nAnswer: B": "B",
    "": None,
}
# Reply: ours, the paper's.
DIFFERENT: dict[str, tuple[str | None, str | None]] = {
    "{'Reasoning': 'It rolls on.', 'Answer': 'Yes'}": ("A", "Y"),
    "{'Reasoning': 'Hidden.', 'Answer': 'Not sure.'}": ("C", "E"),
    "{'Reasoning': 'Hidden.', 'Answer': 'Not sure'}": ("C", "N"),
    "{'Reasoning': 'x', 'Answer': '(A)'}\n{'Reasoning': 'y', 'Answer': '(B)'}": (None, "B"),
    "{'Reasoning': 'It rolls on.', 'Answer': '(D)'}": (None, "D"),
    "B": ("B", None),
    "(B) No": ("B", None),
    "I cannot help with that.": (None, None),
    "Error: timeout. Answer: none.": (None, "E"),
}


@pytest.mark.parametrize("reply", [*SAME, *DIFFERENT])
def test_replies_are_read_by_both_rules(reply: str) -> None:
    from cow_service.evals.asking import Case, read_as_paper
    from cow_service.evals.design import Arm
    from cow_service.evals.items import Item

    item = Item.model_construct(options=OPTIONS)
    wanted = DIFFERENT[reply] if reply in DIFFERENT else (SAME[reply], SAME[reply])
    assert (Case(item, Arm(), 0, (0, 1, 2)).read(reply), read_as_paper(reply)) == wanted


def test_the_extra_has_the_packages_of_the_reader_that_reads_replies() -> None:
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    assert "cow-service[providers]" in extras["evals"]
