"""Finds the clause that holds the motion: which verb, whose subject, how far its words reach.

A conditional clause comes first ("if the ball rolls"), then a statement, then a question that holds a verb of motion.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

from cow_service.readers.embedded.english import lexicon as lex
from cow_service.readers.embedded.english.tokens import ARROWS, Item, ObjectPhrase, key_at, phrase_at
from cow_service.records import MotionKind

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
            candidate = _free_fall(item, at, clause) if item.phrase else _candidate(found, at, clause)
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


def _free_fall(item: Item, at: int, clause: _Clause) -> MotionCandidate | None:
    if item.words[-1] in {"fall", "freefall"} and "free" in item.words[-2:] + item.words[-1:]:
        return MotionCandidate(at, clause.start, "fall", "fall", clause.subject, _RANKS[clause.kind])
    return None


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
