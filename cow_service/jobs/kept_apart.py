"""The trajectory of a job is kept once: the result of its stage and that of the whole job have a mark in its place.

Both are JSON texts. A trajectory is most of either, and to parse it only to write it again takes long.
"""

from __future__ import annotations

MARK = '"kept apart"'  # a JSON string where else an object is


def without(text: str, name: str, trajectory: str) -> str:
    """A JSON text in which the trajectory, the value of a field, is replaced by the mark; unchanged without it."""
    return text.replace(f'"{name}":{trajectory}', f'"{name}":{MARK}', 1)


def lacks(text: str, name: str) -> bool:
    """Whether the trajectory of a JSON text is kept apart. Inside a string, quotes would stand behind backslashes."""
    return f'"{name}":{MARK}' in text


def whole(text: str, name: str, trajectory: str) -> str:
    """The JSON text with its trajectory."""
    return text.replace(f'"{name}":{MARK}', f'"{name}":{trajectory}', 1)
