"""Which option a reply chooses: as this service reads replies, and as the paper's public scripts do."""

from __future__ import annotations

import ast
import hashlib
import random
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import permutations
from typing import Any, Protocol

from cow_service.evals.imagination import NO_USAGE, Arm, Look
from cow_service.evals.items import Item, Observation, question_text
from cow_service.readers.mllm.answer import read_answer
from cow_service.readers.mllm.replies import ReplyError
from cow_service.readers.options import plain
from cow_service.records import AnswerOption, Usage

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


BETWEEN_REPLIES = "\n\n"
_YES, _NO = ("yes", "true"), ("no", "false")


@dataclass(frozen=True)
class Case:
    """An item in one arm and one repeat, with its options in the order in which they are shown."""

    item: Item
    arm: Arm
    repeat: int
    order: tuple[int, ...]

    @property
    def question(self) -> str:
        """As it is asked."""
        return question_text(self.item, self.order)

    @property
    def options(self) -> tuple[AnswerOption, ...]:
        """As they are shown."""
        return shown_options(self.item, self.order)

    def read(self, reply: str) -> str | None:
        """The letter, in the data's order, that a reply chooses."""
        return in_data_order(self.item, self.order, read_reply(reply, self.options))


@dataclass(frozen=True)
class Reply:
    """A reply of the multimodal LLM, and what it cost."""

    text: str
    usage: Usage = NO_USAGE
    seconds: float = 0.0


@dataclass(frozen=True)
class Asked:
    """What came of a case: its replies, the first of which were given before anything was imagined, and the looks."""

    replies: tuple[Reply, ...]
    looks: tuple[Look, ...] = ()
    before: int = 0  # replies from the image alone that decided whether to imagine
    messages: tuple[Any, ...] = field(default=(), compare=False)  # as they were sent last, for the log


class Asking(Protocol):
    """A way of asking."""

    async def __call__(self, case: Case) -> Asked:
        """Asks. Raises the `CowError` for which there is no reply."""
        ...


def observed(case: Case, asked: Asked) -> Observation:
    """The observation of a case. Of several replies the most frequent answer counts, of equals the first given."""
    item = case.item
    deciding = asked.replies[asked.before :] or asked.replies
    chosen = leading([case.read(reply.text) for reply in deciding])
    look = asked.looks[0] if asked.looks else Look()
    usage = sum((part.usage for part in (*asked.replies, *asked.looks)), NO_USAGE)
    imagining = sum(each.seconds for each in asked.looks)
    refusal = next((each.refusal for each in asked.looks if each.refusal is not None), None)
    return Observation(
        **place_of(case),
        reply=BETWEEN_REPLIES.join(reply.text for reply in asked.replies),
        read=chosen,
        read_as_paper=leading([_as_paper(case, reply.text) for reply in deciding]),
        calls=usage.calls,
        input_tokens=usage.input_tokens,
        output_tokens=usage.output_tokens,
        seconds=imagining + sum(reply.seconds for reply in asked.replies),
        imagining_seconds=imagining,
        imaginations=sum(each.simulated for each in asked.looks),
        refusal=None if refusal is None else refusal.code,
        frames=tuple(digest for each in asked.looks for digest in each.frames),
        overlay=look.overlay,
        probability=look.probability,
        happens=happens(item),
    )


def place_of(case: Case) -> dict[str, Any]:
    """The fields of an observation that do not depend on what came of it."""
    item = case.item
    return {
        "item": item.id,
        "task": item.task,
        "level": item.level,
        "scene": item.scene,
        "arm": case.arm.name,
        "repeat": case.repeat,
        "options": tuple(item.options[place].letter for place in case.order),
        "truth": item.answer,
        "abstain": item.abstain,
    }


def leading(letters: Sequence[str | None]) -> str | None:
    """The most frequent of the letters, of equals the first; None where none could be read."""
    counts = Counter(letter for letter in letters if letter is not None)
    return counts.most_common(1)[0][0] if counts else None


def happens(item: Item) -> bool | None:
    """Whether what is asked happens, by the truth; None where the right option is neither yes nor no."""
    said = plain(next(option.text for option in item.options if option.letter == item.answer)).split()[:1]
    return True if said and said[0] in _YES else False if said and said[0] in _NO else None


def _as_paper(case: Case, text: str) -> str | None:
    return in_data_order(case.item, case.order, read_as_paper(text))
