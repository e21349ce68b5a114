"""What a noun says of whether a thing is an open container, and of which form."""

from __future__ import annotations

from typing import Literal

from cow_service.readers.question.lexicon import SETS, words
from cow_service.readers.question.sentences import parse_noun_phrase
from cow_service.readers.question.shapes import shape_of

ContainerForm = Literal["round", "square", "none", "unknown"]

_ROUND = SETS["round"]
_SQUARE = words("box crate drawer carton case chest tray suitcase bag cart sink crib bathtub package parcel")


def container_form(name: str) -> ContainerForm:
    """Round or square for what is called a container, `none` for a solid thing, `unknown` where the noun says nothing.

    A box is a container: whoever means a solid one does not ask what goes into it.
    """
    phrase = parse_noun_phrase(name)
    head = "" if phrase is None else phrase.head
    if head in _ROUND:
        return "round"
    if head in _SQUARE:
        return "square"
    return "unknown" if shape_of(name) is None else "none"
