"""Removes what is no longer needed: jobs past their retention, and artifacts that no job refers to."""

import logging
import math
import time
from collections import Counter
from collections.abc import Callable, Collection, Generator
from itertools import islice

from cow_service.jobs.computing import EngineParts
from cow_service.jobs.database import Database
from cow_service.media.artifacts import ArtifactStore, ListedArtifact
from cow_service.service import Service

CLEAN_UP_SECONDS = 600.0  # between two rounds
TURN_SECONDS = 0.9 * CLEAN_UP_SECONDS  # since the last one of any process, which may have begun late
# The same where artifacts are listed, which costs seconds for hundreds of thousands. It must be done sooner only where
# they have a budget: without a reference they are kept for an hour anyway.
LISTING_SECONDS = 0.9 * 3600.0
RENEWAL_SECONDS = 60.0  # after which the turn of a listing that goes on is taken again: it may last longer than a turn
MAX_REMOVED_JOBS = 200  # at a time
CHUNK = 1000  # artifacts that are looked at together
# Both are longer than an object store's times of use may be wrong.
UNREFERENCED_GRACE_SECONDS = 3600.0  # that an artifact is kept without a reference: a request may be about to name it
BUDGET_GRACE_SECONDS = 900.0  # that it is kept after its last use, whatever the budget: a stage may be about to refer
LEFTOVER_SECONDS = 24 * 3600.0  # that a temporary file is kept after it was last written to

log = logging.getLogger("cow_service")


def clean_up(parts: EngineParts, stop: Callable[[], bool]) -> None:
    """Does what no other process has done lately, until `stop` says so."""
    database, settings = parts.database, parts.service.settings
    if database.take_turn("jobs", TURN_SECONDS):
        remove_old_jobs(parts, stop)
    seconds = LISTING_SECONDS if settings.artifacts_max_gb is None else TURN_SECONDS
    if stop() or not database.take_turn("artifacts", seconds):
        return

    def stop_or_renew() -> bool:  # between two chunks
        database.take_turn("artifacts", RENEWAL_SECONDS)
        return stop()

    is_done = False
    try:
        collect_artifacts(parts.service, database, stop_or_renew)
        is_done = not stop()
    finally:
        if not is_done:
            database.give_turn_back("artifacts")  # an hour is long


def remove_old_jobs(parts: EngineParts, stop: Callable[[], bool]) -> None:
    """Removes jobs past their retention."""
    before = time.time() - 3600.0 * parts.service.settings.job_retention_hours
    while not stop() and (jobs := parts.jobs.ended_before(before, MAX_REMOVED_JOBS)):
        remove(parts, jobs, before)
    if not stop():
        parts.database.give_room_back(stop)


def remove(parts: EngineParts, jobs: list[str], untouched_since: float) -> None:
    """Removes jobs that have ended, and those of their artifacts that were not used since (Unix time, s)."""
    parts.service.artifacts.delete(parts.jobs.delete(jobs), untouched_since + 1)


def collect_artifacts(service: Service, database: Database, stop: Callable[[], bool], now: float | None = None) -> None:
    """Removes what is no longer needed, as of `now` (Unix time, s; by default the clock's), until `stop` says so.

    The store is listed in chunks, one in memory at a time; a second listing finds the least recently used.

    What is used meanwhile stays, however long this takes: whoever refers to an artifact has used it within the grace
    before that. One without a reference in the database, whose last use, looked up again right before it is deleted,
    was before the grace of the start, has got none since.
    """
    now = time.time() if now is None else now
    store, max_gb = service.artifacts, service.settings.artifacts_max_gb
    store.remove_leftovers(now - LEFTOVER_SECONDS)
    max_bytes = math.inf if max_gb is None else max_gb * 1e9
    # Those of jobs that become open later are protected by their last use. A queue's limit keeps these few.
    in_use = set[str]() if max_gb is None else database.referenced_by_open_jobs()
    grace, removed, total = now - UNREFERENCED_GRACE_SECONDS, 0, 0
    removable: Counter[int] = Counter()  # bytes that the budget may remove, by the class of their age
    for chunk in _chunks(store, stop):
        old = {one.sha256 for one in chunk if one.used_at <= grace}
        deleted = store.delete(old - database.referenced(old), grace)
        removed += len(deleted)
        for one in chunk:
            if one.sha256 not in deleted:
                total += one.size
                if one.used_at <= now - BUDGET_GRACE_SECONDS and one.sha256 not in in_use:
                    removable[_age_class(now - one.used_at)] += one.size
    if removed:
        log.info("removed %d artifacts that no job refers to", removed)
    if total > max_bytes and not stop():
        total -= _remove_longest_unused(store, stop, now, in_use, removable, total - max_bytes)
        if total > max_bytes:
            shown = total / 1e9, max_gb
            log.warning("artifacts have %.1f GB, more than COW_ARTIFACTS_MAX_GB=%g: the rest is in use", *shown)


def _remove_longest_unused(
    store: ArtifactStore,
    stop: Callable[[], bool],
    now: float,
    in_use: Collection[str],
    removable: Counter[int],
    excess: float,
) -> int:
    """Removes artifacts of the highest classes of ages, of the last class as many as it takes; returns their bytes."""
    for last_class in sorted(removable, reverse=True):
        if removable[last_class] >= excess:
            break
        excess -= removable[last_class]
    else:
        last_class = -1  # not even all of them are enough
    removed = removed_bytes = 0
    for chunk in _chunks(store, stop) if removable else ():
        sizes: dict[str, int] = {}
        for one in chunk:
            age_class = _age_class(now - one.used_at)
            if age_class < last_class or one.used_at > now - BUDGET_GRACE_SECONDS or one.sha256 in in_use:
                continue
            if age_class == last_class:
                if excess <= 0:
                    continue
                excess -= one.size
            sizes[one.sha256] = one.size
        deleted = store.delete(sizes, now - BUDGET_GRACE_SECONDS)
        removed += len(deleted)
        removed_bytes += sum(sizes[sha256] for sha256 in deleted)
    log.info("removed %d artifacts for COW_ARTIFACTS_MAX_GB", removed)
    return removed_bytes


def _chunks(store: ArtifactStore, stop: Callable[[], bool]) -> Generator[list[ListedArtifact]]:
    """All artifacts of a store, until `stop` says so."""
    listed = store.listed()
    while not stop() and (chunk := list(islice(listed, CHUNK))):
        yield chunk


def _age_class(seconds: float) -> int:
    """Ages that differ by less than a hundredth are of one class: some two thousand classes are all there are."""
    return int(64 * math.log2(max(seconds, 1.0)))
