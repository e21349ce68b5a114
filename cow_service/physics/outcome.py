"""How a question is answered by an ensemble of worlds, and how sure that is.

The rule, the same for every form of question: an answer is sure where it has at least `SURE` of the worlds, and robust
where it has at least `ROBUST` of them.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cow_service.physics.draws import NAMES, PARAMETERS
from cow_service.physics.events import Events
from cow_service.records import Asked, AskedRelation, Doubt, EncounterKind
from cow_service.vision.types import Floats, Mask

SURE = 0.7  # share of the worlds from which an answer is given
ROBUST = 0.9
MATTERS = 0.2  # correlation with the outcome from which a parameter is named
MOST_NAMED = 3

KIND_OF: dict[AskedRelation, EncounterKind] = {"touches": "touches", "covers": "occludes", "covered": "occluded-by"}


@dataclass(frozen=True)
class Decided:
    """What the worlds say to a question."""

    probability: float | None
    sure: bool
    robust: bool
    depends_on: tuple[Doubt, ...]
    first: int | None = None  # body
    count: int | None = None
    time: float | None = None
    time_band: tuple[float, float] | None = None


def decide(asked: Asked, target: int | None, ensemble: Events, draws: Floats) -> Decided:
    """The answer of an ensemble with draws [K, P]."""
    answers = _answers(asked, target, ensemble)
    counted = Counter(answers)
    answer, most = max(counted.items(), key=lambda item: (item[1], item[0]))
    probability = most / len(answers)
    times = _times(asked, target, ensemble)
    times = times[np.isfinite(times)]
    shown = asked.form in ("whether", "when")
    return Decided(
        probability=_said(asked, answer, probability) if shown else probability,
        sure=probability >= SURE,
        robust=probability >= ROBUST,
        depends_on=_depends_on(np.array([found == answer for found in answers]), draws),
        first=answer if asked.form == "which-first" and answer >= 0 else None,
        count=answer if asked.form == "how-many" else None,
        time=float(np.median(times)) if len(times) else None,
        time_band=(float(np.quantile(times, 0.1)), float(np.quantile(times, 0.9))) if len(times) else None,
    )


def agrees(asked: Asked, target: int | None, likeliest: Events, ensemble: Events) -> Mask:
    """[K]: which worlds of the ensemble answer as most do; and whether the likeliest one does, as the last [K + 1]."""
    answers = _answers(asked, target, ensemble)
    answer = max(Counter(answers).items(), key=lambda item: (item[1], item[0]))[0]
    return np.array([found == answer for found in (*answers, *_answers(asked, target, likeliest))])


def _said(asked: Asked, answer: int, probability: float) -> float:
    """That what is asked happens, or, where it is negated, does not."""
    happens = probability if answer else 1 - probability
    return 1 - happens if asked.negated else happens


def _answers(asked: Asked, target: int | None, events: Events) -> list[int]:
    """Per draw: 1 or 0 for whether and when, the body that is met first or -1, or how many are met."""
    times = _per_body(asked, target, events)
    if asked.form == "which-first":
        first = times.argmin(axis=1)
        return np.where(np.isfinite(times.min(axis=1)), first, -1).tolist()
    if asked.form == "how-many":
        return np.isfinite(times).sum(axis=1).tolist()
    return np.isfinite(times).any(axis=1).astype(int).tolist()


def _times(asked: Asked, target: int | None, events: Events) -> Floats:
    """[K]: when it first happens, s."""
    return _per_body(asked, target, events).min(axis=1)


def _per_body(asked: Asked, target: int | None, events: Events) -> Floats:
    """[K, B]: when it first happens with each body that is meant."""
    meant = events.eligible.copy()
    if target is not None:
        meant &= np.arange(len(meant)) == target
    if asked.relation == "inside":
        times = np.full((1, 1), np.inf) if events.placed is None else events.placed[:, None]
        return np.where(meant[None], times, np.inf)
    return np.where(meant[None], events.times[KIND_OF[asked.relation]], np.inf)


def _depends_on(same: Mask, draws: Floats) -> tuple[Doubt, ...]:
    """Doubts whose parameters go with the answer, the closest first."""
    weights: dict[Doubt, float] = {}
    for place, name in enumerate(NAMES):
        column = draws[:, place]
        spread = float(same.std() * column.std())
        related = abs(float(((same - same.mean()) * (column - column.mean())).mean())) / spread if spread > 0 else 0.0
        if related >= MATTERS:
            doubt = PARAMETERS[name]
            weights[doubt] = max(weights.get(doubt, 0.0), related)
    ranked: Sequence[Doubt] = sorted(weights, key=lambda doubt: -weights[doubt])
    return tuple(ranked[:MOST_NAMED])
