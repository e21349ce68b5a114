"""One question, asked once: the order of its options, the model asked, its reply, and the observation made of it.

There are two ways to ask: a multimodal LLM itself through Inspect, or the service's own `/answer`.
"""

import ast
import base64
import hashlib
import random
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import permutations
from typing import Any, Literal

from inspect_ai import model as inspect_model

from cow_service.adaptive import AdaptivePlaces
from cow_service.client import AsyncClient, errors
from cow_service.errors import MllmUnavailable
from cow_service.evals.design import GATE_VOTES, Arm, Order
from cow_service.evals.imagination import NO_USAGE, REFUSALS, Evidence, Imagination, asked_once, evidence_of, kept
from cow_service.evals.items import Item, Observation, Pictures, question_text
from cow_service.media.artifacts import media_type_of
from cow_service.readers.mllm.answer import read_answer
from cow_service.readers.mllm.replies import ReplyError
from cow_service.readers.options import plain
from cow_service.readers.prompts import load_prompt
from cow_service.records import AnswerOption, Usage, Verdict
from cow_service.stages import answering, keys

GATE_THRESHOLD = 1.0
PROMPT = "eval-question"
OVERLAY = "Not sent to the model: the overlay of the simulation behind the frames."
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
BETWEEN_REPLIES = "\n\n"
MOST_LISTED = 5  # options; up to so many, all orders are listed
_PAPER_FORMS = tuple(map(re.compile, (r"\(([a-j])\)", r"^([a-j])$", r"([a-j])\.", r"^([a-j])\)")))


def order_of(item: Item, order: Order, seed: int, repeat: int) -> tuple[int, ...]:
    """The order in which the options are shown: as the data has them, or shuffled.

    Shuffled it is the same in every arm, and another one in every repeat. Up to five options go through all their
    orders before one comes again.
    """
    places = range(len(item.options))
    if order == "data":
        return tuple(places)
    if len(places) > MOST_LISTED:
        return tuple(_draws(seed, item.id, str(repeat)).sample(places, len(places)))
    orders = list(permutations(places))
    _draws(seed, item.id).shuffle(orders)
    return orders[(repeat - 1) % len(orders)]


def _draws(*parts: object) -> random.Random:
    digest = hashlib.sha256("\n".join(map(str, parts)).encode()).digest()
    return random.Random(int.from_bytes(digest, "big"))


def read_as_paper(reply: str) -> str | None:
    """The letter that the rules of the paper's public scoring script read in a reply; None if they find none.

    The last announced answer counts: a letter in brackets anywhere in it, else a lone letter, else a letter before a
    full stop, else its first character where that is a letter.
    """
    found = _ANNOUNCED.findall(reply)
    try:  # else what a Python literal between the outer braces says
        literal = None if found else ast.literal_eval(reply[reply.find("{") : reply.rfind("}") + 1])
        said = found[-1] if literal is None else str(literal["Answer"])
    except (ValueError, SyntaxError, TypeError, KeyError, MemoryError, RecursionError, IndexError):
        return None
    text = said.strip().lower()
    letters = (match[1] for form in _PAPER_FORMS if (match := form.search(text)))
    first = text[0] if text[:1].isalpha() else None
    letter = next(letters, first)
    return None if letter is None else letter.upper()


@dataclass(frozen=True)
class Case:
    """An item in one arm and one repeat, with its options in the order in which they are shown."""

    item: Item
    arm: Arm
    repeat: int
    order: tuple[int, ...]

    @property
    def question(self) -> str:
        """The text of the question."""
        return question_text(self.item, self.order)

    @property
    def options(self) -> tuple[AnswerOption, ...]:
        """As they are shown: the letters stay in their places, the texts change theirs."""
        return tuple(
            AnswerOption(letter=option.letter, text=self.item.options[place].text)
            for option, place in zip(self.item.options, self.order, strict=True)
        )

    def read(self, reply: str) -> str | None:
        """The letter, in the data's order, that a reply chooses; None if it chooses none, or several."""
        try:
            return self._in_data_order(read_answer(reply, self.options).answer)
        except ReplyError:
            return None

    def read_as_paper(self, reply: str) -> str | None:
        """The same by the rules of the paper's public scripts."""
        return self._in_data_order(read_as_paper(reply))

    def _in_data_order(self, letter: str | None) -> str | None:
        places = {option.letter: place for option, place in zip(self.item.options, self.order, strict=True)}
        return self.item.options[places[letter]].letter if letter in places else None


@dataclass(frozen=True)
class Reply:
    """A reply of the multimodal LLM, and what it cost."""

    text: str
    usage: Usage = NO_USAGE
    seconds: float = 0.0
    model: str | None = None  # as its provider names what replied


@dataclass(frozen=True)
class CaseReplies:
    """The replies to a case, first those given before anything was imagined, and what was shown."""

    replies: tuple[Reply, ...]
    evidence: tuple[Evidence, ...] = ()
    before: int = 0  # replies from the image alone that decided whether to imagine
    messages: tuple[Any, ...] = field(default=(), compare=False)  # as they were sent last, for the log


def observation_of(case: Case, asked: CaseReplies) -> Observation:
    """The observation of a case. Of several replies the most frequent answer counts, of equals the first given."""
    deciding = asked.replies[asked.before :] or asked.replies
    chosen = leading([case.read(reply.text) for reply in deciding])
    first_shown = asked.evidence[0] if asked.evidence else Evidence()
    usage = sum((part.usage for part in (*asked.replies, *asked.evidence)), NO_USAGE)
    refusal = next((each.refusal for each in asked.evidence if each.refusal is not None), None)
    return Observation(
        **place_of(case),
        reply=BETWEEN_REPLIES.join(reply.text for reply in asked.replies),
        read=chosen,
        read_as_paper=leading([case.read_as_paper(reply.text) for reply in deciding]),
        **usage.model_dump(),
        seconds=sum(part.seconds for part in (*asked.replies, *asked.evidence)),
        imaginations=sum(each.simulated for each in asked.evidence),
        refusal=None if refusal is None else refusal.code,
        frames=tuple(digest for each in asked.evidence for digest in each.frames),
        overlay=first_shown.overlay,
        probability=first_shown.probability,
        event_shown=first_shown.event_shown,
        path_error=first_shown.path_error,
        happens=happens(case.item),
        model=next((reply.model for reply in asked.replies if reply.model is not None), None),
    )


def place_of(case: Case) -> dict[str, Any]:
    """The fields of an observation that do not depend on what came of it."""
    item, shown = case.item, tuple(case.item.options[place].letter for place in case.order)
    asked = {"item": item.id, "arm": case.arm.name, "repeat": case.repeat, "options": shown, "truth": item.answer}
    return asked | item.model_dump(include={"task", "level", "scene", "abstain"})


def leading(letters: Sequence[str | None]) -> str | None:
    """The most frequent of the letters, of equals the first; None if none could be read."""
    counts = Counter(letter for letter in letters if letter is not None)
    return counts.most_common(1)[0][0] if counts else None


def happens(item: Item) -> bool | None:
    """Whether the event happens, by the truth; None if the right option is neither yes nor no."""
    said = plain(next(option.text for option in item.options if option.letter == item.answer))
    return {"yes": True, "true": True, "no": False, "false": False}.get(said.partition(" ")[0])


@dataclass(frozen=True)
class PromptAsker:
    """Asks a model. Every reply is kept as soon as it has come, and never asked for again in the same run."""

    model: inspect_model.Model
    imagination: Imagination
    pictures: Pictures
    key: str  # of the run: replies of other runs are not taken

    async def __call__(self, case: Case) -> CaseReplies:
        """Imagines where the arm says so, and asks. Raises `MllmUnavailable`, and what a simulation failed with."""
        first: tuple[Reply, ...] = ()
        if case.arm.gate:
            alone = self._messages(case, Evidence())
            first = tuple([await self._ask(case, alone, f"first {vote}") for vote in range(GATE_VOTES)])
            letters = [letter for reply in first if (letter := case.read(reply.text)) is not None]
            leader, verdict = leading(letters), None
            if leader is not None:
                votes = dict(Counter(letters).most_common())
                verdict = Verdict(answer=leader, not_sure=leader == case.item.abstain, votes=votes)
            # Whether to imagine is decided by the rule of `/answer`.
            if not answering.gate_of(keys.FirstAnswers(verdict=verdict, asked=len(first)), GATE_THRESHOLD).imagined:
                return CaseReplies(first)
        evidence = tuple(
            [await self.imagination.evidence(case.item, case.arm, trial) for trial in range(case.arm.votes)]
        )
        replies: list[Reply] = []
        messages: list[inspect_model.ChatMessage] = []
        for trial, found in enumerate(evidence):
            messages = self._messages(case, found)
            replies.append(await self._ask(case, messages, f"look {trial}"))
        return CaseReplies((*first, *replies), evidence, len(first), tuple(messages))

    async def _ask(self, case: Case, messages: list[inspect_model.ChatMessage], purpose: str) -> Reply:
        # The repeat is part of the key by itself: it is Inspect's epoch.
        scopes = {"run": self.key, "arm": case.arm.name, "item": case.item.id, "purpose": purpose}
        try:
            output = await self.model.generate(messages, cache=inspect_model.CachePolicy(expiry=None, scopes=scopes))
        except Exception as error:
            # Providers raise what they like; Inspect has tried again where that may help.
            told = getattr(error, "provider_message", None) or str(error)
            raise MllmUnavailable(f"{self.model} gave no reply: {told}") from error
        usage = Usage(calls=1)
        if (used := output.usage) is not None:
            cached = (used.input_tokens_cache_read or 0) + (used.input_tokens_cache_write or 0)
            usage = Usage(calls=1, input_tokens=used.input_tokens + cached, output_tokens=used.output_tokens)
        return Reply(output.completion, usage, output.time or 0.0, output.model or None)

    def _messages(self, case: Case, evidence: Evidence) -> list[inspect_model.ChatMessage]:
        """One message: pictures, then the question."""
        with_image = case.arm.image or not evidence.frames
        shown = "image-and-facts" if evidence.facts else "nothing"
        if evidence.frames:
            shown = "image-and-frames" if with_image else "frames"
        text = load_prompt(PROMPT).render(question=case.question, shown=shown, facts=evidence.facts)
        digests = (*((case.item.image,) if with_image else ()), *evidence.frames)
        return [message(digests, text, self.pictures)]


@dataclass(frozen=True)
class AnswerAsker:
    """Asks a server. The same run never asks the same twice: requests have idempotency keys."""

    client: AsyncClient
    places: AdaptivePlaces  # for its requests
    pictures: Pictures
    options: Mapping[str, Any]  # fields of the requests
    key: str  # of the run

    async def __call__(self, case: Case) -> CaseReplies:
        """Asks, once per vote of the arm."""
        imagine = "never" if case.arm.content == "none" else "auto" if case.arm.gate else "always"
        asked = [await self._ask(case, imagine, trial) for trial in range(case.arm.votes)]
        return CaseReplies(tuple(reply for reply, _ in asked), tuple(found for _, found in asked))

    async def _ask(self, case: Case, imagine: Literal["always", "auto", "never"], trial: int) -> tuple[Reply, Evidence]:
        seed = trial + case.arm.votes * (case.repeat - 1)  # an MLLM that takes seeds must not repeat itself
        options: Any = {**self.options, "frames": case.arm.frames_request, **({"seed": seed} if trial else {})}
        image = self.pictures.path(case.item.image)
        parts = (self.key, case.item.id, case.arm.name, str(case.repeat), str(trial), str(sorted(options.items())))
        answer = await asked_once(
            self.places, parts, self.client.answer, image, case.question, imagine=imagine, **options
        )
        found = Evidence()
        if answer.simulation_problem is not None:
            problem = errors.error_from(answer.simulation_problem.model_dump())
            if not isinstance(problem, REFUSALS):
                raise problem
            found = Evidence(refusal=problem)
        elif answer.simulation is not None:
            found = await kept(evidence_of(answer.simulation), self.client, self.pictures)
        # Usage and stages are of everything together: what is not of the simulation stands with the reply.
        seconds = max(0.0, sum(answer.timings.values()) - found.seconds)
        # In the form that the paper's prompt asks for.
        said = answer.answer or ("Not sure" if answer.not_sure else "")
        reasons = answer.reasoning.replace("'", "\u2019")
        text = f"{{'Reasoning': '{reasons}', 'Answer': '{said}'}}"
        return Reply(text, answer.usage_total, seconds), found


def message(digests: Iterable[str], text: str, pictures: Pictures) -> inspect_model.ChatMessageUser:
    """Pictures, then a text."""
    shown = map(pictures.read, digests)
    urls = (f"data:{media_type_of(data)};base64,{base64.b64encode(data).decode()}" for data in shown)
    content = (inspect_model.ContentImage(image=url) for url in urls)
    return inspect_model.ChatMessageUser(content=[*content, inspect_model.ContentText(text=text)])


def conversation(case: Case, asked: CaseReplies, pictures: Pictures) -> list[inspect_model.ChatMessage]:
    """The content for a viewer: the last question, every reply, and in the first repeat the overlay.

    What `/answer` sends is not known here; the image, the frames and the question stand for it.
    """
    frames = [digest for found in asked.evidence for digest in found.frames]
    shown = list(asked.messages) or [message((case.item.image, *frames), case.question, pictures)]
    shown += [inspect_model.ChatMessageAssistant(content=reply.text) for reply in asked.replies]
    overlay = asked.evidence[0].overlay if asked.evidence else None
    if overlay is not None and case.repeat == 1:
        shown.append(message((overlay,), OVERLAY, pictures))
    return shown
