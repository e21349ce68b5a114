"""A trajectory is kept once: the result of its stage and that of the whole job have a mark in its place.

Both are JSON texts. A trajectory is most of either, and to parse it only to write it again takes long. The mark names
the stage's key: a job that is computed again from an earlier stage on may come to another trajectory.
"""

from __future__ import annotations

import re


def without(text: str, name: str, trajectory: str, key: str) -> str:
    """A JSON text in which the trajectory, the value of a field, is replaced by a mark; unchanged without it.

    `key`: SHA-256 digits, under which the trajectory is kept.
    """
    return text.replace(f'"{name}":{trajectory}', _mark(name, key), 1)


def key_in(text: str, name: str) -> str | None:
    """The key under which the trajectory of a JSON text is kept; None where it is in the text itself.

    Inside a string, quotes would stand behind backslashes.
    """
    found = re.search(_mark(name, "([0-9a-f]{64})"), text)
    return None if found is None else found[1]


def whole(text: str, name: str, trajectory: str, key: str) -> str:
    """The JSON text with its trajectory."""
    return text.replace(_mark(name, key), f'"{name}":{trajectory}', 1)


def _mark(name: str, key: str) -> str:
    return f'"{name}":"kept apart: {key}"'
