"""First prompt: which object the question sets in motion, in words, and how it moves."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, cast, get_args

from cow_service.readers.mllm.changes import CHANGE_FIELDS, Change, read_changes
from cow_service.readers.mllm.client import PromptCall
from cow_service.readers.mllm.free_text import is_broken_json, names_nothing, says_absent
from cow_service.readers.mllm.images import EncodedImage
from cow_service.readers.mllm.legs import LEG_FIELDS, NO_LEGS, Legs, read_legs
from cow_service.readers.mllm.lengths import LENGTH_FIELDS, NOT_SAID, Lengths, read_lengths
from cow_service.readers.mllm.replies import (
    ReplyError,
    fields_of,
    first_of,
    is_none,
    name_words,
    text_of,
    values_in,
    without_thinking,
)
from cow_service.readers.mllm.schemas import Schema, nullable, object_of, one_of, words
from cow_service.readers.options import plain
from cow_service.records import MotionKind

MAX_OBJECT = 120  # characters
MAX_OTHERS = 4
MIN_SENTENCE, MAX_SENTENCE = 8, 240  # characters
KINDS: tuple[MotionKind, ...] = get_args(MotionKind)
_NAMES = ("object", "moving_object", "mover", "object_name", "final_result", "result")
_INNER = ("name", "label", "object", "description")  # of an object that is an object itself
_ANSWERS = frozenset({"yes", "no", "not sure", "unsure", "true", "false", "unknown", "maybe"})
_SENTENCE = re.compile(r"\b(?:I|am|is|are|was|were|will|would|has|have|does|do)\b")
_LETTERED = re.compile(r"\W*[(\[]?[A-Za-z][)\].:](\s|$)|\W*[A-Za-z]\W*$")
_SAID = re.compile(
    r"(?:final result|(?:moving )?object|mover|(?:object|thing) that moves)[*\"'`]*\s*(?:is|:|=)\s*(?P<name>[^\n]+)",
    re.IGNORECASE,
)


@dataclass(frozen=True)
class Identified:
    """What moves, in words; nothing about where it is. `kind` and `sentence` are None where the reply has none."""

    object: str
    others: tuple[str, ...] = ()
    kind: MotionKind | None = None
    sentence: str | None = None
    changes: tuple[Change, ...] = ()
    lengths: Lengths = NOT_SAID
    legs: Legs = NO_LEGS


def identify_call(question: str, image: EncodedImage, reasoning_length: int) -> PromptCall[Identified | None]:
    """The call that asks which object moves, in words, and how."""
    return PromptCall("identify", {"question": question}, (image.jpeg,), schema(reasoning_length), read_identified)


def schema(reasoning_length: int) -> Schema:
    """JSON schema of the reply."""
    optional = CHANGE_FIELDS | LENGTH_FIELDS | LEG_FIELDS
    return object_of(
        optional,
        reasoning=words(reasoning_length),
        object=nullable(words(MAX_OBJECT)),
        others={"type": "array", "items": words(MAX_OBJECT), "maxItems": MAX_OTHERS},
        kind=one_of(*KINDS),
        sentence=words(MAX_SENTENCE),
        **optional,
    )


def read_identified(reply: str) -> Identified | None:
    """The object that a reply names; None where it says that there is none. Raises `ReplyError`."""
    said = without_thinking(reply)
    values = values_in(said)
    found = [named for value in values for named in _named(value)]
    if not found and not any(isinstance(value, dict | list) or value is None for value in values):
        found = [Identified(name) for name in _in_prose(said)]
    absent = [named for named in found if says_absent(named.object)]
    if (found and len(absent) == len(found)) or (not found and says_absent(said)):
        return None
    if not found:
        if any(_says_none(value) for value in values):
            return None
        raise ReplyError("`object` is missing; name the one object that moves, and do not answer the question")
    for named in found:
        _check(named.object)
    if len({tuple(name_words(named.object)) for named in found}) > 1:
        raise ReplyError(f"several objects are named ({', '.join(n.object for n in found)}); name the one that moves")
    return found[-1]


def _named(value: object) -> Iterator[Identified]:
    if isinstance(value, list):
        for part in cast("list[object]", value):
            yield from _named(part) if isinstance(part, dict) else _as_words(part)
    fields = fields_of(value)
    name = first_of(fields, *_NAMES)
    names = cast("list[object]", name) if isinstance(name, list) else [name]
    for each in names:
        inner = fields_of(each)
        if any(key in inner for key in _NAMES) and "kind" in inner:  # the whole reply, under a heading
            yield from _named(each)
            continue
        kind, sentence = text_of(fields.get("kind")).lower(), text_of(fields.get("sentence"))
        for named in _as_words(first_of(inner, *_INNER) if inner else each):
            changes = read_changes(fields)
            placed = any(each.kind == "place" and _same(each.object, named.object) for each in changes)
            said_kind: MotionKind | None = next((known for known in KINDS if known == kind), None)
            yield Identified(
                object=named.object,
                others=_others(fields, named.object),
                kind=None if said_kind == "place" and not placed else said_kind,
                sentence=sentence if MIN_SENTENCE <= len(sentence) <= MAX_SENTENCE else None,
                changes=changes,
                lengths=read_lengths(fields),
                legs=read_legs(fields),
            )


def _same(one: str, other: str) -> bool:
    return name_words(one) == name_words(other)


def _as_words(value: object) -> Iterator[Identified]:
    if not is_none(value) and text_of(value):
        yield Identified(text_of(value))


def _says_none(value: object) -> bool:
    fields = fields_of(value)
    key = next((key for key in _NAMES if key in fields), None)
    return is_none(value) if key is None else is_none(fields[key])


def _in_prose(said: str) -> list[str]:
    """A name told in words: behind "the moving object is", or the whole reply if it is nothing but a phrase."""
    if is_broken_json(said):
        return []
    names = [_unquoted(found["name"]) for found in _SAID.finditer(said)]
    if names:
        return names[-1:]
    phrase = _unquoted(said)
    is_phrase = "\n" not in said and len(phrase.split()) <= 12 and not re.search(r"[.!?:;{}\[\]]", phrase)
    return [phrase] if is_phrase and not _SENTENCE.search(phrase) else []


def _unquoted(text: str) -> str:
    return text.strip().strip("*\"'`.[]{} ").strip()


def _check(name: str) -> None:
    if len(name) > MAX_OBJECT:
        raise ReplyError(f"`object` has {len(name)} characters; a few words are enough")
    if _LETTERED.match(name) or (len(name.split()) <= 3 and plain(name) in _ANSWERS):
        raise ReplyError(f"'{name}' answers the question; name the object that moves instead")
    if names_nothing(name):
        raise ReplyError(f"'{name[:80]}' names no one object; give a few words that single it out, or null")
    if not re.search(r"[^\W\d_]{2}|[^\W\d_\x00-\x7f]", name):
        raise ReplyError(f"'{name}' names no object; say in words what moves")


def _others(fields: dict[str, Any], mover: str) -> tuple[str, ...]:
    held = fields.get("others")
    parts = cast("list[object]", held) if isinstance(held, list) else [held]
    inner = [first_of(fields_of(part), *_INNER) if isinstance(part, dict) else part for part in parts]
    names = [text_of(each)[:MAX_OBJECT] for each in inner if not is_none(each)]
    kept = [name for name in names if name and name_words(name) != name_words(mover)]
    return tuple(dict.fromkeys(kept))[:MAX_OTHERS]
