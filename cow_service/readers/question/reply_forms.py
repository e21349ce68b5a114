"""What a prompt says of the reply that it wants, taken off before the question is read."""

from __future__ import annotations

import re

from cow_service.readers.question.lexicon import SETS, words

# Sentences of the text, and what those are about that say how to reply.
_BETWEEN_SENTENCES = re.compile(r"((?<=[.?!])\s+|\n+)")
_BETWEEN_PARTS = re.compile(r"((?<=[.?!;:])\s+)")
_PICTURES = words("image images frame frames picture pictures photo photos")
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
    return "".join(each for each in _BETWEEN_PARTS.split(kept) if not _instructs(each))


def _instructs(sentence: str) -> bool:
    """Whether it says what to do, or what the images are, not what happens in them."""
    said = re.findall(r"\w+", sentence.lower())
    first = next((word for word in said[:2] if word != "please"), "")
    return first in SETS["instructions"] or (first == "note" and not _PICTURES.isdisjoint(said))
