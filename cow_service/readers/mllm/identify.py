"""First prompt: what the question asks, which object it sets in motion, and how that moves, in words."""

import json
import re
from collections.abc import Collection, Iterator, Sequence
from functools import partial
from typing import Annotated, Any, ClassVar, Self, get_args

import pydantic
from pydantic import BeforeValidator, Field, ValidationInfo, WithJsonSchema, field_validator
from pydantic.json_schema import SkipJsonSchema

from cow_service import records
from cow_service.narration.words import RELATION_WORDS
from cow_service.physics.camera import depth_motion
from cow_service.readers.base import ReaderInput
from cow_service.readers.mllm import replies
from cow_service.readers.mllm.client import PromptCall
from cow_service.readers.mllm.coordinates import EncodedImage
from cow_service.readers.mllm.quantities import Distance, ReadingContext, Seconds, Speed, context_of, positive
from cow_service.readers.options import plain

MAX_NAMED = 12  # other objects that the question names
_NUMBERS = ("speed", "distance", "duration")  # which only a question with a number can say
SAID_ALIKE = (*_NUMBERS, "until")  # fields of a reply and of a motion
_MOTION = ("kind", *SAID_ALIKE, "then", "also_moving")
# The reply to "With the vase gone, will the red car that drives left at 20 px/s miss the mug?"
_EXAMPLE: dict[str, Any] = {
    "object": "red car", "others": ["mug", "vase"],
    "asked": {"form": "whether", "relation": "touches", "target": "mug", "negated": True}, "kind": "linear",
    "changes": [{"kind": "remove", "object": "vase"}], "speed": "20 px/s", "language": "en",
}  # fmt: skip
_NAMES = ("object", "moving_object", "mover", "object_name", "final_result", "result")
_INNER = ("name", "label", "object", "description")  # of an object that is an object itself
_ANSWERS = frozenset({"yes", "no", "not sure", "unsure", "true", "false", "unknown", "maybe"})
_SENTENCE = re.compile(r"\b(?:I|am|is|are|was|were|will|would|has|have|does|do)\b")
_LETTERED = re.compile(r"\W*[(\[]?[A-Za-z][)\].:](\s|$)|\W*[A-Za-z]\W*$")
_SAID = re.compile(
    r"(?:final result|(?:moving )?object|mover|(?:object|thing) that moves)[*\"'`]*\s*(?:is|:|=)\s*"
    r"(?P<name>[^\n]+?)(?=[.!;](?:\s|$)|\n|$)",
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
_KINDS = {
    "rolling": "linear", "sliding": "linear", "moving": "linear", "driving": "linear", "thrown": "projectile",
    "throw": "projectile", "falling": "fall", "drop": "fall", "dropped": "fall",
}  # fmt: skip
# What a reply may call a relation in words of its own. What "hidden" says depends on which of the two is meant.
_RELATIONS: tuple[tuple[records.AskedRelation, bool, str], ...] = (  # with whether it is denied
    ("touches", False, r"hits?|hitting|collides?|colliding|collision|touch(?:es|ing)?|contacts?|bumps?|strikes?"),
    ("touches", True, r"miss|misses|avoids?"),
    ("covers", False, r"occludes?|occluding|hides?|hiding|covers?|covering|obscures?"),
    ("inside", False, r"fits?|enters?"),
    ("tips", False, r"tips?|tipping|topples?|knock(?:s|ed)? over|tipped over"),
    ("leaves", False, r"leaves?|leaving|exits?"),
)
_NOT = re.compile(r"\b(?:not|never|no|without|first|when|where|how|which|what)\b|n['\u2019]t\b", re.IGNORECASE)
_ANY = re.compile(r"\b(?:anything|something|any object)\b", re.IGNORECASE)
_FORMS = {"yes-no": "whether", "yes/no": "whether", "if": "whether"}
_DIAGONAL = 0.5**0.5
WAYS: dict[str, tuple[records.Vector, float]] = {  # direction in the image, and the depth's sense
    "left": ((-1, 0), 0), "right": ((1, 0), 0), "up": ((0, -1), 0), "down": ((0, 1), 0),
    "up-left": ((-_DIAGONAL, -_DIAGONAL), 0), "up-right": ((_DIAGONAL, -_DIAGONAL), 0),
    "down-left": ((-_DIAGONAL, _DIAGONAL), 0), "down-right": ((_DIAGONAL, _DIAGONAL), 0),
    "towards": ((0, 1), -1), "away": ((0, -1), 1),
}  # fmt: skip


def _known(kind: Any, synonyms: dict[str, str] | None = None, default: str | None = None) -> BeforeValidator:
    """Reads one of the words of a `Literal`, or a synonym of one; any other word is a fault."""
    known = {word: word for word in get_args(kind)} | (synonyms or {})

    def read(written: object, info: ValidationInfo) -> str | None:
        said = replies.text_of(written).lower().strip(" .")
        if said not in known and not replies.is_none(written) and default is None:
            words = ", ".join(get_args(kind))
            context_of(info).faults.append(f"`{info.field_name}` is {replies.shown(written)}, not one of {words}")
        return known.get(said, default)

    return BeforeValidator(read)


def _names(most: int) -> tuple[Any, Any]:
    """The annotations of a list of names. An object with a name is taken for it."""

    def read(written: object, info: ValidationInfo) -> tuple[str, ...]:
        names = dict[str, None]()
        for part in replies.listed(written):
            name = replies.first_of(replies.fields_of(part), *_INNER) if isinstance(part, dict) else part
            if replies.text_of(name) and not replies.is_none(name):
                names[replies.name_of(name)] = None
            elif not replies.is_none(name):
                context_of(info).faults.append(f"`{info.field_name}` has {replies.shown(part)}, which is no name")
        if len(names) > most:
            context_of(info).faults.append(f"`{info.field_name}` has {len(names)} names; give at most {most}")
        return tuple(names)[:most]

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
_PLACE_RELATION = BeforeValidator(lambda said: RELATION_WORDS.get(replies.text_of(said).lower().replace("_", "-")))
_LANGUAGES = get_args(records.Language)
_LANGUAGE = BeforeValidator(lambda said: code if (code := replies.text_of(said)[:2].lower()) in _LANGUAGES else None)
_WAY = BeforeValidator(_way), WithJsonSchema(replies.nullable(replies.one_of(*WAYS)))


class Change(replies.Reply):
    """A change of the scene before anything moves, in words."""

    other_names: ClassVar = {"object": ("name", "label"), "targets": ("target",)}
    kind: Annotated[records.InterventionKind, _known(records.InterventionKind, _CHANGES)]
    object: Name
    relation: Annotated[records.PlaceRelation | None, _PLACE_RELATION] = None
    targets: Annotated[tuple[str, ...], *_names(2)] = ()

    @property
    def as_said(self) -> records.InterventionRequest:
        """As a request says it."""
        place = {"relation": self.relation, "targets": self.targets} if self.kind == "place" else {}
        return records.InterventionRequest.model_validate({"kind": self.kind, "object": self.object, **place})

    @pydantic.model_validator(mode="after")
    def _check_place(self) -> Self:
        count = 2 if self.relation == "between" else 1
        things = {replies.name_words(each) for each in (self.object, *self.targets)}
        if self.kind == "place" and (self.relation is None or not len(self.targets) == len(things) - 1 == count):
            raise ValueError("says not where to")
        return self


class Leg(replies.Reply):
    """A further leg of the motion."""

    other_names: ClassVar = {"way": ("direction",)}
    way: Annotated[tuple[records.Vector, float], *_WAY]
    distance: Distance = None
    duration: Seconds = None

    @property
    def as_said(self) -> records.MotionStepRequest:
        """As a request says it."""
        (direction, depth), ends = self.way, {"distance": self.distance, "duration": self.duration}
        return records.MotionStepRequest.model_validate({"direction": direction, "depth": depth, **ends})


class AlsoMoving(replies.Reply):
    """Another thing that is set moving at the same time."""

    other_names: ClassVar = {"object": ("name", "label"), "way": ("direction",)}
    object: Name
    kind: Annotated[records.MotionKind, _known(records.MotionKind, _KINDS, default="linear")]
    way: Annotated[tuple[records.Vector, float] | None, *_WAY] = None

    @property
    def as_said(self) -> records.OtherMotionRequest:
        """As a request says it."""
        direction, depth = self.way if self.way is not None and self.kind in records.DIRECTED_KINDS else (None, 0.0)
        return records.OtherMotionRequest.model_validate(
            {"object": self.object, "kind": self.kind, "direction": direction, "depth": depth}
        )

    @pydantic.model_validator(mode="after")
    def _check_way(self) -> Self:
        if self.kind == "place" or (self.kind in records.DIRECTED_KINDS and self.way is None):
            raise ValueError("says not which way")
        return self


class Identified(replies.Reply):
    """What is asked and what moves, in words; nothing about where it is. Null is what the reply does not say."""

    other_names: ClassVar = {"object": _NAMES}
    object: Annotated[str, WithJsonSchema(replies.nullable({"type": "string"}))]
    others: Annotated[tuple[str, ...], *_names(MAX_NAMED)]
    asked: records.Asked | None
    kind: Annotated[records.MotionKind | None, _known(records.MotionKind, _KINDS)]
    changes: Annotated[tuple[Change, ...], replies.all_of(Change)] = ()
    speed: Speed = None
    distance: Distance = None
    duration: Seconds = None
    until: Annotated[records.Until | None, _known(records.Until)] = None
    then: Annotated[tuple[Leg, ...], replies.all_of(Leg)] = ()
    also_moving: Annotated[tuple[AlsoMoving, ...], replies.all_of(AlsoMoving)] = ()
    language: Annotated[records.Language | None, _LANGUAGE] = None
    warnings: Annotated[SkipJsonSchema[tuple[str, ...]], BeforeValidator(lambda _: ())] = ()  # of what was left out

    @field_validator("object", mode="before")
    @classmethod
    def _check_name(cls, written: Any) -> str:
        name = replies.text_of(written)
        if len(name) > replies.MAX_NAME:
            raise replies.ReplyError(f"`object` has {len(name)} characters; a few words are enough")
        if _LETTERED.match(name) or (len(name.split()) <= 3 and plain(name) in _ANSWERS):
            raise replies.ReplyError(f"'{name}' answers the question; name the object that moves instead")
        if _DENIAL.search(name) or name.lower().strip(" .") in _POINTING:
            raise replies.ReplyError(f"'{name[:80]}' names no one object; give a few words that single it out, or null")
        if not re.search(r"[^\W\d_]{2}|[^\W\d_\x00-\x7f]", name):
            raise replies.ReplyError(f"'{name}' names no object; say in words what moves")
        return name

    @field_validator("asked", mode="before")
    @classmethod
    def _read_asked(cls, written: Any, info: ValidationInfo) -> records.Asked | None:
        """What is asked; null where any of it cannot be read: no verdict is better than one on another question."""
        if replies.is_none(written):
            return None
        if len(parts := replies.listed(written)) == 1:
            (written,) = parts
        given = replies.fields_of(written)
        if not given:  # a question such as "Will it hit the mug?"
            sentence, others = replies.text_of(written), info.data.get("others", ())
            words = set(replies.name_words(sentence))
            named = [name for name in others if set(replies.name_words(name)) <= words]
            if len(named) == 1 or (not named and _ANY.search(sentence)):
                given = {"relation": sentence, "target": "".join(named)}
        fields = {name: given[name] for name in records.Asked.model_fields if not replies.is_none(given.get(name))}
        if "form" in fields:
            form = replies.text_of(fields["form"]).lower().replace("_", "-").replace(" ", "-")
            fields["form"] = _FORMS.get(form, form)
        relation = replies.text_of(fields.get("relation")).lower().strip(" .").replace("_", " ")
        told = {(name, denied) for name, denied, words in _RELATIONS if re.search(rf"\b(?:{words})\b", relation)}
        if relation in get_args(records.AskedRelation):
            fields["relation"] = relation
        elif len(told) == 1 and not _NOT.search(relation):
            ((fields["relation"], denied),) = told
            fields |= {"negated": True} if denied else {}
        if "within" in fields:
            fields["within"] = positive(fields["within"], "s") or fields["within"]
        try:
            return records.Asked.model_validate(fields)
        except pydantic.ValidationError as error:
            fault = ".".join(map(str, error.errors()[0]["loc"]))
            context_of(info).faults.append(f"`asked` is {replies.shown(written)}, of which `{fault}` cannot be read")
            return None

    @property
    def must_be_found(self) -> tuple[str, ...]:
        """The things that are changed, move at the same time, or are asked about."""
        names = [name for change in self.changes for name in (change.object, *change.targets)]
        names += [each.object for each in self.also_moving]
        if self.asked is not None:
            names += [name for name in (self.asked.subject, self.asked.target, *self.asked.among) if name is not None]
        return tuple(names)

    @property
    def motion(self) -> dict[str, Any]:
        """Fields of a motion, as far as the reply says them."""
        if not self.object:
            return {}
        kind = self.kind or "linear"
        said = [name for name in SAID_ALIKE if name != "speed" or kind in records.DIRECTED_KINDS]
        return {
            "kind": kind,
            **{name: value for name in said if (value := getattr(self, name)) is not None},
            "steps": tuple(each.as_said for each in self.then),
            "others": tuple(each.as_said for each in self.also_moving),
        }


NOTHING_IDENTIFIED = Identified.model_construct(object="", others=(), asked=None, kind=None)


def identified_by_words(given: ReaderInput) -> Identified | None:
    """What the words of a question say of all that is asked here; None where they leave something open."""
    words, is_changed = given.words, given.given.interventions is not None
    if words is None or not words.is_whole or words.reading.grounding is None or words.reading.motion is None:
        return None
    read = words.reading
    return Identified.model_construct(
        object=words.reading.grounding.object,
        others=tuple(each.object for each in read.objects),
        asked=read.asked if given.given.asked is None else None,
        kind=words.reading.motion.kind,
        changes=tuple(Change.model_construct(**dict(each)) for each in read.interventions or () if not is_changed),
    )


def identify_call(given: ReaderInput, image: EncodedImage, reasoning_length: int) -> PromptCall[Identified | None]:
    """The call that asks which object moves, in words, and of the rest what neither the caller nor the words say."""
    asked = None if given.words is None or given.given.asked is not None else given.words.reading.asked
    if asked is not None and (asked.among or asked.form.startswith("which")):
        asked = None  # the words do not say which things these are
    place, said = given.given.grounding, set[str]()
    is_placed = place is not None and place.bbox is not None  # then all but the motion is known
    if is_placed or asked is not None or given.given.asked is not None:
        said.add("asked")
    if is_placed or given.given.interventions is not None:
        said.add("changes")
    if not given.motion_wanted:
        said.update(_MOTION)
    if not any(map(str.isdigit, given.question)):
        said.update(_NUMBERS)
    fields = {name: each for name, each in replies.fields_schema(Identified).items() if name not in said}
    example = {"reasoning": "...", **{name: _EXAMPLE[name] for name in fields if name in _EXAMPLE}}
    inputs: dict[str, object] = {
        "question": given.question,
        "wants_asked": "asked" in fields,
        "wants_changes": "changes" in fields,
        "wants_motion": "kind" in fields,
        "wants_numbers": "speed" in fields,
        "objections": tuple(" ".join(each.split()) for each in given.objections),
        "example": json.dumps(example),
    }
    schema = replies.schema_of(fields, reasoning_length=reasoning_length)
    return PromptCall("identify", inputs, (image.jpeg,), schema, partial(read_identified, said=said, asked=asked))


def read_identified(reply: str, said: Collection[str] = (), asked: records.Asked | None = None) -> Identified | None:
    """The object that a reply names; None where it says that there is none. Raises `ReplyError`.

    Fields that are `said` elsewhere are not read; `asked` is what the question's words ask.
    """
    text = replies.without_thinking(reply)
    values = replies.values_in(text)
    objects = [value for value in values if any(replies.objects_in(value))]
    written = _written(text, values, objects)
    names = [replies.text_of(fields["object"]) for fields in written]
    if _says_nothing_moves(names, text, values):
        return None
    if not names:
        raise replies.ReplyError("`object` is missing; name the one object that moves, and do not answer the question")
    if len(set(map(replies.name_words, names))) > 1:
        raise replies.ReplyError(f"several objects are named ({', '.join(names)}); name the one that moves")
    context = ReadingContext(faults=[] if objects else ["it is no JSON object, so that fields are missing"])
    fields = {name: held for name, held in written[-1].items() if name not in said}
    found = _consistent(Identified.model_validate(fields, context=context), asked)
    found = found.model_copy(update={"warnings": context.left_out})
    if context.faults:
        raise replies.ReplyError("; ".join(context.faults), found)
    return found


def _written(text: str, values: Sequence[object], objects: Sequence[object]) -> list[dict[str, Any]]:
    """The fields of each reply in a text, with `object`: of its JSON objects, else of its lists, else of its prose."""
    for among in (objects, values):  # words in brackets may be part of the prose around the object
        if found := [fields for value in among for fields in _replies(value)]:
            return found
    is_prose = not any(isinstance(value, dict | list) or value is None for value in values)
    return [{"object": name} for name in _names_in_prose(text)] if is_prose else []


def _says_nothing_moves(names: Sequence[str], text: str, values: Sequence[object]) -> bool:
    """Whether a reply says, instead of the name of what moves, that there is nothing of the kind."""
    if names:
        return all(map(_ABSENT.fullmatch, names))
    # A value that has the field says so there, any other as a whole.
    said = (replies.first_of({"": value} | replies.fields_of(value), *_NAMES, "") for value in values)
    return _ABSENT.fullmatch(text) is not None or any(map(replies.is_none, said))


def _consistent(found: Identified, asked: records.Asked | None) -> Identified:
    """A reply whose things have one name each, without what contradicts the rest of it.

    `asked` is what the question's words ask, which goes before what the reply says of it.
    """
    mover, asked = replies.name_words(found.object), asked or found.asked
    others = tuple(name for name in found.others if replies.name_words(name) != mover)

    def one(name: str | None) -> str | None:
        return name and (replies.named_among(name, (found.object, *others)) or name)

    if asked is not None:
        subject = one(asked.subject)
        update: dict[str, Any] = {
            "subject": None if subject == found.object else subject,  # null is the mover
            "target": one(asked.target),
            "among": tuple(map(one, asked.among)),
        }
        asked = asked.model_copy(update=update)
    is_put = any(each.kind == "place" and replies.name_words(each.object) == mover for each in found.changes)
    kind = None if found.kind == "place" and not is_put else found.kind
    return found.model_copy(update={"others": others, "asked": asked, "kind": kind})


def _replies(value: object) -> Iterator[dict[str, Any]]:
    """The fields of each object in a value that names what moves, whatever it is wrapped in; words of a list alone."""
    words = [part for part in replies.listed(value) if isinstance(part, str)] if isinstance(value, list) else []
    yield from ({"object": word} for word in words)
    for fields in replies.objects_in(value, "changes", "also_moving"):
        for each in replies.listed(replies.first_of(fields, *_NAMES)):
            inner = replies.fields_of(each)
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
