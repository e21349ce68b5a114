"""Starts worker processes, the first one ahead of its work: it imports what it needs while its parent does."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import dataclass
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from typing import Any


@dataclass(frozen=True)
class Spawned:
    """A worker process that waits for its settings, and the pipe to it. It ends with that."""

    process: subprocess.Popen[bytes]
    pipe: Connection[Any, Any]


_ahead: list[Spawned] = []


def spawn_ahead() -> None:
    """Starts a process for the first caller of `spawn`."""
    _ahead.append(_spawn())


def spawn() -> Spawned:
    """The process that was started ahead, or a new one."""
    return _ahead.pop() if _ahead else _spawn()


def _spawn() -> Spawned:
    ours, theirs = Pipe()
    with theirs:
        command = [sys.executable, "-m", "cow_service.workers", str(theirs.fileno())]
        return Spawned(subprocess.Popen(command, pass_fds=[theirs.fileno()]), ours)
