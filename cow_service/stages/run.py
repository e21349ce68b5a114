"""One request being worked on: its inputs and backends, and how each stage is timed, stored and accounted for."""

import threading
import time
import uuid
from collections import abc
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager, ExitStack, contextmanager
from contextvars import copy_context
from copy import copy
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Generic, TypeVar

from pydantic import BaseModel, ValidationError

from cow_service import errors, records
from cow_service.concurrency import PrioritySemaphore
from cow_service.errors import CowError, FieldError, InvalidRequest, pointer_part
from cow_service.generators.base import Generator, Limits
from cow_service.media.artifacts import ArtifactStore, RetryPolicy, try_once
from cow_service.media.images import DecodedImage
from cow_service.observability.logging import rfc3339
from cow_service.perception.base import Perception
from cow_service.perception.observation import Observation, SeenImages, Sight
from cow_service.readers.base import CallLog, Reader, ReaderInput, WordReader, WordsReading
from cow_service.records import (
    Grounding,
    Language,
    LocatedObject,
    MotionRequest,
    ObjectRequest,
    Reading,
    Record,
    Stage,
    Usage,
)
from cow_service.requests import AnswerRequest, SimulateRequest
from cow_service.stages.keys import BackendRole, StageKey, StageResult, Value, key_of

# What reading a picture that a request attaches may end with.
UNREADABLE = (errors.ArtifactNotFound, errors.ImageTooLarge, errors.ImageTypeUnsupported, errors.ImageUnreadable)


def check_request(generator: Limits, request: SimulateRequest) -> BaseModel:
    """The generator's own options, checked, as is the length of the clip.

    Raises `InvalidRequest` with a JSON Pointer for each option that the generator does not take, for a clip that it
    cannot make, and for frames that the clip does not have.
    """
    try:
        options = generator.options_model.model_validate(request.generator_options)
    except ValidationError as error:
        known = ", ".join(sorted(generator.options_model.model_fields)) or "none"
        fields = tuple(
            FieldError("/generator_options/" + "/".join(pointer_part(part) for part in item["loc"]), item["msg"])
            for item in error.errors()
        )
        raise InvalidRequest(
            f"`generator_options` are not valid for this generator. It takes: {known}.", errors=fields
        ) from error
    if request.num_frames not in (legal := generator.nearest_lengths(request.num_frames, request.fps)):
        asked = f"{request.num_frames} frames at {request.fps:g} per second"
        able = " or ".join(f"{length} ({(length - 1) / request.fps:g} s)" for length in legal)
        detail = f"this generator makes no clip of {asked}; take {able}"
        raise InvalidRequest(f"`num_frames`: {detail}.", errors=(FieldError("/num_frames", detail),))
    last = request.num_frames - 1
    faults = tuple(
        FieldError(f"/frames/indices/{place}", f"the clip has frames 0 to {last}, got {index}")
        for place, index in enumerate(request.frames.indices or ())
        if index > last
    )
    if faults:
        raise InvalidRequest(
            f"`frames.indices` names frames that the clip does not have: it has 0 to {last}.", errors=faults
        )
    return options


ALMOST_DONE = 0.999  # of a stage whose end has not been reported

Request_co = TypeVar("Request_co", bound=SimulateRequest, covariant=True)
Progress = Callable[[Stage | None, float], None]
"""Hears how far a stage is, 0 to 1; the stage is None where none is told: while the run waits to begin, and of a stage
beside others, from another thread. What it raises ends the run."""


Compute = Callable[[], StageResult[Any]]
Step = Callable[[Stage, StageKey, Compute], tuple[StageResult[Any], bool]]
"""Runs a stage, directly or as a step whose result is stored and found again: the result, and whether another request
had computed it."""


def ignore_progress(stage: Stage | None, done: float) -> None:
    """Does nothing."""


def compute_directly(stage: Stage, key: StageKey, compute: Compute) -> tuple[StageResult[Any], bool]:
    """Computes every time: for runs that are not resumed."""
    return compute(), False


def now() -> str:
    """RFC 3339, UTC."""
    return rfc3339(time.time())


def priority_of(turn: int, created_at: str) -> str:
    """A string that sorts by turn, then by time (RFC 3339)."""
    return f"{turn:010d} {created_at}"


@dataclass(frozen=True)
class Backends:
    """Who does the work of one request. Reader and generator are loaded when a stage first needs them."""

    reader_name: str
    reader: Callable[[], Reader]
    words: Callable[[], WordReader]  # of the request, whichever reader looks at the image
    generator: Callable[[], Generator]
    artifacts: ArtifactStore
    perception: Perception
    cpu: PrioritySemaphore
    device: Callable[[], PrioritySemaphore]  # of the generator: its own, or `cpu`


@dataclass
class Run(Generic[Request_co]):
    """One request, its image, and what its stages have come to."""

    request: Request_co
    image: DecodedImage
    backends: Backends
    progress: Progress = ignore_progress
    step: Step = compute_directly
    retry_policy: RetryPolicy = try_once  # for the store of the artifacts
    id: str = field(default_factory=lambda: str(uuid.uuid4()))
    created_at: str = field(default_factory=now)
    turn: int = 0  # of the job, among those of all callers: the lower comes first
    until: float | None = None  # see `ReaderInput.until`
    sight: Sight = field(init=False)  # its looks at the image, and what other runs have seen of it
    results: dict[Stage, StageResult[Any]] = field(default_factory=dict[Stage, StageResult[Any]])
    timings: dict[str, float] = field(default_factory=dict[str, float])  # seconds per stage
    reused: list[Stage] = field(default_factory=list[Stage])  # results that another request had computed
    _calls: dict[Stage, CallLog] = field(default_factory=dict[Stage, CallLog])  # of the stages that asked the reader
    _current: tuple[Stage | None, float] = (None, 0.0)
    _beside: Future[Any] | None = None

    def __post_init__(self) -> None:
        self.share(None)

    def share(self, seen: SeenImages | None, owner: str | None = None) -> None:
        """Finds what other runs of its owner have seen in its image, and has them find what it sees. None: nothing."""
        shared = seen or SeenImages(self.backends.perception)
        self.sight = Sight(self.image.pixels, (owner, self.image.info.sha256), shared)

    def observe(self, mover: LocatedObject | Grounding, others: Sequence[LocatedObject], trails: bool) -> Observation:
        """What the image shows once it is known what moves and what else matters. To be called with `cpu` held.

        Masks are those that were stored: one that is cut again from its box may differ from what was given.
        """
        masks = tuple((each.bbox, each.mask.sha256) for each in (mover, *others) if each.mask is not None)
        boxes, read = tuple(each.bbox for each in others), self.backends.artifacts.read
        return self.sight.look_closer(mover.bbox, boxes, trails, masks, read)

    @property
    def can_segment(self) -> bool:
        """Whether the server has a segmenter."""
        return "segmenter" in self.backends.perception.names

    @property
    def wants_depth(self) -> bool:
        """Whether a depth model is to be asked: the server has one, and the request leaves it the depth."""
        request = self.request
        is_free = request.depth is None and request.trajectory is None and request.law == "contact"
        return is_free and "depth" in self.backends.perception.names

    @cached_property
    def words(self) -> WordsReading:
        """What the question says in words."""
        given = [each.object for each in self.request.objects]
        place = self.request.place
        given += [] if place is None or place.object is None else [place.object]
        return self.backends.words().read_question(self.request.question, given)

    @property
    def reader(self) -> Reader:
        """Loads the reader where it was not loaded before."""
        return self.backends.reader()

    @property
    def generator(self) -> Generator:
        """Loads the generator where it was not loaded before."""
        return self.backends.generator()

    @cached_property
    def generator_options(self) -> BaseModel:
        """The generator's options, once the request was found to be one that it can do. Raises `InvalidRequest`."""
        return check_request(self.generator, self.request)

    def check_request(self) -> None:
        """Raises `InvalidRequest` for what the generator cannot do: to be called before any work is done."""
        _ = self.generator_options

    @property
    def simulation_id(self) -> str:
        """The id of the simulation: inside an answer the same each time that the answer is computed again."""
        answering = isinstance(self.request, AnswerRequest)
        return str(uuid.uuid5(uuid.NAMESPACE_OID, self.id)) if answering else self.id

    def stage(self, name: Stage, function: Callable[..., StageResult[Value]], *inputs: Record | None) -> Value:
        """Runs one stage, `function(run, *inputs)`, through `step`, with its time, warnings and usage noted."""

        def compute() -> StageResult[Value]:
            result = function(self, *inputs)
            if name not in self._calls:
                return result
            calls = self._calls[name]
            info = self.reader.info.model_copy(update={"prompts": dict(sorted(calls.prompts.items()))})
            return result.model_copy(update={"reader": info, "usage": calls.usage})

        started = time.perf_counter()
        self.report(name, 0.0)
        key = key_of(
            name,
            self.image.info.sha256,
            self.request,
            inputs,
            self._identity,
            self.repeats_answers,
            lambda: self.reader.heeds_seed,
            self.backends.perception.identity,
        )
        try:
            result, reused = self.step(name, key, compute)
        except CowError as error:
            error.usage = self._spent()
            raise
        self.results[name] = result
        if reused:
            self.reused.append(name)
        self.timings[name] = round(time.perf_counter() - started, 4)
        self.report(name, 1.0)
        return result.value

    @contextmanager
    def beside(self, name: Stage, function: Callable[..., StageResult[Value]]) -> abc.Generator[Callable[[], Value]]:
        """Runs a stage without inputs in a thread of its own; yields the function that waits for its value.

        The stage reports no progress. Where the block ends without having waited for it, it is canceled; where it
        fails, the stages in the block end with its error, too, as soon as they report.
        """
        left = threading.Event()

        def check(_stage: Stage | None, _done: float) -> None:
            if left.is_set():
                raise errors.Canceled("The run has ended without this stage.")
            self.progress(None, 0.0)

        side = copy(self)  # with the same results, times, calls and looks
        side.progress = check
        try:
            with ThreadPoolExecutor(1, thread_name_prefix=name) as thread, ExitStack() as leaving:
                leaving.callback(left.set)
                self._beside = thread.submit(copy_context().run, side.stage, name, function)
                yield self._beside.result
        except CowError as error:
            error.usage = self._spent()
            raise
        finally:
            self._beside = None

    def report(self, name: Stage | None, done: float) -> None:
        """Says how far a stage is, 0 to 1. Raises `Canceled` if nobody wants the result, and what one beside raised."""
        self._current = name, done
        self.progress(name, done)
        if self._beside is not None and self._beside.done():
            self._beside.result()

    def report_share(self, done: float) -> None:
        """As `report`, of the current stage before its end."""
        self.report(self._current[0], min(done, ALMOST_DONE))

    def check_canceled(self) -> None:
        """Raises `Canceled` where nobody wants the result any more."""
        self.progress(*self._current)

    @property
    def priority(self) -> str:
        """Of this run where several wait to compute; the lowest comes first."""
        return priority_of(self.turn, self.created_at)

    def cpu(self) -> AbstractContextManager[None]:
        """To be held around work on the CPU. By turn, then by the time of the request; not reentrant."""
        return self.backends.cpu.held(self.priority, self.check_canceled)

    def device(self) -> AbstractContextManager[None]:
        """To be held around the work of the generator."""
        return self.backends.device().held(self.priority, self.check_canceled)

    def reader_input(
        self, stage: Stage, observation: Observation | None = None, known: Sequence[ObjectRequest] = ()
    ) -> ReaderInput:
        """What the reader is given on behalf of a stage: the image, and what the caller says, with what is `known`."""
        self._calls[stage] = CallLog()
        request = self.request
        given = Reading(
            grounding=request.grounding,
            motion=request.motion,
            objects=tuple(known),
            interventions=request.interventions,
            asked=request.asked,
        )
        return ReaderInput(
            image=self.image.pixels,
            observation=observation,
            question=request.question,
            given=given,
            motion_wanted="motion" in request.left_to_reader,
            language=self.language,
            seed=request.seed,
            until=self.until,
            calls=self._calls[stage],
            check_canceled=self.check_canceled,
            cpu=self.cpu,
        )

    @property
    def language(self) -> Language:
        """Of the narration: that of the request, else of the question as the reader read it, else English."""
        return self.request.language or (self.grounding and self.grounding.language) or "en"

    @property
    def grounding(self) -> Grounding | None:
        """What stage 1 came to, also where a later stage failed."""
        return self.results["grounding"].value if "grounding" in self.results else None

    @property
    def read_motion(self) -> MotionRequest | None:
        """What the reader said of the motion in stage 1, where that is left to it.

        Ignored otherwise: a cached grounding may carry a motion that a fresh one would not.
        """
        wanted = "motion" in self.request.left_to_reader and "grounding" in self.results
        return self.results["grounding"].motion if wanted else None

    def repeats_answers(self, votes: int) -> bool:
        """Whether the reader's answers are the same each time."""
        return self.reader.repeats_answers(votes)

    def usage(self, stages: Iterable[Stage]) -> Usage:
        """What some stages asked of a multimodal LLM, failed ones of this process included."""
        asked = (self._calls.get(stage) or self.results.get(stage) for stage in stages)
        return sum((each.usage for each in asked if each is not None), Usage())

    def _spent(self) -> dict[str, int] | None:
        """The usage for an error: what this run has asked so far; None if nothing."""
        spent = self.usage((self.results.keys() | self._calls.keys()).difference(self.reused))
        return spent.model_dump() if spent.calls else None

    def accounts(self, *stages: Stage) -> dict[str, Any]:
        """What some stages cost and took, and which of them were reused: fields of a result.

        In total, results of other requests count as if they had been computed for this one.
        """
        return {
            "usage": self.usage(stage for stage in stages if stage not in self.reused),
            "usage_total": self.usage(stages),
            "timings": {stage: self.timings[stage] for stage in stages if stage in self.timings},
            "reused": tuple(stage for stage in stages if stage in self.reused),
        }

    def reader_info(self, *stages: Stage) -> records.ReaderInfo:
        """Who read for some stages; a reader that none of them needed is named but was never loaded."""
        done = {stage: self.results[stage].reader for stage in stages if stage in self.results}
        infos = {stage: info for stage, info in done.items() if info is not None}
        if not infos:
            return records.ReaderInfo(name=self.backends.reader_name)
        prompts = {name: version for info in infos.values() for name, version in info.prompts.items()}
        told = {"prompts": dict(sorted(prompts.items())), "stages": tuple(infos)}
        return next(iter(infos.values())).model_copy(update=told)

    def warnings(self, *stages: Stage) -> tuple[str, ...]:
        """The warnings of some stages."""
        return tuple(warning for stage in stages if stage in self.results for warning in self.results[stage].warnings)

    def _identity(self, backend: BackendRole) -> dict[str, Any]:
        """All that decides the work of a backend."""
        if backend == "reader":
            return {"reader": self.reader.fingerprint}
        return {"generator": self.generator.fingerprint, "options": self.generator_options.model_dump(mode="json")}
