"""The options that a question offers, and the form in which it wants the reply."""

import json
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from cow_service.records import AnswerOption, OptionsSource

Span = tuple[int, int]  # begin and end of a piece of the question


class Listed(NamedTuple):
    """What a question offers, and the question without it."""

    options: tuple[tuple[str, str], ...]  # letter and text
    rest: str
    lettered: bool = True  # the letters stand in the question
    places: tuple[Span, ...] = ()  # of the text of each option in the question


@dataclass(frozen=True)
class Reply:
    """What a reply says: an answer (letter or text), the option's text, why, and where the options stood."""

    answer: str
    option: str | None
    reasoning: str
    source: OptionsSource


MAX_LISTS = 12  # only the last so many lists of a text are considered
_LETTERS = "ABCDEFGHIJKLMNOPQRSTUVWXYZ"
_MARKER = re.compile(
    r"[(\[]([A-Za-z])[)\]]\s?[:.]?|\b([A-Z])[.):）](?=[\s*])|(?:(?<=\n)|^)[ \t]*([a-z])[.)](?=\s)", re.ASCII
)
_LIST_END = re.compile(r"\n|[.?!;](?=\s|$|[A-Z][a-z])")  # "C. Not sure.Note that ...": a space may be missing
_EDGES = " ,;.*-•–"
_QUOTES = "\"'`\u2018\u2019\u201c\u201d"
_ASKS = re.compile(r"(?:will|would|does|do|is|are|can|could) ", re.IGNORECASE)
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
_FORM = re.compile(r"\b(?:letters?|words?|numbers?|sentences?|json|options?|choices?|explanations?)\b", re.IGNORECASE)
_LONGEST = 6  # words of an option without a letter
_NOT_SURE = re.compile(
    r"\b(not (quite |really )?(sure|certain)|unsure|uncertain|(can(no|'|’)?t|cannot|can not|could not|impossible to) "
    r"(be )?(tell|told|say|said|know|known|determined?|decided?)|don'?t know|unknown|undecided|not enough information|"
    r"insufficient information)\b",
    re.IGNORECASE,
)

MARKS = "*_`\"'“” \t."  # around an answer
_LETTER = re.compile(
    r"(?:option\s+|choice\s+)?[(\[]?(?P<letter>[A-Za-z])[)\]]?\s*[.:)\-]?\s*(?P<text>.*)", re.DOTALL | re.IGNORECASE
)
_TEMPLATE = re.compile(r"\{[^{}]*\}", re.DOTALL)
_KEY = re.compile(r"[\"'\u2018\u201c]([\w -]{1,40})[\"'\u2019\u201d]\s*:")
_REASONS = re.compile(r"reason|rationale|explanation|explain|thought|thinking|analysis|justification", re.IGNORECASE)
_ANSWERS = re.compile(r"answer|choice|option|letter|response|result|prediction|verdict|conclusion", re.IGNORECASE)
# "ANSWER: $LETTER", "Answer: [letter]", "Final answer: <X>": a fixed beginning and a place for the letter.
_ANSWER_LINE = re.compile(
    r"(?P<begin>\b(?:final |the )?answer\s*:)\s*(?:\$\s?\w+|[<\[({]\s*[^<>\[\](){}\n]{1,40}\s*[>\])}]|X\b|LETTER\b)",
    re.IGNORECASE,
)
_LINE_ALONE = re.compile(
    r"entire (?:content|response)|nothing else|only the (?:answer|line)|without (?:any )?explanation", re.I
)
_TEXT = re.compile(
    r"\b(?:single|one) word\b|word or (?:short )?phrase|\b(?:text|content) of the (?:\w+ )?(?:option|answer|choice)"
    r"|full (?:text|option|answer)|repeat the (?:option|answer)",
    re.IGNORECASE,
)


def read_choices(question: str, given: Sequence[str | AnswerOption] | None) -> tuple[AnswerOption, ...]:
    """The options of the request, lettered A, B, C..., else those that the question lists; empty if it is open."""
    if not given:
        return tuple(AnswerOption(letter=letter, text=text) for letter, text in split_options(question).options)
    texts = [" ".join(text.split()) for text in given if isinstance(text, str)]
    if not texts:
        pairs = (option for option in given if isinstance(option, AnswerOption))
        return tuple(AnswerOption(letter=pair.letter, text=" ".join(pair.text.split())) for pair in pairs)
    # Letters are taken off where every option begins with its own: "A. M." alone may be a text.
    bare = [
        re.sub(rf"^\s*(?:\({letter}\)|{letter}[.):])\s*(?=\S)", "", text).strip()
        for letter, text in zip(_LETTERS, texts, strict=False)
    ]
    if all(a != b for a, b in zip(bare, texts, strict=True)):
        texts = bare
    return tuple(AnswerOption(letter=letter, text=text) for letter, text in zip(_LETTERS, texts, strict=False))


def choices_source(question: str, given: Sequence[str | AnswerOption] | None) -> OptionsSource:
    """Where the options of `read_choices` stand."""
    if given:
        return "request"
    listed = split_options(question)
    if not listed.options:
        return "none"
    return "question-letters" if listed.lettered else "question-list"


def question_without(question: str, options: Sequence[AnswerOption]) -> str:
    """The question without the options that it lists itself, where those are not `options`."""
    listed = split_options(question)
    same = [(one.letter, plain(one.text)) for one in options] == [(a, plain(text)) for a, text in listed.options]
    if same or not listed.options or not options:
        return question
    return " ".join(listed.rest.replace(" . ", " ").split())


def says_not_sure(text: str) -> bool:
    """Whether a text says that the answer is not known."""
    return _NOT_SURE.search(text) is not None


def not_sure_option(options: Sequence[AnswerOption]) -> AnswerOption | None:
    """The first option that says so, if any."""
    return next((option for option in options if says_not_sure(option.text)), None)


def option_saying(options: Sequence[AnswerOption], text: str) -> AnswerOption | None:
    """The only option whose text is this, but for case, spaces and punctuation."""
    said = [option for option in options if plain(option.text) == plain(text) != ""]
    return said[0] if len(said) == 1 else None


def option_named(options: Sequence[AnswerOption], said: str) -> AnswerOption | None:
    """The option that a short text names: by its letter, by its own words, or by both."""
    text = said.strip(MARKS)
    if letter := _LETTER.fullmatch(text):
        # Behind the letter stands nothing, or that option's own text.
        lettered = next((option for option in options if option.letter == letter["letter"].upper()), None)
        rest = letter["text"].strip(MARKS + ")")
        if lettered and (not rest or rest == lettered.text or plain(rest) == plain(lettered.text) != ""):
            return lettered
    return option_saying(options, text)


def plain(text: str) -> str:
    """Lower-case words alone."""
    return " ".join(re.findall(r"\w+", text.lower()))


def split_options(question: str) -> Listed:
    """The options of a question, and the question without them. Those without letters get A, B, C...

    Letters that follow one another from A may also name things ("car (A) hits car (B)"): a list has texts that differ
    and none that asks; of several such lists the longest counts, and of those the last.
    """
    chains: list[list[re.Match[str]]] = []  # runs of markers A, B, C...
    for marker in _MARKER.finditer(question):
        letter = _letter(marker)
        if letter == "A":
            chains.append([marker])
        elif chains and len(chains[-1]) < len(_LETTERS) and letter == _LETTERS[len(chains[-1])]:
            chains[-1].append(marker)
    chains = [chain for chain in chains if len(chain) > 1][-MAX_LISTS:]
    lists = [listed for chain in chains for listed in _read_lettered(question, chain)]
    longest = max((len(listed.options) for listed in lists), default=0)
    if longest:
        return [listed for listed in lists if len(listed.options) == longest][-1]
    return next(_read_announced(question), Listed((), question))


def _letter(marker: re.Match[str]) -> str:
    return next(group for group in marker.groups() if group).upper()


def _read_lettered(question: str, chain: Sequence[re.Match[str]]) -> Iterator[Listed]:
    """The list that a chain of markers makes; nothing where its parts are no options."""
    closing = _LIST_END.search(question, min(chain[-1].end() + 1, len(question)))
    ends = [*(marker.start() for marker in chain[1:]), closing.start() if closing else len(question)]
    spans = [question[marker.end() : end] for marker, end in zip(chain, ends, strict=True)]
    texts = [" ".join(span.split()).strip(_EDGES) for span in spans]
    for joint in (" or", " and"):
        texts = [text.removesuffix(joint).rstrip(_EDGES) for text in texts]
    differ = len({text.lower() for text in texts}) == len(texts)
    say_something = all(re.search(r"[\w+−±-]", text) for text in texts)
    ask = any("?" in span or _MARKER.search(text) or _ASKS.match(text) for span, text in zip(spans, texts, strict=True))
    if differ and say_something and not ask:
        options = tuple((_letter(marker), text) for marker, text in zip(chain, texts, strict=True))
        places = _places(question, [marker.end() for marker in chain], texts)
        yield Listed(options, question[: chain[0].start()] + " . " + question[ends[-1] :], places=places)


def _read_announced(question: str) -> Iterator[Listed]:
    """Lists without letters that say that they are one, last first: "Options: yes, no or not sure"."""
    for found in reversed(list(_ANNOUNCED.finditer(question))):
        listed = _ONLY.sub("", found["list"])
        texts = [part.strip(_EDGES + _QUOTES) for part in _PARTS.split(listed)]
        are_short = all(text and len(text.split()) <= _LONGEST and not _FORM.search(text) for text in texts)
        if are_short and 1 < len({text.lower() for text in texts}) == len(texts) <= len(_LETTERS):
            begins = [found.start("list"), *(found.start("list") + part.end() for part in _PARTS.finditer(listed))]
            rest = question[: found.start()] + " . " + question[found.end() :]
            options = tuple(zip(_LETTERS, texts, strict=False))
            yield Listed(options, rest, lettered=False, places=_places(question, begins, texts))


def _places(question: str, begins: Sequence[int], texts: Sequence[str]) -> tuple[Span, ...]:
    """Where the texts of the options stand, each after its own begin."""
    found = [
        re.compile(r"\s+".join(re.escape(word) for word in text.split())).search(question, begin)
        for begin, text in zip(begins, texts, strict=True)
    ]
    return tuple(each.span() for each in found if each is not None)


def reply_text(prompt: str, reply: Reply) -> str:
    """The reply to a prompt, in the form that it asks for: a JSON template, "ANSWER: X", a letter, an option's text."""
    # The last JSON template that has a place for the answer.
    templates = reversed(_TEMPLATE.findall(prompt)) if "json" in prompt.lower() else ()
    named = (dict.fromkeys(key.strip() for key in _KEY.findall(template)) for template in templates)
    keys = next((keys for keys in named if any(_ANSWERS.search(key) for key in keys)), None)
    if keys is not None:
        listed = reply.option is not None and reply.source == "question-list"
        answer = reply.option if listed else reply.answer
        values = {a: reply.reasoning if _REASONS.search(a) else answer if _ANSWERS.search(a) else None for a in keys}
        return json.dumps(values, ensure_ascii=False)
    lines = list(_ANSWER_LINE.finditer(prompt))
    if lines:
        line = f"{lines[-1]['begin']} {reply.answer}"
        return line if _LINE_ALONE.search(prompt) or not reply.reasoning else f"{reply.reasoning}\n\n{line}"
    wants_text = _TEXT.search(prompt) is not None and not re.search(r"\bletters?\b", prompt, re.IGNORECASE)
    if reply.option is not None and (wants_text or reply.source == "question-list"):
        return reply.option
    return reply.answer


# Sentences of a prompt that say how to reply and nothing else, and its heading.
_ABOUT_REPLY = re.compile(
    r"\byour (?:\w+ ){0,2}(?:response|answer|reply|output)s?\b|\bjson\b|answer\s*:\s*\$|\$\s?letter\b", re.IGNORECASE
)
_CONDITION = re.compile(r"\b(?:if|when|once|suppose|assum\w+|imagine)\b", re.IGNORECASE)
_INSTRUCTION = re.compile(
    r"(?:please )?(?:think|reason|answer|choose|select|pick|options?|choices?|explain|respond|reply|provide|return"
    r"|output|note that the (?:first|second|last|image|video|frame)\w*)\b", re.IGNORECASE,
)  # fmt: skip
_YES_NO = re.compile(r"[\s,]*[(\[]\s*yes\s*(?:/|\bor\b|,)\s*no\s*[)\]]?\.?\s*$", re.IGNORECASE)
_HEADING = re.compile(r"^[ \t]*question[ \t]*(?:\d+[ \t]*)?:[ \t]*", re.IGNORECASE | re.MULTILINE)


def without_reply_form(prompt: str) -> str:
    """The prompt without the heading of its question, and without sentences that say how to reply and nothing else."""
    sentences = re.split(r"((?<=[.?!])\s+|\n+)", _YES_NO.sub("", _HEADING.sub("", prompt)))
    kept = "".join(each for each in sentences if not _ABOUT_REPLY.search(each) or _CONDITION.search(each))
    return "".join(part for part in re.split(r"((?<=[.?!;:])\s+)", kept) if not _INSTRUCTION.match(part.strip()))
