"""A PostgreSQL server of our own, from whatever Debian's packages have put here, for as long as the tests run."""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

REQUIRED = "COW_TEST_POSTGRES"  # set where a missing PostgreSQL is a fault and not a reason to skip


def _programs() -> Path | None:
    found = sorted(Path("/usr/lib/postgresql").glob("*/bin/initdb"))
    told = shutil.which("initdb")
    return found[-1].parent if found else Path(told).parent if told else None


@contextmanager
def postgres_server() -> Iterator[str]:
    """The URL of an empty database; the server is gone afterwards. Skips the test where there is no PostgreSQL."""
    programs = _programs()
    if programs is None:
        if os.environ.get(REQUIRED):
            pytest.fail("PostgreSQL is not installed: apt-get install postgresql")
        pytest.skip("PostgreSQL is not installed: apt-get install postgresql")
    folder = Path(tempfile.mkdtemp(prefix="cow-postgres-"))
    as_user = ["runuser", "-u", "postgres", "--"] if os.getuid() == 0 else []  # it refuses to run as root
    if as_user:
        shutil.chown(folder, "postgres")
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        port = one.getsockname()[1]

    def run(program: str, *arguments: str) -> None:
        # Nobody reads the server's output: it would keep a pipe open.
        subprocess.run(
            [*as_user, str(programs / program), *arguments], check=True, cwd="/", stdout=subprocess.DEVNULL, timeout=60
        )

    data, control = str(folder / "data"), ("-D", str(folder / "data"), "-l", str(folder / "log"), "-w")
    run("initdb", "-D", data, "-U", "cow", "-A", "trust", "--no-sync")
    try:
        run("pg_ctl", *control, "-o", f"-p {port} -h 127.0.0.1 -k {folder}", "start")
        run("createdb", "-h", "127.0.0.1", "-p", str(port), "-U", "cow", "cow")
        yield f"postgresql://cow@127.0.0.1:{port}/cow"
    finally:
        subprocess.run(
            [*as_user, str(programs / "pg_ctl"), "-D", data, "-m", "immediate", "stop"], check=False, cwd="/"
        )
        shutil.rmtree(folder, ignore_errors=True)
