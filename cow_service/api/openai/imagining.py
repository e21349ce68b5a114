"""The imagination of a chat with an MLLM, and the chat with frames, a placebo, or facts added."""

import base64
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from numpy.typing import NDArray
from pydantic import ValidationError

from cow_service import errors
from cow_service.api.openai.chats import EXTENSION, Chat, ImagePart, images_of, locate_in_chat, other_parts
from cow_service.api.openai.records import WITHOUT, Answerer, ChatImagination
from cow_service.api.problems import invalid
from cow_service.media.artifacts import ArtifactStore
from cow_service.media.images import decode, decode_own, encode_png, fit_within
from cow_service.readers.base import Imagined
from cow_service.readers.chat import ChatReader, adapted
from cow_service.readers.mllm.contents import as_large_as, facts_of, hypothesis, opposite_motion, other_item, pictures
from cow_service.readers.mllm.sheets import AFTER_FIRST, SHEET_NOTE, sheet_of
from cow_service.readers.options import read_choices
from cow_service.readers.prompts import load_prompt
from cow_service.records import Frame, ServerCapabilities, Simulation, Usage
from cow_service.requests import ImageArtifact, MotionRequest, SimulateRequest

NOTE, FACTS_NOTE = "imagined-frames", "imagined-facts"  # names in prompts/
FIELDS_OF_CHAT = ("image", "question")  # of a `SimulateRequest`: from messages
OF_ANSWERS = {  # fields of an `AnswerRequest`, and what does the same for a chat
    "votes": "ask the model of the same name with :vote-3, or with `n`",
    "baseline": "ask the model of the same name with :no-imagination",
    "imagine": "is said by `model`",
    "options": "the MLLM reads them in the messages",
}
NAMED_FRAMES = {"count": 3, "max_side": 512}  # in addition to the policy in a model's name: as in the paper
# The same for another item.
OF_CLIP = ("generator", "generator_options", "num_frames", "fps", "seed", "video", "priority")
# Why something cannot be imagined from a chat that the MLLM may still answer. Other errors are faults of the server, or
# of what the caller told COW itself: those are not passed over, or a figure would be that of another condition.
PASSED_OVER = (
    errors.InvalidRequest, errors.CannotGround, errors.CannotReadDirection, errors.MllmBadReply, errors.ImageTooLarge,
    errors.ImageUnreadable, errors.ImageTypeUnsupported,
)  # fmt: skip


@dataclass(frozen=True)
class EnrichedChat:
    """A chat that is ready to be sent: its messages, with frames or without, and what COW says of it."""

    chat: Chat
    answerer: Answerer
    messages: list[Any]
    cow: ChatImagination

    def adapted(self, reader: ChatReader) -> "EnrichedChat":
        """As the server of that reader takes it; warnings tell what of the chat could not be sent."""
        if reader.upstream is None or (takes := reader.takes) is None:
            return self
        fields, messages, warnings = adapted(self.chat.fields, self.messages, takes)
        cow = self.cow.model_copy(update={"warnings": (*self.cow.warnings, *warnings)})
        return replace(self, chat=replace(self.chat, fields=fields), messages=messages, cow=cow)

    def extension(self, *warnings: str, **others: Any) -> dict[str, Any]:
        """`cow` of the reply."""
        told = {"warnings": (*self.cow.warnings, *warnings), "content": self.answerer.content, **others}
        return self.cow.model_copy(update=told).model_dump(mode="json")


@dataclass
class WhatIf:
    """A what-if question of a chat, and the simulations that were run for it: its own first, then a placebo's."""

    chat: Chat
    answerer: Answerer
    request: SimulateRequest
    message: int  # place of the message whose question it is: frames are added to it
    image: ImagePart
    results: list[Simulation] = field(default_factory=list[Simulation])

    def without(self, error: errors.CowError) -> EnrichedChat:
        """The chat if nothing could be imagined. Raises the error for the caller, if there is one."""
        own = {"/image": self.image.url_pointer, "/question": f"/messages/{self.message}/content"}
        located = locate_in_chat(error, own)
        given = {f"/{EXTENSION}/{name}" for name in self.chat.cow}
        is_own = any("/".join(field.pointer.split("/")[:3]) in given for field in located.errors)
        if is_own or not isinstance(error, PASSED_OVER):
            raise located from error
        spent = sum((each.usage for each in self.results), Usage.model_validate(error.usage or {}))
        return EnrichedChat(
            self.chat, self.answerer, self.chat.messages, _nothing_imagined(error.code, str(error), spent)
        )

    def take(self, result: str, artifacts: ArtifactStore) -> SimulateRequest | None:
        """Takes a result (JSON), and returns the request for a second simulation that is needed, if any.

        Its frames are those of the first one, as many and at the same times. CPU work. Raises `CannotReadDirection`.
        """
        first = Simulation.model_validate_json(result)
        self.results.append(first)
        content = self.answerer.content
        if len(self.results) > 1 or content not in ("wrong-direction", "other-item"):
            return None
        frames = self.request.frames.model_copy(update={"indices": tuple(frame.index for frame in first.frames)})
        if content == "wrong-direction":
            motion = MotionRequest.model_validate(opposite_motion(first))
            image = ImageArtifact(artifact=first.image.sha256)
            return self.request.model_copy(update={"image": image, "motion": motion, "frames": frames})
        other, question = other_item(_image_of(first, artifacts))
        return SimulateRequest(
            image="data:image/jpeg;base64," + base64.b64encode(other).decode(),
            question=question,
            reader="embedded",
            frames=frames,
            **{name: getattr(self.request, name) for name in OF_CLIP},
        )

    def enriched(self, artifacts: ArtifactStore, takes: ServerCapabilities | None) -> EnrichedChat:
        """The chat with a note and pictures after its question; for two worlds, a named strip of each.

        Where the MLLM's server takes fewer images a call, they share one strip. All images are seen in the `detail` of
        the caller's own. CPU work. Raises `ArtifactNotFound`.
        """
        simulation, content = self.results[0], self.answerer.content
        factual = tuple(decode_own(artifacts.read(frame.sha256)) for frame in simulation.factual_frames)
        told = hypothesis(Imagined(simulation, (), factual)) | {"facts": facts_of(simulation)}
        prompt = load_prompt(FACTS_NOTE if content == "text" else NOTE)
        detail = {} if self.image.detail is None else {"detail": self.image.detail}
        parts: list[Any] = [{"type": "text", "text": prompt.render(**{name: told[name] for name in prompt.inputs})}]
        pngs, warnings = [] if content == "text" else self._pngs(artifacts), list(simulation.warnings)
        own = sum(1 for _ in images_of(self.chat.messages))
        if takes is not None and takes.images is not None and own < takes.images < own + len(pngs):
            sheet = sheet_of([decode_own(png) for png in pngs], own + 1)
            pngs = [encode_png(sheet)]
            parts.append({"type": "text", "text": AFTER_FIRST})
            warnings.append(SHEET_NOTE)
        for png in pngs:
            url = "data:image/png;base64," + base64.b64encode(png).decode()
            parts.append({"type": "image_url", "image_url": {"url": url, **detail}})
        shown = () if content in ("text", "still") else (self.results[-1],)
        cow = ChatImagination(
            imagined=True,
            simulation=simulation.id,
            frames=tuple(frame for each in shown for frame in (*each.factual_frames, *each.frames)),
            prompts={prompt.name: prompt.version},
            usage=sum((each.usage for each in self.results), Usage()),
            usage_total=sum((each.usage_total for each in self.results), Usage()),
            reused=simulation.reused,
            warnings=tuple(warnings),
        )
        messages = list(self.chat.messages)
        content = messages[self.message].get("content")
        held = [{"type": "text", "text": content}] if isinstance(content, str) else list(content or ())
        messages[self.message] = messages[self.message] | {"content": [*held, *parts]}
        return EnrichedChat(self.chat, self.answerer, messages, cow)

    def _pngs(self, artifacts: ArtifactStore) -> list[bytes]:
        """The pictures to show: as many as frames of the first simulation, and as large, whatever they show."""
        first, shown, still = self.results[0], self.results[-1], self.answerer.content == "still"
        if not (first.factual_frames or still or self.answerer.content == "other-item"):
            return [artifacts.read(frame.sha256) for frame in shown.frames]
        image = _image_of(first, artifacts) if still else None

        def drawn(wanted: Sequence[Frame], frames: Sequence[Frame]) -> tuple[NDArray[Any], ...]:
            found: list[NDArray[Any]] = []
            for like, frame in zip(wanted, frames, strict=True):
                size = like.width, like.height
                png = artifacts.read(frame.sha256) if image is None else encode_png(fit_within(image, max(size)))
                found.append(as_large_as(decode_own(png), *size))
            return tuple(found)

        factual = drawn(first.factual_frames, shown.factual_frames or shown.frames[: len(first.factual_frames)])
        imagined = Imagined(first, drawn(first.frames, shown.frames), factual)
        return [encode_png(picture) for picture in pictures(imagined)]


def find_what_if(chat: Chat, answerer: Answerer) -> WhatIf | ChatImagination:
    """What the chat asks to be imagined, or why nothing is. CPU work.

    Raises `InvalidRequest` for unusable fields of `cow`, and where there is nothing to vote on.
    """
    asked, question = chat.question()
    if answerer.votes > 1:
        check_votable(chat, answerer.votes)
    if answerer.content == "none":
        unused = f"`{EXTENSION}` was not used: the model's name says that nothing is imagined."
        reason = f"The model's name holds {WITHOUT}."
        return _nothing_imagined("no-imagination", reason, warnings=(unused,) if chat.cow else ())
    images = list({image.url: image for image in reversed(list(images_of(chat.messages)))}.values())
    others = sorted({kind for _, kind in other_parts(chat.messages)})
    check_fields(chat, answerer)
    for applies, reason, detail in (
        (others, "other-parts", f"The messages hold parts that COW does not read: {', '.join(others)}."),
        (len(images) > 1, "several-images", f"A what-if question is about one image; there are {len(images)}."),
        (not images, "no-image", "There is no image in the messages."),
        (not question.strip(), "no-question", "The last user message has no text."),
    ):
        if applies:
            return _nothing_imagined(reason, detail)
    named = {} if answerer.policy is None else {"frames": {"policy": answerer.policy, **NAMED_FRAMES}}
    try:
        fields = {"video": False, **chat.cow, **named, "question": question, "image": images[0].reference}
        return WhatIf(chat, answerer, SimulateRequest.model_validate(fields), asked, images[0])
    except ValidationError as error:
        refused = invalid(error)
        return _nothing_imagined(refused.code, str(refused))


def check_fields(chat: Chat, answerer: Answerer) -> None:
    """Raises `InvalidRequest` for COW's own fields that it cannot use, whatever the messages hold."""
    refused = dict.fromkeys(FIELDS_OF_CHAT, "is said by `messages`; leave it out")
    refused |= {name: f"leave it out: {instead}" for name, instead in OF_ANSWERS.items()}
    if answerer.policy is not None:
        refused["frames"] = f"is said by the model's name (:{answerer.policy}); leave it out"
    if answerer.content == "wrong-direction":
        refused["trajectory"] = "has no wrong direction: leave it out, or ask the model without :wrong-direction"
    for name in chat.cow:
        if name in refused:
            raise errors.wrong(f"/{EXTENSION}/{name}", refused[name])
    try:
        SimulateRequest.model_validate({**chat.cow, "question": "?", "image": "data:"})
    except ValidationError as error:
        raise invalid(error, lambda pointer: f"/{EXTENSION}{pointer}") from error


def check_votable(chat: Chat, votes: int) -> None:
    """Raises `InvalidRequest` if the question offers no answers, or each vote would be several, or the same."""
    place, question = chat.question()
    if not read_choices(question, None):
        pointer = "/messages" if place < 0 else f"/messages/{place}/content"
        detail = "the last user message lists no answers to choose from, such as (A) Yes (B) No"
        raise errors.wrong(pointer, f"{detail}: list them, or ask the model without :vote-{votes}")
    remedy = f"leave it out, or ask the model without :vote-{votes}"
    if chat.fields.get("n") not in (None, 1):
        raise errors.wrong("/n", f"each vote is one reply: {remedy}")
    if chat.fields.get("seed") is not None:
        raise errors.wrong("/seed", f"all votes would be the same reply: {remedy}")


def _nothing_imagined(
    reason: str, detail: str, usage: Usage | None = None, warnings: tuple[str, ...] = ()
) -> ChatImagination:
    used = usage or Usage()
    return ChatImagination(
        imagined=False, reason=reason, detail=detail, usage=used, usage_total=used, warnings=warnings
    )


def _image_of(simulation: Simulation, artifacts: ArtifactStore) -> NDArray[Any]:
    """The question's own image. Its job has decoded it, so that it is not too large."""
    return decode(artifacts.read(simulation.image.sha256), max_megapixels=math.inf).pixels
