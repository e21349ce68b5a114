"""Reads a clause that asks: its tree by the grammar, as the event that is asked about and the things it names."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import get_args

from lark import Token, Tree

from cow_service.readers.question import lexicon as lex
from cow_service.readers.question.parsing import parse_all
from cow_service.readers.question.words import Word
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
    | {"spared", "stays_in"}
)


_SPARING = _NEGATIONS - {"no", "none", "no_contact"}
_ANY_PART = frozenset({"any_part", "partly", "wholly", "in_full", "at_some_time"})  # hidden in part or once


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
