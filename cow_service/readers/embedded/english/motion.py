"""Finds the clause that holds the motion: which verb, whose subject, how far its words reach.

A conditional clause comes first ("if the ball rolls"), then a statement, then a question that holds a verb of motion.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

from lark import Token, Tree

from cow_service.readers.embedded.english import lexicon as lex
from cow_service.readers.embedded.english.grammar import read_from
from cow_service.readers.embedded.english.interventions import TrailWords
from cow_service.readers.embedded.english.lexicon import (
    ARROWS,
    Item,
    ObjectPhrase,
    QuantityWords,
    key_at,
    phrase_at,
    words_of,
)
from cow_service.records import MotionKind, Vector

SENTENCE_END = frozenset(".?!;:")
_ClauseKind = Literal["cond", "plain", "question"]
_GOES_ON = lex.PLACES | lex.words(
    "~ to toward towards along in at as opposite against away and then forward backward though"
)
# A conditional clause is where the motion stands; a question without one may still hold it.
_RANKS: dict[_ClauseKind, int] = {"cond": 30, "plain": 20, "question": 10}
_UNKNOWN_VERB = 15
_CONTACT = 16
_WINDOW = 60  # items: no clause is longer
_PARTICLES = lex.words("up down away off out over")
_STILL = lex.words("still stationary motionless unmoved immobile")
_BETWEEN = lex.words("to be being on of in by slowly quickly suddenly going about allowed")


@dataclass
class _Clause:
    kind: _ClauseKind
    start: int
    subject: ObjectPhrase | None = None
    verbs: int = 0

    def offer(self, phrase: ObjectPhrase) -> None:
        """Takes the first noun phrase for the subject; scenery gives way to a thing ("on the table the ball rolls")."""
        if self.verbs or phrase.head in lex.ABSTRACT or (phrase.noun is None and phrase.colour is None):
            return
        if self.subject is None or (self.subject.head in lex.SCENERY and phrase.head not in lex.SCENERY):
            self.subject = phrase


@dataclass(frozen=True)
class MotionCandidate:
    """A motion that the question may be about: its verb is at `at`, in the clause that begins at `start`.

    `verb` is empty for a condition without a verb of motion.
    Its subject is None where the clause has a pronoun, or nothing.
    """

    at: int
    start: int
    verb: str
    kind: MotionKind | None
    subject: ObjectPhrase | None
    rank: int

    @property
    def asked(self) -> bool:
        """Whether the verb is that of the question, not of a condition."""
        return self.rank == _RANKS["question"]


@dataclass
class Clauses:
    """What one pass over the clauses finds; the subjects of its questions are given with their places."""

    candidates: list[MotionCandidate] = field(default_factory=list[MotionCandidate])
    question_subjects: list[tuple[int, ObjectPhrase]] = field(default_factory=list[tuple[int, ObjectPhrase]])


def read_clauses(found: Sequence[Item]) -> Clauses:
    """One pass over the clauses: every verb of motion with its subject, and the subjects of the questions."""
    clauses, clause = Clauses(), _Clause("plain", 0)
    for at, item in enumerate(found):
        opened = _opens(found, at, clause)
        if opened:
            _close(clauses, clause)
            clause = _Clause(opened, at)
        elif item.phrase:
            if clause.kind == "question" and clause.subject is None and not is_vague(item):
                clauses.question_subjects.append((at, item.phrase))
            clause.offer(item.phrase)
        candidate = None
        if not opened:
            candidate = None if item.phrase else _candidate(found, at, clause)
        if candidate:
            clauses.candidates.append(candidate)
        clause.verbs += item.key in lex.VERBS
    _close(clauses, clause)
    return clauses


def _close(clauses: Clauses, clause: _Clause) -> None:
    known = bool(clauses.candidates) and clauses.candidates[-1].start == clause.start
    if clause.kind == "cond" and clause.subject and not known:
        clauses.candidates.append(MotionCandidate(clause.start, clause.start, "", None, clause.subject, _UNKNOWN_VERB))


def _is_subject(item: Item) -> bool:
    return item.phrase is not None or item.key in lex.MOVER_PRONOUNS or item.key in {"there", "i", "you", "we"}


def _opens(found: Sequence[Item], at: int, clause: _Clause) -> _ClauseKind | None:
    """The kind of the clause that begins at a word; None where none begins."""
    key = found[at].key
    if key in SENTENCE_END:
        return "plain"
    if key in {",", "(", ")", "—", "–"}:
        return None if clause.kind == "cond" and not clause.verbs else "plain"
    if key in lex.CONDITIONALS or is_during(found, at):
        return "cond"
    if key in lex.CAUSATIVES:
        return None if key_at(found, at + 1) in {"go", "loose"} else clause.kind
    if _is_inversion(found, at):
        return "question"
    follows = at + 1 < len(found) and found[at + 1].phrase is not None
    return clause.kind if key in {"and", "but", "then"} and clause.verbs and follows else None


def is_during(found: Sequence[Item], at: int) -> bool:
    """ "As the cube slides left, does it ...": an "as" that opens a sentence, in front of a thing."""
    after = phrase_at(found, at + 1)
    opens = found[at].key == "as" and key_at(found, at - 1) in SENTENCE_END
    return opens and after is not None and after.is_thing


def _is_inversion(found: Sequence[Item], at: int) -> bool:
    key = found[at].key
    after = at + 2 if key_at(found, at + 1) in lex.NEGATIONS else at + 1
    if after >= len(found) or not _is_subject(found[after]):
        return False
    return key in lex.AUXILIARIES or (key in lex.BE and key != "'s" and not (at and _is_subject(found[at - 1])))


def _candidate(found: Sequence[Item], at: int, clause: _Clause) -> MotionCandidate | None:
    key = found[at].key
    if key in lex.CAUSATIVES and key_at(found, at + 1) in {"go", "loose"}:
        return MotionCandidate(
            at, clause.start, "let go", "fall", _subject(found, at, "drop", clause), _RANKS[clause.kind]
        )
    if key in _STILL and key_at(found, at - 1) in lex.BE and clause.kind != "question":
        return MotionCandidate(at, clause.start, "stay", "static", clause.subject, _RANKS[clause.kind])
    verb = lex.VERBS.get(key)
    if verb is None or _is_idle(found, at, verb) or key_at(found, at - 1) == "nobody":
        return None
    rank, kind = _rank(found, at, verb, clause), verb.kind
    if rank == 0 or _is_about_picture(found, at, clause) or (kind is None and not _is_struck(found, at, verb)):
        return None
    negated = any(key_at(found, before) in lex.NEGATIONS | {"nothing"} for before in (at - 1, at - 2, at - 3))
    kind = "static" if negated else kind or "linear"
    if verb.lemma == "keep" and (_STILL | {"in", "at"}).intersection({key_at(found, at + 1)}):
        kind = "static"
    return MotionCandidate(at, clause.start, verb.lemma, kind, _subject(found, at, verb.lemma, clause), rank)


def _is_about_picture(found: Sequence[Item], at: int, clause: _Clause) -> bool:
    """ "Assume the camera stays still": nothing in the scene is meant."""
    acting = phrase_at(found, at - 2 if key_at(found, at - 1) in lex.BE else at - 1)
    return clause.subject is None and acting is not None and acting.head in lex.ABSTRACT


def _is_idle(found: Sequence[Item], at: int, verb: lex.Verb) -> bool:
    """A verb that only leads to the next one ("keeps moving") or says where a thing is ("the ball resting on")."""
    if verb.kind == "static" and (verb.form == "ing" or key_at(found, at - 1) in {"that", "which"}):
        return True
    if verb.lemma == "rest" and key_at(found, at - 1) == "at" and key_at(found, at - 2) not in lex.BE:
        return True
    if verb.lemma == "reverse" and key_at(found, at - 1) == "in":
        return True
    for after in range(at + 1, min(at + 5, len(found))) if verb.lemma in lex.WEAK else ():
        key = found[after].key
        if key in lex.VERBS and lex.VERBS[key].kind:
            return True
        if key not in _BETWEEN:
            return False
    return False


def _is_struck(found: Sequence[Item], at: int, verb: lex.Verb) -> bool:
    return verb.lemma in {"hit", "strike", "knock", "bump"} and verb.form in {"past", "base"} and is_passive(found, at)


def is_passive(found: Sequence[Item], at: int) -> bool:
    """Whether the verb at a place is in the passive voice: a participle behind a form of "be"."""
    verb = lex.VERBS.get(found[at].key)
    past = verb is not None and (verb.form == "past" or verb.lemma in {"hit", "cast"})
    before = [key_at(found, at - 1), key_at(found, at - 2), key_at(found, at - 3)]
    return past and not lex.BE.isdisjoint(before)


def _rank(found: Sequence[Item], at: int, verb: lex.Verb, clause: _Clause) -> int:
    rank = _RANKS[clause.kind]
    if verb.kind is None:
        return min(rank, _CONTACT) if clause.kind == "cond" else 0
    if verb.kind == "static" and clause.kind != "cond":
        return 5
    participle = verb.form in {"ing", "past"} and not is_passive(found, at)
    return max(rank, _RANKS["plain"]) if participle else rank


def _subject(found: Sequence[Item], at: int, verb: str, clause: _Clause) -> ObjectPhrase | None:
    """What moves: the object of an active verb where a person acts, the subject otherwise; None for a pronoun."""
    form, passive = lex.VERBS[found[at].key].form if found[at].key in lex.VERBS else "base", is_passive(found, at)
    near = phrase_at(found, at - 1)
    rolling = (
        (form == "ing" or (form == "past" and clause.kind == "question")) and near and near.head not in lex.ABSTRACT
    )
    thrown = form == "past" and not passive and clause.verbs and near and near.is_thing and near.head not in lex.AGENTS
    if rolling or thrown:  # "which cube is hit by the ball thrown along the arrow"
        return near
    led = _behind_participle(found, at) if form in {"past", "ing"} and not passive and clause.subject is None else None
    if led is not None:
        return led
    relative = at - 2 if key_at(found, at - 1) in lex.BE else at - 1
    if key_at(found, relative) in {"that", "which", "who"} and phrase_at(found, relative - 1):
        return phrase_at(found, relative - 1)
    acted = clause.subject is None or clause.subject.head in lex.AGENTS
    if acted and not passive and verb in lex.TRANSITIVE:
        after = at + 1
        while key_at(found, after) in _PARTICLES | {"go", "loose", "of"}:
            after += 1
        target = phrase_at(found, after)
        if target and (target.head not in lex.ABSTRACT):
            return target
        if key_at(found, after) in lex.MOVER_PRONOUNS:
            return None
    return clause.subject


def _behind_participle(found: Sequence[Item], at: int) -> ObjectPhrase | None:
    """ "Sent towards the mug, the ball ...", "after rolling left, will the ball ...": the subject behind it."""
    comma = next((place for place in range(at, len(found)) if found[place].key in SENTENCE_END | {","}), len(found))
    opens = key_at(found, at - 1) in SENTENCE_END | {","} | lex.CONDITIONALS
    if not opens or key_at(found, comma) != "," or phrase_at(found, at + 1) is not None:
        return None
    subject = phrase_at(found, comma + 1 + (key_at(found, comma + 1) in lex.AUXILIARIES))
    return subject if subject is not None and subject.is_thing and subject.head not in lex.AGENTS else None


def is_vague(item: Item) -> bool:
    """Whether a noun phrase names no certain object: "which ball", "any cube", "the first thing"."""
    content = [word for word in item.words if word not in lex.DETERMINERS]
    order = bool(content) and content[0] == "first" and lex.GENERIC.issuperset(content[1:])
    return bool(item.words) and (item.words[0] in lex.VAGUE_DETERMINERS or order)


def clause_end(found: Sequence[Item], at: int) -> int:
    """One past the last item that belongs to the verb at `at`: where the next clause, or the question, begins."""
    end = at + 1
    while end < min(len(found), at + _WINDOW) and not _ends_clause(found, end):
        end += 1
    return min(end, len(found))


def _ends_clause(found: Sequence[Item], at: int) -> bool:
    item, key, after = found[at], found[at].key, at + 1
    if key in SENTENCE_END or key in lex.CONDITIONALS or key in {"what", "why"} or _is_inversion(found, at):
        return True
    if key == "how":  # "thrown how the arrow shows"
        arrow = phrase_at(found, at + 1)
        return arrow is None or arrow.head not in ARROWS
    if key == ",":
        joined = key_at(found, after) in {"and", "then", "but"}
        after += joined
        ahead = phrase_at(found, after)
        return key_at(found, after) not in _GOES_ON if not joined else ahead is not None
    verb = lex.VERBS.get(key)
    contact = verb is not None and verb.lemma in lex.TOUCH | lex.OCCLUDE | lex.LAND
    return contact or (item.phrase is not None and is_vague(item))


ArrowSense = Literal["along", "against"]

SLIGHTLY = math.tan(math.pi / 8)  # "slightly up": half of a diagonal's 45 degrees
_WINDOW_MOTION = 14  # words of one adverbial
_MAX_TRIES = 16  # of one motion: each takes a part of a ms
_FIRST_LEG_ONLY = frozenset({"along", "against", "reversed", "towards", "forward", "backward"})
_THEN = lex.words("then afterwards finally")
_KICKED = lex.words("kick hit knock strike push send flick tap go swing")
_TIPPED = lex.words("knock push kick hit turn blow go")
_RISING = lex.words("lift raise rise climb ascend")
_SETS_GOING = lex.words("send start keep get")
_FALLING = lex.words("fall drop release plummet plunge descend sink")
_SINKING = _FALLING | {"lower"}
_CLIMBING = lex.words("rise ascend")
_GOES_STRAIGHT = lex.words("go move drive roll travel continue run")


@dataclass(frozen=True)
class StepWords:
    """A further leg of a motion, behind "then"; as in `MotionWords`."""

    direction: Vector | None
    depth: float
    quantities: tuple[QuantityWords, ...] = ()


@dataclass(frozen=True)
class OtherWords:
    """Another thing that moves at the same time."""

    object: ObjectPhrase
    motion: MotionWords


@dataclass(frozen=True)
class MotionWords:
    """How the question says that the mover moves; None and 0 where it does not say.

    `direction` is a unit vector in image pixels, x right, y down. A fall has one only where it leaves the vertical
    ("falls to the left"): its kind stays "fall". `depth` is the sine of the angle out of the image plane: -1 towards
    the camera, 1 away from it, and 0.71 of that where a direction in the image is named too. `verb` is in its base
    form, empty where no known verb of motion stands in the question. `towards` is the object that the motion aims at;
    the direction to it is for the caller to measure. `trail`: it goes on along the trail that is shown.
    `contradictory`: two of its words are opposites, such as to fall upwards, or left and right in one leg.
    `steps` are the legs behind the first, `others` what moves at the same time. `read` are the places in the text of
    the items that were understood.
    """

    kind: MotionKind | None
    arrow: ArrowSense | None
    direction: Vector | None
    depth: float
    forward: bool | None
    verb: str
    towards: ObjectPhrase | None = None
    trail: TrailWords | None = None
    quantities: tuple[QuantityWords, ...] = ()
    steps: tuple[StepWords, ...] = ()
    contradictory: bool = False
    others: tuple[OtherWords, ...] = ()
    read: frozenset[int] = field(default_factory=frozenset[int], compare=False)


@dataclass
class _Leg:
    """What the adverbials of one leg say."""

    verb: str
    ways: list[Vector] = field(default_factory=list[Vector])
    depths: set[int] = field(default_factory=set[int])
    senses: set[ArrowSense] = field(default_factory=set[ArrowSense])
    ahead: set[bool] = field(default_factory=set[bool])
    towards: ObjectPhrase | None = None
    marks: set[str] = field(default_factory=set[str])
    quantities: list[QuantityWords] = field(default_factory=list[QuantityWords])

    def way(self, kind: MotionKind | None) -> Vector | None:
        """A unit vector in the image."""
        x, y = (sum(way[axis] for way in self.ways) for axis in (0, 1))
        if kind == "fall":
            y = 0.0  # down is what a fall does; only what leads away from it is a direction
        elif x == y == 0.0 and not self.ways:
            y = -1.0 if self.verb in _RISING else 1.0 if self.verb in _SINKING else 0.0
        length = math.hypot(x, y)
        return (x / length, y / length) if length > 1e-9 else None

    def depth(self) -> float:
        return float(sum(self.depths))

    def contradicts(self) -> bool:
        """Whether two of its words are opposites."""
        up = [way[1] for way in self.ways]
        turned = (self.verb in _FALLING and min(up, default=0) < 0) or (
            self.verb in _CLIMBING and max(up, default=0) > 0
        )
        opposed = any(a[0] * b[0] < 0 or a[1] * b[1] < 0 for a in self.ways for b in self.ways)
        moved = bool(self.ways or self.depths) and "at_rest" in self.marks
        return turned or opposed or moved or any(len(each) > 1 for each in (self.depths, self.senses, self.ahead))


def read_motion(
    found: Sequence[Item],
    verb: str,
    kind: MotionKind | None,
    mover: ObjectPhrase | None,
    asked: bool = False,
    arrow: bool = False,
) -> MotionWords:
    """The motion in a clause whose verb is the first of `found`.

    `asked`: the verb itself is in question, so where it gets to is not given ("will the ball roll into the vase?").
    `arrow`: the question names an arrow elsewhere, so "the opposite direction" is opposite to it.
    """
    read = {found[0].start} if found and found[0].phrase is None else set[int]()
    legs = [_Leg(verb)]
    if verb == "let go":
        read |= {item.start for item in found[1:3] if item.key in {"go", "loose", "of"}}
    for tree, items in _adverbials(found, 0 if verb == "follow" else 1):
        node = None if tree is None else next(iter(tree.children), None)
        if tree is None:
            leg = legs[-1]
            if items[0].quantity is not None and items[0].quantity.within is not None:
                continue
            if items[0].quantity is not None:
                leg.quantities.append(items[0].quantity)
            elif items[0].key in _THEN:
                if _says_more(legs[-1]):
                    legs.append(_Leg(""))
            elif items[0].key in lex.VERBS and len(legs) > 1 and not leg.verb:
                leg.verb = lex.lemma(items[0].key)
                if lex.VERBS[items[0].key].kind in {"fall", "projectile"} and leg.verb not in _FALLING:
                    continue
        elif isinstance(node, Tree):
            later = len(legs) > 1 and str(node.data) in _FIRST_LEG_ONLY
            aside = str(node.data) == "off" and _stands_before_thing(found, items[-1])
            ended = str(node.data) == "stops" and len(legs) > 1 and not _says_more(legs[-1])
            if later or aside or not _apply(legs[-1 - ended], node, found, mover, asked or kind == "fall", arrow):
                continue
        read |= {item.start for item in items}
    first, *rest = [leg for at, leg in enumerate(legs) if not at or leg.way(None) is not None or leg.depths]
    return _motion(first, rest, _kind(first, kind), frozenset(read))


def _stands_before_thing(found: Sequence[Item], item: Item) -> bool:
    """ "Rolls on the mug", "off the shelf": not "rolls on", "rolls off"."""
    after = next((each for each in found if each.start >= item.end), None)
    return after is not None and after.phrase is not None and after.phrase.is_thing


def with_front(motion: MotionWords, before: Sequence[Item], told: frozenset[int]) -> MotionWords:
    """The motion with what stands in front of its verb: "along the arrow, the ball ...", "at 20 px/s it would ..."."""
    leg, read = _Leg(""), set(told)
    for tree, items in _adverbials(before, 0):
        node = None if tree is None else next(iter(tree.children), None)
        name = str(node.data) if isinstance(node, Tree) else ""
        if tree is None and items[0].quantity is not None and items[0].quantity.within is None:
            leg.quantities.append(items[0].quantity)
        elif name in {"along", "against"}:
            leg.senses |= {"along"} if name == "along" else {"against"}
        elif tree is None or name not in {"", "marked", "told"}:
            continue
        read |= {item.start for item in items}
    said = motion.direction is not None or motion.depth or motion.forward is not None or motion.towards is not None
    arrow = motion.arrow or next(iter(leg.senses), None) or ("along" if told and not said else None)
    contradictory = motion.contradictory or len({motion.arrow, *leg.senses} - {None}) > 1
    return replace(
        motion, arrow=arrow, quantities=(*leg.quantities, *motion.quantities), contradictory=contradictory,
        read=motion.read | read,
    )  # fmt: skip


def arrow_statement(found: Sequence[Item]) -> frozenset[int]:
    """The places of "The arrow shows the way" where the question says so."""
    for at in range(len(found)):
        opens = key_at(found, at - 1) in {".", "?", "!", ";", ":", ",", "that", "and"}
        near = any(word.text in ARROWS for word in words_of(found[at : at + 4])) if opens else False
        parsed = read_from("adverbial", found, at, _WINDOW_MOTION) if near else None
        if parsed is not None and next(parsed[0].find_data("told"), None) is not None:
            return frozenset(item.start for item in found[at : parsed[1]])
    return frozenset()


def _says_more(leg: _Leg) -> bool:
    return bool(leg.ways or leg.depths or leg.senses or leg.quantities or leg.verb in _FALLING | _RISING | _SINKING)


def _motion(first: _Leg, rest: Sequence[_Leg], kind: MotionKind | None, read: frozenset[int]) -> MotionWords:
    arrow = next(iter(first.senses), None)
    forward = next(iter(first.ahead), None)
    if forward is None and arrow is None and first.verb == "reverse":
        forward = False
    if forward is None and "straight_on" in first.marks and first.verb in _GOES_STRAIGHT:
        forward = True
    if forward is False and arrow is not None:
        forward = None
    steps = tuple(StepWords(*_way(leg, None), tuple(leg.quantities)) for leg in rest)
    return MotionWords(
        kind, arrow, *_way(first, kind), forward, first.verb, first.towards,
        quantities=tuple(first.quantities), steps=steps, contradictory=any(leg.contradicts() for leg in (first, *rest)),
        read=read,
    )  # fmt: skip


def _way(leg: _Leg, kind: MotionKind | None) -> tuple[Vector | None, float]:
    """The direction in the image and the depth of a leg."""
    direction, depth = leg.way(kind), leg.depth()
    return direction, depth * math.sqrt(0.5) if direction is not None else depth


def _kind(leg: _Leg, kind: MotionKind | None) -> MotionKind | None:
    if leg.verb == "come" and any(way[1] > 0 for way in leg.ways):
        return "fall"
    if leg.verb in _TIPPED and "over" in leg.marks:
        return "fall"
    if leg.verb in _KICKED and "airborne" in leg.marks:
        return "projectile"
    return kind


def _adverbials(found: Sequence[Item], start: int) -> Iterator[tuple[Tree[Token] | None, Sequence[Item]]]:
    """The adverbials of a clause with their items; None for a quantity, a "then" or a further verb alone."""
    at, tries = start, 0
    while at < len(found):
        item, parsed = found[at], None
        if item.quantity is not None or item.key in _THEN or _is_next_verb(found, at) or _is_set_going(found, at):
            yield None, (item,)
        elif tries < _MAX_TRIES:
            tries += 1
            parsed = read_from("adverbial", found, at, _WINDOW_MOTION)
        end = at if parsed is None else parsed[1]
        if parsed is not None and end > at:
            yield parsed[0], found[at:end]
        at = max(end, at + 1)


def _is_next_verb(found: Sequence[Item], at: int) -> bool:
    """ "And then drops", "then it rolls": the verb of a further leg."""
    verb = lex.VERBS.get(found[at].key)
    before = at - 1
    while key_at(found, before) in lex.MOVER_PRONOUNS | lex.BE | {"to", "let"}:
        before -= 1
    return verb is not None and verb.kind is not None and key_at(found, before) in _THEN | {"and", "so"}


def _is_set_going(found: Sequence[Item], at: int) -> bool:
    """ "Sends the ball rolling", "sets it sliding"."""
    verb = lex.VERBS.get(found[at].key)
    sent = at == 2 and lex.lemma(found[0].key) in _SETS_GOING and key_at(found, 1) in lex.MOVER_PRONOUNS | {""}
    return sent and verb is not None and verb.kind == "linear" and verb.form == "ing"


def _apply(
    leg: _Leg, node: Tree[Token], found: Sequence[Item], mover: ObjectPhrase | None, open_end: bool, arrow: bool
) -> bool:
    """Takes one adverbial into a leg; false where it says nothing there."""
    name = str(node.data)
    match name:
        case "heading":
            weight = SLIGHTLY if next(node.find_data("slight"), None) is not None else 1.0
            said = [lex.DIRECTIONS[str(token)] for ways in node.find_data("ways") for token in ways.children]
            leg.ways += [(weight * x, weight * y) for x, y in said]
        case "away" | "near":
            leg.depths.add(1 if name == "away" else -1)
        case "along" | "against":
            leg.senses.add(name)
        case "reversed":
            if arrow:
                leg.senses.add("against")
            return arrow
        case "forward" | "backward":
            leg.ahead.add(name == "forward")
        case "beside_it":
            return False
        case "airborne":
            leg.marks.add(name)
            flies = leg.verb in lex.VERBS and lex.VERBS[leg.verb].kind in {"projectile", "fall"}
            return flies or leg.verb in _KICKED  # "rolls through the air": the worlds have nothing that does
        case "stops":
            return bool(leg.quantities)
        case "towards":
            return _aim(leg, node, found, mover, open_end)
        case _:
            leg.marks.add(name)
    return True


def _aim(leg: _Leg, node: Tree[Token], found: Sequence[Item], mover: ObjectPhrase | None, open_end: bool) -> bool:
    phrase = next((found[token.line or 0].phrase for token in node.scan_values(lambda v: isinstance(v, Token))), None)
    if phrase is None or phrase == mover or (open_end and next(node.find_data("to_goal"), None) is not None):
        return False
    if phrase.is_thing or (phrase.noun is None and phrase.colour is not None):
        leg.towards = leg.towards or phrase
        return leg.towards == phrase
    return False
