"""The likeliest world, and the ensemble of worlds around it, which give the frames, the answer and its certainty.

The rule, the same for every form of question: an answer is sure where it has at least `SURE` of the worlds, or
`SURE_OF_MISS` where a throw meets nothing, or `SURE_OF_FIT` of what is put into something, and robust where it has at
least `ROBUST` of them.

Worlds are run in batches, until those that are left are not likely to change that (a sequential test): what nearly all
of the first batch agree on is settled.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from math import ceil, comb, floor, sqrt
from typing import Any

import numpy as np

from cow_service.media.types import Floats, Mask
from cow_service.physics.draws import NAMES, PARAMETERS, ensemble, likeliest
from cow_service.physics.events import NEVER, WorldEvents, find_world_events, seen_paths
from cow_service.physics.placement import PlacementGoal
from cow_service.physics.world import DrawnWorlds, WorldInput, Worlds, run_world
from cow_service.records import Asked, AskedForm, AskedRelation, Doubt, EncounterKind

BATCHES = (15, 30)  # worlds after which it is asked whether all that are wanted have to be run
EVERY = 2  # frames of its clock between those that are recorded of the ensemble
TRIES = 4  # worlds that are tried for one that shows what most of the ensemble does
SURE = 0.7  # share of the worlds from which an answer is given
# The same for a throw with an unknown heading out of the image plane that meets nothing: a wrong guess of
# the heading makes worlds miss, and hardly ever hit.
SURE_OF_MISS = 0.85
SURE_OF_FIT = 0.85  # the same for whether a put object fits: widths are measured by two outlines at two depths
ROBUST = 0.9
# The chance, at most and at each look, that those which are left would change whether the answer is sure, and whether
# it is robust, if they were drawn like those that were run.
MAY_CHANGE, MAY_CHANGE_ROBUST = 0.01, 0.12
MATTERS, MATTERS_OF = 0.2, 50  # least correlation with the outcome to name a parameter, for that many worlds
MOST_NAMED = 3

FEW_WORLDS = 0.2  # share of the worlds: what is touched in no more of them turns no answer that is clear
# Things that are met, at most, which are taken away in turn where the question names none: each takes as long as the
# worlds in which all are there, and what is met in fewer worlds than these hardly keeps anything from happening.
MOST_TAKEN = 8

OF_COVERING: tuple[AskedRelation, ...] = ("covers", "covered")
KIND_OF: dict[AskedRelation, EncounterKind] = {"touches": "touches", "covers": "occludes", "covered": "occluded-by"}
BY_EVENTS = (*KIND_OF, "tips", "moves", "leaves", "lands")  # relations that what happens in a world decides
FIRST_MET: tuple[AskedForm, ...] = ("which-first", "where", "what-happens")  # told apart by what is met first
OF_EACH: tuple[AskedForm, ...] = ("which", "which-to-remove")  # told of each candidate, which `among` are


@dataclass(frozen=True)
class Query:
    """The question, with the bodies that it is about."""

    asked: Asked
    target: int | None = None  # None: any
    subject: int = 0  # the acting body
    among: tuple[int, ...] = ()  # the things that are meant; empty: any
    goals: tuple[PlacementGoal, ...] = ()  # of `which`, if the mover is put into each of `among` in turn
    meets_more: bool = False  # what the acting object meets is one of `among`, too
    is_decidable: bool = True  # by worlds
    sure: float = SURE  # share of the worlds from which an answer is given
    sure_of_miss: float = SURE  # share of the worlds from which it is answered that nothing happens

    @property
    def is_of_removal(self) -> bool:
        """Whether it asks what happens without each candidate."""
        return self.asked.form == "which-to-remove"

    @property
    def has_own_worlds(self) -> bool:
        """Whether it is worlds of their own that say what is so of each candidate."""
        return self.is_of_removal or bool(self.goals)

    def of(self, candidate: int | None) -> Query:
        """Whether it happens: with one candidate or, where that is taken away, in the world without it."""
        asked = self.asked.model_copy(update={"form": "whether", "among": (), "every": False})
        return replace(self, asked=asked, target=self.target if self.is_of_removal else candidate, among=(), goals=())

    def of_shown(self, world: WorldInput) -> Query:
        """What the world itself can be asked, without those of the candidates."""
        if not self.has_own_worlds:
            return self
        return self.of(None if world.placement is None else world.placement.targets[0])


@dataclass(frozen=True)
class Told:
    """What the worlds of one candidate tell, per draw [K]."""

    happens: Mask
    misread: Mask
    touches: Floats  # [K, B] s: when the mover first touches each body
    way: Floats | None = None  # [F, 2] px: how far the mover gets in the first draw; None: as in the world shown

    @staticmethod
    def by(query: Query, events: WorldEvents, way: Floats | None = None) -> Told:
        """As worlds answer whether it happens."""
        happens = np.isfinite(_happens(query, events))
        return Told(happens, _misread(events), events.of[0].times["touches"], way)

    def joined(self, other: Told) -> Told:
        """With those of more draws."""
        names = "happens", "misread", "touches"
        return replace(self, **{n: np.concatenate([getattr(self, n), getattr(other, n)]) for n in names})


@dataclass(frozen=True)
class Candidate:
    """What is decided of one candidate: that it happens with it or, where it is taken away, that it does not."""

    body: int
    probability: float
    sure: bool
    told: Told


@dataclass(frozen=True)
class Decided:
    """What the worlds say to a question."""

    probability: float
    sure: bool
    robust: bool
    depends_on: tuple[Doubt, ...]
    first: int | None = None  # body
    count: int | None = None
    time: float | None = None
    time_band: tuple[float, float] | None = None
    candidates: tuple[Candidate, ...] = ()
    as_it_is: float | None = None  # probability that it happens while all candidates are there


@dataclass(frozen=True)
class ObservedWorlds:
    """Worlds with what happens in them."""

    worlds: Worlds
    events: WorldEvents


@dataclass(frozen=True)
class EnsembleResult:
    """One world that is shown, and the ensemble around it."""

    world: WorldInput
    shown: ObservedWorlds
    ensemble: ObservedWorlds | None
    query: Query | None
    decided: Decided | None  # null if nothing is asked, or there is no ensemble


def run_ensemble(world: WorldInput, query: Query | None, size: int) -> tuple[EnsembleResult, ...]:
    """Runs the likeliest world and an ensemble of `size` worlds around it; where something is changed first, also
    the world as it is, with the same draws, as the second.

    What is shown must not contradict what is answered: where an answer is sure and the likeliest world differs from
    it, the likeliest world of those that agree is shown.
    """
    of_shown = None if query is None else query.of_shown(world)
    given, queries = (world,), [query]
    if world.removed or world.placed_before:
        given, queries = (world, world.as_it_is()), [query, None if query is None else _of_unchanged(query, world)]
    if size == 0:
        pairs = zip(given, queries, strict=True)
        return tuple(EnsembleResult(each, _run(each, likeliest()), None, asked, None) for each, asked in pairs)
    rows = ensemble(size)
    with ThreadPoolExecutor(1) as beside:  # half of the time is the engine's, which does not hold the interpreter up
        likely = beside.submit(lambda: [_run(each, likeliest()) for each in given])
        worlds, decided, queries[0] = _run_until_settled(given, queries, rows)
        shown = likely.result()
    rows = rows[: len(worlds[0].worlds.runs)]
    if of_shown is not None:
        shown = _agreeing(given, of_shown, decided, rows, worlds, shown)
        decided = [_at_shown_time(*each, of_shown) for each in zip(decided, shown, strict=True)]
    return tuple(EnsembleResult(*parts) for parts in zip(given, shown, worlds, queries, decided, strict=True))


def _of_unchanged(query: Query, world: WorldInput) -> Query:
    """What is asked of the world as it is: as of the changed one but, where a change is asked about, what changes."""
    if query.asked.form != "changes":
        return query.of_shown(world)
    form = "what-happens" if query.target is None else "whether"
    return replace(query, asked=query.asked.model_copy(update={"form": form, "negated": False}))


def _at_shown_time(decided: Decided | None, shown: ObservedWorlds, query: Query) -> Decided | None:
    """With one time for one event: that of what is shown, unless most others have it much earlier, or later."""
    if decided is None or decided.time_band is None:
        return decided
    time, (early, late) = float(_happens(query, shown.events)[0]), decided.time_band
    return replace(decided, time=time) if early <= time <= late else decided


def batches(size: int) -> tuple[int, ...]:
    """How many worlds of an ensemble are run before each look. None is left for last: one alone is run more finely."""
    return (*(batch for batch in BATCHES if batch + 1 < size), size)


def _run_until_settled(
    given: Sequence[WorldInput], queries: Sequence[Query | None], rows: Floats
) -> tuple[list[ObservedWorlds], list[Decided | None], Query | None]:
    """The first of some draws [K, P] in each world, as many as it takes, what they say, and the first one's query."""
    drawn = [DrawnWorlds.of(each, rows, EVERY) for each in given]
    worlds, decided, told, count = list[ObservedWorlds](), list[Decided | None](), list[Told](), 0
    query = queries[0]
    for most in batches(len(rows)):
        part = slice(count, most)
        run = [each.run(part) for each in drawn]
        if query is not None and query.is_decidable and query.has_own_worlds:
            query, told = _tell_candidates(query, told, drawn[0], _observed(given[0], run[0], rows[part]), part)
        if count:
            layouts = [each.layout.of(slice(0, most)) for each in drawn]
            run = [each.worlds.joined(*more) for each, more in zip(worlds, zip(run, layouts, strict=True), strict=True)]
        count = most
        worlds = [_observed(*each, rows[:count]) for each in zip(given, run, strict=True)]
        decided = _decide((query, *queries[1:]), worlds, rows[:count], told)
        verdicts = [each for each in decided if each is not None]
        if len(verdicts) == len(decided) and all(is_settled(each, query, count, len(rows)) for each in verdicts):
            break
    return worlds, decided, query


def _tell_candidates(
    query: Query, told: Sequence[Told], drawn: DrawnWorlds, there: ObservedWorlds, part: slice
) -> tuple[Query, list[Told]]:
    """The query with all its candidates, and what some more worlds tell of each, beside what was told before."""
    query = _with_met(query, there) if query.meets_more else query
    more = [_told_of(query, each, drawn, there, part) for each in query.among]
    return query, [one.joined(other) for one, other in zip(told, more, strict=True)] if told else more


def _with_met(query: Query, there: ObservedWorlds) -> Query:
    """With the things that the acting object meets, those first that it meets in most worlds."""
    touches = there.events.of[query.subject].times["touches"]
    shares = np.isfinite(np.minimum(touches, _per_body(query.of(None), there.events))).mean(axis=0)
    met = [int(body) for body in np.argsort(-shares, kind="stable") if body and shares[body] > FEW_WORLDS]
    among = dict.fromkeys((*query.among, *met[:MOST_TAKEN]))
    return replace(query, among=tuple(among), meets_more=False)


def _told_of(query: Query, candidate: int, drawn: DrawnWorlds, there: ObservedWorlds, part: slice) -> Told:
    """What worlds of its own, with the same draws, tell of a candidate; `there` are some in which all is there."""
    asked, events, count = query.of(candidate), there.events, len(there.worlds.runs)
    if not query.is_of_removal:
        goal = query.goals[query.among.index(candidate)]
        own = replace(drawn, given=replace(drawn.given, placement=goal))
    elif candidate in (0, query.subject, query.target):  # without it there is nothing that could happen
        return replace(Told.by(asked, events), happens=np.zeros(count, bool), misread=np.zeros(count, bool))
    else:
        meetings = (each for run in there.worlds.runs for each in run.meetings if each.b is not None)
        matter = {*there.worlds.layout.supports, *(body for each in meetings for body in (each.a, each.b))}
        if candidate not in matter and (query.target is not None or query.asked.relation not in OF_COVERING):
            return Told.by(asked, events)  # what touches nothing changes nothing
        own = drawn.without(candidate)
    found = _observed(own.given, own.run(part), drawn.draws[part])
    path = seen_paths(found.worlds.within_horizon, 0)
    return Told.by(asked, found.events, path.points[0] - path.seen[0])


def _run(world: WorldInput, draws: Floats) -> ObservedWorlds:
    return _observed(world, run_world(world, draws), draws)


def _observed(world: WorldInput, worlds: Worlds, draws: Floats) -> ObservedWorlds:
    return ObservedWorlds(worlds, find_world_events(worlds.within_horizon, world.bodies, draws, world.size))


def _decide(
    queries: Sequence[Query | None], worlds: Sequence[ObservedWorlds], draws: Floats, told: Sequence[Told]
) -> list[Decided | None]:
    """What is decided of each world; None if worlds decide nothing. `told` is of the first one's candidates."""
    decided: list[Decided | None] = []
    for asked, each in zip(queries, worlds, strict=True):
        if asked is None or not asked.is_decidable or (asked.asked.form == "changes" and len(worlds) == 1):
            decided.append(None)
        elif asked.asked.form == "changes":
            decided.append(decide_change(asked, each.events, worlds[1].events, draws))
        elif asked.asked.form in OF_EACH:
            own = told if asked.has_own_worlds else [Told.by(asked.of(body), each.events) for body in asked.among]
            decided.append(decide_each(asked, each.events, own, draws))
        else:
            decided.append(decide(asked, each.events, draws))
    return decided


def is_settled(decided: Decided, query: Query | None, count: int, size: int) -> bool:
    """Whether the worlds run so far, drawn from `size`, most likely give the same answer as all of them.

    The worlds that agree are hypergeometrically distributed; what all of them would say differs where they cross a
    share, and is likeliest to do so just beyond it.
    """
    shares = [decided.probability]
    if query is not None and query.asked.form in ("whether", "when", "changes"):
        shares = [max(decided.probability, 1 - decided.probability)]
    shares += [max(each.probability, 1 - each.probability) for each in decided.candidates]
    sure = {SURE} if query is None else {query.sure, query.sure_of_miss}
    return all(
        _chance_beyond(share * count, count, size, least) < may_change
        for share in shares
        for least, may_change in (*((each, MAY_CHANGE) for each in sure), (ROBUST, MAY_CHANGE_ROBUST))
    )


def _chance_beyond(agreeing: float, count: int, size: int, share: float) -> float:
    """The chance of this many agreeing worlds, or a more extreme number, among `count` drawn from `size` worlds, where
    the agreeing share lies just beyond a share, on the other side than theirs."""
    least = ceil(share * size)  # of all, to reach it
    if agreeing >= share * count:
        total, seen = least - 1, range(floor(agreeing), count + 1)
    else:
        total, seen = least, range(ceil(agreeing) + 1)
    return sum(comb(total, each) * comb(size - total, count - each) for each in seen) / comb(size, count)


def _agreeing(
    given: Sequence[WorldInput],
    query: Query,
    decided: Sequence[Decided | None],
    rows: Floats,
    worlds: Sequence[ObservedWorlds],
    shown: list[ObservedWorlds],
) -> list[ObservedWorlds]:
    """The likeliest world, with its counterpart, that shows what most of the ensemble does."""
    sure = [each is not None and each.sure for each in decided]
    if not any(sure):
        return shown
    found = _verdicts(query, sure, worlds)
    wanted = tuple(Counter(column).most_common(1)[0][0] for column in zip(*found, strict=True))
    if _verdicts(query, sure, shown)[0] == wanted:
        return shown
    nearest = np.argsort(np.linalg.norm(rows, axis=1))
    for row in [int(k) for k in nearest if found[k] == wanted][:TRIES]:
        tried = [_run(each, rows[row : row + 1]) for each in given]
        if _verdicts(query, sure, tried)[0] == wanted:
            return tried
    return shown


def _verdicts(query: Query, sure: Sequence[bool], worlds: Sequence[ObservedWorlds]) -> list[tuple[int, ...]]:
    """Per draw, the answers that are sure: of each world, or whether they differ where that is asked. Then whether
    each thing stays where it is put before."""
    answers = [answers_of(query, each.events) for each in worlds]
    if query.asked.form == "changes":
        told = [[int(one != other) for one, other in zip(*answers, strict=True)]]
    else:
        told = [each for each, is_sure in zip(answers, sure, strict=True) if is_sure]
    stays = [placements.stays.astype(int).tolist() for placements in worlds[0].worlds.before]
    return list(zip(*told, *stays, strict=True))


def decide(query: Query, events: WorldEvents, draws: Floats) -> Decided:
    """The answer of an ensemble with draws [K, P]."""
    asked, answers = query.asked, answers_of(query, events)
    answer, _ = max(Counter(answers).items(), key=lambda item: (item[1], item[0]))
    agrees = np.array([found == answer for found in answers])
    misread = _misread(events)
    probability = shown = float(np.where(misread, 0.5, agrees).mean())  # what was misread tells neither way
    times = _happens(query, events)
    times = times[np.isfinite(times)]
    if asked.form in ("whether", "when"):  # that the event happens, or, if negated, does not
        happens = probability if answer else 1 - probability
        shown = 1 - happens if asked.negated else happens
    return Decided(
        probability=shown,
        sure=probability >= (query.sure_of_miss if answer <= 0 else query.sure),
        robust=probability >= ROBUST,
        depends_on=_depends_on(agrees, draws, misread),
        first=answer if asked.form in FIRST_MET and answer >= 0 else None,
        count=answer if asked.form == "how-many" else None,
        **_timed(_happens(query, events)),
    )


def _misread(events: WorldEvents) -> Mask:
    """[K]: which worlds tell neither way."""
    return np.zeros(len(events.moved), bool) if events.misread is None else events.misread


def _timed(times: Floats) -> dict[str, Any]:
    """When it happens, by times [K] s, as fields of what is decided."""
    times = times[np.isfinite(times)]
    if not len(times):
        return {}
    band = float(np.quantile(times, 0.1)), float(np.quantile(times, 0.9))
    return {"time": float(np.median(times)), "time_band": band}


def decide_each(query: Query, events: WorldEvents, told: Sequence[Told], draws: Floats) -> Decided:
    """What is so of each candidate, and how many worlds say that of all of them.

    Where each is taken away in turn, that changes nothing in worlds in which it does not happen anyway: if most are
    such worlds, the answer is that nothing has to be taken away.
    """
    negated, bodies = query.asked.negated, query.among
    turned = negated != query.is_of_removal  # what is told is that it does not happen
    misread, shape = _misread(events), (len(told), len(draws))
    happens, unclear = (
        np.array([getattr(each, n) for each in told], bool).reshape(shape) for n in ("happens", "misread")
    )
    shares = np.where(unclear, 0.5, happens != turned).mean(axis=1)
    is_so = shares >= 0.5
    enough = np.where(is_so != turned, query.sure, query.sure_of_miss)
    sure = np.maximum(shares, 1 - shares) >= enough
    agrees, as_it_is = ((happens != turned) == is_so[:, None]).all(axis=0), None
    if query.is_of_removal:
        there = np.isfinite(_happens(query.of(None), events)) != negated
        as_it_is = float(np.where(misread, 0.5, there).mean())
        agrees = agrees & there if as_it_is >= 0.5 else ~there
    misread = misread | unclear.any(axis=0)
    probability = float(np.where(misread, 0.5, agrees).mean())
    return Decided(
        probability=probability,
        sure=bool(sure.all()) and probability >= query.sure_of_miss,
        robust=probability >= ROBUST,
        depends_on=_depends_on(agrees, draws, misread),
        candidates=tuple(
            Candidate(body, float(share), bool(is_sure), each)
            for body, share, is_sure, each in zip(bodies, shares, sure, told, strict=True)
        ),
        as_it_is=as_it_is,
        **_timed(_happens(query.of(None) if query.is_of_removal else query, events)),
    )


def decide_change(query: Query, changed: WorldEvents, factual: WorldEvents, draws: Floats) -> Decided:
    """Whether the answer differs between two ensembles with the same draws [K, P]."""
    pairs = zip(answers_of(query, changed), answers_of(query, factual), strict=True)
    differs = np.array([one != other for one, other in pairs])
    share = float(differs.mean())
    probability = max(share, 1 - share)
    return Decided(
        probability=1 - share if query.asked.negated else share,
        sure=probability >= query.sure_of_miss,
        robust=probability >= ROBUST,
        depends_on=_depends_on(differs == (share >= 0.5), draws),
    )


def answers_of(query: Query, events: WorldEvents) -> list[int]:
    """Per draw: 1 or 0 for whether and when, the body that is met first or -1, how many are met, or which, as a number.

    Of `changes` it is the answer whose change is asked about: whether the target is met, or what is met first.
    """
    asked, times = query.asked, _per_body(query, events)
    if asked.form in FIRST_MET or (asked.form == "changes" and query.target is None):
        first = times.argmin(axis=1)
        return np.where(np.isfinite(times.min(axis=1)), first, -1).tolist()
    if asked.form == "how-many":
        return np.isfinite(times).sum(axis=1).tolist()
    if asked.form == "which":
        return [int.from_bytes(row.tobytes()) for row in np.packbits(np.isfinite(times), axis=1)]
    return np.isfinite(_happens(query, events)).astype(int).tolist()


def _happens(query: Query, events: WorldEvents) -> Floats:
    """[K]: when it has happened with any of the bodies that are meant or, where that is asked, with each of them."""
    times = _per_body(query, events)
    if not query.asked.every or not query.among:
        return times.min(axis=1)
    is_there = max(query.among) < times.shape[1]  # what was taken away is numbered behind the others
    return times[:, list(query.among)].max(axis=1) if is_there else np.full(len(times), NEVER)


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


def _depends_on(same: Mask, draws: Floats, misread: Mask | None = None) -> tuple[Doubt, ...]:
    """Doubts whose parameters go with the answer, the closest first; where many worlds were misread, places."""
    weights: dict[Doubt, float] = {}
    least = MATTERS * max(1.0, sqrt(MATTERS_OF / len(draws)))  # of fewer worlds chance makes larger ones
    for place, name in enumerate(NAMES):
        column = draws[:, place]
        spread = float(same.std() * column.std())
        related = abs(float(((same - same.mean()) * (column - column.mean())).mean())) / spread if spread > 0 else 0.0
        if related >= least:
            doubt = PARAMETERS[name]
            weights[doubt] = max(weights.get(doubt, 0.0), related)
    ranked: Sequence[Doubt] = sorted(weights, key=lambda doubt: -weights[doubt])
    if misread is not None and misread.mean() > MATTERS:
        ranked = ["place", *(doubt for doubt in ranked if doubt != "place")]
    return tuple(ranked[:MOST_NAMED])
