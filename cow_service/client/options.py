"""Arguments of calls besides image and question: the fields of `SimulateRequest` and `AnswerRequest`, and defaults."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from os import PathLike
from typing import TYPE_CHECKING, Any, Literal, TypedDict

if TYPE_CHECKING:
    from cow_service import records, requests
    from cow_service.records import Language, Law

DEFAULT_TIMEOUT = 60.0  # seconds without a word from the server
RETRIES = 5
CONCURRENCY = 64  # most questions of a batch at the same time

Given = Mapping[str, Any]  # a record as a plain mapping, checked by the server


class SimulateOptions(TypedDict, total=False):
    """All of `SimulateRequest` but image and question: see docs/ask.md, docs/correct.md and `cow_service.requests`.

    `law` stands for `motion.law`. The `mask` of an object may be whatever an image may be, and an array of booleans;
    the `map` of a `depth` may be that, too, an array of 16-bit integers, or one of metres, nan where nothing is known.
    """

    options: Sequence[str] | Sequence[requests.OptionRequest | Given] | None
    language: Language | None
    grounding: requests.GroundingRequest | Given | None
    motion: requests.MotionRequest | Given | None
    trajectory: requests.TrajectoryRequest | Given | None
    objects: Sequence[requests.ObjectRequest | Given] | None
    objects_complete: bool
    interventions: Sequence[requests.InterventionRequest | Given] | None
    asked: records.Asked | Given | None
    camera: requests.CameraRequest | Given | None
    depth: requests.DepthRequest | Given | None
    law: Law | None
    ensemble: int | None
    reader: str | None
    generator: str | None
    num_frames: int
    fps: float
    seed: int | None
    video: bool
    live: bool
    frames: requests.FramesRequest | Given
    generator_options: Given
    priority: requests.Priority
    webhook: str | None


class AnswerOptions(SimulateOptions, total=False):
    """As for a simulation, and how to answer from it."""

    imagine: Literal["always", "auto", "never"]
    imagine_votes: int
    imagine_threshold: float
    baseline: bool
    votes: int


class BatchSettings(TypedDict, total=False):
    """How the questions of a batch are asked; `BatchOptions` has the defaults."""

    concurrency: int
    timeout: float | None
    fresh: bool
    minimal: bool
    out: str | PathLike[str] | None
    retry_failed: bool
    only_new: bool
    save: bool
    progress: bool


class SimulateBatchOptions(SimulateOptions, BatchSettings, total=False):
    """Of a batch of simulations."""


class AnswerBatchOptions(AnswerOptions, BatchSettings, total=False):
    """Of a batch of answers."""
