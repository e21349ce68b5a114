"""Corrects typing errors: a word that is one letter off a listed word is read as that word."""

from __future__ import annotations

from collections.abc import Sequence
from difflib import SequenceMatcher
from functools import cache

from cow_service.readers.embedded.english import lexicon as lex
from cow_service.readers.embedded.english.grammar import listed_words
from cow_service.readers.embedded.english.lexicon import PUNCTUATION, Item, key_at, tokens

SHORTEST = 5  # letters of a word that is looked at
_BEFORE_NOUN = lex.DETERMINERS | lex.COLOURS.keys() | lex.CONDITIONALS | lex.AUXILIARIES | PUNCTUATION | {"of"}
_ONE_EDIT = ([("replace", 1, 1)], [("insert", 0, 1)], [("delete", 1, 0)])
_ENDINGS = ("s", "es", "d", "ed", "r", "er")  # a listed word with one of these is no typing error


def without_typing_errors(text: str) -> tuple[str, tuple[tuple[str, str], ...]]:
    """The corrected text, and each error with the word that it was read as.

    Any word may be a noun, so where a noun may stand only a few are corrected, such as names of directions.
    """
    found, errors, end, kept = tokens(text), dict[str, str](), 0, list[str]()
    for at, item in enumerate(found):
        meant = _meant(found, at)
        if meant is not None:
            errors[text[item.start : item.end]] = meant
            kept += [text[end : item.start], meant]
            end = item.end
    return "".join([*kept, text[end:]]), tuple(errors.items())


def _meant(found: Sequence[Item], at: int) -> str | None:
    key = found[at].key
    if len(key) < SHORTEST or not key.isalpha() or _is_known(key):
        return None
    among = _vocabulary().get(key[0], ())
    near = [word for word in among if abs(len(word) - len(key)) < 2 and _is_one_edit(key, word)]
    if len(near) != 1 or (_may_be_noun(found, at) and near[0] not in lex.SETS["misspelt_nouns"]):
        return None
    return near[0]


def _is_known(key: str) -> bool:
    bare = {key, *(key.removesuffix(ending) for ending in _ENDINGS)}
    return not bare.isdisjoint(_vocabulary().get(key[0], ())) or key in lex.SETS["no_errors"]


def _may_be_noun(found: Sequence[Item], at: int) -> bool:
    """Whether a noun may stand at a place: behind a determiner, say, and with no noun behind it."""
    before, after = key_at(found, at - 1), key_at(found, at + 1)
    closed = after in PUNCTUATION or after in lex.FUNCTION_WORDS | lex.VERBS.keys() | lex.PLACES | lex.DETERMINERS
    return closed and (before in _BEFORE_NOUN or lex.is_modifier(before))


def _is_one_edit(one: str, other: str) -> bool:
    """Whether two words differ by one letter, or by two neighbours that have changed places."""
    pairs = [(a, b) for a, b in zip(one, other, strict=False) if a != b]
    if len(one) == len(other) and len(pairs) == 2 and pairs[0] == pairs[1][::-1]:
        return "".join(pair[0] for pair in pairs) in one
    if len(set(one) ^ set(other)) > 2:
        return False
    codes = SequenceMatcher(None, one, other, autojunk=False).get_opcodes()
    return [(tag, b - a, d - c) for tag, a, b, c, d in codes if tag != "equal"] in _ONE_EDIT


@cache
def _vocabulary() -> dict[str, frozenset[str]]:
    """The words of the closed lists and of the grammar by their first letters."""
    words = lex.FUNCTION_WORDS | lex.DETERMINERS | lex.COLOURS.keys() | lex.VERBS.keys() | listed_words()
    words = words.union(*lex.SETS.values()) - lex.SETS["no_errors"]
    plurals = {f"{noun}s" for noun in lex.SETS["nouns"]}
    letters = {word[0] for word in words}
    return {letter: frozenset(word for word in words | plurals if word[0] == letter) for letter in letters}
