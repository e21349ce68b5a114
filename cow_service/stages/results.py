"""What a stage returns: one generic record, which can be stored as JSON and read again."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from typing import Any, Generic, TypeVar

from pydantic import BaseModel

from cow_service.readers.base import MotionHints
from cow_service.records import Clip, Grounding, Motion, ReaderInfo, Record, Sha256, Trajectory, Usage, Verdict
from cow_service.requests import Stage

Value = TypeVar("Value")


class StageResult(Record, Generic[Value]):
    """The value of a stage, and what belongs to it. It holds no pixels: bytes are artifacts, named by SHA-256."""

    value: Value
    warnings: tuple[str, ...] = ()
    reader: ReaderInfo | None = None  # null where the stage asked none
    usage: Usage = Usage()
    artifacts: tuple[Sha256, ...] = ()  # those that the value names
    hints: MotionHints | None = None  # of stage 1 for stage 2


class Verdicts(Record):
    """The value of stage 5: the answer, and the one from the image alone where the request wants it for comparison."""

    verdict: Verdict
    baseline: Verdict | None = None


class FirstAnswers(Record):
    """The value of the gate: the answer from the image alone, and how many votes it was asked for with."""

    verdict: Verdict | None  # null where no vote could be read
    asked: int


RESULT_TYPES: dict[Stage, type[StageResult[Any]]] = {
    "gating": StageResult[FirstAnswers],
    "grounding": StageResult[Grounding],
    "motion": StageResult[Motion],
    "trajectory": StageResult[Trajectory],
    "generation": StageResult[Clip],
    "answering": StageResult[Verdicts],
}


def digest_of(value: BaseModel | Mapping[str, Any]) -> str:
    """SHA-256 of a record, or of JSON values, the same in every process."""
    plain = value.model_dump(mode="json") if isinstance(value, BaseModel) else value
    return hashlib.sha256(json.dumps(plain, sort_keys=True, separators=(",", ":")).encode()).hexdigest()
