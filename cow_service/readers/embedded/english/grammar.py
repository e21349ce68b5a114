"""Parses tokens by `grammar.lark`: all of some words, or as many as make sense from the first on."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence, Set
from contextlib import suppress
from functools import cache
from importlib.resources import files
from itertools import islice
from threading import Lock
from typing import Any

from lark import Lark, Token, Tree
from lark.common import LexerConf
from lark.exceptions import UnexpectedToken
from lark.grammar import NonTerminal
from lark.lexer import Lexer
from lark.parsers.earley import Item as EarleyItem
from lark.parsers.earley_forest import ForestToParseTree

from cow_service.readers.embedded.english.tokens import Item, Word, words_at

STARTS = ["intervention", "fitting", "trail", "quantity", "asked", "adverbial", "place", "opening", "premise"]
MAX_WORDS = 48  # of one parse: its work may grow with the cube of their number


class _NoLexer(Lexer):
    """Lark wants one; the words come from `_Grammar.lex`."""

    def __init__(self, conf: LexerConf) -> None:
        pass

    def lex(self, lexer_state: Any, parser_state: Any) -> Iterator[Token]:
        raise NotImplementedError


def _literals(pattern: str) -> list[str]:
    """The words of a terminal: lark writes a list as (?:one|two)."""
    inner = pattern.removeprefix("(?:").removesuffix(")") if pattern.startswith("(?:") else pattern
    return [re.sub(r"\\(.)", r"\1", word) for word in inner.split("|")]


class _Grammar:
    """The grammar's Earley parser, which looks one word ahead, and which of its terminals each word may be."""

    def __init__(self) -> None:
        text = files("cow_service.readers.embedded.english").joinpath("grammar.lark").read_text(encoding="utf-8")
        lark = Lark(text, parser="earley", lexer=_NoLexer, start=STARTS, maybe_placeholders=False)
        self.terminals: dict[str, set[str]] = {}
        for terminal in lark.terminals:
            for word in _literals(terminal.pattern.value):
                self.terminals.setdefault(word, set()).add(terminal.name)
        self.earley: Any = lark.parser.parser
        self.earley.term_matcher = self._may_be
        self.rules: dict[Any, Any] = self.earley.predictions
        self.earley.predictions = self
        self.firsts = {rule: self._first(rule.expansion) for rules in self.rules.values() for rule in rules}
        self.kept: dict[tuple[Any, frozenset[str]], list[Any]] = {}
        self.ahead: frozenset[str] = frozenset()  # the terminals that the next word may be
        self.words: Sequence[Word] = ()
        self.lock = Lock()  # of what is ahead, which one parse at a time may say
        self.starts = {start: self._first([NonTerminal(start)])[0] for start in STARTS}

    def names(self, word: Word) -> frozenset[str]:
        """A word may be in several lists of the grammar, which is why no lexer of lark's own serves."""
        return frozenset([word.kind]) if word.kind else frozenset(self.terminals.get(word.text, ()))

    def _may_be(self, terminal: Any, token: Token) -> bool:
        return terminal.name == token.type if token.type else terminal.name in self.terminals.get(token.value, ())

    def _first(self, symbols: Sequence[Any]) -> tuple[frozenset[str], bool]:
        """The terminals that some symbols may begin with, and whether they may be nothing."""
        first: set[str] = set()
        for symbol in symbols:
            if symbol.is_term:
                return frozenset(first | {symbol.name}), False
            first |= {each.name for each in self.earley.FIRST[symbol]}
            if symbol not in self.earley.NULLABLE:
                return frozenset(first), False
        return frozenset(first), True

    def __getitem__(self, symbol: Any) -> list[Any]:
        """The rules of a symbol that the next word may begin: lark's parser would follow up all of them."""
        key = symbol, self.ahead
        if key not in self.kept:
            firsts = [(rule, *self.firsts[rule]) for rule in self.rules[symbol]]
            self.kept[key] = [rule for rule, first, empty in firsts if empty or not self.ahead.isdisjoint(first)]
        return self.kept[key]

    def lex(self, expected: Any) -> Iterator[Token]:
        for place, word in enumerate(self.words):
            self.ahead = self.names(word)
            yield Token(word.kind, word.text, start_pos=place, line=word.at)
        self.ahead = frozenset()

    def columns(self, start: str, words: Sequence[Word]) -> list[Any]:
        """For each number of words from the first on, what the rules have made of them."""
        columns, to_scan = [self.earley.Set()], self.earley.Set()
        with self.lock, suppress(UnexpectedToken):
            self.words, self.ahead = words, self.names(words[0])
            for rule in self[NonTerminal(start)]:
                item = EarleyItem(rule, 0, 0)
                (to_scan if item.expect in self.earley.TERMINALS else columns[0]).add(item)
            self.earley._parse(self, columns, to_scan, NonTerminal(start))
        return columns

    def tree(self, start: str, column: Any) -> Tree[Token] | None:
        """The tree of a rule that is whole in a column; None where it is not."""
        for item in column:
            if item.is_complete and item.node is not None and item.s == NonTerminal(start) and item.start == 0:
                to_tree: Any = ForestToParseTree
                made: Any = to_tree(Tree, self.earley.callbacks, None, True, False).transform(item.node)
                return made
        return None


@cache
def _grammar() -> _Grammar:
    return _Grammar()


def parse_all(start: str, words: Sequence[Word]) -> Tree[Token] | None:
    """The tree of a rule over all of some words; None where they are no such thing."""
    if not 0 < len(words) <= MAX_WORDS or not may_begin(start, words[0]):
        return None
    columns = _grammar().columns(start, words)
    return _grammar().tree(start, columns[-1]) if len(columns) > len(words) else None


def parse_from(start: str, words: Sequence[Word]) -> tuple[Tree[Token], int] | None:
    """The tree of a rule over as many words as can be, from the first on, and their number."""
    ahead = words[:MAX_WORDS]
    if not ahead or not may_begin(start, ahead[0]):
        return None
    columns = _grammar().columns(start, ahead)
    for end in range(len(columns) - 1, 0, -1):
        if end < len(ahead) and ahead[end].text == "-ing":
            continue  # "the ball is going" is not "the ball is gone"
        tree = _grammar().tree(start, columns[end])
        if tree is not None:
            return tree, end
    return None


def read_from(start: str, found: Sequence[Item], at: int, window: int) -> tuple[Tree[Token], int] | None:
    """The tree of a rule over the items from a place on, `window` words at most, and the place of the item behind it.

    The `line` of a token is the place of its item.
    """
    first = words_at(found, at)[:1] if at < len(found) else []
    if not first or not may_begin(start, first[0]):
        return None
    words = list(islice((word for place in range(at, len(found)) for word in words_at(found, place)), window))
    parsed = parse_from(start, words)
    if parsed is None:
        return None
    tree, length = parsed
    return tree, words[length].at if length < len(words) else words[-1].at + 1


def may_begin(start: str, word: Word) -> bool:
    """Whether a word may be the first one of a rule."""
    grammar = _grammar()
    return not grammar.starts[start].isdisjoint(grammar.names(word))


def listed_words() -> Set[str]:
    """The words of the grammar."""
    return _grammar().terminals.keys()


def terminals(word: str) -> Set[str]:
    """The terminals of the grammar that a word may be."""
    return _grammar().terminals.get(word, frozenset())
