"""Reads a model's reply: finds the JSON anywhere in the text, and parses it into the models that a prompt declares.

Models fence their JSON, quote it as Python does, think aloud before it or write prose around it. What is malformed is
repaired by a library, but only where its brackets close: a reply that was cut short must not become a shorter number.
"""

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from typing import Any, ClassVar, TypeGuard, TypeVar, cast

from pydantic import BaseModel, BeforeValidator, ConfigDict, ValidationError, ValidationInfo, model_validator

Schema = dict[str, Any]

MAX_LENGTH = 20_000  # characters behind the thinking; a longer reply is not looked through
MAX_NAME = 120  # characters of an object's name, and of any text without another limit
MAX_LISTED = 8  # entries of a list without another limit
_FENCE = re.compile(r"```[\w+-]*[ \t]*\n?(.*?)```", re.DOTALL)
_THOUGHT = re.compile(r"</(?:think|thinking|thought|reasoning|seed:think)>|◁/think▷|<\|channel\|>final<\|message\|>")
_THINKING = re.compile(r"<(?:think|thinking|thought|seed:think)>|◁think▷|<\|channel\|>analysis")
_OPENING = {"{": "}", "[": "]"}
_NOTHING = frozenset({"", "none", "null", "n/a", "not found", "nothing", "...", "\u2026"})
_NO_JSON = object()
_DETERMINERS = frozenset({"the", "a", "an", "this", "that"})
_BEFORE_STRING, _AFTER_STRING = frozenset("{[,:("), frozenset("}],:)")


class ReplyError(Exception):
    """A reply cannot be used. The message says why, in words that the model can act on.

    `usable` is what can be used of it: such a reply is asked for again once, then taken without the rest. Not a
    `ValueError`: raised in a validator, it passes through pydantic as it is.
    """

    def __init__(self, message: str, usable: object = None) -> None:
        super().__init__(message)
        self.usable = usable


class Reply(BaseModel):
    """An object that a prompt asks for. Its JSON schema, which goes to the server, requires every field.

    Reading is more tolerant: names of fields may be spelled and capitalised differently, and a missing field is null.
    """

    model_config = ConfigDict(frozen=True)
    other_names: ClassVar[dict[str, tuple[str, ...]]] = {}  # under which models give a field, too

    @model_validator(mode="before")
    @classmethod
    def _find_fields(cls, written: object) -> object:
        fields = fields_of(written)
        return {name: first_of(fields, name, *cls.other_names.get(name, ())) for name in cls.model_fields}


R = TypeVar("R", bound=Reply)


def all_of(kind: type[R]) -> BeforeValidator:
    """Reads a list of objects, or one alone; entries that name nothing count as none.

    Raises `ReplyError` for any other one that cannot be used: without it, another world would be simulated.
    """
    own = next(name for name in ("object", *kind.model_fields) if name in kind.model_fields)

    def read(written: object, info: ValidationInfo) -> tuple[R, ...]:
        found: list[R] = []
        for part in listed(written):
            fields = fields_of(part) or {own: part}
            if is_none(first_of(fields, own, *kind.other_names.get(own, ()))):
                continue
            try:
                found.append(kind.model_validate(fields, context=info.context))
            except ValidationError as error:
                fault = error.errors()[0]
                where = ".".join(map(str, fault["loc"])) or "it"
                raise ReplyError(
                    f"`{info.field_name}` has {shown(part)}, of which {where} cannot be read; give it in the form that "
                    "is asked for, or [] if the question does not say it"
                ) from error
        if len(found) > MAX_LISTED:
            raise ReplyError(f"`{info.field_name}` has {len(found)} entries; give at most {MAX_LISTED}")
        return tuple(found)

    return BeforeValidator(read)


def schema_of(fields: Mapping[str, Schema] | None = None, *, reasoning_length: int) -> Schema:
    """The JSON schema of a reply with `reasoning` and these fields, in the few forms that strict servers take."""
    return closed({"reasoning": words(reasoning_length), **(fields or {})})


def closed(fields: Mapping[str, Schema]) -> Schema:
    """The schema of an object with all of these fields and no others."""
    properties = json.loads(json.dumps(dict(fields)))  # copies: pydantic-ai empties a schema that stands at two places
    return {"type": "object", "properties": properties, "required": [*fields], "additionalProperties": False}


def fields_schema(kind: type[Reply]) -> dict[str, Schema]:
    """The schemas of a model's fields, none of them optional, and without limits, which some servers refuse."""
    whole = kind.model_json_schema()

    def strict(schema: Schema) -> Schema:
        if "$ref" in schema:
            schema = whole["$defs"][schema["$ref"].rpartition("/")[2]]
        if "anyOf" in schema:
            return {"anyOf": [strict(each) for each in schema["anyOf"]]}
        if "properties" in schema:
            return closed({name: strict(each) for name, each in schema["properties"].items()})
        kept = {key: schema[key] for key in ("type", "enum") if key in schema}
        return kept | ({"items": strict(schema["items"])} if "items" in schema else {})

    return strict(whole)["properties"]


def words(longest: int) -> Schema:
    """The schema of a text with a maximum length."""
    return {"type": "string", "maxLength": longest}


def one_of(*values: str) -> Schema:
    """The schema of one of some words."""
    return {"type": "string", "enum": list(values)}


def nullable(schema: Schema) -> Schema:
    """That, or null."""
    return {"anyOf": [schema, {"type": "null"}]}


def without_thinking(text: str) -> str:
    """The reply behind its thinking. Raises `ReplyError` if there is nothing else, or far too much."""
    ends = list(_THOUGHT.finditer(text))
    if not ends and _THINKING.search(text):
        raise ReplyError("the reply ended while it was still thinking; think less and give the JSON object")
    said = (text[ends[-1].end() :] if ends else text).strip()
    if not said:
        raise ReplyError("the reply is empty; give the JSON object")
    if len(said) > MAX_LENGTH:
        raise ReplyError(f"the reply has {len(said)} characters; answer in a few sentences")
    return said


def values_in(text: str) -> tuple[Any, ...]:
    """Every JSON object and list in a reply, in order; those in code fences alone where there are any.

    Numbers, words and null are values only where they are the whole reply.
    """
    whole = _parsed(text)
    if whole is not _NO_JSON:
        inner = _parsed(whole) if isinstance(whole, str) else _NO_JSON  # a string may hold the JSON that was meant
        return (whole if inner is _NO_JSON else inner,)
    fenced = [value for block in _FENCE.findall(text) for value in _bracketed(block)]
    return tuple(fenced or _bracketed(text))


def is_broken_json(said: str) -> bool:
    """Whether a text without a value in it began as JSON: cut short, it is no prose to read answers from."""
    return re.match(r"\W*(?:json\s*)?\{", said) is not None


def fields_of(value: object) -> dict[str, Any]:
    """An object's fields with plain names: lower case, words joined by _; none where the value is no object."""
    if not isinstance(value, dict):
        return {}
    fields = cast("dict[object, Any]", value)
    return {"_".join(re.split(r"[\s_-]+", str(name).strip().lower())): held for name, held in fields.items()}


def first_of(fields: dict[str, Any], *names: str) -> Any:
    """The value of the first of some fields that is there; None if none is."""
    return next((fields[name] for name in names if name in fields), None)


def objects_in(value: object, *closed: str) -> Iterator[dict[str, Any]]:
    """The fields of a value's objects, the outer ones first; what the fields `closed` hold is not looked into."""
    for part in listed(value):
        if isinstance(part, list):
            yield from objects_in(part, *closed)
        fields = fields_of(part)
        if fields:
            yield fields
        for key, held in fields.items():
            if key not in closed and isinstance(held, dict | list):
                yield from objects_in(held, *closed)


def listed(written: object) -> list[Any]:
    """A field that should hold a list; anything else is a list of one, and nothing an empty one."""
    return cast("list[Any]", written) if isinstance(written, list) else [] if written is None else [written]


def is_none(value: object) -> bool:
    """Whether a field says that there is nothing: null, an empty list, or a word for it."""
    return value is None or value == [] or (isinstance(value, str) and value.strip().lower() in _NOTHING)


def is_number(value: object) -> TypeGuard[int | float]:
    """Whether a value is a number; true and false are none."""
    return isinstance(value, int | float) and not isinstance(value, bool)


def truth_of(value: object) -> bool | None:
    """A field that should hold true or false, also as a word; None if it holds neither."""
    meanings = {"true": True, "yes": True, "false": False, "no": False}
    return value if isinstance(value, bool) else meanings.get(text_of(value).lower())


def text_of(value: object) -> str:
    """A field that should hold words, as one line, without what no text may hold; empty if it holds nothing visible."""
    if not isinstance(value, str) or not any(each.isprintable() and not each.isspace() for each in value):
        return ""
    return " ".join(value.encode(errors="replace").decode().replace("\0", " ").split())


def name_of(value: object) -> str:
    """A field that should hold the name of an object."""
    return text_of(value)[:MAX_NAME]


def name_words(name: str) -> tuple[str, ...]:
    """The words of an object's name without determiners, lower case: names with the same words are the same."""
    return tuple(word for word in re.findall(r"\w+", name.lower()) if word not in _DETERMINERS)


def named_among(name: str, known: Sequence[str]) -> str | None:
    """The one of the known names that has the words of a name, or the only one that is part of it or extends it."""
    words = set(name_words(name))
    held = [(set(name_words(each)), each) for each in known]
    same = [each for other, each in held if other == words]
    alike = [each for other, each in held if words and other and (other < words or words < other)]
    return same[0] if same else alike[0] if len(alike) == 1 else None


def shown(written: object) -> str:
    """What was written, in quotation marks and short enough for a message."""
    return f"'{' '.join(str(written).split())[:80]}'"


def _parsed(text: str) -> Any:
    try:
        return json.loads(text)
    except (ValueError, RecursionError):
        return _NO_JSON


def _bracketed(text: str) -> list[Any]:
    from json_repair import repair_json  # noqa: PLC0415 # of an extra, without which the server starts all the same

    values: list[Any] = []
    for span in _spans(text):
        with suppress(ValueError, RecursionError):
            values.append(repair_json(span, return_objects=True))  # which does not change well-formed JSON
    return [value for value in values if isinstance(value, dict | list)]


def _spans(text: str) -> Iterator[str]:
    """Outermost bracketed parts of a text, strings inside them left alone; up to the first that does not close.

    What stands inside a bracket that never closes may be half of what was meant. One pass: a reply may be nothing but
    opening brackets.
    """
    waiting: list[str] = []
    start, quote, skipped = 0, "", False
    for at, char in enumerate(text):
        if skipped:
            skipped = False
        elif quote:
            skipped = char == "\\"
            # An unescaped quotation mark inside a string is not followed by what follows a string.
            if char == quote and text[at + 1 : at + 40].lstrip()[:1] in _AFTER_STRING:
                quote = ""
        elif waiting and char in "\"'" and text[max(0, at - 40) : at].rstrip()[-1:] in _BEFORE_STRING:
            quote = char
        elif char in _OPENING:
            start = start if waiting else at
            waiting.append(_OPENING[char])
        elif waiting and char == waiting[-1]:
            waiting.pop()
            if not waiting:
                yield text[start : at + 1]
