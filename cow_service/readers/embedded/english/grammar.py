"""Parses words by `grammar.lark`: all of them, or as many as make sense from the first on.

Lark compiles the grammar. Its own parsers give a word one terminal and want a whole text; here a word may be in several
lists, and most rules describe how a text begins. So the rules are followed top-down, each once at each place, and only
where they may begin with the next word. No rule may begin with itself.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence, Set
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from itertools import islice

from lark import Lark
from lark.grammar import Symbol, Terminal

from cow_service.readers.embedded.english.lexicon import NUMERALS, Item, Word, words_of

STARTS = ["intervention", "fitting", "trail", "quantity", "asked", "adverbial", "place", "opening", "premise", "list"]
MAX_WORDS = 48  # of one parse: its work may grow with the cube of their number
_NUMBER = re.compile(r"[0-9]+(\.[0-9]+)?")


@dataclass(frozen=True)
class Node:
    """What a rule makes of some words: the nodes of the rules in it, and the words that it keeps."""

    name: str
    children: tuple[Node | Word, ...]

    def find(self, *names: str) -> Iterator[Node]:
        """The nodes of some names, itself among them, those above first; all without a name."""
        if not names or self.name in names:
            yield self
        for child in self.children:
            if isinstance(child, Node):
                yield from child.find(*names)

    def __contains__(self, name: str) -> bool:
        return name in self.names

    @property
    def names(self) -> list[str]:
        """The names of its nodes, its own first."""
        return [node.name for node in self.find()]

    @property
    def words(self) -> list[Word]:
        """The words that it keeps, in order."""
        return [word for each in self.children for word in ([each] if isinstance(each, Word) else each.words)]


_Nodes = tuple[Node | Word, ...]


class _Grammar:
    """The rules by name, and which terminals each word may be."""

    def __init__(self) -> None:
        text = files("cow_service.readers.embedded.english").joinpath("grammar.lark").read_text(encoding="utf-8")
        lark = Lark(text, parser=None, lexer="basic", start=STARTS, maybe_placeholders=False)
        self.terminals: dict[str, set[str]] = {}
        for terminal in lark.terminals:
            for word in terminal.pattern.value.removeprefix("(?:").removesuffix(")").split("|"):
                self.terminals.setdefault(re.sub(r"\\(.)", r"\1", word), set()).add(terminal.name)
        self.rules: dict[str, list[Sequence[Symbol]]] = {}
        for rule in lark.rules:
            self.rules.setdefault(rule.origin.name, []).append(rule.expansion)
        # The terminals that each rule may begin with, and "" where it may be nothing.
        self.firsts, grown = {name: frozenset[str]() for name in self.rules}, True
        while grown:
            found = {name: frozenset[str]().union(*map(self.first, ways)) for name, ways in self.rules.items()}
            self.firsts, grown = found, found != self.firsts
        self.kept: dict[tuple[str, frozenset[str]], list[Sequence[Symbol]]] = {}

    def first(self, expansion: Sequence[Symbol]) -> frozenset[str]:
        """The terminals that one way to write a rule may begin with."""
        found = frozenset[str]()
        for symbol in expansion:
            first = frozenset([symbol.name]) if symbol.is_term else self.firsts[symbol.name]
            if "" not in first:
                return found | first
            found |= first - {""}
        return found | {""}

    def names(self, word: Word) -> frozenset[str]:
        """The terminals that a word may be."""
        if word.kind:
            return frozenset([word.kind])
        number = word.text in NUMERALS or _NUMBER.fullmatch(word.text)
        return frozenset(self.terminals.get(word.text, ())) | ({"NUMBER"} if number else set())

    def expansions(self, name: str, ahead: frozenset[str]) -> list[Sequence[Symbol]]:
        """The ways to go on with a rule where the next word may be one of some terminals."""
        key = name, ahead
        if key not in self.kept:
            wanted = ahead | {""}
            self.kept[key] = [each for each in self.rules[name] if not wanted.isdisjoint(self.first(each))]
        return self.kept[key]


_grammar = cache(_Grammar)


def terminals(word: str) -> Set[str]:
    """The terminals of the grammar that a word may be."""
    return _grammar().terminals.get(word, frozenset())


def parse_ends(start: str, words: Sequence[Word]) -> dict[int, Node]:
    """The trees of a rule over the first words, by their number; of several that end alike, the first."""
    grammar = _grammar()
    if not words or grammar.firsts[start].isdisjoint(grammar.names(words[0])):
        return {}
    names = [*map(grammar.names, words[:MAX_WORDS]), frozenset[str]()]
    known: dict[tuple[str, int], dict[int, _Nodes]] = {}

    def ends(name: str, at: int) -> dict[int, _Nodes]:
        if (name, at) not in known:
            found: dict[int, _Nodes] = {}
            for expansion in grammar.expansions(name, names[at]):
                for end, nodes in follow(expansion, at).items():
                    found.setdefault(end, nodes)
            known[name, at] = found if name.startswith("_") else {end: (Node(name, n),) for end, n in found.items()}
        return known[name, at]

    def follow(expansion: Sequence[Symbol], start: int) -> dict[int, _Nodes]:
        reached: dict[int, _Nodes] = {start: ()}
        for symbol in expansion:
            behind: dict[int, _Nodes] = {}
            for at, nodes in reached.items():
                if not isinstance(symbol, Terminal):
                    for end, more in ends(symbol.name, at).items():
                        behind.setdefault(end, nodes + more)
                elif symbol.name in names[at]:
                    behind.setdefault(at + 1, nodes if symbol.filter_out else (*nodes, words[at]))
            reached = behind
        return reached

    return {end: node for end, (node, *_) in ends(start, 0).items() if isinstance(node, Node)}


def parse_all(start: str, words: Sequence[Word]) -> Node | None:
    """The tree of a rule over all of some words; None if they are no such thing."""
    return parse_ends(start, words).get(len(words))


def read_from(start: str, found: Sequence[Item], at: int, window: int) -> tuple[Node, int] | None:
    """The tree of a rule over as many items as can be, from a place on, and the place of the item behind them.

    `window` words are looked at.
    """
    words = list(islice(words_of(found, at), min(window, MAX_WORDS)))
    trees = parse_ends(start, words)
    # Whole items: "the ball is going" is not "the ball is gone".
    whole = [end for end in trees if end and (end == len(words) or words[end].at != words[end - 1].at)]
    if not whole:
        return None
    end = max(whole)
    return trees[end], words[end].at if end < len(words) else words[-1].at + 1
