"""What the paper printed, and how its protocol and data differ from what is measured here."""

from __future__ import annotations

from cow_service.evals.items import Task
from cow_service.evals.replies import DIFFERENCES as READING

SOURCE = "CausalSpatial, arXiv 2601.13304"
# Of all questions, in percent.
PRINTED_TPR: dict[str, float] = {
    "GPT-5": 54.17,
    "Gemini 2.5 Pro": 50.55,
    "Qwen3-VL-30B-T": 50.50,
    "human": 84.49,
}
# Of COW with Qwen3-VL-30B-A3B-I over the same model without, in points.
PRINTED_GAINS: dict[Task, float] = {"collision": 2.40, "trajectory": 2.20}
PRINTED_MODEL = "Qwen3-VL-30B-A3B-I with COW"

PROTOCOL = (
    "Options are shown in a random order, another one in every repeat and the same in every arm; the public scripts "
    "show them as the data has them.",
    "The note about frames is worded anew; the question and the JSON template are the paper's.",
    "An answer counts for the option whose text was shown with its letter.",
    "Questions whose call failed count nowhere and are listed; the public scripts score the text of the error.",
    "Intervals and tests are paired by question and drawn by scene; the paper prints means over repeats.",
)
DATA = (
    "The paper's cells do not all follow from the published data (n = 1030; some of its cells have fewer questions, "
    "and its abstain rates fit 958): figures stand beside each other and are not tuned to agree.",
    "The option that abstains is found by its text, not by the column `not_sure`.",
    "Items are told apart by subset, shard and row: ids are not unique.",
)


def differences() -> tuple[tuple[str, tuple[str, ...]], ...]:
    """All of them, by what they are about."""
    return ("Protocol", PROTOCOL), ("Reading replies", READING), ("Data", DATA)
