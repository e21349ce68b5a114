"""Which words of a question no rule has read: a warning names them, so that none is passed over in silence."""

from __future__ import annotations

from collections.abc import Iterator

from cow_service.readers.question import lexicon as lex
from cow_service.readers.question.phrases import Item, ObjectPhrase, key_at, phrase_at
from cow_service.readers.question.relations import covered_items
from cow_service.readers.question.sentences import Question

# Words of a motion that lead past, over or round a thing: its path is not bent by them.
_PATHS = lex.words(
    "around over under below above beneath past behind between through across beside near by off without with among"
)
_PLAIN_ADVERBS = lex.words(
    "directly exactly slightly straight freely horizontally vertically simply only suddenly currently initially",
    "originally diagonally completely entirely fully really actually possibly immediately accidentally",
)
_END = frozenset(".?!;")


def unread_warnings(question: Question) -> list[str]:
    """What was passed over of the motion and of further sentences, each named."""
    said = [f"The words '{words}' were not understood and changed nothing." for words in _unread(question)]
    return list(dict.fromkeys(said))


def _unread(question: Question) -> Iterator[str]:
    covered = covered_items(question)
    for at, item in enumerate(question.items):
        if item.quantity is not None and not _is_read(item, question):
            yield " ".join(item.words)
        if at in covered or item not in question.clause:
            continue
        phrase = phrase_at(question.items, at + 1)
        if item.key in _PATHS and phrase is not None and _is_further(phrase, question):
            yield f"{item.key} {phrase.text}"
        elif lex.is_adverb(item.key) and item.key not in _PLAIN_ADVERBS:
            yield item.key
        elif item.phrase is not None and lex.is_adverb(item.phrase.text) and item.phrase.text not in _PLAIN_ADVERBS:
            yield item.phrase.text
    yield from _statements(question, covered)


def _is_further(phrase: ObjectPhrase, question: Question) -> bool:
    """Whether a phrase is a thing that the motion neither moves nor aims at."""
    read = [question.mover, question.motion.towards, *(other.object for other in question.motion.others)]
    return phrase.is_thing and phrase.head not in lex.AGENTS and phrase not in read


def _is_read(item: Item, question: Question) -> bool:
    motion = question.motion
    legs = [motion.quantities, *(step.quantities for step in motion.steps)]
    legs += [other.motion.quantities for other in motion.others]
    return any(item.quantity in quantities for quantities in legs)


def _statements(question: Question, covered: frozenset[int]) -> Iterator[str]:
    """Sentences that say of a thing how it is: "The floor is slippery."."""
    start = 0
    for at in range(len(question.items) + 1):
        if key_at(question.items, at) not in _END:
            continue
        sentence = range(start, at)
        start = at + 1
        told = [question.items[place] for place in sentence]
        if covered.isdisjoint(sentence) and not any(item in question.clause for item in told):
            words = [_text(item) for item in told]
            if any(word in lex.BE for word in words) and "there" not in words and "arrow" not in words:
                yield " ".join(words)


def _text(item: Item) -> str:
    return item.phrase.text if item.phrase is not None else " ".join(item.words) or item.key
