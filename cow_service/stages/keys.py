"""What decides a stage's result: the table from which the key of each stored result is made.

A result is decided by the image, the results of the stages before it, the fields of the request in the table, and the
backend that does the work. Two runs with the same key come to the same result, or to two samples of it where a
multimodal LLM reads: its reading of the image may be taken by other jobs, its answers never are.
"""

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Generic, Literal, TypeVar

from pydantic import BaseModel

from cow_service import __version__, records
from cow_service.perception.base import PerceptionKind
from cow_service.readers.prompts import load_prompt
from cow_service.records import MotionRequest, Record, Simulation, Stage, Usage, Verdict
from cow_service.requests import DepthRequest, SimulateRequest

Value = TypeVar("Value")


class StageResult(Record, Generic[Value]):
    """The value of a stage, and what belongs to it. It holds no pixels: bytes are artifacts, named by SHA-256."""

    value: Value
    warnings: tuple[str, ...] = ()
    reader: records.ReaderInfo | None = None  # null where the stage asked none
    usage: Usage = Usage()
    artifacts: tuple[records.Sha256, ...] = ()  # those that the value names
    motion: MotionRequest | None = None  # of stage 1 for stage 2: what the reader said of it


class EstimatedDepth(Record):
    """The value of the stage `depth`: what a depth model makes of the image, as a caller would give it."""

    depth: DepthRequest | None  # null where nothing of it can be used


class FirstAnswers(Record):
    """The value of the gate and of the baseline: the answer from the image alone, and how many votes were asked for."""

    verdict: Verdict | None  # null where no vote could be read
    asked: int


RESULT_TYPES: dict[Stage, type[StageResult[Any]]] = {
    "gating": StageResult[FirstAnswers],
    "baseline": StageResult[FirstAnswers],
    "grounding": StageResult[records.Grounding],
    "depth": StageResult[EstimatedDepth],
    "motion": StageResult[records.Motion],
    "trajectory": StageResult[records.Trajectory],
    "generation": StageResult[records.Clip],
    "answering": StageResult[Verdict],
}


def digest_of(values: Mapping[str, Any]) -> str:
    """SHA-256 of JSON values, the same in every process."""
    return hashlib.sha256(json.dumps(values, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


BackendRole = Literal["reader", "generator"]
FORMAT = 21  # of stored results; raised where what a stage means or stores changes


@dataclass(frozen=True)
class StageKey:
    """Names a stage's result."""

    digest: str  # SHA-256, hexadecimal
    shareable: bool = True  # False: this job's alone, since it is sampled, or its backend does not say what decides it
    also: tuple[str, ...] = ()  # digests of other requests' results that say all that this one would


@dataclass(frozen=True)
class KeyFields:
    """Names of what decides one stage, all of them attributes of the request."""

    fields: tuple[str, ...]
    backend: BackendRole | None = None
    set_by_request: tuple[str, ...] = ()  # where the request sets one of these, no reader is asked: they decide ...
    always: tuple[str, ...] = ()  # ... together with these, which decide in either case
    prompt: str | None = None  # whose version decides, too
    votes: str | None = None  # the field that says how many answers are drawn, of the stages that draw answers
    perception: tuple[PerceptionKind, ...] = ()  # kinds of models that decide, where the server has them
    read_with: str | None = None  # a stage: where the reader reads for it, too, it says no less of this one


TRAJECTORY_FIELDS = (
    *("grounding", "motion", "trajectory", "objects_complete", "camera", "depth", "ensemble", "num_frames", "fps"),
    "live",
)
KEY_FIELDS: dict[Stage, KeyFields] = {
    "gating": KeyFields(("question", "language", "seed", "options", "imagine_votes"), "reader", votes="imagine_votes"),
    "baseline": KeyFields(("question", "language", "seed", "options", "votes"), "reader", votes="votes"),
    "grounding": KeyFields(
        ("seed", "left_to_reader", "open_motion"),
        "reader",
        set_by_request=("place",),
        always=("question", "question_is_doubtful", "asked", "objects", "objects_complete", "interventions"),
        perception=("finder", "detector", "segmenter"),
        # The reader is asked the same of the place; hints for the motion are not used where the request gives it.
        read_with="motion",
    ),
    "motion": KeyFields(
        ("question", "seed", "left_to_reader"),
        "reader",
        set_by_request=("whole_motion", "trajectory"),
        always=("question", "law", "motion", "camera", "depth"),
        prompt="motion-sentence",
        perception=("finder",),
    ),
    "depth": KeyFields((), perception=("depth",)),
    "trajectory": KeyFields(TRAJECTORY_FIELDS, perception=("finder",)),
    "generation": KeyFields(("clip_seed", "frames", "video"), "generator", perception=("finder", "inpainter")),
    "answering": KeyFields(("question", "language", "seed", "options", "votes"), "reader", votes="votes"),
}
# Of a simulation its id and times do not decide an answer.
_SIMULATION_FIELDS = {"grounding", "motion", "trajectory", "frames", "factual_frames"}


def key_of(
    stage: Stage,
    image_sha256: str,
    request: SimulateRequest,
    inputs: tuple[Record | None, ...],
    identity_of: Callable[[BackendRole], Mapping[str, Any] | None],
    repeats_answers: Callable[[int], bool],
    heeds_seed: Callable[[], bool] = lambda: True,
    perceives: Callable[[Sequence[PerceptionKind]], Mapping[str, str]] = lambda kinds: {},
) -> StageKey:
    """The key of a stage's result. `inputs` are the results of stages before it.

    `identity_of` a backend is all that decides its work, as JSON values, or None where it does not say; it is asked
    only where the table names a backend. `repeats_answers` is that of the reader, asked where answers are drawn;
    `heeds_seed` where it reads: of rules, a request with another seed finds the same. `perceives` says what decides
    the work of the server's models of some kinds.
    """
    decided = KEY_FIELDS[stage]
    parts: dict[str, Any] = {
        "format": FORMAT,
        "version": __version__,
        "stage": stage,
        "image": image_sha256,
        "inputs": [_digest(value) for value in inputs],
        "prompt": None if decided.prompt is None else load_prompt(decided.prompt).version,
        "always": {name: _plain(getattr(request, name)) for name in decided.always},
    }
    if decided.perception and (models := perceives(decided.perception)):
        parts["perception"] = dict(models)
    given = {name: _plain(value) for name in decided.set_by_request if (value := getattr(request, name)) is not None}
    if given:
        return StageKey(digest_of(parts | {"given": given}))
    parts["request"] = {name: _plain(getattr(request, name)) for name in decided.fields}
    if decided.backend is None:
        return StageKey(digest_of(parts))
    identity = identity_of(decided.backend)
    if decided.backend == "reader" and not heeds_seed():
        del parts["request"]["seed"]
    sampled = decided.votes is not None and not repeats_answers(getattr(request, decided.votes))
    parts["backend"] = identity
    # The same stage where one more is left to the reader, unless the request leaves it that, too.
    left: list[str] = parts["request"].get("left_to_reader", [])
    also: tuple[str, ...] = ()
    if decided.read_with is not None and decided.read_with not in left:
        more = parts["request"] | {"left_to_reader": sorted([*left, decided.read_with])}
        also = (digest_of(parts | {"request": more}),)
    return StageKey(digest_of(parts), identity is not None and not sampled, also)


def _digest(value: Record | None) -> str | None:
    if value is None:
        return None
    included = _SIMULATION_FIELDS if isinstance(value, Simulation) else None
    return hashlib.sha256(value.model_dump_json(include=included).encode()).hexdigest()


def _plain(value: Any) -> Any:
    if isinstance(value, tuple):
        return [_plain(part) for part in value]
    if isinstance(value, frozenset):
        return sorted(value)
    return value.model_dump(mode="json") if isinstance(value, BaseModel) else value
