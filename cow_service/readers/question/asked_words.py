"""Renders a question as a line of plain tokens per sentence, for the grammar of what it asks (`asked_grammar`).

`M` is the mover, `T0`, `T1` and so on are other named things, `OBJ` and `OBJS` an object or objects of no name, `K0` is
the kind in "which ball". Verbs are in their base form, with "-ing" where they end so. `X` is a phrase that is not
understood.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from cow_service.readers.question import lexicon as lex
from cow_service.readers.question.choices import plain
from cow_service.readers.question.phrases import Item, ObjectPhrase
from cow_service.readers.question.sentences import Question

MAX_TOKENS = 80  # of one sentence; a longer one is not read
_ENDS = frozenset(".?!;")
_PAUSES = frozenset(":—–")
_BE = dict.fromkeys(["be", "is", "are", "was", "were", "been"], "be") | {
    "being": "be-ing", "gets": "get", "got": "get", "gotten": "get", "getting": "get-ing",
}  # fmt: skip
# Verbs of the grammar that the lexicon has for other words.
_INFLECTED = {
    "takes": "take", "elapses": "elapse", "makes": "make", "making": "make-ing", "has": "have", "having": "have-ing",
    "escapes": "escape",
}  # fmt: skip
_GENERIC = lex.GENERIC | lex.words("obstacle obstacles body bodies")
_PLURAL = lex.words("objects things items ones obstacles bodies")
# Words that the chunker takes for nouns, and that are part of the grammar.
_PLAIN_WORDS = lex.words(
    "take takes taking long soon clear free untouched visible unobstructed unoccluded uncovered unhidden unblocked",
    "first elapse elapses pass passes seconds whole entire total overall altogether",
    "number least all short able",
)
_OF_GENERIC = lex.words("first other different all")
_TRAILING = lex.words("hard fast slow alone anyway whatsoever second third last twice once again")  # more is asked
_COUNTING = lex.words(
    "both all every each other several many twice once exactly least most only else same different single",
) | (lex.NUMBER_WORDS.keys() - {"one"})


@dataclass
class Sentence:
    """One sentence as tokens: for each its words and its place in the items, and the phrases of its `T` and `K`."""

    tokens: list[str] = field(default_factory=list[str])
    words: list[tuple[str, ...]] = field(default_factory=list[tuple[str, ...]])
    items: list[int] = field(default_factory=list[int])
    phrases: dict[str, ObjectPhrase] = field(default_factory=dict[str, ObjectPhrase])
    asks: bool = False  # it ends with a question mark, or with the text


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
        if item.phrase is None:
            tokens = ["," if item.key in _PAUSES else _word(item.key)]
        else:
            of_kind = found[-1].tokens[-2:] in (["which", "of"], ["what", "of"])
            tokens = _phrase_tokens(item, item.phrase, question, found[-1].phrases, of_kind)
        found[-1].tokens += tokens
        said = tuple(word.lower() for word in (item.words or (item.key,)))
        found[-1].words += [said] * len(tokens)
        found[-1].items += [at] * len(tokens)
    found[-1].asks = True
    return [sentence for sentence in found if sentence.tokens]


def _word(key: str) -> str:
    if key in _BE:
        return _BE[key]
    verb = lex.VERBS.get(key)
    if verb is None:
        return _INFLECTED.get(key, key)
    return f"{verb.lemma}-ing" if verb.form == "ing" else verb.lemma


def _phrase_tokens(
    item: Item, phrase: ObjectPhrase, question: Question, known: dict[str, ObjectPhrase], of_kind: bool
) -> list[str]:
    words = [word.lower() for word in item.words]
    determiners = words[: _count_determiners(words)]
    content = words[len(determiners) :]
    if words == ["each", "other"] or phrase.head in lex.NO_THINGS or set(content) <= _PLAIN_WORDS:
        return [_word(word) for word in words]
    if question.motion.others and words in (["the", "two"], ["both"]):
        return ["they"]
    if of_kind and phrase.noun is not None and phrase.head not in _GENERIC and "other" not in content:
        known[f"K{len(known)}"] = phrase
        return [list(known)[-1]]
    asked = words[0] in {"which", "what"}
    return ["M"] if means_mover(phrase, question) and not asked else _named(determiners, content, phrase, asked, known)


def _named(
    determiners: Sequence[str],
    content: Sequence[str],
    phrase: ObjectPhrase,
    asked: bool,
    known: dict[str, ObjectPhrase],
) -> list[str]:
    named = phrase.inside_box or phrase.colour is not None or phrase.number is not None
    if not named and _GENERIC.intersection(content) and set(content) <= _GENERIC | _OF_GENERIC:
        return _generic(determiners, content)
    if _is_several(determiners, content, phrase, asked):
        return ["X"]
    name = f"{'K' if asked else 'T'}{len(known)}"
    known[name] = phrase
    return ["which", name] if asked else [name]


def _is_several(determiners: Sequence[str], content: Sequence[str], phrase: ObjectPhrase, asked: bool) -> bool:
    """Whether a phrase is of no one thing, or has a word of counting or of order in it."""
    vague = not asked and not lex.VAGUE_DETERMINERS.isdisjoint(determiners)
    counted = content[0].isdecimal() and phrase.number is None  # "3 balls"
    single = determiners == ["the"] and content[0] == "other" and lex.singular(content[-1]) == content[-1]
    return vague or counted or bool(set(content[single:]) & _COUNTING) or content[-1] in _TRAILING


def _count_determiners(words: Sequence[str]) -> int:
    return next((at for at, word in enumerate(words) if word not in lex.DETERMINERS), len(words))


def _generic(determiners: Sequence[str], content: Sequence[str]) -> list[str]:
    if len(content) > 1 and content[0] == "one":
        return ["X"]  # "one object" is a number
    kept = [word for word in content if word in {"first", "different", "all"}]
    return [*determiners, *kept, "OBJS" if content[-1] in _PLURAL else "OBJ"]


def means_mover(phrase: ObjectPhrase, question: Question) -> bool:
    """Whether a phrase speaks of the mover again: no word in it that the mover's own lacks."""
    words = set(plain(phrase.text).split())
    return question.mover is not None and bool(words) and words <= set(plain(question.mover.text).split())
