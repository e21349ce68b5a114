"""The Protocol of readers, which read an image for a question. Stages know this file, never an implementation."""

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from typing import Literal, Protocol

from pydantic import Field

from cow_service import records
from cow_service.records import (
    BBox,
    Grounding,
    Language,
    LocatedObject,
    MotionKind,
    ObjectPrior,
    Point,
    Record,
    Source,
    Vector,
)
from cow_service.vision.scene import Scene
from cow_service.vision.types import Image, Mask

Likeness = Literal["same", "other", "unknown"]
SpeedWord = Literal["slow", "normal", "fast"]
Unit = Literal["px", "m", "widths", "px/s", "m/s", "widths/s"]  # `widths`: of the image


@dataclass(frozen=True)
class Quantity:
    """A number with its unit, as it was said."""

    value: float
    unit: Unit


@dataclass(frozen=True)
class StepReading:
    """A further leg of a motion."""

    direction: Vector  # any length, px
    depth: float = 0.0
    distance: Quantity | None = None
    duration: float | None = None  # s


@dataclass(frozen=True)
class OtherMotionReading:
    """Another thing that is set moving at the same time."""

    object: LocatedObject
    kind: MotionKind
    direction: Vector | None  # any length, px
    direction_deviation: float | None = None  # degrees; null: as that of the mover
    depth: float = 0.0
    speed: SpeedWord | Quantity | None = None
    towards: LocatedObject | None = None  # see `Motion.towards`


@dataclass
class CallLog:
    """What one stage sent to a multimodal LLM. Readers add to it, so that failed calls count, too."""

    usage: records.Usage = field(default_factory=records.Usage)
    prompts: dict[str, int] = field(default_factory=dict[str, int])  # version by name
    notes: dict[str, None] = field(default_factory=dict[str, None])  # warnings of what was sent in another form


@dataclass(frozen=True)
class SeenThing:
    """What the models of the server found for a noun."""

    noun: str  # as it was asked for
    mask: Mask  # [H, W]
    score: float  # of the detector


@dataclass(frozen=True)
class ReaderInput:
    """What every call of a reader is given. Readers keep nothing of it from one call to the next."""

    scene: Scene
    question: str
    language: Language = "en"  # of what is said of the simulation
    seed: int | None = None  # None: an MLLM is sent none, and draws as it likes
    motion_wanted: bool = True  # stage 2 is left to the reader, too
    asked_wanted: bool = True  # what the question wants to know is; else the caller has said it
    changes_wanted: bool = True  # so with what is taken away or put somewhere
    known: tuple[LocatedObject, ...] = ()  # objects that the caller has located, by name: not to be searched
    sought: tuple[str, ...] = ()  # names of further objects that the caller wants located, besides the question's
    words: "QuestionReading | None" = None  # what the words of the question say, where a reader may rely on it
    objections: tuple[str, ...] = ()  # what speaks against its last reading, in sentences: to be asked again with these
    until: float | None = None  # Unix time, s, after which an MLLM that refuses is not asked again; None: its own limit
    calls: CallLog = field(default_factory=CallLog)
    check_canceled: Callable[[], None] = lambda: None  # to be called while waiting; raises `Canceled`
    cpu: Callable[[], AbstractContextManager[None]] = nullcontext  # to be held around work on the CPU; not reentrant
    find: Callable[[Sequence[str]], tuple[SeenThing, ...]] | None = None  # by nouns, with `cpu` held; None: no detector


class OtherMotionHint(Record):
    """As `OtherMotionReading`, by name: it is located with the other objects."""

    object: str
    kind: MotionKind
    direction: Vector | None = None
    depth: float = 0.0


class MotionHints(Record):
    """What a reader learned of the motion while it looked for the object, so that stage 2 needs no second look."""

    kind: MotionKind | None = None
    ends: tuple[Point, Point] | None = None  # of a line along the motion, px of the upright image
    camera: Literal["towards", "away"] | None = None  # the motion leads straight to the camera, or from it
    speed: Quantity | None = None
    distance: Quantity | None = None
    duration: float | None = Field(default=None, gt=0)  # s
    until: records.Until | None = None
    then: tuple[StepReading, ...] = ()  # further legs
    also: tuple[OtherMotionHint, ...] = ()
    cue: records.Cue | None = None
    along_arrow: bool | None = None
    metres_per_pixel: records.MetresPerPixel | None = None
    down: Vector = (0.0, 1.0)
    scale_error: str | None = None  # code of the error for which the scale could not be read


@dataclass(frozen=True)
class NamedChange:
    """An intervention whose objects are names that are still to be located."""

    kind: records.InterventionKind
    object: str
    relation: records.PlaceRelation | None = None
    targets: tuple[str, ...] = ()


@dataclass(frozen=True)
class WayReading:
    """What the words of a question say of the way of what moves; None where they say nothing."""

    along_arrow: bool | None = None  # else against it
    direction: Vector | None = None  # unit vector in the image
    depth: float = 0.0  # see `Motion.depth`; 1 or -1 alone: straight away from the camera, or towards it
    towards: str | None = None  # name of the thing that it moves towards
    forward: bool | None = None  # as it faces, else backward


@dataclass(frozen=True)
class QuestionReading:
    """What the words of a question say, without a look at the image and without a model."""

    asked: records.Asked | None = None  # null if the reader cannot tell from the words alone
    mover: str | None = None  # what moves, in its words
    changes: tuple[NamedChange, ...] = ()  # what is taken away or put somewhere
    trail_named: bool = False  # the question speaks of a trail
    nouns: tuple[str, ...] = ()  # of the things that it names, each once
    drawings_named: frozenset[str] = frozenset()  # "arrow" and "box", where the question speaks of one
    way: WayReading = WayReading()
    kind: MotionKind | None = (
        None  # of the motion, where the words tell all of it but its direction, and name all things
    )
    others: tuple[str, ...] = ()  # the further things that it names, in its words


@dataclass(frozen=True)
class GroundingReading:
    """What a reader says of stage 1. The stage adds the point and the mask."""

    object: str
    bbox: BBox  # px of the upright image
    label: str = ""  # what the reader calls the thing in the box, if not by that name
    point: Point | None = None  # where the reader pointed, if it gave no box; by default the centre of the box
    others: tuple[LocatedObject, ...] = ()
    objects_complete: bool = False  # the others are all that could be hit or hide something
    warnings: tuple[str, ...] = ()
    place_doubts: tuple[str, ...] = ()  # why its boxes may be wrong, unless the image shows the mover there
    interventions: tuple[records.Intervention, ...] = ()
    hints: MotionHints | None = None
    prior: ObjectPrior | None = None  # of the mover
    mask: Mask | None = None  # [H, W] of the mover, where it does not follow from the box
    asked: records.Asked | None = None  # what the question wants to know; null if the reader cannot say
    changes: tuple[NamedChange, ...] = ()  # as `interventions`, of things that the request locates
    is_doubtful: bool = False  # the object in the box may not be the named one
    asked_is_doubtful: bool = False  # the words say otherwise than what is asked was read
    bbox_deviation: float = 0.0  # of all its boxes, where nothing that is seen tells their edges, in their sides
    language: Language | None = None  # of the question, as far as the reader can say


@dataclass(frozen=True)
class MotionReading:
    """What a reader says of stage 2. The stage adds speed and gravity, and the sentence where there is none."""

    kind: MotionKind
    direction: Vector | None  # any length; px of the upright image
    cue: records.Cue
    along_arrow: bool | None = None
    direction_deviation: float | None = None  # degrees; null: as is usual for the cue
    other_direction: Vector | None = None  # see `Motion.other_direction`
    depth: float = 0.0  # see `Motion.depth`
    depth_deviation: float | None = None  # degrees; null if the reader says nothing of the depth
    towards: LocatedObject | None = None  # see `Motion.towards`
    rises: bool = False  # see `Motion.rises`
    speed: SpeedWord | Quantity | None = None  # a word: as for such a thing
    distance: Quantity | None = None  # after which it is stopped
    duration: float | None = None  # s, after which it is stopped
    until: records.Until | None = None
    steps: tuple[StepReading, ...] = ()
    trail: tuple[Point, ...] = ()  # earlier positions that are shown, oldest first, px
    others: tuple[OtherMotionReading, ...] = ()
    speed_deviation: float | None = None  # of ln speed; null if nothing is said of the speed
    metres_per_pixel: records.MetresPerPixel | None = None  # null if the reader cannot tell
    down: Vector = (0.0, 1.0)  # unit vector: which way things fall in the image
    sentence: str | None = None
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True)
class Imagined:
    """What an answer may use besides the image: the simulation and its frames."""

    simulation: records.Simulation
    frames: tuple[Image, ...]  # RGB [h, w, 3] of `simulation.frames`, in their order
    factual_frames: tuple[Image, ...] = ()  # of `simulation.factual_frames`


@dataclass(frozen=True)
class AnswerReading:
    """One answer as a reader gives it: the letter of an option, or text where the question offers none."""

    answer: str | None  # null if it is not sure and no option says so
    not_sure: bool
    reasoning: str = ""  # empty if the reader does not reason in words
    notes: tuple[str, ...] = ()  # what the answer rests on or lacks, in whole sentences: warnings for the caller


class WordReader(Protocol):
    """Reads only words, without an image, weights or calls; used for every request, whatever its reader."""

    def read_question(self, question: str, names: Sequence[str] = ()) -> QuestionReading:
        """What a question says in words that it understands. `names` are those of the things that the caller gave."""
        ...

    def read_name(self, name: str) -> ObjectPrior:
        """What the name of an object says of its shape."""
        ...

    def likeness(self, words: str, name: str) -> Likeness:
        """Whether a phrase means the thing of that name.

        It does where they share a colour, noun or number and differ in none; it means another one where they differ in
        a colour, a number or a form.
        """
        ...

    def names_meant(self, words: str, names: Sequence[str]) -> tuple[str, ...]:
        """Those of some names that a phrase for several things means, such as "both mugs"; else the phrase itself."""
        ...


class Reader(Protocol):
    """Reads images for questions. Holds connections or weights, never a request; safe to use from several threads."""

    source: Source
    info: records.ReaderInfo
    """Name, model and revision. The run adds prompts and stages."""
    fingerprint: str
    """Everything that determines its results besides its inputs: model, revision, prompts, options."""

    heeds_seed: bool
    """Whether the seed of a request changes anything. Of a reader without this attribute it is taken to."""

    heeds_objections: bool
    """Whether `ReaderInput.objections` may change what it reads."""

    def repeats_answers(self, votes: int) -> bool:
        """Whether `answer` gives the same votes every time for the same input.

        Where not, its answers are samples: none is handed to two requests. Readers without this method are sampled.
        """
        ...

    def ground(self, given: ReaderInput) -> GroundingReading:
        """Which object moves and where it is. Raises `CannotGround` if that cannot be told."""
        ...

    def read_motion(self, given: ReaderInput, grounding: Grounding, hints: MotionHints | None) -> MotionReading:
        """How the grounded object moves. `hints` are those of `ground`, where this reader grounded the object.

        Raises `CannotReadDirection` if that cannot be told.
        """
        ...

    def answer(
        self,
        given: ReaderInput,
        options: Sequence[records.AnswerOption],
        grounding: Grounding | None,
        imagined: Imagined | None,
        votes: int,
    ) -> tuple[AnswerReading, ...]:
        """`votes` answers, fewer where some could not be read; without `imagined` from the image alone.

        `grounding` is what stage 1 came to, also where a later stage failed and nothing was imagined.
        """
        ...
