"""Programs that begin where their imports are done: a process that has made them forks itself for each command.

Each command is a process of its own, with its own output, folder and environment: it can be killed, interrupted, and
ends with its own exit code. Imports that take seconds are made once for all of them.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

# Each line of its input is a request: to fork, or to wait for a process; it says the process's number, or exit code.
TEMPLATE = """
import functools, gc, importlib.metadata, json, os, sys
# Inspect asks for each of its tasks; half a second each time.
importlib.metadata.packages_distributions = functools.cache(importlib.metadata.packages_distributions)
importlib.metadata.packages_distributions()
from cow_service.cli.main import app
for name in sys.argv[1:]:
    importlib.import_module(name)
gc.freeze()  # what was imported is no garbage: no command looks through it at its end
print("ready", flush=True)
for line in sys.stdin:
    asked = json.loads(line)
    if "wait" in asked:
        print(os.waitstatus_to_exitcode(os.waitpid(asked["wait"], 0)[1]), flush=True)
        continue
    pid = os.fork()
    if pid:
        print(pid, flush=True)
        continue
    for place, name in enumerate((os.devnull, asked["out"], asked["err"])):
        file = os.open(name, os.O_RDWR | os.O_CREAT, 0o600)
        os.dup2(file, place)
        os.close(file)
    os.chdir(asked["folder"])
    os.environ.clear()
    os.environ.update(asked["environment"])
    sys.argv = ["cow", *asked["arguments"]]
    app()
"""


@dataclass
class Running:
    """A command that was begun."""

    template: Template
    pid: int
    out: Path
    err: Path

    def send_signal(self, number: int) -> None:
        os.kill(self.pid, number)

    def wait(self) -> int:
        """Its exit code; of one that was ended by a signal, the negative number of that."""
        return self.template.ask(wait=self.pid)

    def done(self) -> subprocess.CompletedProcess[str]:
        code = self.wait()
        return subprocess.CompletedProcess((), code, self.out.read_text(), self.err.read_text())


class Template:
    """The process that is forked."""

    def __init__(self, process: subprocess.Popen[str], folder: Path) -> None:
        self._process, self._folder, self._count = process, folder, 0

    def ask(self, **asked: Any) -> int:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        print(json.dumps(asked), file=self._process.stdin, flush=True)
        return int(self._process.stdout.readline())

    def begin(self, arguments: Sequence[str], folder: Path, environment: Mapping[str, str]) -> Running:
        """A `cow` command in a folder."""
        self._count += 1
        out, err = (self._folder / f"{self._count}.{name}" for name in ("out", "err"))
        asked = {"arguments": list(arguments), "folder": str(folder), "environment": dict(environment)}
        return Running(self, self.ask(**asked, out=str(out), err=str(err)), out, err)


@contextmanager
def template(folder: Path, modules: Sequence[str], environment: Mapping[str, str]) -> Iterator[Template]:
    """A process that has imported these modules; it ends with the block, and with it what it has begun."""
    command = [sys.executable, "-c", TEMPLATE, *modules]
    pipes: Any = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with subprocess.Popen(command, cwd=folder, env=environment, start_new_session=True, **pipes) as process:
        assert process.stdout is not None
        try:
            assert process.stdout.readline() == "ready\n"
            yield Template(process, folder)
        finally:
            os.killpg(process.pid, signal.SIGKILL)
