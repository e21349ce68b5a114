"""The bodies of `POST /simulate` and `POST /answer`: what is said of the scene, and how to simulate and show it."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Any, Literal

from pydantic import Discriminator, Field, Tag, field_validator, model_validator

from cow_service import records
from cow_service.errors import SHOWN_CHARACTERS, FieldError, pointer_part, shortened
from cow_service.records import Finite, Flag, MaskRef, MotionRequest, Name, Reading, Record, Whole, Words


def has_more_values(value: Any, most: int) -> bool:
    """Whether a JSON value contains more than `most` values, counting nested ones. Stops counting there."""
    held = [value]
    for _ in range(most):
        if not held:
            return False
        one = held.pop()
        held.extend(one.values() if isinstance(one, dict) else one if isinstance(one, list) else ())
    return bool(held)


class LookRequest(Record):
    """Asks the server's vision models what is at a point, in a box, or which objects of a question they find.

    Without point, box and question, the image is only prepared for later requests.
    """

    image: records.ImageRef
    point: tuple[Finite, Finite] | None = Field(default=None, description="[x, y], px of the upright image.")
    bbox: records.Box | None = Field(default=None, description="[x0, y0, x1, y1], px.")
    question: Words | None = Field(default=None, min_length=1, max_length=4000)

    @model_validator(mode="after")
    def _one_place(self) -> LookRequest:
        if (self.bbox is not None) + (self.point is not None) + (self.question is not None) > 1:
            raise ValueError("give only one of `point`, `bbox` and `question`")
        return self


MAX_TRACKS = 1024
MAX_TRACK_POINTS = 262_144  # of all tracks together


class TrajectoryRequest(Record):
    """The path of the object's centre, at `fps`; it stays at the last point. Skips stage 3, trajectory."""

    points: records.Points = Field(min_length=2, max_length=4096, description="[[x, y], ...], px.")
    fps: Finite = Field(default=16, gt=0, le=240)
    visible: records.Flags | None = Field(
        default=None, max_length=4096, description="Per point inside the image: whether the object is visible."
    )
    scale: tuple[Annotated[Finite, Field(ge=0.001, le=1000)], ...] | None = Field(
        default=None, max_length=4096, description="Per point: apparent size relative to the image. By default 1."
    )
    tracks: Annotated[tuple[records.Points, ...], Field(fail_fast=True)] | None = Field(
        default=None,
        min_length=1,
        max_length=MAX_TRACKS,
        description="Paths of several points of the object, each like `points`. By default points in its mask.",
    )
    tracks_visible: Annotated[tuple[records.Flags, ...], Field(fail_fast=True)] | None = Field(
        default=None,
        max_length=MAX_TRACKS,
        description="Per track and point: whether it is visible. By default inside the image.",
    )
    anchors: records.Points | None = Field(
        default=None,
        max_length=MAX_TRACKS,
        description="Points of the background that do not move. By default spread over the image.",
    )

    @model_validator(mode="after")
    def _same_length(self) -> TrajectoryRequest:
        wanted = len(self.points)
        for name in ("visible", "scale"):
            entries = getattr(self, name)
            if entries is not None and len(entries) != wanted:
                raise ValueError(f"`{name}` has {len(entries)} entries for {wanted} `points`")
        wrong = next((len(track) for track in self.tracks or () if len(track) != wanted), None)
        if wrong is not None:
            raise ValueError(f"a track has {wrong} points where `points` has {wanted}")
        if len(self.tracks or ()) * wanted > MAX_TRACK_POINTS:
            raise ValueError(f"`tracks` holds more than {MAX_TRACK_POINTS} points")
        lengths = [wanted] * len(self.tracks or ())
        if self.tracks_visible is not None and [len(track) for track in self.tracks_visible] != lengths:
            raise ValueError("`tracks_visible` must have an entry for every point of every track")
        return self


class CameraRequest(Record):
    """What the caller knows about the camera; the rest is estimated."""

    focal: Annotated[Finite, Field(ge=1, le=1_000_000)] | None = Field(default=None, description="Focal length, px.")
    pitch: Annotated[Finite, Field(ge=-90, le=90)] | None = Field(
        default=None, description="Degrees that the camera looks down."
    )
    roll: Annotated[Finite, Field(ge=-180, le=180)] | None = Field(
        default=None, description="Degrees that the vertical leans to the left in the image."
    )

    @model_validator(mode="after")
    def _says_something(self) -> CameraRequest:
        if self.focal is None and self.pitch is None and self.roll is None:
            raise ValueError("give `focal`, `pitch` or `roll`")
        return self


class DepthRequest(Record):
    """A depth map of the image: for each pixel the distance from the camera along its optical axis."""

    map: MaskRef = Field(
        description="16-bit grey PNG of the upright image's size: the depth in units of `scale`; 0: unknown."
    )
    scale: Annotated[Finite, Field(ge=1e-9, le=1e6)] | None = Field(
        default=None, description="Metres per unit of the map; null: unknown, values are proportional to depth."
    )
    focal: Annotated[Finite, Field(ge=1, le=1_000_000)] | None = Field(
        default=None, description="Focal length of the map, px; by default the camera's."
    )
    deviation: Annotated[Finite, Field(ge=0, le=1)] = Field(
        default=0.05, description="Relative error of its depths: one standard deviation."
    )


MAX_FRAMES = 481
MAX_VALUES = 10_000  # of each field but the trajectory
Priority = Literal["low", "normal", "high"]
PRIORITIES: tuple[Priority, ...] = ("low", "normal", "high")
MAX_OPTIONS = 26
MAX_OPTION_LEVELS = 8


class OptionRequest(records.AnswerOption):
    """An answer to choose from, with its letter."""

    text: Words = Field(min_length=1, max_length=400)


def _kind_of_options(options: Any) -> str:
    """The form of the options, judged by the first one."""
    first = options[0] if isinstance(options, list | tuple) and options else None
    return "pairs" if isinstance(first, Mapping | OptionRequest) else "texts"


Options = Annotated[
    Annotated[
        tuple[Annotated[Words, Field(min_length=1, max_length=400)], ...], Field(max_length=MAX_OPTIONS), Tag("texts")
    ]
    | Annotated[tuple[OptionRequest, ...], Field(min_length=1, max_length=MAX_OPTIONS), Tag("pairs")],
    Discriminator(_kind_of_options),
]


class FramesRequest(Record):
    """Which frames of the clip to return as pictures, and how large."""

    policy: records.FramePolicy = Field(
        default="events",
        description="events: before, at and after the events that matter, and the end; uniform: evenly over the clip; "
        "initial: frames 1, 3, 5, ..., as in the paper.",
    )
    count: Whole = Field(default=4, ge=1, le=64, description="How many pictures.")
    indices: tuple[Annotated[int, Field(ge=0), records.WHOLE], ...] | None = Field(
        default=None, min_length=1, max_length=MAX_FRAMES, description="Exactly these frames; overrides the policy."
    )
    max_side: Annotated[int, Field(ge=16, le=8192), records.WHOLE] | None = Field(
        default=512, description="Longest side of the pictures, px; null for the clip's own size."
    )
    factual: Flag | None = Field(
        default=None,
        description="If an object is taken away or put elsewhere first: also make the same frames of the unchanged "
        "scene. By default only with a generator on the CPU, because a video model would take twice as long.",
    )


WAYS = ("direction", "towards", "along_arrow", "forward")  # in which a motion tells which way it leads


class SimulateRequest(Reading):
    """One image and one what-if question; everything else has a default."""

    image: records.ImageRef
    question: Words = Field(
        min_length=1,
        max_length=4000,
        description="A what-if question in English that names the moving object and its motion: 'If the red ball moves "
        "to the left, will it hit the vase?', 'If the cup falls, what does it land on?'",
    )
    options: Options | None = Field(
        default=None,
        description="Answers to choose from: texts, which get the letters A, B, C..., or texts with letters; by "
        "default those that the question lists. Used by `/answer`.",
    )
    trajectory: TrajectoryRequest | None = None
    camera: CameraRequest | None = None
    depth: DepthRequest | None = Field(
        default=None, description="A depth map, from which the floor, the camera and the objects are measured."
    )
    ensemble: Whole = Field(
        default=50,
        ge=0,
        le=500,
        description="Most simulated versions of the scene over which probabilities are counted; fewer are run once "
        "more would not change the answer. 0: no probabilities.",
    )
    reader: Name | None = Field(default=None, description="Part that understands the question; default: the server's.")
    generator: Name | None = Field(default=None, description="Part that makes the frames; default: the server's.")
    num_frames: Whole = Field(default=81, ge=2, le=MAX_FRAMES, description="Frames of the clip.")
    fps: Finite = Field(default=16, ge=1, le=60, description="Frames of the clip per second.")
    seed: Annotated[int, Field(ge=0, le=2**32 - 1), records.WHOLE] | None = Field(
        default=None,
        description="Random seed. By default 0 for the clip, and none for a multimodal LLM, whose repeats would "
        "otherwise all be the same.",
    )
    video: Flag = Field(default=True, description="Whether to make a video (mp4) of the whole clip.")
    live: Flag = Field(
        default=False,
        description="Whether the result includes the initial state of its simulated versions (`trajectory.live`), so "
        "that others can run them; the page does while you drag.",
    )
    frames: FramesRequest = FramesRequest()
    generator_options: dict[str, Any] = Field(default_factory=dict, description="Options of the generator.")
    priority: Priority = Field(default="normal", description="Order among the waiting jobs of a key, high first.")
    webhook: str | None = Field(
        default=None,
        min_length=1,
        max_length=2048,
        description="URL to call when the job has ended, signed by Standard Webhooks; only on servers with a webhook "
        "secret.",
    )

    @property
    def place(self) -> records.GroundingRequest | None:
        """Where the moving object is, if the request says so. A given trajectory begins on it."""
        if self.grounding is None and self.trajectory is not None:
            return records.GroundingRequest(point=self.trajectory.points[0])
        return self.grounding

    @property
    def left_to_reader(self) -> frozenset[str]:
        """The stages of a simulation that the request leaves to the reader."""
        needed = {"grounding"} if self.place is None else set[str]()
        given = self.trajectory is not None or self.whole_motion is not None
        return frozenset(needed if given else needed | {"motion"})

    @property
    def open_motion(self) -> MotionRequest | None:
        """What is said of a motion of which a reader says the rest."""
        return self.motion if "motion" in self.left_to_reader else None

    @property
    def whole_motion(self) -> MotionRequest | None:
        """The motion, if nothing of it is left to the reader."""
        return None if self.motion is None or not self.motion.is_whole else self.motion

    @property
    def clip_seed(self) -> int:
        """The seed of the generator."""
        return self.seed or 0

    @property
    def law(self) -> records.Law:
        """The law of the motion."""
        return MotionRequest().law if self.motion is None else self.motion.law

    @property
    def attached(self) -> tuple[MaskRef, ...]:
        """The pictures besides its image: masks, the moving object's first, and the depth map."""
        places = (*([] if self.grounding is None else [self.grounding]), *self.objects)
        masks = (place.mask for place in places if place.mask is not None)
        return (*masks, *([] if self.depth is None else [self.depth.map]))

    @field_validator("grounding", "objects")
    @classmethod
    def _has_places(cls, given: Any) -> Any:
        """Readers may name things that are still to be located; a caller says where they are."""
        for each in given if isinstance(given, tuple) else (given,):
            if each is not None and not each.has_place:
                raise ValueError(f"'{each.object or 'grounding'}' has no place: give `bbox`, `mask` or `point`")
        return given

    @field_validator("motion")
    @classmethod
    def _one_way(cls, motion: MotionRequest | None) -> MotionRequest | None:
        """Of several ways nothing would tell which one counts."""
        for each in () if motion is None else (motion, *motion.others):
            ways = [name for name in WAYS if getattr(each, name, None) is not None]
            if len(ways) > 1:
                raise ValueError(f"`{ways[0]}` and `{ways[1]}` both tell which way: give one of them")
        return motion

    @model_validator(mode="before")
    @classmethod
    def _not_too_much(cls, given: Any) -> Any:
        """Limits long lists, as each wrong element would be an error. Of a trajectory only the first is reported."""
        fields: dict[str, Any] = given if isinstance(given, dict) else {}
        for name, value in fields.items():
            if name != "trajectory" and has_more_values(value, MAX_VALUES):
                raise ValueError(
                    f"holds more than {MAX_VALUES} values in `{shortened(name)}`, more than any field needs"
                )
        return given

    @field_validator("options")
    @classmethod
    def _differ(cls, options: Options | None) -> Options | None:
        texts = [option.text if isinstance(option, OptionRequest) else option for option in options or ()]
        letters = [option.letter for option in options or () if isinstance(option, OptionRequest)]
        plain = [" ".join(text.lower().split()) for text in texts]
        if len(plain) == 1 or len(set(plain)) < len(plain):
            raise ValueError(f"options must be two or more different texts, got {texts}")
        if len(set(letters)) < len(letters):
            raise ValueError(f"options must have different letters, got {letters}")
        return options or None

    @field_validator("generator_options")
    @classmethod
    def _plain_values(cls, options: dict[str, Any]) -> dict[str, Any]:
        level: list[Any] = [*options, *options.values()]
        for _ in range(MAX_OPTION_LEVELS):
            if any(isinstance(value, float) and not math.isfinite(value) for value in level):
                raise ValueError("holds a number that is not finite")
            for text in (value for value in level if isinstance(value, str)):
                records.writable(text)
            below = [value for value in level if isinstance(value, dict | list)]
            keys = [key for value in below if isinstance(value, dict) for key in value]
            level = keys + [part for value in below for part in (value.values() if isinstance(value, dict) else value)]
        if level:
            raise ValueError(f"is nested deeper than {MAX_OPTION_LEVELS} levels")
        return options


class AnswerRequest(SimulateRequest):
    """A simulation, and how to answer from it."""

    video: Flag = Field(default=False, description="Whether to make a video (mp4) of the whole clip, too.")

    imagine: Literal["always", "auto", "never"] = Field(
        default="always",
        description="Whether to simulate before answering. never: answer from the image alone; auto: simulate only if "
        "the first answers from the image alone disagree or are unsure.",
    )
    imagine_votes: Whole = Field(
        default=3, ge=1, le=32, description="With `imagine: auto`: number of first answers from the image alone."
    )
    imagine_threshold: Finite = Field(
        default=1.0,
        gt=0,
        le=1,
        description="With `imagine: auto`: the share of those votes that an answer needs to be final.",
    )
    baseline: Flag = Field(default=False, description="Also answer without frames, for comparison.")
    votes: Whole = Field(default=1, ge=1, le=32, description="How often to ask; the most frequent answer wins.")


# --- what was wrong with a request, in words

_OURS = {"extra_forbidden": "there is no such field", "string_too_short": "is empty"}  # by pydantic's type
_HIDDEN = ("function-", "constrained-", "is-instance")
_UNION_BRANCHES = frozenset({"ImageArtifact", "ImageUrl", "str", "texts", "pairs"})


def field_errors(
    found: Sequence[Any], placed: Callable[[str], str] = lambda pointer: pointer
) -> tuple[FieldError, ...]:
    """One error per place in a pydantic error's `errors()`; `placed` maps a JSON Pointer into the request."""
    fields: dict[str, FieldError] = {}
    for item in found:
        # Without the names of union branches and validators, which callers cannot see.
        parts = [p for p in item["loc"] if not str(p).startswith(_HIDDEN) and p not in _UNION_BRANCHES]
        pointer = placed("".join("/" + pointer_part(part) for part in parts))
        detail = _with_value(_OURS.get(item["type"], str(item["msg"])), item["input"])
        if "is empty" in detail and pointer.endswith("/question"):
            detail += ". Ask, for example: 'If the red ball moves to the left, will it hit the vase?'"
        fields.setdefault(pointer, FieldError(pointer, detail))
    return tuple(fields.values())


def _with_value(message: str, value: Any) -> str:
    """A validator's message with the value. Our own messages contain it already where it helps."""
    ours = message.removeprefix("Value error, ")
    if ours != message or not isinstance(value, str | int | float):
        return ours
    reason = message.partition(", got ")[0]  # pydantic says the kind of number there, we say the number
    if isinstance(value, str) and len(value) > SHOWN_CHARACTERS:
        return f"{reason}, got {len(value)} characters"
    return f"{reason}, got {shortened(json.dumps(value))}"
