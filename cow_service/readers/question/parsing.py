"""Parses tokens by `grammar.lark`: all of some words, or as many as make sense from the first on."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from functools import cache
from importlib.resources import files
from typing import Any

from lark import Lark, Token, Tree
from lark.common import LexerConf
from lark.exceptions import UnexpectedEOF, UnexpectedToken
from lark.lexer import Lexer

from cow_service.readers.question.words import Word

STARTS = ["intervention", "fitting", "trail", "quantity", "asked"]
MAX_WORDS = 48  # of one parse: its work may grow with the cube of their number


class _Words(Lexer):
    """Hands the words over as they are: which terminals each may be is for `_may_be` to say."""

    def __init__(self, conf: LexerConf) -> None:
        pass

    def lex(self, lexer_state: Any, parser_state: Any = None) -> Iterator[Token]:
        for place, word in enumerate(lexer_state):
            yield Token(word.kind, word.text, start_pos=place, line=word.at)


def _literals(pattern: str) -> list[str]:
    """The words of a terminal: lark writes a list as (?:one|two)."""
    inner = pattern.removeprefix("(?:").removesuffix(")") if pattern.startswith("(?:") else pattern
    return [re.sub(r"\\(.)", r"\1", word) for word in inner.split("|")]


@cache
def _parser() -> Lark:
    text = files("cow_service.readers.question").joinpath("grammar.lark").read_text(encoding="utf-8")
    lark = Lark(text, parser="earley", lexer=_Words, start=STARTS, maybe_placeholders=False)
    names: dict[str, set[str]] = {}
    for terminal in lark.terminals:
        for word in _literals(terminal.pattern.value):
            names.setdefault(word, set()).add(terminal.name)

    def may_be(terminal: Any, token: Token) -> bool:
        """A word may be in several lists of the grammar, which is why no lexer of lark's own serves."""
        return terminal.name == token.type if token.type else terminal.name in names.get(token.value, ())

    lark.parser.parser.term_matcher = may_be
    return lark


def parse_all(start: str, words: Sequence[Word]) -> Tree[Token] | None:
    """The tree of a rule over all of some words; None where they are no such thing."""
    return _try(start, words)[0] if len(words) <= MAX_WORDS else None


def parse_from(start: str, words: Sequence[Word]) -> tuple[Tree[Token], int] | None:
    """The tree of a rule over as many words as can be, from the first on, and their number."""
    end = min(len(words), MAX_WORDS)
    while end > 0:
        tree, failed = _try(start, words[:end])
        if tree is not None:
            return tree, end
        end = min(end - 1, failed)
    return None


def _try(start: str, words: Sequence[Word]) -> tuple[Tree[Token] | None, int]:
    """A tree, or the place of the first word that does not fit."""
    if not words:
        return None, 0
    try:
        return _parser().parse(words, start=start), len(words)  # pyright: ignore[reportArgumentType]
    except UnexpectedToken as error:
        return None, error.token.start_pos or 0
    except UnexpectedEOF:
        return None, len(words)
