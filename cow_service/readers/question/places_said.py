"""Joins a thing with the words that single it out by another thing: "the ball behind the vase"."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from lark import Token, Tree

from cow_service.readers.question import lexicon as lex
from cow_service.readers.question.parsing import read_from
from cow_service.readers.question.phrases import Item, PlaceWords, key_at

_WINDOW = 9  # words
_PUTS = lex.words("put place insert set position lower stand stick pop plonk plop")


def with_places(found: Sequence[Item]) -> list[Item]:
    """The items, each thing with what is said behind it of its place joined to one."""
    texts = [item.phrase.text.lower() for item in found if item.phrase is not None]
    joined: list[Item] = []
    at = 0
    while at < len(found):
        item, end = found[at], at + 1
        thing = item.phrase is not None and item.phrase.is_thing and end < len(found)
        parsed = read_from("place", found, end, _WINDOW) if thing else None
        read = None if parsed is None else _place(found, parsed[0])
        if item.phrase is not None and parsed is not None and read is not None and not _is_goal(found, at):
            comma, end = key_at(found, end) == ",", parsed[1]
            end += comma and key_at(found, end) == ","
            words = " ".join(" ".join(each.words) or each.key for each in found[at + 1 : end])
            several = texts.count(item.phrase.text.lower()) > 1
            text = f"{item.phrase.text} {words}" if several else item.phrase.text
            item = replace(item, end=found[end - 1].end, phrase=replace(item.phrase, text=text, place=read))
        joined.append(item)
        at = end
    return joined


def _place(found: Sequence[Item], tree: Tree[Token]) -> PlaceWords | None:
    relation = next(str(node.data) for node in tree.iter_subtrees() if str(node.data).endswith("_it"))
    token = next(tree.scan_values(lambda value: isinstance(value, Token)), None)
    phrase = None if token is None else found[token.line or 0].phrase
    if token is not None and (phrase is None or not phrase.is_thing):
        return None
    return PlaceWords(relation.removesuffix("_it"), phrase)


def _is_goal(found: Sequence[Item], at: int) -> bool:
    """ "Push the ball behind the mug", "put the ball on the mug": where it gets to, not where it is."""
    verb = lex.VERBS.get(key_at(found, at - 1))
    moved = verb is not None and (verb.kind not in {None, "static"} or verb.lemma in _PUTS)
    return moved and key_at(found, at + 1) not in {"that", "which", ","}
