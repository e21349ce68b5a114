"""Starts worker processes, the first one ahead of its work: it imports what it needs while its parent does."""

from __future__ import annotations

from cow_service import processes
from cow_service.processes import Spawned

MODULE = "cow_service.workers"

_ahead: list[Spawned] = []


def spawn_ahead() -> None:
    """Starts a process for the first caller of `spawn`."""
    _ahead.append(processes.spawn(MODULE))


def spawn() -> Spawned:
    """The process that was started ahead, or a new one. It waits for its settings."""
    return _ahead.pop() if _ahead else processes.spawn(MODULE)
