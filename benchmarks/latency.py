"""Measures what a caller waits for, on this machine: command line start, server start, requests, memory.

    python benchmarks/latency.py [--runs N] [--image FILE --question TEXT] [--json FILE]

A real server runs in its own process with an empty data folder. Times are medians in milliseconds; a run of each kind
is made first and not counted. Of commands the CPU time (user and system) is told, too: other load on the machine
changes it less, and that of an empty Python is there to compare. Peak memory is the largest resident set of the server
process.
"""

from __future__ import annotations

import argparse
import base64
import json
import os
import resource
import sqlite3
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from itertools import count, cycle
from pathlib import Path
from threading import Lock
from typing import Any

import cv2
import httpx

ROOT = Path(__file__).resolve().parents[1]
EXAMPLE = ROOT / "examples" / "ball-and-mug"
SAME_IMAGE = "What happens if the yellow ball moves to the right"
USE = "from cow_service.client import Client; Client()"
FRESH = {"Cache-Control": "no-cache"}  # no results of earlier runs


def timed(run: Callable[[], object], runs: int) -> dict[str, float]:
    """Median, least and most milliseconds of `runs` calls after one that is not counted."""
    run()
    times: list[float] = []
    for _ in range(runs):
        started = time.perf_counter()
        run()
        times.append(1000 * (time.perf_counter() - started))
    return {
        "p50_ms": round(statistics.median(times), 1),
        "min_ms": round(min(times), 1),
        "max_ms": round(max(times), 1),
    }


def timed_command(command: list[str], runs: int) -> dict[str, float]:
    """The same of a command, and its median CPU time."""
    used: list[float] = []

    def run() -> None:
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        subprocess.run(command, check=True, capture_output=True)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        used.append(1000 * (after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime))

    return {**timed(run, runs), "cpu_p50_ms": round(statistics.median(used[1:]), 1)}


def cow(*arguments: str) -> list[str]:
    """The command line of this interpreter's environment."""
    return [sys.executable, "-m", "cow_service.cli.main", *arguments]


def start_server(data: Path) -> tuple[subprocess.Popen[str], str, float]:
    """The server process, its address, and the milliseconds until it was ready."""
    started = time.perf_counter()
    environment = os.environ | {"COW_DATA_DIR": str(data)}
    command = cow("serve", "--port", "0")
    process = subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    assert process.stderr is not None
    address = ""
    for line in process.stderr:
        if "running on" in line:
            address = line.split("running on ")[1].split()[0]
            break
    while httpx.get(address + "/readyz").status_code != 200:
        time.sleep(0.01)
    return process, address, 1000 * (time.perf_counter() - started)


def peak_memory_mb(pid: int) -> float:
    """Largest resident set of a process so far, MB."""
    status = Path(f"/proc/{pid}/status").read_text()
    return int(next(line for line in status.splitlines() if line.startswith("VmHWM")).split()[1]) / 1000


def kept_bytes(data: Path) -> dict[str, int]:
    """What a data folder holds: the rows of the job database, and all other files."""
    with sqlite3.connect(data / "jobs.sqlite3") as database:
        pages, free, size = (
            database.execute(f"PRAGMA {name}").fetchone()[0] for name in ("page_count", "freelist_count", "page_size")
        )
    files = [path for path in data.rglob("*") if path.is_file() and not path.name.startswith("jobs.sqlite3")]
    return {"database": (pages - free) * size, "files": sum(path.stat().st_size for path in files)}


def pictures_like(image: Path) -> Iterator[str]:
    """Data URLs of the image, each with another shade in a corner: their frames are files that are not there yet."""
    pixels = cv2.imread(str(image))
    assert pixels is not None, image
    for shade in cycle(range(256)):
        pixels[:8, :8] = shade
        _, encoded = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, 90])
        yield "data:image/jpeg;base64," + base64.b64encode(encoded.tobytes()).decode()


def throughput(address: str, ask: Callable[..., None], callers: int, runs: int) -> float:
    """Requests per second of several callers, each with a connection of its own and one request at a time."""

    def calls(_: int) -> None:
        with httpx.Client(base_url=address, timeout=60) as client:
            for _ in range(runs):
                ask(client, video=False)

    with ThreadPoolExecutor(callers) as pool:
        list(pool.map(calls, range(callers)))  # workers are started when they are first needed
        started = time.perf_counter()
        list(pool.map(calls, range(callers)))
        return callers * runs / (time.perf_counter() - started)


def measure(image: Path, question: str, runs: int) -> dict[str, Any]:
    """All figures."""
    figures: dict[str, Any] = {"cores": os.cpu_count(), "image": image.name, "runs": runs}
    figures["cow --help"] = timed_command(cow("--help"), runs)
    for line in ("pass", "import cow_service.client", "from cow_service.client import Client", USE):
        figures[line] = timed_command([sys.executable, "-W", "error", "-c", line], runs)
    with tempfile.TemporaryDirectory() as data:
        starts: list[float] = []
        for _ in range(3):
            process, address, ready = start_server(Path(data))
            starts.append(ready)
            process.terminate()
            process.wait()
        figures["server ready"] = {"p50_ms": round(statistics.median(starts), 1)}
        process, address, _ = start_server(Path(data))
        try:
            pictures, taking = pictures_like(image), Lock()
            body = {"image": next(pictures), "question": question}

            def ask(client: httpx.Client, **rest: Any) -> None:
                with taking:
                    other = {"image": next(pictures), "question": question}
                client.post("/simulate", json=other | rest, headers=FRESH).raise_for_status()

            def ask_again(client: httpx.Client, **rest: Any) -> None:
                client.post("/simulate", json=body | rest, headers=FRESH).raise_for_status()

            with httpx.Client(base_url=address, timeout=60) as client:
                started = time.perf_counter()
                ask(client, video=False)
                first = 1000 * (time.perf_counter() - started)
                warm = timed(lambda: ask(client, video=False), runs)
                figures["POST /simulate, 4 frames"] = warm
                figures["first request"] = {"ms": round(first, 1), "against warm": round(first / warm["p50_ms"], 2)}
                figures["the same picture again"] = timed(lambda: ask_again(client, video=False), runs)
                numbers = count(2)

                def ask_other() -> None:
                    other = {"question": f"{SAME_IMAGE} for {next(numbers)} seconds?", "video": False}
                    client.post("/simulate", json=body | other).raise_for_status()

                figures["another question about the image"] = timed(ask_other, runs)
                before = kept_bytes(Path(data))
                figures["POST /simulate, 4 frames and 81-frame mp4"] = timed(lambda: ask(client), runs)
                made = runs + 1
                figures["kept per job"] = {
                    name: round((size - before[name]) / made) for name, size in kept_bytes(Path(data)).items()
                }
                alone = throughput(address, ask, 1, runs)
                figures["throughput"] = {
                    "one caller, 1/s": round(alone, 2),
                    "two callers against one": round(throughput(address, ask, 2, runs) / alone, 2),
                }
            figures["peak memory, MB"] = round(peak_memory_mb(process.pid), 1)
        finally:
            process.terminate()
            process.wait()
    return figures


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("--runs", type=int, default=15)
    parser.add_argument("--image", type=Path, default=EXAMPLE / "image.jpg")
    parser.add_argument("--question", default=json.loads((EXAMPLE / "meta.json").read_text())["question"])
    parser.add_argument("--json", type=Path, default=None, help="write the figures here")
    arguments = parser.parse_args()
    figures = measure(arguments.image, arguments.question, arguments.runs)
    print(json.dumps(figures, indent=2))
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(figures, indent=2) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
