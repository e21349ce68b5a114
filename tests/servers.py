"""Real servers in processes of their own, each with its own settings and data: to be stopped, killed, started again."""

from __future__ import annotations

import base64
import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any

import httpx
import psutil
from drawn import ball, block, floor, png_bytes
from waiting import TIME_LIMIT, eventually

SLOW_GENERATOR = Path(__file__).resolve().parents[1] / "benchmarks" / "slow_generator"
SEEING = {  # settings of a server that sees plain scenes
    "PYTHONPATH": f"{Path(__file__).parent / 'stand_in_models'}:{SLOW_GENERATOR}",
    "COW_PERCEPTION": "stand-in-segmenter,stand-in-detector",
}
TERMINAL = ("succeeded", "failed", "canceled")
ASYNC = {"Prefer": "respond-async"}
QUESTION = "If the red ball moves to the right, will it hit the blue cube?"


def picture(shift: int = 0) -> bytes:
    """A small scene as PNG; every shift is another one."""
    image = ball(floor(240, 160), (60 + shift, 80), 18, (210, 20, 20))
    return png_bytes(block(image, (170, 60, 205, 98), (50, 80, 200)))


def data_url(image: bytes) -> str:
    return "data:image/png;base64," + base64.b64encode(image).decode()


IMAGE = picture()
# The request gives what the reader would have to find: jobs are about order, not about pictures.
BODY: dict[str, Any] = {
    "image": data_url(IMAGE),
    "question": QUESTION,
    "grounding": {"point": [60, 80]},
    "motion": {"direction": [1, 0]},
    "num_frames": 5,
    "video": False,
    "frames": {"count": 1},
}


def slow(seconds: float, seed: int = 0, **others: Any) -> dict[str, Any]:
    """A request that takes that long, in at least 40 steps; it can be ended after each."""
    options = {"generator": "slow", "generator_options": {"seconds": seconds}, "frames": {"count": 40}}
    return {**BODY, **options, "num_frames": 80, "seed": seed, **others}


class Program:
    """A `cow` process of a data folder, and those that it has started. It can be killed, and started again."""

    def __init__(self, folder: Path, command: list[str], log: str, **settings: str) -> None:
        self.data = folder / "data"
        self.journal = folder / "journal"
        self.journal.touch()
        self._log_file = folder / log
        own = {
            "COW_DATA_DIR": str(self.data),
            "PYTHONPATH": str(SLOW_GENERATOR),
            "SLOW_JOURNAL": str(self.journal),
            "COW_WARMUP": "false",
        }
        self._environment = {name: value for name, value in os.environ.items() if not name.startswith("COW_")}
        self._environment |= own | settings
        self._command = [sys.executable, *command]
        self.process: subprocess.Popen[bytes] | None = None

    def launch(self) -> int:
        """Starts the process, and does not wait for it; returns how long its log was before."""
        said = len(self.log()) if self._log_file.exists() else 0
        if self.process is not None:
            self.process.wait()
        with self._log_file.open("ab") as log:
            self.process = subprocess.Popen(self._command, env=self._environment, stdout=log, stderr=log)
        return said

    def another(self) -> subprocess.Popen[bytes]:
        """A second process like it, at the same time."""
        with self._log_file.open("ab") as log:
            return subprocess.Popen(self._command, env=self._environment | {"COW_PORT": "0"}, stdout=log, stderr=log)

    def processes(self) -> list[psutil.Process]:
        """Its children, and itself last; none where it is gone."""
        if self.process is None or self.process.poll() is not None:  # its number may be another process's by now
            return []
        try:
            own = psutil.Process(self.process.pid)
            return [*own.children(recursive=True), own]
        except psutil.NoSuchProcess:
            return []

    def end(self) -> None:
        """Ends the process and all that it has started, also what is frozen."""
        processes = self.processes()
        send(processes, signal.SIGKILL)
        if self.process is not None:
            self.process.wait()
        psutil.wait_procs(processes)

    def log(self) -> str:
        return self._log_file.read_text(errors="replace")


class Served(Program):
    """A data folder, and the server on it that lives just now. Ends it with the `with` block."""

    def __init__(self, folder: Path, code: str | None = None, log: str = "log", **settings: str) -> None:
        own = {
            "COW_PORT": "0",
            "COW_HOST": "127.0.0.1",
            # Where who computes does not matter: processes that are started for each server take most of a test's time.
            "COW_WORKERS": "false",
        }
        command = ["-m", "cow_service.cli.main", "serve"] if code is None else ["-c", code]
        super().__init__(folder, command, log, **own | settings)
        self.http = httpx.Client()

    def __enter__(self) -> Served:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.kill()

    def start(self, probe: str | None = None) -> None:
        """Starts a server, and waits until a probe of it succeeds, by default that it is ready."""
        said = self.launch()

        def address() -> str | None:
            assert self.process is not None
            assert self.process.poll() is None, self.log()
            found = re.search(r"running on (http://\S+)", self.log()[said:])
            return found and found[1]

        self.http.close()  # to a server that ended by itself
        self.http = httpx.Client(base_url=eventually(address), timeout=TIME_LIMIT)
        # One that only takes requests is ready once a worker is.
        ready = "/livez" if self._environment.get("COW_ROLE") == "api" else "/readyz"
        eventually(lambda: self.http.get(probe or ready).status_code == 200)

    def kill(self) -> None:
        """Ends it as a loss of power would."""
        self.http.close()
        if self.process is not None:
            self.process.send_signal(signal.SIGKILL)
            self.process.wait()

    def ask_to_stop(self) -> None:
        assert self.process is not None
        self.process.terminate()

    def stop(self) -> int:
        """Ends it in peace; returns its exit code."""
        assert self.process is not None
        self.ask_to_stop()
        code = self.process.wait(TIME_LIMIT)
        self.http.close()
        return code

    @property
    def host_and_port(self) -> tuple[str, int]:
        return self.http.base_url.host, self.http.base_url.port or 80

    def submit(self, body: dict[str, Any], path: str = "/simulate", **headers: str) -> dict[str, Any]:
        """An accepted job."""
        response = self.http.post(path, json=body, headers=ASYNC | headers)
        assert response.status_code == 202, response.text
        return response.json()

    def job(self, job_id: str) -> dict[str, Any]:
        response = self.http.get(f"/jobs/{job_id}")
        assert response.status_code == 200, response.text
        return response.json()

    def until(self, job_id: str, *statuses: str) -> dict[str, Any]:
        """The job, once it has one of these statuses."""
        return eventually(lambda: job if (job := self.job(job_id))["status"] in statuses else None)

    def ended(self, job_id: str) -> dict[str, Any]:
        return self.until(job_id, *TERMINAL)

    def rendering(self, job_id: str) -> dict[str, Any]:
        """The job, once its clip is in the making."""

        def looked() -> dict[str, Any] | None:
            job = self.job(job_id)
            assert job["status"] not in TERMINAL, job
            return job if job["stage"] == "generation" else None

        return eventually(looked)

    def clips(self) -> list[int]:
        """Seeds of the slow clips that were begun, one for each time."""
        return [int(line) for line in self.journal.read_text().split()]


class Worker(Program):
    """A worker on the data folder and database of a server. Ends with the `with` block."""

    def __init__(self, folder: Path, log: str, **settings: str) -> None:
        super().__init__(folder, ["-m", "cow_service.cli.main", "worker"], log, **settings)

    def __enter__(self) -> Worker:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.end()

    def start(self) -> None:
        """Starts it, and waits until it takes jobs."""
        said = self.launch()
        eventually(lambda: "takes jobs" in self.log()[said:])

    def cpu_seconds(self) -> float:
        """That it and its children have computed."""
        return sum(sum(one.cpu_times()[:2]) for one in self.processes())


def send(processes: Iterable[psutil.Process], number: int) -> None:
    """Sends a signal to those that are still there."""
    for one in processes:
        with suppress(psutil.NoSuchProcess):
            one.send_signal(number)


def problem(response: httpx.Response, status: int, code: str) -> dict[str, Any]:
    """The problem that a response tells."""
    assert response.status_code == status, response.text
    assert response.headers["content-type"] == "application/problem+json"
    told = response.json()
    assert told["type"] == f"urn:cow:problem:{code}", told
    assert told["detail"]
    return told


def plain(result: dict[str, Any]) -> dict[str, Any]:
    """A result without what differs between two that are the same."""
    return {name: value for name, value in result.items() if name not in ("id", "created_at", "timings", "reused")}


def events_of(response: httpx.Response) -> list[dict[str, Any]]:
    """The server-sent events of a response, to its end: `event`, `id` where there is one, `data` as JSON."""
    return [parsed(block) for block in read_blocks(response) if not block.startswith(":")]


def read_blocks(response: httpx.Response) -> list[str]:
    response.read()
    return [block for block in response.text.split("\n\n") if block.strip()]


def parsed(block: str) -> dict[str, Any]:
    fields = dict(line.split(": ", 1) for line in block.split("\n"))
    return {**fields, "data": json.loads(fields["data"])}
