"""The answer of the embedded reader: what the world tells of the question, in the words of its options.

One rule for every form: `Outcome.sure` decides whether an answer is given, and half the probability is the line.
"""

import math
import re
from collections.abc import Sequence

from cow_service.narration.words import Phrases, same_name
from cow_service.readers.base import AnswerReading
from cow_service.readers.embedded.english import lexicon as lex
from cow_service.readers.embedded.english.lexicon import ObjectPhrase
from cow_service.readers.embedded.english.noun_phrases import may_name, parse_noun_phrase
from cow_service.readers.options import not_sure_option, option_saying, plain, says_not_sure
from cow_service.records import AnswerOption, Asked, Narration, Outcome, Simulation

_YES = re.compile(r"(?:yes\b(?! (?:and|or) no).*|true)", re.DOTALL | re.IGNORECASE)
# "No contact" says something of the event, "No, it stops" of what is asked.
_NO = re.compile(
    r"no\s*(?:[,.;:!()\u2013\u2014-].*)?|no (?:it|the|this|that|because|they)\b.*|false", re.DOTALL | re.IGNORECASE
)
_COVERING = lex.words("hidden hide hides occluded occlude occludes occlusion covered obscured concealed obstructed")
_MISSING = lex.words("miss misses missed missing avoid avoids avoided untouched")
_SEEN = lex.words("visible unobstructed unoccluded uncovered")
_NEGATIONS = lex.words("not no never n't without nothing neither")
_ANY_WORDS = lex.words("anything something any object objects nothing")
_PASSIVE = lex.words("is are be get gets stays stay remains remain being")
_IT = r"(?:it |the \w+(?: \w+)? )?"
_NONE = re.compile(
    rf"{_IT}(?:(?:hits|touches|reaches) )?(?:none|nothing|neither)(?: of (?:them|these|the \w+))?|neither .+ nor .+"
    rf"|{_IT}misses (?:it|both|all|everything)(?: of them)?|not at all|no (?:objects?|things?|collision|contact|one)"
    rf"|{_IT}(?:never|(?:does|will) not)(?: (?:hits?|touch(?:es)?|reach(?:es)?))?(?: (?:it|anything|any of them))?"
)
_ALL = re.compile(r"(both|all|each)(?: of (?:them|these|the \w+))?(?: (?:objects|things))?")
_ONLY = re.compile(
    r"(?:(?:only|just|both) )?(?:(?:removing|remove|taking away|take away) )?(?:(?:only|just|both) )?"
    r"(.+?)(?:,? (?:only|alone))?"
)
_SEVERAL = re.compile(r"\b(?:both|all|several|more than one|at the same time|simultaneously|each)\b", re.IGNORECASE)


def says_it_happens(text: str, asked: Asked) -> bool | None:
    """Whether an option says that what is asked happens; None where it does not say so plainly.

    It may say that the mover touches, hides or is hidden by the thing asked about, in words of that alone.
    """
    bare, said = text.strip().rstrip(".!"), _unfolded(text)
    if _YES.fullmatch(bare) or _NO.fullmatch(bare):
        return _YES.fullmatch(bare) is not None
    if whole := re.fullmatch(r"it (?:will|does|would)( not)?", said):
        return whole[1] is None
    words, (yes, no) = said.split(), (lex.TOUCHING, _MISSING) if asked.relation == "touches" else (_COVERING, _SEEN)
    about = [at for at, word in enumerate(words) if word in yes | no]
    if len(about) != 1:
        return None
    known = yes | no | _NEGATIONS | lex.FILLERS
    known = known | _ANY_WORDS if asked.target is None else (known | set(plain(asked.target).split())) - {"nothing"}
    before, after = words[: about[0]], words[about[0] + 1 :]
    acting = asked.relation != "covered" and _PASSIVE.isdisjoint(before)  # then the mover is spoken of, by any name
    turned = sum(word in _NEGATIONS for word in words)
    if turned > 1 or not set(after if acting else words) <= known:
        return None
    return ((words[about[0]] in yes) != (turned == 1)) != asked.negated


def names_none(text: str) -> bool:
    """Whether an option says that there is no such object, or that it never happens."""
    return _NONE.fullmatch(_unfolded(text)) is not None


def _unfolded(text: str) -> str:
    """Lower-case words alone, "won't" as "will not"."""
    return re.sub(r"\b(would|does|is|can|will)n? t\b", r"\1 not", plain(text).replace("won t", "will not"))


Span = tuple[float, float]  # from, to; both the same where one value is named

ALONE = 0.25  # share of a single value that it may be off
_WORDS = {"zero": "0", "no": "0", "half": "0.5", **{word: str(value) for word, value in lex.NUMBER_WORDS.items()}}
_NUMBER = re.compile(r"(\d{1,6}(?:[.,]\d{1,6})?) ?(?:(ms|milliseconds?)|(min|minutes?)|(?:s|secs?|(?:a )?seconds?))?\b")
# What an option says around its numbers, and what it allows then.
_SPANS = {
    "value": "(?:about|around|roughly|approximately|exactly|only|just|almost|nearly|at|after|in|it hits|it takes| )*#",
    "range": "(?:between|from)? ?# ?(?:and|to|or|-|–) ?#",
    "above": "(?:(?:after )?more than|over|above|longer than|later than|>) ?#",
    "least": "at least #|# ?(?:[+]|or (?:more|longer|later))",
    "below": "(?:(?:in )?(?:less than|under)|below|fewer than|before|sooner than|<) ?#",
    "most": "(?:at most|up to|within|(?:the )?first) #|# or (?:less|fewer)",
}
_THINGS = r"(?: of (?:them|these|the objects)| (?:other )?(?:objects?|things?|items?|bodies|body)| later)?"


def span_of(text: str, step: int = 0) -> Span | None:
    """The numbers that an option allows; None where it names none, or something else. Times are in s; what is counted
    has a `step` of 1: more than two is three or more."""
    said = " ".join(_WORDS.get(word, word) for word in text.lower().rstrip(".!").split())
    found = [
        float(number.replace(",", ".")) * (0.001 if milli else 60.0 if minute else 1.0)
        for number, milli, minute in _NUMBER.findall(said)
    ]
    around = _NUMBER.sub("#", said)
    form = next((form for form, words in _SPANS.items() if re.fullmatch(f"(?:{words}){_THINGS}", around)), None)
    if form is None or found != sorted(found):
        return None
    low = 0.0 if form in {"below", "most"} else found[0] + (step if form == "above" else 0)
    return low, math.inf if form in {"above", "least"} else found[-1] - (step if form == "below" else 0)


def _times(options: Sequence[AnswerOption]) -> list[tuple[AnswerOption, Span]]:
    """The options that name a time, s, with the span that it stands for: a value, for what is nearer to it than to
    any other value that is named."""
    said = [(option, span) for option in options if (span := span_of(option.text)) is not None]
    values = {low for _, (low, high) in said if low == high}
    gaps = {one: min((abs(one - two) / 2 for two in values - {one}), default=one * ALONE) for one in values}
    return [
        (option, span if span[0] != span[1] else (span[0] - gaps[span[0]], span[0] + gaps[span[0]]))
        for option, span in said
    ]


MAX_UNREAD = 200  # characters


def answer_from(
    options: Sequence[AnswerOption],
    asked: Asked | None,
    simulation: Simulation | None,
    say: Phrases,
    alternatives: Sequence[ObjectPhrase] = (),
    unread: Sequence[str] = (),
) -> AnswerReading:
    """The answer, and why it is not sure, in the language of `say`. `asked` and `alternatives` are read in the
    question, `unread` was not.
    """
    outcome = None if simulation is None else simulation.trajectory.outcome
    if asked is None:
        words = "\n".join(unread)[:MAX_UNREAD].splitlines()
        named = say.templates["names-comma"].join(say("quoted", words=each) for each in words)
        return _unsure(options, say, say("unsure-not-read", words=named or say("the-question")))
    if simulation is None or outcome is None:
        return _unsure(options, say, say("unsure-no-simulation" if simulation is None else "unsure-no-outcome"))
    first = outcome.first
    if outcome.sure and first is not None and alternatives and not any(may_name(each, first) for each in alternatives):
        return _unsure(options, say, say("unsure-not-among", said=first))
    return choose_option(options, outcome, simulation.narration, say)


def choose_option(
    options: Sequence[AnswerOption], outcome: Outcome, narration: Narration, say: Phrases
) -> AnswerReading:
    """The option that says what the simulation says, or its words where there are none; else not sure, and why."""
    if not outcome.sure:
        return _unsure(options, say, narration.summary)
    if not options:
        return AnswerReading(narration.answer, False, reasoning=narration.summary)
    fits = _fitting_set if outcome.asked.form in ("which", "which-to-remove") else _fitting
    fitting = fits([option for option in options if not says_not_sure(option.text)], outcome)
    # Options in another language than English are told by the words of the answer in it, such as "Ja".
    only = fitting[0] if len(fitting) == 1 else None if fitting else option_saying(options, narration.answer)
    if only is not None:
        return AnswerReading(only.letter, False, reasoning=narration.summary)
    return _unsure(options, say, say("unsure-no-option", said=narration.answer))


def _unsure(options: Sequence[AnswerOption], say: Phrases, why: str) -> AnswerReading:
    option = not_sure_option(options) or option_saying(options, say("not-sure"))
    return AnswerReading(None if option is None else option.letter, True, reasoning=why)


def _fitting(options: Sequence[AnswerOption], outcome: Outcome) -> list[AnswerOption]:
    """The options that say what the world says."""
    match outcome.asked.form:
        case "whether" | "changes":
            return [each for each in options if says_it_happens(each.text, outcome.asked) is outcome.happens]
        case "how-many":
            counts = [(each, (0, 0) if names_none(each.text) else span_of(each.text, 1)) for each in options]
            return [each for each, span in counts if span and span[0] <= (outcome.count or 0) <= span[1]]
        case "which-first" if outcome.first is not None:
            return _naming(options, outcome.first)
        case "when" if outcome.happens:
            return _around(options, outcome)
        case "which-first" | "when":
            return [each for each in options if names_none(each.text)]
        case _:
            return []


def _naming(options: Sequence[AnswerOption], name: str) -> list[AnswerOption]:
    """The options that name a thing; none where any names several at once."""
    things = [(each, parse_noun_phrase(each.text)) for each in options if not names_none(each.text)]
    if any(_SEVERAL.search(each.text) for each, _ in things):
        return []
    return [each for each, phrase in things if phrase is not None and may_name(phrase, name)]


def _around(options: Sequence[AnswerOption], outcome: Outcome) -> list[AnswerOption]:
    """The only option whose span of time meets the band of the outcome, where all of the band lies in it."""
    if outcome.time is None:
        return []
    low, high = outcome.time_band or (outcome.time, outcome.time)
    met = [(each, span) for each, span in _times(options) if span[0] <= high and span[1] >= low]
    return [each for each, (start, end) in met if len(met) == 1 and start <= low and high <= end]


def _fitting_set(options: Sequence[AnswerOption], outcome: Outcome) -> list[AnswerOption]:
    """The options that name just the candidates that are meant: of all, if the question names them, else of those that
    any option names."""
    names = [each.object for each in outcome.candidates]
    meant = frozenset(each.object for each in outcome.candidates if each.is_meant and not outcome.is_needless)
    if not outcome.asked.among:
        single = [option.text for option in options if not _ALL.fullmatch(_unfolded(option.text))]
        named = frozenset[str]().union(*(_named_in(text, names) or () for text in single))
        names = [name for name in names if name in named] or names
    return [option for option in options if _named_in(option.text, names) == meant & frozenset(names)]


def _named_in(text: str, names: Sequence[str]) -> frozenset[str] | None:
    """Which of some objects an option names, as in: only the mug; the mug and the box; both; neither. None where it
    names something else, or does not single one out."""
    if names_none(text):
        return frozenset()
    if said := _ALL.fullmatch(_unfolded(text)):
        return frozenset(names) if said[1] != "both" or len(names) == 2 else None

    def named(part: str) -> str | None:
        """The only object that a text may name."""
        phrase = parse_noun_phrase(part)
        found = [name for name in names if same_name(part, name)]
        found = found or [name for name in names if phrase is not None and may_name(phrase, name)]
        return found[0] if len(found) == 1 else None

    bare = _ONLY.fullmatch(" ".join(text.lower().split()).rstrip(".!"))
    whole = "" if bare is None else bare[1]
    is_name = any(same_name(whole, name) for name in names)
    found = [named(part) for part in ([whole] if is_name else re.split(r",? and |, |/| & ", whole))]
    return None if None in found else frozenset(name for name in found if name is not None)
