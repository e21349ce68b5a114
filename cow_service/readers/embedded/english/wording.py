"""Puts a question into plain wording: without how to reply, without openings, and without typing errors."""

import re
from collections.abc import Sequence
from difflib import SequenceMatcher
from functools import cache

from cow_service.readers.embedded.english import lexicon as lex
from cow_service.readers.embedded.english.grammar import listed_words, read_from
from cow_service.readers.embedded.english.lexicon import Item, key_at

# Sentences of the text, and what those are about that say how to reply.
_BETWEEN_SENTENCES = re.compile(r"((?<=[.?!])\s+|\n+)")
_BETWEEN_PARTS = re.compile(r"((?<=[.?!;:])\s+)")
_PICTURES = lex.words("image images frame frames picture pictures photo photos")
_ABOUT_REPLY = re.compile(
    r"\byour (?:\w+ ){0,2}(?:response|answer|reply|output)s?\b|\bjson\b|answer\s*:\s*\$|\$\s?letter\b", re.IGNORECASE
)
_CONDITION = re.compile(r"\b(?:if|when|once|suppose|assum\w+|imagine)\b", re.IGNORECASE)
_YES_NO = re.compile(r"[\s,]*[(\[]\s*yes\s*(?:/|\bor\b|,)\s*no\s*[)\]]?\.?\s*$", re.IGNORECASE)  # what may be replied
_HEADING = re.compile(r"^[ \t]*question[ \t]*(?:\d+[ \t]*)?:[ \t]*", re.IGNORECASE | re.MULTILINE)


def without_reply_form(prompt: str) -> str:
    """The prompt without the heading of its question, and without sentences that say how to reply and nothing else."""
    sentences = _BETWEEN_SENTENCES.split(_YES_NO.sub("", _HEADING.sub("", prompt)))
    kept = "".join(each for each in sentences if not _ABOUT_REPLY.search(each) or _CONDITION.search(each))
    parts: list[str] = []
    for part in _BETWEEN_PARTS.split(kept):
        said = re.findall(r"\w+", part.lower())
        first = next((word for word in said[:2] if word != "please"), "")
        if not (first in lex.SETS["instructions"] or (first == "note" and not _PICTURES.isdisjoint(said))):
            parts.append(part)  # the others say what to do, or what the images are
    return "".join(parts)


_OPENING = 24  # words of the openings of one sentence
_MAX_TRIES = 12  # of one question
_LONGEST_FIRST = sorted(map(re.escape, lex.TABLES["said_as"]), key=len, reverse=True)
_SAID_AS = re.compile(rf"\b(?:{'|'.join(_LONGEST_FIRST)})\b", re.IGNORECASE)
_TAG = re.compile(rf",\s*(?:{'|'.join(lex.SETS['tags'])})\s*\?(?=\s+\S)", re.IGNORECASE)  # and something else is asked


def without_openings(text: str) -> str:
    """The text without openings; what asks by a statement ("I wonder whether it ...") begins with "tell me" then.

    Words of informal English are put as the grammar has them ("gonna" as "going to").
    """
    text = _TAG.sub(".", text)
    text = _SAID_AS.sub(lambda found: lex.TABLES["said_as"][found[0].lower()], text.replace("’", "'"))
    found, kept, end = lex.tokens(text), list[str](), 0
    starts = [at for at in range(len(found)) if at == 0 or key_at(found, at - 1) in lex.ENDS]
    for at in starts[:_MAX_TRIES]:
        parsed = read_from("opening", found, at, _OPENING)
        if parsed is not None:
            tree, behind = parsed
            asks = f"tell me {found[behind - 1].key} " if "asks_if" in tree else ""
            kept += [text[end : found[at].start], asks]
            end = found[behind].start if behind < len(found) else len(text)
    return "".join([*kept, text[end:]])


_SHORTEST = 5  # letters of a word that is looked at
_BEFORE_NOUN = lex.DETERMINERS | lex.COLOURS.keys() | lex.CONDITIONALS | lex.AUXILIARIES | lex.PUNCTUATION | {"of"}
_BEHIND_NOUN = lex.PUNCTUATION | lex.CLOSED | lex.VERBS.keys() | lex.PLACES
_ONE_EDIT = ([("replace", 1, 1)], [("insert", 0, 1)], [("delete", 1, 0)])
_ENDINGS = ("", "s", "es", "d", "ed", "r", "er")  # a listed word with one of these is no typing error


def without_typing_errors(text: str) -> tuple[str, tuple[tuple[str, str], ...]]:
    """The corrected text, and each error with the word that it was read as: one that is one letter off.

    Any word may be a noun, so where a noun may stand only a few are corrected, such as names of directions.
    """
    found, errors, end, kept = lex.tokens(text), dict[str, str](), 0, list[str]()
    for at, item in enumerate(found):
        meant = _meant(found, at)
        if meant is not None:
            errors[text[item.start : item.end]] = meant
            kept += [text[end : item.start], meant]
            end = item.end
    return "".join([*kept, text[end:]]), tuple(errors.items())


def _meant(found: Sequence[Item], at: int) -> str | None:
    key, before = found[at].key, key_at(found, at - 1)
    if len(key) < _SHORTEST or not key.isalpha() or key in lex.SETS["no_errors"]:
        return None
    among = _vocabulary().get(key[0], frozenset())
    if not among.isdisjoint(key.removesuffix(ending) for ending in _ENDINGS):
        return None
    near = [word for word in among if abs(len(word) - len(key)) < 2 and _is_one_edit(key, word)]
    # A noun may stand behind a determiner, say, and with no noun behind it.
    noun = key_at(found, at + 1) in _BEHIND_NOUN and (before in _BEFORE_NOUN or lex.is_modifier(before))
    return near[0] if len(near) == 1 and (not noun or near[0] in lex.SETS["misspelt_nouns"]) else None


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
    words = lex.CLOSED | lex.COLOURS.keys() | lex.VERBS.keys() | listed_words()
    words = words.union(*lex.SETS.values()) - lex.SETS["no_errors"] | {f"{noun}s" for noun in lex.SETS["nouns"]}
    return {letter: frozenset(word for word in words if word[0] == letter) for letter in {word[0] for word in words}}
