"""What calls take beside image and question: the fields of `SimulateRequest` and `AnswerRequest`; and defaults."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal, TypedDict

if TYPE_CHECKING:
    from cow_service.records import Law
    from cow_service.requests import (
        AskedRequest,
        CameraRequest,
        FramesRequest,
        GroundingRequest,
        InterventionRequest,
        MotionRequest,
        ObjectRequest,
        OptionRequest,
        Priority,
        TrajectoryRequest,
    )

DEFAULT_TIMEOUT = 60.0  # seconds without a word from the server
RETRIES = 5
CONCURRENCY = 8  # questions of a batch at the same time

Given = Mapping[str, Any]  # a record as a plain mapping, checked by the server


class SimulateOptions(TypedDict, total=False):
    """All of `SimulateRequest` but image and question; docs/http.md and `cow_service.requests` say what each means.

    `law` stands for `motion.law`. The `mask` of an object may be whatever an image may be, and an array of booleans.
    """

    options: Sequence[str] | Sequence[OptionRequest | Given] | None
    grounding: GroundingRequest | Given | None
    motion: MotionRequest | Given | None
    trajectory: TrajectoryRequest | Given | None
    objects: Sequence[ObjectRequest | Given] | None
    interventions: Sequence[InterventionRequest | Given] | None
    asked: AskedRequest | Given | None
    camera: CameraRequest | Given | None
    law: Law | None
    ensemble: int | None
    reader: str | None
    generator: str | None
    num_frames: int
    fps: float
    seed: int | None
    video: bool
    frames: FramesRequest | Given
    generator_options: Given
    priority: Priority
    webhook: str | None


class AnswerOptions(SimulateOptions, total=False):
    """As for a simulation, and how to answer from it."""

    imagine: Literal["always", "auto", "never"]
    imagine_votes: int
    imagine_threshold: float
    baseline: bool
    votes: int
