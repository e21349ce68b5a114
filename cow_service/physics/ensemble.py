"""The likeliest world, and the ensemble of worlds around it: what is shown, and how sure that is."""

from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np

from cow_service.physics.draws import ensemble, likeliest
from cow_service.physics.events import WorldEvents, find_world_events
from cow_service.physics.outcome import Decided, Query, answers_of, decide, decide_change
from cow_service.physics.world import WorldInput, Worlds, run_world
from cow_service.vision.types import Floats

EVERY = 2  # frames between those that are recorded of the ensemble
TRIES = 4  # worlds that are tried for one that shows what most of the ensemble does


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
    decided: Decided | None  # null where nothing is asked, or there is no ensemble


def run_ensemble(world: WorldInput, query: Query | None, size: int) -> tuple[EnsembleResult, ...]:
    """Runs the likeliest world and an ensemble of `size` worlds around it; where something is changed first, also
    the world as it is, with the same draws, as the second.

    What is shown must not contradict what is answered: where an answer is sure and the likeliest world differs from
    it, the likeliest world of those that agree is shown.
    """
    given, queries = (world,), [query]
    if world.is_changed:
        as_it_is = query
        if query is not None and query.asked.form == "changes":  # of the world as it is: what it is that would change
            form = "what-happens" if query.target is None else "whether"
            as_it_is = replace(query, asked=query.asked.model_copy(update={"form": form, "negated": False}))
        given, queries = (world, world.as_it_is()), [query, as_it_is]
    if size == 0:
        pairs = zip(given, queries, strict=True)
        return tuple(EnsembleResult(each, _run(each, likeliest()), None, asked, None) for each, asked in pairs)
    rows = ensemble(size)
    # Side by side: the engine's steps, half of the time, are not held up by the interpreter's lock.
    with ThreadPoolExecutor(1) as beside:
        likely = beside.submit(lambda: [_run(each, likeliest()) for each in given])
        worlds = [_run(each, rows, EVERY) for each in given]
        shown = likely.result()
    decided: list[Decided | None] = []
    for asked, each in zip(queries, worlds, strict=True):
        if asked is None or (asked.asked.form == "changes" and len(worlds) == 1):
            decided.append(None)
        elif asked.asked.form == "changes":
            decided.append(decide_change(asked, each.events, worlds[1].events, rows))
        else:
            decided.append(decide(asked, each.events, rows))
    if query is not None and any(each is not None and each.sure for each in decided):
        shown = _agreeing(given, query, decided, rows, worlds, shown)
    return tuple(EnsembleResult(*parts) for parts in zip(given, shown, worlds, queries, decided, strict=True))


def _run(world: WorldInput, draws: Floats, every: int = 1) -> ObservedWorlds:
    worlds = run_world(world, draws, every)
    return ObservedWorlds(worlds, find_world_events(worlds, world.bodies, world.fps, draws, world.size))


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
