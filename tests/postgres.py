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
import psycopg
import pytest
from servers import send
from waiting import TIME_LIMIT, eventually

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

    def set_read_only(self, value: bool) -> None:
        """From now on every new transaction is read-only, as on a standby; or none is, as after its promotion."""
        with psycopg.connect(self.url, autocommit=True, options="-c default_transaction_read_only=off") as session:
            session.execute(f"ALTER SYSTEM SET default_transaction_read_only = {'on' if value else 'off'}")
            session.execute("SELECT pg_reload_conf()")

    @contextmanager
    def locked_tables(self) -> Iterator[None]:
        """No other session can use the table of jobs meanwhile."""
        with psycopg.connect(self.url) as session:
            session.execute("LOCK TABLE cow_jobs IN ACCESS EXCLUSIVE MODE")
            yield

    @contextmanager
    def pooled(self, mode: str) -> Iterator[str]:
        """The address of a PgBouncer before it. Skips the test where there is none."""
        program = shutil.which("pgbouncer")
        if program is None:
            if os.environ.get(REQUIRED):
                pytest.fail("PgBouncer is not installed: apt-get install pgbouncer")
            pytest.skip("PgBouncer is not installed: apt-get install pgbouncer")
        with socket.socket() as one:
            one.bind(("127.0.0.1", 0))
            port = one.getsockname()[1]
        users, file = self._folder / "users", self._folder / "pgbouncer.ini"
        users.write_text('"cow" ""\n')
        file.write_text(
            f"[databases]\ncow = host=127.0.0.1 port={self.port} dbname=cow user=cow\n"
            f"[pgbouncer]\nlisten_addr=127.0.0.1\nlisten_port={port}\nauth_type=any\nauth_file={users}\n"
            f"pool_mode={mode}\nmax_client_conn=200\ndefault_pool_size=10\nunix_socket_dir=\n"
            f"ignore_startup_parameters=extra_float_digits,options\n"
        )
        command = [*self._as_user, program, "-q", str(file)]
        process = subprocess.Popen(command, cwd="/", stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            url = self.url.replace(str(self.port), str(port))
            eventually(lambda: _answers(url))
            yield url
        finally:
            send(psutil.Process(process.pid).children(recursive=True), signal.SIGTERM)
            process.terminate()
            process.wait(TIME_LIMIT)

    def stop(self) -> None:
        command = [*self._as_user, str(self._programs / "pg_ctl"), "-D", self._data, "-m", "immediate", "stop"]
        subprocess.run(command, check=False, cwd="/")

    def _run(self, program: str, *arguments: str) -> None:
        # The server's output is not read: it would keep a pipe open.
        command = [*self._as_user, str(self._programs / program), *arguments]
        subprocess.run(command, check=True, cwd="/", stdout=subprocess.DEVNULL, timeout=TIME_LIMIT)


def _answers(url: str) -> bool:
    try:
        with psycopg.connect(url, connect_timeout=2) as session:
            return session.execute("SELECT 1").fetchone() is not None
    except psycopg.OperationalError:
        return False


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
