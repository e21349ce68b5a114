"""What the words for the way of something say together."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from cow_service.readers.embedded.english import lexicon as lex
from cow_service.readers.embedded.english.forms import SIDES, WAYS
from cow_service.readers.embedded.english.lexicon import ObjectPhrase, QuantityWords
from cow_service.readers.embedded.english.noun_phrases import Tokens
from cow_service.records import MotionKind, Vector

_RISING, _SINKING = lex.words("lift raise rise climb ascend"), lex.words("descend lower")
_TOPPLING = lex.words("knock push tip fall turn blow topple")


@dataclass(frozen=True)
class MotionWords:
    """How the question says that something moves; None and 0 where it does not say.

    `direction` is a unit vector in image pixels, x right, y down. `depth` is the sine of the angle out of the image
    plane: -1 towards the camera, 1 away from it. `trail`: on along it; `trail_end`, a thing or a side, tells which end
    of it is the present position. `topples`: it falls over where it stands. `in_air`: it is let go, or falls freely.
    `steps` are the legs behind the first, `others` what moves at the same time.
    """

    kind: MotionKind | None = None
    along_arrow: bool | None = None  # else against it
    direction: Vector | None = None
    depth: float = 0.0
    forward: bool | None = None
    verb: str = ""
    towards: ObjectPhrase | None = None
    trail: bool = False
    trail_end: ObjectPhrase | Vector | None = None
    quantities: tuple[QuantityWords, ...] = ()
    steps: "tuple[MotionWords, ...]" = ()
    others: "tuple[tuple[ObjectPhrase, MotionWords], ...]" = ()
    is_contradictory: bool = False  # two of its words are opposites
    topples: bool = False
    in_air: bool = False


NOT_SAID = MotionWords()


def motion_of(verb: str, said: Sequence[tuple[str, str]], tokens: Tokens, kind: MotionKind | None) -> MotionWords:
    """The motion by a verb and words for the way, each by what it says and the word that says it."""
    found = {name: [text for each, text in said if each == name] for name, _ in said}
    ways = [WAYS[text.lower()] for text in found.get("way", ())]
    senses, ahead, depths = (set(found.get(name, ())) for name in ("sense", "ahead", "depth"))
    x, y, depth = sum(way[0] for way in ways), sum(way[1] for way in ways), 0.0
    up, falls = [way[1] for way in ways], verb in lex.SETS["fall"]
    turned = (falls and min(up, default=0) < 0) or (verb in _RISING and max(up, default=0) > 0)
    opposed = any(a[0] * b[0] < 0 or a[1] * b[1] < 0 for a in ways for b in ways)
    stays = "still" in found and bool(ways or depths or senses)
    if kind == "fall":
        y = 0.0  # down is what a fall does; only what leads away from it is a direction
    elif not ways:
        y = -1.0 if verb in _RISING else 1.0 if verb in _SINKING else 0.0
    if depths:
        depth = -1.0 if "NEAR" in depths else 1.0
    length = math.hypot(x, y)
    goal, near, side = (next(iter(found.get(name, ())), "") for name in ("goal", "near", "side"))
    return MotionWords(
        kind=kind,
        along_arrow="ALONG" in senses if senses else None,
        direction=(x / length, y / length) if length else None,
        depth=depth * math.sqrt(0.5) if length else depth,
        forward=False if verb == "reverse" else "FORWARD" in ahead if ahead and not senses else None,
        verb=verb,
        towards=tokens.things[int(goal[1:])] if goal else None,
        trail="trail" in found,
        trail_end=tokens.things[int(near[1:])] if near else SIDES.get(side),
        quantities=tuple(tokens.quantities[int(text[1:])] for text in found.get("quantity", ())),
        is_contradictory=turned or opposed or stays or any(len(each) > 1 for each in (senses, ahead, depths)),
        topples=("over" in found and verb in _TOPPLING) or verb in {"tip", "topple"},
        in_air=verb in {"drop", "release", "detach", "let go"} or "freely" in found,
    )


def joined(first: MotionWords, second: MotionWords) -> MotionWords:
    """A motion that is told in two places."""
    empty = vars(NOT_SAID)
    told = {name: value for name, value in vars(second).items() if value != empty[name]}
    single = ("kind", "direction", "depth", "along_arrow", "forward")
    clash = any(name in told and getattr(first, name) not in (empty[name], told[name]) for name in single)
    kept = {name: value for name, value in told.items() if getattr(first, name) == empty[name]}
    quantities = (*first.quantities, *second.quantities)
    return replace(first, **kept | {"quantities": quantities, "is_contradictory": clash or first.is_contradictory})
