"""A row of any data set, checked, and as an item."""

import hashlib
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field

from pydantic import ValidationError

from cow_service.errors import CowError, StorageUnavailable
from cow_service.evals import items
from cow_service.evals.items import Item, Pictures, Task, Truth
from cow_service.readers.options import not_sure_option, option_named
from cow_service.records import AnswerOption

Unread = tuple[str, Callable[[], "Row"]]  # where a row stands (for people), and what reads it, which raises `RowFault`
MAX_SHOWN = 20  # faults in an error
_TASKS: dict[str, Task] = {"physics": "trajectory", "physical": "trajectory", **{task: task for task in items.TASKS}}


class RowFault(ValueError):
    """Why a row cannot be asked; the message names the value and the fault."""


@dataclass(frozen=True)
class Known:
    """What a data set knows of what really happens, and pictures of it with their moments, s."""

    truth: Truth
    pictures: Sequence[tuple[float, bytes]]


@dataclass(frozen=True)
class Row:
    """What a data set says of one question, before it is checked."""

    id: str
    source_id: str
    image: bytes | None
    question: str
    answer: str
    options: Sequence[str] | None = None  # beside the question; None: it lists them itself
    task: str | None = None
    level: str | None = None
    scene: str | None = None
    truth: Known | None = None


def item_of(place: str, row: Row, pictures: Pictures) -> Item:
    """The item of a row; its pictures are kept. Raises `RowFault`."""
    parts, options = wording_of(row)
    image = _picture(row.image, "image", pictures)
    abstain, known = not_sure_option(options), row.truth
    shown = () if known is None else known.pictures
    kept = tuple((time, _picture(data, "picture of what really happens", pictures)) for time, data in shown)
    try:
        return Item(
            id=row.id,
            row=place,
            source_id=row.source_id,
            image=image,
            question=parts,
            options=options,
            answer=_answer(row.answer, options),
            abstain=None if abstain is None else abstain.letter,
            task=task_of(row.task),
            level=row.level or items.UNKNOWN_LEVEL,
            scene=row.scene or image,
            truth=None if known is None else known.truth.model_copy(update={"pictures": kept}),
        )
    except ValidationError as error:
        first = error.errors()[0]
        raise RowFault(f"`{'.'.join(map(str, first['loc']))}` cannot be used: {first['msg']}") from error


def wording_of(row: Row) -> items.Wording:
    """The question of a row around its options, and these. Raises `RowFault`."""
    if not row.question.strip():
        raise RowFault("`question` is empty")
    if row.options is None:
        wording = items.listed_wording(row.question)
        if wording is None:
            raise RowFault("the question lists no options, such as (A) Yes, (B) No, and the row has none either")
        return wording
    texts = [str(text).strip() for text in row.options]
    different = {text.lower() for text in texts if text}
    if not 2 <= len(texts) == len(different) <= len(items.LETTERS):
        raise RowFault(f"`options` must be 2 to {len(items.LETTERS)} different texts, got {texts}")
    return items.appended_wording(row.question.rstrip(), texts)


def task_of(name: str | None) -> Task:
    """The task that a data set's name means; `other` if it is unknown."""
    known: list[Task] = [_TASKS[word] for word in re.findall(r"[a-z]+", (name or "").lower()) if word in _TASKS]
    return known[0] if known else "other"


def _answer(given: str, options: Sequence[AnswerOption]) -> str:
    """The letter of the right option: given as a letter, as its text, or both."""
    if not given.strip():
        raise RowFault("`answer` is empty")
    said = option_named(options, given)
    if said is None:
        shown = ", ".join(f"({option.letter}) {option.text}" for option in options)
        raise RowFault(f"`answer` is not one of the options: {given[:60]!r}; they are {shown[:200]}")
    return said.letter


def _picture(data: bytes | None, name: str, pictures: Pictures) -> str:
    if not data:
        raise RowFault(f"the {name} is missing")
    try:
        return pictures.add(data)
    except StorageUnavailable:
        raise
    except CowError as error:
        raise RowFault(f"the {name} cannot be used: {error.detail}") from error


@dataclass
class Collected:
    """What a data set holds."""

    items: list[Item] = field(default_factory=list[Item])
    faults: list[str] = field(default_factory=list)  # a row each, with its place: what is left out
    notes: list[str] = field(default_factory=list)  # what was found and worked around


def collect(rows: Iterable[Unread], pictures: Pictures, *, repeated_rows: bool = False) -> Collected:
    """The items of rows. A row twice is a fault, and so is an id, unless `repeated_rows`: then rows are kept."""
    found = Collected()
    asked: dict[tuple[str, str], Item] = {}
    by_id: dict[str, Item] = {}
    for place, read in rows:
        try:
            item = item_of(place, read(), pictures)
        except RowFault as fault:
            found.faults.append(f"{place}: {fault}")
            continue
        key = item.image, items.question_text(item)
        before = asked.get(key)
        if item.id in by_id:
            found.faults.append(f"{place}: the id {item.id!r} stands in {by_id[item.id].row} too")
        elif before is not None and not repeated_rows:
            other = "" if before.answer == item.answer else f" with another answer, ({before.answer})"
            found.faults.append(f"{place}: asks the same as {before.row}{other}")
        else:
            asked.setdefault(key, item)
            by_id[item.id] = item
            found.items.append(item)
    if repeated_rows and len(asked) < len(found.items):
        found.notes.append(f"{len(found.items) - len(asked)} rows ask the same of the same picture as another row.")
    return found


def digest_of(asked: Iterable[Item]) -> str:
    """Of all that is asked, pictures and truth included, wherever it came from."""
    parts = sorted(item.model_dump_json(exclude={"row"}) for item in asked)
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()
