"""Runs the worlds of a scene: the ensemble, what the question comes to in it, and the world that is shown."""

from __future__ import annotations

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
class Ran:
    """Worlds with what happens in them."""

    worlds: Worlds
    events: WorldEvents


@dataclass(frozen=True)
class Imagined:
    """The world that is shown, and what an ensemble around it says."""

    given: WorldInput
    shown: Worlds
    events: WorldEvents  # of the shown world
    around: Worlds | None  # the ensemble's
    around_events: WorldEvents | None
    query: Query | None
    decided: Decided | None  # null where nothing is asked, or there is no ensemble


def imagine(world: WorldInput, query: Query | None, size: int) -> tuple[Imagined, ...]:
    """Runs the likeliest world and an ensemble of `size` worlds around it; where something is changed first, also
    the world as it is, with the same draws, as the second.

    What is shown must not contradict what is answered: where an answer is sure and the likeliest world differs from
    it, the likeliest world of those that agree is shown.
    """
    given = (world, world.as_it_is()) if world.is_changed else (world,)
    queries = [query if len(given) == 1 else _as_it_is(query, place) for place in range(len(given))]
    if size == 0:
        shown = [_run(each, likeliest()) for each in given]
        return tuple(
            Imagined(each, ran.worlds, ran.events, None, None, asked, None)
            for each, ran, asked in zip(given, shown, queries, strict=True)
        )
    rows = ensemble(size)
    # Side by side: the engine's steps, half of the time, are not held up by the interpreter's lock.
    with ThreadPoolExecutor(1) as beside:
        likely = beside.submit(lambda: [_run(each, likeliest()) for each in given])
        around = [_run(each, rows, EVERY) for each in given]
        shown = likely.result()
    decided = _decided(queries, around, rows)
    if query is not None and any(each is not None and each.sure for each in decided):
        shown = _agreeing(given, query, decided, rows, around, shown)
    return tuple(
        Imagined(each, one.worlds, one.events, many.worlds, many.events, asked, said)
        for each, one, many, asked, said in zip(given, shown, around, queries, decided, strict=True)
    )


def _as_it_is(query: Query | None, place: int) -> Query | None:
    """What is asked of the world as it is, the second, where a change is asked about: what it is that would change."""
    if query is None or place == 0 or query.asked.form != "changes":
        return query
    form = "what-happens" if query.target is None else "whether"
    return replace(query, asked=query.asked.model_copy(update={"form": form, "negated": False}))


def _decided(queries: Sequence[Query | None], around: Sequence[Ran], rows: Floats) -> list[Decided | None]:
    found: list[Decided | None] = []
    for query, ran in zip(queries, around, strict=True):
        if query is None:
            found.append(None)
        elif query.asked.form != "changes":
            found.append(decide(query, ran.events, rows))
        else:
            found.append(decide_change(query, ran.events, around[1].events, rows) if len(around) > 1 else None)
    return found


def _agreeing(
    given: Sequence[WorldInput],
    query: Query,
    decided: Sequence[Decided | None],
    rows: Floats,
    around: Sequence[Ran],
    shown: list[Ran],
) -> list[Ran]:
    """The likeliest world, with its counterpart, that shows what most of the ensemble does."""
    sure = [each is not None and each.sure for each in decided]
    found = _verdicts(query, sure, around)
    wanted = tuple(Counter(column).most_common(1)[0][0] for column in zip(*found, strict=True))
    if _verdicts(query, sure, shown)[0] == wanted:
        return shown
    nearest = np.argsort(np.linalg.norm(rows, axis=1))
    for row in [int(k) for k in nearest if found[k] == wanted][:TRIES]:
        tried = [_run(each, rows[row : row + 1]) for each in given]
        if _verdicts(query, sure, tried)[0] == wanted:
            return tried
    return shown


def _verdicts(query: Query, sure: Sequence[bool], ran: Sequence[Ran]) -> list[tuple[int, ...]]:
    """Per draw, the answers that are sure: of each world, or whether they differ where that is asked. Then whether
    each thing stays where it is put before."""
    answers = [answers_of(query, each.events) for each in ran]
    if query.asked.form == "changes":
        told = [[int(one != other) for one, other in zip(*answers, strict=True)]]
    else:
        told = [each for each, is_sure in zip(answers, sure, strict=True) if is_sure]
    stays = [placements.stays.astype(int).tolist() for placements in ran[0].worlds.before]
    return list(zip(*told, *stays, strict=True))


def _run(world: WorldInput, draws: Floats, every: int = 1) -> Ran:
    worlds = run_world(world, draws, every)
    return Ran(worlds, find_world_events(worlds, world.bodies, world.fps, draws, world.size))
