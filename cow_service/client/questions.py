"""The questions of a batch: what each asks, and its id and fingerprint."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, TypeAlias

from cow_service.client.inputs import ImageLike, Reference, image_input, is_url
from cow_service.client.request_fields import request_fields
from cow_service.client.serialization import to_json
from cow_service.errors import CowError, FieldError, InvalidRequest

# A mapping has `image` and `question`, maybe `id` and `meta`, and else fields of the request; a pair has the first two.
QuestionLike: TypeAlias = "Question | Mapping[str, Any] | tuple[ImageLike, str]"
MAX_ID_CHARACTERS = 200
_OWN_FIELDS = {"id", "image", "meta", "question"}  # of each question: no defaults are taken for them
_CONVERTED = {"law", "grounding", "objects"}  # fields that are not sent as they are given
_PLAIN = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}")


@dataclass(frozen=True)
class Question:
    """One question of a batch. `meta` is whatever should stand beside its outcome, such as the true answer.

    `named` is what tells its image from others; by default its path, its URL, or the digest of its bytes.
    """

    id: str
    image: ImageLike
    question: str
    options: Mapping[str, Any] = field(default_factory=dict[str, Any])
    meta: Any = None
    named: Any = None

    @cached_property
    def fingerprint(self) -> str:
        """SHA-256 of what is asked; of an image in a file its path counts, not its bytes."""
        named = _named(self.image) if self.named is None else self.named
        asked = {**self.options, "image": named, "question": self.question}
        return hashlib.sha256(to_json(dict(sorted(asked.items())))).hexdigest()

    @property
    def folder(self) -> str:
        """A name for a folder of its own: its id where that is plain, else the digest of it."""
        return self.id if _PLAIN.fullmatch(self.id) else hashlib.sha256(self.id.encode()).hexdigest()[:32]


def questions(
    items: Iterable[QuestionLike], defaults: Mapping[str, Any] | None = None, folder: Path | None = None
) -> Iterator[Question]:
    """The questions of these items, each with an id: its own, else one made of what it asks.

    `defaults` are fields of the request for those that do not have them. Files are looked for in `folder`. Raises
    `InvalidRequest` for an item without image or question, for what no JSON can hold, and for an id that comes twice.
    """
    defaults = defaults or {}
    wrong = sorted(_OWN_FIELDS & defaults.keys())
    if wrong:
        raise InvalidRequest(
            f"Each question has its own {' and '.join(f'`{name}`' for name in wrong)}: give none for all."
        )
    seen: set[str] = set()
    same: dict[str, int] = {}
    for place, item in enumerate(items, 1):
        question = _read(item, place, defaults, folder)
        question = replace(question, options=_fields(question.options, place))
        if question.id == "":
            made = _checked(question, place).fingerprint[:16]
            times = same[made] = same.get(made, 0) + 1
            question = replace(question, id=made if times == 1 else f"{made}-{times}")
        if question.id in seen:
            raise _wrong(place, "id", f"'{question.id}' stands before; give each its own")
        seen.add(question.id)
        yield _checked(question, place)


def _read(item: Any, place: int, defaults: Mapping[str, Any], folder: Path | None) -> Question:
    """A question without an id where it has none of its own. Raises `InvalidRequest` for what is no `QuestionLike`."""
    if isinstance(item, Question):
        return replace(item, options={**defaults, **item.options}) if defaults else item
    if not isinstance(item, Mapping) and not (isinstance(item, tuple | list) and len(item) == 2):
        raise InvalidRequest(f"Question {place} is a {type(item).__name__}: give a mapping, or image and question.")
    given: dict[str, Any] = dict(item) if isinstance(item, Mapping) else {"image": item[0], "question": item[1]}
    for name in ("image", "question"):
        if given.get(name) is None:
            raise _wrong(place, name, "is missing")
    if not isinstance(given["question"], str):
        raise _wrong(place, "question", f"must be a text, got {type(given['question']).__name__}")
    own = given.pop("id", None)
    if own is not None and not 0 < len(str(own)) <= MAX_ID_CHARACTERS:
        raise _wrong(place, "id", f"has {len(str(own))} characters; give 1 to {MAX_ID_CHARACTERS}")
    image, question, meta = given.pop("image"), given.pop("question"), given.pop("meta", None)
    named = None
    if folder is not None and isinstance(image, str) and not is_url(image):
        image, named = folder / image, image  # the same question, from wherever the folder is looked at
    return Question("" if own is None else str(own), image, question, {**defaults, **given}, meta, named)


def _fields(options: Mapping[str, Any], place: int) -> Mapping[str, Any]:
    """The fields of the request, with masks that JSON can hold. Raises `InvalidRequest` naming the question."""
    try:
        return request_fields(options) if _CONVERTED & options.keys() else options
    except CowError as error:
        raise InvalidRequest(f"Question {place}: {error.detail}", errors=error.errors) from error


def _checked(question: Question, place: int) -> Question:
    """The question, all of which JSON can hold: checked before it is asked, not after it was paid for."""
    for name, value in (("id", question.id), ("question", question.question), ("meta", question.meta)):
        try:
            to_json(value)
        except (TypeError, ValueError) as error:  # numbers and objects that JSON has not; halves of surrogate pairs
            raise _wrong(place, name, f"cannot be written as JSON: {error}") from error
    return question


def _named(image: ImageLike) -> Any:
    """What tells an image from others without its file being read."""
    if isinstance(image, Path) or (isinstance(image, str) and not image.lower().startswith("data:")):
        return str(image)
    if isinstance(image, Mapping):
        return dict(image)
    sent = image_input(image)
    return sent.json if isinstance(sent, Reference) else hashlib.sha256(sent.data).hexdigest()


def _wrong(place: int, name: str, detail: str) -> InvalidRequest:
    message = f"Question {place}: `{name}` {detail}."
    return InvalidRequest(message, errors=(FieldError(f"/{place - 1}/{name}", detail),))
