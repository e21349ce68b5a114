"""What is asked: an item is one question on one image, with its options and its truth."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from cow_service.records import AnswerOption, Record
from cow_service.records.base import Sha256

Task = Literal["collision", "trajectory", "compatibility", "occlusion", "other"]
TASKS: tuple[Task, ...] = ("collision", "trajectory", "compatibility", "occlusion", "other")
REAL = "real"  # the level of photographs
UNKNOWN_LEVEL = "?"


class Item(Record):
    """One question of a data set. It holds no pixels: pictures are files that are named by their digest."""

    id: str = Field(description="Unique in the data set, whatever the ids of its rows are.")
    row: str = Field(description="Where it stands in the data, for people: file and row.")
    source_id: str = Field(description="As the data names it; need not be unique.")
    image: Sha256
    question: tuple[str, ...] = Field(
        description="The text around the options, one part more than there are options: `question_text` puts an option "
        "between two parts. The only part of an open question is the question."
    )
    options: tuple[AnswerOption, ...] = Field(description="In the data's order.")
    answer: str = Field(description="Letter of the right option, in the data's order.")
    abstain: str | None = Field(description="Letter of the option that says that it is not sure, found by its text.")
    task: Task
    level: str = Field(description="L1, L2, ..., `real` for photographs, `?` where the data does not say.")
    scene: str = Field(description="Items of one scene are not independent: statistics draw whole scenes.")
    oracle: tuple[Sha256, ...] = Field(default=(), description="Pictures of what really happens, in order.")


def question_text(item: Item, order: tuple[int, ...] | None = None) -> str:
    """The question with its options. `order` says which option, counted from 0, stands at each place."""
    places = range(len(item.options)) if order is None else order
    between = [item.options[place].text for place in places]
    return item.question[0] + "".join(option + part for option, part in zip(between, item.question[1:], strict=True))


def letters(item: Item) -> tuple[str, ...]:
    """The letters that stand in the question, in their order."""
    return tuple(option.letter for option in item.options)
