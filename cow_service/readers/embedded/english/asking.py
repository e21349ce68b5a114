"""Reads a clause that asks: its tree by the grammar, as the event that is asked about and the things it names."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import dropwhile
from typing import get_args

from lark import Token, Tree

from cow_service.readers.embedded.english import lexicon as lex
from cow_service.readers.embedded.english.grammar import parse_all
from cow_service.readers.embedded.english.lexicon import Item, ObjectPhrase, Word, key_at, plain_words
from cow_service.readers.embedded.english.questions import Question
from cow_service.readers.options import plain
from cow_service.records import AskedForm, AskedRelation

IT = "it"  # as a target: the one other thing that is named
MOVER = frozenset({"M", "PRONOUN"})
# By the node of an act: the relation, and whether the subject of the clause is what it is done to.
_ACTS = {
    act: (relation, table == "done_to")
    for table in ("does", "done_to")
    for relation in get_args(AskedRelation)
    for act in lex.TABLES[table].get(relation, "").split()
}
_FORMS: dict[str, AskedForm] = {"either": "which-first"}
_FORMS.update({form.replace("-", "_"): form for form in get_args(AskedForm)})
_BY_MOVER: dict[AskedRelation, AskedRelation] = {"covers": "covered", "covered": "covers"}  # "the mug hides it"
_INNER = frozenset({"untouched", "still"})  # acts inside `stays`
_NEGATIONS = frozenset(
    {"no", "none", "misses", "missed", "avoids", "stays", "stays_up", "no_contact", "sticks_out", "stops_short"}
    | {"spared", "safe", "stays_in", "stays_on", "seen"}
)


_SPARING = _NEGATIONS - {"no", "none", "no_contact"}
_ANY_PART = frozenset({"any_part", "all_seen", "partly", "wholly", "in_full", "at_some_time"})  # hidden in part or once


@dataclass(frozen=True)
class Asking:
    """What a clause asks; things are tokens of the clause. None is the mover as `subject`, anything as `target`."""

    form: AskedForm
    relation: AskedRelation
    negated: bool
    subject: str | None
    target: str | None
    among: tuple[str, ...] = ()
    partly: bool = False
    every: bool = False


def read_clause(words: Sequence[Word], beside: str | None) -> Asking | None:
    """What a clause asks, if all its words make sense. `beside`: the token of a second mover, for "they"."""
    tree = parse_all("asked", words)
    if tree is None:
        return None
    before = {str(token) for node in tree.find_data("once") for token in _tokens(node)}
    for node in list(tree.iter_subtrees()):
        node.children = [each for each in node.children if not (isinstance(each, Tree) and each.data == "once")]
    asking = _read_tree(tree, beside)
    # What is met before must be what then acts, or is moved: else it says something of the time.
    met = asking is None or not before or not before.isdisjoint({asking.subject or asking.target, IT})
    return asking if met else None


def _read_tree(tree: Tree[Token], beside: str | None) -> Asking | None:
    form: AskedForm = next(_FORMS[str(node.data)] for node in tree.iter_subtrees_topdown() if node.data in _FORMS)
    negations = sum(node.data in _NEGATIONS for node in tree.iter_subtrees())
    relation, done_to = _act(tree)
    subject = _tokens(next(tree.find_data("subject"), None))
    listed = [token for node in (*tree.find_data("list"), *tree.find_data("kind")) for token in _tokens(node)]
    things = list(dict.fromkeys(str(t) for t in _tokens(tree) if t.type == "T" and t not in (*subject, *listed)))
    if form == "where":
        things = []  # "what does it land on, the floor or the mug?"
    open_ = any(token.type == "PRONOUN" and token == "them" for token in _tokens(tree))  # which of them
    if open_ or negations > 1 or len(things) > 1 or (negations and form not in {"whether", "changes"}):
        return None
    if form == "which-first" and not things and not listed and next(tree.find_data("lands_on"), None) is not None:
        form = "where"  # "what does it land on?": on the floor, too
    of_another = form == "which-first" and things  # "which mug is hit by the cone first": not by the mover
    partly = relation in {"covers", "covered"} and any(node.data in _ANY_PART for node in tree.iter_subtrees())
    target = things[0] if things else None
    asking = Asking(form, relation, negations == 1, None, target, tuple(map(str, listed)), partly)
    inside_it = any(token.type in MOVER for token in subject) and next(tree.find_data("inside_bare"), None) is not None
    if inside_it or (any(token.type == "M" for token in subject) and _speaks_of_it(tree)):
        asking = replace(asking, target=IT)
    if any(token.type == "S" for token in _tokens(tree)) and not of_another:
        return _of_kind(asking, tree, subject, done_to)
    alone = next(tree.find_data("meet_bare"), None) is not None
    pronoun = next((str(token) for token in subject if token.type == "PRONOUN"), None)
    if pronoun == "they":
        return _together(asking, beside)
    if of_another or alone or (pronoun is not None and beside is not None):
        return None  # which of the two movers is meant is open
    return asking if listed and form == "which-first" else _with_subject(asking, tree, subject, done_to)


def _of_kind(asking: Asking, tree: Tree[Token], subject: list[Token], done_to: bool) -> Asking | None:
    """What is asked of several things: it happens with one of them at least, with each, or with none."""
    nodes = {str(node.data) for node in tree.iter_subtrees()}
    sets = [str(token) for token in _tokens(tree) if token.type == "S"]
    thing = next((str(token) for token in subject if token.type == "T"), None)
    suffers, every, spared = any(t.type == "S" for t in subject), "all_of" in nodes, bool(_SPARING & nodes)
    if len(sets) > 1 or (every and "no" in nodes) or (done_to and thing is not None):
        return None
    if spared:  # to spare all is to hit none; where any is spared, not each is hit
        every = not every and suffers
    relation = asking.relation
    if suffers != done_to or asking.form == "which-first":  # else the things suffer it, or the subject does it to them
        acts_on_mover = any(t.type in MOVER for node in tree.find_data("object") for t in _tokens(node))
        if relation not in {"touches", "covers"} or (suffers and not acts_on_mover):
            return None
        relation = "covered" if relation == "covers" else relation
    doer = asking.target if suffers else thing
    return replace(asking, among=tuple(sets), every=every, relation=relation, subject=doer, target=None)


def _speaks_of_it(tree: Tree[Token]) -> bool:
    """ "Does the ball hit it?": not the ball itself."""
    return any(token == IT for node in tree.find_data("object") for token in _tokens(node))


def _act(tree: Tree[Token]) -> tuple[AskedRelation, bool]:
    """The relation of the outermost act, and whether the subject suffers it."""
    found = [str(node.data) for node in tree.iter_subtrees_topdown() if node.data in _ACTS]
    inner = [name for name in found if name in _INNER]
    return _ACTS[(inner or found or ["touches"])[0]]


def _tokens(tree: Tree[Token] | None) -> list[Token]:
    """The things and pronouns of a tree, in order."""
    return [] if tree is None else [t for t in tree.scan_values(lambda value: isinstance(value, Token)) if t.type]


def _together(asking: Asking, beside: str | None) -> Asking | None:
    """ "Will they collide?": the two things that move, or the mover and the one other thing."""
    if asking.target is not None:
        return None
    return replace(asking, subject=None, target=beside or IT)


def _with_subject(asking: Asking, tree: Tree[Token], subject: list[Token], done_to: bool) -> Asking:
    """Who does it, and to whom: the words "it" and the mover's stand for the mover."""
    thing = next((str(token) for token in subject if token.type == "T"), None)
    relation, target, doer = asking.relation, asking.target, thing
    mover_acted = any(t.type in MOVER for node in tree.find_data("object") for t in _tokens(node))
    if target == IT:
        return asking
    if asking.form == "what-happens":
        target, doer = thing or target, None
    elif done_to and relation == "covers":
        # Hidden: the mover by another, one thing by another, or a thing by the mover.
        by_other = target is not None and thing is not None
        if (subject and thing is None) or by_other:
            relation = "covered"
        else:
            target, doer = thing, None
    elif done_to and relation in {"touches", "tips", "moves"}:
        target, doer = (
            (thing, target) if thing is not None else (target or ("M" if relation != "touches" else None), None)
        )
    elif mover_acted and target is None:
        target, doer = thing, None
        relation = _BY_MOVER.get(relation, relation)
    return replace(asking, relation=relation, subject=doer, target=target)


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
    return _several_words(at, words, phrase, sentence, listed) or _thing(at, determiners, content, phrase, sentence)


def _counts(before: Sequence[str]) -> bool:
    """Whether what stands in front is "any of", "all the", "neither"."""
    return before[-1:] in (["all"], ["neither"], ["no"]) or (
        before[-1:] == ["of"] and not _SOME.isdisjoint(before[-2:-1])
    )


def _several_words(at: int, words: Sequence[str], phrase: ObjectPhrase, sentence: Sentence, listed: bool) -> list[Word]:
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
