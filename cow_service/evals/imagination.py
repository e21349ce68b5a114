"""What is shown beside a question in each arm of an evaluation, and the simulations that it takes."""

import asyncio
import hashlib
import re
import time
from collections.abc import Awaitable, Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal, TypeVar

from cow_service.adaptive import AdaptivePlaces
from cow_service.client import AsyncClient, AsyncSimulation
from cow_service.client.errors import Canceled
from cow_service.errors import CannotGround, CannotReadDirection, CowError, InvalidRequest, MllmBadReply
from cow_service.evals.items import Ask, Item, Pictures, question_text
from cow_service.media.images import decode
from cow_service.readers.mllm.contents import facts_of, opposite_motion, still_frame
from cow_service.records import Usage

Shown = Literal["nothing", "simulation", "still", "wrong-direction", "facts", "oracle"]
MAX_TRIES = 16
MAX_INTERRUPTS = 20  # of one run, each of which may have canceled the same job
NO_USAGE = Usage()
# What an image and a question may come to: nothing is imagined, and the question is asked without. All else is a fault.
REFUSALS = (CannotGround, CannotReadDirection, MllmBadReply)
Result = TypeVar("Result")
_BEST_OF = re.compile(r"best-of-(\d+)")


@dataclass(frozen=True)
class Arm:
    """What is shown beside the image, and how often it is asked."""

    name: str
    shown: Shown = "nothing"
    with_image: bool = True  # whether the question's image is shown
    gated: bool = False  # whether the answers from the image alone decide if anything is imagined
    tries: int = 1  # simulations, a reply each; the most frequent answer is taken

    @property
    def asks(self) -> tuple[Ask, ...]:
        """The ways to ask in which there is such an arm."""
        plain = self.shown in ("nothing", "simulation") and self.with_image
        return ("prompt", "answer") if plain else ("prompt",)


ARMS: dict[str, Arm] = {
    arm.name: arm
    for arm in (
        Arm("never"),
        Arm("always", "simulation"),
        Arm("auto", "simulation", gated=True),  # where three answers from the image alone disagree
        Arm("best-of-3", "simulation", tries=3),  # each with its own seed
        Arm("placebo-still", "still"),  # the first image again in place of each frame
        Arm("placebo-direction", "wrong-direction"),
        Arm("encounters", "facts"),  # in words; no frames
        Arm("frames-only", "simulation", with_image=False),
        Arm("oracle", "oracle"),  # pictures of what really happens
    )
}


def arm_of(name: str) -> Arm:
    """The arm of a name; `best-of-K` for any number of simulations. Raises `InvalidRequest` for another name."""
    best = _BEST_OF.fullmatch(name)
    if best and 2 <= int(best[1]) <= MAX_TRIES:
        return Arm(name, "simulation", tries=int(best[1]))
    if name not in ARMS:
        raise InvalidRequest(
            f"There is no arm '{name}': there are {', '.join(ARMS)}, and best-of-K for K from 2 to {MAX_TRIES}."
        )
    return ARMS[name]


def check_arms(names: Sequence[str], ask: Ask, items: Sequence[Item]) -> tuple[Arm, ...]:
    """The arms of these names. Raises `InvalidRequest` for one that cannot be asked so, or of these items."""
    arms = tuple(arm_of(name) for name in dict.fromkeys(names))
    if not arms:
        raise InvalidRequest(f"Name at least one arm: {', '.join(ARMS)}.")
    for arm in arms:
        if ask not in arm.asks:
            there = ", ".join(each.name for each in ARMS.values() if ask in each.asks)
            raise InvalidRequest(
                f"The service's own /answer has no arm '{arm.name}', only {there}: use --ask prompt with --mllm."
            )
    without = [item for item in items if not item.oracle]
    if without and any(arm.shown == "oracle" for arm in arms):
        raise InvalidRequest(
            f"The arm 'oracle' needs pictures of what really happens, and {len(without)} of {len(items)} items have "
            f"none, such as {without[0].row}."
        )
    return arms


async def asked_once(places: AdaptivePlaces, ask: Callable[..., Awaitable[Result]], *parts: str) -> Result:
    """What `ask` returns for an `idempotency_key` of these parts; it holds one of the places meanwhile.

    A job that an interrupt has canceled stays so under its key: then there is another key. Raises what `ask` raises.
    """
    for attempt in range(MAX_INTERRUPTS):
        key = hashlib.sha256("\n".join((*parts, str(attempt))).encode()).hexdigest()
        try:
            async with places.held() as call:
                result = await ask(idempotency_key=key)
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
    refusal: CowError | None = None  # why there is nothing
    usage: Usage = NO_USAGE
    seconds: float = 0.0  # of its stages, without waiting for a place
    simulated: bool = False


class Imagination:
    """Simulations of items, from one server. For one event loop."""

    def __init__(
        self, client: AsyncClient, places: AdaptivePlaces, pictures: Pictures, options: Mapping[str, Any], key: str
    ) -> None:
        """`places` are for requests of the client, `options` are fields of these.

        `key` names the run: the same run never asks the same twice.
        """
        self._client = client
        self.places = places
        self._pictures = pictures
        self._options = dict(options)
        self._key = key
        self._found: dict[tuple[str, Shown, int], asyncio.Task[Evidence]] = {}

    async def evidence(self, item: Item, shown: Shown, trial: int = 0) -> Evidence:
        """What to show of an item. `trial` counts simulations of the same, which differ by their seed.

        Raises the `CowError` for which a simulation failed, but for refusals: those are part of the evidence.
        """
        place = item.id, shown, trial
        if place not in self._found:
            self._found[place] = asyncio.ensure_future(self._make(item, shown, trial))
        try:
            return await asyncio.shield(self._found[place])
        except CowError:
            self._found.pop(place, None)
            raise

    async def _make(self, item: Item, shown: Shown, trial: int) -> Evidence:
        if shown == "nothing":
            return Evidence()
        if shown == "oracle":
            return Evidence(frames=item.oracle)
        if shown == "still":
            # The image itself, as large as a frame.
            pixels = decode(self._pictures.read(item.image)).pixels
            still = self._pictures.add_made(still_frame(pixels, self._options["frames"]["max_side"]))
            return Evidence(frames=(still,) * self._options["frames"]["count"])
        begun = time.monotonic()
        try:
            simulation = await self._simulate(item, trial, {})
            usage, seconds = simulation.usage_total, sum(simulation.timings.values())
            if shown == "wrong-direction":
                simulation = await self._simulate(item, trial, {"motion": opposite_motion(simulation)})
                usage, seconds = usage + simulation.usage_total, seconds + sum(simulation.timings.values())
        except REFUSALS as refusal:
            usage = Usage.model_validate(refusal.usage or {})
            return Evidence(refusal=refusal, usage=usage, seconds=time.monotonic() - begun)
        found = replace(await evidence_of(simulation, self._client, self._pictures), usage=usage, seconds=seconds)
        if shown == "facts":
            return replace(found, frames=(), facts=facts_of(simulation))
        return replace(found, probability=None) if shown == "wrong-direction" else found

    async def _simulate(self, item: Item, trial: int, changes: Mapping[str, Any]) -> AsyncSimulation:
        options: Any = {**self._options, **({"seed": trial} if trial else {}), **changes}
        image, question = self._pictures.path(item.image), question_text(item)
        ask = partial(self._client.simulate, image, question, video=False, **options)
        return await asked_once(self.places, ask, self._key, item.id, item.image, str(sorted(options.items())))


async def evidence_of(simulation: AsyncSimulation, client: AsyncClient, pictures: Pictures) -> Evidence:
    """What a simulation gives to show; its pictures are kept."""
    for digest in simulation.pictures.values():
        pictures.add_made(await client.artifact(digest))
    outcome = simulation.trajectory.outcome
    return Evidence(
        frames=tuple(frame.sha256 for frame in simulation.frames),
        overlay=simulation.overlay.sha256,
        probability=None if outcome is None else outcome.probability,
        seconds=sum(simulation.timings.values()),
        simulated=True,
    )
