"""What models write where JSON was asked for: phrases of refusal, answers announced in a sentence."""

from __future__ import annotations

import re

_DENIAL = re.compile(
    r"\b(?:not|none|cannot|can['’]?t|couldn['’]?t|sorry|unable|unclear|unknown|impossible|or|there (?:is|are))\b"
    r"|n['’]t\b|\bno\b(?!\.?\s*\d)",
    re.IGNORECASE,
)
# One sentence that an object is not in the picture, and nothing else.
_ABSENT = re.compile(
    r"\W*(?:sorry,? |unfortunately,? )?(?:(?:but )?"
    r"i (?:can(?:no|['’])t|can not|do(?: not|n['’]t)) (?:see|find|locate|identify)"
    r"|there (?:is|are|['’]s) (?:no|not any)|no)\b[^.!?:;{}]{1,80}\b(?:in|on|visible in|present in|shown in) "
    r"(?:the|this|your) (?:given |provided )?(?:image|picture|photo|photograph|scene|frame)\W*",
    re.IGNORECASE,
)
_POINTING = frozenset({"it", "this", "that", "them", "they", "object", "the object", "moving object"})
_ANSWER_IS = re.compile(r"\b(?:final\s+)?answer\b[\s*_\"'`]*(?:is|:|=)[\s*_\"'`]*(?P<said>[^\n]*)", re.IGNORECASE)
_TAGGED = re.compile(r"<answer>(?P<said>.*?)(?:</answer>|$)", re.IGNORECASE | re.DOTALL)
_BOXED = re.compile(r"\\boxed\{(?:\\\w+\{)*(?P<said>[^{}]*)\}")
# A letter alone behind such words; with a word after it, it may be an article.
_CHOSEN = re.compile(
    r"\b(?:[Aa]nswer|[Cc]hoose|[Pp]ick|[Ss]elect)[\s*_:]+(?:[Oo]ption\s+)?(?P<said>[(\[]?[A-Z][)\]]?)(?=[.,;*\s]*(?:\n|$))"
    r"|^\W*(?:[Oo]ption\s+)?(?P<right>[(\[]?[A-Z][)\]]?) is (?:the )?(?:correct|right)\b",
    re.MULTILINE,
)
_SPECIAL = re.compile(r"<\|\w+\|>")
MARKS = "*_`\"'“” \t."


def names_nothing(name: str) -> bool:
    """Whether a phrase that should name an object refuses, denies, hesitates or points without naming."""
    return _DENIAL.search(name) is not None or name.lower().strip(" .") in _POINTING


def says_absent(said: str) -> bool:
    """Whether a text says, in one sentence, that something is not in the image: "There is no toy car in the image."."""
    return _ABSENT.fullmatch(said) is not None


def is_broken_json(said: str) -> bool:
    """Whether a text without a value in it began as JSON: cut short, it is no prose to read answers from."""
    return re.match(r"\W*(?:json\s*)?\{", said) is not None


def announced(said: str) -> list[str]:
    """Answers that a text announces as such, the surest kind of announcement alone."""
    text = _SPECIAL.sub(" ", said)
    for pattern in (_BOXED, _TAGGED, _ANSWER_IS, _CHOSEN):
        groups = [next(group for group in found.groups() if group is not None) for found in pattern.finditer(text)]
        answers = [group.strip(MARKS) for group in groups if group.strip(MARKS)]
        if answers:
            return answers
    return []


def lines_of(said: str) -> list[str]:
    """First and last line of a text, without special tokens: where an answer that is not announced stands."""
    lines = [line.strip(MARKS) for line in _SPECIAL.sub(" ", said).splitlines() if line.strip(MARKS)]
    if not lines:
        return []
    last = re.sub(r"^(?:so|therefore|thus|hence)\W+", "", lines[-1], flags=re.IGNORECASE)
    return list(dict.fromkeys((lines[0], last)))
