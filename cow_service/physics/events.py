"""What the mover meets in worlds that were run: when it first touches, covers or is covered by each other body."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cow_service.physics.bodies import SeenBody
from cow_service.physics.draws import COLUMN
from cow_service.physics.occlusion import shares
from cow_service.physics.projection import seen_paths
from cow_service.physics.world import Worlds
from cow_service.records import Encounter, EncounterKind
from cow_service.vision.types import Floats, Mask

COVERED = 0.3  # share of a silhouette from which it counts as covered
COVERED_SIGMA = 0.2  # of its logarithm: outlines are inexact, and so is what people call hidden
KINDS: tuple[EncounterKind, ...] = ("touches", "occludes", "occluded-by")
NEVER = math.inf
PerKind = dict[EncounterKind, Floats]  # [K, B] each


@dataclass(frozen=True)
class Events:
    """Per kind of encounter, draw and body: the first time (s, infinity for never) and the largest share covered."""

    times: PerKind
    shares: PerKind  # 0 for touches
    eligible: Mask  # [B]: neither the mover nor what it stands on
    placed: Floats | None = None  # [K] s: when the mover is where it was to be put; infinite where it does not fit

    def happens(self, kind: EncounterKind) -> Mask:
        """[K, B]."""
        return np.isfinite(self.times[kind])


def find_events(worlds: Worlds, bodies: Sequence[SeenBody], fps: float, draws: Floats) -> Events:
    """The events of every draw [K, P]. What the mover stands on at the start is no encounter."""
    enough = COVERED * np.exp(COVERED_SIGMA * draws[:, COLUMN["outline"]])[:, None]
    count = len(bodies)
    eligible = np.ones(count, bool)
    eligible[[0, *(on for on in worlds.scene.supports[:1] if on is not None)]] = False
    times: PerKind = {kind: np.full((len(draws), count), NEVER) for kind in KINDS}
    most: PerKind = {kind: np.zeros((len(draws), count)) for kind in KINDS}
    for k, run in enumerate(worlds.runs):
        for meeting in run.meetings:
            if meeting.a == 0 and meeting.b is not None and eligible[meeting.b]:
                times["touches"][k, meeting.b] = min(times["touches"][k, meeting.b], meeting.time)
    path, step = seen_paths(worlds, 0), worlds.every / fps
    clock = np.arange(path.depth.shape[1]) * step
    for other in np.nonzero(eligible)[0].tolist():
        depth = worlds.scene.cameras.depth(worlds.scene.bodies[other].centre)
        found = shares(bodies[0].mask, path, bodies[other].mask, depth)
        before = clock[None] <= times["touches"][:, other : other + 1] + step
        for kind, values in zip(KINDS[1:], (found.covers, found.covered), strict=True):
            seen = np.where(before, values, 0.0)
            most[kind][:, other] = seen.max(axis=1)
            times[kind][:, other] = np.where(seen >= enough, clock[None], NEVER).min(axis=1)
    return Events(times, most, eligible, None if worlds.placements is None else worlds.placements.times)


def encounters(
    likeliest: Events, ensemble: Events | None, bodies: Sequence[SeenBody], fps: float, num_frames: int
) -> tuple[Encounter, ...]:
    """Those of the likeliest world, in the order of their first frame, with their share of the ensemble's worlds."""
    found: list[Encounter] = []
    for kind in KINDS:
        for body in np.nonzero(likeliest.happens(kind)[0])[0].tolist():
            frame = math.ceil(likeliest.times[kind][0, body] * fps - 1e-6)
            share = None if kind == "touches" else float(likeliest.shares[kind][0, body])
            likely = None if ensemble is None else float(ensemble.happens(kind)[:, body].mean())
            found.append(
                Encounter(
                    object=bodies[body].name,
                    bbox=bodies[body].bbox,
                    body=body,
                    kind=kind,
                    first_frame=min(frame, num_frames - 1),
                    share=share,
                    probability=likely,
                )
            )
    return tuple(sorted(found, key=lambda encounter: encounter.first_frame))
