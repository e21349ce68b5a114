"""Puts a question into plain wording: without how to reply, and without openings."""

import re

from cow_service.readers.embedded.english import lexicon as lex
from cow_service.readers.embedded.english.grammar import read_from
from cow_service.readers.embedded.english.lexicon import key_at

# Sentences of the text, and what those are about that say how to reply.
_BETWEEN_SENTENCES = re.compile(r"((?<=[.?!])\s+|\n+)")
_BETWEEN_PARTS = re.compile(r"((?<=[.?!;:])\s+)")
_PICTURES = lex.words("image images frame frames picture pictures photo photos")
_ABOUT_REPLY = re.compile(
    r"\byour (?:\w+ ){0,2}(?:response|answer|reply|output)s?\b|\bjson\b|answer\s*:\s*\$|\$\s?letter\b", re.IGNORECASE
)
_CONDITION = re.compile(r"\b(?:if|when|once|suppose|assum\w+|imagine)\b", re.IGNORECASE)
_YES_NO = re.compile(r"[\s,]*[(\[]\s*yes\s*(?:/|\bor\b|,)\s*no\s*[)\]]?\.?\s*$", re.IGNORECASE)  # what may be replied
_HEADING = re.compile(r"^[ \t]*question[ \t]*(?:\d+[ \t]*)?:[ \t]*", re.IGNORECASE | re.MULTILINE)


def without_reply_form(prompt: str) -> str:
    """The prompt without the heading of its question, and without sentences that say how to reply and nothing else."""
    sentences = _BETWEEN_SENTENCES.split(_YES_NO.sub("", _HEADING.sub("", prompt)))
    kept = "".join(each for each in sentences if not _ABOUT_REPLY.search(each) or _CONDITION.search(each))
    parts: list[str] = []
    for part in _BETWEEN_PARTS.split(kept):
        said = re.findall(r"\w+", part.lower())
        first = next((word for word in said[:2] if word != "please"), "")
        if not (first in lex.SETS["instructions"] or (first == "note" and not _PICTURES.isdisjoint(said))):
            parts.append(part)  # the others say what to do, or what the images are
    return "".join(parts)


_OPENING = 24  # words of the openings of one sentence
_MAX_TRIES = 12  # of one question
_LONGEST_FIRST = sorted(map(re.escape, lex.TABLES["said_as"]), key=len, reverse=True)
_SAID_AS = re.compile(rf"\b(?:{'|'.join(_LONGEST_FIRST)})\b", re.IGNORECASE)
_TAG = re.compile(rf",\s*(?:{'|'.join(lex.SETS['tags'])})\s*\?(?=\s+\S)", re.IGNORECASE)  # and something else is asked
_CLAIM = re.compile(r"(^|[.!]\s)\s*true or false\s*[:?,]?\s+([^.?!]+)[.?]?\s*$", re.IGNORECASE)  # the last sentence


def without_openings(text: str) -> str:
    """The text without openings; what asks by a statement ("I wonder whether it ...") begins with "tell me" then.

    Words of informal English are put as the grammar has them ("gonna" as "going to").
    """
    text = _CLAIM.sub(r"\1\2?", _TAG.sub(".", text))
    text = _SAID_AS.sub(lambda found: lex.TABLES["said_as"][found[0].lower()], text.replace("’", "'"))
    found, kept, end = lex.tokens(text), list[str](), 0
    starts = [at for at in range(len(found)) if at == 0 or key_at(found, at - 1) in lex.ENDS]
    for at in starts[:_MAX_TRIES]:
        parsed = read_from("opening", found, at, _OPENING)
        if parsed is not None:
            tree, behind = parsed
            asks = f"tell me {found[behind - 1].key} " if "asks_if" in tree else ""
            kept += [text[end : found[at].start], asks]
            end = found[behind].start if behind < len(found) else len(text)
    return "".join([*kept, text[end:]])
