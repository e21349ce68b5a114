"""The options that a question lists, (A) Yes, (B) No, or "Options: yes or no", and the question without them."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import NamedTuple

Options = tuple[tuple[str, str], ...]  # letter and text


class Listed(NamedTuple):
    """What a question offers, and the question without it."""

    options: Options
    rest: str
    lettered: bool = True  # the letters stand in the question
    places: tuple[tuple[int, int], ...] = ()  # begin and end of the text of each option in the question


MAX_LISTS = 12  # the last so many of a text are looked at
_MARKER = re.compile(
    r"[(\[]([A-Za-z])[)\]]\s?[:.]?|\b([A-Z])[.):）](?=[\s*])|(?:(?<=\n)|^)[ \t]*([a-z])[.)](?=\s)", re.ASCII
)
_OPTION_END = re.compile(r"\n|[.?!;](?=\s|$|[A-Z][a-z])")  # "C. Not sure.Note that ...": a space may be missing
# A list without letters needs words that say that it is one.
_ANNOUNCED = re.compile(
    r"\b(?:(?:choose|select|pick|decide) (?:one )?(?:of|from|between|among)(?: (?:the|these))?(?: following)?"
    r"(?: (?:options?|answers?|choices))?"
    r"|(?:the )?(?:possible |following )?(?:options|choices|answers)(?: are)?"
    r"|(?:please )?(?:answer|reply|respond)(?: only| just| simply)? with(?: either)?"
    r"|(?:please )?(?:answer|reply|respond)(?: only| just| simply)?(?=:? (?:yes|no|true)\b))"
    r"\s*:?\s+(?P<list>[^\n.?!;:]+)",
    re.IGNORECASE,
)
_PARTS = re.compile(r",? or |,? and (?=[^,]*$)|, ", re.IGNORECASE)
_ONLY = re.compile(r"\s+(?:only|please|alone)\W*$", re.IGNORECASE)
_QUOTES = "\"'`\u2018\u2019\u201c\u201d"
_FORM = re.compile(r"\b(?:letters?|words?|numbers?|sentences?|json|options?|choices?|explanations?)\b", re.IGNORECASE)
_LONGEST = 6  # words of an option without a letter
_WORDS = re.compile(r"[\w+−±-]")
_ASKS = re.compile(r"(?:will|would|does|do|is|are|can|could) ", re.IGNORECASE)
_EDGES = " ,;.*-•–"
_LETTERS = "ABCDEFGHIJKLMNOPQRSTUVWXYZ"


def split_options(question: str) -> Listed:
    """The options of a question, and the question without them. Those without letters get A, B, C...

    Letters that follow one another from A may also name things ("car (A) hits car (B)"): a list has texts that differ
    and none that asks; of several such lists the longest counts, and of those the last.
    """
    best: tuple[list[re.Match[str]], int, Options] | None = None
    for chain in _chains(question)[-MAX_LISTS:]:
        end = _end(question, chain)
        options = _read(question, chain, end)
        if options and (best is None or len(options) >= len(best[2])):
            best = chain, end, options
    if best is None:
        return _split_announced(question)
    chain, end, options = best
    places = _places(question, [marker.end() for marker in chain], options)
    return Listed(options, question[: chain[0].start()] + " . " + question[end:], places=places)


def _split_announced(question: str) -> Listed:
    """The options of a list without letters that says that it is one: "Options: yes, no or not sure"."""
    for found in reversed(list(_ANNOUNCED.finditer(question))):
        listed = _ONLY.sub("", found["list"])
        texts = [part.strip(_EDGES + _QUOTES) for part in _PARTS.split(listed)]
        short = all(text and len(text.split()) <= _LONGEST and not _FORM.search(text) for text in texts)
        if short and 1 < len({text.lower() for text in texts}) == len(texts) <= len(_LETTERS):
            options = tuple(zip(_LETTERS, texts, strict=False))
            parts = [found.start("list"), *(found.start("list") + part.end() for part in _PARTS.finditer(listed))]
            rest = question[: found.start()] + " . " + question[found.end() :]
            return Listed(options, rest, lettered=False, places=_places(question, parts, options))
    return Listed((), question)


def _places(question: str, begins: Sequence[int], options: Options) -> tuple[tuple[int, int], ...]:
    """Where the texts of the options stand, each after its own begin."""
    found = [
        re.compile(r"\s+".join(re.escape(word) for word in text.split())).search(question, begin)
        for begin, (_, text) in zip(begins, options, strict=True)
    ]
    return tuple(each.span() for each in found if each is not None)


def _chains(question: str) -> list[list[re.Match[str]]]:
    """Runs of markers A, B, C..., two or more."""
    chains: list[list[re.Match[str]]] = []
    for marker in _MARKER.finditer(question):
        letter = _letter(marker)
        if letter == "A":
            chains.append([marker])
        elif chains and ord(letter) == ord("A") + len(chains[-1]):
            chains[-1].append(marker)
    return [chain for chain in chains if len(chain) > 1]


def _letter(marker: re.Match[str]) -> str:
    return next(group for group in marker.groups() if group).upper()


def _end(question: str, chain: Sequence[re.Match[str]]) -> int:
    """Where the last option ends: at its line's or its sentence's end."""
    closing = _OPTION_END.search(question, min(chain[-1].end() + 1, len(question)))
    return closing.start() if closing else len(question)


def _read(question: str, chain: Sequence[re.Match[str]], end: int) -> Options:
    """The options of a chain; empty where its parts are no options."""
    ends = [*(marker.start() for marker in chain[1:]), end]
    spans = [question[marker.end() : stop] for marker, stop in zip(chain, ends, strict=True)]
    texts = [_text(span) for span in spans]
    listed = all(_WORDS.search(text) for text in texts) and len({text.lower() for text in texts}) == len(texts)
    asks = any(
        "?" in span or _MARKER.search(text) or _ASKS.match(text) for span, text in zip(spans, texts, strict=True)
    )
    return tuple((_letter(m), text) for m, text in zip(chain, texts, strict=True)) if listed and not asks else ()


def _text(span: str) -> str:
    words = " ".join(span.split()).strip(_EDGES)
    for joint in (" or", " and"):
        words = words.removesuffix(joint).rstrip(_EDGES)
    return words
