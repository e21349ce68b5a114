"""The reader's look at the image of one request: begun when a stage first needs it, one for all stages."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from typing import Any

from cow_service.readers.base import Asked, Look, Reader
from cow_service.records import Grounding, ReaderInfo, Usage
from cow_service.requests import GroundingRequest, SimulateRequest, Stage
from cow_service.stages.results import Reading
from cow_service.vision.scene import Scene


def place_of(request: SimulateRequest) -> GroundingRequest | None:
    """Where the request says the object is. A given path begins on it, so that it grounds the object too."""
    if request.grounding is None and request.trajectory is not None:
        return GroundingRequest(point=request.trajectory.points[0])
    return request.grounding


def left_to_reader(request: SimulateRequest) -> frozenset[str]:
    """The stages of a simulation that the request leaves to the reader."""
    needed = {"grounding"} if place_of(request) is None else set[str]()
    return frozenset(needed if request.motion is not None or request.trajectory is not None else needed | {"motion"})


@dataclass
class Eyes:
    """Asks the reader for whole stages, and adds up what that took."""

    request: SimulateRequest
    scene: Scene
    name: str  # of the reader
    reader: Callable[[], Reader]
    still_wanted: Callable[[Stage], None]
    elsewhere: Callable[[], AbstractContextManager[None]]
    recalled: Grounding | None = None  # what stage 1 came to where another look, or none, read it
    _readings: dict[Stage, tuple[Reading, bool]] = field(default_factory=dict[Stage, tuple[Reading, bool]])
    _asked: list[Stage] = field(default_factory=list[Stage])
    _look: Look | None = None

    def look_for(self, stage: Stage) -> Look:
        """The look, asked on behalf of a stage."""
        self._asked.append(stage)
        if self._look is None:
            asked = Asked(
                question=self.request.question,
                stages=left_to_reader(self.request),
                seed=self.request.seed,
                still_wanted=lambda: self.still_wanted(self._asked[-1]),
                elsewhere=self.elsewhere,
                recalled=self.recalled,
            )
            self._look = self.reader().look(self.scene, asked)
        return self._look

    def inputs(self) -> Mapping[str, Any] | None:
        """What decides a reading besides image and question; None where the reader does not say what it is."""
        fingerprint = getattr(self.reader(), "fingerprint", None)  # one of another package may have none
        if fingerprint is None:
            return None
        return {"reader": fingerprint, "stages": sorted(left_to_reader(self.request)), "seed": self.request.seed}

    def reading(self, stage: Stage, before: Usage) -> Reading:
        """What a stage has asked of the reader since its usage was `before`."""
        if self._look is None or stage not in self._asked:
            return Reading()
        return Reading(reader=self._look.info, usage=self._look.usage - before)

    @property
    def used(self) -> Usage:
        """What this look has asked of a multimodal LLM so far."""
        return Usage() if self._look is None else self._look.usage

    def note(self, stage: Stage, reading: Reading, *, reused: bool) -> None:
        """Remembers what a stage took; what another request asked for is not counted again."""
        if reading.reader is not None:
            self._readings[stage] = (reading, reused)

    def info(self, *stages: Stage) -> ReaderInfo:
        """Who read, and for which of some stages; a reader that none of them needed is named but was never made."""
        infos = [reading.reader for reading, _ in self._readings.values() if reading.reader is not None]
        if not infos:
            return ReaderInfo(name=self.name)
        prompts = {name: version for info in infos for name, version in info.prompts.items()}
        read = tuple(stage for stage in stages if stage in self._readings)
        return infos[-1].model_copy(update={"prompts": dict(sorted(prompts.items())), "stages": read})

    @property
    def usage(self) -> Usage:
        """What this request asked of a multimodal LLM, also for stages that failed, and before a restart."""
        before = [
            reading.usage
            for stage, (reading, reused) in self._readings.items()
            if not reused and stage not in self._asked
        ]
        return sum(before, self.used)
