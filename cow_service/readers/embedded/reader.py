"""The reader that needs no weights: rules for the question, classical vision for the image. It refuses, not guesses."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property

from cow_service import __version__
from cow_service.errors import CannotGround, CannotReadDirection
from cow_service.physics.camera import depth_motion
from cow_service.readers.base import AnswerReading, Asked, GroundingReading, Imagined, MotionReading
from cow_service.readers.embedded.encounter_answers import choose_option
from cow_service.readers.embedded.judging import judge
from cow_service.readers.embedded.matching import best_matches, describe, inside_drawn_box, is_known, match_one
from cow_service.readers.question.motion_words import MotionWords
from cow_service.readers.question.phrases import ObjectPhrase
from cow_service.readers.question.sentences import Question, parse
from cow_service.records import AnswerOption, BBox, Grounding, LocatedObject, ReaderInfo, Source, Usage, Vector
from cow_service.settings import Settings
from cow_service.vision.arrow_choice import arrow_of, arrows_near, at_arrow
from cow_service.vision.scene import SAME_OBJECT, Scene, iou

# Words that say which way, wherever they stand: where they were not understood, no arrow may stand in for them.
_DIRECTIONS = re.compile(
    r"\b(left|right|up|down|upwards?|downwards?|leftwards?|rightwards?|north|south|east|west|(north|south)-?(east|west)"
    r"|clockwise|counterclockwise|towards?|away|diagonal(ly)?|degrees?|sideways|back|backwards?|forwards?|other way)\b",
    re.IGNORECASE,
)

GIVE_PLACE = "Say where it is with `grounding.point` [x, y] or `grounding.bbox` [x0, y0, x1, y1] in the request."
GIVE_DIRECTION = "Say it with `motion.direction` [dx, dy] in the request, in pixels, x right and y down."


class EmbeddedReader:
    """Colour and noun of the mover, words and arrows for its direction, encounters for the answer."""

    fingerprint = f"embedded {__version__}"

    def look(self, scene: Scene, asked: Asked) -> EmbeddedLook:
        """Begins to read an image for a question."""
        return EmbeddedLook(scene, asked.question, asked.recalled)


class EmbeddedLook:
    """One image and one question under the rules."""

    source: Source = "embedded"
    usage = Usage()  # it asks nobody

    def __init__(self, scene: Scene, question: str, recalled: Grounding | None) -> None:
        self._scene = scene
        self._text = question
        self._grounded: GroundingReading | None = None
        if recalled is not None and recalled.source == self.source:
            self._grounded = GroundingReading(recalled.object, recalled.bbox, others=recalled.others)

    @property
    def info(self) -> ReaderInfo:
        """Rules change with the version alone."""
        return ReaderInfo(name="embedded", revision=__version__)

    @cached_property
    def _question(self) -> Question:
        return parse(self._text)

    def answer(
        self, options: Sequence[AnswerOption], imagined: Imagined | None, votes: int
    ) -> tuple[AnswerReading, ...]:
        """What geometry decides, the same for every vote; not sure where it does not. It gives no reasoning."""
        simulation = None if imagined is None else imagined.simulation
        judgement = judge(self._scene, self._question, self._grounded, simulation)
        reading = choose_option(options, judgement.happens)
        again = ("The embedded reader gives the same answer every time: more votes say no more.",) if votes > 1 else ()
        notes = tuple(note for note in (judgement.why, *reading.notes, *again) if note)
        return (replace(reading, notes=notes),) * votes

    def ground(self) -> GroundingReading:
        """The region that fits the mover's words; `CannotGround` where none or several do."""
        scene, asked = self._scene, self._question
        if asked.mover is None or not _speaks_of_motion(asked.motion):
            raise CannotGround(
                'The question does not say in words what moves. Ask like "If the red ball moves to the left, '
                f'will it hit the vase?". {GIVE_PLACE}'
            )
        bbox = self._mover(scene, asked, asked.mover)
        others = _others(scene, asked, bbox)
        found = {other.object for other in others}
        missing = [phrase.text for phrase in asked.others if phrase.text not in found]
        doubts = tuple(_not_found(scene, text) for text in missing)
        self._grounded = GroundingReading(asked.mover.text, bbox, others=others, warnings=doubts)
        return self._grounded

    def read_motion(self, grounding: Grounding) -> MotionReading:
        """Kind and direction from the words, and from the arrow where the words speak of one."""
        scene, question, asked = self._scene, self._text, self._question
        words = asked.motion
        kind = words.kind or "linear"
        if kind == "static" and _DIRECTIONS.search(question):
            raise CannotReadDirection(
                f"The question says that the {grounding.object} does not move, and speaks of a direction all the same: "
                f"which is meant was not understood. {GIVE_DIRECTION}"
            )
        if kind in ("static", "fall"):  # neither has a direction
            return MotionReading(kind, None, "text" if kind == "static" else "gravity")
        if words.arrow is not None:
            arrow = arrow_of(scene, grounding, GIVE_DIRECTION)
            sign = 1.0 if words.arrow == "along" else -1.0
            return MotionReading(kind, _scaled(arrow.direction, sign), "arrow", along_arrow=sign > 0)
        if words.direction is not None:
            return MotionReading(kind, words.direction, "text", depth=words.depth)
        if words.depth:
            direction, depth = depth_motion(words.depth)
            return MotionReading(kind, direction, "text", depth=depth)
        if words.towards is not None:
            return MotionReading(kind, _towards(scene, asked, words.towards, grounding), "text")
        if words.forward is not None:
            raise CannotReadDirection(
                f"The question says that the {grounding.object} moves {'forward' if words.forward else 'backward'}. "
                "Which way an object faces is beyond the embedded reader: it reads drawn arrows and words like left or "
                f"up. {GIVE_DIRECTION}"
            )
        own = arrows_near(scene, grounding.bbox)
        if own and _DIRECTIONS.search(question):
            raise CannotReadDirection(
                "The question has words of direction that could not be read as the motion's, so the drawn arrow was "
                f"not followed either. {GIVE_DIRECTION}"
            )
        if len(own) != 1:
            raise CannotReadDirection(
                "The question names no direction (left, right, up, down, towards, away, along the arrow), and the "
                f"image shows {len(own) or 'no'} arrow{'s' if len(own) > 1 else ''} at the {grounding.object}. "
                f"{GIVE_DIRECTION}"
            )
        note = "The question names no direction; the arrow drawn at the object was followed."
        return MotionReading(kind, own[0].direction, "arrow", along_arrow=True, warnings=(note,))

    def _mover(self, scene: Scene, asked: Question, phrase: ObjectPhrase) -> BBox:
        if phrase.inside_box:
            return inside_drawn_box(scene, phrase, GIVE_PLACE)
        if not scene.regions:
            raise CannotGround(
                f"Looked for '{phrase.text}', but the image is too cluttered (or too plain) for the embedded reader to "
                f"tell its objects apart. {GIVE_PLACE}"
            )
        fitting = best_matches(scene.regions, phrase, asked.others)
        if len(fitting) > 1 and "arrow" in asked.text.lower():
            fitting = at_arrow(scene, fitting) or fitting
        seen = describe(scene.regions)
        if len(fitting) == 1 and phrase.colour is None and not is_known(phrase) and len(scene.regions) > 1:
            raise CannotGround(
                f"Looked for '{phrase.text}', which names no colour and no shape that the embedded reader knows. "
                f"Seen: {seen}. {GIVE_PLACE}"
            )
        if len(fitting) == 1:
            return fitting[0].bbox
        if not fitting:
            raise CannotGround(f"Looked for '{phrase.text}' and found nothing that fits. Seen: {seen}. {GIVE_PLACE}")
        raise CannotGround(
            f"Looked for '{phrase.text}' and found {len(fitting)} that fit: {describe(fitting)}. "
            f"Seen in all: {seen}. {GIVE_PLACE}"
        )


def create(settings: Settings) -> EmbeddedReader:
    """Factory for the registry."""
    return EmbeddedReader()


def _not_found(scene: Scene, text: str) -> str:
    return (
        f"The question names '{text}', which was not found, or not for certain, so no encounter is told of it by that "
        f"name. Seen: {describe(scene.regions)}."
    )


def _speaks_of_motion(words: MotionWords) -> bool:
    """Whether the question says at all that something moves."""
    told = (words.kind, words.arrow, words.direction, words.forward, words.towards)
    return bool(words.verb or words.depth) or any(part is not None for part in told)


def _others(scene: Scene, asked: Question, mover: BBox) -> tuple[LocatedObject, ...]:
    """The other things that the question names, where exactly one region fits; the rest stay unnamed."""
    rest = [region for region in scene.regions if iou(region.bbox, mover) < SAME_OBJECT]
    found: list[LocatedObject] = []
    for phrase in asked.others:
        region = match_one(rest, phrase)
        if region is not None and all(region.bbox != other.bbox for other in found):
            found.append(LocatedObject(object=phrase.text, bbox=region.bbox))
    return tuple(found)


def _towards(scene: Scene, asked: Question, phrase: ObjectPhrase, grounding: Grounding) -> Vector:
    """From the mover to the thing that it moves towards."""
    goal = next((other for other in grounding.others if other.object == phrase.text), None)
    bbox = goal.bbox if goal is not None else None
    if bbox is None:
        region = match_one([r for r in scene.regions if iou(r.bbox, grounding.bbox) < SAME_OBJECT], phrase)
        bbox = None if region is None else region.bbox
    if bbox is None:
        raise CannotReadDirection(
            f"The {grounding.object} moves towards '{phrase.text}', which was not found. "
            f"Seen: {describe(scene.regions)}. {GIVE_DIRECTION}"
        )
    x, y = grounding.point
    return (bbox[0] + bbox[2]) / 2 - x, (bbox[1] + bbox[3]) / 2 - y


def _scaled(vector: Vector, factor: float) -> Vector:
    return factor * vector[0], factor * vector[1]
