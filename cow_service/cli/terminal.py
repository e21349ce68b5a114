"""Text of others on a terminal."""

from __future__ import annotations


def printable(text: str) -> str:
    """The text without what a terminal would obey: control characters, escapes, marks that turn the direction."""
    return "".join(character if character.isprintable() or character == "\n" else "\ufffd" for character in text)
