"""Reads how something moves from the words behind its verb: kind, direction, depth, arrow, forward or backward.

Places are not motion: "to the left of the vase" and "the ball on the left" say where something is.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from cow_service.readers.question import lexicon as lex
from cow_service.readers.question.arrow_words import ArrowSense, has_opposite, is_arrow
from cow_service.readers.question.phrases import Item, ObjectPhrase, QuantityWords, flatten, key_at, phrase_at
from cow_service.readers.question.trail_words import TrailWords
from cow_service.records import MotionKind, Vector

SLIGHTLY = math.tan(math.pi / 8)  # "slightly up": half of a diagonal's 45 degrees
_AIMS = lex.words("to toward towards into for and or then")
_SIDES = lex.words("side hand direction corner edge half part end border far very most extreme")
_NOT_AIMED = lex.words("parallel perpendicular relative next close opposite orthogonal according due contrary")
_RIGHT_IDIOMS = lex.words("now away next behind in above below beside into at onto before after under off")
_FAR_ENDS = lex.words("background distance depth depths horizon back rear")
_NEAR_ENDS = lex.words("foreground front")
_INSIDE_PICTURE = lex.words("scene picture image screen photo photograph")
_KICKED = lex.words("kick hit knock strike push send flick tap go swing")
_TIPPED = lex.words("knock push kick hit turn blow go")
_RISING = lex.words("lift raise rise climb ascend")
_SINKING = lex.words("lower descend sink")
_FALLING = lex.words("fall drop plummet plunge descend sink")
_CLIMBING = lex.words("rise ascend")
_FACES = lex.words("face head point")
_GOES_STRAIGHT = lex.words("go move drive roll travel continue run")
_FORWARD = lex.words("forward forwards ahead onward onwards")
_BACKWARD = lex.words("backward backwards back")


@dataclass(frozen=True)
class StepWords:
    """A further leg of a motion, behind "then"; as in `MotionWords`."""

    direction: Vector | None
    depth: float
    quantities: tuple[QuantityWords, ...] = ()


@dataclass(frozen=True)
class OtherWords:
    """Another thing that moves at the same time."""

    object: ObjectPhrase
    motion: MotionWords


@dataclass(frozen=True)
class MotionWords:
    """How the question says that the mover moves; None and 0 where it does not say.

    `direction` is a unit vector in image pixels, x right, y down. A fall has one only where it leaves the vertical
    ("falls to the left"): its kind stays "fall". `depth` is the sine of the angle out of the image plane: -1 towards
    the camera, 1 away from it, and 0.71 of that where a direction in the image is named too. `verb` is in its base
    form, empty where no known verb of motion stands in the question. `towards` is the object that the motion aims at;
    the direction to it is for the caller to measure. `trail`: it goes on along the trail that is shown.
    `contradictory`: it is said to fall upwards or to rise downwards.
    `steps` are the legs behind the first, `others` what moves at the same time.
    """

    kind: MotionKind | None
    arrow: ArrowSense | None
    direction: Vector | None
    depth: float
    forward: bool | None
    verb: str
    towards: ObjectPhrase | None = None
    trail: TrailWords | None = None
    quantities: tuple[QuantityWords, ...] = ()
    steps: tuple[StepWords, ...] = ()
    contradictory: bool = False
    others: tuple[OtherWords, ...] = ()


def read_motion(
    found: Sequence[Item],
    verb: str,
    kind: MotionKind | None,
    arrow: ArrowSense | None,
    mover: ObjectPhrase | None,
    asked: bool = False,
) -> MotionWords:
    """The motion in a clause; `found` begins at its verb, `arrow` is what the whole question says of an arrow.

    `asked`: the verb itself is in question, so where it gets to is not given ("will the ball roll into the vase?").
    """
    kind = _kind(found, verb, kind)
    if arrow == "along" and _turns_around(found):
        arrow = "against"
    legs = _legs(found, verb, arrow)
    direction, depth = _way(legs[0], verb, kind)
    steps = [StepWords(*_way(leg, "", None), _quantities(leg)) for leg in legs[1:]]
    forward = _forward(found, verb, arrow)
    towards = _towards(found, asked or kind == "fall", mover)
    return MotionWords(
        kind, arrow, direction, depth, forward, verb, towards,
        quantities=_quantities(legs[0]), steps=tuple(steps), contradictory=_contradicts_verb(legs[0], verb),
    )  # fmt: skip


def _contradicts_verb(found: Sequence[Item], verb: str) -> bool:
    """ "Falls upwards", "rises downwards"."""
    ways = [_word_step(found, at)[1] for at in range(1, len(found))] if verb in _FALLING | _CLIMBING else []
    return any(way > 0 if verb in _CLIMBING else way < 0 for way in ways)


def _legs(found: Sequence[Item], verb: str, arrow: ArrowSense | None) -> list[Sequence[Item]]:
    """The words of a motion cut at each "then" that a way to go follows."""
    legs: list[Sequence[Item]] = [found]
    for at in range(len(found) - 1, 0, -1):
        if found[at].key in {"then", "afterwards"} and _way(found[at:], "", None) != (None, 0.0):
            first = legs.pop(0)
            legs = [first[:at], first[at:], *legs]
    along = arrow is not None and any(is_arrow(legs[0], at) for at in range(len(legs[0])))
    return legs if along or _way(legs[0], verb, None) != (None, 0.0) else [found]


def _way(found: Sequence[Item], verb: str, kind: MotionKind | None) -> tuple[Vector | None, float]:
    """The direction in the image and the depth of a leg."""
    direction, depth = _direction(found, verb, kind), _depth(found)
    return direction, depth * math.sqrt(0.5) if direction is not None else depth


def _quantities(found: Sequence[Item]) -> tuple[QuantityWords, ...]:
    return tuple(item.quantity for item in found if item.quantity is not None)


def _kind(found: Sequence[Item], verb: str, kind: MotionKind | None) -> MotionKind | None:
    flat = flatten(found[:12])
    if verb == "come" and "down" in flat[:3]:
        return "fall"
    if verb in _TIPPED and "over" in flat[1:3] and not any(item.phrase for item in found[2:3]):
        return "fall"
    if verb in _KICKED and "air" in flat:
        return "projectile"
    return kind


def _turns_around(found: Sequence[Item]) -> bool:
    """ "The arrow shows the way. If the ball moves in the opposite direction ..."."""
    return not any(is_arrow(found, at) for at in range(len(found))) and has_opposite(flatten(found))


def _direction(found: Sequence[Item], verb: str, kind: MotionKind | None) -> Vector | None:
    x = y = 0.0
    for at in range(1, len(found)):
        step = _place_step(found, at) if found[at].phrase else _word_step(found, at)
        x, y = x + step[0], y + step[1]
    if kind == "fall":
        y = 0.0  # down is what a fall does; only what leads away from it is a direction
    elif x == y == 0.0:
        y = -1.0 if verb in _RISING else 1.0 if verb in _SINKING else 0.0
    length = math.hypot(x, y)
    return (x / length, y / length) if length > 1e-9 else None


def _word_step(found: Sequence[Item], at: int) -> Vector:
    key, before, after = found[at].key, key_at(found, at - 1), key_at(found, at + 1)
    if key not in lex.DIRECTIONS or before in {"from", "on", "at"} or before in lex.BE:
        return (0.0, 0.0)
    if (key == "right" and after in _RIGHT_IDIOMS) or _is_beside(found, at):
        return (0.0, 0.0)
    along = at + 1 if after != "to" else at + 2
    if key in {"up", "down"} and phrase_at(found, along) and not _place_words(found[along]):
        return (0.0, 0.0)  # "down the ramp", "up to the vase"
    return _weighed(found, at, lex.DIRECTIONS[key])


def _is_beside(found: Sequence[Item], at: int) -> bool:
    """ "to the left of the vase" is a place; "to the left of the image" is a direction."""
    beside = phrase_at(found, at + 2)
    return key_at(found, at + 1) == "of" and (beside is None or beside.head not in lex.NO_THINGS)


def _place_words(item: Item) -> list[str]:
    words = [word for word in item.words if word not in lex.DETERMINERS and word != "and"]
    return words if all(word in lex.PLACES or word in _SIDES for word in words) else []


def _place_step(found: Sequence[Item], at: int) -> Vector:
    words, before = _place_words(found[at]), key_at(found, at - 1)
    aimed = before in _AIMS or lex.is_adverb(before)
    aimed = aimed or (bool(words) and words[-1] == "direction" and before in {"in", "along"})
    if not aimed or _is_beside(found, at):
        return (0.0, 0.0)
    steps = [lex.DIRECTIONS[word] for word in words if word in lex.DIRECTIONS]
    return _weighed(found, at, (sum(step[0] for step in steps), sum(step[1] for step in steps)))


def _weighed(found: Sequence[Item], at: int, step: Vector) -> Vector:
    slight = "slightly" in {key_at(found, at - 1), key_at(found, at - 2)}
    return (step[0] * SLIGHTLY, step[1] * SLIGHTLY) if slight else step


def _depth(found: Sequence[Item]) -> float:
    for at, item in enumerate(found):
        viewer = item.key in {"us", "me", "you"} or (item.phrase and item.phrase.head in lex.VIEWERS)
        before = [key_at(found, at - 1), key_at(found, at - 2), key_at(found, at - 3)]
        if viewer and before[0] == "from" and {"away", "farther", "further", "far", "back"}.intersection(before):
            return 1.0
        approached = before[0] in {"to", "toward", "towards", "at"} or before[0].startswith("approach")
        if viewer and approached and before[1] not in _NOT_AIMED:
            return -1.0
        head = item.words[-1] if item.words and before[0] in {"to", "toward", "towards", "into"} else ""
        if head in _FAR_ENDS or (head in _INSIDE_PICTURE and before[0] == "into"):
            return 1.0
        if head in _NEAR_ENDS:
            return -1.0
    return 0.0


def _forward(found: Sequence[Item], verb: str, arrow: ArrowSense | None) -> bool | None:
    flat = flatten(found)
    if not _FORWARD.isdisjoint(flat):
        return True
    back = not _BACKWARD.isdisjoint(flatten(item for item in found if not item.phrase))
    if arrow is None and (back or verb == "reverse" or "reverse" in flat):
        return False
    if arrow is None and not _FACES.isdisjoint(map(lex.lemma, flat[1:])):
        return not has_opposite(flat)
    return True if verb in _GOES_STRAIGHT and flat[-1:] == ["straight"] else None


def _is_one(phrase: ObjectPhrase) -> bool:
    """ "The pink one"."""
    return phrase.noun is None and phrase.colour is not None


def _towards(found: Sequence[Item], open_end: bool, mover: ObjectPhrase | None) -> ObjectPhrase | None:
    preps = {"toward", "towards"} if open_end else {"toward", "towards", "to", "at", "into"}
    for at, item in enumerate(found):
        before, earlier = key_at(found, at - 1), phrase_at(found, at - 2)
        if before == "of":  # "in the direction of the vase"
            aimed = earlier is not None and earlier.noun == "direction" and not has_opposite(flatten(found))
        else:
            aimed = before in preps and key_at(found, at - 2) not in _NOT_AIMED
        if item.phrase and aimed and item.phrase != mover and (item.phrase.is_thing or _is_one(item.phrase)):
            return item.phrase
    return None
