"""The reader that asks a multimodal LLM. A simulation takes two calls one after the other, an answer one more."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

from cow_service import __version__
from cow_service.errors import CannotReadDirection, CowError, ObjectNotFound
from cow_service.physics.camera import depth_motion
from cow_service.readers.base import AnswerReading, Asked, GroundingReading, Imagined, MotionReading
from cow_service.readers.mllm.asking import Asker, Question, Tally
from cow_service.readers.mllm.geometry import doubt_box, follow_arrow
from cow_service.readers.mllm.identify import Identified
from cow_service.readers.mllm.lines import Line
from cow_service.readers.mllm.locate import Located
from cow_service.readers.mllm.places import shares_words
from cow_service.readers.mllm.questions import Questions
from cow_service.readers.mllm.scale import Scaled
from cow_service.readers.mllm.serving import UNKNOWN, serve
from cow_service.readers.question import sentences
from cow_service.records import AnswerOption, BBox, Cue, Grounding, MotionKind, ReaderInfo, Source, Usage
from cow_service.settings import Settings
from cow_service.vision.scene import Scene
from cow_service.weights.resources import PROMPTS

DIRECTED: tuple[MotionKind, ...] = ("linear", "projectile")
FALLING: tuple[MotionKind, ...] = ("projectile", "fall")
CAMERA = {"towards": -1.0, "away": 1.0}
GIVE_DIRECTION = "Say it with `motion.direction` [dx, dy] in the request, in pixels, x right and y down."
GIVE_PLACE = "Say where it is with `grounding.point` [x, y] or `grounding.bbox` [x0, y0, x1, y1] in the request."


class MllmReader:
    """Asks one model for everything. It keeps its connections, and nothing of what it saw."""

    def __init__(self, name: str, asker: Asker, origin: str = "") -> None:
        self.name = name
        self.asker = asker
        self._origin = origin  # which server, or which weights

    @cached_property
    def fingerprint(self) -> str:
        """The model, where it is served from, how its family is asked, and the words of all prompts."""
        served = self.asker.served
        prompts = "".join(PROMPTS.read(name) for name in PROMPTS.names())
        told = (
            __version__, self.name, served.name, self._origin,
            served.manifest.model_dump_json(), served.family.model_dump_json(), prompts,
        )  # fmt: skip
        return hashlib.sha256("\n".join(told).encode()).hexdigest()

    def look(self, scene: Scene, asked: Asked) -> MllmLook:
        """Begins to read an image for a question. Nothing is sent yet."""
        return MllmLook(self, scene, asked)

    def close(self) -> None:
        """Closes its connections."""
        self.asker.close()


class MllmLook:
    """One image and one question: what was asked of the model, and what it said."""

    source: Source = "mllm"

    def __init__(self, reader: MllmReader, scene: Scene, asked: Asked) -> None:
        self._reader = reader
        self._scene = scene
        self._asked = asked
        self._questions = Questions(reader.asker.served, scene, asked)
        self._who = f"The multimodal LLM '{reader.asker.served.name}'"
        self._tally = Tally()
        self._identified: Identified | None = None
        self._line: Line | None = None
        self._scaled: Scaled | CowError | None = None

    @property
    def info(self) -> ReaderInfo:
        """The model as it is served, and the version of each prompt that it was sent."""
        served = self._reader.asker.served
        return ReaderInfo(name=self._reader.name, model=served.name, prompts=dict(sorted(self._tally.prompts.items())))

    @property
    def usage(self) -> Usage:
        """Calls and tokens so far."""
        return self._tally.usage

    def ground(self) -> GroundingReading:
        """Two calls: what moves, in words; then where it is and, in the same call, which way it moves.

        Raises `ObjectNotFound`, `MllmBadReply`, `MllmUnavailable`.
        """
        identified = self._reader.asker.ask(self._questions.identify(), self._tally, self._asked)
        if identified is None:
            raise ObjectNotFound(f"{self._who} sees nothing in the image that the question could move. {GIVE_PLACE}")
        self._identified = identified
        located = self._locate(identified.object, None, identified.others)
        if located is None:
            raise ObjectNotFound(f"{self._who} does not see '{identified.object}' in the image. {GIVE_PLACE}")
        bbox = self._scene.bbox_at(located.point or (0.0, 0.0)) if located.bbox is None else located.bbox
        return GroundingReading(
            object=identified.object,
            bbox=bbox,
            point=located.point,
            others=located.others,
            warnings=(*self._doubts(identified, located, bbox), *self._unknown_family()),
        )

    def read_motion(self, grounding: Grounding) -> MotionReading:
        """No call where `ground` asked already; one where the place came with the request, two where it was recalled.

        Raises `CannotReadDirection`, `MllmBadReply`, `MllmUnavailable`.
        """
        if grounding.source == "request":
            self._locate(grounding.object, grounding.bbox, ())
        elif self._identified is None:  # the place was read by another look: it stays, the words are asked for again
            self._identified = self._reader.asker.ask(self._questions.identify(), self._tally, self._asked)
            self._locate(grounding.object, grounding.bbox, ())
        sentence = None if self._identified is None else self._identified.sentence
        reading = MotionReading(self._kind, None, "text", sentence=sentence)
        if self._kind in FALLING:
            reading = self._with_scale(replace(reading, cue="gravity"))
        return self._directed(reading, grounding) if self._kind in DIRECTED else reading

    def answer(
        self, options: Sequence[AnswerOption], imagined: Imagined | None, votes: int
    ) -> tuple[AnswerReading, ...]:
        """One call per vote, all at the same time. Raises `MllmBadReply`, `MllmUnavailable` where all of them fail."""
        asked = self._questions.answers(options, imagined, votes)
        told = self._reader.asker.ask_all(asked, self._tally, self._asked)
        readings = tuple(each for each in told if not isinstance(each, CowError))
        if not readings:
            raise next(each for each in told if isinstance(each, CowError))
        return readings

    @cached_property
    def _parsed(self) -> sentences.Question:
        return sentences.parse(self._asked.question)

    @property
    def _kind(self) -> MotionKind:
        """What the model said, else what the question's verb says."""
        told = None if self._identified is None else self._identified.kind
        return told or self._parsed.motion.kind or "linear"

    def _locate(self, name: str, bbox: BBox | None, others: Sequence[str]) -> Located | None:
        """Asks for the place, the direction and, of what falls, the scale, as far as they are needed; all at once."""
        moves = "motion" in self._asked.stages
        wants_direction = moves and self._kind in DIRECTED
        where = [self._questions.locate(name, bbox, others, wants_direction)] if bbox is None or wants_direction else []
        scale = [self._questions.scale(name)] if moves and self._kind in FALLING else []
        asked: list[Question[Any]] = [*where, *scale]
        told = self._reader.asker.ask_all(asked, self._tally, self._asked)
        if scale:
            scaled = told.pop()
            if isinstance(scaled, Scaled | CowError):
                self._scaled = scaled
        for located in told:
            if isinstance(located, CowError):
                raise located
            if isinstance(located, Located):
                self._line = located.line
                return located
        return None

    def _doubts(self, identified: Identified, located: Located, bbox: BBox) -> tuple[str, ...]:
        """What speaks against the place that the model gave."""
        phrase = sentences.parse(f"If the {identified.object.removeprefix('the ')} moves, what happens?").mover
        doubts = doubt_box(self._scene, bbox, phrase, located.cut_off)
        if located.label and not shares_words(located.label, identified.object):
            told = f"Asked for '{identified.object}', the reader gave a place that it calls '{located.label}'."
            return (*doubts, told)
        return doubts

    def _unknown_family(self) -> tuple[str, ...]:
        served = self._reader.asker.served
        if served.manifest.name != UNKNOWN:
            return ()
        taken = "coordinates were asked for as fractions, and a model that is used to others may have given those"
        if served.family.name != UNKNOWN:
            taken = f"by its name it was taken for one of the family '{served.family.name}'"
        return (f"No manifest describes '{served.name}': {taken}.",)

    def _with_scale(self, reading: MotionReading) -> MotionReading:
        if isinstance(self._scaled, Scaled):
            return replace(reading, metres_per_pixel=self._scaled.metres_per_pixel, down=self._scaled.down)
        if isinstance(self._scaled, CowError):
            told = f"The scale of the scene could not be read ({self._scaled.code}): the default one was taken."
            return replace(reading, warnings=(*reading.warnings, told))
        return reading

    def _directed(self, reading: MotionReading, grounding: Grounding) -> MotionReading:
        """The reading with its direction, checked against the drawn arrow where the question speaks of one."""
        line, words = self._line, self._parsed.motion
        if line is None or (line.ends is None and line.camera is None):
            raise CannotReadDirection(
                f"{self._who} found nothing in the image or the question that tells which way the {grounding.object} "
                f"moves. {GIVE_DIRECTION}"
            )
        speaks_of_arrow = "arrow" in self._asked.question.lower()
        guess: Cue = "arrow" if speaks_of_arrow else "text" if words.direction is not None else "orientation"
        cue = line.cue or guess
        if line.camera is not None:
            direction, depth = depth_motion(CAMERA[line.camera])
            return replace(reading, direction=direction, depth=depth, cue=cue)
        (x0, y0), (x1, y1) = line.ends or ((0.0, 0.0), (1.0, 0.0))
        along = line.along_arrow if cue == "arrow" else None
        reading = replace(reading, direction=(x1 - x0, y1 - y0), cue=cue, along_arrow=along)
        return follow_arrow(self._scene, grounding.bbox, reading, words.arrow) if speaks_of_arrow else reading


def create(settings: Settings) -> MllmReader:
    """Factory for the registry. Raises `ReaderUnavailable` where COW_MLLM cannot be used."""
    return MllmReader("mllm", Asker(serve(settings), settings), settings.mllm_base_url or "")
