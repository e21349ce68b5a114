"""Reads which event a question asks about: that the mover hits, lands on, hides or is hidden by something.

The question is taken at its word: one that has a word which no rule reads, where that may turn its meaning, is not
read at all. A wrong yes is worse than "not sure".
"""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import dropwhile, groupby, pairwise

from cow_service.readers.embedded.english import lexicon as lex
from cow_service.readers.embedded.english.asking import MAX_TOKENS, Asking, Clause, Sentence, sentences
from cow_service.readers.embedded.english.grammar import parse_all
from cow_service.readers.embedded.english.lexicon import Item, ObjectPhrase, Word, key_at
from cow_service.readers.embedded.english.motion import NO_MATTER, is_during, read_adverbial
from cow_service.readers.embedded.english.questions import Question
from cow_service.records import Asked

_MAX_TRIES = 8  # of one sentence: each takes some ms
MAX_SENTENCES = 12  # of one question; more are not read
_OPENERS = lex.words(", and then so but now please")
_ASKING = lex.words("how what why who whom whose")  # in front of what was read they make another question of it
_SUBJECTS = lex.words("it they the a an be this its i you we someone somebody there")
_CONDITIONS = lex.words("if when once after as while upon assuming given provided suppose supposing")
_HOLLOW = lex.words("bowl basket hole pocket goal bin bucket pit hoop net drawer gap garage tunnel cave tray pan pot")


def read_asked(question: Question) -> Asked | None:
    """What the question asks for; None if it is not one of ours, or not put plainly.

    `target` is worded as in `Question.others`, where the question names it there. Of `which-first` it is None: see
    `read_alternatives`.
    """
    asking = _read(question)
    among = None if asking is None else _meant(asking, question)
    if asking is None or among is None or unread(question).turning:
        return None
    target = asking.target
    if asking.relation == "inside" and target is None:
        target = next((put.targets[0] for put in question.interventions if put.targets), None)
    things = [phrase for kind, phrase in among if kind != "K"]
    return Asked(
        form=asking.form, relation=asking.relation, subject=_in_full(asking.subject, question),
        target=_in_full(target, question), negated=asking.negated,
        among=tuple(text for phrase in things if (text := _in_full(phrase, question))),
        every=asking.every, within=asking.within, partly=asking.partly,
    )  # fmt: skip


def read_alternatives(question: Question) -> tuple[ObjectPhrase, ...]:
    """The things, or the one kind, among which a question asks for the first; empty if it asks for any."""
    asking = _read(question)
    if asking is None or asking.form != "which-first":
        return ()
    return tuple(phrase for _, phrase in _meant(asking, question) or ())


def _meant(asking: Asking, question: Question) -> list[tuple[str, ObjectPhrase]] | None:
    """The things or else the kinds that are meant; None for a "them" that is not two or more things."""
    found = [(word.kind, word.phrase) for word in asking.among if word.phrase is not None]
    if len(found) == len(asking.among):
        return [each for each in found if each[0] != "K"] or found
    put = [change.object for change in question.interventions if change.kind == "place"]
    things = [("T", phrase) for phrase in (*put, *question.others) if phrase != question.mover]
    return things if len(things) > 1 else None


def _in_full(thing: ObjectPhrase | None, question: Question) -> str | None:
    """A thing in the words of the first mention of it: "a blue cup" that is "the cup" later."""
    texts = [other.text for other in question.others]
    if thing is None or thing == question.mover or thing.text in texts:
        return None if thing is None else thing.text
    changed = [phrase.text for change in question.interventions for phrase in (change.object, *change.targets)]
    moving = [] if question.mover is None else [question.mover.text]
    known = {text for text in [*texts, *changed, *moving] if thing.words - {"one"} <= set(text.lower().split())}
    fuller = known - {thing.text} if len(known) > 1 else known
    return fuller.pop() if len(fuller) == 1 else thing.text


@lru_cache(maxsize=64)  # two readers and a stage of every request ask for it
def _read(question: Question) -> Asking | None:
    """The one clause of the question that asks; None if none is understood, or several ask."""
    found = sentences(question)
    if len(found) > MAX_SENTENCES or any(len(sentence.words) > MAX_TOKENS for sentence in found):
        return None
    read = ((at, _read_sentence(sentence, question)) for at, sentence in enumerate(found))
    readings = [(at, *reading) for at, reading in read if reading is not None]
    if len(readings) != 1:
        return None
    at, asking, places = readings[0]
    # The things of a list behind: "What will it hit first if it falls? The red cube or the blue mug?".
    behind = found[at].words[places[-1] + 1 :]
    lists = [behind[place + 1 :] for place, word in enumerate(behind) if word.text == ","]
    lists += [each.words for each in found[at + 1 : at + 2]]
    listed = next((tree.words for words in lists if (tree := parse_all("list", words))), [])
    if listed and asking.form != "which-first":
        return None
    items = question.items
    said = {found[at].words[place].at for place in places}
    said |= _premise(found[: at + 1], places[0], asking, question)
    phrases = [word.phrase for word in listed]
    said |= {at for at, item in enumerate(items) if listed and (item.phrase in phrases or item.key == "or")}
    said |= {at for at, item in enumerate(items) if item.key == "still" and question.interventions}
    # A time limits the event, not the motion; "after 2 s" does so only in questions about what has happened.
    limits = {at: item.quantity.within for at, item in enumerate(items) if item.quantity and item.quantity.within}
    have = not {"has", "have", "had"}.isdisjoint(items[place].key for place in said)
    apart = not any(items[place] in question.clause for place in said)
    if any((items[at] in question.clause and apart) or (not have and "after" in items[at].words) for at in limits):
        return None
    return replace(
        asking,
        among=tuple(listed) or asking.among,
        within=min(limits.values(), default=None),
        items=frozenset(said | limits.keys()),
    )


def _premise(told: Sequence[Sentence], first: int, asking: Asking, question: Question) -> set[int]:
    """The places of "and strikes the bowl" in front of the question, where what the bowl then does is asked."""
    if asking.subject is None:
        return set()
    ends = [len(each.words) for each in told[:-1]] + [max(first - 1, 0)]
    for sentence, end in zip(told, ends, strict=True):
        if sentence.asks and sentence is not told[-1]:
            continue
        for start in (at for at, token in enumerate(sentence.tokens[:end]) if token in {"and", ","}):
            words = sentence.words[start:end]
            struck = next((word.phrase for word in words if word.kind == "T"), None)
            same = struck is not None and _in_full(struck, question) == _in_full(asking.subject, question)
            if same and parse_all("premise", words) is not None:
                return {word.at for word in words}
    return set()


def _read_sentence(sentence: Sentence, question: Question) -> tuple[Asking, list[int]] | None:
    """The longest part of a sentence, up to its end or to a condition, that a pattern covers, and its places."""
    tokens = sentence.tokens
    tries = 0
    rolling = [[word, question.motion.verb, "-ing"] for word in ("by", "of")]
    ends = [at for at in range(len(tokens)) if tokens[at] in _CONDITIONS or tokens[at : at + 3] in rolling]
    for start in range(len(tokens)):
        if not _starts(sentence, start, question):
            continue
        for end in (end for end in (len(tokens), *ends) if end > start):
            tries += 1
            if tries > _MAX_TRIES:
                return None
            places = list(range(start, end))
            commas = [at for at in places if tokens[at] == ","]
            # Without what stands between commas behind its subject: "the car, moving left,".
            inserted = len(commas) > 1 and commas[0] <= start + 4 and tokens[commas[0] - 1] in {"M", "it"}
            if inserted and tokens[commas[0] + 1] in _CONDITIONS | lex.VERBS.keys():
                places = [at for at in places if not commas[0] <= at <= commas[1]]
            elif commas and commas[-1] == end - 1:
                places.pop()
            asking = _read_words([sentence.words[at] for at in places], question)
            if asking is not None:
                return asking, places
    return None


def _read_words(words: Sequence[Word], question: Question) -> Asking | None:
    """What all of some words ask."""
    tokens = {word.text for word in words}
    senses = tokens & {"along", "against"}
    if "arrow" in tokens and senses and senses != {question.motion.arrow}:
        return None  # the motion that was read is another
    tree = parse_all("asked", words)
    asking = None if tree is None else Clause(tree, question).read()
    if asking is None or asking.target is None or asking.relation != "touches" or asking.form != "whether":
        return asking
    # "Roll into the bowl": it would be in it, not only touch it; "fall into the vase" is to hit it.
    hollow = asking.target.head in _HOLLOW and not tokens.isdisjoint({"into", "in"})
    return replace(asking, relation="inside") if hollow else asking


def _starts(sentence: Sentence, at: int, question: Question) -> bool:
    """Whether a question may begin at a token: with an auxiliary, or as in "ball rolls left - hits the mug?"."""
    tokens, word = sentence.tokens, sentence.words[at]
    # "Thrown how the arrow shows": that "how" asks nothing.
    before = [each.text for each in sentence.words[:at] if each.text != "how" or not question.has_read(each.at)]
    if word.kind == "T" and tokens[at + 1 : at + 2] in (["or"], [","]):
        return _may_open(before)  # "the mug or the cone, which one does it hit?"
    if word.text in lex.SETS["starts"] and not (at and sentence.words[at - 1].at == word.at):
        return _may_open(before)
    # "Let go of the ball, it lands on the mug?"
    verb = sentence.words[at + 1] if word.kind in {"PRONOUN", "M", "T"} and at + 1 < len(tokens) else word
    finite = lex.is_form(question.items[verb.at].key, "s")
    return finite and sentence.asks and (at == 0 or tokens[at - 1] == ",")


def _may_open(before: Sequence[str]) -> bool:
    """Whether a question may begin behind these tokens: at the start, or where its condition ends."""
    rest = list(before)
    while rest and rest[-1] in _OPENERS:
        rest.pop()
    if not rest:
        return True
    last = rest[max((at for at, token in enumerate(rest) if token == ","), default=-1) + 1 :]
    closed = len(rest) < len(before) or any(token in lex.CONDITIONALS or token in lex.VERBS for token in last)
    for token, after in pairwise([*last, ""]):
        # Nothing is asked with a "which", "when" or "where" that a clause follows on.
        related = after[:1] in {"M", "T", "S", "X"} or after in _SUBJECTS or after.startswith("OBJ")
        if token in {"which", "when", "where"} and not related and not (token == "when" and after in lex.VERBS):
            return False
    return closed and _ASKING.isdisjoint(last) and last[-1] != "not"


# Words that hold a sentence together; what they join is read, or is named.
_STRUCTURE = (
    lex.PUNCTUATION | lex.AUXILIARIES | lex.BE | lex.MOVER_PRONOUNS | lex.CAUSATIVES | (lex.CONDITIONALS - {"unless"})
    | lex.words("to that which who and but then so i you we us me there also have has had please now here")
    | lex.words("someone somebody ok either go come get goes comes")
    | lex.words("what happens happen tell know will keep keeps kept continue continues continued start starts started")
    | lex.words("begin begins began s yes")
)  # fmt: skip
_NAMING = lex.words(", and there is are we see you have here with in on")
_NEGATIVE = lex.NEGATIONS | lex.words("no none nothing neither nor unless except")
_ALL_OF_IT = lex.words("whole entire")  # "is the whole mug hidden": how much is hidden at most is not asked anywhere
_ADVERBIALS = 8  # tries of one sentence, and words of one
MAX_TEXT = 200  # characters of unread words that are named
_WORD = re.compile(r"\w+(?:['’]\w+)*")  # "won't" is one, and two items


@dataclass(frozen=True)
class Unread:
    """Words that were not understood: `turning` if they may change the question or the motion."""

    turning: tuple[str, ...] = ()
    beside: tuple[str, ...] = ()


@lru_cache(maxsize=64)
def unread(question: Question) -> Unread:
    """The words of the question that no rule has read, sentence by sentence."""
    asking, items = _read(question), question.items
    covered = frozenset[int]() if asking is None else asking.items
    turning = [words for words in (question.pronoun, question.beyond) if words]
    turning += [word for item in items for word in item.words if word in _ALL_OF_IT]
    beside: list[str] = []
    ends = [at for at, item in enumerate(items) if item.key in lex.ENDS]
    for start, end in zip([0, *(at + 1 for at in ends)], [*ends, len(items)], strict=True):
        sentence = range(start, end)
        told = any(at in covered or question.has_read(at) for at in sentence)
        only_described = not told and _describes(items[start:end])
        for run in _unread_runs(question, sentence, covered):
            words = [w for w in _WORD.finditer(question.text) if w.end() > run[0].start and w.start() < run[-1].end]
            said = question.text[words[0].start() : words[-1].end()]
            (beside if only_described else turning).append(said[:MAX_TEXT])
    return Unread(tuple(dict.fromkeys(turning)), tuple(dict.fromkeys(beside)))


def _describes(sentence: Sequence[Item]) -> bool:
    """Whether a sentence only says how something is: nothing happens in it, and nothing is denied."""
    keys = [item.key for item in sentence]
    verbs = [lex.VERBS[key] for key in keys if key in lex.VERBS]
    acting = any(lex.moves(verb) or verb.lemma in lex.TOUCH | lex.OCCLUDE for verb in verbs)
    states = not lex.BE.isdisjoint(keys) or any(verb.kind == "static" for verb in verbs)
    return states and not acting and _NEGATIVE.isdisjoint(keys)


def _unread_runs(question: Question, sentence: range, covered: frozenset[int]) -> Iterator[list[Item]]:
    """The unread items, those together that stand together, without words at the end that only join others."""
    items = question.items
    harmless = _harmless(question, sentence, covered)

    def is_read(at: int) -> bool:
        key, after = items[at].key, key_at(items, at + 1)
        # "By rolling left", "of sliding", "keeps on rolling": before a verb of the motion that was read.
        on = key == "on" and lex.lemma(key_at(items, at - 1)) == "keep"
        leads_on = (on or key in {"by", "of", "when"}) and lex.is_form(after, "ing") and question.has_read(at + 1)
        return leads_on or at in covered or question.has_read(at) or at in harmless or key in lex.PUNCTUATION

    def is_structure(at: int) -> bool:
        return items[at].phrase is None and items[at].key in _STRUCTURE

    def is_order(at: int) -> bool:
        """ "First", "is first rolled left, then ...", "as the ball rolls": when, as the rest of the sentence says."""
        if at == sentence.start or items[at].key != "first":
            return at == sentence.start and (items[at].key == "first" or is_during(items, at))
        return at + 1 < sentence.stop and bool(question.motion.steps) and question.has_read(at + 1)

    for read, places in groupby(sentence, is_read):
        run = [*dropwhile(is_structure, reversed([*places]))][::-1]
        if not read and not all(is_structure(at) or is_order(at) for at in run):
            yield [items[at] for at in run]


def _harmless(question: Question, sentence: range, covered: frozenset[int]) -> set[int]:
    """The places of what changes nothing: a floor where it moves, "please", the mover named again."""
    items = question.items
    said = [items[at] for at in sentence]
    # "There is a ball and a mug.", "A ball, a mug."; but not "Replace the ball", which has no verb that is known.
    names = all(item.thing if item.phrase else item.key in _NAMING for item in said)
    apart = not any(one.phrase and two.phrase for one, two in pairwise(said))
    opens = lex.BE.isdisjoint(item.key for item in said) or said[0].key in {"there", "here"}
    if names and apart and opens:
        return set(sentence)
    known = {other.object for other in question.motion.others}
    found = {
        at
        for at in sentence
        if (phrase := items[at].phrase)
        and (phrase.head in lex.AGENTS or question.means_mover(phrase) or phrase in known)
    }
    tries = 0
    for at in sentence:
        if items[at].key == "nobody" and key_at(items, at + 1) in lex.VERBS:
            found |= {at, at + 1}  # "nobody throws the ball and it falls"; another thing than the mover is named
        if at in found or at in covered or question.has_read(at) or tries == _ADVERBIALS:
            continue
        tries += 1
        parsed = read_adverbial(items[: sentence.stop], at, _ADVERBIALS)
        if parsed is not None and parsed[0].name in NO_MATTER:
            found |= set(range(at, parsed[1]))
    return found
