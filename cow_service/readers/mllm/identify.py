"""First prompt: what the question asks, which object it sets in motion, and how that moves, in words."""

import re
from collections.abc import Iterator
from typing import Annotated, Any, ClassVar, Self, get_args

from pydantic import BeforeValidator, Field, ValidationError, WithJsonSchema, field_validator, model_validator

from cow_service import records
from cow_service.narration.words import RELATION_WORDS
from cow_service.physics.camera import depth_motion
from cow_service.readers.base import OtherMotionHint, StepReading
from cow_service.readers.mllm import replies
from cow_service.readers.mllm.client import PromptCall
from cow_service.readers.mllm.coordinates import EncodedImage
from cow_service.readers.mllm.estimates import Distance, Seconds, Speed, seconds_of
from cow_service.readers.mllm.replies import Reply, ReplyError
from cow_service.readers.options import plain

MAX_OTHERS = 4
MIN_SENTENCE, MAX_SENTENCE = 8, 240  # characters
_SAID_ALIKE = ("sentence", "speed", "distance", "duration", "until")  # fields of a reply and of `MotionHints`
_NAMES = ("object", "moving_object", "mover", "object_name", "final_result", "result")
_INNER = ("name", "label", "object", "description")  # of an object that is an object itself
_ANSWERS = frozenset({"yes", "no", "not sure", "unsure", "true", "false", "unknown", "maybe"})
_SENTENCE = re.compile(r"\b(?:I|am|is|are|was|were|will|would|has|have|does|do)\b")
_LETTERED = re.compile(r"\W*[(\[]?[A-Za-z][)\].:](\s|$)|\W*[A-Za-z]\W*$")
_SAID = re.compile(
    r"(?:final result|(?:moving )?object|mover|(?:object|thing) that moves)[*\"'`]*\s*(?:is|:|=)\s*(?P<name>[^\n]+)",
    re.IGNORECASE,
)
_DENIAL = re.compile(
    r"\b(?:not|none|cannot|can['’]?t|couldn['’]?t|sorry|unable|unclear|unknown|impossible|or|there (?:is|are))\b"
    r"|n['’]t\b|\bno\b(?!\.?\s*\d)",
    re.IGNORECASE,
)
# One sentence that an object is not in the picture, and nothing else.
_ABSENT = re.compile(
    r"\W*(?:sorry,? |unfortunately,? )?(?:(?:but )?"
    r"i (?:can(?:no|['’])t|can not|do(?: not|n['’]t)) (?:see|find|locate|identify)"
    r"|there (?:is|are|['’]s) (?:no|not any)|no)\b[^.!?:;{}]{1,80}\b(?:in|on|visible in|present in|shown in) "
    r"(?:the|this|your) (?:given |provided )?(?:image|picture|photo|photograph|scene|frame)\W*",
    re.IGNORECASE,
)
_POINTING = frozenset({"it", "this", "that", "them", "they", "object", "the object", "moving object"})
_CHANGES = {
    "removed": "remove", "removal": "remove", "take away": "remove", "put": "place", "placed": "place", "add": "place",
}  # fmt: skip
_NAME_SCHEMA = replies.words(replies.MAX_NAME)
_DIAGONAL = 0.5**0.5
WAYS: dict[str, tuple[records.Vector, float]] = {  # direction in the image, and the depth's sense
    "left": ((-1, 0), 0), "right": ((1, 0), 0), "up": ((0, -1), 0), "down": ((0, 1), 0),
    "up-left": ((-_DIAGONAL, -_DIAGONAL), 0), "up-right": ((_DIAGONAL, -_DIAGONAL), 0),
    "down-left": ((-_DIAGONAL, _DIAGONAL), 0), "down-right": ((_DIAGONAL, _DIAGONAL), 0),
    "towards": ((0, 1), -1), "away": ((0, -1), 1),
}  # fmt: skip


def _known(kind: Any, synonyms: dict[str, str] | None = None, default: str | None = None) -> BeforeValidator:
    """Reads one of the words of a `Literal`, or a synonym of one."""
    known = {word: word for word in get_args(kind)} | (synonyms or {})
    return BeforeValidator(lambda written: known.get(replies.text_of(written).lower(), default))


def _names(most: int) -> tuple[Any, Any]:
    """The annotations of a list of names. An object with a name is taken for it."""

    def read(written: object) -> tuple[str, ...]:
        listed = replies.listed(written)
        parts = [
            replies.first_of(replies.fields_of(part), *_INNER) if isinstance(part, dict) else part for part in listed
        ]
        names = [replies.name_of(part) for part in parts if not replies.is_none(part) and replies.text_of(part)]
        return tuple(dict.fromkeys(names))[:most]

    return Field(max_length=most), BeforeValidator(read)


def _way(written: object) -> tuple[records.Vector, float] | None:
    """The direction in the image, and the depth."""
    said = "-".join(replies.text_of(written).lower().replace("the ", "").split())
    known = WAYS.get(said) or next((WAYS[key] for key in ("towards", "away") if said.startswith(key)), None)
    if known is None:
        return None
    direction, sense = known
    return depth_motion(sense) if sense else (direction, 0.0)


Name = Annotated[str, Field(min_length=1), BeforeValidator(replies.name_of)]
_RELATION = BeforeValidator(lambda said: RELATION_WORDS.get(replies.text_of(said).lower().replace("_", "-")))
_LANGUAGES = get_args(records.Language)
_LANGUAGE = BeforeValidator(lambda said: code if (code := replies.text_of(said)[:2].lower()) in _LANGUAGES else None)
_WAY = BeforeValidator(_way), WithJsonSchema(replies.one_of(*WAYS))


class Change(Reply):
    """A change of the scene before anything moves, in words."""

    other_names: ClassVar = {"object": ("name", "label"), "targets": ("target",)}
    kind: Annotated[records.InterventionKind, _known(records.InterventionKind, _CHANGES)]
    object: Name
    relation: Annotated[records.PlaceRelation | None, _RELATION] = None
    targets: Annotated[tuple[str, ...], *_names(2)] = ()

    @model_validator(mode="after")
    def _check_place(self) -> Self:
        if self.kind == "place" and (self.relation is None or not self.targets):
            raise ValueError("says not where to")
        return self


class Leg(Reply):
    """A further leg of the motion."""

    other_names: ClassVar = {"way": ("direction",)}
    way: Annotated[tuple[records.Vector, float], *_WAY]
    distance: Distance = None
    duration: Seconds = None


class AlsoMoving(Reply):
    """Another thing that is set moving at the same time."""

    other_names: ClassVar = {"object": ("name", "label"), "way": ("direction",)}
    object: Name
    kind: Annotated[records.MotionKind, _known(records.MotionKind, default="linear")]
    way: Annotated[tuple[records.Vector, float] | None, *_WAY] = None

    @property
    def hint(self) -> OtherMotionHint:
        """As stage 2 takes it."""
        direction, depth = self.way if self.way is not None and self.kind in records.DIRECTED_KINDS else (None, 0.0)
        return OtherMotionHint(object=self.object, kind=self.kind, direction=direction, depth=depth)

    @model_validator(mode="after")
    def _check_way(self) -> Self:
        if self.kind == "place" or (self.kind in records.DIRECTED_KINDS and self.way is None):
            raise ValueError("says not which way")
        return self


class Identified(Reply):
    """What is asked and what moves, in words; nothing about where it is. Null is what the reply does not say."""

    other_names: ClassVar = {"object": _NAMES}
    object: Annotated[str, BeforeValidator(replies.text_of), WithJsonSchema(replies.nullable(_NAME_SCHEMA))]
    others: Annotated[tuple[str, ...], *_names(MAX_OTHERS)]
    asked: records.Asked | None
    kind: Annotated[records.MotionKind | None, _known(records.MotionKind)]
    sentence: Annotated[str | None, WithJsonSchema(replies.words(MAX_SENTENCE))]
    changes: Annotated[tuple[Change, ...], replies.usable(Change)] = ()
    speed: Speed = None
    distance: Distance = None
    duration: Seconds = None
    until: Annotated[records.Until | None, _known(records.Until)] = None
    then: Annotated[tuple[Leg, ...], replies.usable(Leg)] = ()
    also_moving: Annotated[tuple[AlsoMoving, ...], replies.usable(AlsoMoving)] = ()
    language: Annotated[records.Language | None, _LANGUAGE] = None

    @field_validator("asked", mode="before")
    @classmethod
    def _read_asked(cls, written: Any) -> records.Asked | None:
        """What is asked; null where any of it cannot be read: no verdict is better than one on another question."""
        given = replies.fields_of(written)
        fields = {name: given[name] for name in records.Asked.model_fields if not replies.is_none(given.get(name))}
        for name in fields.keys() & {"form", "relation"}:
            fields[name] = replies.text_of(fields[name]).lower()
        if "within" in fields:
            fields["within"] = seconds_of(fields["within"]) or fields["within"]
        try:
            return records.Asked.model_validate(fields)
        except ValidationError:
            return None

    @field_validator("sentence", mode="before")
    @classmethod
    def _read_sentence(cls, written: Any) -> str | None:
        sentence = replies.text_of(written)
        return sentence if MIN_SENTENCE <= len(sentence) <= MAX_SENTENCE else None

    @property
    def must_be_found(self) -> tuple[str, ...]:
        """The things that are changed, move at the same time, or are asked about."""
        names = [name for change in self.changes for name in (change.object, *change.targets)]
        names += [each.object for each in self.also_moving]
        if self.asked is not None:
            names += [name for name in (self.asked.subject, self.asked.target, *self.asked.among) if name is not None]
        return tuple(names)

    @property
    def hints(self) -> dict[str, Any]:
        """Fields of `MotionHints`, as far as the reply says them."""
        return {
            **{name: value for name in _SAID_ALIKE if (value := getattr(self, name)) is not None},
            "then": tuple(StepReading(*each.way, each.distance, each.duration) for each in self.then),
            "also": tuple(each.hint for each in self.also_moving),
        }


def identify_call(question: str, image: EncodedImage, reasoning_length: int) -> PromptCall[Identified | None]:
    """The call that asks what is asked, which object moves, in words, and how."""
    schema = replies.schema_of(Identified, reasoning_length=reasoning_length)
    return PromptCall("identify", {"question": question}, (image.jpeg,), schema, read_identified)


def read_identified(reply: str) -> Identified | None:
    """The object that a reply names; None where it says that there is none. Raises `ReplyError`."""
    said = replies.without_thinking(reply)
    values = replies.values_in(said)
    written = [fields for value in values for fields in _replies(value)]
    if not written and not any(isinstance(value, dict | list) or value is None for value in values):
        written = [{"object": name} for name in _names_in_prose(said)]
    names = [replies.text_of(fields["object"]) for fields in written]
    if names:
        if all(map(_ABSENT.fullmatch, names)):
            return None
    # A value that has the field says so there, any other as a whole.
    elif _ABSENT.fullmatch(said) or any(
        replies.is_none(replies.first_of({"": value} | replies.fields_of(value), *_NAMES, "")) for value in values
    ):
        return None
    else:
        raise ReplyError("`object` is missing; name the one object that moves, and do not answer the question")
    for name in names:
        if len(name) > replies.MAX_NAME:
            raise ReplyError(f"`object` has {len(name)} characters; a few words are enough")
        if _LETTERED.match(name) or (len(name.split()) <= 3 and plain(name) in _ANSWERS):
            raise ReplyError(f"'{name}' answers the question; name the object that moves instead")
        if _DENIAL.search(name) or name.lower().strip(" .") in _POINTING:
            raise ReplyError(f"'{name[:80]}' names no one object; give a few words that single it out, or null")
        if not re.search(r"[^\W\d_]{2}|[^\W\d_\x00-\x7f]", name):
            raise ReplyError(f"'{name}' names no object; say in words what moves")
    if len(set(map(replies.name_words, names))) > 1:
        raise ReplyError(f"several objects are named ({', '.join(names)}); name the one that moves")

    # What contradicts the rest of the same reply is left out.
    found = Identified.model_validate(written[-1])
    mover, asked = replies.name_words(found.object), found.asked
    if asked is not None and asked.subject is not None and replies.name_words(asked.subject) == mover:
        asked = asked.model_copy(update={"subject": None})  # null is the mover
    others = tuple(name for name in found.others if replies.name_words(name) != mover)
    placed = any(each.kind == "place" and replies.name_words(each.object) == mover for each in found.changes)
    kind = None if found.kind == "place" and not placed else found.kind
    return found.model_copy(update={"others": others, "asked": asked, "kind": kind})


def _replies(value: object) -> Iterator[dict[str, Any]]:
    """The fields of each reply in a value that names an object, without headings and lists around it."""
    if isinstance(value, list):
        for part in replies.listed(value):
            yield from _replies(part if isinstance(part, dict) else {"object": part})
    fields = replies.fields_of(value)
    for each in replies.listed(replies.first_of(fields, *_NAMES)):
        inner = replies.fields_of(each)
        if "kind" in inner and not inner.keys().isdisjoint(_NAMES):  # the whole reply, under a heading
            yield from _replies(each)
            continue
        for named in replies.listed(replies.first_of(inner, *_INNER) if inner else each):
            if not replies.is_none(named) and replies.text_of(named):
                yield fields | {"object": named}


def _names_in_prose(said: str) -> list[str]:
    """A name told in words: behind "the moving object is", or the whole reply if it is nothing but a phrase."""
    if replies.is_broken_json(said):
        return []
    told = list(_SAID.finditer(said))
    phrase = (told[-1]["name"] if told else said).strip().strip("*\"'`.[]{} ").strip()
    is_phrase = "\n" not in said and len(phrase.split()) <= 12 and not re.search(r"[.!?:;{}\[\]]", phrase)
    return [phrase] if told or (is_phrase and not _SENTENCE.search(phrase)) else []
