"""What a chat with an MLLM asks to be imagined: one what-if question about one image, or why there is nothing."""

from __future__ import annotations

from dataclasses import dataclass, field

from pydantic import ValidationError

from cow_service import errors
from cow_service.api.openai.chats import EXTENSION, Chat, wrong
from cow_service.api.openai.messages import ImagePart, images_of, other_parts, role_of, texts_of
from cow_service.api.problems import invalid
from cow_service.errors import CowError, FieldError
from cow_service.records import Usage
from cow_service.requests import SimulateRequest

FIELDS_OF_CHAT = ("image", "question")  # of a `SimulateRequest`: from messages
OF_ANSWERS = {  # fields of an `AnswerRequest`, and what does the same for a chat
    "votes": "the MLLM replies once: ask with `n`, or again",
    "baseline": "ask the model of the same name with :no-imagination",
    "imagine": "is said by `model`",
    "options": "the MLLM reads them in the messages",
}
# Why something cannot be imagined from a chat that the MLLM may still answer. Other errors are faults of the server, or
# of what the caller told COW itself: those are not passed over, or a figure would be that of another condition.
PASSED_OVER = (
    errors.InvalidRequest, errors.CannotGround, errors.CannotReadDirection, errors.MllmBadReply, errors.ImageTooLarge,
    errors.ImageUnreadable, errors.ImageTypeUnsupported, errors.ImageUrlNotAllowed, errors.ImageUrlUnreachable,
)  # fmt: skip


@dataclass(frozen=True)
class NotImagined:
    """Why nothing is imagined; see `ChatImagination`."""

    reason: str
    detail: str
    usage: Usage = field(default_factory=Usage)  # of what was tried


@dataclass(frozen=True)
class WhatIf:
    """A simulation that a chat asks for."""

    request: SimulateRequest
    message: int  # place of the message whose question it is: frames are added to it
    image: ImagePart
    given: frozenset[str]  # fields of `cow` in the request

    def why_not(self, error: CowError) -> NotImagined | None:
        """Why nothing was imagined, where the chat goes on without; None where the error is the caller's to hear."""
        told = self.located(error)
        own = any(self._is_given(field.pointer) for field in told.errors)
        if own or not isinstance(error, PASSED_OVER):
            return None
        return NotImagined(error.code, error.detail, Usage.model_validate(error.usage or {}))

    def located(self, error: CowError) -> CowError:
        """An error of the simulation, pointing into the chat."""
        fields = tuple(FieldError(self._pointer(field.pointer), field.detail) for field in error.errors)
        told = type(error)(error.detail, errors=fields, headers=error.headers)
        told.usage = error.usage
        return told

    def _is_given(self, pointer: str) -> bool:
        """Whether that is a field of `cow`, and one that the caller gave."""
        steps = pointer.split("/")[1:3]
        return steps[:1] == [EXTENSION] and not self.given.isdisjoint(steps[1:])

    def _pointer(self, pointer: str) -> str:
        head = "/".join(pointer.split("/")[:2])
        own = {"": "", "/image": self.image.url_pointer, "/question": f"/messages/{self.message}/content"}
        return own.get(head, f"/{EXTENSION}{pointer}")


def what_if(chat: Chat) -> WhatIf | NotImagined:
    """What the chat asks to be imagined. Raises `InvalidRequest` for fields of `cow` that cannot be used."""
    messages = chat.messages()
    asked = max((place for place, each in enumerate(messages) if role_of(each) == "user"), default=-1)
    question = "\n".join(texts_of(messages[asked])) if asked >= 0 else ""
    images = list({image.url: image for image in reversed(list(images_of(messages)))}.values())
    others = sorted({kind for _, kind in other_parts(messages)})
    _check_cow(chat)
    if others:
        return NotImagined("other-parts", f"The messages hold parts that COW does not read: {', '.join(others)}.")
    if len(images) > 1:
        return NotImagined("several-images", f"A what-if question is about one image; there are {len(images)}.")
    if not images:
        return NotImagined("no-image", "There is no image in the messages.")
    if not question.strip():
        return NotImagined("no-question", "The last user message has no text.")
    try:
        fields = {"video": False, **chat.cow, "question": question, "image": images[0].reference}
        return WhatIf(SimulateRequest.model_validate(fields), asked, images[0], frozenset(chat.cow))
    except ValidationError as error:
        told = invalid(error)
        return NotImagined(told.code, told.detail)


def _check_cow(chat: Chat) -> None:
    """Raises `InvalidRequest` for what COW itself is told and cannot do."""
    for name in chat.cow:
        if name in FIELDS_OF_CHAT:
            raise wrong(f"/{EXTENSION}/{name}", "is said by `messages`; leave it out")
        if name in OF_ANSWERS:
            raise wrong(f"/{EXTENSION}/{name}", f"leave it out: {OF_ANSWERS[name]}")
    try:
        SimulateRequest.model_validate({**chat.cow, "question": "?", "image": "data:"})
    except ValidationError as error:
        raise invalid(error, lambda pointer: f"/{EXTENSION}{pointer}") from error
