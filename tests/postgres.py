"""A PostgreSQL server of our own, from whatever Debian's packages have put here, for as long as the tests run."""

from __future__ import annotations

import os
import shutil
import signal
import socket
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import psutil
import pytest
from servers import send
from waiting import TIME_LIMIT

REQUIRED = "COW_TEST_POSTGRES"  # set where a missing PostgreSQL is a fault and not a reason to skip


class PostgresServer:
    """An empty database, whose server can be killed and started again."""

    def __init__(self, programs: Path, folder: Path) -> None:
        self._programs, self._folder, self._data = programs, folder, str(folder / "data")
        self._as_user = ["runuser", "-u", "postgres", "--"] if os.getuid() == 0 else []  # it refuses to run as root
        if self._as_user:
            shutil.chown(folder, "postgres")
        with socket.socket() as one:
            one.bind(("127.0.0.1", 0))
            self.port = one.getsockname()[1]
        self.url = f"postgresql://cow@127.0.0.1:{self.port}/cow"
        self._run("initdb", "-D", self._data, "-U", "cow", "-A", "trust", "--no-sync")
        self.start()
        self._run("createdb", "-h", "127.0.0.1", "-p", str(self.port), "-U", "cow", "cow")

    def start(self) -> None:
        # Commits without a waiter are written late, so a crash shows which ones should have been waited for.
        options = f"-p {self.port} -h 127.0.0.1 -k {self._folder} -c wal_writer_delay=10s"
        self._run("pg_ctl", "-D", self._data, "-l", str(self._folder / "log"), "-w", "-o", options, "start")

    def kill(self) -> None:
        """Ends every process of the server at once. What it had not handed to the system is gone."""
        pid = (self._folder / "data" / "postmaster.pid").read_text().split()[0]
        children = Path(f"/proc/{pid}/task/{pid}/children").read_text()  # psutil would look through all of /proc
        processes: list[psutil.Process] = []
        for one in [pid, *children.split()]:
            with suppress(psutil.NoSuchProcess):
                processes.append(psutil.Process(int(one)))
        send(processes, signal.SIGKILL)
        psutil.wait_procs(processes)

    def run_script(self, file: Path, **variables: str) -> None:
        """Has psql run a file as the owner of the database."""
        command = [str(self._programs / "psql"), "--set", "ON_ERROR_STOP=1", "--file", str(file), self.url]
        subprocess.run(command, check=True, env=os.environ | variables, stdout=subprocess.DEVNULL, timeout=TIME_LIMIT)

    def stop(self) -> None:
        command = [*self._as_user, str(self._programs / "pg_ctl"), "-D", self._data, "-m", "immediate", "stop"]
        subprocess.run(command, check=False, cwd="/")

    def _run(self, program: str, *arguments: str) -> None:
        # The server's output is not read: it would keep a pipe open.
        command = [*self._as_user, str(self._programs / program), *arguments]
        subprocess.run(command, check=True, cwd="/", stdout=subprocess.DEVNULL, timeout=TIME_LIMIT)


@contextmanager
def postgres() -> Iterator[PostgresServer]:
    """A server, which is gone afterwards. Skips the test where there is no PostgreSQL."""
    found = sorted(Path("/usr/lib/postgresql").glob("*/bin/initdb"))
    in_path = shutil.which("initdb")
    programs = found[-1].parent if found else Path(in_path).parent if in_path else None
    if programs is None:
        if os.environ.get(REQUIRED):
            pytest.fail("PostgreSQL is not installed: apt-get install postgresql")
        pytest.skip("PostgreSQL is not installed: apt-get install postgresql")
    folder = Path(tempfile.mkdtemp(prefix="cow-postgres-"))
    server = PostgresServer(programs, folder)
    try:
        yield server
    finally:
        server.stop()
        shutil.rmtree(folder, ignore_errors=True)
