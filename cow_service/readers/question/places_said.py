"""Joins a thing with the words that single it out by another thing: "the ball behind the vase"."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from lark import Token, Tree

from cow_service.readers.question import lexicon as lex
from cow_service.readers.question.parsing import may_begin, parse_from
from cow_service.readers.question.phrases import Item, PlaceWords, key_at
from cow_service.readers.question.words import words_of

_MAX_TRIES = 8  # of one question
_WINDOW = 9  # words
_PUTS = lex.words("put place insert set position lower")


def with_places(found: Sequence[Item]) -> list[Item]:
    """The items, each thing with what is said behind it of its place joined to one."""
    texts = [item.phrase.text.lower() for item in found if item.phrase is not None]
    joined: list[Item] = []
    at = tries = 0
    while at < len(found):
        item, end = found[at], at + 1
        if item.phrase is not None and item.phrase.is_thing and tries < _MAX_TRIES and end < len(found):
            if not may_begin("place", words_of(found[end : end + 1])[0]):
                joined.append(item)
                at = end
                continue
            ahead = words_of(found[end : end + _WINDOW])
            parsed = parse_from("place", ahead)
            tries += 1
            read = None if parsed is None else _place(found[end:], parsed[0])
            if parsed is not None and read is not None and not _is_goal(found, at, ahead[0].text):
                stop = end + ahead[parsed[1] - 1].at + 1
                several = texts.count(item.phrase.text.lower()) > 1
                stop += ahead[0].text == "," and key_at(found, stop) == ","
                words = " ".join(" ".join(each.words) or each.key for each in found[end:stop])
                text = f"{item.phrase.text} {words}" if several else item.phrase.text
                item = replace(item, end=found[stop - 1].end, phrase=replace(item.phrase, text=text, place=read))
                end = stop
        joined.append(item)
        at = end
    return joined


def _place(behind: Sequence[Item], tree: Tree[Token]) -> PlaceWords | None:
    relation = next(str(node.data) for node in tree.iter_subtrees() if str(node.data).endswith("_it"))
    tokens = list(tree.scan_values(lambda value: isinstance(value, Token)))
    phrase = behind[tokens[0].line or 0].phrase if tokens else None
    if tokens and (phrase is None or not phrase.is_thing):
        return None
    return PlaceWords(relation.removesuffix("_it"), phrase)


def _is_goal(found: Sequence[Item], at: int, first: str) -> bool:
    """ "Push the ball behind the mug", "put the ball on the mug": where it gets to, not where it is."""
    verb = lex.VERBS.get(key_at(found, at - 1))
    moved = verb is not None and (verb.kind not in {None, "static"} or verb.lemma in _PUTS)
    return moved and first not in {"that", "which", ","}
