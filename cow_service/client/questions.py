"""The questions of a batch: what each asks, by which id its outcome is known, and how the server knows it again."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeAlias

from cow_service.client.calls import to_json
from cow_service.client.inputs import ImageLike, Reference, image_input
from cow_service.errors import FieldError, InvalidRequest

# A mapping has `image` and `question`, maybe `id` and `meta`, and else fields of the request; a pair has the first two.
QuestionLike: TypeAlias = "Question | Mapping[str, Any] | tuple[ImageLike, str]"
MAX_ID = 200  # characters
_PLAIN = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}")


@dataclass(frozen=True)
class Question:
    """One question of a batch. `meta` is whatever should stand beside its outcome, such as the true answer."""

    id: str
    image: ImageLike
    question: str
    options: Mapping[str, Any] = field(default_factory=dict[str, Any])
    meta: Any = None
    fingerprint: str = ""  # SHA-256 of what is asked; of a file by its name, not its bytes

    @property
    def folder(self) -> str:
        """A name for a folder of its own: its id where that is plain, else its fingerprint."""
        return self.id if _PLAIN.fullmatch(self.id) else self.fingerprint[:32]


def questions(items: Iterable[QuestionLike], defaults: Mapping[str, Any] | None = None) -> Iterator[Question]:
    """The questions of these items, each with an id: its own, else one made of what it asks.

    `defaults` are fields of the request for those that do not have them. Raises `InvalidRequest` for an item without
    image or question, and for an id that comes twice.
    """
    seen: set[str] = set()
    for place, item in enumerate(items, 1):
        question = item if isinstance(item, Question) else _question(item, place, defaults or {})
        if question.id in seen and not isinstance(item, Question) and _own_id(item) is None:
            question = _numbered(question, seen)
        if question.id in seen:
            raise _wrong(place, "id", f"'{question.id}' stands before; give each its own")
        seen.add(question.id)
        yield question


def _question(item: Mapping[str, Any] | tuple[ImageLike, str], place: int, defaults: Mapping[str, Any]) -> Question:
    given: dict[str, Any] = dict(item) if isinstance(item, Mapping) else {"image": item[0], "question": item[1]}
    for name in ("image", "question"):
        if given.get(name) is None:
            raise _wrong(place, name, "is missing")
    if not isinstance(given["question"], str):
        raise _wrong(place, "question", f"must be a text, got {type(given['question']).__name__}")
    own, meta = _own_id(given), given.pop("meta", None)
    if own is not None and not 0 < len(own) <= MAX_ID:
        raise _wrong(place, "id", f"has {len(own)} characters; give 1 to {MAX_ID}")
    given.pop("id", None)
    image, question = given.pop("image"), given.pop("question")
    options = {**defaults, **given}
    asked = {"image": _named(image), "question": question, **options}
    fingerprint = hashlib.sha256(to_json(dict(sorted(asked.items())))).hexdigest()
    return Question(own or fingerprint[:16], image, question, options, meta, fingerprint)


def _named(image: ImageLike) -> Any:
    """What tells an image from others without its file being read."""
    if isinstance(image, Path) or (isinstance(image, str) and not image.startswith("data:")):
        return str(image)
    if isinstance(image, Mapping):
        return dict(image)
    sent = image_input(image)
    return sent.json if isinstance(sent, Reference) else hashlib.sha256(sent.data).hexdigest()


def _own_id(item: Any) -> str | None:
    own = item.get("id") if isinstance(item, Mapping) else None
    return None if own is None else str(own)


def _numbered(question: Question, seen: set[str]) -> Question:
    """The same question once more, under an id that is free: -2, -3 and so on."""
    number = 2
    while f"{question.id}-{number}" in seen:
        number += 1
    return Question(
        f"{question.id}-{number}",
        question.image,
        question.question,
        question.options,
        question.meta,
        question.fingerprint,
    )


def _wrong(place: int, name: str, detail: str) -> InvalidRequest:
    told = f"Question {place}: `{name}` {detail}."
    return InvalidRequest(told, errors=(FieldError(f"/{place - 1}/{name}", detail),))
