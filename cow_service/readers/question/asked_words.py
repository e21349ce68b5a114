"""Renders the sentences of a question as words of the grammar, for what is asked in them.

`M` is the mover, `T0`, `T1` and so on are other named things, `S0` some things of one kind, `K0` the kind in "which
ball", `OBJ` and `OBJS` an object or objects of no name. `X` is a phrase that is not understood.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import dropwhile

from cow_service.readers.options import plain
from cow_service.readers.question import lexicon as lex
from cow_service.readers.question.phrases import Item, ObjectPhrase, key_at
from cow_service.readers.question.sentences import Question
from cow_service.readers.question.words import Word, plain_words

MAX_TOKENS = 80  # of one sentence; a longer one is not read
_ENDS = frozenset(".?!;")
_PAUSES = frozenset(":—–")
_GENERIC = lex.GENERIC | lex.words("obstacle obstacles body bodies")
_PLURAL = lex.words("objects things items ones obstacles bodies")
# Words that the chunker takes for nouns, and that are part of the grammar.
_PLAIN_WORDS = lex.SETS["plain_words"]
_OF_GENERIC = lex.words("first other different all single")
_TRAILING = lex.words("hard fast slow alone anyway whatsoever second third last twice once again")  # more is asked
_COUNTING = lex.SETS["counting"] | (lex.NUMBER_WORDS.keys() - {"one"})
THEM = "them"  # the things that were named
_TWO = (["the", "two"], ["those", "two"], ["these", "two"], ["both"], ["two"])
_CHANCES = ([], ["chance"], ["danger"], ["risk"], ["possibility"], ["likelihood"])
_LISTING = frozenset({",", ":", "or"})
_TWO_OF = lex.words("both either neither")
_SOME = lex.words("any every each either neither both all many no none one some")  # of the things of a kind


@dataclass
class Sentence:
    """One sentence in words of the grammar, and the phrases of its `T`, `S` and `K`."""

    words: list[Word] = field(default_factory=list[Word])
    phrases: dict[str, ObjectPhrase] = field(default_factory=dict[str, ObjectPhrase])
    asks: bool = False  # it ends with a question mark, or with the text
    dropped: frozenset[int] = frozenset()  # places of items that were left out of it because they change nothing

    @property
    def tokens(self) -> list[str]:
        """The texts of its words."""
        return [word.text for word in self.words]


def sentences(question: Question) -> list[Sentence]:
    """The sentences of a question, empty ones left out."""
    found = [Sentence()]
    for at, item in enumerate(question.items):
        if item.key in _ENDS:
            found[-1].asks = item.key == "?"
            found.append(Sentence())
            continue
        limit = item.quantity is not None and item.quantity.within is not None
        if limit or (item.start in question.read and item.quantity is not None and item not in question.clause):
            continue
        if item.phrase is not None:
            found[-1].words += _phrase_words(at, item, item.phrase, question, found[-1])
        elif item.key in {"them", "these", "those"} and _counts(found[-1].tokens):
            found[-1].words.append(Word("S", THEM, at))
        elif item.key != "still" or not question.interventions:  # "will it still hit it?": with what is taken away
            found[-1].words += plain_words(["," if item.key in _PAUSES else item.key], at)
    found[-1].asks = True
    return [sentence for sentence in found if sentence.words]


def _phrase_words(at: int, item: Item, phrase: ObjectPhrase, question: Question, sentence: Sentence) -> list[Word]:
    words = [word.lower() for word in item.words]
    content = list(dropwhile(lex.DETERMINERS.__contains__, words))
    determiners, before = words[: len(words) - len(content)], sentence.tokens
    if words in _TWO and before[-1:] == ["of"] and before[-2:-1] not in _CHANCES:
        return [Word("S", THEM, at)]
    place = phrase.head in lex.NO_THINGS and not phrase.as_thing
    if words == ["each", "other"] or place or set(content) <= _PLAIN_WORDS:
        return plain_words(["they"] if question.motion.others and words in _TWO else words, at)
    asked = words[0] in {"which", "what"}
    if means_mover(phrase, question) and not asked and words[0] not in _SOME:
        return [Word("M", "M", at)]
    named = phrase.inside_box or phrase.colour is not None or phrase.number is not None
    if not named and _GENERIC.intersection(content) and set(content) <= _GENERIC | _OF_GENERIC:
        return _generic(determiners, content, at)
    listed = not _LISTING.isdisjoint((key_at(question.items, at - 1), key_at(question.items, at + 1)))
    return _of_kind(at, words, phrase, sentence, listed) or _thing(at, determiners, content, phrase, sentence)


def _counts(before: Sequence[str]) -> bool:
    """Whether what stands in front is "any of", "all the", "neither"."""
    return before[-1:] in (["all"], ["neither"], ["no"]) or (
        before[-1:] == ["of"] and not _SOME.isdisjoint(before[-2:-1])
    )


def _of_kind(at: int, words: Sequence[str], phrase: ObjectPhrase, sentence: Sentence, listed: bool) -> list[Word]:
    """ "Both mugs", "any of the other two mugs", "neither mug" in tokens; none for a phrase that is of no kind."""
    before = [word for word in sentence.tokens if word != "of"]
    fronted = sentence.tokens in (["of"], ["out", "of"])  # "of the three balls, which ..."
    counts = fronted or _counts(sentence.tokens)
    plain = phrase.colour is None and phrase.number is None and phrase.place is None and not phrase.inside_box
    of_it = words[0] in _SOME or (words[0] in {"a", "an"} and plain and not listed)
    if (not counts and not of_it) or phrase.noun is None or phrase.head in _GENERIC or (counts and of_it):
        return []
    if counts and _is_one(words):
        return []  # "any of the cube" is a part of it
    said = words[0] if of_it else "" if fronted else before[-1]
    content = [word for word in words if word not in {"the", "these", "those"}]
    if not set(content) & _COUNTING <= _SOME | lex.NUMBER_WORDS.keys() | {"other"} or content[-1] in _TRAILING:
        return [Word("X", "X", at)]
    name = " ".join(content if of_it else [*([said] if said in _TWO_OF else []), *content])
    return [*plain_words([said] if of_it else [], at), _name("S", at, replace(phrase, text=name), sentence)]


def _is_one(words: Sequence[str]) -> bool:
    """Whether the words "the blue cube" are of one thing."""
    return words[0] in {"the", "this", "that"} and lex.singular(words[-1]) == words[-1]


def _thing(
    at: int, determiners: Sequence[str], content: Sequence[str], phrase: ObjectPhrase, sentence: Sentence
) -> list[Word]:
    asked = not {"which", "what"}.isdisjoint(determiners)
    if sentence.tokens[-2:] in (["which", "of"], ["what", "of"]) and phrase.noun is not None and "other" not in content:
        return [_name("K", at, phrase, sentence)]
    if _is_several(determiners, content, phrase, asked):
        return [Word("X", "X", at)]
    return [*([Word("", "which", at)] if asked else []), _name("K" if asked else "T", at, phrase, sentence)]


def _name(kind: str, at: int, phrase: ObjectPhrase, sentence: Sentence) -> Word:
    same = (name for name, known in sentence.phrases.items() if known == phrase and name.startswith(kind))
    name = next(same, f"{kind}{len(sentence.phrases)}")
    sentence.phrases[name] = phrase
    return Word(kind, name, at)


def _is_several(determiners: Sequence[str], content: Sequence[str], phrase: ObjectPhrase, asked: bool) -> bool:
    """Whether a phrase is of no one thing, or has a word of counting or of order in it."""
    vague = not asked and not lex.VAGUE_DETERMINERS.isdisjoint(determiners)
    counted = content[0].isdecimal() and phrase.number is None  # "3 balls"
    single = determiners == ["the"] and content[0] == "other" and lex.singular(content[-1]) == content[-1]
    return vague or counted or bool(set(content[single:]) & _COUNTING) or content[-1] in _TRAILING


def _generic(determiners: Sequence[str], content: Sequence[str], at: int) -> list[Word]:
    if len(content) > 1 and content[0] == "one":
        return [Word("X", "X", at)]  # "one object" is a number
    kept = [word for word in content if word in {"first", "different", "all", "single"}]
    object = "OBJS" if content[-1] in _PLURAL else "OBJ"
    return [*plain_words([*determiners, *kept], at), Word(object, object, at)]


def means_mover(phrase: ObjectPhrase, question: Question) -> bool:
    """Whether a phrase speaks of the mover again: no word in it that the mover's own lacks."""
    words = set(plain(phrase.text).split())
    return question.mover is not None and bool(words) and words <= set(plain(question.mover.text).split())
