"""What is said, seen and read of one thing, settled: the surer source decides.

Pure functions, without a look at an image or a call of a model. What speaks against a reading is told in sentences, for
the reader to be asked again with, and to warn of where it stays.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

from cow_service import records
from cow_service.media.masks import iou, is_same_object
from cow_service.perception.base import Thing
from cow_service.physics.camera import way_to
from cow_service.physics.lift import DIRECTION_DEVIATIONS
from cow_service.readers.base import WordReader, WordsReading
from cow_service.records import DIRECTED_KINDS, BBox, GroundingRequest, MotionRequest, ObjectRequest, Reading, Vector

Objections = tuple[str, ...]
"""What speaks against a reading, in whole sentences."""

# --- which way

APART = 2.0  # spreads between two sources from which they contradict each other
FORWARD: Vector = (0.0, 1.0)  # which way, where something moves and nothing tells which
SOURCES: dict[records.Cue, str] = {"arrow": "the arrow drawn at the object", "orientation": "its front"}  # in words
WORDS_APART = 60.0  # degrees between a drawn arrow and a direction in words, which is a rough one: "to the right"


@dataclass(frozen=True)
class SeenWay:
    """What the image shows of the way of what moves."""

    arrow: Vector | None = None  # of the arrow that is drawn at it
    is_only_arrow: bool = True  # no other one is near
    goal: BBox | None = None  # where the thing is that it is said to move towards
    front: Vector | None = None  # the way that it faces
    trail: Vector | None = None  # on from its earlier positions
    is_thrown: bool = False  # along them


def settle_way(
    read: MotionRequest, said: MotionRequest, seen: SeenWay, mover: BBox
) -> tuple[MotionRequest, Objections]:
    """The motion with its direction by the surest source, and what speaks against what was `read`.

    A direction that is not estimated stays. Else an arrow that is meant decides, what is `said` in words, the front,
    what was read, and last what is drawn at the thing. An arrow gives an axis; its sense is that of the words, else as
    read. Where another source is more than two spreads away, worlds are drawn from both. A trail is measured.
    """
    kind = read.stated_kind or "linear"
    if kind == "static" and said.has_way:
        stays = read.model_copy(update={"other_direction": said.direction or seen.arrow or FORWARD})
        return stays, ("The question has it move, and it was read to stay where it is.",)
    if kind not in DIRECTED_KINDS or (read.direction is not None and read.direction_deviation is None):
        return read, ()
    taken = (
        by_trail(read, said, seen)
        or by_arrow(read, said, seen.arrow)
        or by_words(read, said, seen.goal, mover)
        or by_front(read, said, seen.front)
    )
    if taken is None:
        return as_drawn(read, said, seen)
    rival, objections = rival_of(taken, read, said, seen, mover)
    # A direction beside another one is no goal.
    update = {} if rival is None else {"other_direction": rival, "towards": None}
    return taken.model_copy(update=update), objections


def rival_of(
    taken: MotionRequest, read: MotionRequest, said: MotionRequest, seen: SeenWay, mover: BBox
) -> tuple[Vector | None, Objections]:
    """The direction that speaks against the one that was taken, and in which words it does."""
    rival, objections, way = None, list[str](), taken.direction or FORWARD
    is_arrow, is_estimate = taken.cue == "arrow", read.direction_deviation is not None
    goal = None if seen.goal is None else way_to(seen.goal, mover, is_on_floor=read.kind == "linear")
    words = said.direction or goal
    if is_arrow and words is not None and angle(words, way) > WORDS_APART:
        objections.append("The question's words for the direction contradict the arrow drawn at the object.")
        rival = words
    if is_arrow and is_estimate and not said.has_way and read.along_arrow is None and read.direction is None:
        objections.append("Nothing tells whether it moves along the arrow drawn at it or against it.")
        rival = _turned(way)
    if fault := reading_fault(taken, read, said):
        objections.append(fault)
        rival = read.direction
    return rival, tuple(objections)


def reading_fault(taken: MotionRequest, read: MotionRequest, said: MotionRequest) -> str:
    """That the direction that was read is far from the one that was taken; empty where it is not."""
    cue = taken.cue or "text"
    off = 0.0 if read.direction is None or cue == "trail" else angle(read.direction, taken.direction or FORWARD)
    if off <= APART * math.hypot(read.direction_deviation or 0.0, DIRECTION_DEVIATIONS[cue]):
        return ""
    source = SOURCES.get(cue, "the question")
    if cue == "arrow" and said.along_arrow is not None:
        source += f", which the question has it move {'along' if said.along_arrow else 'against'},"
    return f"The direction that was read is {off:.0f} degrees off what {source} says."


def by_trail(read: MotionRequest, said: MotionRequest, seen: SeenWay) -> MotionRequest | None:
    """Measured, where the reading or the words go by the trail, and the words say nothing else."""
    told = said.has_way and said.cue != "trail"
    if told or seen.trail is None or "trail" not in (read.cue, said.cue):
        return None
    update: dict[str, object] = {"direction": read.direction or seen.trail, "cue": "trail"}
    if read.direction is None:
        is_thrown = seen.is_thrown or read.kind in records.FALLING_KINDS
        update["kind"] = "projectile" if is_thrown else "linear"
    return read.model_copy(update=update)


def by_arrow(read: MotionRequest, said: MotionRequest, arrow: Vector | None) -> MotionRequest | None:
    """Along the arrow or against it, where one is meant."""
    is_open = read.direction is None and read.direction_deviation is not None and not said.has_way
    if arrow is None or not (said.along_arrow is not None or read.cue == "arrow" or is_open):
        return None
    along = read.along_arrow if said.along_arrow is None else said.along_arrow
    if along is None:
        rough = said.direction or read.direction
        along = rough is None or angle(rough, arrow) <= 90
    return _taken(read, arrow if along else _turned(arrow), "arrow", along=along)


def by_words(read: MotionRequest, said: MotionRequest, goal: BBox | None, mover: BBox) -> MotionRequest | None:
    """As words say it, or towards the goal that they name."""
    is_beside_arrow = said.along_arrow is not None and read.direction_deviation is None  # which then must be seen
    if said.direction is not None and not is_beside_arrow:
        return _taken(read, said.direction, "text", depth=said.depth)
    if goal is None:
        return None
    way = way_to(goal, mover, is_on_floor=(read.kind or "linear") == "linear")
    return _taken(read, way, "text").model_copy(update={"towards": said.towards or read.towards})


def by_front(read: MotionRequest, said: MotionRequest, front: Vector | None) -> MotionRequest | None:
    """As it faces, where the words say forward or backward."""
    if front is None or said.forward is None:
        return None
    return _taken(read, front if said.forward else _turned(front), "orientation")


def as_drawn(read: MotionRequest, said: MotionRequest, seen: SeenWay) -> tuple[MotionRequest, Objections]:
    """As it was read; along the only arrow at the thing, where nothing at all is said."""
    if read.direction is None:
        is_led = seen.is_only_arrow and not said.has_way
        return _taken(read, seen.arrow, "arrow", along=True) if seen.arrow and is_led else read, ()
    if {said.along_arrow, read.along_arrow} != {True, False}:
        return read, ()
    told = "The question and the reading have it move to opposite ends of an arrow that is not seen."
    return read.model_copy(update={"other_direction": _turned(read.direction)}), (told,)


def _turned(way: Vector) -> Vector:
    return -way[0], -way[1]


def _taken(
    read: MotionRequest, direction: Vector, cue: records.Cue, along: bool | None = None, depth: float | None = None
) -> MotionRequest:
    """The reading with a direction that was not estimated; a throw keeps the depth that was read, unless it is said."""
    keeps = depth is None and read.kind == "projectile"
    return read.model_copy(
        update={
            "direction": direction,
            "cue": cue,
            "along_arrow": along,
            "direction_deviation": None,
            "depth": read.depth if keeps else depth or 0.0,
            "depth_deviation": read.depth_deviation if keeps else None,
        }
    )


# --- what stands where

EDGE_OFF = 0.25  # of the sides of a thing that is seen: an estimated edge this far off is still its own


@dataclass(frozen=True)
class SeenThings:
    """What the image shows of things."""

    things: Sequence[Thing] = ()
    bare: frozenset[BBox] = frozenset()  # those of the boxes that were read in which nothing stands


def settle_places(read: Reading, seen: SeenThings) -> tuple[Reading, Objections, bool]:
    """The reading, its boxes moved onto the things that are seen there, and what speaks against its places.

    A box in which nothing stands, or something of another colour while the named one is elsewhere, is doubtful. The
    last value says whether the mover's box was moved onto a thing.
    """
    mover = mover_of(read)
    moved = onto_things(list(dict.fromkeys(box_of(each) for each in (mover, *read.objects))), seen.things)
    objections, doubtful = list[str](), set[BBox]()
    for thing in dict.fromkeys((mover, *read.objects)):
        fault = fault_of(thing, moved[box_of(thing)], seen)
        if fault is not None and thing.bbox not in doubtful:
            objections.append(fault)
            doubtful.add(box_of(thing))

    def settled(thing: Place) -> Place:
        region = moved[box_of(thing)]
        update: dict[str, object] = {"is_doubtful": thing.is_doubtful or thing.bbox in doubtful}
        update |= {} if region is None else {"bbox": region.bbox, "bbox_deviation": None}
        return thing.model_copy(update=update)

    update = {"grounding": settled(mover), "objects": tuple(map(settled, read.objects))}
    return read.model_copy(update=update), tuple(objections), moved[box_of(mover)] is not None


Place = TypeVar("Place", GroundingRequest, ObjectRequest)


def mover_of(read: Reading) -> GroundingRequest:
    """What a reading says of the moving object."""
    assert read.grounding is not None, "a reading of stage 1 has a moving object"
    return read.grounding


def box_of(thing: GroundingRequest | ObjectRequest) -> BBox:
    """The box of a thing that was located."""
    assert thing.bbox is not None, "things are located before they are settled"
    return thing.bbox


def onto_things(boxes: Sequence[BBox], things: Sequence[Thing]) -> dict[BBox, Thing | None]:
    """For each box the thing that it is about: none of its edges is far off, and no other box fits it better."""
    pairs = [
        (iou(box, region.bbox), at, box, region)
        for box in boxes
        for at, region in enumerate(things)
        if _is_about(box, region.bbox)
    ]
    found = dict[BBox, Thing | None].fromkeys(boxes)
    taken = set[int]()
    for _, at, box, region in sorted(pairs, key=lambda pair: -pair[0]):
        if found[box] is None and at not in taken:
            found[box] = region
            taken.add(at)
    return found


def _is_about(box: BBox, region: BBox) -> bool:
    sides = (region[2] - region[0], region[3] - region[1]) * 2
    return all(abs(a - b) <= EDGE_OFF * side for a, b, side in zip(box, region, sides, strict=True))


def fault_of(thing: GroundingRequest | ObjectRequest, region: Thing | None, seen: SeenThings) -> str | None:
    """What speaks against the place of a thing."""
    name, box = thing.object or "", box_of(thing)
    if region is None and box in seen.bare:
        return f"In the box of '{name}' nothing stands."
    named = set(name.lower().split(" with ")[0].split())  # "a truck with a red cab" need not be red
    region = region or next((each for each in seen.things if is_same_object(each.bbox, box)), None)
    if region is None or not named.isdisjoint((region.colour, *region.colours)):
        return None
    there = [each for each in seen.things if each.colour in named]
    if not there:
        return None
    x, y = there[0].centre
    return (
        f"In the box of '{name}' is something {region.colour}, while something {there[0].colour} is at "
        f"({x:.0f}, {y:.0f})."
    )


def settle_mover(read: Reading, said: WordsReading, words: WordReader, label: str = "") -> tuple[Reading, Objections]:
    """The reading; in doubt where what was read to move, or what was found for it, is not what the words say."""
    mover, meant = mover_of(read), None if said.reading.grounding is None else said.reading.grounding.object
    for name in filter(None, (mover.object, label)) if meant is not None else ():
        likeness = words.likeness(meant or "", name)
        rivals = read.objects if likeness == "unknown" else ()
        if likeness == "other" or any(words.likeness(meant or "", each.object) == "same" for each in rivals):
            told = f"The question has '{meant}' move, and '{name}' was read."
            return read.model_copy(update={"grounding": mover.model_copy(update={"is_doubtful": True})}), (told,)
    return read, ()


# --- what is asked

PLAIN, DETAILS = ("form", "relation", "negated"), ("every", "partly", "within")


def settle_question(
    read: Reading, said: WordsReading, words: WordReader, is_given: bool = False
) -> tuple[Reading, Objections]:
    """The reading with what is asked, and what speaks against it: the words decide what they plainly say.

    Names stay as they were read: the things that were found have them. Words that were not understood say nothing;
    where what is asked `is_given`, they tell only what is changed.
    """
    asked, plain = read.asked, said.reading.asked
    if plain is None:
        return read, ()
    objections, names = list[str](), [mover_of(read).object or "", *(each.object for each in read.objects)]
    if asked is not None and not is_given:
        differ = differences(asked, plain, names, words)
        told = (f"`{name}` {_shown(getattr(plain, name))}, not {_shown(getattr(asked, name))}" for name in differ)
        objections += [f"By its words the question asks with {', '.join(told)}."] if differ else []
        # What is left at its default was not said: the words complete it.
        asked = asked.model_copy(update={name: getattr(plain, name) for name in (*PLAIN, *DETAILS)})
    objections += removal_faults(read, said.reading, names, words)
    update = {"asked": asked or plain, "question_is_doubtful": read.question_is_doubtful or bool(objections)}
    return read.model_copy(update=update), tuple(objections)


def differences(asked: records.Asked, plain: records.Asked, names: Sequence[str], words: WordReader) -> list[str]:
    """The fields in which what was read to be asked is not what the words `plain`ly ask."""
    usual = records.Asked(relation=asked.relation)
    differ = [name for name in PLAIN if getattr(asked, name) != getattr(plain, name)]
    differ += [name for name in DETAILS if getattr(asked, name) not in (getattr(usual, name), getattr(plain, name))]
    for name in ("subject", "target"):
        wanted, taken = getattr(plain, name), getattr(asked, name)
        if wanted is not None and taken is not None:
            is_same = _is_meant(wanted, taken, names, words)
        else:  # the place that something is put into tells what it is to be inside of
            is_same = wanted is taken or (wanted is None and asked.relation == "inside")
        differ += [] if is_same else [name]
    if len(plain.among) > 1 and not _are_meant(plain.among, asked.among, names, words):
        differ.append("among")
    return differ


def removal_faults(read: Reading, said: Reading, names: Sequence[str], words: WordReader) -> list[str]:
    """That the words take away other things than was read."""
    removed, taken = ([each.object for each in of.interventions or () if each.kind == "remove"] for of in (said, read))
    if _are_meant(removed, taken, names, words):
        return []
    told = [", ".join(f"'{name}'" for name in each) or "nothing" for each in (removed, taken)]
    return [f"By its words the question takes {told[0]} away beforehand, and {told[1]} was read."]


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
