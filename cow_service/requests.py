"""What a caller may ask: the bodies of `POST /simulate` and `POST /answer`. Checked once, here, then trusted."""

from __future__ import annotations

import json
import math
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BeforeValidator, Field, field_validator, model_validator

from cow_service.records import DIRECTED_KINDS, BBox, FramePolicy, MotionKind, Point, Record, Sha256, Vector

MAX_FRAMES = 481
MAX_TRACKS = 1024
MAX_TRACK_POINTS = 262_144  # of all tracks together
MAX_NAME = 100  # characters of a backend's name
MAX_OPTION_LEVELS = 8


def _number(value: Any) -> Any:
    """Numbers only: `true` is not 1 and "81" is not 81, but 81.0 is 81."""
    if isinstance(value, bool | str):
        raise ValueError(f"must be a number, without quotes, got {json.dumps(value)[:40]}")
    return value


def _writable(text: str) -> str:
    """Text that every database and file can hold."""
    if "\0" in text:
        raise ValueError(f"holds the character NUL (U+0000) at position {text.index(chr(0))}; leave it out")
    return text


def _says_something(text: str) -> str:
    """Text with at least one character to be seen: zero-width and control characters are none."""
    if not any(character.isprintable() and not character.isspace() for character in text):
        raise ValueError(f"is empty: it holds only {len(text)} blank or invisible characters")
    return text


Finite = Annotated[float, Field(strict=True, allow_inf_nan=False)]  # strict: no strings, no booleans
Whole = Annotated[int, BeforeValidator(_number)]
Flag = Annotated[bool, Field(strict=True)]
Words = Annotated[str, AfterValidator(_writable), AfterValidator(_says_something)]
Name = Annotated[str, Field(max_length=MAX_NAME)]
# Of a long list the first wrong element is told: the others would fill the memory.
Points = Annotated[tuple[tuple[Finite, Finite], ...], Field(fail_fast=True)]
Flags = Annotated[tuple[Flag, ...], Field(fail_fast=True)]


class ImageArtifact(Record):
    """An image that the service already keeps."""

    artifact: Sha256


class ImageUrl(Record):
    """An image to be fetched; off unless the server allows it."""

    url: str = Field(max_length=4096)


ImageRef = Annotated[str, Field(description="data:image/png;base64,... (PNG, JPEG or WebP)")] | ImageArtifact | ImageUrl


class GroundingRequest(Record):
    """Skips stage 1: the object's box, or a point on it, from which the box is cut."""

    object: Annotated[Words, Field(min_length=1, max_length=200)] | None = None
    bbox: tuple[Finite, Finite, Finite, Finite] | None = Field(default=None, description="[x0, y0, x1, y1], px.")
    point: tuple[Finite, Finite] | None = Field(default=None, description="[x, y], px.")

    @model_validator(mode="after")
    def _one_place(self) -> GroundingRequest:
        if (self.bbox is None) == (self.point is None):
            raise ValueError("give either `bbox` or `point`")
        return self

    @field_validator("bbox")
    @classmethod
    def _has_area(cls, bbox: BBox | None) -> BBox | None:
        if bbox is not None and (bbox[2] - bbox[0] < 2 or bbox[3] - bbox[1] < 2):
            raise ValueError(f"[x0, y0, x1, y1] must span at least 2 px each way, got {list(bbox)}")
        return bbox


class MotionRequest(Record):
    """Skips stage 2: how the object moves."""

    kind: MotionKind = "linear"
    direction: tuple[Finite, Finite] | None = Field(
        default=None,
        description="[dx, dy] in the image, any length but zero; not needed for a fall or a static object.",
    )
    depth: Finite = Field(default=0.0, ge=-1, le=1, description="See `Motion.depth`.")
    speed: Annotated[Finite, Field(ge=0, le=100_000)] | None = Field(
        default=None, description="px/s; by default 0.26 image widths per second."
    )
    metres_per_pixel: Annotated[Finite, Field(ge=1e-6, le=1000)] | None = Field(
        default=None, description="By default the image is taken to be 3 m wide at the object."
    )

    @model_validator(mode="after")
    def _goes_somewhere(self) -> MotionRequest:
        if self.kind in DIRECTED_KINDS and self.direction is None:
            raise ValueError(f"a {self.kind} motion needs a `direction` [dx, dy]")
        if self.kind not in DIRECTED_KINDS and (self.direction is not None or self.speed is not None or self.depth):
            raise ValueError(
                f"a {self.kind} motion takes no `direction`, `speed` or `depth`; a throw is a `projectile`"
            )
        return self

    @field_validator("direction")
    @classmethod
    def _has_length(cls, direction: Vector | None) -> Vector | None:
        if direction is not None and not 1e-9 < math.hypot(*direction) < 1e12:
            raise ValueError(f"[dx, dy] must have a length, got {list(direction)}")
        return direction


class TrajectoryRequest(Record):
    """Skips stage 3: where the object's centre is, at `fps`. After the last point it stays there."""

    points: Points = Field(min_length=2, max_length=4096, description="[[x, y], ...], px.")
    fps: Finite = Field(default=16, gt=0, le=240)
    visible: Flags | None = Field(
        default=None, max_length=4096, description="Per point inside the image: the object can be seen there."
    )
    tracks: Annotated[tuple[Points, ...], Field(fail_fast=True)] | None = Field(
        default=None,
        min_length=1,
        max_length=MAX_TRACKS,
        description="Paths of several points of the object, each like `points`. By default points in its mask.",
    )
    tracks_visible: Annotated[tuple[Flags, ...], Field(fail_fast=True)] | None = Field(
        default=None,
        max_length=MAX_TRACKS,
        description="Per track and point: it can be seen. By default inside the image.",
    )
    anchors: Points | None = Field(
        default=None,
        max_length=MAX_TRACKS,
        description="Points that stay where they are. By default spread over the image.",
    )

    @field_validator("points", "anchors")
    @classmethod
    def _near_the_image(cls, points: tuple[Point, ...] | None) -> tuple[Point, ...] | None:
        far = next((point for point in points or () if max(abs(point[0]), abs(point[1])) > 1e6), None)
        if far is not None:
            raise ValueError(f"points lie at most 1,000,000 px from the image, got {list(far)}")
        return points

    @field_validator("tracks")
    @classmethod
    def _tracks_near_the_image(
        cls, tracks: tuple[tuple[Point, ...], ...] | None
    ) -> tuple[tuple[Point, ...], ...] | None:
        for track in tracks or ():
            cls._near_the_image(track)
        return tracks

    @model_validator(mode="after")
    def _same_length(self) -> TrajectoryRequest:
        wanted = len(self.points)
        if self.visible is not None and len(self.visible) != wanted:
            raise ValueError(f"`visible` has {len(self.visible)} entries for {wanted} `points`")
        wrong = next((len(track) for track in self.tracks or () if len(track) != wanted), None)
        if wrong is not None:
            raise ValueError(f"a track has {wrong} points where `points` has {wanted}")
        if len(self.tracks or ()) * wanted > MAX_TRACK_POINTS:
            raise ValueError(f"`tracks` holds more than {MAX_TRACK_POINTS} points")
        if self.tracks_visible is not None and [len(t) for t in self.tracks_visible] != [wanted] * len(
            self.tracks or ()
        ):
            raise ValueError("`tracks_visible` must have an entry for every point of every track")
        return self


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


class SimulateRequest(Record):
    """One image and one what-if question; everything else has a default."""

    image: ImageRef
    question: Words = Field(min_length=1, max_length=4000)
    options: tuple[Annotated[Words, Field(min_length=1, max_length=400)], ...] | None = Field(
        default=None,
        max_length=26,
        description="Answers to choose from, lettered A, B, C...; by default those that the question lists. "
        "Used by `/answer`.",
    )
    grounding: GroundingRequest | None = None
    motion: MotionRequest | None = None
    trajectory: TrajectoryRequest | None = None
    reader: Name | None = Field(default=None, description="By default the server's.")
    generator: Name | None = Field(default=None, description="By default the server's.")
    num_frames: Whole = Field(default=81, ge=2, le=MAX_FRAMES)
    fps: Finite = Field(default=16, ge=1, le=60)
    seed: Whole = Field(default=0, ge=0, le=2**32 - 1)
    video: Flag = Field(default=True, description="Whether to make the mp4 of the whole clip.")
    frames: FramesRequest = FramesRequest()
    generator_options: dict[str, Any] = Field(default_factory=dict, description="As the generator defines them.")
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
        return frozenset(needed if self.motion is not None or self.trajectory is not None else needed | {"motion"})

    @field_validator("options")
    @classmethod
    def _differ(cls, options: tuple[str, ...] | None) -> tuple[str, ...] | None:
        plain = [" ".join(option.lower().split()) for option in options or ()]
        if len(plain) == 1 or len(set(plain)) < len(plain):
            raise ValueError(f"options must be two or more different texts, got {list(options or ())}")
        return options or None

    @field_validator("generator_options")
    @classmethod
    def _plain_values(cls, options: dict[str, Any]) -> dict[str, Any]:
        level: list[Any] = [*options, *options.values()]
        for _ in range(MAX_OPTION_LEVELS):
            if any(isinstance(value, float) and not math.isfinite(value) for value in level):
                raise ValueError("holds a number that is not finite")
            for text in (value for value in level if isinstance(value, str)):
                _writable(text)
            below = [value for value in level if isinstance(value, dict | list)]
            keys = [key for value in below if isinstance(value, dict) for key in value]
            level = keys + [part for value in below for part in (value.values() if isinstance(value, dict) else value)]
        if level:
            raise ValueError(f"is nested deeper than {MAX_OPTION_LEVELS} levels")
        return options


class AnswerRequest(SimulateRequest):
    """As a simulation, and how to answer from it."""

    video: Flag = Field(default=False, description="Whether to make the mp4 of the whole clip, too.")

    imagine: Literal["always", "never"] = Field(
        default="always", description="never: answer from the image alone, without a simulation."
    )
    baseline: Flag = Field(default=False, description="Answer without frames, too, for comparison.")
    votes: Whole = Field(default=1, ge=1, le=32, description="How often to ask; the most frequent answer is taken.")


Stage = Literal["grounding", "motion", "trajectory", "generation", "answering"]
