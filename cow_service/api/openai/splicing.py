"""Changes single members of a JSON object in its text: every other byte stays as the sender wrote it."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

_SPACE = re.compile(r"[ \t\r\n]*")
_DECODER = json.JSONDecoder()
SEPARATORS = (",", ":")


@dataclass(frozen=True)
class Member:
    """A member of an object: its key, and where it and its value stand in the text."""

    key: str
    start: int  # of the key
    value: int  # of the value
    end: int


def as_json(value: Any) -> str:
    """A value as compact JSON."""
    return json.dumps(value, separators=SEPARATORS, ensure_ascii=False)


def spliced(text: str, replaced: Mapping[str, str], *, dropped: str = "") -> str:
    """The object with these members replaced, each by JSON, or added at its end; and without the one named `dropped`.

    `text` must be one well-formed JSON object whose keys differ.
    """
    members = list(_members(text))
    edits: list[tuple[int, int, str]] = []
    for place, member in enumerate(members):
        if member.key in replaced:
            edits.append((member.value, member.end, replaced[member.key]))
        elif member.key == dropped:
            after = members[place + 1].start if place + 1 < len(members) else member.end
            edits.append((members[place - 1].end, member.end, "") if place else (member.start, after, ""))
    new = [f"{as_json(key)}:{value}" for key, value in replaced.items() if key not in {m.key for m in members}]
    if new:
        kept = [member for member in members if member.key != dropped]
        end = members[-1].end if members else text.index("{") + 1
        edits.append((end, end, ("," if kept else "") + ",".join(new)))
    parts: list[str] = []
    at = 0
    for start, end, value in edits:
        parts += [text[at:start], value]
        at = end
    return "".join([*parts, text[at:]])


def _members(text: str) -> Iterator[Member]:
    at = _after_space(text, text.index("{") + 1)
    while text[at] != "}":
        key, end = _DECODER.raw_decode(text, at)
        value = _after_space(text, _after_space(text, end) + 1)  # behind the colon
        _, stop = _DECODER.raw_decode(text, value)
        yield Member(key, at, value, stop)
        at = _after_space(text, stop)
        at = _after_space(text, at + 1) if text[at] == "," else at


def _after_space(text: str, at: int) -> int:
    found = _SPACE.match(text, at)
    return at if found is None else found.end()
