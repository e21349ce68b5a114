"""Which option a reply chooses: as this service reads replies, and as the paper's public scripts do."""

from __future__ import annotations

import ast
import hashlib
import random
import re
from collections.abc import Sequence
from itertools import permutations

from cow_service.evals.items import Item
from cow_service.readers.mllm.answer import read_answer
from cow_service.readers.mllm.replies import ReplyError
from cow_service.records import AnswerOption

# Where the public rules and ours differ, for readers of a report.
DIFFERENCES = (
    "A reply that gives an option's text instead of its letter is read here; the paper's rules take the text's first "
    "character for the letter.",
    "The paper's rules look for a letter before a full stop anywhere in the answer: the text 'Not sure.' is E to them.",
    "A reply that gives two different answers is unreadable here; the paper's rules take the last one.",
    "A letter that no option has is unreadable here, a column of its own; to the paper's rules it is a wrong answer.",
    "A reply without an announced answer, such as the letter alone, is read here; the paper's rules find none.",
)
# What stands behind the word "answer" and a colon, up to the next quotation mark.
_ANNOUNCED = re.compile(r"""["']?[Aa]nswer["']?\s*:\s*["']?([^"']+)""")
MOST_LISTED = 5  # options, of which all orders are listed
_PAPER_FORMS = tuple(map(re.compile, (r"\(([a-j])\)", r"^([a-j])$", r"([a-j])\.", r"^([a-j])\)")))


def order_of(item: Item, seed: int, repeat: int) -> tuple[int, ...]:
    """The order in which the options are shown: the same in every arm, and another one in every repeat.

    Up to five options go through all their orders before one comes again.
    """
    places = range(len(item.options))
    if len(places) > MOST_LISTED:
        return tuple(_draws(seed, item.id, str(repeat)).sample(places, len(places)))
    orders = list(permutations(places))
    _draws(seed, item.id).shuffle(orders)
    return orders[(repeat - 1) % len(orders)]


def _draws(*parts: object) -> random.Random:
    digest = hashlib.sha256("\n".join(map(str, parts)).encode()).digest()
    return random.Random(int.from_bytes(digest, "big"))


def shown_options(item: Item, order: Sequence[int]) -> tuple[AnswerOption, ...]:
    """The options as the question shows them: the letters stay in their places, the texts change theirs."""
    return tuple(
        AnswerOption(letter=option.letter, text=item.options[place].text)
        for option, place in zip(item.options, order, strict=True)
    )


def in_data_order(item: Item, order: Sequence[int], letter: str | None) -> str | None:
    """The letter, in the data's order, of the option that is shown with a letter; None where none is."""
    places = {option.letter: place for option, place in zip(item.options, order, strict=True)}
    return item.options[places[letter]].letter if letter in places else None


def read_reply(reply: str, options: Sequence[AnswerOption]) -> str | None:
    """The letter of the shown option that a reply chooses; None where it chooses none, or several."""
    try:
        return read_answer(reply, options).answer
    except ReplyError:
        return None


def read_as_paper(reply: str) -> str | None:
    """The letter that the rules of the paper's public scoring script read in a reply; None where they find none.

    The last announced answer counts: a letter in brackets anywhere in it, else a lone letter, else a letter before a
    full stop, else its first character where that is a letter.
    """
    found = _ANNOUNCED.findall(reply)
    said = found[-1] if found else _literal_answer(reply)
    if said is None:
        return None
    text = said.strip().lower()
    letters = (match[1] for form in _PAPER_FORMS if (match := form.search(text)))
    first = text[0] if text[:1].isalpha() else None
    letter = next(letters, first)
    return None if letter is None else letter.upper()


def _literal_answer(reply: str) -> str | None:
    """What a Python literal between the outer braces says under `Answer`."""
    try:
        value = ast.literal_eval(reply[reply.find("{") : reply.rfind("}") + 1])
        return str(value["Answer"])
    except (ValueError, SyntaxError, TypeError, KeyError, MemoryError, RecursionError):
        return None
