"""Sets aside what opens a sentence and changes nothing: "Excuse me, could you please tell me whether ..."."""

from __future__ import annotations

import re
from collections.abc import Sequence
from difflib import SequenceMatcher
from functools import cache

from cow_service.readers.embedded.english import lexicon as lex
from cow_service.readers.embedded.english.grammar import listed_words, read_from
from cow_service.readers.embedded.english.lexicon import SETS, words
from cow_service.readers.embedded.english.tokens import PUNCTUATION, Item, key_at, tokens

_ENDS = frozenset(".?!;")
_WINDOW = 24  # words of the openings of one sentence
_MAX_TRIES = 12  # of one question
_LONGEST_FIRST = sorted(map(re.escape, lex.TABLES["said_as"]), key=len, reverse=True)
_SAID_AS = re.compile(rf"\b(?:{'|'.join(_LONGEST_FIRST)})\b", re.I)
_TAG = re.compile(rf",\s*(?:{'|'.join(lex.SETS['tags'])})\s*\?(?=\s+\S)", re.I)  # and something else is asked


def without_openings(text: str) -> str:
    """The text without openings; what asks by a statement ("I wonder whether it ...") begins with "tell me" then.

    Words of informal English are put as the grammar has them ("gonna" as "going to").
    """
    text = _TAG.sub(".", text)
    text = _SAID_AS.sub(lambda found: lex.TABLES["said_as"][found[0].lower()], text.replace("’", "'"))
    found, kept, end, tries = tokens(text), list[str](), 0, 0
    for at in range(len(found)):
        if not (at == 0 or key_at(found, at - 1) in _ENDS) or tries >= _MAX_TRIES:
            continue
        tries += 1
        parsed = read_from("opening", found, at, _WINDOW)
        if parsed is None:
            continue
        tree, behind = parsed
        asks = next(tree.find_data("asks_if"), None)
        kept += [text[end : found[at].start], "" if asks is None else f"tell me {found[behind - 1].key} "]
        end = found[behind].start if behind < len(found) else len(text)
    return "".join([*kept, text[end:]])


# Sentences of the text, and what those are about that say how to reply.
_BETWEEN_SENTENCES = re.compile(r"((?<=[.?!])\s+|\n+)")
_BETWEEN_PARTS = re.compile(r"((?<=[.?!;:])\s+)")
_PICTURES = words("image images frame frames picture pictures photo photos")
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
    return "".join(each for each in _BETWEEN_PARTS.split(kept) if not _instructs(each))


def _instructs(sentence: str) -> bool:
    """Whether it says what to do, or what the images are, not what happens in them."""
    said = re.findall(r"\w+", sentence.lower())
    first = next((word for word in said[:2] if word != "please"), "")
    return first in SETS["instructions"] or (first == "note" and not _PICTURES.isdisjoint(said))


SHORTEST = 5  # letters of a word that is looked at
_BEFORE_NOUN = lex.DETERMINERS | lex.COLOURS.keys() | lex.CONDITIONALS | lex.AUXILIARIES | PUNCTUATION | {"of"}
_ONE_EDIT = ([("replace", 1, 1)], [("insert", 0, 1)], [("delete", 1, 0)])
_ENDINGS = ("s", "es", "d", "ed", "r", "er")  # of listed words: no errors


def without_typing_errors(text: str) -> tuple[str, tuple[tuple[str, str], ...]]:
    """The text with its typing errors set right, and each of them with what it was read as.

    Nouns are an open set: where one may stand, a word is left as it is, but for the names of directions.
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
