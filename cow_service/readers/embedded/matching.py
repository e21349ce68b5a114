"""Which thing of a scene a phrase is about: by its colour, its noun's outline, and words of place and size.

A thing is meant by positive evidence alone. What is merely left is not meant.
"""

from collections import Counter
from collections.abc import Iterable, Sequence
from difflib import get_close_matches

import numpy as np

from cow_service.errors import CannotGround, listed
from cow_service.media.masks import is_same_object
from cow_service.perception.base import Thing
from cow_service.perception.classical import forms
from cow_service.perception.observation import Observation
from cow_service.physics.bodies import SeenBody, supports_of
from cow_service.readers.base import GIVE_OBJECT, GIVE_PLACE
from cow_service.readers.embedded.english.lexicon import COLOURS, GENERIC, PLACES, SETS, TABLES, ObjectPhrase
from cow_service.readers.embedded.english.noun_phrases import Kind, kind_of, may_name, parse_noun_phrase, prior_of
from cow_service.readers.embedded.english.questions import Question
from cow_service.records import BBox, ObjectRequest

LEAD = 0.25  # of the mean size of the things: so far ahead of the next one in place
LARGER = 1.2  # ratio of areas to the next one
# Which of x of the centre, y of the centre and y of the lower end is the largest, or with -1 the smallest.
_MEASURES: dict[str, tuple[int, int]] = {
    "left leftmost left-hand": (0, -1),
    "right rightmost right-hand": (0, 1),
    "top topmost upper highest uppermost": (1, -1),
    "bottom lower lowest bottommost": (1, 1),
    "front nearest closest foreground": (2, 1),
    "back rear farthest furthest background": (2, -1),
}
_PLACES = {word: measure for words, measure in _MEASURES.items() for word in words.split()}
_LARGE = frozenset({"large", "largest", "big", "biggest", "larger", "bigger", "tallest", "taller", "tall", "huge"})
_SMALL = frozenset({"small", "smallest", "smaller", "little", "tiny", "shortest", "shorter", "short"})


def singled_out(things: Sequence[Thing], phrase: ObjectPhrase) -> list[Thing]:
    """The one thing that the words of place or size mean; all of them where these do not decide."""
    words = phrase.text.lower().replace("-", " ").split()
    for word in words if len(things) > 1 else []:
        if word in _PLACES:
            which, sign = _PLACES[word]
            size = sum((r.bbox[2] - r.bbox[0] + r.bbox[3] - r.bbox[1]) / 2 for r in things) / len(things)
            ranked = sorted(((*thing.centre, thing.bbox[3])[which] * -sign, i) for i, thing in enumerate(things))
            return [things[ranked[0][1]]] if ranked[1][0] - ranked[0][0] >= LEAD * size else list(things)
        if word in {"middle", "center", "centre", "central"} and len(things) % 2:
            return [sorted(things, key=lambda thing: thing.centre[0])[len(things) // 2]]
        if word in _LARGE | _SMALL:
            sign = 1 if word in _LARGE else -1
            ordered = sorted(things, key=lambda thing: -sign * thing.mask.area)
            ratio = (ordered[0].mask.area / ordered[1].mask.area) ** sign
            return [ordered[0]] if ratio >= LARGER else list(things)
    return list(things)


CLEAR = 1.0  # log ratio of an outline from which one of several is called so
POOR = -1.0  # log ratio of an outline: with less it is not called so, unless by its colour


def is_known(phrase: ObjectPhrase) -> bool:
    """Whether the noun says something of a shape, or claims nothing."""
    head = phrase.head
    return head is None or forms.form_of(head) is not None or head in forms.SOLID | GENERIC | TABLES


def _shape_ratio(thing: Thing, phrase: ObjectPhrase) -> float:
    return forms.shape_ratio(thing, phrase.head, phrase.colour is not None)


def best_matches(things: Sequence[Thing], phrase: ObjectPhrase) -> list[Thing]:
    """Regions that fit a phrase, all about equally well."""
    tables: list[Thing] = []
    if phrase.head in TABLES:  # what others stand on
        bodies = [SeenBody(thing.colour, thing.bbox, thing.mask, "box") for thing in things]
        tables = [things[i] for i in dict.fromkeys(supports_of(bodies)) if i is not None]
    return singled_out(_foremost(tables or things, phrase), phrase)


def _foremost(things: Sequence[Thing], phrase: ObjectPhrase, count: int = 1) -> list[Thing]:
    """The given number of things that fit a phrase best, and those not clearly worse than the last of them."""
    ratios = forms.likeness(things, phrase.noun, phrase.head, phrase.colour)
    ranked = sorted((ratio for ratio in ratios if ratio > forms.IMPOSSIBLE), reverse=True)
    least = ranked[min(count, len(ranked)) - 1] - forms.NAMING.clearly_worse if ranked else 0.0
    fitting = [thing for thing, ratio in zip(things, ratios, strict=True) if ratio > max(forms.IMPOSSIBLE, least)]
    # A detector called it so, its outline is that of the noun, or it has the colour and is not clearly another kind of
    # thing, such as a candle where a cone of its colour was not seen.
    says_shape = phrase.colour is not None or is_known(phrase)
    for each in fitting:
        has_colour = each.colour == phrase.colour and not forms.is_other_kind(each, phrase.head)
        if phrase.noun in each.called or (says_shape and _shape_ratio(each, phrase) >= POOR) or has_colour:
            return fitting
    return []


def match_one(things: Sequence[Thing], phrase: ObjectPhrase) -> Thing | None:
    """The one thing that fits a phrase; None if none or several do."""
    fitting = best_matches(things, phrase)
    return fitting[0] if len(fitting) == 1 else None


def match_several(things: Sequence[Thing], kind: Kind) -> list[Thing]:
    """The things that fit a kind such as "both mugs", as many as it says, or all; empty if it is not clear which."""
    fitting = _foremost(things, kind.phrase, kind.count or 1)
    are_clear = kind.count is None and all(_shape_ratio(thing, kind.phrase) > CLEAR for thing in fitting)
    return fitting if are_clear or len(fitting) == kind.count else []


def unclear(phrase: ObjectPhrase, things: Sequence[Thing]) -> str:
    """Why not one of the things is what a phrase names, for a message."""
    fitting = best_matches(things, phrase)
    if len(fitting) > 1:
        return f"'{phrase.text}' may be any of {len(fitting)}: {describe(fitting)}. Name its colour or its place"
    if phrase.colour is None and not is_known(phrase):
        return f"'{phrase.text}' names no colour and no shape that is known here. Seen: {describe(things)}"
    return f"'{phrase.text}' was not found, or not for certain. Seen: {describe(things)}"


WHOLE = 0.7  # share of a thing that must lie inside a drawn box to be the thing in it


def inside_drawn_box(observation: Observation, phrase: ObjectPhrase) -> BBox:
    """The object inside the only box drawn over the image."""
    if len(observation.boxes) != 1:
        told = (
            f"'{phrase.text}' is said to be inside a drawn box, and the image shows {len(observation.boxes) or 'none'}."
        )
        raise CannotGround(told, remedy=GIVE_PLACE)
    x0, y0, x1, y1 = observation.boxes[0].bbox
    inside = np.zeros((observation.height, observation.width), bool)
    inside[int(y0) : int(y1) + 1, int(x0) : int(x1) + 1] = True
    held = [r for r in observation.things if r.mask.shared_with(inside) > WHOLE * r.mask.area]
    return max(held, key=lambda thing: thing.mask.area).bbox if held else observation.boxes[0].bbox


def describe(things: Sequence[Thing]) -> str:
    """What was seen, in words, for an error message."""
    return listed([f"{each.colour} at ({each.centre[0]:.0f}, {each.centre[1]:.0f})" for each in things]) or "nothing"


def things_of_kinds(
    things: Sequence[Thing], question: Question, mover: BBox, given: Sequence[ObjectRequest]
) -> list[ObjectRequest]:
    """Those of the things, but for the mover's, that are of a kind asked about, each under its colour.

    None of a kind that the caller has `given`. Raises `CannotGround` where the question counts on them.
    """
    found, asked = list[ObjectRequest](), question.asked
    among = () if asked is None or asked.form == "which-to-remove" else asked.among
    left = [thing for thing in things if not is_same_object(thing.bbox, mover)]
    # Of "which mug does it hit first" there may be none for certain.
    kinds = [kind_of(name) for name in among]
    kinds += [Kind(each, None) for each in question.alternatives if each.colour is None and each not in question.others]
    for kind in kinds:
        if kind is None or any(may_name(kind.phrase, each.object) for each in given):
            continue
        fitting = match_several(left, kind)
        if not fitting and kind in kinds[: len(among)]:
            told = f"Which things '{kind.phrase.text}' are, the image does not tell for certain."
            raise CannotGround(f"{told} Seen: {describe(things)}.", remedy=GIVE_OBJECT)
        found += named_by_colour(fitting, kind, () if question.mover is None else (question.mover.text,))
    return found


def named_by_colour(things: Sequence[Thing], kind: Kind, taken: Iterable[str]) -> list[ObjectRequest]:
    """Things of a kind, each under its colour; with a number where that name is `taken`."""
    count, found = Counter(taken), list[ObjectRequest]()
    for each in things:
        name = f"{each.colour} {kind.phrase.head or 'object'}"
        count[name] += 1
        found.append(ObjectRequest(object=name if count[name] == 1 else f"{name} {count[name]}", bbox=each.bbox))
    return found


def nouns_of(question: Question, sought: Sequence[str] = ()) -> tuple[str, ...]:
    """The nouns of the things that a question names, and of further words, each once."""
    changed = (each for change in question.changes for each in (change.object, *change.targets))
    kinds = (kind_of(name) for name in (() if question.asked is None else question.asked.among))
    named = [question.mover, *question.others, *question.alternatives, *changed, *map(parse_noun_phrase, sought)]
    named += [kind.phrase for kind in kinds if kind is not None]
    return tuple(dict.fromkeys(each.noun for each in named if each is not None and each.noun))


NEARLY = 0.8  # difflib's ratio from which a word is nearly a colour's name: "grean"


def noun_doubts(
    observation: Observation, found: Sequence[tuple[ObjectPhrase, BBox]]
) -> tuple[list[str], frozenset[BBox]]:
    """A warning for each thing whose noun is not known, or whose outline is not that of the noun; and the boxes of
    those that look like something else, of which nothing is sure."""
    warnings, doubtful = list[str](), set[BBox]()
    for phrase, bbox in found:
        thing = observation.thing_in(bbox)
        if thing is None or phrase.inside_box or phrase.noun in thing.called:
            continue
        # What cannot be told by its outline is believed, unless the thing is clearly one of another kind. Where no
        # colour tells that it is meant, its outline alone does.
        head, looks, own = phrase.head or "", forms.looks_like(thing), forms.form_of(phrase.head)
        is_other_form = phrase.colour is None and looks not in (None, own)
        is_odd = own is not None and (forms.is_unlike(thing, own) or is_other_form)
        is_other = is_odd if own is not None else prior_of(head).shape != prior_of(looks or "").shape
        odd = [each for each in phrase.text.lower().split()[:-1] if each not in SETS["adjectives"] | PLACES]
        colours = [each for each in odd if phrase.colour is None and get_close_matches(each, COLOURS, 1, NEARLY)]
        if colours:
            told = "may be the colour of a part of it" if colours[0] in COLOURS else "is no colour that is known"
            reason = f": '{colours[0]}' {told}."
        elif any(phrase.noun in each.called for each in observation.things) and _shape_ratio(thing, phrase) <= CLEAR:
            reason = ": the detector calls another thing so."  # a detector misses some
        elif is_odd or (looks is not None and is_other and phrase.noun is not None and head not in GENERIC):
            reason = f", which looks like {f'a {looks}' if looks else 'something else'}, not '{head}'."
        elif not is_known(phrase):
            reason = f": whether '{phrase.head}' is right, the embedded reader cannot tell."
        else:
            continue
        warnings.append(f"'{phrase.text}' was taken for what is {describe([thing])}{reason}")
        doubtful.add(bbox)
    return warnings, frozenset(doubtful)
