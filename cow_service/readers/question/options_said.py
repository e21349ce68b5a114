"""What the options of a question say: that what is asked happens or does not, which object, or none."""

from __future__ import annotations

import re

from cow_service.readers.options import plain
from cow_service.readers.question import lexicon as lex
from cow_service.readers.question.phrases import ObjectPhrase
from cow_service.readers.question.sentences import parse_noun_phrase
from cow_service.records import Asked

_YES = re.compile(r"(?:yes\b(?! (?:and|or) no).*|true)", re.DOTALL | re.IGNORECASE)
# "No contact" says something of the event, "No, it stops" of what is asked.
_NO = re.compile(
    r"no\s*(?:[,.;:!()\u2013\u2014-].*)?|no (?:it|the|this|that|because|they)\b.*|false", re.DOTALL | re.IGNORECASE
)
_TOUCHING = lex.SETS["touching"]
_COVERING = lex.words("hidden hide hides occluded occlude occludes occlusion covered obscured concealed obstructed")
_MISSING = lex.words("miss misses missed missing avoid avoids avoided untouched")
_SEEN = lex.words("visible unobstructed unoccluded uncovered")
_NEGATIONS = lex.words("not no never n't without nothing neither")
# They change nothing beside such a word.
_FILLERS = lex.SETS["fillers"]
_ANY_WORDS = lex.words("anything something any object objects nothing")
_PASSIVE = lex.words("is are be get gets stays stay remains remain being")
_BARE = {
    "it will": True, "it does": True, "it would": True, "it will not": False, "it does not": False,
    "it would not": False, "it can not": False,
}  # fmt: skip
_NONE = re.compile(
    r"none|nothing|neither|never|not at all|no (?:object|objects|thing|collision|contact|one|time|hit)"
    r"|none of (?:them|these|the above|the objects)|neither of (?:them|these|the two)"
    r"|(?:it |the \w+(?: \w+)? )?(?:hits|touches|reaches) (?:nothing|none|none of them)"
    r"|(?:it |the \w+(?: \w+)? )?misses (?:it|both|all|everything|both of them|all of them)"
    r"|(?:it |the \w+(?: \w+)? )?never (?:hits|touches|reaches)(?: (?:it|anything|any of them))?"
    r"|(?:it |the \w+(?: \w+)? )?(?:does|will) not(?: (?:hit|touch|reach|collide with))?"
    r"(?: (?:it|anything|any object|any of them|happen))?"
)
_SEVERAL = re.compile(r"\b(?:both|all|several|more than one|at the same time|simultaneously|each)\b", re.IGNORECASE)


def says_it_happens(text: str, asked: Asked) -> bool | None:
    """Whether an option says that what is asked happens; None where it does not say so plainly."""
    bare = text.strip().rstrip(".!")
    if _YES.fullmatch(bare) or _NO.fullmatch(bare):
        return _YES.fullmatch(bare) is not None
    said = _unfolded(text)
    if said in _BARE:
        return _BARE[said]
    event = _says_event(said.split(), asked)
    return None if event is None else event != asked.negated


def _says_event(words: list[str], asked: Asked) -> bool | None:
    """Whether it says that the mover touches, hides or is hidden by the thing asked about, in words of that alone."""
    yes, no = (_TOUCHING, _MISSING) if asked.relation == "touches" else (_COVERING, _SEEN)
    about = [at for at, word in enumerate(words) if word in yes | no]
    if len(about) != 1:
        return None
    known = yes | no | _NEGATIONS | _FILLERS
    known |= _ANY_WORDS if asked.target is None else set(plain(asked.target).split())
    if asked.target is not None:
        known -= {"nothing"}
    before, after = words[: about[0]], words[about[0] + 1 :]
    acting = asked.relation != "covered" and _PASSIVE.isdisjoint(before)  # then the mover is spoken of, by any name
    if not set(after if acting else words) <= known:
        return None
    turned = sum(word in _NEGATIONS for word in words)
    return None if turned > 1 else (words[about[0]] in yes) != (turned == 1)


def names_none(text: str) -> bool:
    """Whether an option says that there is no such object, or that it never happens."""
    return _NONE.fullmatch(_unfolded(text)) is not None


def names_several(text: str) -> bool:
    """Whether an option says that it is more than one object."""
    return _SEVERAL.search(text) is not None and not names_none(text)


def may_name(phrase: ObjectPhrase, name: str) -> bool:
    """Whether a phrase may mean the object of that name: they share a colour, noun or number, and differ in none."""
    other = parse_noun_phrase(name)
    if other is None:
        return False
    if plain(phrase.text) == plain(name):
        return True
    nouns = [each.head if each.head not in lex.GENERIC else None for each in (phrase, other)]
    pairs = ((phrase.colour, other.colour), tuple(nouns), (phrase.number, other.number))
    said = [(one, two) for one, two in pairs if one is not None and two is not None]
    return bool(said) and all(one == two for one, two in said)


def _unfolded(text: str) -> str:
    """Lower-case words alone, "won't" as "will not"."""
    return re.sub(r"\b(would|does|is|can|will)n? t\b", r"\1 not", plain(text).replace("won t", "will not"))
