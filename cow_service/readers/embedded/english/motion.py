"""Finds the clause that holds the motion: which verb, whose subject, how far its words reach; and what they say.

A conditional clause comes first ("if the ball rolls"), then a statement, then a question that holds a verb of motion.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from difflib import get_close_matches
from typing import Literal

from cow_service.readers.embedded.english import lexicon as lex
from cow_service.readers.embedded.english.grammar import Node, read_from
from cow_service.readers.embedded.english.interventions import TrailWords
from cow_service.readers.embedded.english.lexicon import Item, ObjectPhrase, QuantityWords, key_at, phrase_at
from cow_service.records import MotionKind, Vector

_ENDS = lex.ENDS | {":"}
_ClauseKind = Literal["cond", "plain", "question"]
_GOES_ON = lex.PLACES | lex.words(
    "~ to toward towards along in at as opposite against away and then forward backward though"
)
# A conditional clause is where the motion stands; a question without one may still hold it.
_RANKS: dict[_ClauseKind, int] = {"cond": 30, "plain": 20, "question": 10}
_STAYS, _UNKNOWN_VERB = 5, 15  # ranks, too
_EVENTS = lex.TOUCH | lex.OCCLUDE | lex.LAND
_WINDOW = 60  # items: no clause is longer
_PARTICLES = lex.words("up down away off out over go loose of")
_SUBJECTS = lex.MOVER_PRONOUNS | {"", "there", "i", "you", "we"}  # a noun phrase, too
_STILL = lex.words("still stationary motionless unmoved immobile")
_BETWEEN = lex.words("to be being on of in by slowly quickly suddenly going about allowed")


@dataclass
class _Clause:
    kind: _ClauseKind
    start: int
    subject: ObjectPhrase | None = None
    verbs: int = 0


@dataclass(frozen=True)
class MotionCandidate:
    """A motion that the question may be about: its verb is at `at`, in the clause that begins at `start`.

    `verb` is empty for a condition without a verb of motion.
    Its subject is None if the clause has a pronoun, or nothing.
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

    @property
    def moves(self) -> bool:
        """Whether it is known to be a motion, and not a rest."""
        return self.kind not in {None, "static"}


def read_clauses(found: Sequence[Item]) -> tuple[list[MotionCandidate], list[tuple[int, ObjectPhrase]]]:
    """Every verb of motion with its subject, and the subjects of the questions with their places."""
    candidates: list[MotionCandidate] = []
    question_subjects: list[tuple[int, ObjectPhrase]] = []
    clause = _Clause("plain", 0)
    for at in range(len(found) + 1):
        opened, phrase = _opened(found, at, clause), phrase_at(found, at)
        if opened:
            known = bool(candidates) and candidates[-1].start == clause.start
            if clause.kind == "cond" and clause.subject and not known:
                start = clause.start
                candidates.append(MotionCandidate(start, start, "", None, clause.subject, _UNKNOWN_VERB))
            clause = _Clause(opened, at)
        elif phrase is not None:
            if clause.kind == "question" and clause.subject is None and not is_vague(found[at]):
                question_subjects.append((at, phrase))
            # The first thing is the subject; scenery gives way to it ("on the table the ball rolls").
            names = phrase.head not in lex.ABSTRACT and (phrase.noun is not None or phrase.colour is not None)
            gives_way = clause.subject is None or (
                clause.subject.head in lex.SCENERY and phrase.head not in lex.SCENERY
            )
            if names and gives_way and not clause.verbs:
                clause.subject = phrase
        elif candidate := _candidate(found, at, clause):
            candidates.append(candidate)
        clause.verbs += key_at(found, at) in lex.VERBS
    return candidates, question_subjects


def _opened(found: Sequence[Item], at: int, clause: _Clause) -> _ClauseKind | None:
    """The kind of the clause that begins at a word, or behind the last one; None if none begins."""
    key = key_at(found, at)
    if key in _ENDS:
        return "plain"
    if key in {",", "(", ")", "—", "–"}:
        return None if clause.kind == "cond" and not clause.verbs else "plain"
    if key in lex.CONDITIONALS or is_during(found, at):
        return "cond"
    if key in lex.CAUSATIVES:
        return None if key_at(found, at + 1) in {"go", "loose"} else clause.kind
    if _is_inversion(found, at):
        return "question"
    follows = key in {"and", "but", "then"} and clause.verbs and phrase_at(found, at + 1) is not None
    return clause.kind if follows else None


def is_during(found: Sequence[Item], at: int) -> bool:
    """ "As the cube slides left, does it ...": an "as" that opens a sentence, in front of a thing."""
    after = phrase_at(found, at + 1)
    return key_at(found, at) == "as" and key_at(found, at - 1) in _ENDS and after is not None and after.is_thing


def _is_inversion(found: Sequence[Item], at: int) -> bool:
    key, after = found[at].key, at + 2 if key_at(found, at + 1) in lex.NEGATIONS else at + 1
    behind_subject = at > 0 and key_at(found, at - 1) in _SUBJECTS
    inverted = key in lex.AUXILIARIES or (key in lex.BE and key != "'s" and not behind_subject)
    return inverted and key_at(found, after) in _SUBJECTS


def _candidate(found: Sequence[Item], at: int, clause: _Clause) -> MotionCandidate | None:
    key, before, after, rank = found[at].key, key_at(found, at - 1), key_at(found, at + 1), _RANKS[clause.kind]
    if key in lex.CAUSATIVES and after in {"go", "loose"}:
        return MotionCandidate(at, clause.start, "let go", "fall", _subject(found, at, "drop", clause), rank)
    if key in _STILL and before in lex.BE and clause.kind != "question":
        return MotionCandidate(at, clause.start, "stay", "static", clause.subject, rank)
    verb = lex.VERBS.get(key)
    if verb is None or before == "nobody" or _is_idle(found, at, verb):
        return None
    acting = phrase_at(found, at - 2 if before in lex.BE else at - 1)
    # "Assume the camera stays still": nothing in the scene is meant.
    if clause.subject is None and acting is not None and acting.head in lex.ABSTRACT:
        return None
    kind, passive = verb.kind, is_passive(found, at)
    if kind is None:
        return None
    if kind == "static" and clause.kind != "cond":
        rank = _STAYS
    elif verb.form in {"ing", "past"} and not passive:
        rank = max(rank, _RANKS["plain"])
    negated = any(key_at(found, at - back) in lex.NEGATIONS | {"nothing"} for back in (1, 2, 3))
    if negated or (verb.lemma == "keep" and after in _STILL | {"in", "at"}):
        kind = "static"
    return MotionCandidate(at, clause.start, verb.lemma, kind, _subject(found, at, verb.lemma, clause), rank)


def _is_idle(found: Sequence[Item], at: int, verb: lex.Verb) -> bool:
    """A verb that only leads to the next one ("keeps moving") or says where a thing is ("the ball resting on")."""
    before = key_at(found, at - 1)
    if verb.kind == "static" and (verb.form == "ing" or before in {"that", "which"}):
        return True
    for item in found[at + 1 : at + 5] if verb.lemma in lex.SETS["weak"] else ():
        if item.key in lex.VERBS and lex.VERBS[item.key].kind:
            return True
        if item.key not in _BETWEEN:
            return False
    return False


def is_passive(found: Sequence[Item], at: int) -> bool:
    """Whether the verb at a place is in the passive voice: a participle behind a form of "be"."""
    past = lex.is_form(found[at].key, "past") or lex.lemma(found[at].key) == "hit"
    return past and not lex.BE.isdisjoint(key_at(found, at - back) for back in (1, 2, 3))


def _subject(found: Sequence[Item], at: int, verb: str, clause: _Clause) -> ObjectPhrase | None:
    """What moves: the object of an active verb where a person acts, the subject otherwise; None for a pronoun."""
    form = lex.VERBS[found[at].key].form if found[at].key in lex.VERBS else "base"
    before, passive, near = key_at(found, at - 1), is_passive(found, at), phrase_at(found, at - 1)
    # "Which cube is hit by the ball thrown along the arrow".
    thrown = form == "past" and not passive and clause.verbs and near and near.is_thing and near.head not in lex.AGENTS
    rolling = form == "ing" or (form == "past" and clause.kind == "question")
    if thrown or (rolling and near and near.head not in lex.ABSTRACT):
        return near
    if form in {"past", "ing"} and not passive and clause.subject is None and phrase_at(found, at + 1) is None:
        # "Sent towards the mug, the ball ...", "after rolling left, will the ball ...": the subject behind it.
        comma = next((place for place in range(at, len(found)) if found[place].key in _ENDS | {","}), len(found))
        led = phrase_at(found, comma + 1 + (key_at(found, comma + 1) in lex.AUXILIARIES))
        opens = before in _ENDS | {","} | lex.CONDITIONALS and key_at(found, comma) == ","
        if opens and led is not None and led.is_thing and led.head not in lex.AGENTS:
            return led
    relative = at - 2 if before in lex.BE else at - 1
    if key_at(found, relative) in {"that", "which", "who"} and phrase_at(found, relative - 1):
        return phrase_at(found, relative - 1)
    acted = clause.subject is None or clause.subject.head in lex.AGENTS
    if acted and not passive and verb in lex.SETS["transitive"]:
        after = at + 1
        while key_at(found, after) in _PARTICLES:
            after += 1
        target = phrase_at(found, after)
        if target and target.head not in lex.ABSTRACT:
            return target
        if key_at(found, after) in lex.MOVER_PRONOUNS:
            return None
    return clause.subject


def is_vague(item: Item) -> bool:
    """Whether a noun phrase names no certain object: "which ball", "any cube", "the first thing"."""
    content = [word for word in item.words if word not in lex.DETERMINERS]
    order = content[:1] == ["first"] and lex.GENERIC.issuperset(content[1:])
    return item.phrase is not None and (item.words[0] in lex.VAGUE_DETERMINERS or order)


def clause_end(found: Sequence[Item], at: int) -> int:
    """One past the last item that belongs to the verb at `at`: where the next clause, or the question, begins."""
    last = min(len(found), at + _WINDOW)
    for end in range(at + 1, last):
        key, ahead = found[end].key, phrase_at(found, end + 1)
        if key == "how":  # "thrown how the arrow shows"
            ends = ahead is None or ahead.head not in lex.ARROWS
        elif key == ",":
            joined = key_at(found, end + 1) in {"and", "then", "but"}
            ends = phrase_at(found, end + 2) is not None if joined else key_at(found, end + 1) not in _GOES_ON
        else:
            starts = key in _ENDS or key in lex.CONDITIONALS or key in {"what", "why"} or _is_inversion(found, end)
            ends = starts or lex.lemma(key) in _EVENTS or is_vague(found[end])
        if ends:
            return end
    return last


ArrowSense = Literal["along", "against"]

_ADVERBIAL = 14  # words of one
_MAX_TRIES = 16  # of one motion: each takes a part of a ms
_FIRST_LEG_ONLY = frozenset({"along", "against", "towards", "forward", "backward"})
_THEN = lex.words("then afterwards finally")
_BEFORE_VERB = lex.MOVER_PRONOUNS | lex.BE | {"to", "let"}
_TOPPLING = lex.words("topple tip collapse")
_TOPPLING_WITH_OVER = lex.words("knock push kick hit turn blow go fall")
_RISING = lex.words("lift raise rise climb ascend")
_SETS_GOING = lex.words("send start keep get")
_FALLING = lex.words("fall drop release plummet plunge descend")
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
    form, empty if no known verb of motion stands in the question. `towards` is the object that the motion aims at;
    the direction to it is for the caller to measure. `trail`: it goes on along the trail that is shown.
    `contradictory`: two of its words are opposites, such as to fall upwards. `topples`: it falls over where it stands.
    `in_air`: it is let go, or falls freely. `steps` are the legs behind the first, `others` what moves at the same
    time. `read` are the places in the text of the items that were understood.
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
    topples: bool = False
    in_air: bool = False
    others: tuple[OtherWords, ...] = ()
    read: frozenset[int] = field(default_factory=frozenset[int], compare=False)

    @property
    def says_way(self) -> bool:
        """Whether it has a direction of any sort."""
        said = (self.direction, self.arrow, self.forward, self.trail)
        return bool(self.depth) or self.kind in {"fall", "projectile"} or any(each is not None for each in said)


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
    quantities: dict[int, QuantityWords] = field(default_factory=dict[int, QuantityWords])  # by place in the text

    def take(self, node: Node, mover: ObjectPhrase | None, open_end: bool) -> bool:
        """Takes an adverbial; false where it says nothing here."""
        match node.name:
            case "heading":
                self.ways += [lex.DIRECTIONS[word.text] for word in node.words]
            case "away" | "near":
                self.depths.add(1 if node.name == "away" else -1)
            case "along" | "against":
                self.senses.add(node.name)
            case "forward" | "backward":
                self.ahead.add(node.name == "forward")
            case "beside_it":
                return False
            case "stops":
                return bool(self.quantities)
            case "towards":
                phrase = node.words[0].phrase
                named = phrase is not None and (phrase.is_thing or (phrase.noun is None and phrase.colour is not None))
                # "To the rigth": what may be a misspelt direction is no goal.
                head = "" if phrase is None or phrase.head in lex.NOUNS else phrase.head or ""
                named = named and not get_close_matches(head, lex.DIRECTIONS, 1, 0.8)
                aims = named and phrase != mover and not (open_end and "to_goal" in node)
                self.towards = self.towards or (phrase if aims else None)
                return aims and self.towards == phrase
            case _:
                self.marks.add(node.name)
        return True

    def way(self, kind: MotionKind | None) -> tuple[Vector | None, float]:
        """A unit vector in the image, and the depth."""
        x, y = (sum(way[axis] for way in self.ways) for axis in (0, 1))
        if kind == "fall":
            y = 0.0  # down is what a fall does; only what leads away from it is a direction
        elif not self.ways:
            y = -1.0 if self.verb in _RISING else 1.0 if self.verb in _SINKING else 0.0
        length, depth = math.hypot(x, y), float(sum(self.depths))
        return ((x / length, y / length), depth * math.sqrt(0.5)) if length > 1e-9 else (None, depth)

    def contradicts(self) -> bool:
        """Whether two of its words are opposites."""
        up = [way[1] for way in self.ways]
        turned = self.verb in _FALLING and min(up, default=0) < 0
        turned = turned or (self.verb in _CLIMBING and max(up, default=0) > 0)
        opposed = any(a[0] * b[0] < 0 or a[1] * b[1] < 0 for a in self.ways for b in self.ways)
        moved = bool(self.ways or self.depths) and "at_rest" in self.marks
        return turned or opposed or moved or any(len(each) > 1 for each in (self.depths, self.senses, self.ahead))

    def says_more(self) -> bool:
        """Whether it says more than that something moves."""
        known = self.verb in _FALLING | _RISING | _SINKING
        return bool(self.ways or self.depths or self.senses or self.quantities or known)


def read_motion(
    found: Sequence[Item],
    verb: str,
    kind: MotionKind | None,
    mover: ObjectPhrase | None,
    asked: bool = False,
) -> MotionWords:
    """The motion in a clause whose verb is the first of `found`.

    `asked`: the verb itself is in question, so where it gets to is not given ("will the ball roll into the vase?").
    """
    read = {found[0].start} if found and found[0].phrase is None else set[int]()
    legs = [_Leg(verb)]
    if verb == "let go":
        read |= {item.start for item in found[1:3] if item.key in {"go", "loose", "of"}}
    for node, items in _adverbials(found, 0 if verb == "follow" else 1):
        leg, item = legs[-1], items[0]
        if node is not None:
            # "Rolls on the mug", "off the shelf": not "rolls on", "rolls off".
            after = next((each for each in found if each.start >= items[-1].end), None)
            aside = node.name == "off" and after is not None and after.thing is not None
            later = len(legs) > 1 and node.name in _FIRST_LEG_ONLY
            if node.name == "stops" and len(legs) > 1 and not leg.says_more():
                leg = legs[-2]
            # "Falls over to the left" is to topple; "dropped over the mug" says where.
            is_above = node.name == "over" and kind == "fall" and after is not None and after.thing is not None
            if later or aside or not (is_above or leg.take(node, mover, asked or kind == "fall")):
                continue
            falls_over = item.key == "over" and leg.verb in {"fall", "knock", "turn", "blow"} and not is_above
            leg.marks |= ({"over"} if falls_over else set()) | ({"freely"} & {each.key for each in items})
        elif item.quantity is not None and item.quantity.within is not None:
            continue
        elif item.quantity is not None:
            leg.quantities[item.start] = item.quantity
        elif item.key in _THEN:
            legs += [_Leg("")] if leg.says_more() else []
        elif item.key in lex.VERBS and len(legs) > 1 and not leg.verb:
            leg.verb = lex.lemma(item.key)
            if lex.VERBS[item.key].kind in {"fall", "projectile"} and leg.verb not in _FALLING:
                continue
        read |= {item.start for item in items}
    words = _in_words(legs, kind, frozenset(read))
    later = (lex.lemma(each.key) for each in found[1:] if each.key in lex.VERBS)  # "moves left and tips over"
    return replace(words, topples=words.topples or (not asked and not _TOPPLING.isdisjoint(later)))


def _in_words(legs: Sequence[_Leg], kind: MotionKind | None, read: frozenset[int]) -> MotionWords:
    first, *rest = legs
    lost = [leg.quantities.keys() for leg in rest if leg.way(None)[0] is None and not leg.depths]
    rest = [leg for leg in rest if leg.way(None)[0] is not None or leg.depths]
    kind = "fall" if first.verb == "come" and any(y > 0 for _, y in first.ways) else kind
    is_over = first.verb in _TOPPLING or (first.verb in _TOPPLING_WITH_OVER and "over" in first.marks)
    sense, forward = next(iter(first.senses), None), next(iter(first.ahead), None)
    if forward is None and sense is None and first.verb == "reverse":
        forward = False
    elif forward is None and "straight_on" in first.marks and first.verb in _GOES_STRAIGHT:
        forward = True
    return MotionWords(
        kind, sense, *first.way(kind), None if sense is not None and not forward else forward, first.verb,
        first.towards, quantities=tuple(first.quantities.values()),
        steps=tuple(StepWords(*leg.way(None), tuple(leg.quantities.values())) for leg in rest),
        contradictory=any(leg.contradicts() for leg in (first, *rest)), read=read.difference(*lost),
        topples=is_over and "off" not in first.marks and not any(y > 0 for _, y in first.ways),  # "off a shelf", "down"
        in_air=first.verb in {"drop", "release", "detach", "let go"} or "freely" in first.marks,
    )  # fmt: skip


def with_front(motion: MotionWords, before: Sequence[Item]) -> MotionWords:
    """The motion with what stands in front of its verb: "along the arrow, the ball ...", "at 20 px/s it would ..."."""
    read, senses, quantities = set[int](), set[ArrowSense](), list[QuantityWords]()
    for node, items in _adverbials(before, 0):
        quantity = items[0].quantity
        if node is None and quantity is not None and quantity.within is None:
            quantities.append(quantity)
        elif node is not None and node.name in {"along", "against"}:
            senses |= {"along"} if node.name == "along" else {"against"}
        elif node is None or node.name not in NO_MATTER:
            continue
        read |= {item.start for item in items}
    return replace(
        motion,
        arrow=motion.arrow or next(iter(senses), None),
        quantities=(*quantities, *motion.quantities),
        contradictory=motion.contradictory or len({motion.arrow, *senses} - {None}) > 1,
        read=motion.read | read,
    )


NO_MATTER = frozenset({"adverbial", "marked", "told"})  # adverbials that say nothing of a motion


def read_adverbial(found: Sequence[Item], at: int, window: int) -> tuple[Node, int] | None:
    """The adverbial at a place, by what it says, and the place behind it; it is an "adverbial" if it says nothing."""
    parsed = read_from("adverbial", found, at, window)
    if parsed is None:
        return None
    tree, end = parsed
    return next((child for child in tree.children if isinstance(child, Node)), tree), end


def _adverbials(found: Sequence[Item], start: int) -> Iterator[tuple[Node | None, Sequence[Item]]]:
    """The adverbials of a clause with their items; None for a quantity, a "then" or a further verb alone."""
    at, tries = start, 0
    while at < len(found):
        item, verb, before, parsed = found[at], lex.VERBS.get(found[at].key), at - 1, None
        # "And then drops", "then it rolls": the verb of a further leg.
        while verb is not None and key_at(found, before) in _BEFORE_VERB:
            before -= 1
        next_verb = verb is not None and verb.kind is not None and key_at(found, before) in _THEN | {"and", "so"}
        # "Sends the ball rolling", "sets it sliding".
        sent = at == 2 and lex.lemma(found[0].key) in _SETS_GOING and key_at(found, 1) in lex.MOVER_PRONOUNS | {""}
        sent = sent and verb is not None and verb.kind == "linear" and verb.form == "ing"
        if item.quantity is not None or item.key in _THEN or next_verb or sent:
            yield None, (item,)
        elif tries < _MAX_TRIES:
            tries += 1
            parsed = read_adverbial(found, at, _ADVERBIAL)
        node, end = parsed or (None, at + 1)
        if node is not None:
            yield node, found[at:end]
        at = end
