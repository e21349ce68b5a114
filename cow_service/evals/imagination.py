"""Asks a server for simulations, each item's once: what is shown of it, and what it cost."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from cow_service.client import AsyncClient
from cow_service.client.results import AsyncSimulation
from cow_service.errors import CannotGround, CannotReadDirection, CowError, MllmBadReply
from cow_service.evals.arms import Shown
from cow_service.evals.idempotency import asked_once
from cow_service.evals.items import Item, question_text
from cow_service.evals.pictures import Pictures
from cow_service.media.images import decode, encode_png, fit_within
from cow_service.readers.base import Imagined
from cow_service.readers.mllm.hypothesis import hypothesis
from cow_service.records import DIRECTED_KINDS, Motion, Simulation, Usage

NO_USAGE = Usage()
# What an image and a question may come to: nothing is imagined, and the question is asked without. All else is a fault.
STEEP = 0.05  # of a unit vector
_ENDS = ("distance", "duration", "until")
REFUSALS = (CannotGround, CannotReadDirection, MllmBadReply)


@dataclass(frozen=True)
class Look:
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

    def __init__(self, client: AsyncClient, pictures: Pictures, options: Mapping[str, Any], key: str) -> None:
        """`options` are fields of the requests; `key` names the run: the same run never asks the same twice."""
        self._client = client
        self._pictures = pictures
        self._options = dict(options)
        self._key = key
        self._looks: dict[tuple[str, Shown, int], asyncio.Task[Look]] = {}

    async def look(self, item: Item, shown: Shown, trial: int = 0) -> Look:
        """What to show of an item. `trial` counts simulations of the same, which differ by their seed.

        Raises the `CowError` for which a simulation failed, but for refusals: those are part of the look.
        """
        place = item.id, shown, trial
        if place not in self._looks:
            self._looks[place] = asyncio.ensure_future(self._make(item, shown, trial))
        try:
            return await asyncio.shield(self._looks[place])
        except CowError:
            self._looks.pop(place, None)
            raise

    async def _make(self, item: Item, shown: Shown, trial: int) -> Look:
        if shown == "nothing":
            return Look()
        if shown == "oracle":
            return Look(frames=item.oracle)
        if shown == "still":
            return Look(frames=(self._still(item),) * self._options["frames"]["count"])
        begun = time.monotonic()
        try:
            simulation = await self._simulate(item, trial, {})
            usage, seconds = simulation.usage_total, sum(simulation.timings.values())
            if shown == "wrong-direction":
                simulation = await self._simulate(item, trial, _opposite(simulation))
                usage, seconds = usage + simulation.usage_total, seconds + sum(simulation.timings.values())
        except REFUSALS as refusal:
            usage = Usage.model_validate(refusal.usage or {})
            return Look(refusal=refusal, usage=usage, seconds=time.monotonic() - begun)
        return await self._seen(simulation, shown, usage, seconds)

    async def _simulate(self, item: Item, trial: int, changes: Mapping[str, Any]) -> AsyncSimulation:
        options: Any = {**self._options, **({"seed": trial} if trial else {}), **changes}
        image, question = self._pictures.path(item.image), question_text(item)

        async def ask(key: str) -> AsyncSimulation:
            return await self._client.simulate(image, question, idempotency_key=key, video=False, **options)

        return await asked_once(ask, self._key, item.id, item.image, str(sorted(options.items())))

    async def _seen(self, simulation: AsyncSimulation, shown: Shown, usage: Usage, seconds: float) -> Look:
        """The look of a simulation; its pictures are kept."""
        for digest in simulation.pictures.values():
            self._pictures.add_made(await self._client.artifact(digest))
        outcome = simulation.trajectory.outcome
        return Look(
            frames=() if shown == "facts" else tuple(frame.sha256 for frame in simulation.frames),
            overlay=simulation.overlay.sha256,
            facts=_facts(simulation) if shown == "facts" else (),
            probability=None if outcome is None or shown == "wrong-direction" else outcome.probability,
            usage=usage,
            seconds=seconds,
            simulated=True,
        )

    def _still(self, item: Item) -> str:
        """The image itself, as large as a frame."""
        pixels = decode(self._pictures.read(item.image)).pixels
        return self._pictures.add_made(encode_png(fit_within(pixels, self._options["frames"]["max_side"])))


def _facts(simulation: Simulation) -> tuple[str, ...]:
    """What a simulation found, in the words in which `/answer` tells it."""
    told: Any = hypothesis(Imagined(simulation, ()))
    found = tuple(told["facts"]) + tuple(told["encounters"])
    return found or (
        "The moving object meets nothing." if told["encounters_known"] else "It is not known what it meets.",
    )


def _opposite(simulation: Simulation) -> dict[str, Any]:
    """The fields of a request for the same scene with the motion the other way round.

    A throw keeps its rise; a fall becomes a motion to the side. Raises `CannotReadDirection` for what goes nowhere.
    """
    motion: Motion = simulation.motion
    if motion.kind == "fall":
        wrong: dict[str, Any] = {"kind": "linear", "direction": (1.0, 0.0)}
    elif motion.kind in DIRECTED_KINDS and motion.direction is not None:
        right, down = motion.direction
        if motion.kind == "projectile" and abs(right) < STEEP and abs(motion.depth) < STEEP:
            raise CannotReadDirection("What is thrown straight up or down has no opposite direction.")
        wrong = {"kind": motion.kind, "direction": (-right, down if motion.kind == "projectile" else -down)}
        wrong |= {"depth": -motion.depth, "speed": motion.speed}
        wrong |= {name: value for name in _ENDS if (value := getattr(motion, name)) is not None}
    else:
        raise CannotReadDirection(f"A {motion.kind} motion has no direction, so there is no wrong one.")
    return {"motion": wrong}
