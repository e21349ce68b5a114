"""What is said, seen and read of one thing, settled: the surer source decides.

Pure functions, without a look at an image or a call of a model. What speaks against a reading is told in sentences, for
the reader to be asked again with, and to warn of where it stays.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from cow_service.physics.camera import depth_motion, way_to
from cow_service.physics.lift import DIRECTION_DEVIATIONS
from cow_service.readers.base import GroundingReading, MotionReading, QuestionReading, WayReading, WordReader
from cow_service.records import Asked, BBox, Cue, LocatedObject, Vector
from cow_service.vision.masks import iou, is_same_object
from cow_service.vision.regions import Region

Objections = tuple[str, ...]
"""What speaks against a reading, in whole sentences."""

# --- which way

APART = 2.0  # spreads between two sources from which they contradict each other
FORWARD: Vector = (0.0, 1.0)  # which way, where something moves and nothing tells which
WORDS_APART = 60.0  # degrees between a drawn arrow and a direction in words, which is a rough one: "to the right"


@dataclass(frozen=True)
class SeenWay:
    """What the image shows of the way of what moves."""

    arrow: Vector | None = None  # of the arrow that is drawn at it
    goal: LocatedObject | None = None  # where the thing is that the words have it move towards
    front: Vector | None = None  # the way that it faces
    has_trail: bool = False  # which is measured


def settle_way(read: MotionReading, said: WayReading, seen: SeenWay, mover: BBox) -> tuple[MotionReading, Objections]:
    """The reading, with its direction by the surest source: an arrow that is meant, words, its front, what was read.

    An arrow gives an axis. Its sense is that of the words, else as read. Where another source is more than two spreads
    away from what was taken, worlds are drawn from both. A direction that was not estimated stays as it is, and so does
    one along a trail, which is measured.
    """
    if read.kind == "static" and said != WayReading():
        way = said.direction or seen.arrow or FORWARD
        stays = replace(read, other_direction=way, sentence=None)
        return stays, ("The question has it move, and it was read to stay where it is.",)
    is_measured = read.cue == "trail" and seen.has_trail and said == WayReading()
    if read.direction_deviation is None or is_measured:
        return read, ()
    taken = _by_arrow(read, said, seen.arrow) or _by_words(read, said, seen.goal, mover) or _by_front(read, said, seen)
    if taken is None or taken.direction is None:
        senses = {said.along_arrow, read.along_arrow}
        if read.direction is None or senses != {True, False}:
            return read, ()
        told = "The question and the reading have it move to opposite ends of an arrow that is not seen."
        return replace(read, other_direction=(-read.direction[0], -read.direction[1]), sentence=None), (told,)
    objections, rival = list[str](), None
    goal = None if seen.goal is None else way_to(seen.goal.bbox, mover, is_on_floor=read.kind == "linear")
    words = said.direction or goal
    if taken.cue == "arrow" and words is not None and angle(words, taken.direction) > WORDS_APART:
        objections.append("The question's words for the direction contradict the arrow drawn at the object.")
        rival = words
    if taken.cue == "arrow" and said == WayReading() and read.along_arrow is None and read.direction is None:
        objections.append("Nothing tells whether it moves along the arrow drawn at it or against it.")
        rival = (-taken.direction[0], -taken.direction[1])
    off = 0.0 if read.direction is None else angle(read.direction, taken.direction)
    if off > APART * math.hypot(read.direction_deviation, DIRECTION_DEVIATIONS[taken.cue]):
        source = {"arrow": "the arrow drawn at the object", "orientation": "its front"}.get(taken.cue, "the question")
        if taken.cue == "arrow" and said.along_arrow is not None:
            source += f", which the question has it move {'along' if said.along_arrow else 'against'},"
        objections.append(f"The direction that was read is {off:.0f} degrees off what {source} says.")
        rival = read.direction
    if rival is None:
        return taken, ()
    # Its sentence was worded for another direction.
    return replace(taken, other_direction=rival, towards=None, sentence=None), tuple(objections)


def _by_arrow(read: MotionReading, said: WayReading, arrow: Vector | None) -> MotionReading | None:
    is_meant = said.along_arrow is not None or read.cue == "arrow" or (read.direction is None and said == WayReading())
    if arrow is None or not is_meant:
        return None
    along = read.along_arrow if said.along_arrow is None else said.along_arrow
    if along is None:
        rough = said.direction or read.direction
        along = rough is None or angle(rough, arrow) <= 90
    sign = 1.0 if along else -1.0
    return _taken(read, (sign * arrow[0], sign * arrow[1]), "arrow", along=along)


def _by_words(read: MotionReading, said: WayReading, goal: LocatedObject | None, mover: BBox) -> MotionReading | None:
    if said.direction is not None:
        return _taken(read, said.direction, "text", depth=said.depth)
    if said.depth:
        direction, depth = depth_motion(said.depth)
        return _taken(read, direction, "text", depth=depth)
    if goal is None:
        return None
    return replace(_taken(read, way_to(goal.bbox, mover, is_on_floor=read.kind == "linear"), "text"), towards=goal)


def _by_front(read: MotionReading, said: WayReading, seen: SeenWay) -> MotionReading | None:
    if seen.front is None or said.forward is None:
        return None
    sign = 1.0 if said.forward else -1.0
    return _taken(read, (sign * seen.front[0], sign * seen.front[1]), "orientation")


def _taken(
    read: MotionReading, direction: Vector, cue: Cue, along: bool | None = None, depth: float | None = None
) -> MotionReading:
    """The reading with a direction that was not estimated; a throw keeps the depth that was read, unless it is said."""
    keeps = depth is None and read.kind == "projectile"
    return replace(
        read,
        direction=direction,
        cue=cue,
        along_arrow=along,
        direction_deviation=None,
        depth=read.depth if keeps else depth or 0.0,
        depth_deviation=read.depth_deviation if keeps else None,
    )


# --- what stands where

EDGE_OFF = 0.25  # of the sides of a thing that is seen: an estimated edge this far off is still its own


@dataclass(frozen=True)
class SeenThings:
    """What the image shows of things."""

    regions: Sequence[Region] = ()
    bare: frozenset[BBox] = frozenset()  # those of the boxes that were read in which nothing stands


def settle_places(read: GroundingReading, seen: SeenThings) -> tuple[GroundingReading, Objections]:
    """The reading, its boxes moved onto the things that are seen there, and what speaks against its places.

    A box in which nothing stands, or something of another colour while the named one is elsewhere, is doubtful.
    """
    boxes = list(dict.fromkeys([read.bbox, *(each.bbox for each in things_of(read))]))
    moved, objections, doubtful = _onto_regions(boxes, seen.regions), list[str](), set[BBox]()
    mover = LocatedObject(object=read.object, bbox=read.bbox)
    for thing in dict.fromkeys((mover, *things_of(read))):
        fault = _fault_of(thing, moved[thing.bbox], seen)
        if fault is not None and thing.bbox not in doubtful:
            objections.append(fault)
            doubtful.add(thing.bbox)

    def settled(thing: LocatedObject) -> LocatedObject:
        region = moved[thing.bbox]
        return thing.model_copy(update={
            "bbox": thing.bbox if region is None else region.bbox,
            "bbox_deviation": read.bbox_deviation if region is None else 0.0,
            "is_doubtful": thing.is_doubtful or thing.bbox in doubtful,
        })  # fmt: skip

    changed = tuple(
        each.model_copy(update={"object": settled(each.object), "targets": tuple(map(settled, each.targets))})
        for each in read.interventions
    )
    own = settled(mover)
    unproved = read.place_doubts if moved[read.bbox] is None else ()
    reading = replace(
        read,
        bbox=own.bbox,
        bbox_deviation=own.bbox_deviation,
        is_doubtful=read.is_doubtful or own.is_doubtful or bool(unproved),
        warnings=(*read.warnings, *unproved),
        others=tuple(map(settled, read.others)),
        interventions=changed,
    )
    return reading, tuple(objections)


def things_of(read: GroundingReading) -> list[LocatedObject]:
    """All that was located besides the mover."""
    changed = (thing for each in read.interventions for thing in (each.object, *each.targets))
    return [*read.others, *changed]


def _onto_regions(boxes: Sequence[BBox], regions: Sequence[Region]) -> dict[BBox, Region | None]:
    """For each box the region that it is about: none of its edges is far off, and no other box fits it better."""
    pairs = [
        (iou(box, region.bbox), at, box, region)
        for box in boxes
        for at, region in enumerate(regions)
        if _is_about(box, region.bbox)
    ]
    found = dict[BBox, Region | None].fromkeys(boxes)
    taken = set[int]()
    for _, at, box, region in sorted(pairs, key=lambda pair: -pair[0]):
        if found[box] is None and at not in taken:
            found[box] = region
            taken.add(at)
    return found


def _is_about(box: BBox, region: BBox) -> bool:
    sides = (region[2] - region[0], region[3] - region[1]) * 2
    return all(abs(a - b) <= EDGE_OFF * side for a, b, side in zip(box, region, sides, strict=True))


def _fault_of(thing: LocatedObject, region: Region | None, seen: SeenThings) -> str | None:
    if region is None and thing.bbox in seen.bare:
        return f"In the box of '{thing.object}' nothing stands."
    named = set(thing.object.lower().split(" with ")[0].split())  # "a truck with a red cab" need not be red
    region = region or next((each for each in seen.regions if is_same_object(each.bbox, thing.bbox)), None)
    if region is None or not named.isdisjoint((region.colour, *region.colours)):
        return None
    there = [each for each in seen.regions if each.colour in named]
    if not there:
        return None
    x, y = there[0].centre
    return (
        f"In the box of '{thing.object}' is something {region.colour}, while something {there[0].colour} is at "
        f"({x:.0f}, {y:.0f})."
    )


def settle_mover(
    read: GroundingReading, said: QuestionReading, words: WordReader
) -> tuple[GroundingReading, Objections]:
    """The reading; in doubt where what was read to move, or what was found for it, is not what the words say."""
    if said.mover is None:
        return read, ()
    for name in filter(None, (read.object, read.label)):
        likeness = words.likeness(said.mover, name)
        rivals = read.others if likeness == "unknown" else ()
        if likeness == "other" or any(words.likeness(said.mover, each.object) == "same" for each in rivals):
            told = f"The question has '{said.mover}' move, and '{name}' was read."
            return replace(read, is_doubtful=True), (told,)
    return read, ()


# --- what is asked

PLAIN, DETAILS = ("form", "relation", "negated"), ("every", "partly", "within")


def settle_question(
    read: GroundingReading, said: QuestionReading, words: WordReader, is_given: bool = False
) -> tuple[GroundingReading, Objections]:
    """The reading with what is asked, and what speaks against it: the words decide what they plainly say.

    Names stay as they were read: the things that were found have them. Words that were not understood say nothing;
    where what is asked `is_given`, they tell only what is changed.
    """
    asked, plain = read.asked, said.asked
    if plain is None:
        return read, ()
    objections, names = list[str](), [read.object, *(each.object for each in things_of(read))]
    if asked is not None and not is_given:
        # What is left at its default was not said: the words complete it.
        usual = Asked(relation=asked.relation)
        differ = [name for name in PLAIN if getattr(asked, name) != getattr(plain, name)]
        differ += [name for name in DETAILS if getattr(asked, name) not in (getattr(usual, name), getattr(plain, name))]
        followed = asked.model_copy(update={name: getattr(plain, name) for name in (*PLAIN, *DETAILS)})
        for name in ("subject", "target"):
            wanted, taken = getattr(plain, name), getattr(asked, name)
            if wanted is None or taken is None:
                # The place that something is put into tells what it is to be inside of.
                differs = wanted is not taken and not (wanted is None and asked.relation == "inside")
            else:
                differs = not _is_meant(wanted, taken, names, words)
            differ += [name] if differs else []
        if len(plain.among) > 1 and not _are_meant(plain.among, asked.among, names, words):
            differ.append("among")
        if differ:
            told = (f"`{name}` {_shown(getattr(plain, name))}, not {_shown(getattr(asked, name))}" for name in differ)
            objections.append(f"By its words the question asks with {', '.join(told)}.")
        asked = followed
    removed = tuple(each.object for each in said.changes if each.kind == "remove")
    taken = tuple(each.object.object for each in read.interventions if each.kind == "remove")
    if not _are_meant(removed, taken, names, words):
        told = [", ".join(f"'{name}'" for name in each) or "nothing" for each in (removed, taken)]
        objections.append(f"By its words the question takes {told[0]} away beforehand, and {told[1]} was read.")
    return replace(read, asked=asked or plain, asked_is_doubtful=read.asked_is_doubtful or bool(objections)), tuple(
        objections
    )


def _is_meant(wanted: str, taken: str, names: Sequence[str], words: WordReader) -> bool:
    """Whether the words for a thing may mean what was taken for it: of the things that were read none fits better."""
    likeness = words.likeness(wanted, taken)
    return likeness == "same" or (
        likeness == "unknown" and all(words.likeness(wanted, name) != "same" for name in names)
    )


def _are_meant(wanted: Sequence[str], taken: Sequence[str], names: Sequence[str], words: WordReader) -> bool:
    """Whether as many things are meant as were taken, each of them one of those."""
    return len(wanted) == len(taken) and all(
        any(_is_meant(name, each, names, words) for each in taken) for name in wanted
    )


def _shown(value: object) -> str:
    return str(value).lower() if isinstance(value, bool) or value is None else f"'{value}'"


def angle(a: Vector, b: Vector) -> float:
    """Degrees between two vectors, 0 to 180."""
    return abs(math.degrees(math.atan2(a[0] * b[1] - a[1] * b[0], a[0] * b[0] + a[1] * b[1])))
