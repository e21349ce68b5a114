"""How a question is answered by an ensemble of worlds, and how sure that is.

The rule, the same for every form of question: an answer is sure where it has at least `SURE` of the worlds, and robust
where it has at least `ROBUST` of them.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cow_service.physics.draws import NAMES, PARAMETERS
from cow_service.physics.events import NEVER, WorldEvents
from cow_service.records import Asked, AskedForm, AskedRelation, Doubt, EncounterKind
from cow_service.vision.types import Floats, Mask

SURE = 0.7  # share of the worlds from which an answer is given
ROBUST = 0.9
MATTERS = 0.2  # correlation with the outcome from which a parameter is named
MOST_NAMED = 3

KIND_OF: dict[AskedRelation, EncounterKind] = {"touches": "touches", "covers": "occludes", "covered": "occluded-by"}
FIRST_MET: tuple[AskedForm, ...] = ("which-first", "where", "what-happens")  # told apart by what is met first


@dataclass(frozen=True)
class Query:
    """What is asked, with the bodies that it is about."""

    asked: Asked
    target: int | None = None  # None: any
    subject: int = 0  # who does it
    among: tuple[int, ...] = ()  # the things that are meant; empty: any


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


def decide(query: Query, ensemble: WorldEvents, draws: Floats) -> Decided:
    """The answer of an ensemble with draws [K, P]."""
    asked, answers = query.asked, answers_of(query, ensemble)
    answer, count = max(Counter(answers).items(), key=lambda item: (item[1], item[0]))
    probability = shown = count / len(answers)
    times = _happens(query, ensemble)
    times = times[np.isfinite(times)]
    if asked.form in ("whether", "when"):  # that what is asked happens, or, where it is negated, does not
        happens = probability if answer else 1 - probability
        shown = 1 - happens if asked.negated else happens
    return Decided(
        probability=shown,
        sure=probability >= SURE,
        robust=probability >= ROBUST,
        depends_on=_depends_on(np.array([found == answer for found in answers]), draws),
        first=answer if asked.form in FIRST_MET and answer >= 0 else None,
        count=answer if asked.form == "how-many" else None,
        time=float(np.median(times)) if len(times) else None,
        time_band=(float(np.quantile(times, 0.1)), float(np.quantile(times, 0.9))) if len(times) else None,
    )


def decide_change(query: Query, changed: WorldEvents, factual: WorldEvents, draws: Floats) -> Decided:
    """Whether the answer differs between two ensembles with the same draws [K, P]."""
    pairs = zip(answers_of(query, changed), answers_of(query, factual), strict=True)
    differs = np.array([one != other for one, other in pairs])
    share = float(differs.mean())
    probability = max(share, 1 - share)
    return Decided(
        probability=1 - share if query.asked.negated else share,
        sure=probability >= SURE,
        robust=probability >= ROBUST,
        depends_on=_depends_on(differs == (share >= 0.5), draws),
    )


def answers_of(query: Query, events: WorldEvents) -> list[int]:
    """Per draw: 1 or 0 for whether and when, the body that is met first or -1, or how many are met.

    Of `changes` it is the answer whose change is asked about: whether the target is met, or what is met first.
    """
    asked, times = query.asked, _per_body(query, events)
    if asked.form in FIRST_MET or (asked.form == "changes" and query.target is None):
        first = times.argmin(axis=1)
        return np.where(np.isfinite(times.min(axis=1)), first, -1).tolist()
    if asked.form == "how-many":
        return np.isfinite(times).sum(axis=1).tolist()
    return np.isfinite(_happens(query, events)).astype(int).tolist()


def _happens(query: Query, events: WorldEvents) -> Floats:
    """[K]: when it has happened with any of the bodies that are meant or, where that is asked, with each of them."""
    times = _per_body(query, events)
    return times[:, list(query.among)].max(axis=1) if query.asked.every and query.among else times.min(axis=1)


def _per_body(query: Query, events: WorldEvents) -> Floats:
    """[K, B]: when it first happens with each body that is meant.

    Raises `KeyError` for a relation that encounters do not decide.
    """
    relation, of_subject = query.asked.relation, events.of[query.subject]
    bodies = np.arange(len(of_subject.eligible))
    if query.target is not None:
        meant = bodies == query.target
    else:
        meant = np.isin(bodies, query.among) if query.among else of_subject.eligible
    if relation in ("leaves", "lands"):
        times, meant = events.gone if relation == "leaves" else events.landed, bodies == query.subject
    elif relation == "inside":
        times = np.full_like(events.moved, NEVER) if events.placed is None else events.placed[:, None]
    elif relation in ("tips", "moves"):
        times = events.tipped if relation == "tips" else events.moved
    else:
        kinds = of_subject.partly if query.asked.partly else of_subject.times
        times = kinds[KIND_OF[relation]]
    times, limit = np.where(meant[None], times, NEVER), query.asked.within
    return times if limit is None else np.where(times <= limit, times, NEVER)


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
