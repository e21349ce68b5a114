"""Reads what a question says of the arrow drawn over the image: the motion goes along it, or against it.

An arrow may also only mark an object ("the ball next to the arrow"); that is no direction.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

from cow_service.readers.question import lexicon as lex
from cow_service.readers.question.phrases import Item, flatten, key_at, phrase_at

ArrowSense = Literal["along", "against"]

_OPPOSITE = lex.words(
    "opposite opposing opposed against reverse reversed inverse inversely backward backwards contrary tail"
)
_ARROW_CUES = lex.words(
    "along direction way path trajectory where as per according toward towards follow follows following"
)
_STOPS = frozenset(".,;:?!")
_FROM_ITS_END = lex.words("from where the a direction of way tip head point arrow that in which") | lex.COLOURS.keys()
_BESIDE = lex.words("with near beside under above below at behind")
_SHOWN = lex.words("indicated shown marked drawn depicted pointed specified given")


def is_arrow(found: Sequence[Item], at: int) -> bool:
    """Whether a noun phrase names the drawn arrow, or the direction that is shown in the image."""
    names = found[at].words
    if any(word.startswith("arrow") for word in names):
        return True
    shown = {*names, key_at(found, at + 1)}
    return bool(names) and names[-1] in {"direction", "path"} and not _SHOWN.isdisjoint(shown)


def read_arrow(found: Sequence[Item]) -> ArrowSense | None:
    """Along or against the drawn arrow; None where none is named, or where it only marks an object."""
    for at in range(len(found)):
        sense = _arrow_sense(found, at) if is_arrow(found, at) else None
        if sense is not None:
            return sense
    return None


def _arrow_sense(found: Sequence[Item], at: int) -> ArrowSense | None:
    begin = at
    while begin > 0 and at - begin < 12 and found[begin - 1].key not in _STOPS:
        begin -= 1
    end = at + 1
    while end < len(found) and end - at < 7 and found[end].key not in lex.AUXILIARIES | _STOPS:
        end += 1
    own = list(found[at].words)
    before, after = flatten(found[begin:at]) + own, flatten(found[at + 1 : end])
    if has_opposite(before) or has_opposite(after[:3]) or _flees(before):
        return "against"
    if _only_marks(found, at):
        return None
    if not _ARROW_CUES.isdisjoint(before) or key_at(found, at - 1) in {"by", "in"}:
        return "along"
    points_at = "point" in map(lex.lemma, after) and "at" in after
    shows = any(lex.lemma(word) in {"show", "indicate", "point"} for word in after[:2])
    first = at == begin or key_at(found, at - 1) in lex.CONDITIONALS | {"that"}
    return "along" if shows and first and not points_at else None


def has_opposite(flat: Sequence[str]) -> bool:
    """Whether some words turn a direction around; "the opposite side" is a place and does not."""
    return any(word in _OPPOSITE and "side" not in flat[at + 1 : at + 2] for at, word in enumerate(flat))


def _flees(before: Sequence[str]) -> bool:
    """ "away from where the arrow points", but not "away from the camera along the arrow"."""
    if "away" not in before:
        return False
    return all(word in _FROM_ITS_END for word in before[before.index("away") + 1 :])


def _only_marks(found: Sequence[Item], at: int) -> bool:
    """ "the ball indicated by the arrow", "the ball next to the arrow": the arrow singles an object out."""
    before = key_at(found, at - 1)
    if before in _BESIDE or key_at(found, at - 2) == "next":
        return True
    marked = before == "by" and key_at(found, at - 2) in lex.VERBS
    noun = phrase_at(found, at - 3)
    return marked and noun is not None and noun.head not in lex.ABSTRACT
