"""The bodies of `POST /simulate` and `POST /answer`."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import Discriminator, Field, Tag, field_validator

from cow_service.records import AnswerOption, FramePolicy, Law, Record
from cow_service.requests.motion import CameraRequest, MotionRequest, TrajectoryRequest
from cow_service.requests.places import MAX_OBJECTS, AskedRequest, GroundingRequest, InterventionRequest, ObjectRequest
from cow_service.requests.values import Finite, Flag, ImageRef, MaskRef, Name, Whole, Words, writable

MAX_FRAMES = 481
Priority = Literal["low", "normal", "high"]
PRIORITIES: tuple[Priority, ...] = ("low", "normal", "high")
MAX_OPTIONS = 26
MAX_OPTION_LEVELS = 8


class OptionRequest(AnswerOption):
    """An answer to choose from, with its letter."""

    text: Words = Field(min_length=1, max_length=400)


def _kind_of_options(options: Any) -> str:
    """Which of the two forms they have, by the first of them."""
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

    policy: FramePolicy = Field(
        default="initial",
        description="initial: frames 1, 3, 5, ...; uniform: evenly over the clip; "
        "events: at encounters and on the way.",
    )
    count: Whole = Field(default=3, ge=1, le=64)
    indices: tuple[Annotated[Whole, Field(ge=0)], ...] | None = Field(
        default=None, min_length=1, max_length=MAX_FRAMES, description="Exactly these frames; overrides the policy."
    )
    max_side: Annotated[Whole, Field(ge=16, le=8192)] | None = Field(
        default=512, description="Longest side of the pictures, px; null for the clip's own size."
    )
    factual: Flag | None = Field(
        default=None,
        description="Where something is taken away, or put elsewhere first: also the same frames of the scene as it "
        "is. By default only of a generator on the CPU: a video model takes as long for them as for the clip.",
    )


class SimulateRequest(Record):
    """One image and one what-if question; everything else has a default."""

    image: ImageRef
    question: Words = Field(min_length=1, max_length=4000)
    options: Options | None = Field(
        default=None,
        description="Answers to choose from: texts, which get the letters A, B, C..., or each with a letter of its "
        "own; by default those that the question lists. Used by `/answer`.",
    )
    grounding: GroundingRequest | None = None
    motion: MotionRequest | None = None
    trajectory: TrajectoryRequest | None = None
    objects: tuple[ObjectRequest, ...] = Field(
        default=(),
        max_length=MAX_OBJECTS,
        description="Other objects of the image: they come before what the reader finds there.",
    )
    interventions: tuple[InterventionRequest, ...] = Field(
        default=(),
        max_length=8,
        description="What is taken away or put somewhere before the motion, beside the question's.",
    )
    asked: AskedRequest | None = Field(
        default=None, description="What the question wants to know; by default it is read from the question."
    )
    camera: CameraRequest | None = None
    ensemble: Whole = Field(
        default=50,
        ge=0,
        le=500,
        description="How many worlds the probabilities are counted in; 0: none, and no probabilities.",
    )
    reader: Name | None = Field(default=None, description="By default the server's.")
    generator: Name | None = Field(default=None, description="By default the server's.")
    num_frames: Whole = Field(default=81, ge=2, le=MAX_FRAMES)
    fps: Finite = Field(default=16, ge=1, le=60)
    seed: Annotated[Whole, Field(ge=0, le=2**32 - 1)] | None = Field(
        default=None,
        description="Of all random numbers. By default 0 for the clip, and none for a multimodal LLM: a provider that "
        "heeds seeds would give every repeat the same reply.",
    )
    video: Flag = Field(default=True, description="Whether to make the mp4 of the whole clip.")
    frames: FramesRequest = FramesRequest()
    generator_options: dict[str, Any] = Field(default_factory=dict, description="As the generator defines them.")
    priority: Priority = Field(
        default="normal",
        description="Among the jobs that wait with the same API key: the higher come first. The share of the key stays "
        "what it is.",
    )
    webhook: str | None = Field(
        default=None,
        min_length=1,
        max_length=2048,
        description="URL to call when the job has ended, signed as Standard Webhooks says; off unless the server has a "
        "secret for it.",
    )

    @property
    def place(self) -> GroundingRequest | None:
        """Where the object is, as far as the request says: a given trajectory begins on it, so it grounds it, too."""
        if self.grounding is None and self.trajectory is not None:
            return GroundingRequest(point=self.trajectory.points[0])
        return self.grounding

    @property
    def left_to_reader(self) -> frozenset[str]:
        """The stages of a simulation that the request leaves to the reader."""
        needed = {"grounding"} if self.place is None else set[str]()
        given = self.stated_motion is not None or self.trajectory is not None
        return frozenset(needed if given else needed | {"motion"})

    @property
    def clip_seed(self) -> int:
        """The seed of the generator."""
        return self.seed or 0

    @property
    def law(self) -> Law:
        """The law of the motion, whoever reads it."""
        return MotionRequest().law if self.motion is None else self.motion.law

    @property
    def stated_motion(self) -> MotionRequest | None:
        """The motion, where the request says more of it than its law."""
        return None if self.motion is None or self.motion.stated_kind is None else self.motion

    @property
    def changed_names(self) -> tuple[str, ...]:
        """The names of all objects of its interventions, each once."""
        named = (name for each in self.interventions for name in (each.object, *each.targets))
        return tuple(dict.fromkeys(named))

    @property
    def masks(self) -> tuple[MaskRef, ...]:
        """The masks that it gives, the mover's first."""
        places = (*([] if self.grounding is None else [self.grounding]), *self.objects)
        return tuple(place.mask for place in places if place.mask is not None)

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
                writable(text)
            below = [value for value in level if isinstance(value, dict | list)]
            keys = [key for value in below if isinstance(value, dict) for key in value]
            level = keys + [part for value in below for part in (value.values() if isinstance(value, dict) else value)]
        if level:
            raise ValueError(f"is nested deeper than {MAX_OPTION_LEVELS} levels")
        return options


class AnswerRequest(SimulateRequest):
    """As a simulation, and how to answer from it."""

    video: Flag = Field(default=False, description="Whether to make the mp4 of the whole clip, too.")

    imagine: Literal["always", "auto", "never"] = Field(
        default="always",
        description="never: answer from the image alone, without a simulation; auto: only where the first answers from "
        "the image alone disagree, or are not sure.",
    )
    imagine_votes: Whole = Field(
        default=3, ge=1, le=32, description="Of `imagine: auto`: how often to ask before anything is imagined."
    )
    imagine_threshold: Finite = Field(
        default=1.0,
        gt=0,
        le=1,
        description="Of `imagine: auto`: the share of those votes that the leading answer must have to be taken as it "
        "is.",
    )
    baseline: Flag = Field(default=False, description="Answer without frames, too, for comparison.")
    votes: Whole = Field(default=1, ge=1, le=32, description="How often to ask; the most frequent answer is taken.")


Stage = Literal["gating", "grounding", "motion", "trajectory", "generation", "answering"]
