"""Renders the sentences of a question as words of the grammar, for what is asked in them.

`M` is the mover, `T0`, `T1` and so on are other named things, `S0` some things of one kind, `K0` the kind in "which
ball", `OBJ` and `OBJS` an object or objects of no name. `X` is a phrase that is not understood.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import takewhile

from cow_service.readers.question import lexicon as lex
from cow_service.readers.question.choices import plain
from cow_service.readers.question.phrases import Item, ObjectPhrase
from cow_service.readers.question.sentences import Question
from cow_service.readers.question.words import Word, plain_words

MAX_TOKENS = 80  # of one sentence; a longer one is not read
_ENDS = frozenset(".?!;")
_PAUSES = frozenset(":—–")
_GENERIC = lex.GENERIC | lex.words("obstacle obstacles body bodies")
_PLURAL = lex.words("objects things items ones obstacles bodies")
# Words that the chunker takes for nouns, and that are part of the grammar.
_PLAIN_WORDS = lex.words(
    "take takes taking long soon clear free untouched visible unobstructed unoccluded uncovered unhidden unblocked",
    "first elapse elapses pass passes seconds whole entire total overall altogether",
    "number least all both short able",
)
_OF_GENERIC = lex.words("first other different all")
_TRAILING = lex.words("hard fast slow alone anyway whatsoever second third last twice once again")  # more is asked
_COUNTING = lex.words(
    "both all every each other several many twice once exactly least most only else same different single",
) | (lex.NUMBER_WORDS.keys() - {"one"})
_SOME = lex.words("any every each either both all many no")  # in front of the things of a kind


@dataclass
class Sentence:
    """One sentence in words of the grammar, and the phrases of its `T`, `S` and `K`."""

    words: list[Word] = field(default_factory=list[Word])
    phrases: dict[str, ObjectPhrase] = field(default_factory=dict[str, ObjectPhrase])
    asks: bool = False  # it ends with a question mark, or with the text

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
        elif item.key != "still" or not question.interventions:  # "will it still hit it?": with what is taken away
            found[-1].words += plain_words(["," if item.key in _PAUSES else item.key], at)
    found[-1].asks = True
    return [sentence for sentence in found if sentence.words]


def _phrase_words(at: int, item: Item, phrase: ObjectPhrase, question: Question, sentence: Sentence) -> list[Word]:
    words = [word.lower() for word in item.words]
    determiners = list(takewhile(lex.DETERMINERS.__contains__, words))
    content = words[len(determiners) :]
    asked, before = words[0] in {"which", "what"}, sentence.tokens[-2:]
    kind = before in (["which", "of"], ["what", "of"]) and phrase.head not in _GENERIC and "other" not in content
    if words == ["each", "other"] or phrase.head in lex.NO_THINGS or set(content) <= _PLAIN_WORDS:
        return plain_words(words, at)
    if question.motion.others and words in (["the", "two"], ["both"]):
        return plain_words(["they"], at)
    if kind and phrase.noun is not None:
        return [_name("K", at, phrase, sentence)]
    if means_mover(phrase, question) and not asked:
        return [Word("M", "M", at)]
    named = phrase.inside_box or phrase.colour is not None or phrase.number is not None
    if not named and _GENERIC.intersection(content) and set(content) <= _GENERIC | _OF_GENERIC:
        return _generic(determiners, content, at)
    if _is_several(determiners, content, phrase, asked):
        return [Word("X", "X", at)]
    return [*([Word("", "which", at)] if asked else []), _name("K" if asked else "T", at, phrase, sentence)]


def _name(kind: str, at: int, phrase: ObjectPhrase, sentence: Sentence) -> Word:
    name = f"{kind}{len(sentence.phrases)}"
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
    kept = [word for word in content if word in {"first", "different", "all"}]
    object = "OBJS" if content[-1] in _PLURAL else "OBJ"
    return [*plain_words([*determiners, *kept], at), Word(object, object, at)]


def means_mover(phrase: ObjectPhrase, question: Question) -> bool:
    """Whether a phrase speaks of the mover again: no word in it that the mover's own lacks."""
    words = set(plain(phrase.text).split())
    return question.mover is not None and bool(words) and words <= set(plain(question.mover.text).split())
