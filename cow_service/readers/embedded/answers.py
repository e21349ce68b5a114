"""The answer of the embedded reader: what the world tells of the question, in the words of its options.

One rule for every form: `Outcome.sure` decides whether an answer is given, and half the probability is the line.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from cow_service.readers.base import AnswerReading
from cow_service.readers.embedded.english.asked import Unread
from cow_service.readers.embedded.english.options_said import (
    count_of,
    may_name,
    names_none,
    names_several,
    says_it_happens,
    seconds_of,
    spans,
)
from cow_service.readers.embedded.english.questions import parse_noun_phrase
from cow_service.readers.embedded.english.tokens import ObjectPhrase
from cow_service.readers.options import not_sure_option, says_not_sure
from cow_service.records import AnswerOption, Asked, Doubt, Outcome

HAPPENS = 0.5  # probability from which what is asked happens

NOT_ASKED = (
    "Not sure, because the embedded reader did not understand {words}. It reads questions in English of whether, "
    "when or where something hits, lands on, hides, enters, leaves, misses or is hidden by something, what it hits "
    "first, how many things it hits, whether something is moved or tips, and what changes. Set COW_MLLM to ask a "
    "multimodal LLM."
)
ALL_READ = Unread()
MAX_UNREAD = 200  # characters
NO_SIMULATION = "Not sure, because without a simulation there is nothing for the embedded reader to judge by."
NO_OUTCOME = "Not sure, because the simulation does not tell what the question asks."
NOT_FOUND = "Not sure, because what the question asks about was not found in the image under that name."
NOT_TOLD = "Not sure, because nothing in the image tells what was asked: its objects could not be told apart."
NO_OPTION = "The world's answer is '{said}', but not exactly one of the options says so."
NOT_AMONG = "Not sure, because what is met first, '{said}', is not one of what the question asks about."
TOO_CLOSE = "Not sure: the probability of {what} is {probability:.2f}{depends}."

_DOUBTS: dict[Doubt, str] = {
    "speed": "how fast it moves",
    "heading": "which way it heads in depth",
    "camera": "how the camera stands",
    "size": "how large things are",
    "place": "where things are in depth",
    "friction": "how much the floor brakes",
}


def answer_from(
    options: Sequence[AnswerOption],
    asked: Asked | None,
    outcome: Outcome | None,
    simulated: bool,
    alternatives: Sequence[ObjectPhrase] = (),
    unread: Unread = ALL_READ,
) -> AnswerReading:
    """The answer, and why it is not sure. `asked` and `alternatives` are read in the question, `unread` was not."""
    if asked is None or not simulated or outcome is None:
        words = "', '".join(unread.turning or unread.beside)[:MAX_UNREAD]
        named = NOT_ASKED.format(words=f"'{words}'" if words else "the question")
        why = named if asked is None else NO_OUTCOME if simulated else NO_SIMULATION
        return _unsure(options, why)
    first = outcome.first
    if outcome.sure and first is not None and alternatives and not any(may_name(each, first) for each in alternatives):
        return replace(_unsure(options, NOT_AMONG.format(said=first)), reasoning=outcome.facts)
    return choose_option(options, outcome)


def choose_option(options: Sequence[AnswerOption], outcome: Outcome) -> AnswerReading:
    """The option that says what the world says, or its words where there are none; else not sure, and why."""
    why = why_not_sure(outcome)
    if why:
        reading = _unsure(options, why)
    elif not options:
        reading = AnswerReading(_in_words(outcome), False)
    else:
        offered = [option for option in options if not says_not_sure(option.text)]
        fitting = _fitting(offered, outcome)
        if len(fitting) == 1:
            reading = AnswerReading(fitting[0].letter, False)
        else:
            reading = _unsure(options, NO_OPTION.format(said=_in_words(outcome)))
    return replace(reading, reasoning=outcome.facts)


def why_not_sure(outcome: Outcome) -> str:
    """What keeps the world from an answer, in one sentence; empty where it gives one."""
    if outcome.asked.target is not None and outcome.object is None:
        return NOT_FOUND
    if outcome.probability is None or (outcome.asked.form == "how-many" and outcome.count is None):
        return NOT_TOLD
    if outcome.sure:
        return ""
    what = "what is asked" if outcome.asked.form == "whether" else f"the likeliest answer, '{_in_words(outcome)}',"
    depends = f"; it depends most on {_DOUBTS[outcome.depends_on[0]]}" if outcome.depends_on else ""
    return TOO_CLOSE.format(what=what, probability=outcome.probability, depends=depends)


def _unsure(options: Sequence[AnswerOption], why: str) -> AnswerReading:
    option = not_sure_option(options)
    return AnswerReading(None if option is None else option.letter, True, notes=(why,))


def _happens(outcome: Outcome) -> bool:
    return outcome.probability is not None and outcome.probability >= HAPPENS


def _in_words(outcome: Outcome) -> str:
    """The answer to an open question."""
    match outcome.asked.form:
        case "whether" | "changes":
            return "Yes" if _happens(outcome) else "No"
        case "which-first":
            return outcome.first or "Nothing"
        case "when":
            return "Never" if outcome.time is None else f"After about {outcome.time:.1f} s"
        case "how-many":
            return str(outcome.count)
        case "where" | "what-happens":
            return outcome.facts


def _fitting(options: Sequence[AnswerOption], outcome: Outcome) -> list[AnswerOption]:
    """The options that say what the world says."""
    match outcome.asked.form:
        case "whether" | "changes":
            happens = _happens(outcome)
            return [option for option in options if says_it_happens(option.text, outcome.asked) is happens]
        case "which-first":
            return _naming(options, outcome.first)
        case "when":
            return _at_time(options, outcome)
        case "how-many":
            return [option for option in options if outcome.count in (count_of(option.text) or range(0))]
        case "where" | "what-happens":
            return []


def _naming(options: Sequence[AnswerOption], first: str | None) -> list[AnswerOption]:
    if first is None:
        return [option for option in options if names_none(option.text)]
    if any(names_several(option.text) for option in options):
        return []
    said = [(option, parse_noun_phrase(option.text)) for option in options if not names_none(option.text)]
    return [option for option, phrase in said if phrase is not None and may_name(phrase, first)]


def _at_time(options: Sequence[AnswerOption], outcome: Outcome) -> list[AnswerOption]:
    """The one option in whose span the time lies, where no other option's meets the band of times."""
    if outcome.time is None:
        return [option for option in options if names_none(option.text)]
    said = [(option, span) for option in options if (span := seconds_of(option.text)) is not None]
    low, high = outcome.time_band or (outcome.time, outcome.time)
    placed = list(zip([option for option, _ in said], spans([span for _, span in said]), strict=True))
    met = [(option, span) for option, span in placed if span[0] <= high and span[1] >= low]
    return [option for option, (start, end) in met if len(met) == 1 and start <= outcome.time <= end]
