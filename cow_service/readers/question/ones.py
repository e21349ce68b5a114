"""What "the red one" is one of: "which cone is hit first, the red one or the blue one?"."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from cow_service.readers.question import lexicon as lex
from cow_service.readers.question.phrases import Item, ObjectPhrase, key_at

_REFERRING = frozenset([("the", "latter"), ("the", "former")])
_OTHER = frozenset([("the", "other", "one"), ("the", "other")])


def with_nouns(found: Sequence[Item]) -> list[Item]:
    """The items, where a reference has what it means.

    "The latter" is what was named last, "the other one" is of the kind named, and "the red one" of the kind that is
    asked for, or of that of all things before it.
    """
    kinds = {_kind_of(item.phrase) for at, item in enumerate(found) if item.phrase and _is_asked_for(found, at)} - {""}
    before: set[str] = set()
    said: list[Item] = []
    things: list[Item] = []
    for item in found:
        nouns, phrase = kinds or before, item.phrase
        if item.words in _REFERRING and len(things) > 1:
            meant = things[-1] if item.words == ("the", "latter") else things[-2]
            said.append(replace(item, phrase=meant.phrase, words=meant.words))
            continue
        if item.key == "that" and things and _acts(found, len(said)):
            said.append(replace(item, key="", phrase=things[-1].phrase, words=things[-1].words))
            continue
        if item.words[:1] == ("that",) and phrase is not None and (again := _last_like(phrase, things)):
            said.append(replace(item, phrase=again, words=("that", *again.text.split())))
            continue
        if item.words in _OTHER and len(nouns) == 1:
            noun = next(iter(nouns))
            other = ObjectPhrase(f"other {noun}", None, noun)
            said.append(replace(item, phrase=other, words=("the", "other", *noun.split())))
            continue
        if phrase is not None and phrase.is_thing and phrase.noun and all(phrase != each.phrase for each in things):
            things.append(item)
        if phrase is not None and kinds and _is_bare_colour(item):
            phrase = replace(phrase, noun=None)  # "which mug does it hit first, the blue or the white?"
        if phrase is not None and phrase.noun is None and _singles_out(item, phrase) and len(nouns) == 1:
            said.append(replace(item, phrase=_of_kind(phrase, next(iter(nouns)))))
        else:
            said.append(item)
            before |= {_kind_of(phrase)} - {""}
    return said


def _last_like(phrase: ObjectPhrase, things: Sequence[Item]) -> ObjectPhrase | None:
    """ "That mug": the mug that was named last."""
    if phrase.noun is None or phrase.text.lower() != phrase.noun:
        return None
    return next((each.phrase for each in reversed(things) if each.phrase and each.phrase.noun == phrase.noun), None)


def _acts(found: Sequence[Item], at: int) -> bool:
    """ "Will that then knock into the cube?": what was named last."""
    verb = lex.lemma(key_at(found, at + 1 + (key_at(found, at + 1) in {"then", "also"})))
    return key_at(found, at - 1) in lex.AUXILIARIES and verb in lex.TOUCH | lex.OCCLUDE | {"tip", "topple"}


def _singles_out(item: Item, phrase: ObjectPhrase) -> bool:
    """ "The red one", "the left one", "the one on the left"."""
    words = phrase.text.lower().split()
    return phrase.colour is not None or (item.words[-1:] == ("one",) and len(words) > 1)


def _is_bare_colour(item: Item) -> bool:
    """ "The blue"; but "the orange" may be the fruit."""
    return (
        len(item.words) == 2 and item.words[0] == "the" and item.words[1] in lex.COLOURS and item.words[1] != "orange"
    )


def _is_asked_for(found: Sequence[Item], at: int) -> bool:
    """ "Which cone", "which of the cones"."""
    return found[at].words[:1] in {("which",), ("what",)} or (
        key_at(found, at - 1) == "of" and key_at(found, at - 2) in {"which", "what"}
    )


def _kind_of(phrase: ObjectPhrase | None) -> str:
    """The noun of a phrase that names a thing by one; empty otherwise."""
    named = phrase is not None and phrase.is_thing and phrase.head not in lex.GENERIC | lex.AGENTS
    return phrase.noun or "" if phrase is not None and named else ""


def _of_kind(phrase: ObjectPhrase, noun: str) -> ObjectPhrase:
    words = phrase.text.split()
    if "one" not in words:
        return replace(phrase, text=" ".join([*words, noun]), noun=noun)
    return replace(phrase, text=" ".join(noun if word == "one" else word for word in words), noun=noun)
