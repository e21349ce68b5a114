"""Asks a multimodal LLM itself, through Inspect, with the paper's prompt and pictures beside the question."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

from inspect_ai.model import CachePolicy, ChatMessage, Model, ModelOutput

from cow_service.errors import MllmUnavailable
from cow_service.evals.asking import Asked, Case, Reply
from cow_service.evals.conversation import message
from cow_service.evals.imagination import Imagination, Look
from cow_service.evals.pictures import Pictures
from cow_service.readers.prompts import load_prompt
from cow_service.records import Usage, Verdict
from cow_service.stages.answering import gate_of
from cow_service.stages.keys import FirstAnswers

GATE_VOTES = 3
GATE_THRESHOLD = 1.0
PROMPT = "eval-question"


@dataclass(frozen=True)
class ByPrompt:
    """Asks a model. Every reply is kept as soon as it has come, and never asked for again in the same run."""

    model: Model
    imagination: Imagination
    pictures: Pictures
    key: str  # of the run: replies of other runs are not taken

    async def __call__(self, case: Case) -> Asked:
        """Imagines where the arm says so, and asks. Raises `MllmUnavailable`, and what a simulation failed with."""
        first = await self._first(case) if case.arm.gated else ()
        if first and not _wants_more(case, first):
            return Asked(first)
        trials = range(case.arm.tries)
        looks = tuple([await self.imagination.look(case.item, case.arm.shown, trial) for trial in trials])
        replies: list[Reply] = []
        messages: list[ChatMessage] = []
        for trial, look in enumerate(looks):
            messages = self._messages(case, look)
            replies.append(await self._ask(case, messages, f"look {trial}"))
        return Asked((*first, *replies), looks, len(first), tuple(messages))

    async def _first(self, case: Case) -> tuple[Reply, ...]:
        """The answers from the image alone."""
        messages = self._messages(case, Look())
        return tuple([await self._ask(case, messages, f"first {vote}") for vote in range(GATE_VOTES)])

    async def _ask(self, case: Case, messages: list[ChatMessage], purpose: str) -> Reply:
        # The repeat is part of the key by itself: it is Inspect's epoch.
        scopes = {"run": self.key, "arm": case.arm.name, "item": case.item.id, "purpose": purpose}
        try:
            output = await self.model.generate(messages, cache=CachePolicy(expiry=None, scopes=scopes))
        except Exception as error:
            # Providers raise what they like; Inspect has tried again where that may help.
            told = getattr(error, "provider_message", None) or str(error)
            raise MllmUnavailable(f"{self.model} gave no reply: {told}") from error
        return Reply(output.completion, _usage(output), output.time or 0.0)

    def _messages(self, case: Case, look: Look) -> list[ChatMessage]:
        """One message: pictures, then the question."""
        with_image = case.arm.with_image or not look.frames
        shown = "image-and-facts" if look.facts else "nothing"
        if look.frames:
            shown = "image-and-frames" if with_image else "frames"
        text = load_prompt(PROMPT).render(question=case.question, shown=shown, facts=look.facts)
        digests = (*((case.item.image,) if with_image else ()), *look.frames)
        return [message(digests, text, self.pictures)]


def _wants_more(case: Case, first: Sequence[Reply]) -> bool:
    """Whether to imagine, by the rule of `/answer`."""
    letters = [letter for reply in first if (letter := case.read(reply.text)) is not None]
    votes = dict(Counter(letters).most_common())
    verdict = None
    if letters:
        leader = next(iter(votes))
        verdict = Verdict(answer=leader, not_sure=leader == case.item.abstain, votes=votes)
    return gate_of(FirstAnswers(verdict=verdict, asked=len(first)), GATE_THRESHOLD).imagined


def _usage(output: ModelOutput) -> Usage:
    usage = output.usage
    if usage is None:
        return Usage(calls=1)
    cached = (usage.input_tokens_cache_read or 0) + (usage.input_tokens_cache_write or 0)
    return Usage(calls=1, input_tokens=usage.input_tokens + cached, output_tokens=usage.output_tokens)
