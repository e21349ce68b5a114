"""One question, asked once: what is known of it before, and what every way of asking makes of the replies."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

from cow_service.evals.arms import Arm
from cow_service.evals.imagination import NO_USAGE, Look
from cow_service.evals.items import Item, question_text
from cow_service.evals.observations import Observation
from cow_service.evals.replies import in_data_order, read_as_paper, read_reply, shown_options
from cow_service.readers.options import plain
from cow_service.records import AnswerOption, Usage

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
