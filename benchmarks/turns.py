"""Compares the servers of two versions: both run at the same time, and each request goes to one and then the other.

    python benchmarks/turns.py A B [--runs N] [--json FILE]

Each is the folder of a checkout, or a revision or tag of this repository. A slow moment of the machine meets both,
which a run of one after the other cannot promise. Of each: milliseconds until it is ready; median milliseconds of a
`POST /simulate` with three frames and with the clip, and the CPU milliseconds of the server and all its processes, for
a picture that it has not seen before; requests a second of one, two and four callers, while the other server rests.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from itertools import count
from pathlib import Path
from typing import Any

import httpx
import psutil
from latency import EXAMPLE, pictures_like

ROOT = Path(__file__).resolve().parents[1]
# The command line of a version, wherever it has it.
COW = """
import sys; from importlib.metadata import entry_points; sys.argv[0] = "cow"
next(iter(entry_points(group="console_scripts", name="cow"))).load()()
"""
KINDS: dict[str, dict[str, Any]] = {"3 frames": {"video": False}, "with mp4": {}}
CALLERS = (1, 2, 4)
PIPES: dict[str, Any] = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE, "text": True}


class Served:
    """A server of an installed version with an empty data folder."""

    def __init__(self, folder: Path, resources: ExitStack) -> None:
        data = resources.enter_context(tempfile.TemporaryDirectory())
        environment = os.environ | {"COW_DATA_DIR": data, "PYTHONPATH": str(folder), "COW_PORT": "0"}
        started = time.perf_counter()
        self._process = subprocess.Popen([sys.executable, "-c", COW, "serve"], cwd=folder, env=environment, **PIPES)
        resources.callback(self._end)
        assert self._process.stderr is not None
        line = next(line for line in self._process.stderr if "running on" in line)
        self.address = line.split("running on ")[1].split()[0]
        while httpx.get(self.address + "/readyz").status_code != 200:
            time.sleep(0.005)
        self.ready_ms = 1000 * (time.perf_counter() - started)
        self.http = resources.enter_context(httpx.Client(base_url=self.address, timeout=120))

    def _end(self) -> None:
        self._process.terminate()
        self._process.communicate()

    def cpu_ms(self) -> float:
        """CPU time so far of all its processes that live."""
        server = psutil.Process(self._process.pid)
        used = [each.cpu_times() for each in (server, *server.children(recursive=True))]
        return 1000 * sum(times.user + times.system for times in used)

    def asked(self, body: dict[str, Any]) -> tuple[float, float]:
        """Milliseconds that a request took, and that the server computed for it."""
        before, started = self.cpu_ms(), time.perf_counter()
        self.http.post("/simulate", json=body).raise_for_status()
        passed = 1000 * (time.perf_counter() - started)
        return passed, self.cpu_ms() - before

    def rate(self, bodies: list[dict[str, Any]], callers: int) -> float:
        """Requests per second of a number of callers, each with one request at a time."""

        def ask(body: dict[str, Any]) -> None:
            self.http.post("/simulate", json=body).raise_for_status()

        with ThreadPoolExecutor(callers) as pool:
            started = time.perf_counter()
            list(pool.map(ask, bodies))
            return len(bodies) / (time.perf_counter() - started)


def installed(name: str, resources: ExitStack) -> Path:
    """A folder with the package and its entry points, as a checkout or a revision of this repository has them."""
    folder = Path(resources.enter_context(tempfile.TemporaryDirectory()))
    source = str(Path(name).resolve()) if Path(name).is_dir() else f"git+{ROOT.as_uri()}@{name}"
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--target", str(folder), source]
    subprocess.run(pip, check=True)
    return folder


def measure(folders: list[Path], runs: int) -> dict[str, list[float]]:
    """The figures of A and of B, by name."""
    found: dict[str, list[float]] = {}
    question = json.loads((EXAMPLE / "meta.json").read_text())["question"]
    pictures, seeds = pictures_like(EXAMPLE / "image.jpg"), count()

    def body(**rest: Any) -> dict[str, Any]:
        return {"image": next(pictures), "question": question, "seed": next(seeds), **rest}  # pictures come again

    ready: list[list[float]] = [[], []]
    for turn in range(5):
        for which in (0, 1) if turn % 2 else (1, 0):
            with ExitStack() as one:
                ready[which].append(Served(folders[which], one).ready_ms)
    found["ready, ms"] = [statistics.median(each[1:]) for each in ready]
    with ExitStack() as resources:
        served = [Served(folder, resources) for folder in folders]
        for name, rest in KINDS.items():
            times: list[list[tuple[float, float]]] = [[], []]
            for turn in range(runs + 3):
                asked = body(**rest)
                for which in (0, 1) if turn % 2 else (1, 0):
                    took = served[which].asked(asked)
                    times[which] += [took] if turn >= 3 else []
            found[f"{name}, p50 ms"] = [statistics.median(passed for passed, _ in each) for each in times]
            found[f"{name}, CPU ms"] = [statistics.mean(cpu for _, cpu in each) for each in times]
        for callers in CALLERS:
            rates: list[list[float]] = [[], []]
            for turn in range(4):
                asked = [body(video=False) for _ in range(12 * callers)]
                for which in (0, 1) if turn % 2 else (1, 0):
                    rate = served[which].rate(asked, callers)
                    rates[which] += [rate] if turn else []
            found[f"{callers} callers, 1/s"] = [statistics.median(each) for each in rates]
    return found


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("versions", nargs=2)
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    with ExitStack() as resources:
        found = measure([installed(version, resources) for version in given.versions], given.runs)
    load = os.getloadavg()[0]
    a_is, b_is = (name if not Path(name).is_dir() else "the checkout" for name in given.versions)
    print(f"{os.cpu_count()} cores, load {load:.1f}; A is {a_is}, B {b_is}\n{'A':>10} {'B':>10} {'B/A':>6}  figure")
    for name, (a, b) in found.items():
        print(f"{a:>10.1f} {b:>10.1f} {b / a:>6.2f}  {name}")
    if given.json:
        told = {name: {"a": round(a, 1), "b": round(b, 1), "ratio": round(b / a, 3)} for name, (a, b) in found.items()}
        about = {"a": a_is, "b": b_is, "cores": os.cpu_count(), "load": load}
        given.json.write_text(json.dumps({**about, "figures": told}, indent=1) + "\n")


if __name__ == "__main__":
    main()
