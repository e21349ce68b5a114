"""The answer of the embedded reader: what the world tells of the question, in the words of its options.

One rule for every form: `Outcome.sure` decides whether an answer is given, and half the probability is the line.
"""

import math
import re
from collections.abc import Sequence
from itertools import pairwise

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
_TOUCHING = lex.TOUCHING
_COVERING = lex.words("hidden hide hides occluded occlude occludes occlusion covered obscured concealed obstructed")
_MISSING = lex.words("miss misses missed missing avoid avoids avoided untouched")
_SEEN = lex.words("visible unobstructed unoccluded uncovered")
_NEGATIONS = lex.words("not no never n't without nothing neither")
_ANY_WORDS = lex.words("anything something any object objects nothing")
_PASSIVE = lex.words("is are be get gets stays stay remains remain being")
_BARE = dict.fromkeys(("it will", "it does", "it would"), True) | dict.fromkeys(
    ("it will not", "it does not", "it would not", "it can not"), False
)
_NONE = re.compile(
    r"none|nothing|neither|never|not at all|no (?:object|objects|thing|collision|contact|one|time|hit)"
    r"|none of (?:them|these|the above|the objects)|neither of (?:them|these|the two)"
    r"|(?:it |the \w+(?: \w+)? )?(?:hits|touches|reaches) (?:nothing|none|none of them)"
    r"|(?:it |the \w+(?: \w+)? )?misses (?:it|both|all|everything|both of them|all of them)"
    r"|(?:it |the \w+(?: \w+)? )?never (?:hits|touches|reaches)(?: (?:it|anything|any of them))?"
    r"|(?:it |the \w+(?: \w+)? )?(?:does|will) not(?: (?:hit|touch|reach|collide with))?"
    r"(?: (?:it|anything|any object|any of them|happen))?"
)
_ALL = re.compile(r"(both|all|each)(?: of (?:them|these|the \w+))?(?: (?:objects|things))?")
_ONLY = re.compile(
    r"(?:(?:it is )?(?:only|just|both) )?(?:(?:by )?(?:removing|remove|taking away|take away) )?(?:only |just |both )?"
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
    if said in _BARE:
        return _BARE[said]
    words, (yes, no) = said.split(), (_TOUCHING, _MISSING) if asked.relation == "touches" else (_COVERING, _SEEN)
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

MOST = 1000  # of what is counted
ALONE = 0.25  # share of a single value that it may be off
_WORDS = {"zero": "0", "no": "0", **{word: str(value) for word, value in lex.NUMBER_WORDS.items()}}
_UNITS = {"ms": 0.001, "milliseconds": 0.001, "millisecond": 0.001, "min": 60.0, "minute": 60.0, "minutes": 60.0}
_N = r"(\d{1,6}(?:\.\d{1,6})?)"
_UNIT = r"(?: ?(ms|milliseconds?|s|secs?|seconds?|min|minutes?))?"
_ABOUT = r"(?:at|after|in|about|around|approximately|roughly|circa|ca|exactly|almost|nearly|it hits|it takes|~)"
_BELOW = r"(?:less than|under|below|fewer than|within|before|in under|in less than|sooner than|<)"
_ABOVE = r"(?:more than|over|above|longer than|later than|after more than|>)"
_TIME_FORMS: tuple[tuple[re.Pattern[str], str], ...] = (
    (re.compile(rf"(?:between|from)? ?{_N}{_UNIT} ?(?:and|to|-|–) ?{_N}{_UNIT}"), "range"),
    (re.compile(rf"{_BELOW} ?{_N}{_UNIT}|(?:the )?first {_N}{_UNIT}"), "below"),
    (re.compile(rf"{_ABOVE} ?{_N}{_UNIT}|{_N}{_UNIT} or (?:more|longer|later)"), "above"),
    (re.compile(rf"(?:{_ABOUT} )*{_N}{_UNIT}(?: later)?"), "value"),
)
_THINGS = r"(?:(?: of (?:them|these|the objects))|(?: (?:other )?(?:objects?|things?|items?|obstacles?|bodies|body)))?"
_COUNT_FORMS: tuple[tuple[re.Pattern[str], str], ...] = (
    (re.compile(rf"(?:exactly |only |just )?(\d{{1,3}}){_THINGS}"), "value"),
    (re.compile(rf"(?:between )?(\d{{1,3}}) ?(?:and|to|-|–|or) ?(\d{{1,3}}){_THINGS}"), "range"),
    (re.compile(rf"(?:more than|over) (\d{{1,3}}){_THINGS}"), "above"),
    (re.compile(rf"at least (\d{{1,3}}){_THINGS}|(\d{{1,3}})(?: ?\+| or more){_THINGS}"), "least"),
    (re.compile(rf"(?:less than|fewer than) (\d{{1,3}}){_THINGS}"), "below"),
    (re.compile(rf"(?:at most|up to) (\d{{1,3}}){_THINGS}|(\d{{1,3}}) or (?:less|fewer){_THINGS}"), "most"),
)


def seconds_of(text: str) -> Span | None:
    """The time that a text names, s; None where it names none, or more than a time."""
    said = _digits(text)
    for pattern, form in _TIME_FORMS:
        match = pattern.fullmatch(said)
        if match is None:
            continue
        found = [group for group in match.groups() if group is not None]
        numbers = [float(group) for group in found if group[0].isdigit()]
        units = [_UNITS.get(group, 1.0) for group in found if not group[0].isdigit()] or [1.0]
        values = [number * unit for number, unit in zip(numbers, (units * 2)[-len(numbers) :], strict=False)]
        if form == "range":
            return (values[0], values[1]) if values[0] < values[1] else None
        return {"below": (0.0, values[0]), "above": (values[0], math.inf), "value": (values[0], values[0])}[form]
    return None


def spans(said: Sequence[Span]) -> list[Span]:
    """The span that each time stands for: a value, for all that is nearer to it than to another value named."""
    values = sorted({low for low, high in said if low == high})
    gaps = [high - low for low, high in pairwise(values)]
    found: list[Span] = []
    for low, high in said:
        if low != high:
            found.append((low, high))
        elif gaps:
            at = values.index(low)
            before, after = gaps[max(at - 1, 0)], gaps[min(at, len(gaps) - 1)]
            found.append((max(low - before / 2, 0.0), low + after / 2))
        else:
            found.append((low * (1 - ALONE), low * (1 + ALONE)))
    return found


def count_of(text: str) -> range | None:
    """The numbers that a text allows for what is counted; None where it names none."""
    said = _digits(text)
    if said in {"none", "nothing", "0 of them", "none of them"}:
        return range(1)
    for pattern, form in _COUNT_FORMS:
        match = pattern.fullmatch(said)
        if match is not None:
            first, *rest = (int(group) for group in match.groups() if group is not None)
            spans = {
                "value": (first, first + 1), "range": (first, rest[0] + 1 if rest else 0), "above": (first + 1, MOST),
                "least": (first, MOST), "below": (0, first), "most": (0, first + 1),
            }  # fmt: skip
            return range(*spans[form])
    return None


def _digits(text: str) -> str:
    """Lower case, number words as digits, without a full stop at the end."""
    said = re.sub(r"(?<=\d),(?=\d)", ".", text.lower().strip()).rstrip(".!")
    said = re.sub(r"\bhalf a (?=second)", "0.5 ", said)
    said = re.sub(r"\ba (?=second)", "1 ", said)
    said = re.sub(r"\band a half\b", "and_a_half", said)
    said = " ".join(_WORDS.get(word, word) for word in re.split(r"[\s]+", said))
    said = re.sub(r"(\d+) and_a_half\b", r"\1.5", said)
    return " ".join(said.split())


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
    form, first = outcome.asked.form, outcome.first
    if form in ("whether", "changes"):
        is_yes = outcome.happens
        return [option for option in options if says_it_happens(option.text, outcome.asked) is is_yes]
    if form == "how-many":
        return [option for option in options if outcome.count in (count_of(option.text) or range(0))]
    if (form == "which-first" and first is None) or (form == "when" and not outcome.happens):
        return [option for option in options if names_none(option.text)]
    if form == "which-first" and first is not None:
        things = [option for option in options if not names_none(option.text)]
        several = any(_SEVERAL.search(option.text) for option in things)
        named = [(option, parse_noun_phrase(option.text)) for option in things if not several]
        return [option for option, phrase in named if phrase is not None and may_name(phrase, first)]
    if form == "when" and outcome.time is not None:
        # The one option in whose span the time lies, where no other option's meets the band of times.
        said = [(option, span) for option in options if (span := seconds_of(option.text)) is not None]
        low, high = outcome.time_band or (outcome.time, outcome.time)
        placed = zip([option for option, _ in said], spans([span for _, span in said]), strict=True)
        met = [(option, span) for option, span in placed if span[0] <= high and span[1] >= low]
        return [option for option, (start, end) in met if len(met) == 1 and start <= outcome.time <= end]
    return []


def _fitting_set(options: Sequence[AnswerOption], outcome: Outcome) -> list[AnswerOption]:
    """The options that name just the candidates that are meant: of all, if the question names them, else of those that
    any option names."""
    names = [each.object for each in outcome.candidates]
    meant = frozenset(each.object for each in outcome.candidates if each.is_meant and not outcome.is_needless)
    if not outcome.asked.among:
        chosen = [_named_in(option.text, names) or frozenset[str]() for option in options if not _says_all(option.text)]
        named = frozenset[str]().union(*chosen)
        names = [name for name in names if name in named] or names
    return [option for option in options if _named_in(option.text, names) == meant & frozenset(names)]


def _says_all(text: str) -> re.Match[str] | None:
    return _ALL.fullmatch(_unfolded(text))


def _named_in(text: str, names: Sequence[str]) -> frozenset[str] | None:
    """Which of some objects an option names, as in: only the mug; the mug and the box; both; neither. None where it
    names something else, or does not single one out."""
    if names_none(text) or re.fullmatch(r"neither .+ nor .+", _unfolded(text)):
        return frozenset()
    if said := _says_all(text):
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
