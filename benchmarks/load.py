"""Measures a real server under load: many callers at once, a full queue, and memory over thousands of requests.

    python benchmarks/load.py [--callers N] [--requests N] [--database URL] [--json FILE]

Callers: that many synchronous requests at the same time, all different. Queue: how soon a server whose queue is full
says so. Soak: requests one after the other by four callers, with the server's resident memory every hundred.
"""

from __future__ import annotations

import argparse
import base64
import json
import statistics
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import httpx
from crash import Ground

ROOT = Path(__file__).resolve().parents[1]
EXAMPLE = ROOT / "examples" / "ball-and-mug"
QUESTION = "If the yellow ball moves to the left, will it hit the blue mug?"
SOAKERS = 4


def body(seed: int, **rest: Any) -> dict[str, Any]:
    """A request that no other one is the same as."""
    image = base64.b64encode((EXAMPLE / "image.jpg").read_bytes()).decode()
    url = f"data:image/jpeg;base64,{image}"
    return {
        "image": url,
        "question": QUESTION,
        "seed": seed,
        "video": False,
        "motion": {"direction": [-1, seed / 1e6]},
        **rest,
    }


def resident(ground: Ground) -> float:
    """MB of the server's memory that are in use."""
    assert ground.process is not None
    status = Path(f"/proc/{ground.process.pid}/status").read_text()
    return round(int(status.split("VmRSS:")[1].split()[0]) / 1024, 1)


def callers(ground: Ground, many: int) -> dict[str, Any]:
    """All at once: how they were answered, and how long the last one waited."""
    started = time.perf_counter()

    def ask(seed: int) -> int:
        return httpx.post(f"{ground.address}/simulate", json=body(seed), timeout=600).status_code

    with ThreadPoolExecutor(many) as pool:
        statuses = list(pool.map(ask, range(many)))
    told = {str(status): statuses.count(status) for status in sorted(set(statuses))}
    return {"callers": many, "statuses": told, "all_answered_s": round(time.perf_counter() - started, 1)}


def full_queue(folder: Path, database: str | None) -> dict[str, Any]:
    """Milliseconds until a request of 1 MB is refused because the queue is full, while the server works."""
    ground = Ground(folder, database, queue_limit=4)
    try:
        ground.start()
        for seed in range(4):
            slow = body(seed, generator="slow", generator_options={"seconds": 60})
            httpx.post(f"{ground.address}/simulate", json=slow, headers={"Prefer": "respond-async"}, timeout=60)
        times: list[float] = []
        sent = json.dumps(body(9, question=QUESTION + " " * 3000)).encode() + b" " * 1_000_000
        with httpx.Client(base_url=ground.address) as client:
            for _ in range(40):
                started = time.perf_counter()
                answer = client.post("/simulate", content=sent, headers={"content-type": "application/json"})
                times.append(1000 * (time.perf_counter() - started))
                assert answer.json()["type"].endswith("queue-full"), answer.text
    finally:
        ground.kill()
        ground.close()
    return {"p50_ms": round(statistics.median(times), 1), "max_ms": round(max(times), 1)}


def soak(ground: Ground, requests: int) -> dict[str, Any]:
    """The server's memory along the way."""
    curve: list[float] = []
    with ThreadPoolExecutor(SOAKERS) as pool, httpx.Client(base_url=ground.address, timeout=600) as client:

        def ask(seed: int) -> int:
            return client.post("/simulate", json=body(seed, num_frames=9)).status_code

        statuses: list[int] = []
        for start in range(0, requests, 100):
            statuses += list(pool.map(ask, range(1_000_000 + start, 1_000_000 + start + 100)))
            curve.append(resident(ground))
    told = {str(status): statuses.count(status) for status in sorted(set(statuses))}
    return {"requests": requests, "statuses": told, "resident_mb_every_100": curve}


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--callers", type=int, default=100)
    parser.add_argument("--requests", type=int, default=2000)
    parser.add_argument("--database", help="postgresql://...; by default SQLite")
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    told: dict[str, Any] = {"database": "postgresql" if given.database else "sqlite"}
    with tempfile.TemporaryDirectory(prefix="cow-load-") as made:
        ground = Ground(Path(made), given.database)
        try:
            ground.start()
            told["callers"] = callers(ground, given.callers)
            print(json.dumps(told["callers"]), file=sys.stderr)
            told["soak"] = soak(ground, given.requests)
        finally:
            ground.close()
    with tempfile.TemporaryDirectory(prefix="cow-load-") as made:
        told["queue_full"] = full_queue(Path(made), given.database)
    print(json.dumps(told))
    if given.json:
        given.json.write_text(json.dumps(told, indent=1) + "\n")


if __name__ == "__main__":
    main()
