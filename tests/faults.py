"""What can happen to a program, to its machine, and to the network before it, and how each is set right again."""

from __future__ import annotations

import errno
import shutil
import signal
import struct
import subprocess
import threading
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path

import psutil
import psycopg
import pytest
from postgres import PostgresServer
from proxy import Proxy
from servers import Program, send
from waiting import TIME_LIMIT, eventually


class Machine:
    """The disk and the clock of a program's processes, which can fail: `machine.c`, preloaded. The disk has `data`."""

    def __init__(self, folder: Path) -> None:
        self._files, self._disk, self._state = folder / "data", folder / "disk", folder / "state"
        for one in (self._files, self._disk):
            one.mkdir(parents=True)
        self._state.write_bytes(bytes(16))
        self.environment = {
            "MACHINE_FILES": str(self._files),
            "MACHINE_DISK": str(self._disk),
            "MACHINE_STATE": str(self._state),
            "LD_PRELOAD": str(_compiled(folder.parent / "machine.so")),
        }

    def fail_writes(self, error: int = 0) -> None:
        """From now on whatever writes has this error, or none."""
        self._set(0, error)

    def set_clock(self, seconds: int = 0) -> None:
        """From now on the clock is ahead by a number of seconds."""
        self._set(8, seconds)

    def _set(self, place: int, value: int) -> None:
        with self._state.open("r+b") as file:  # it is mapped: it must stay the same file
            file.seek(place)
            file.write(struct.pack("=q", value))

    def lose_power(self) -> None:
        """Once all its processes were killed: the files are as they were synced."""
        shutil.rmtree(self._files)
        shutil.copytree(self._disk, self._files, ignore=shutil.ignore_patterns(".*"))
        shutil.rmtree(self._disk / ".inodes")


def _compiled(library: Path) -> Path:
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("no C compiler: disks and clocks fail by a library that is preloaded")
    if not library.exists():
        source = Path(__file__).with_name("machine.c")
        subprocess.run([compiler, "-O1", "-shared", "-fPIC", "-o", library, source, "-ldl"], check=True)
    return library


@dataclass
class Station:
    """A program on a machine of its own; `url` where it is a server."""

    program: Program
    machine: Machine
    url: str | None = None
    halts: int = 0  # faults that stop its processes, so far
    is_halted: bool = False


@dataclass(frozen=True)
class Fault:
    """Something that goes wrong, and how it is set right again. `halts`: the station does not answer meanwhile."""

    name: str
    strike: Callable[[], object]
    heal: Callable[[], object] = lambda: None
    station: Station | None = None
    halts: bool = False


def faults_of(name: str, station: Station) -> list[Fault]:
    """Everything that can happen to a program and its machine."""
    program, machine = station.program, station.machine
    frozen: list[psutil.Process] = []
    slowed = Slowness(program)

    def kill() -> None:
        assert program.process is not None
        program.process.kill()  # those that it has started must notice
        program.process.wait()

    def stop() -> None:
        assert program.process is not None
        program.process.terminate()
        program.process.wait(TIME_LIMIT)

    def crash_workers() -> None:
        send(program.processes()[:-1], signal.SIGKILL)

    def freeze(first: int | None = None) -> None:
        frozen[:] = program.processes()[:first]
        send(frozen, signal.SIGSTOP)

    def thaw() -> None:
        send(frozen, signal.SIGCONT)

    return [
        Fault(f"kill {name}", kill, program.launch, station, halts=True),
        Fault(f"stop {name}", stop, program.launch, station, halts=True),
        Fault(f"freeze {name}", freeze, thaw, station, halts=True),
        Fault(f"slow {name}", slowed.begin, slowed.end, station, halts=True),
        Fault(f"crash of {name}'s workers", crash_workers, station=station),
        Fault(f"freeze {name}'s workers", lambda: freeze(-1), thaw, station),
        Fault(f"full disk of {name}", lambda: machine.fail_writes(errno.ENOSPC), machine.fail_writes, station),
        Fault(f"read-only disk of {name}", lambda: machine.fail_writes(errno.EROFS), machine.fail_writes, station),
        Fault(f"clock of {name} ahead", lambda: machine.set_clock(5000), machine.set_clock, station),
        Fault(f"clock of {name} behind", lambda: machine.set_clock(-5000), machine.set_clock, station),
    ]


def faults_of_network(name: str, network: Proxy) -> list[Fault]:
    """Everything that can happen between a program and what it needs."""

    def lose() -> None:  # also what is held
        network.cut()
        network.restore()

    return [
        Fault(f"silence of {name}", network.hold, network.restore),
        Fault(f"half-open connections to {name}", lambda: network.hold(requests=False), lose),
        Fault(f"cut connections to {name}", network.cut),
    ]


def power_cut(station: Station) -> Fault:
    """All processes end at once, and what was not synced is gone."""

    def strike() -> None:
        station.program.end()
        station.machine.lose_power()

    return Fault("power cut", strike, station.program.launch, station, halts=True)


def a_second_server(station: Station) -> Fault:
    """Somebody starts another server on the same folder. It is refused while the first one lives."""
    others: list[subprocess.Popen[bytes]] = []

    def end() -> None:
        for other in others:
            other.kill()
            other.wait()

    return Fault("a second server on the folder", lambda: others.append(station.program.another()), end, station)


def a_cleaner(station: Station) -> Fault:
    """Somebody deletes all that looks temporary."""

    def clean() -> None:
        for one in station.program.data.rglob("*"):
            if one.is_file() and (one.suffix == ".lock" or one.name.startswith("tmp")):
                one.unlink(missing_ok=True)

    return Fault("a cleaner of temporary files", clean, station=station)


def faults_of_database(database: PostgresServer) -> list[Fault]:
    """What people and failovers do to PostgreSQL."""
    held = ExitStack()

    def lock() -> None:
        with suppress(psycopg.OperationalError):  # it is away
            held.enter_context(database.locked_tables())

    def unlock() -> None:
        with suppress(psycopg.OperationalError):  # it was away meanwhile
            held.close()

    def demote() -> None:
        with suppress(psycopg.OperationalError):
            database.set_read_only(True)

    def is_promoted() -> bool:
        try:
            database.set_read_only(False)
        except psycopg.OperationalError:
            return False
        return True

    def promote() -> None:
        eventually(is_promoted)

    return [Fault("a standby in place of the database", demote, promote), Fault("locked tables", lock, unlock)]


class Slowness:
    """Lets the processes of a program run a fifth of the time."""

    def __init__(self, program: Program) -> None:
        self._program, self._stop = program, threading.Event()
        self._thread = threading.Thread()

    def begin(self) -> None:
        self._stop.clear()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def end(self) -> None:
        self._stop.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._stop.is_set():
            processes = self._program.processes()
            send(processes, signal.SIGSTOP)
            self._stop.wait(0.08)
            send(processes, signal.SIGCONT)
            self._stop.wait(0.02)
