"""What one server takes of a call: learned from what it refuses, and remembered per server and model.

A refusal that names a field moves one step down, and so does an unexplained one, before any call has succeeded or of
more images than any call had. What has worked is not given up again without a reason.
"""

import re
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from http import HTTPStatus

from pydantic_ai import exceptions as errors

from cow_service.readers.mllm.known import MllmNotes
from cow_service.readers.mllm.sheets import FEWER_FRAMES
from cow_service.records import Delivery, ServerCapabilities

MAX_STEPS = 8  # that one call may teach
MAX_REDUCTION = FEWER_FRAMES + 2
REFUSED = (HTTPStatus.BAD_REQUEST, HTTPStatus.UNPROCESSABLE_ENTITY, HTTPStatus.NOT_IMPLEMENTED)
_MAY_LEARN = (*REFUSED, HTTPStatus.INTERNAL_SERVER_ERROR)
_SIZE_STATUS = HTTPStatus.REQUEST_ENTITY_TOO_LARGE
_IMAGES = re.compile(
    r"(?i)(?:most|maximum(?: of)?|only|up to|limit\D{0,20}|than)\s+(\d+)\s+(?:image|picture)"
    r"|image count \d+ exceeds limit (\d+)|\bimage=(\d+)"  # of SGLang, and of older vLLM
)
_ONE_IMAGE = re.compile(r"\b(?:single|one) image\b|multiple images|more than one image", re.IGNORECASE)
_TOO_LARGE = re.compile(
    r"(?i)too (?:large|big|long)|maximum (?:context|model|size|allowed)|context (?:length|window|size)"
    r"|exceeds? .{0,30}(?:size|limit|length|tokens)"
)
# What a refusal may be about, by its words, in the order in which steps are taken.
_NAMED: dict[str, re.Pattern[str]] = {
    "token_field": re.compile(r"max_completion_tokens"),
    "temperature": re.compile(r"temperature"),
    "seed": re.compile(r"\bseed\b"),
    "system_role": re.compile(
        r"(?i)system[ _]?(?:role|message|prompt|instruction)|role\W{0,3}.{0,12}system|roles must"
    ),
    "delivery": re.compile(r"(?i)stream"),
    "output": re.compile(r"(?i)response_?format|json_?(?:schema|object)|\bschema\b|grammar|guided|structured|extra"),
}
# The step down from each value that a refusal has named.
_LOWER: dict[str, dict[object, object]] = {
    "token_field": {"max_tokens": "max_completion_tokens", "max_completion_tokens": "max_tokens"},
    "temperature": {True: False},
    "seed": {True: False},
    "system_role": {True: False},
    "delivery": {"whole": "streamed"},
    "output": {"json_schema": "json_object", "json_object": "prompt"},
}
_UNREADABLE: dict[Delivery, Delivery] = {"whole": "streamed", "streamed": "declared"}  # of replies in pieces


@dataclass
class CapabilityStore:
    """What is known of one server and model, in memory and, once a call has succeeded, on disk.

    Used from one event loop. `proven` is what calls have succeeded with, and `shown` the most images of one.
    """

    notes: MllmNotes
    first: ServerCapabilities  # before anything is known
    shown: int = 0

    def __post_init__(self) -> None:
        self.proven = self.notes.takes
        self.current = self.proven or self.first

    def succeed(self, used: ServerCapabilities, images: int) -> None:
        """A call with that many images has succeeded: what it was sent with is kept."""
        self.shown = max(self.shown, min(images, used.images or images))
        if used == self.proven:
            return
        self.proven = used
        with suppress(OSError):  # it is found out again by the next process
            self.notes.keep(used)

    def refuse(self, used: ServerCapabilities, error: errors.ModelAPIError, images: int, *, may_pass: bool) -> bool:
        """A call with that many images was refused: whether another one is worth trying, with what is known then.

        `may_pass`: the refusal may be a passing fault, unless it says what it is about.
        """
        if used != self.current:
            return True  # another call has learned meanwhile
        lower = step_down(used, error, images, self.shown, is_proven=may_pass or used == self.proven)
        if lower is None:
            return False
        self.current = lower
        return True

    def forget(self) -> None:
        """All is found out again from the next call on."""
        self.proven, self.current = None, self.first

    def give_up(self) -> None:
        """No step helped: nothing was learned from these refusals."""
        self.current = self.proven or self.first


def step_down(
    used: ServerCapabilities, error: errors.ModelAPIError, images: int, shown: int = 0, *, is_proven: bool
) -> ServerCapabilities | None:
    """What to try after a refusal; None where nothing that is known of servers would help.

    `images` were sent, and `shown` is the most that were ever taken.
    """
    if not isinstance(error, errors.ModelHTTPError):  # no chat completion: it may be one in pieces
        unreadable = type(error) is errors.ModelAPIError and not is_proven
        delivery = _UNREADABLE.get(used.delivery) if unreadable else None
        return None if delivery is None else used.model_copy(update={"delivery": delivery})
    update = next(_named_steps(used, error, images), None)
    # Else this call is at fault, not what every call is sent with.
    if update is None and not is_proven and error.status_code in _MAY_LEARN and not _is_too_large(error):
        update = next(_blind_steps(used), None)
    may_be_many = images > max(1, shown) and used.images is None and error.status_code in REFUSED
    if update is None and may_be_many and not _is_too_large(error):
        update = {"images": 1}
    return None if update is None else used.model_copy(update=update)


def _is_too_large(error: errors.ModelHTTPError) -> bool:
    if isinstance(error, errors.ModelContextWindowExceededError) or error.status_code == _SIZE_STATUS:
        return True
    return error.status_code in REFUSED and _TOO_LARGE.search(str(error.body or "")) is not None


def _named_steps(used: ServerCapabilities, error: errors.ModelHTTPError, images: int) -> Iterator[dict[str, object]]:
    """Steps for what a refusal names."""
    status, said = error.status_code, str(error.body or "")
    counted = _IMAGES.search(said)
    most = int(counted[counted.lastindex or 1]) if counted else 1 if _ONE_IMAGE.search(said) else images
    if status in REFUSED and 0 < most < images:
        yield {"images": most}
    if _is_too_large(error):
        if used.reduction < MAX_REDUCTION:
            only_first = images == 1  # what is done to frames does not help
            yield {"reduction": max(used.reduction, FEWER_FRAMES if only_first else 0) + 1}
    elif status in _MAY_LEARN:
        for field, words in _NAMED.items():
            if (value := getattr(used, field)) in _LOWER[field] and words.search(said):
                yield {field: _LOWER[field][value]}


def _blind_steps(used: ServerCapabilities) -> Iterator[dict[str, object]]:
    """Steps after a refusal that names nothing, what is refused most often first."""
    if used.output != "prompt":
        yield {"output": _LOWER["output"][used.output]}
    if used.temperature or used.seed:
        yield {"temperature": False, "seed": False}
    if used.system_role:
        yield {"system_role": False}
