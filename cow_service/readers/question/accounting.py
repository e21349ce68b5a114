"""Which words of a question no rule has read, so that none is passed over in silence.

A word is read by the rule of a change, a trail, a quantity, a motion or of what is asked, or it changes nothing.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

from lark import Tree

from cow_service.readers.question import lexicon as lex
from cow_service.readers.question.asked_words import means_mover
from cow_service.readers.question.clauses import is_during
from cow_service.readers.question.parsing import read_from
from cow_service.readers.question.phrases import PUNCTUATION, Item, key_at
from cow_service.readers.question.sentences import Question

# Words that hold a sentence together; what they join is read, or is named.
_STRUCTURE = (
    PUNCTUATION | lex.AUXILIARIES | lex.BE | lex.MOVER_PRONOUNS | lex.CAUSATIVES | (lex.CONDITIONALS - {"unless"})
    | lex.words("to that which who and but then so i you we us me there also have has had please now here")
    | lex.words("someone somebody ok either go come get goes comes")
    | lex.words("what happens happen tell know will keep keeps kept continue continues continued start starts started")
    | lex.words("begin begins began s yes")
)  # fmt: skip
_NAMING = lex.words(", and there is are we see you have here with in on")
_NEGATIVE = lex.words("no none nothing neither nor unless except")
_ALL_OF_IT = lex.words("whole entire")  # "is the whole mug hidden": how much is hidden at most is not asked anywhere
_END = frozenset(".?!;")
_NO_MATTER = frozenset({"", "marked", "told"})  # adverbials that say nothing of a motion
_TRIES = 8  # of one question
MAX_TEXT = 200  # characters of unread words that are named


@dataclass(frozen=True)
class Unread:
    """Words that were not understood: `turning`, where they may change what is asked or how it moves."""

    turning: tuple[str, ...] = ()
    beside: tuple[str, ...] = ()


def unread_words(question: Question, covered: frozenset[int]) -> Unread:
    """The words that no rule read, sentence by sentence. `covered` are the places of the items that ask."""
    items = question.items
    turning = [words for words in (question.pronoun, question.beyond) if words]
    turning += [word for item in items for word in item.words if word in _ALL_OF_IT]
    beside: list[str] = []
    for sentence in _sentences(items):
        runs = [" ".join(_text(items[at]) for at in run) for run in _runs(question, sentence, covered)]
        told = any(at in covered or items[at].start in question.read for at in sentence)
        (beside if not told and _describes(items, sentence) else turning).extend(run[:MAX_TEXT] for run in runs)
    return Unread(tuple(dict.fromkeys(turning)), tuple(dict.fromkeys(beside)))


def _sentences(items: tuple[Item, ...]) -> Iterator[range]:
    start = 0
    for at in range(len(items) + 1):
        if key_at(items, at) in _END:
            if at > start:
                yield range(start, at)
            start = at + 1


def _describes(items: tuple[Item, ...], sentence: range) -> bool:
    """Whether a sentence only says how something is: nothing happens in it, and nothing is denied."""
    keys = [items[at].key for at in sentence]
    verbs = [lex.VERBS[key] for key in keys if key in lex.VERBS]
    acting = any(verb.kind not in {None, "static"} or verb.lemma in lex.TOUCH | lex.OCCLUDE for verb in verbs)
    states = not lex.BE.isdisjoint(keys) or any(verb.kind == "static" for verb in verbs)
    return states and not acting and (lex.NEGATIONS | _NEGATIVE).isdisjoint(keys)


def _runs(question: Question, sentence: range, covered: frozenset[int]) -> Iterator[list[int]]:
    """The places of unread items, those together that stand together."""
    harmless = _harmless(question, sentence, covered)
    run: list[int] = []
    for at in sentence:
        item = question.items[at]
        read = at in covered or item.start in question.read or at in harmless or _leads_on(question, at)
        structure = item.phrase is None and (item.key in _STRUCTURE or _orders(question, sentence, at))
        if not read and (run or not structure) and item.key not in PUNCTUATION:
            run.append(at)
        elif run:
            yield from _trimmed(question, run)
            run = []
    yield from _trimmed(question, run)


def _orders(question: Question, sentence: range, at: int) -> bool:
    """ "First", "is first rolled left, then ...", "as the ball rolls": when, as the rest of the sentence says."""
    if question.items[at].key == "first" and at > sentence.start and at + 1 < sentence.stop:
        return bool(question.motion.steps) and question.items[at + 1].start in question.read
    return at == sentence.start and (question.items[at].key == "first" or is_during(question.items, at))


def _leads_on(question: Question, at: int) -> bool:
    """ "By rolling left", "of sliding", "keeps on rolling": before a verb of the motion that was read."""
    on = question.items[at].key == "on" and lex.lemma(key_at(question.items, at - 1)) == "keep"
    if not (on or question.items[at].key in {"by", "of", "when"}) or at + 1 == len(question.items):
        return False
    after = question.items[at + 1]
    rolling = after.key in lex.VERBS and lex.VERBS[after.key].form == "ing"
    return rolling and after.start in question.read


def _trimmed(question: Question, run: list[int]) -> Iterator[list[int]]:
    while run and question.items[run[-1]].phrase is None and question.items[run[-1]].key in _STRUCTURE:
        run = run[:-1]
    if run:
        yield run


def _harmless(question: Question, sentence: range, covered: frozenset[int]) -> set[int]:
    """The places of what changes nothing: a floor where it moves, "please", the mover named again."""
    items = question.items
    found = {at for at in sentence if _names_known(question, items[at])}
    if _only_names([items[at] for at in sentence]):
        return set(sentence)
    tries = 0
    for at in sentence:
        if items[at].key == "nobody" and key_at(items, at + 1) in lex.VERBS:
            found |= {at, at + 1}  # "nobody throws the ball and it falls"; another thing than the mover is named
        if at in found or at in covered or items[at].start in question.read or tries >= _TRIES:
            continue
        parsed = read_from("adverbial", items[: sentence.stop], at, 8)
        tries += 1
        node = None if parsed is None else next(iter(parsed[0].children), None)
        if parsed is not None and (str(node.data) if isinstance(node, Tree) else "") in _NO_MATTER:
            found |= set(range(at, parsed[1]))
    return found


def _only_names(sentence: list[Item]) -> bool:
    """ "There is a ball and a mug.", "A ball, a mug." """
    plain = all(item.key in _NAMING if item.phrase is None else item.phrase.is_thing for item in sentence)
    plain = plain and not any(one.phrase and two.phrase for one, two in pairwise(sentence))  # "Replace the ball"
    return plain and (lex.BE.isdisjoint(item.key for item in sentence) or sentence[0].key in {"there", "here"})


def _names_known(question: Question, item: Item) -> bool:
    """Whether a noun phrase names what moves, or a hand that moves it."""
    if item.phrase is None:
        return False
    if item.phrase.head in lex.AGENTS or means_mover(item.phrase, question):
        return True
    return any(item.phrase == other.object for other in question.motion.others)


def _text(item: Item) -> str:
    return item.phrase.text if item.phrase is not None else " ".join(item.words) or item.key
