"""The reader that needs no weights: rules for the question, classical vision for the image. It refuses, not guesses."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

from cow_service import __version__
from cow_service.errors import CannotGround, CannotReadDirection
from cow_service.narration import same_name
from cow_service.physics.camera import depth_motion
from cow_service.readers.base import (
    AnswerReading,
    GroundingReading,
    Imagined,
    MotionHints,
    MotionReading,
    NamedChange,
    QuestionReading,
    ReaderInput,
)
from cow_service.readers.embedded.answers import MAX_UNREAD, answer_from
from cow_service.readers.embedded.changes import check_changes, find_placed, find_removed, given_as, without
from cow_service.readers.embedded.english.asked import read_alternatives, read_asked, unread
from cow_service.readers.embedded.english.lexicon import ARROWS, ObjectPhrase
from cow_service.readers.embedded.english.motion import MotionWords
from cow_service.readers.embedded.english.nouns import is_vehicle
from cow_service.readers.embedded.english.questions import Question, parse, parse_noun_phrase
from cow_service.readers.embedded.facing import facing
from cow_service.readers.embedded.matching import (
    best_matches,
    describe,
    inside_drawn_box,
    is_kind_asked,
    is_known,
    match_one,
    names_meant,
    noun_warnings,
    read_name,
    things_of_kinds,
)
from cow_service.readers.embedded.motions import (
    along_trail,
    length,
    other_readings,
    quantities,
    scene_of_mover,
    step_readings,
)
from cow_service.readers.remedies import GIVE_DIRECTION, GIVE_PLACE
from cow_service.records import (
    DIRECTED_KINDS,
    AnswerOption,
    BBox,
    Grounding,
    LocatedObject,
    MotionKind,
    ObjectPrior,
    ReaderInfo,
    Source,
    Vector,
)
from cow_service.settings import Settings
from cow_service.vision.arrow_choice import arrow_of, arrows_near, at_arrow
from cow_service.vision.masks import iou
from cow_service.vision.regions import SAME_OBJECT_IOU, Region
from cow_service.vision.scene import Scene


class EmbeddedReader:
    """Colour and noun of the mover, words and arrows for its direction, encounters for the answer."""

    source: Source = "embedded"
    info = ReaderInfo(name="embedded", revision=__version__)  # rules change with the version alone
    fingerprint = f"embedded {__version__}"

    heeds_seed = False

    def repeats_answers(self, votes: int) -> bool:
        """Always: rules draw no random numbers."""
        return True

    def read_question(self, question: str) -> QuestionReading:
        """What the grammar reads."""
        read = parse(question)
        changes = (
            NamedChange(
                kind=change.kind,
                object=change.object.text,
                relation=change.relation,
                targets=tuple(target.text for target in change.targets),
            )
            for change in read.interventions
        )
        words = question.lower()
        drawings = frozenset(each for each in ("arrow", "box") if each in words)
        return QuestionReading(read_asked(read), tuple(changes), read.motion.trail is not None, drawings)

    def read_name(self, name: str) -> ObjectPrior:
        """By its noun."""
        return read_name(name)

    def names_meant(self, words: str, names: Sequence[str]) -> tuple[str, ...]:
        """Those of the kind, where they are as many as the words say."""
        return names_meant(words, names)

    def ground(self, given: ReaderInput) -> GroundingReading:
        """The region that fits the mover's words. Raises `CannotGround` where none or several do."""
        scene, question = given.scene, parse(given.question)
        if question.mover is None or not _names_motion(question.motion):
            words = unread(question)
            named = ("', '".join((*words.turning, *words.beside)) or given.question)[:MAX_UNREAD]
            raise CannotGround(
                "The question does not say in words what moves, as far as the embedded reader understands it; it reads "
                f"English. It did not understand '{named}'. "
                f'Ask like "If the red ball moves to the left, will it hit the vase?". {GIVE_PLACE}'
            )
        with given.cpu():
            check_changes(question)
            scene, assumed = scene_of_mover(scene, question)
            removed = find_removed(scene, question, given.known)
            regions = without(scene.regions, removed)
            bbox = _mover(scene, regions, question, question.mover)
            placed = find_placed(scene, regions, question, (question.mover, bbox), given.known)
            others = _others(regions, [*question.others, *_sought(given, question)], bbox)
            others += things_of_kinds(regions, question, bbox, given.known)
            found = {other.object for other in others}
            unseen = (each for each in question.others if each.text not in found and not is_kind_asked(each, question))
            missing = [_not_found(scene, each.text) for each in unseen if given_as(each, given.known) is None]
            boxes = {other.object: other.bbox for other in others} | {question.mover.text: bbox}
            things = [(each, boxes[each.text]) for each in (question.mover, *question.others) if each.text in boxes]
            doubts = [*noun_warnings(scene, things), *_unread_warnings(question)]
        return GroundingReading(
            question.mover.text,
            bbox,
            others=others,
            warnings=(*assumed, *missing, *doubts),
            interventions=(*removed, *placed),
            asked=read_asked(question),
        )

    def read_motion(self, given: ReaderInput, grounding: Grounding, hints: MotionHints | None) -> MotionReading:
        """Kind and direction from the words, and from the arrow where the words speak of one.

        Raises `CannotReadDirection`.
        """
        with given.cpu():
            question = parse(given.question)
            on = along_trail(given.scene, grounding, question.motion) if question.motion.trail is not None else None
            reading = on or _read_motion(given.scene, question, grounding)
            return _with_quantities(given.scene, question, grounding, reading)

    def answer(
        self,
        given: ReaderInput,
        options: Sequence[AnswerOption],
        grounding: Grounding | None,
        imagined: Imagined | None,
        votes: int,
    ) -> tuple[AnswerReading, ...]:
        """What the world tells of the question, the same for every vote; not sure where it does not."""
        question = parse(given.question)
        outcome = None if imagined is None else imagined.simulation.trajectory.outcome
        alternatives = read_alternatives(question)
        asked = read_asked(question) if grounding is None else grounding.asked
        reading = answer_from(options, asked, outcome, imagined is not None, alternatives, unread(question))
        if votes > 1:
            again = "The embedded reader gives the same answer every time: more votes say no more."
            reading = replace(reading, notes=(*reading.notes, again))
        return (reading,) * votes


AGREES = 0.5  # cosine of the angle from which an arrow and a direction that is named are two things
_ON_FLOOR = frozenset({"slide", "roll", "drive", "glide", "skid"})  # what does so keeps touching what it stands on
_SEVERAL = frozenset({"both", "two", "three", "all", "four", "several"})


def create(settings: Settings) -> EmbeddedReader:
    """Factory for the registry."""
    return EmbeddedReader()


def _unread_warnings(question: Question) -> list[str]:
    words = unread(question)
    said = [f"Read '{error}' as '{meant}'." for error, meant in question.errors]
    said += [f"The words '{each}' were not understood, so no outcome is told." for each in words.turning]
    return said + [f"The words '{each}' were not understood and changed nothing." for each in words.beside]


def _names_motion(words: MotionWords) -> bool:
    """Whether the question says at all that something moves."""
    parts = (words.kind, words.arrow, words.direction, words.forward, words.towards, words.trail)
    return bool(words.verb or words.depth) or any(part is not None for part in parts)


def _mover(scene: Scene, regions: Sequence[Region], question: Question, phrase: ObjectPhrase) -> BBox:
    if phrase.text.lower().split()[0] in _SEVERAL:
        raise CannotGround(f"The question moves '{phrase.text}' at once: ask of one thing, or name each. {GIVE_PLACE}")
    if phrase.inside_box:
        return inside_drawn_box(scene, phrase, GIVE_PLACE)
    if not scene.regions:
        raise CannotGround(
            f"Looked for '{phrase.text}', but the image is too cluttered (or too plain) for the embedded reader to "
            f"tell its objects apart. {GIVE_PLACE}"
        )
    fitting = best_matches(regions, phrase, question.others)
    if len(fitting) > 1 and question.mentions_arrow:
        fitting = at_arrow(scene, fitting) or fitting
    seen = describe(scene.regions)
    if not fitting:
        raise CannotGround(f"Looked for '{phrase.text}' and found nothing that fits. Seen: {seen}. {GIVE_PLACE}")
    if len(fitting) > 1:
        raise CannotGround(
            f"Looked for '{phrase.text}' and found {len(fitting)} that fit: {describe(fitting)}. "
            f"Seen in all: {seen}. {GIVE_PLACE}"
        )
    if phrase.colour is None and not is_known(phrase) and len(scene.regions) > 1:
        raise CannotGround(
            f"Looked for '{phrase.text}', which names no colour and no shape that the embedded reader knows. "
            f"Seen: {seen}. {GIVE_PLACE}"
        )
    return fitting[0].bbox


def _sought(given: ReaderInput, question: Question) -> list[ObjectPhrase]:
    """What the caller wants located, but for what the question names in the same words."""
    named = [phrase.text for phrase in (question.mover, *question.others) if phrase is not None]
    phrases = ((name, parse_noun_phrase(name)) for name in given.sought if not any(same_name(name, n) for n in named))
    return [replace(phrase, text=name) for name, phrase in phrases if phrase is not None]


def _others(regions: Sequence[Region], phrases: Sequence[ObjectPhrase], mover: BBox) -> tuple[LocatedObject, ...]:
    """The other things of these words, where exactly one region fits; the rest stay unnamed."""
    found: dict[BBox, LocatedObject] = {}
    for phrase in phrases:
        bbox = _bbox_of(regions, phrase, mover, phrases)
        if bbox is not None:
            found.setdefault(bbox, LocatedObject(object=phrase.text, bbox=bbox))
    return tuple(found.values())


def _bbox_of(
    regions: Sequence[Region], phrase: ObjectPhrase, mover: BBox, others: Sequence[ObjectPhrase]
) -> BBox | None:
    """The box of the one region, besides the mover, that fits a phrase."""
    region = match_one([region for region in regions if iou(region.bbox, mover) < SAME_OBJECT_IOU], phrase, others)
    return None if region is None else region.bbox


def _not_found(scene: Scene, text: str) -> str:
    return (
        f"The question names '{text}', which was not found, or not for certain, so no encounter is told of it by that "
        f"name. Seen: {describe(scene.regions)}."
    )


def _read_motion(scene: Scene, question: Question, grounding: Grounding) -> MotionReading:
    words = question.motion
    kind = words.kind or "linear"
    if kind == "static" and question.names_direction:
        raise CannotReadDirection(
            f"The question says that the {grounding.object} does not move, and speaks of a direction all the same: "
            f"which is meant was not understood. {GIVE_DIRECTION}"
        )
    if words.contradictory:
        raise CannotReadDirection(
            f"The verb '{words.verb}' and the direction that the question gives for the {grounding.object} contradict "
            f"each other: which is meant was not understood. {GIVE_DIRECTION}"
        )
    if kind not in DIRECTED_KINDS:
        return MotionReading(kind, None, "gravity" if kind == "fall" else "text")
    return _as_said(scene, words, kind, grounding) or _as_shown(scene, question, kind, grounding)


def _as_said(scene: Scene, words: MotionWords, kind: MotionKind, grounding: Grounding) -> MotionReading | None:
    """The motion whose direction the words give; None where they give none."""
    if words.arrow is not None:
        x, y = arrow_of(scene, grounding, GIVE_DIRECTION).direction
        along = words.arrow == "along"
        x, y = (x, y) if along else (-x, -y)
        said = words.direction or (x, y)
        if x * said[0] + y * said[1] < AGREES * math.hypot(x, y) * math.hypot(*said):
            raise CannotReadDirection(
                "The question names the arrow and another direction, and the arrow does not point there. "
                f"{GIVE_DIRECTION}"
            )
        return MotionReading(kind, (x, y), "arrow", along_arrow=along)
    if words.direction is not None and words.verb in _ON_FLOOR and words.direction[0] == 0.0 and not words.depth:
        direction, depth = depth_motion(-math.copysign(1.0, words.direction[1]))  # up the image is away on the floor
        return MotionReading(kind, direction, "text", depth=depth)
    if words.direction is not None:
        return MotionReading(kind, words.direction, "text", depth=words.depth)
    if words.depth:
        direction, depth = depth_motion(words.depth)
        return MotionReading(kind, direction, "text", depth=depth)
    if words.towards is not None:
        return MotionReading(kind, _towards(scene, words.towards, grounding), "text")
    return None


def _as_shown(scene: Scene, question: Question, kind: MotionKind, grounding: Grounding) -> MotionReading:
    """The motion whose direction the image shows, by a trail or an arrow. Raises `CannotReadDirection`."""
    words = question.motion
    if words.forward is not None:
        return _as_it_faces(scene, words.forward, kind, grounding)
    return along_trail(scene, grounding, words) or _along_arrow(scene, question, grounding, kind)


def _as_it_faces(scene: Scene, forward: bool, kind: MotionKind, grounding: Grounding) -> MotionReading:
    """Forward or backward, by the way that a vehicle is seen to face."""
    said = f"The question says that the {grounding.object} moves {'forward' if forward else 'backward'}."
    if not is_vehicle(grounding.object):
        raise CannotReadDirection(
            f"{said} The embedded reader sees only of vehicles with wheels which way they face. {GIVE_DIRECTION}"
        )
    way = facing(scene.clean, scene.silhouette(grounding.bbox), grounding.bbox)
    if way is None:
        raise CannotReadDirection(f"{said} Which way it faces could not be seen for certain. {GIVE_DIRECTION}")
    return MotionReading(kind, way if forward else (-way[0], -way[1]), "orientation")


def _along_arrow(scene: Scene, question: Question, grounding: Grounding, kind: MotionKind) -> MotionReading:
    """Along the only arrow drawn at the mover, where the question names no direction at all."""
    near = arrows_near(scene, grounding.bbox)
    clause = (item for item in question.clause if item.phrase is not None and item.phrase.head in ARROWS)
    if any(item.start not in question.read for item in clause):
        raise CannotReadDirection(
            f"How the {grounding.object} moves by the arrow that the question names was not understood. "
            f"{GIVE_DIRECTION}"
        )
    if near and question.names_direction:
        raise CannotReadDirection(
            "The question has words of direction that could not be read as the motion's, so the drawn arrow was "
            f"not followed either. {GIVE_DIRECTION}"
        )
    if len(near) != 1:
        raise CannotReadDirection(
            "The question names no direction (left, right, up, down, towards, away, along the arrow), and the "
            f"image shows {len(near) or 'no'} arrow{'s' if len(near) > 1 else ''} at the {grounding.object}. "
            f"{GIVE_DIRECTION}"
        )
    note = "The question names no direction; the arrow drawn at the object was followed."
    return MotionReading(kind, near[0].direction, "arrow", along_arrow=True, warnings=(note,))


def _with_quantities(scene: Scene, question: Question, grounding: Grounding, reading: MotionReading) -> MotionReading:
    """How fast, how far and how long, the further legs, and what else moves."""
    words = question.motion
    parted = any(each.share is not None for each in words.quantities)
    way = length(_towards(scene, words.towards, grounding)) if parted and words.towards is not None else None
    steps, others = step_readings(words.steps, grounding.bbox), other_readings(words.others, grounding)
    return replace(reading, **quantities(words.quantities, way, grounding.bbox), steps=steps, others=others)


def _towards(scene: Scene, phrase: ObjectPhrase, grounding: Grounding) -> Vector:
    """From the mover to the thing that it moves towards."""
    goal = next((other.bbox for other in grounding.others if other.object == phrase.text), None)
    bbox = goal or _bbox_of(scene.regions, phrase, grounding.bbox, ())
    if bbox is None:
        raise CannotReadDirection(
            f"The {grounding.object} moves towards '{phrase.text}', which was not found. "
            f"Seen: {describe(scene.regions)}. {GIVE_DIRECTION}"
        )
    x, y = grounding.point
    return (bbox[0] + bbox[2]) / 2 - x, (bbox[1] + bbox[3]) / 2 - y
