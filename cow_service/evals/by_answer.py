"""Asks the service's own `/answer`, which imagines and answers by itself."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

from cow_service.client import AsyncClient
from cow_service.client.errors import error_from
from cow_service.client.results import AsyncAnswer
from cow_service.evals.asking import Asked, Case, Reply
from cow_service.evals.idempotency import asked_once
from cow_service.evals.imagination import REFUSALS, Look
from cow_service.evals.pictures import Pictures


@dataclass(frozen=True)
class ByAnswer:
    """Asks a server. The same run never asks the same twice: requests have idempotency keys."""

    client: AsyncClient
    pictures: Pictures
    options: Mapping[str, Any]  # fields of the requests
    key: str  # of the run

    async def __call__(self, case: Case) -> Asked:
        """Asks, once per try of the arm."""
        imagine = "never" if case.arm.shown == "nothing" else "auto" if case.arm.gated else "always"
        replies: list[Reply] = []
        looks: list[Look] = []
        for trial in range(case.arm.tries):
            reply, look = await self._ask(case, imagine, trial)
            replies.append(reply)
            looks.append(look)
        return Asked(tuple(replies), tuple(looks))

    async def _ask(self, case: Case, imagine: Literal["always", "auto", "never"], trial: int) -> tuple[Reply, Look]:
        options: Any = {**self.options, **({"seed": trial} if trial else {})}
        image = self.pictures.path(case.item.image)

        async def ask(key: str) -> AsyncAnswer:
            return await self.client.answer(image, case.question, idempotency_key=key, imagine=imagine, **options)

        parts = (self.key, case.item.id, case.arm.name, str(case.repeat), str(trial), str(sorted(options.items())))
        answer = await asked_once(ask, *parts)
        look = await self._look(answer)
        # Usage and stages are of everything together: what is not of the simulation stands with the reply.
        seconds = max(0.0, sum(answer.timings.values()) - look.seconds)
        return Reply(_text(answer), answer.usage_total, seconds), look

    async def _look(self, answer: AsyncAnswer) -> Look:
        """What the answer rests on. Raises the fault for which nothing was imagined, where it is no refusal."""
        if answer.simulation_problem is not None:
            problem = error_from(answer.simulation_problem.model_dump())
            if not isinstance(problem, REFUSALS):
                raise problem
            return Look(refusal=problem)
        simulation = answer.simulation
        if simulation is None:
            return Look()
        for digest in simulation.pictures.values():
            self.pictures.add_made(await self.client.artifact(digest))
        outcome = simulation.trajectory.outcome
        return Look(
            frames=tuple(frame.sha256 for frame in simulation.frames),
            overlay=simulation.overlay.sha256,
            probability=None if outcome is None else outcome.probability,
            seconds=sum(simulation.timings.values()),
            simulated=True,
        )


def _text(answer: AsyncAnswer) -> str:
    """The answer as a reply that `replies` reads: in the form that the paper's prompt asks for."""
    said = answer.answer or ("Not sure" if answer.not_sure else "")
    reasons = answer.reasoning.replace("'", "\u2019")
    return f"{{'Reasoning': '{reasons}', 'Answer': '{said}'}}"
