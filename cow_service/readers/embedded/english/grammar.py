"""Parses words by `grammar.lark`: all of them, or as many as make sense from the first on.

Lark compiles the grammar. Its own parsers give a word one terminal and want a whole text; here a word may be in several
lists, and most rules describe how a text begins. So the rules are followed top-down, each once at each place, and only
where they may begin with the next word. No rule may begin with itself.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence, Set
from functools import cache
from importlib.resources import files
from itertools import islice

from lark import Lark, Token, Tree
from lark.grammar import Symbol, Terminal

from cow_service.readers.embedded.english.lexicon import Item, Word, words_at

STARTS = ["intervention", "fitting", "trail", "quantity", "asked", "adverbial", "place", "opening", "premise"]
MAX_WORDS = 48  # of one parse: its work may grow with the cube of their number

_Nodes = tuple[Tree[Token] | Token, ...]


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
        self.firsts = self._firsts()
        self.kept: dict[tuple[str, frozenset[str]], list[Sequence[Symbol]]] = {}

    def _firsts(self) -> dict[str, frozenset[str]]:
        """The terminals that each rule may begin with, and "" where it may be nothing."""
        firsts: dict[str, frozenset[str]] = dict.fromkeys(self.rules, frozenset())
        grown = True
        while grown:
            grown = False
            for name, expansions in self.rules.items():
                found = firsts[name].union(*(_first(expansion, firsts) for expansion in expansions))
                grown = grown or found != firsts[name]
                firsts[name] = found
        return firsts

    def names(self, word: Word) -> frozenset[str]:
        """The terminals that a word may be."""
        return frozenset([word.kind] if word.kind else self.terminals.get(word.text, ()))

    def expansions(self, name: str, ahead: frozenset[str]) -> list[Sequence[Symbol]]:
        """The ways to go on with a rule where the next word may be one of some terminals."""
        key = name, ahead
        if key not in self.kept:
            wanted = ahead | {""}
            self.kept[key] = [each for each in self.rules[name] if not wanted.isdisjoint(_first(each, self.firsts))]
        return self.kept[key]


def _first(expansion: Sequence[Symbol], firsts: Mapping[str, frozenset[str]]) -> frozenset[str]:
    found: set[str] = set()
    for symbol in expansion:
        first = frozenset([symbol.name]) if symbol.is_term else firsts[symbol.name]
        found |= first - {""}
        if "" not in first:
            return frozenset(found)
    return frozenset(found | {""})


@cache
def _grammar() -> _Grammar:
    return _Grammar()


def listed_words() -> Set[str]:
    """The words that the grammar lists."""
    return _grammar().terminals.keys()


class _Parse:
    """What the rules make of some words, by rule and place: where each may end, with the first tree that ends there."""

    def __init__(self, words: Sequence[Word]) -> None:
        self.grammar = _grammar()
        self.tokens = [Token(word.kind, word.text, start_pos=at, line=word.at) for at, word in enumerate(words)]
        self.names = [*(self.grammar.names(word) for word in words), frozenset[str]()]
        self.known: dict[tuple[str, int], dict[int, _Nodes]] = {}

    def ends(self, name: str, start: int) -> dict[int, _Nodes]:
        if (name, start) not in self.known:
            found: dict[int, _Nodes] = {}
            for expansion in self.grammar.expansions(name, self.names[start]):
                for end, nodes in self._follow(expansion, start).items():
                    found.setdefault(end, nodes)
            if not name.startswith("_"):
                found = {end: (Tree(name, list(nodes)),) for end, nodes in found.items()}
            self.known[name, start] = found
        return self.known[name, start]

    def _follow(self, expansion: Sequence[Symbol], start: int) -> dict[int, _Nodes]:
        reached: dict[int, _Nodes] = {start: ()}
        for symbol in expansion:
            behind: dict[int, _Nodes] = {}
            for at, nodes in reached.items():
                if not isinstance(symbol, Terminal):
                    for end, more in self.ends(symbol.name, at).items():
                        behind.setdefault(end, nodes + more)
                elif symbol.name in self.names[at]:
                    behind.setdefault(at + 1, nodes if symbol.filter_out else (*nodes, self.tokens[at]))
            reached = behind
        return reached


def _trees(start: str, words: Sequence[Word]) -> dict[int, Tree[Token]]:
    """The trees of a rule over the first words, by their number."""
    if not words or not may_begin(start, words[0]):
        return {}
    ends = _Parse(words).ends(start, 0)
    return {end: tree for end, (tree, *_) in ends.items() if isinstance(tree, Tree)}


def parse_all(start: str, words: Sequence[Word]) -> Tree[Token] | None:
    """The tree of a rule over all of some words; None where they are no such thing."""
    return _trees(start, words).get(len(words)) if len(words) <= MAX_WORDS else None


def parse_from(start: str, words: Sequence[Word]) -> tuple[Tree[Token], int] | None:
    """The tree of a rule over as many words as can be, from the first on, and their number."""
    found = _trees(start, words[:MAX_WORDS])
    # "the ball is going" is not "the ball is gone"
    whole = [end for end in found if end and (end == len(words) or words[end].text != "-ing")]
    return (found[max(whole)], max(whole)) if whole else None


def read_from(start: str, found: Sequence[Item], at: int, window: int) -> tuple[Tree[Token], int] | None:
    """The tree of a rule over the items from a place on, `window` words at most, and the place of the item behind it.

    The `line` of a token is the place of its item.
    """
    words = list(islice((word for place in range(at, len(found)) for word in words_at(found, place)), window))
    parsed = parse_from(start, words)
    if parsed is None:
        return None
    tree, length = parsed
    return tree, words[length].at if length < len(words) else words[-1].at + 1


def may_begin(start: str, word: Word) -> bool:
    """Whether a word may be the first one of a rule."""
    return not _grammar().firsts[start].isdisjoint(_grammar().names(word))


def terminals(word: str) -> Set[str]:
    """The terminals of the grammar that a word may be."""
    return _grammar().terminals.get(word, frozenset())
