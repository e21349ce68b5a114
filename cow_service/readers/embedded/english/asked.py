"""Reads which event a question asks about: that the mover hits, lands on, hides or is hidden by something.

The question is taken at its word: one that has a word which no rule reads, where that may turn its meaning, is not
read at all. A wrong yes is worse than "not sure".
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise

from lark import Tree

from cow_service.readers.embedded.english import lexicon as lex
from cow_service.readers.embedded.english.asking import (
    IT,
    MAX_TOKENS,
    THEM,
    Asking,
    Sentence,
    means_mover,
    read_clause,
    sentences,
)
from cow_service.readers.embedded.english.grammar import parse_all, read_from
from cow_service.readers.embedded.english.lexicon import PUNCTUATION, Item, ObjectPhrase, Word, key_at
from cow_service.readers.embedded.english.motion import is_during
from cow_service.readers.embedded.english.questions import Question
from cow_service.records import Asked

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


_MAX_CHANGES = 24  # of one sentence
_THING = r"(?:M|T\d+|it|they|he|she)"
_SLOTS = {"thing": _THING, "list": r"T\d+(?: , T\d+)*(?: ,)? or T\d+", "some": r"S\d+", "rest": ".+"}
_OBJECTS = frozenset({"OBJ", "OBJS"})  # an object or objects of no name
_SLOT = re.compile(r"<(\w+?)(\d?)>")


_STARTS = lex.SETS["starts"]
_OPENERS = lex.words(", and then so but now please")
_CLAIM = ("true", "or", "false")
_ASKING = lex.words("how what why who whom whose")  # in front of what was read they make another question of it
_SUBJECTS = lex.words("it they the a an be this its i you we someone somebody there")
_SUBJECTS_KINDS = frozenset({"PRONOUN", "M", "T", "S"})
_CONDITIONS = lex.words("if when once after as while upon assuming given provided suppose supposing")
_MAX_TRIES = 8  # of one sentence: each takes some ms
MAX_SENTENCES = 12  # of one question; more are not read
_LIST = re.compile(r"(?P<list>T\d+(?: , T\d+)*(?: ,)? or T\d+)")
_LIST_AT_END = re.compile(r".*?, " + _LIST.pattern)
_HOLLOW = lex.words("bowl basket hole pocket goal bin bucket pit hoop net drawer gap garage tunnel cave tray pan pot")


@dataclass(frozen=True)
class _Reading:
    """What the asking clause says, the things that its tokens stand for, and which tokens of the sentence it covers."""

    asking: Asking
    phrases: dict[str, ObjectPhrase]
    covered: frozenset[int]
    items: frozenset[int] = frozenset()
    listed: tuple[ObjectPhrase, ...] = ()
    within: float | None = None  # s
    claim: bool = False  # a statement behind "true or false"


def read_asked(question: Question) -> Asked | None:
    """What the question asks for; None where it is not one of ours, or not put plainly.

    `target` is worded as in `Question.others`, where the question names it there. Of `which-first` it is None: see
    `read_alternatives`.
    """
    reading = _read(question)
    if reading is None or unread(question).turning:
        return None
    asking = reading.asking
    target = None if asking.target is None else _named(asking.target, reading, question)
    subject = None if asking.subject is None else _named(asking.subject, reading, question)
    if asking.relation == "inside" and target is None:
        target = next((_as_named(put.targets[0], question) for put in question.interventions if put.targets), None)
    among = _meant(reading, question)
    if among is None:
        return None
    return Asked(
        form=asking.form, relation=asking.relation, subject=subject, target=target, negated=asking.negated,
        among=tuple(_as_named(phrase, question) for token, phrase in among if not token.startswith("K")),
        every=asking.every, within=reading.within, partly=asking.partly,
    )  # fmt: skip


def _named(token: str, reading: _Reading, question: Question) -> str | None:
    if token == "M":
        return None if question.mover is None else question.mover.text
    return _as_named(reading.phrases[token], question)


def read_alternatives(question: Question) -> tuple[ObjectPhrase, ...]:
    """The things, or the one kind, among which a question asks for the first; empty where it asks for any."""
    reading = _read(question)
    if reading is None or reading.asking.form != "which-first":
        return ()
    return tuple(phrase for _, phrase in _meant(reading, question) or ())


def _meant(reading: _Reading, question: Question) -> list[tuple[str, ObjectPhrase]] | None:
    """The things and kinds that are meant, with their tokens; None for a "them" that is not two or more things."""
    if reading.listed:
        return [("", phrase) for phrase in reading.listed]
    found = [(token, reading.phrases[token]) for token in reading.asking.among if token != THEM]
    if THEM not in reading.asking.among:
        return [each for each in found if not each[0].startswith("K")] or found
    put = [change.object for change in question.interventions if change.kind == "place"]
    things = [phrase for phrase in (*put, *question.others) if phrase != question.mover]
    return [("", phrase) for phrase in things] if len(things) > 1 else None


@lru_cache(maxsize=64)
def unread(question: Question) -> Unread:
    """The words of the question that no rule has read."""
    reading = _read(question)
    found = unread_words(question, frozenset() if reading is None else reading.items)
    if reading is not None and reading.claim:
        return Unread((*found.turning, *found.beside), ())  # "true or false" is asked of those words, too
    return found


@lru_cache(maxsize=64)  # two readers and a stage of every request ask for it
def _read(question: Question) -> _Reading | None:
    """The one clause of the question that asks; None where none is understood, or several ask."""
    found, claim = _without_claim(sentences(question))
    if len(found) > MAX_SENTENCES or any(len(sentence.words) > MAX_TOKENS for sentence in found):
        return None
    return _read_sentences(found, question, claim)


def _read_sentences(found: Sequence[Sentence], question: Question, claim: frozenset[int]) -> _Reading | None:
    """What one of the sentences asks; None where none is understood, or several ask. `claim`: "true or false"."""
    read = ((at, _read_sentence(sentence, question, claim)) for at, sentence in enumerate(found))
    readings = [(at, reading) for at, reading in read if reading is not None]
    if len(readings) != 1:
        return None
    at, reading = readings[0]
    listed = _listed(found[at], reading.covered, found[at + 1 :])
    if listed and reading.asking.form != "which-first":
        return None
    named = {found[at].words[place].at for place in reading.covered} | claim
    named |= {at for at, item in enumerate(question.items) if listed and (item.phrase in listed or item.key == "or")}
    named |= {at for at, item in enumerate(question.items) if item.key == "still" and question.interventions}
    named |= _premise(found[: at + 1], reading, question)
    quantities = {at: item.quantity for at, item in enumerate(question.items) if item.quantity}
    limits = {at: quantity.within for at, quantity in quantities.items() if quantity.within is not None}
    if not all(_limits(question, named, at) for at in limits):
        return None
    within = min(limits.values(), default=None)
    return replace(reading, listed=listed, items=frozenset(named | limits.keys()), within=within, claim=bool(claim))


def _premise(told: Sequence[Sentence], reading: _Reading, question: Question) -> set[int]:
    """The places of "and strikes the bowl" in front of the question, where what the bowl then does is asked."""
    subject = reading.asking.subject
    if subject is None or subject not in reading.phrases:
        return set()
    ends = [len(each.words) for each in told[:-1]] + [max(min(reading.covered) - 1, 0)]
    for sentence, end in zip(told, ends, strict=True):
        if sentence.asks and sentence is not told[-1]:
            continue
        for start in (at for at, token in enumerate(sentence.tokens[:end]) if token in {"and", ","}):
            words = sentence.words[start:end]
            tree = parse_all("premise", words)
            struck = [] if tree is None else [word.text for word in words if word.kind == "T"]
            if struck and _as_named(sentence.phrases[struck[0]], question) == _named(subject, reading, question):
                return {word.at for word in words}
    return set()


def _without_claim(found: list[Sentence]) -> tuple[list[Sentence], frozenset[int]]:
    """The sentences without a "true or false" in front of them all, and the places of its words."""
    if not found or tuple(found[0].tokens[: len(_CLAIM)]) != _CLAIM:
        return found, frozenset()
    first, number = found[0], len(_CLAIM) + (found[0].tokens[len(_CLAIM) : len(_CLAIM) + 1] == [","])
    rest = replace(first, words=first.words[number:])
    return [each for each in (rest, *found[1:]) if each.words], frozenset(word.at for word in first.words[:number])


def _limits(question: Question, asking: set[int], at: int) -> bool:
    """Whether a time limits what is asked: not the motion, and "after 2 s" only where it is asked what has happened."""
    items = question.items
    have = not {"has", "have", "had"}.isdisjoint(items[place].key for place in asking)
    moves = items[at] in question.clause and not any(items[place] in question.clause for place in asking)
    return not moves and (have or "after" not in items[at].words)


def _read_sentence(sentence: Sentence, question: Question, claim: Collection[int]) -> _Reading | None:
    """The longest part of a sentence, up to its end or to a condition, that a pattern covers.

    Where the question begins with "true or false", a statement asks, too.
    """
    tokens = sentence.tokens
    tries = 0
    rolling = [[word, question.motion.verb, "-ing"] for word in ("by", "of")]
    ends = [at for at in range(len(tokens)) if tokens[at] in _CONDITIONS or tokens[at : at + 3] in rolling]
    claims = {at for at in range(len(tokens)) if claim and _claims(sentence, at)}
    for start in (at for at in range(len(tokens)) if at in claims or _starts(sentence, at, question)):
        for end in (end for end in (len(tokens), *ends) if end > start):
            tries += 1
            if tries > _MAX_TRIES:
                return None
            reading = _match(sentence, _without_insertion(tokens, start, end), question, start in claims)
            if reading is not None:
                return reading
    return None


def _starts(sentence: Sentence, at: int, question: Question) -> bool:
    """Whether a question may begin at a token: with an auxiliary, or as in "ball rolls left - hits the mug?"."""
    tokens, word = sentence.tokens, sentence.words[at]
    # "Thrown how the arrow shows": that "how" asks nothing.
    before = [each.text for each in sentence.words[:at] if each.text != "how" or not question.has_read(each.at)]
    if word.kind == "T" and tokens[at + 1 : at + 2] in (["or"], [","]):
        return _opens(before)  # "the mug or the cone, which one does it hit?"
    if word.text in _STARTS and not (at and sentence.words[at - 1].at == word.at):
        return _opens(before)
    said = question.items[word.at].key
    if word.kind == "PRONOUN" and at and at + 1 < len(tokens):  # "let go of the ball, it lands on the mug?"
        said = question.items[sentence.words[at + 1].at].key
    finite = said in lex.VERBS and lex.VERBS[said].form == "s"
    return finite and sentence.asks and (at == 0 or tokens[at - 1] == ",")


def _claims(sentence: Sentence, at: int) -> bool:
    """Whether a statement may begin at a token: with what does something, at the start or behind a condition."""
    before = sentence.tokens[:at]
    return sentence.words[at].kind in _SUBJECTS_KINDS and (not before or before[-1] in _OPENERS) and _opens(before)


def _without_insertion(tokens: Sequence[str], start: int, end: int) -> list[int]:
    """The places of a clause without what stands between commas behind its subject: "the car, moving left,"."""
    places = list(range(start, end))
    commas = [at for at in places if tokens[at] == ","]
    behind = len(commas) > 1 and commas[0] <= start + 4 and tokens[commas[0] - 1] in {"M", "it"}
    if behind and tokens[commas[0] + 1] in _CONDITIONS | lex.VERBS.keys():
        return [at for at in places if not commas[0] <= at <= commas[1]]
    return places[:-1] if commas and commas[-1] == end - 1 else places


def _match(sentence: Sentence, places: Sequence[int], question: Question, claim: bool) -> _Reading | None:
    words = [Word("", word, places[0]) for word in _CLAIM] if claim else []
    words += [sentence.words[at] for at in places]
    tokens = [word.text for word in words]
    senses = {token for token in tokens if token in {"along", "against"}}
    if "arrow" in tokens and senses and senses != {question.motion.arrow}:
        return None  # the motion that was read is another
    beside = question.motion.others[0].object if len(question.motion.others) == 1 else None
    phrases = sentence.phrases if beside is None else sentence.phrases | {"+": beside}
    asking = read_clause(words, None if beside is None else "+")
    if asking is None:
        return None
    if asking.target == IT:
        if len(question.others) != 1:
            return None
        phrases = phrases | {IT: question.others[0]}
    asking = _into_hollow(asking, tokens, phrases)
    return None if asking is None else _Reading(asking, phrases, frozenset(places))


def _opens(before: Sequence[str]) -> bool:
    """Whether a question may begin behind these tokens: at the start, or where its condition ends."""
    rest = list(before)
    while rest and rest[-1] in _OPENERS:
        rest.pop()
    if not rest:
        return True
    last = rest[max((at for at, token in enumerate(rest) if token == ","), default=-1) + 1 :]
    closed = len(rest) < len(before) or any(token in lex.CONDITIONALS for token in last)
    clause = closed or any(token in lex.VERBS for token in last)
    follows = zip(last, [*last[1:], ""], strict=True)
    related = all(_relates(token, after) for token, after in follows if token in {"which", "when", "where"})
    return clause and related and _ASKING.isdisjoint(last) and last[-1] != "not"


def _relates(token: str, after: str) -> bool:
    """Whether a clause follows on "which", "when" or "where": then nothing is asked with them."""
    subject = after[:1] in {"M", "T", "S", "X"} or after in _SUBJECTS or after.startswith("OBJ")
    return subject or (token == "when" and after in lex.VERBS)


def _into_hollow(asking: Asking, tokens: Sequence[str], phrases: dict[str, ObjectPhrase]) -> Asking | None:
    """ "Roll into the bowl": it would be in it, not only touch it; "fall into the vase" is to hit it."""
    hollow = asking.target in phrases and phrases[asking.target].head in _HOLLOW
    into = any(token in {"into", "in"} for token in tokens)
    if asking.relation == "touches" and hollow and into and asking.form == "whether":
        return replace(asking, relation="inside")
    return asking


def _as_named(target: ObjectPhrase, question: Question) -> str:
    """The target in the words of the first mention of it: "a blue cup" that is "the cup" later."""
    texts = [other.text for other in question.others]
    if target.text in texts:
        return target.text
    words = set(target.text.lower().split()) - {"one"}
    changed = [phrase.text for change in question.interventions for phrase in (change.object, *change.targets)]
    moving = [] if question.mover is None else [question.mover.text]
    fuller = {text for text in [*texts, *changed, *moving] if words <= set(text.lower().split())}
    if len(fuller) > 1:
        fuller -= {target.text}
    return fuller.pop() if len(fuller) == 1 else target.text


def _listed(asking: Sentence, covered: frozenset[int], following: Sequence[Sentence]) -> tuple[ObjectPhrase, ...]:
    """The things of a list behind the question: "What will it hit first if it falls? The red cube or the blue mug?"."""
    behind = " ".join(asking.tokens[max(covered) + 1 :])
    next_one = " ".join(following[0].tokens) if following else ""
    for sentence, text in (
        (asking, _LIST_AT_END.fullmatch(behind)),
        (following[0] if following else asking, _LIST.fullmatch(next_one)),
    ):
        if text is not None:
            return tuple(sentence.phrases[name] for name in text["list"].split() if name in sentence.phrases)
    return ()
