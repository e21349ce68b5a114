"""The form in which a prompt wants its reply: a JSON template, "ANSWER: X", a letter, or the text of an option."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import dataclass

from cow_service.readers.question.lexicon import SETS, words
from cow_service.records import OptionsSource

_TEMPLATE = re.compile(r"\{[^{}]*\}", re.DOTALL)
_KEY = re.compile(r"[\"'\u2018\u201c]([\w -]{1,40})[\"'\u2019\u201d]\s*:")
_REASONS = re.compile(r"reason|rationale|explanation|explain|thought|thinking|analysis|justification", re.IGNORECASE)
_ANSWERS = re.compile(r"answer|choice|option|letter|response|result|prediction|verdict|conclusion", re.IGNORECASE)
# "ANSWER: $LETTER", "Answer: [letter]", "Final answer: <X>": a line of a fixed begin and a place for the letter.
_LINE = re.compile(
    r"(?P<begin>\b(?:final |the )?answer\s*:)\s*(?:\$\s?\w+|[<\[({]\s*[^<>\[\](){}\n]{1,40}\s*[>\])}]|X\b|LETTER\b)",
    re.IGNORECASE,
)
_ALONE = re.compile(
    r"entire (?:content|response)|nothing else|only the (?:answer|line)|without (?:any )?explanation", re.I
)
_TEXT = re.compile(
    r"\b(?:single|one) word\b|word or (?:short )?phrase|\b(?:text|content) of the (?:\w+ )?(?:option|answer|choice)"
    r"|full (?:text|option|answer)|repeat the (?:option|answer)",
    re.IGNORECASE,
)
# Sentences of the text, and what those are about that say how to reply.
_BETWEEN_SENTENCES = re.compile(r"((?<=[.?!])\s+|\n+)")
_BETWEEN_PARTS = re.compile(r"((?<=[.?!;:])\s+)")
_PICTURES = words("image images frame frames picture pictures photo photos")
_ABOUT_REPLY = re.compile(
    r"\byour (?:\w+ ){0,2}(?:response|answer|reply|output)s?\b|\bjson\b|answer\s*:\s*\$|\$\s?letter\b", re.IGNORECASE
)
_CONDITION = re.compile(r"\b(?:if|when|once|suppose|assum\w+|imagine)\b", re.IGNORECASE)
_LETTER = re.compile(r"\bletters?\b", re.IGNORECASE)
_YES_NO = re.compile(r"[\s,]*[(\[]\s*yes\s*(?:/|\bor\b|,)\s*no\s*[)\]]?\.?\s*$", re.IGNORECASE)  # what may be replied
_HEADING = re.compile(r"^[ \t]*question[ \t]*(?:\d+[ \t]*)?:[ \t]*", re.IGNORECASE | re.MULTILINE)


@dataclass(frozen=True)
class Reply:
    """What is to be said: an answer (letter or text), the option's text, why, and where the options stood."""

    answer: str
    option: str | None
    reasoning: str
    source: OptionsSource


def reply_text(prompt: str, reply: Reply) -> str:
    """The reply to a prompt, in the form that it asks for; else the answer alone."""
    keys = _template_keys(prompt)
    if keys:
        return json_reply(keys, reply)
    line = list(_LINE.finditer(prompt))
    if line:
        said = f"{line[-1]['begin']} {reply.answer}"
        return said if _ALONE.search(prompt) or not reply.reasoning else f"{reply.reasoning}\n\n{said}"
    wants_text = _TEXT.search(prompt) is not None and not _LETTER.search(prompt)
    if reply.option is not None and (wants_text or reply.source == "question-list"):
        return reply.option
    return reply.answer


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


def json_reply(keys: Sequence[str], reply: Reply) -> str:
    """A JSON object of these keys: reasoning and answer where their names say so, null for what is neither."""
    return json.dumps({key: _value(key, reply) for key in keys}, ensure_ascii=False)


def _value(key: str, reply: Reply) -> str | None:
    if _REASONS.search(key):
        return reply.reasoning
    if not _ANSWERS.search(key):
        return None
    return reply.option if reply.option is not None and reply.source == "question-list" else reply.answer


def _template_keys(prompt: str) -> tuple[str, ...]:
    """The keys of the last JSON template of a prompt that has a place for the answer; empty where there is none."""
    if "json" not in prompt.lower():
        return ()
    for template in reversed(_TEMPLATE.findall(prompt)):
        keys = tuple(dict.fromkeys(key.strip() for key in _KEY.findall(template)))
        if any(_ANSWERS.search(key) for key in keys):
            return keys
    return ()
