"""What each stage leaves behind, and the seam where whoever runs a request may keep it.

A stage's result is decided by its inputs alone: the image, what the request gives, the results of the stages before it,
and who does the work (`fingerprint`). Records hold no pixels, so that a result can be kept and found again.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from typing import Any, Protocol, TypeVar

from pydantic import BaseModel

from cow_service.records import (
    Artifact,
    Frame,
    GeneratorInfo,
    Grounding,
    Motion,
    ReaderInfo,
    Record,
    Trajectory,
    Usage,
    Verdict,
    Video,
)
from cow_service.requests import Stage

Result = TypeVar("Result", bound=Record)


class Reading(Record):
    """What a stage had a reader do; a stage that the request decides has none."""

    reader: ReaderInfo | None = None
    usage: Usage = Usage()


class Grounded(Record):
    """Stage 1 and its doubts."""

    grounding: Grounding
    warnings: tuple[str, ...]
    reading: Reading


class Moved(Record):
    """Stage 2 and its doubts."""

    motion: Motion
    warnings: tuple[str, ...]
    reading: Reading


class Traced(Record):
    """Stage 3 and what to doubt of the scene as a whole."""

    trajectory: Trajectory
    warnings: tuple[str, ...]


class Rendered(Record):
    """Stage 4: the frames as artifacts."""

    frames: tuple[Frame, ...]
    video: Video | None
    overlay: Artifact
    generator: GeneratorInfo


class Answered(Record):
    """Stage 5 and its doubts."""

    verdict: Verdict
    baseline: Verdict | None
    warnings: tuple[str, ...]
    reading: Reading


class Checkpoints(Protocol):
    """Keeps the results of one request's stages."""

    def __call__(
        self, stage: Stage, inputs: Mapping[str, Any] | None, model: type[Result], compute: Callable[[], Result]
    ) -> tuple[Result, bool]:
        """The stage's result, computed or kept, and whether it is that of another request.

        `inputs` are JSON values that decide the result; None where they are not known, so that it is nobody else's.
        """
        ...


def keep_nothing(
    stage: Stage, inputs: Mapping[str, Any] | None, model: type[Result], compute: Callable[[], Result]
) -> tuple[Result, bool]:
    """Computes every time: for runs that nobody has to pick up again."""
    return compute(), False


def digest_of(value: BaseModel | Mapping[str, Any]) -> str:
    """SHA-256 of a record, or of JSON values, the same in every process."""
    plain = value.model_dump(mode="json") if isinstance(value, BaseModel) else value
    return hashlib.sha256(json.dumps(plain, sort_keys=True, separators=(",", ":")).encode()).hexdigest()
