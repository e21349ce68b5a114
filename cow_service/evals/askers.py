"""The two ways of asking: a multimodal LLM itself through Inspect, or the service's own `/answer`."""

from __future__ import annotations

import base64
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from inspect_ai.model import (
    CachePolicy,
    ChatMessage,
    ChatMessageAssistant,
    ChatMessageUser,
    Content,
    ContentImage,
    ContentText,
    Model,
    ModelOutput,
)

from cow_service.client import AsyncAnswer, AsyncClient
from cow_service.client.errors import error_from
from cow_service.errors import MllmUnavailable
from cow_service.evals.asking import Case, CaseReplies, Reply
from cow_service.evals.imagination import REFUSALS, Evidence, Imagination, asked_once, evidence_of
from cow_service.evals.items import Pictures
from cow_service.media.artifacts import media_type_of
from cow_service.readers.prompts import load_prompt
from cow_service.records import Usage, Verdict
from cow_service.stages.answering import gate_of
from cow_service.stages.keys import FirstAnswers

GATE_VOTES = 3
GATE_THRESHOLD = 1.0
PROMPT = "eval-question"
OVERLAY = "Not sent to the model: the overlay of the simulation that the frames are of."


@dataclass(frozen=True)
class PromptAsker:
    """Asks a model. Every reply is kept as soon as it has come, and never asked for again in the same run."""

    model: Model
    imagination: Imagination
    pictures: Pictures
    key: str  # of the run: replies of other runs are not taken

    async def __call__(self, case: Case) -> CaseReplies:
        """Imagines where the arm says so, and asks. Raises `MllmUnavailable`, and what a simulation failed with."""
        first: tuple[Reply, ...] = ()
        if case.arm.gated:
            alone = self._messages(case, Evidence())
            first = tuple([await self._ask(case, alone, f"first {vote}") for vote in range(GATE_VOTES)])
            if not _wants_more(case, first):
                return CaseReplies(first)
        trials = range(case.arm.tries)
        evidence = tuple([await self.imagination.evidence(case.item, case.arm.shown, trial) for trial in trials])
        replies: list[Reply] = []
        messages: list[ChatMessage] = []
        for trial, found in enumerate(evidence):
            messages = self._messages(case, found)
            replies.append(await self._ask(case, messages, f"look {trial}"))
        return CaseReplies((*first, *replies), evidence, len(first), tuple(messages))

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

    def _messages(self, case: Case, evidence: Evidence) -> list[ChatMessage]:
        """One message: pictures, then the question."""
        with_image = case.arm.with_image or not evidence.frames
        shown = "image-and-facts" if evidence.facts else "nothing"
        if evidence.frames:
            shown = "image-and-frames" if with_image else "frames"
        text = load_prompt(PROMPT).render(question=case.question, shown=shown, facts=evidence.facts)
        digests = (*((case.item.image,) if with_image else ()), *evidence.frames)
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


@dataclass(frozen=True)
class AnswerAsker:
    """Asks a server. The same run never asks the same twice: requests have idempotency keys."""

    client: AsyncClient
    pictures: Pictures
    options: Mapping[str, Any]  # fields of the requests
    key: str  # of the run

    async def __call__(self, case: Case) -> CaseReplies:
        """Asks, once per try of the arm."""
        imagine = "never" if case.arm.shown == "nothing" else "auto" if case.arm.gated else "always"
        asked = [await self._ask(case, imagine, trial) for trial in range(case.arm.tries)]
        return CaseReplies(tuple(reply for reply, _ in asked), tuple(found for _, found in asked))

    async def _ask(self, case: Case, imagine: Literal["always", "auto", "never"], trial: int) -> tuple[Reply, Evidence]:
        options: Any = {**self.options, **({"seed": trial} if trial else {})}
        image = self.pictures.path(case.item.image)

        async def ask(key: str) -> AsyncAnswer:
            return await self.client.answer(image, case.question, idempotency_key=key, imagine=imagine, **options)

        parts = (self.key, case.item.id, case.arm.name, str(case.repeat), str(trial), str(sorted(options.items())))
        answer = await asked_once(ask, *parts)
        found = Evidence()
        if answer.simulation_problem is not None:
            problem = error_from(answer.simulation_problem.model_dump())
            if not isinstance(problem, REFUSALS):
                raise problem
            found = Evidence(refusal=problem)
        elif answer.simulation is not None:
            found = await evidence_of(answer.simulation, self.client, self.pictures)
        # Usage and stages are of everything together: what is not of the simulation stands with the reply.
        seconds = max(0.0, sum(answer.timings.values()) - found.seconds)
        return Reply(_text(answer), answer.usage_total, seconds), found


def _text(answer: AsyncAnswer) -> str:
    """The answer as a reply that `replies` reads: in the form that the paper's prompt asks for."""
    said = answer.answer or ("Not sure" if answer.not_sure else "")
    reasons = answer.reasoning.replace("'", "\u2019")
    return f"{{'Reasoning': '{reasons}', 'Answer': '{said}'}}"


def message(digests: Iterable[str], text: str, pictures: Pictures) -> ChatMessageUser:
    """Pictures, then a text."""
    content: list[Content] = [*(_picture(digest, pictures) for digest in digests), ContentText(text=text)]
    return ChatMessageUser(content=content)


def conversation(case: Case, asked: CaseReplies, overlay: str | None, pictures: Pictures) -> list[ChatMessage]:
    """What a viewer shows: what was asked last, every reply, and in the first repeat the overlay.

    What `/answer` sends by itself is not known here: in its place stand the image, the frames and the question.
    """
    frames = [digest for found in asked.evidence for digest in found.frames]
    sent: tuple[ChatMessage, ...] = asked.messages or (message((case.item.image, *frames), case.question, pictures),)
    shown: list[ChatMessage] = [*sent, *(ChatMessageAssistant(content=reply.text) for reply in asked.replies)]
    if overlay is not None and case.repeat == 1:
        shown.append(message((overlay,), OVERLAY, pictures))
    return shown


def _picture(digest: str, pictures: Pictures) -> ContentImage:
    data = pictures.read(digest)
    return ContentImage(image=f"data:{media_type_of(data)};base64,{base64.b64encode(data).decode()}")
