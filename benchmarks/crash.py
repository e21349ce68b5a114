"""Kills a real server again and again while jobs come in, and looks at what is left when all of them have ended.

    python benchmarks/crash.py [--jobs N] [--kills N] [--database URL] [--seed N] [--json FILE]

Half of the jobs use a generator that takes its time and writes down every clip that it begins (slow_generator/). Asked
is: was a job lost that had been acknowledged; did every one end; was a clip made again that had been finished; are all
artifacts what their names say; how soon after a restart is a job at work again that was cut off.
"""

from __future__ import annotations

import argparse
import base64
import hashlib
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import threading
import time
import zlib
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import httpx
import sqlalchemy as sa

ROOT = Path(__file__).resolve().parents[1]
EXAMPLE = ROOT / "examples" / "ball-and-mug"
QUESTION = "If the yellow ball moves to the left, will it hit the blue mug?"
ENDED = ("succeeded", "failed", "canceled")
UP = (0.3, 2.5)  # seconds that a server lives between ready and its end
FIRST_UP = (0.0, 0.1)  # seconds from the beginning of the first slow clip, of 0.3 s, to the first kill: it is cut off
CALLERS = 4
PATIENCE = 900.0  # seconds for all jobs to end after the last kill


@dataclass
class Report:
    """What came of it."""

    database: str
    jobs: int
    kills: int
    acknowledged: int = 0
    lost: list[str] = field(default_factory=list[str])
    outcomes: dict[str, int] = field(default_factory=dict[str, int])
    wrong_results: list[str] = field(default_factory=list[str])
    redone: list[int] = field(default_factory=list[int])
    begun_twice: int = 0  # clips that a kill cut off
    corrupt: list[str] = field(default_factory=list[str])
    missing: list[str] = field(default_factory=list[str])
    ready_s: list[float] = field(default_factory=list[float])
    back_at_work_s: list[float] = field(default_factory=list[float])  # after ready, where a job had been cut off
    seconds: float = 0.0


class Ground:
    """A data folder, a database, and the server on them that lives just now."""

    def __init__(self, folder: Path, database: str | None, queue_limit: int = 100_000) -> None:
        self.folder = folder
        self.journal = folder / "journal"
        self.journal.touch()
        self.url = database or f"sqlite:///{folder / 'data' / 'jobs.sqlite3'}"
        own = {
            "COW_DATA_DIR": str(folder / "data"),
            "COW_QUEUE_LIMIT": str(queue_limit),
            "PYTHONPATH": str(Path(__file__).parent / "slow_generator"),
            "SLOW_JOURNAL": str(self.journal),
        }
        self._environment = os.environ | own | ({"COW_DATABASE_URL": database} if database else {})
        self._log = (folder / "log").open("ab")
        self.process: subprocess.Popen[bytes] | None = None
        self.port = 0

    @property
    def address(self) -> str:
        """Where the server listens, always at the same port."""
        return f"http://127.0.0.1:{self.port}"

    def start(self) -> float:
        """Starts a server and waits until it is ready; returns the seconds that took."""
        started = time.monotonic()
        self.port = self.port or _free_port()
        command = [sys.executable, "-m", "cow_service.cli.main", "serve", "--port", str(self.port)]
        self.process = subprocess.Popen(command, env=self._environment, stdout=self._log, stderr=self._log)
        while True:
            try:
                if httpx.get(f"{self.address}/readyz", timeout=2).status_code == 200:
                    return time.monotonic() - started
            except httpx.HTTPError:
                assert self.process.poll() is None, f"the server ended: {(self.folder / 'log').read_text()[-2000:]}"
            time.sleep(0.02)

    def kill(self) -> None:
        """Ends the server as a loss of power would."""
        assert self.process is not None
        self.process.send_signal(signal.SIGKILL)
        self.process.wait()

    def finished(self) -> set[int]:
        """Seeds of the clips that the database holds as made."""
        engine = sa.create_engine(self.url.replace("postgresql://", "postgresql+psycopg://"))
        try:
            with engine.connect() as connection:
                query = sa.text("SELECT result FROM cow_results WHERE stage = 'generation'")
                made = [
                    json.loads(zlib.decompress(result))["value"]["generator"]
                    for result in connection.execute(query).scalars()
                ]
        finally:
            engine.dispose()
        return {one["seed"] for one in made if one["name"] == "slow"}

    def begun(self) -> list[int]:
        """Seeds of the clips that were begun, one for each time."""
        return [int(line) for line in self.journal.read_text().split()]

    def close(self) -> None:
        """Ends the server in peace."""
        if self.process is not None and self.process.poll() is None:
            self.process.terminate()
            self.process.wait()
        self._log.close()


class Callers:
    """Sends every job until somebody has acknowledged it, from several threads, whether a server is there or not."""

    def __init__(self, ground: Ground, jobs: int) -> None:
        self._ground = ground
        self._left = list(range(jobs))[::-1]
        self._guard = threading.Lock()
        self._stop = threading.Event()
        self.acknowledged: dict[int, str] = {}
        image = base64.b64encode((EXAMPLE / "image.jpg").read_bytes()).decode()
        self._image = f"data:image/jpeg;base64,{image}"

    def body(self, seed: int) -> dict[str, Any]:
        """The request of a seed: every other one is slow."""
        slow: dict[str, Any] = {"generator": "slow", "generator_options": {"seconds": 0.3}} if seed % 2 else {}
        return {
            "image": self._image,
            "question": QUESTION,
            "seed": seed,
            "num_frames": 9,
            "video": seed % 3 == 0,
            **slow,
        }

    def run(self) -> None:
        """What one thread does."""
        while not self._stop.is_set():
            with self._guard:
                if not self._left:
                    return
                seed = self._left.pop()
            try:
                # The key makes it one job, also where the answer to the first try was lost.
                headers = {"Prefer": "respond-async", "Idempotency-Key": f"job-{seed}"}
                answer = httpx.post(
                    f"{self._ground.address}/simulate", json=self.body(seed), headers=headers, timeout=10
                )
                assert answer.status_code == 202, answer.text
                self.acknowledged[seed] = answer.json()["id"]
            except httpx.HTTPError:
                with self._guard:
                    self._left.append(seed)
                time.sleep(0.05)

    def stop(self) -> None:
        """Ends the threads."""
        self._stop.set()


def crash(jobs: int, kills: int, database: str | None = None, seed: int = 0, folder: Path | None = None) -> Report:
    """Does it all once."""
    started, chance = time.monotonic(), random.Random(seed)
    with tempfile.TemporaryDirectory(prefix="cow-crash-") as made:
        ground = Ground(folder or Path(made), database)
        report = Report("postgresql" if database else "sqlite", jobs, kills)
        callers = Callers(ground, jobs)
        try:
            with ThreadPoolExecutor(CALLERS) as pool:
                try:
                    report.ready_s.append(ground.start())
                    for _ in range(CALLERS):
                        pool.submit(callers.run)
                    for number in range(kills):
                        while number == 0 and not ground.begun():
                            time.sleep(0.01)
                        time.sleep(chance.uniform(*(UP if number else FIRST_UP)))
                        _one_kill(ground, callers, report)
                    _wait_for_all(ground, callers, jobs)
                finally:
                    callers.stop()
            _look(ground, callers, report)
        finally:
            ground.close()
    report.seconds = round(time.monotonic() - started, 1)
    return report


def _one_kill(ground: Ground, callers: Callers, report: Report) -> None:
    cut_off = _running(ground, callers)
    ground.kill()
    finished, begun = ground.finished(), len(ground.begun())
    report.ready_s.append(round(ground.start(), 2))
    ready = time.monotonic()
    while cut_off and time.monotonic() - ready < 30:
        told = [_job(ground, job) for job in cut_off]
        if any(one["status"] != "queued" for one in told):
            report.back_at_work_s.append(round(time.monotonic() - ready, 2))
            break
        time.sleep(0.05)
    report.redone += [one for one in ground.begun()[begun:] if one in finished]


def _running(ground: Ground, callers: Callers) -> list[str]:
    found = httpx.get(f"{ground.address}/jobs", params={"status": "running", "limit": 100}, timeout=10).json()["jobs"]
    known = set(callers.acknowledged.values())
    return [job["id"] for job in found if job["id"] in known and job["status"] == "running"][:3]


def _job(ground: Ground, job: str) -> dict[str, Any]:
    answer = httpx.get(f"{ground.address}/jobs/{job}", timeout=10)
    return answer.json() if answer.status_code == 200 else {"status": "lost"}


def _wait_for_all(ground: Ground, callers: Callers, jobs: int) -> None:
    until = time.monotonic() + PATIENCE
    finished = ground.finished()
    while time.monotonic() < until:
        told = httpx.get(f"{ground.address}/jobs", params={"status": ["queued", "running"]}, timeout=30).json()
        if len(callers.acknowledged) == jobs and not told["jobs"]:
            return
        time.sleep(0.5)
    raise TimeoutError(
        f"jobs have not ended after {PATIENCE:g} s; {len(finished)} clips were finished at the last kill"
    )


def _look(ground: Ground, callers: Callers, report: Report) -> None:
    """Compares what was promised with what is there."""
    report.acknowledged = len(callers.acknowledged)
    outcomes: Counter[str] = Counter()
    artifacts: set[str] = set()
    for seed, job_id in callers.acknowledged.items():
        job = _job(ground, job_id)
        outcomes[job["status"]] += 1
        if job["status"] not in ENDED:
            report.lost.append(job_id)
        elif (
            job["status"] != "succeeded" or job["result"]["generator"]["seed"] != seed or job["result"]["id"] != job_id
        ):
            report.wrong_results.append(job_id)
        else:
            result = job["result"]
            shown = [*result["frames"], result["overlay"], result["grounding"]["mask"], result["video"] or {}]
            artifacts |= {one["sha256"] for one in shown if one}
    report.outcomes = dict(outcomes)
    report.begun_twice = sum(times > 1 for times in Counter(ground.begun()).values())
    stored = {
        path.stem: path for path in (ground.folder / "data" / "artifacts").glob("*/*.*") if path.suffix != ".part"
    }
    report.missing = sorted(artifacts - set(stored))
    report.corrupt = [name for name, path in stored.items() if hashlib.sha256(path.read_bytes()).hexdigest() != name]


def _free_port() -> int:
    import socket  # noqa: PLC0415

    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return one.getsockname()[1]


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--jobs", type=int, default=500)
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--database", help="postgresql://...; by default SQLite")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    report = crash(given.jobs, given.kills, given.database, given.seed)
    print(json.dumps(asdict(report), indent=1))
    if given.json:
        given.json.write_text(json.dumps(asdict(report), indent=1) + "\n")
    sys.exit(bool(report.lost or report.wrong_results or report.redone or report.corrupt or report.missing))


if __name__ == "__main__":
    main()
