"""Kills and freezes servers and workers of a fleet while jobs come in, and looks at what is left when all have ended.

    python benchmarks/fleet.py --database postgresql://... --artifacts s3://... [--seconds N] [--seed N] [--json FILE]

Two servers that compute nothing and three workers share a PostgreSQL and an object store, and no folder. Every few
seconds one of them, or a process that computes, is killed, frozen or asked to stop; it is back some seconds later.
Asked is: was a job lost that had been acknowledged; did one fail; are results and artifacts what they should be.
"""

from __future__ import annotations

import argparse
import base64
import hashlib
import json
import os
import random
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import httpx
import psutil

EXAMPLE = Path(__file__).resolve().parents[1] / "examples" / "ball-and-mug" / "image.jpg"
QUESTION = "If the yellow ball moves to the left, will it hit the blue mug?"
BETWEEN = (1.0, 4.0)  # seconds from one blow to the next
AWAY = (0.5, 4.0)  # seconds until what was killed is started again
FROZEN = (2.0, 14.0)  # seconds, below and beyond what a process may say nothing
PATIENCE = 300.0  # seconds for all jobs to end after the last blow


@dataclass
class Report:
    """What came of it."""

    seconds: float
    blows: dict[str, int] = field(default_factory=dict[str, int])
    acknowledged: int = 0
    outcomes: dict[str, int] = field(default_factory=dict[str, int])
    problems: list[str] = field(default_factory=list[str])
    wrong_results: list[str] = field(default_factory=list[str])
    begun_twice: int = 0  # clips that a blow cut off
    corrupt: list[str] = field(default_factory=list[str])
    slowest_call_s: float = 0.0


class Member:
    """One server or worker, with a folder of its own."""

    def __init__(self, name: str, folder: Path, shared: dict[str, str], *arguments: str) -> None:
        self.name = name
        self.port = _free_port()
        self._arguments = [*arguments, "--port", str(self.port)] if "serve" in arguments else list(arguments)
        self._environment = os.environ | shared | {"COW_DATA_DIR": str(folder / name)}
        self._log = (folder / f"{name}.log").open("ab")
        self.process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        """Starts it."""
        command = [sys.executable, "-m", "cow_service.cli.main", *self._arguments]
        self.process = subprocess.Popen(command, env=self._environment, stdout=self._log, stderr=self._log)

    def processes(self) -> list[psutil.Process]:
        """Its children, and itself last."""
        assert self.process is not None
        try:
            own = psutil.Process(self.process.pid)
            return [*own.children(recursive=True), own]
        except psutil.NoSuchProcess:
            return []

    def send(self, number: int) -> None:
        """Sends a signal to all its processes; a stop in peace goes to the first alone."""
        for one in self.processes()[-1:] if number == signal.SIGTERM else self.processes():
            try:
                one.send_signal(number)
            except psutil.NoSuchProcess:
                continue

    def end(self) -> None:
        """Ends it."""
        self.send(signal.SIGCONT)
        self.send(signal.SIGKILL)
        if self.process is not None:
            self.process.wait()


class Fleet:
    """All members."""

    def __init__(self, folder: Path, shared: dict[str, str]) -> None:
        self.servers = [Member(f"api-{one}", folder, shared, "serve", "--role", "api") for one in (1, 2)]
        self.workers = [Member(f"worker-{one}", folder, shared, "worker") for one in (1, 2, 3)]

    @property
    def members(self) -> list[Member]:
        """Servers and workers."""
        return [*self.servers, *self.workers]

    def call(self, method: str, path: str, chance: random.Random, **more: Any) -> httpx.Response | None:
        """The answer of one of the servers; None where there was none."""
        server = chance.choice(self.servers)
        try:
            return httpx.request(method, f"http://127.0.0.1:{server.port}{path}", timeout=15, **more)
        except httpx.HTTPError:
            return None

    def strike(self, chance: random.Random) -> str:
        """Does something to somebody, and sees that they are back; returns what."""
        member = chance.choice(self.members)
        kind = chance.choice(["kill", "kill", "stop", "freeze", "crash"])
        if kind == "crash" and member in self.workers:
            computing = member.processes()[:-1]
            if computing:
                computing[0].kill()
            return kind
        if kind == "freeze":
            member.send(signal.SIGSTOP)
            threading.Timer(chance.uniform(*FROZEN), member.send, (signal.SIGCONT,)).start()
            return kind
        member.send(signal.SIGTERM if kind == "stop" else signal.SIGKILL)
        assert member.process is not None
        member.send(signal.SIGCONT)  # it may be frozen
        member.process.wait()
        time.sleep(chance.uniform(*AWAY))
        member.start()
        return "stop" if kind == "stop" else "kill"


def fleet(database: str, artifacts: str, seconds: float, seed: int, folder: Path) -> Report:
    """Does it all once. The environment has the credentials of the object store."""
    chance, report = random.Random(seed), Report(seconds)
    journal = folder / "journal"
    journal.touch()
    shared = {
        "COW_DATABASE_URL": database,
        "COW_ARTIFACTS": artifacts,
        "COW_SHUTDOWN_GRACE": "3",
        "COW_CONCURRENCY": "1",
        "PYTHONPATH": str(Path(__file__).parent / "slow_generator"),
        "SLOW_JOURNAL": str(journal),
    }
    members = Fleet(folder, shared)
    for member in members.members:
        member.start()
    acknowledged: dict[int, str] = {}
    stop = threading.Event()
    callers = [threading.Thread(target=_submit, args=(members, acknowledged, stop, one, report)) for one in range(2)]
    try:
        for caller in callers:
            caller.start()
        until = time.monotonic() + seconds
        blows: Counter[str] = Counter()
        while time.monotonic() < until:
            time.sleep(chance.uniform(*BETWEEN))
            blows[members.strike(chance)] += 1
        report.blows = dict(blows)
        stop.set()
        for caller in callers:
            caller.join()
        time.sleep(FROZEN[1])  # whoever is frozen goes on
        _look(members, acknowledged, journal, report)
    finally:
        stop.set()
        for member in members.members:
            member.end()
    return report


def _submit(members: Fleet, acknowledged: dict[int, str], stop: threading.Event, number: int, report: Report) -> None:
    """Sends jobs, each until it is acknowledged."""
    chance, seed = random.Random(number), number
    image = "data:image/jpeg;base64," + base64.b64encode(EXAMPLE.read_bytes()).decode()
    while not stop.is_set():
        slow: dict[str, Any] = {"generator": "slow", "generator_options": {"seconds": 1.0}} if seed % 4 < 2 else {}
        body = {"image": image, "question": QUESTION, "seed": seed, "num_frames": 9, "video": False, **slow}
        headers = {"Prefer": "respond-async", "Idempotency-Key": f"job-{seed}"}
        began = time.monotonic()
        answer = members.call("POST", "/simulate", chance, json=body, headers=headers)
        report.slowest_call_s = max(report.slowest_call_s, round(time.monotonic() - began, 1))
        if answer is not None and answer.status_code == 202:
            acknowledged[seed] = answer.json()["id"]
            seed += 2
            time.sleep(1.0)
        else:
            time.sleep(0.3)


def _look(members: Fleet, acknowledged: dict[int, str], journal: Path, report: Report) -> None:
    """Waits for all jobs, and compares what was promised with what is there."""
    chance, until = random.Random(0), time.monotonic() + PATIENCE
    artifacts: dict[str, str] = {}
    outcomes: Counter[str] = Counter()
    for seed, job_id in acknowledged.items():
        job: dict[str, Any] = {"status": "lost"}
        while time.monotonic() < until:
            answer = members.call("GET", f"/jobs/{job_id}", chance)
            job = answer.json() if answer is not None and answer.status_code == 200 else job
            if job["status"] in ("succeeded", "failed", "canceled"):
                break
            time.sleep(0.2)
        outcomes[job["status"]] += 1
        if job["status"] != "succeeded":
            report.problems.append(json.dumps(job.get("problem") or job["status"]))
        elif job["result"]["generator"]["seed"] != seed or job["result"]["id"] != job_id:
            report.wrong_results.append(job_id)
        else:
            artifacts |= {one["sha256"]: one["url"] for one in [*job["result"]["frames"], job["result"]["overlay"]]}
    for sha256, url in artifacts.items():
        answer = members.call("GET", url, chance, follow_redirects=True)
        if answer is None or hashlib.sha256(answer.content).hexdigest() != sha256:
            report.corrupt.append(sha256)
    begun = Counter(int(line) for line in journal.read_text().split())
    report.begun_twice = sum(times > 1 for times in begun.values())
    report.acknowledged, report.outcomes = len(acknowledged), dict(outcomes)


def _free_port() -> int:
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return one.getsockname()[1]


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--database", required=True, help="postgresql://...")
    parser.add_argument("--artifacts", required=True, help="s3://...")
    parser.add_argument("--seconds", type=float, default=600)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="cow-fleet-") as folder:
        report = fleet(given.database, given.artifacts, given.seconds, given.seed, Path(folder))
    print(json.dumps(asdict(report), indent=1))
    if given.json:
        given.json.write_text(json.dumps(asdict(report), indent=1) + "\n")
    sys.exit(bool(report.problems or report.wrong_results or report.corrupt))


if __name__ == "__main__":
    main()
