"""What is shown beside a question in each arm of an evaluation, and the simulations that it takes."""

import asyncio
import hashlib
import time
from collections.abc import Awaitable, Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from cow_service.adaptive import AdaptivePlaces
from cow_service.client import AsyncClient, AsyncSimulation
from cow_service.client.errors import Canceled
from cow_service.errors import CannotGround, CannotReadDirection, CowError, MllmBadReply
from cow_service.evals.design import Arm
from cow_service.evals.items import Item, Pictures, Truth, question_text
from cow_service.media.images import decode, decode_own, encode_png
from cow_service.readers.mllm.contents import as_large_as, facts_of, opposite_motion
from cow_service.records import Usage

MAX_INTERRUPTS = 20  # of one run, each of which may have canceled the same job
PATH_SAMPLES = 2000  # between which the nearest point of a path is looked for
MAX_DONORS = 8  # scenes that are tried for frames of another scene
NO_USAGE = Usage()
# What an image and a question may come to: nothing is imagined, and the question is asked without. All else is a fault.
REFUSALS = (CannotGround, CannotReadDirection, MllmBadReply)
Result = TypeVar("Result")


async def asked_once(
    places: AdaptivePlaces, parts: Sequence[str], ask: Callable[..., Awaitable[Result]], *given: Any, **options: Any
) -> Result:
    """What `ask` returns for these arguments and an `idempotency_key` of these parts; it holds a place meanwhile.

    A job that an interrupt has canceled stays so under its key: then there is another key. Raises what `ask` raises.
    """
    for attempt in range(MAX_INTERRUPTS):
        key = hashlib.sha256("\n".join((*parts, str(attempt))).encode()).hexdigest()
        try:
            async with places.held() as call:
                result = await ask(*given, idempotency_key=key, **options)
                call.succeeded = True
                return result
        except Canceled:
            continue
    raise Canceled(f"The same job was canceled {MAX_INTERRUPTS} times.")


@dataclass(frozen=True)
class Evidence:
    """What there is to show beside the image of an item. It holds no pixels."""

    frames: tuple[str, ...] = ()  # digests
    overlay: str | None = None
    facts: tuple[str, ...] = ()  # what the simulation found, in words
    probability: float | None = None  # that what the question asks happens
    event_shown: bool | None = None  # whether a frame shows the moment of what is asked, or later; None: no such moment
    path_error: float | None = None  # of the path that is shown, as a share of the image's width
    refusal: CowError | None = None  # why there is nothing
    usage: Usage = NO_USAGE
    seconds: float = 0.0  # of its stages, without waiting for a place
    simulated: bool = False


@dataclass
class Imagination:
    """Simulations of items, from one server. For one event loop."""

    client: AsyncClient
    places: AdaptivePlaces  # for requests of the client
    pictures: Pictures
    options: Mapping[str, Any]  # fields of the requests
    key: str  # of the run: the same run never asks the same twice
    items: Sequence[Item]  # of the run; some may lend their frames to others
    _found: dict[tuple[str, Arm, int], asyncio.Task[Evidence]] = field(default_factory=dict)

    async def evidence(self, item: Item, arm: Arm, trial: int = 0) -> Evidence:
        """What to show of an item. `trial` counts simulations of the same, which differ by their seed.

        Raises the `CowError` for which a simulation failed, but for refusals: those are part of the evidence.
        """
        # What is shown does not depend on how often it is asked about.
        place = item.id, arm.model_copy(update={"votes": 1, "gate": False, "image": True}), trial
        if place not in self._found:
            self._found[place] = asyncio.ensure_future(self._make(*place[1:], item))
        try:
            return await asyncio.shield(self._found[place])
        except CowError:
            self._found.pop(place, None)
            raise

    async def _make(self, arm: Arm, trial: int, item: Item) -> Evidence:
        if arm.content == "none":
            return Evidence()
        begun = time.monotonic()
        try:
            return await kept(await self._shown(arm, trial, item), self.client, self.pictures)
        except REFUSALS as refusal:
            usage = Usage.model_validate(refusal.usage or {})
            return Evidence(refusal=refusal, usage=usage, seconds=time.monotonic() - begun)

    async def _shown(self, arm: Arm, trial: int, item: Item) -> Evidence:
        """Every content begins with the simulation: a placebo has as many pictures as there would be of it, or none."""
        if arm.content == "true":
            return await self._truth(arm, trial, item)
        simulation = await self._simulate(item, arm, trial)
        found = evidence_of(simulation)
        if arm.content == "simulated":
            track = () if item.truth is None else item.truth.track
            if len(track) < 2:
                return found
            width = decode(self.pictures.read(item.image)).pixels.shape[1]
            return replace(found, path_error=_distance(np.array(track), simulation) / width)
        if arm.content == "text":
            return replace(found, frames=(), facts=facts_of(simulation), event_shown=None)
        found = replace(found, probability=None, event_shown=None, overlay=None)
        if arm.content == "still":
            pixels = decode(self.pictures.read(item.image)).pixels
            still = self.pictures.add_made(_sized(pixels, simulation))
            return replace(found, frames=(still,) * len(found.frames), simulated=False)
        # Of a placebo the same moments are shown: other moments would be another difference.
        moments = {"max_side": arm.size, "indices": [frame.index for frame in simulation.frames]}
        if arm.content == "other-item":
            other = await self._of_another(arm, trial, item, simulation, moments)
        else:
            changed = await self._simulate(item, arm, trial, motion=opposite_motion(simulation), frames=moments)
            other = evidence_of(changed)
        usage, seconds = found.usage + other.usage, found.seconds + other.seconds
        return replace(other, probability=None, event_shown=None, overlay=None, usage=usage, seconds=seconds)

    async def _of_another(
        self, arm: Arm, trial: int, item: Item, simulation: AsyncSimulation, moments: dict[str, Any]
    ) -> Evidence:
        """Frames of another scene at these moments, as large as those of this one.

        Of the others, in an order of the item's own, the first that can be simulated. Raises `CannotGround` where none
        of several can.
        """

        def rank(other: Item) -> bytes:
            return hashlib.sha256(f"{item.id}\n{trial}\n{other.id}".encode()).digest()

        for other in sorted((each for each in self.items if each.scene != item.scene), key=rank)[:MAX_DONORS]:
            with suppress(*REFUSALS):
                lent = await self._simulate(other, arm, 0, frames=moments)
                found = await kept(replace(evidence_of(lent), overlay=None), self.client, self.pictures)
                pixels = (decode_own(self.pictures.read(frame)) for frame in found.frames)
                return replace(found, frames=tuple(self.pictures.add_made(_sized(each, simulation)) for each in pixels))
        raise CannotGround(f"None of {MAX_DONORS} other scenes could be simulated.")

    async def _truth(self, arm: Arm, trial: int, item: Item) -> Evidence:
        """What really happens, at the moments that the simulation's frames show; without one, at moments of its own.

        Drawn along the true path, or of the true pictures those that are nearest to the simulation's moments.
        """
        truth, simulation = item.truth or Truth(), None
        with suppress(*REFUSALS):
            simulation = await self._simulate(item, arm, trial)
        try:
            return await self._along(simulation, arm, item)
        except REFUSALS:
            if simulation is None or not truth.pictures:
                raise
        nearest = [min(truth.pictures, key=lambda known: abs(known[0] - frame.time)) for frame in simulation.frames]
        pixels = (decode(self.pictures.read(digest)).pixels for _, digest in nearest)
        shown = tuple(self.pictures.add_made(_sized(each, simulation)) for each in pixels)
        found = replace(evidence_of(simulation), probability=None, event_shown=None, overlay=None)
        return replace(found, frames=shown, path_error=0.0)

    async def _along(self, simulation: AsyncSimulation | None, arm: Arm, item: Item) -> Evidence:
        """Frames that the generator draws along the true path.

        They show the moments of the simulation's frames; after the end of what is known, that end. Raises
        `CannotGround` where no true path is known.
        """
        truth, indices = item.truth or Truth(), None
        if len(truth.track) < 2:
            raise CannotGround("No true path is known.")
        fps, points, frames = truth.fps, np.array(truth.track), arm.frames_request
        if simulation is not None:
            fps = simulation.trajectory.fps
            points = _at_rate(points, truth.fps, fps)
            indices = [min(frame.index, len(points) - 1) for frame in simulation.frames]
            frames = {"max_side": arm.size, "indices": sorted(set(indices))}
        # How it moves is known, so it need not be read.
        path: dict[str, Any] = {"points": points.round(2).tolist(), "fps": fps}
        if truth.scale:
            path["scale"] = _at_rate(np.array(truth.scale)[:, None], truth.fps, fps)[:, 0].round(4).tolist()
        given: dict[str, Any] = {"motion": {"kind": "static"}, "trajectory": path}
        if truth.object is not None and truth.object in truth.boxes:
            objects = [{"object": name, "bbox": box} for name, box in truth.boxes.items() if name != truth.object]
            given |= {"grounding": {"object": truth.object, "bbox": truth.boxes[truth.object]}, "objects": objects}
        drawn = await self._simulate(item, arm, 0, frames=frames, **given)
        found = evidence_of(drawn)
        if indices is not None:
            shown = {frame.index: frame.sha256 for frame in drawn.frames}
            found = replace(found, frames=tuple(shown[index] for index in indices))
        return replace(found, probability=None, event_shown=None, path_error=0.0)

    async def _simulate(self, item: Item, arm: Arm, trial: int, **changes: Any) -> AsyncSimulation:
        seed = {"seed": trial} if trial else {}
        options: Any = {**self.options, "frames": arm.frames_request, **seed, **changes}
        image, question = self.pictures.path(item.image), question_text(item)
        parts = self.key, item.id, item.image, str(sorted(options.items()))
        return await asked_once(self.places, parts, self.client.simulate, image, question, video=False, **options)


async def kept(found: Evidence, client: AsyncClient, pictures: Pictures) -> Evidence:
    """The same, its pictures kept."""
    for digest in dict.fromkeys((*found.frames, *(() if found.overlay is None else (found.overlay,)))):
        if not pictures.has(digest):
            pictures.add_made(await client.artifact(digest))
    return found


def evidence_of(simulation: AsyncSimulation) -> Evidence:
    """What a simulation gives to show."""
    outcome, step = simulation.trajectory.outcome, 1 / simulation.trajectory.fps
    moment = outcome.time if outcome is not None and outcome.happens else None
    return Evidence(
        frames=tuple(frame.sha256 for frame in simulation.frames),
        overlay=simulation.overlay.sha256,
        probability=None if outcome is None else outcome.probability,
        event_shown=None if moment is None else any(frame.time >= moment - step for frame in simulation.frames),
        usage=simulation.usage_total,
        seconds=sum(simulation.timings.values()),
        simulated=True,
    )


def _at_rate(values: NDArray[np.float64], fps: float, wanted: float) -> NDArray[np.float64]:
    """Values (moments, columns), so many per second, at another rate and until they end."""
    times = np.arange(0, (len(values) - 1) / fps + 1e-9, 1 / wanted)
    known = np.arange(len(values)) / fps
    return np.stack([np.interp(times, known, column) for column in values.T], axis=1)


def _distance(points: NDArray[np.float64], simulation: AsyncSimulation) -> float:
    """The mean distance of points (points, 2) from the simulation's path, px.

    Wherever it passes them: no picture tells how fast things are.
    """
    path = np.array(simulation.trajectory.path.points)
    stamps = np.linspace(0, len(path) - 1, PATH_SAMPLES)
    fine = np.stack([np.interp(stamps, np.arange(len(path)), path[:, axis]) for axis in (0, 1)], axis=1)
    return float(np.linalg.norm(points[:, None] - fine[None], axis=2).min(axis=1).mean())


def _sized(pixels: NDArray[np.uint8], simulation: AsyncSimulation) -> bytes:
    """PNG of a picture (height, width, 3), as large as the simulation's frames."""
    first = simulation.frames[0]
    return encode_png(as_large_as(pixels, first.width, first.height))
