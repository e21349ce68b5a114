"""Processes that end with the one that started them: each has a pipe to it, and ends as soon as that does."""

from __future__ import annotations

import signal
import subprocess
import sys
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

OOM_SCORE = "500"  # the system ends such a process before the one that holds the jobs


@dataclass(frozen=True)
class Spawned:
    """A process that waits for its first message, and the pipe to it."""

    process: subprocess.Popen[bytes]
    pipe: Connection[Any, Any]


def spawn(module: str) -> Spawned:
    """Starts `python -m MODULE FD`, where FD is its end of the pipe."""
    ours, theirs = Pipe()
    with theirs:
        command = [sys.executable, "-m", module, str(theirs.fileno())]
        return Spawned(subprocess.Popen(command, pass_fds=[theirs.fileno()]), ours)


def leave_decisions_to_the_parent() -> None:
    """Called by such a process at its start."""
    # A terminal's Ctrl-C and a service manager's stop reach every process: the one that holds the jobs decides.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    with suppress(OSError):  # elsewhere than on Linux
        Path("/proc/self/oom_score_adj").write_text(OOM_SCORE)
