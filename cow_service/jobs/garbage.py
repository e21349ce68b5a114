"""Removes artifacts: those that no job refers to, and beyond a budget in bytes those that were not used for longest."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable

from cow_service.jobs import state
from cow_service.jobs.database import Database
from cow_service.media.artifacts import ArtifactStore, ListedArtifact
from cow_service.service import Service

# Both are longer than an object store's times of use may be wrong.
UNREFERENCED_GRACE_SECONDS = 3600.0  # that an artifact is kept without a reference: a request may be about to name it
BUDGET_GRACE_SECONDS = 900.0  # that it is kept after its last use, whatever the budget: a stage may be about to refer
LEFTOVER_SECONDS = 24 * 3600.0  # that a temporary file is kept after it was last written to

log = logging.getLogger("cow_service")


def collect_artifacts(service: Service, database: Database, stop: Callable[[], bool], now: float | None = None) -> None:
    """Removes what is not needed any more, as of `now` (Unix time, s; by default the clock's), until `stop` says so."""
    now = time.time() if now is None else now
    store, max_gb = service.artifacts, service.settings.artifacts_max_gb
    store.remove_leftovers(now - LEFTOVER_SECONDS)
    left = _remove_unreferenced(store, database, list(store.listed()), now - UNREFERENCED_GRACE_SECONDS, stop)
    if max_gb is not None:
        _keep_within(max_gb * 1e9, store, database, left, now - BUDGET_GRACE_SECONDS, stop)


def _remove_unreferenced(
    store: ArtifactStore, database: Database, listed: list[ListedArtifact], moment: float, stop: Callable[[], bool]
) -> list[ListedArtifact]:
    """Returns the artifacts that are left."""
    needed = database.referenced(one.sha256 for one in listed if one.used_at <= moment)
    left: list[ListedArtifact] = []
    for one in listed:
        kept = one.used_at > moment or one.sha256 in needed or stop()
        if kept or not store.delete(one.sha256, moment):
            left.append(one)
    if removed := len(listed) - len(left):
        log.info("removed %d artifacts that no job refers to", removed)
    return left


def _keep_within(
    max_bytes: float,
    store: ArtifactStore,
    database: Database,
    listed: list[ListedArtifact],
    moment: float,
    stop: Callable[[], bool],
) -> None:
    """Removes the longest unused artifacts until all fit, none of an open job and none that was used since `moment`."""
    total = sum(one.size for one in listed)
    if total <= max_bytes:
        return
    needed = database.artifacts_of(state.open_jobs())
    removed = 0
    for one in sorted(listed, key=lambda each: each.used_at):
        if total <= max_bytes or one.used_at > moment or stop():
            break
        if one.sha256 not in needed and store.delete(one.sha256, moment):
            total -= one.size
            removed += 1
    log.info("removed %d artifacts for COW_ARTIFACTS_MAX_GB", removed)
    if total > max_bytes:
        log.warning(
            "artifacts have %.1f GB, more than COW_ARTIFACTS_MAX_GB=%g: what is left is in use",
            total / 1e9,
            max_bytes / 1e9,
        )
