"""How the mover moves, along which path, and what the camera is: what a caller knows of it."""

from __future__ import annotations

import math
from typing import Annotated, Literal

from pydantic import Field, field_validator, model_validator

from cow_service.records import DIRECTED_KINDS, Law, MotionKind, Point, Record, Until, Vector
from cow_service.requests.places import ObjectWords
from cow_service.requests.values import Finite, Flags, Points

MAX_TRACKS = 1024
MAX_TRACK_POINTS = 262_144  # of all tracks together
MAX_STEPS = 16
_OF_A_LINE = ("distance", "duration", "until", "steps")
Length = Annotated[Finite, Field(gt=0, le=1_000_000)]
Seconds = Annotated[Finite, Field(gt=0, le=3600)]
Speed = Annotated[Finite, Field(ge=0, le=100_000)]


class MotionStepRequest(Record):
    """A further leg of a motion, after the one before has ended."""

    direction: tuple[Finite, Finite] = Field(description="[dx, dy] in the image, any length but zero.")
    depth: Finite = Field(default=0.0, ge=-1, le=1, description="See `Motion.depth`.")
    distance: Length | None = Field(default=None, description="px at the depth of the first frame.")
    duration: Seconds | None = Field(default=None, description="s.")

    @field_validator("direction")
    @classmethod
    def _has_length(cls, direction: Vector) -> Vector:
        return _checked(direction)


class OtherMotionRequest(Record):
    """Another object that is set moving at the first frame."""

    object: ObjectWords = Field(description="As it is named in `objects`.")
    kind: Literal["linear", "projectile", "fall"] | None = Field(
        default=None, description="By default linear; a fall takes no `direction`."
    )
    direction: tuple[Finite, Finite] | None = Field(default=None, description="[dx, dy] in the image.")
    depth: Finite = Field(default=0.0, ge=-1, le=1, description="See `Motion.depth`.")
    speed: Speed | None = Field(default=None, description="px/s; by default as for the mover.")

    @property
    def stated_kind(self) -> MotionKind:
        """The kind of motion."""
        return self.kind or "linear"

    @field_validator("direction")
    @classmethod
    def _has_length(cls, direction: Vector | None) -> Vector | None:
        return None if direction is None else _checked(direction)

    @model_validator(mode="after")
    def _goes_somewhere(self) -> OtherMotionRequest:
        if (self.direction is None) != (self.stated_kind == "fall"):
            needs = "takes no" if self.kind == "fall" else "needs a"
            raise ValueError(f"a {self.stated_kind} motion {needs} `direction`")
        return self


def _checked(direction: Vector) -> Vector:
    """A direction that has a length."""
    if not 1e-9 < math.hypot(*direction) < 1e12:
        raise ValueError(f"[dx, dy] must have a length, got {list(direction)}")
    return direction


class MotionRequest(Record):
    """Skips stage 2: how the object moves. Without `kind` and `direction` these are read from the question."""

    kind: MotionKind | None = Field(
        default=None, description="By default linear where there is a `direction`; else it is read from the question."
    )
    law: Law = Field(default="contact", description="See `Motion.law`.")
    direction: tuple[Finite, Finite] | None = Field(
        default=None,
        description="[dx, dy] in the image, any length but zero; not needed for a fall or a static object.",
    )
    depth: Finite = Field(default=0.0, ge=-1, le=1, description="See `Motion.depth`.")
    speed: Speed | None = Field(
        default=None,
        description="px/s; by default 0.26 image widths per second, and of a throw under the contact law that of a "
        "toy thrown at 1.8 m/s.",
    )
    distance: Length | None = Field(
        default=None, description="px at the depth of the first frame, after which it is stopped."
    )
    duration: Seconds | None = Field(default=None, description="s, after which it is stopped.")
    until: Until | None = Field(default=None, description="See `Motion.until`.")
    steps: tuple[MotionStepRequest, ...] = Field(
        default=(), max_length=MAX_STEPS, description="Further legs, after this one."
    )
    others: tuple[OtherMotionRequest, ...] = Field(
        default=(), max_length=MAX_STEPS, description="What is set moving at the same time."
    )
    metres_per_pixel: Annotated[Finite, Field(ge=1e-6, le=1000)] | None = Field(
        default=None, description="By default the image is taken to be 3 m wide at the object."
    )
    depth_deviation: Annotated[Finite, Field(ge=0, le=90)] | None = Field(
        default=None, description="See `Motion.depth_deviation`; 0 by default: what is given is taken as it is."
    )
    speed_deviation: Annotated[Finite, Field(ge=0, le=3)] | None = Field(
        default=None, description="See `Motion.speed_deviation`; by default 0 for a `speed` that is given."
    )

    @property
    def stated_kind(self) -> MotionKind | None:
        """The kind of motion; None where the motion is left to the reader."""
        return self.kind or ("linear" if self.direction is not None else None)

    @model_validator(mode="after")
    def _goes_somewhere(self) -> MotionRequest:
        kind = self.stated_kind
        if kind is None and (self.depth or self.depth_deviation is not None):
            raise ValueError("`depth` and `depth_deviation` need a `direction` [dx, dy]")
        if kind in DIRECTED_KINDS and self.direction is None:
            raise ValueError(f"a {kind} motion needs a `direction` [dx, dy]")
        speeds = self.direction is not None or self.speed is not None or self.speed_deviation is not None
        if kind not in (None, *DIRECTED_KINDS) and (speeds or self.depth or self.depth_deviation is not None):
            raise ValueError(f"a {kind} motion takes no `direction`, `speed` or `depth`; a throw is a `projectile`")
        lengths = [name for name in _OF_A_LINE if getattr(self, name) not in (None, ())]
        if kind not in (None, "linear") and lengths:
            raise ValueError(f"a {kind} motion takes no `{lengths[0]}`: it ends by what it meets")
        return self

    @field_validator("direction")
    @classmethod
    def _has_length(cls, direction: Vector | None) -> Vector | None:
        return None if direction is None else _checked(direction)


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


class CameraRequest(Record):
    """What the caller knows of the camera that took the image; the rest is estimated."""

    focal: Annotated[Finite, Field(ge=1, le=1_000_000)] | None = Field(default=None, description="px.")
    pitch: Annotated[Finite, Field(ge=-90, le=90)] | None = Field(
        default=None, description="Degrees that it looks down on the floor."
    )
    roll: Annotated[Finite, Field(ge=-180, le=180)] | None = Field(
        default=None, description="Degrees that the vertical leans to the left in the image."
    )

    @model_validator(mode="after")
    def _says_something(self) -> CameraRequest:
        if self.focal is None and self.pitch is None and self.roll is None:
            raise ValueError("give `focal`, `pitch` or `roll`")
        return self
