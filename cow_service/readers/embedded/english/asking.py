"""Reads a clause that asks: its tree by the grammar, as the event that is asked about and the things it names."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import dropwhile
from typing import get_args

from cow_service.readers.embedded.english import lexicon as lex
from cow_service.readers.embedded.english.grammar import Node
from cow_service.readers.embedded.english.lexicon import ObjectPhrase, Word, key_at
from cow_service.readers.embedded.english.questions import Question
from cow_service.records import AskedForm, AskedRelation

# By the node of an act: the relation, and whether the subject of the clause is its object.
_ACTS = {
    act: (relation, table == "done_to")
    for table in ("does", "done_to")
    for relation in get_args(AskedRelation)
    for act in lex.TABLES[table].get(relation, "").split()
}
_FORMS: dict[str, AskedForm] = {"either": "which-first"}
_FORMS.update({form.replace("-", "_"): form for form in get_args(AskedForm)})
_BY_MOVER: dict[AskedRelation, AskedRelation] = {"covers": "covered", "covered": "covers"}  # "the mug hides it"
_SPARING = lex.words("misses avoids stays stays_up stays_in stays_on spared safe seen")
_NEGATIONS = _SPARING | {"no", "none"}
_ANY_PART = frozenset({"any_part", "partly", "wholly", "at_some_time"})  # hidden in part or once


@dataclass(frozen=True)
class Asking:
    """What a clause asks. None is the mover as `subject`, anything as `target`; `among` are things or kinds."""

    form: AskedForm
    relation: AskedRelation
    negated: bool
    subject: ObjectPhrase | None = None
    target: ObjectPhrase | None = None
    among: tuple[Word, ...] = ()
    partly: bool = False
    every: bool = False
    within: float | None = None  # s
    items: frozenset[int] = frozenset()  # the places of what asks


def _things(nodes: Iterable[Node], *kinds: str) -> list[Word]:
    """The things and pronouns of some nodes in order; all kinds without one."""
    return [word for node in nodes for word in node.words if word.kind and (not kinds or word.kind in kinds)]


class Clause:
    """The parts of a clause: its subject, the one thing that is acted on or acts, and the things of a kind."""

    def __init__(self, tree: Node, question: Question) -> None:
        self.names, self.question = tree.names, question
        subjects = [*tree.find("subject")][:1]
        self.subject, self.objects = _things(subjects), _things(tree.find("object"))
        self.doer = next((word.phrase for word in self.subject if word.kind == "T"), None)
        self.several, self.pronouns = _things([tree], "S"), _things([tree], "PRONOUN")
        self.listed = [*_things(tree.find("list")), *_things(tree.find("kind"))]
        known = {word.phrase for word in (*self.subject, *self.listed) if word.kind == "T"}
        self.things = list(dict.fromkeys(word.phrase for word in _things([tree], "T") if word.phrase not in known))
        acts = [name for name in self.names if name in _ACTS] or ["touches"]  # the outermost, or one inside `stays`
        self.relation, self.done_to = _ACTS[next((name for name in acts if name in {"untouched", "still"}), acts[0])]
        self.mover_acted = any(word.kind in {"M", "PRONOUN"} for word in self.objects)

    def read(self) -> Asking | None:
        """What the clause asks; None if that is not plain."""
        names, nodes, others = self.names, set(self.names), self.question.others
        form: AskedForm = next(_FORMS[name] for name in names if name in _FORMS)
        things = [] if form == "where" else self.things  # "what does it land on, the floor or the mug?"
        negations = sum(name in _NEGATIONS for name in names)
        which_of_them = any(word.text == "them" for word in self.pronouns)
        kinds = {word.kind for word in self.subject}
        of_it = any(word.text == "it" for word in self.objects)
        meets_itself = self.mover_acted and not (self.done_to or of_it) and not kinds.isdisjoint({"M", "PRONOUN"})
        if which_of_them or negations > 1 or len(things) > 1 or (negations and form not in {"whether", "changes"}):
            return None
        if form == "which-first" and not things and not self.listed and "lands_on" in nodes:
            form = "where"  # "what does it land on?": on the floor, too
        of_another = form == "which-first" and bool(things)  # "which mug is hit by the cone first": not by the mover
        partly = self.relation in {"covers", "covered"} and not nodes.isdisjoint(_ANY_PART)
        target = things[0] if things else self.question.mover if meets_itself else None
        asking = Asking(form, self.relation, negations == 1, None, target, tuple(self.listed), partly)
        if self.several and not of_another:
            return self._of_several(asking)
        # "Does the ball hit it?": not the ball itself, but the one other thing.
        of_it = of_it and "M" in kinds
        pronoun = next((word.text for word in self.subject if word.kind == "PRONOUN"), None)
        beside = [each.object for each in self.question.motion.others]
        if pronoun == "they" and target is None and not of_it:
            # "Will they collide?": the two things that move, or the mover and the one other thing.
            of_it = len(beside) != 1
            target = None if of_it else beside[0]
        elif pronoun == "they" or of_another or (pronoun is not None and len(beside) == 1):
            return None  # which of the two movers is meant is open
        elif not of_it and not (self.listed and form == "which-first"):
            return self._of_one(asking)
        if of_it and len(others) != 1:
            return None
        return replace(asking, target=others[0] if of_it else target)

    def _of_several(self, asking: Asking) -> Asking | None:
        """How a question about several things counts: with at least one of them, with each, or with none."""
        relation, every = self.relation, "all_of" in self.names
        suffer = any(word.kind == "S" for word in self.subject)
        if len(self.several) > 1 or (every and "no" in self.names) or (self.done_to and self.doer is not None):
            return None
        if not _SPARING.isdisjoint(self.names):  # to spare all is to hit none; where any is spared, not each is hit
            every = not every and suffer
        # Else they suffer it, or the subject does it to them.
        if suffer != self.done_to or asking.form == "which-first":
            if relation not in {"touches", "covers"} or (suffer and not self.mover_acted):
                return None
            relation = _BY_MOVER.get(relation, relation)
        doer = asking.target if suffer else self.doer
        return replace(asking, among=tuple(self.several), every=every, relation=relation, subject=doer, target=None)

    def _of_one(self, asking: Asking) -> Asking:
        """Who does it, and to whom: the words "it" and the mover's stand for the mover."""
        relation, target, doer = self.relation, asking.target, self.doer
        if asking.form == "what-happens":
            target, doer = doer or target, None
        elif self.done_to and relation == "covers":
            # Hidden: the mover by another, one thing by another, or a thing by the mover.
            if (self.subject and doer is None) or (target is not None and doer is not None):
                relation = "covered"
            else:
                target, doer = doer, None
        elif self.done_to and relation in {"touches", "tips", "moves"}:
            if doer is not None:
                target, doer = doer, target
            elif target is None and relation != "touches":
                target = self.question.mover
        elif self.mover_acted and target is None:
            target, doer, relation = doer, None, _BY_MOVER.get(relation, relation)
        return replace(asking, relation=relation, subject=doer, target=target)


MAX_TOKENS = 80  # of one sentence; a longer one is not read
_GENERIC = lex.GENERIC | lex.words("obstacle obstacles body bodies")
_PLURAL = lex.words("objects things items ones obstacles bodies")
_OF_GENERIC = lex.words("first other different all single")
_TRAILING = lex.words("hard fast slow alone anyway whatsoever second third last twice once again")  # more is asked
_COUNTING = lex.SETS["counting"] | (lex.NUMBER_WORDS.keys() - {"one"})
_TWO = (["the", "two"], ["those", "two"], ["these", "two"], ["both"], ["two"])
_CHANCES = ([], ["chance"], ["danger"], ["risk"], ["possibility"], ["likelihood"])
_SOME = lex.words("any every each either neither both all many no none one some")  # of the things of a kind


@dataclass
class Sentence:
    """One sentence in words of the grammar. A `T`, `S` or `K` has its phrase, but an `S` for the things named before.

    An `X`, which no rule has, stands for what is of no one thing.
    """

    words: list[Word] = field(default_factory=list[Word])
    asks: bool = False  # it ends with a question mark, or with the text

    @property
    def tokens(self) -> list[str]:
        """The texts of its words."""
        return [word.text for word in self.words]

    @property
    def counts(self) -> bool:
        """Whether it ends with "any of", "all the", "neither"."""
        last = self.tokens[-2:]
        return last[-1:] in (["all"], ["neither"], ["no"]) or (last[-1:] == ["of"] and last[0] in _SOME)


def sentences(question: Question) -> list[Sentence]:
    """The sentences of a question, empty ones left out."""
    found = [Sentence()]
    for at, item in enumerate(question.items):
        if item.key in lex.ENDS:
            found[-1].asks = item.key == "?"
            found.append(Sentence())
            continue
        limit = item.quantity is not None and item.quantity.within is not None
        if limit or (item.start in question.read and item.quantity is not None and item not in question.clause):
            continue
        if item.phrase is not None:
            found[-1].words += _phrase_words(at, item.phrase, question, found[-1])
        elif item.key != "still" or not question.interventions:  # "will it still hit it?": with what is taken away
            found[-1].words += lex.plain_words(["," if item.key in {":", "—", "–"} else item.key], at)
    found[-1].asks = True
    return [sentence for sentence in found if sentence.words]


def _phrase_words(at: int, phrase: ObjectPhrase, question: Question, sentence: Sentence) -> Iterator[Word]:
    """A noun phrase in words of the grammar."""
    words = [word.lower() for word in question.items[at].words]
    content = list(dropwhile(lex.DETERMINERS.__contains__, words))
    determiners, before = words[: len(words) - len(content)], sentence.tokens
    asked = not {"which", "what"}.isdisjoint(determiners)
    plain = phrase.colour is None and phrase.number is None and not phrase.inside_box
    place = phrase.head in lex.NO_THINGS and not phrase.as_thing
    if words in _TWO and before[-1:] == ["of"] and before[-2:-1] not in _CHANCES:
        yield Word("S", "them", at)
    elif words == ["each", "other"] or place or lex.SETS["plain_words"].issuperset(content):
        yield from lex.plain_words(["they"] if question.motion.others and words in _TWO else words, at)
    elif question.means_mover(phrase) and words[0] not in _SOME | {"which", "what"}:
        yield Word("M", "M", at, question.mover)
    elif plain and not _GENERIC.isdisjoint(content) and (_GENERIC | _OF_GENERIC).issuperset(content):
        kept = [word for word in content if word in {"first", "different", "all", "single"}]
        kind = "X" if content[0] == "one" and content[1:] else "OBJS" if content[-1] in _PLURAL else "OBJ"
        yield from lex.plain_words([*determiners, *kept] if kind != "X" else [], at)  # "one object" is a number
        yield Word(kind, kind, at)
    elif (counted := _count_words(at, words, phrase, question, sentence)) is not None:
        yield from counted
    elif before[-2:] in (["which", "of"], ["what", "of"]) and phrase.noun is not None and "other" not in content:
        yield Word("K", "K", at, phrase)
    else:
        # A phrase of no one thing, or with a word of counting or of order in it.
        vague = not asked and not lex.VAGUE_DETERMINERS.isdisjoint(determiners)
        number = content[0].isdecimal() and phrase.number is None  # "3 balls"
        single = determiners == ["the"] and content[0] == "other" and lex.singular(content[-1]) == content[-1]
        several = vague or number or not _COUNTING.isdisjoint(content[single:]) or content[-1] in _TRAILING
        yield from [Word("", "which", at)] if asked and not several else []
        kind = "X" if several else "K" if asked else "T"
        yield Word(kind, kind, at, phrase)


def _count_words(
    at: int, words: Sequence[str], phrase: ObjectPhrase, question: Question, sentence: Sentence
) -> list[Word] | None:
    """ "Both mugs", "any of the other two mugs", "neither mug", "of the three balls, which ..."; None for no such."""
    fronted = sentence.tokens in (["of"], ["out", "of"])
    counts = fronted or sentence.counts
    listed = not {",", ":", "or"}.isdisjoint((key_at(question.items, at - 1), key_at(question.items, at + 1)))
    plain = not (phrase.colour or phrase.number is not None or phrase.place or phrase.inside_box)
    of_it = words[0] in _SOME or (words[0] in {"a", "an"} and plain and not listed)
    part = counts and words[0] in {"the", "this", "that"} and lex.singular(words[-1]) == words[-1]  # "any of the cube"
    if counts == of_it or phrase.noun is None or phrase.head in _GENERIC or part:
        return None
    kind = [word for word in words if word not in {"the", "these", "those"}]
    if not set(kind) & _COUNTING <= _SOME | lex.NUMBER_WORDS.keys() | {"other"} or kind[-1] in _TRAILING:
        return [Word("X", "X", at)]
    said = words[0] if of_it else "" if fronted else next(word for word in reversed(sentence.tokens) if word != "of")
    name = " ".join([*([said] if not of_it and said in {"both", "either", "neither"} else []), *kind])
    return [*lex.plain_words([said] if of_it else [], at), Word("S", "S", at, replace(phrase, text=name))]
