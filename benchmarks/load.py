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

sys.path.append(str(Path(__file__).resolve().parents[1] / "tests"))

from servers import Served

ROOT = Path(__file__).resolve().parents[1]
EXAMPLE = ROOT / "examples" / "ball-and-mug"
QUESTION = "If the yellow ball moves to the left, will it hit the blue mug?"
SOAKERS = 4


def server(folder: str, database: str | None, **settings: str) -> Served:
    """A server with an empty data folder, as users start it."""
    usual = {"COW_WORKERS": "true", "COW_WARMUP": "true", "COW_QUEUE_LIMIT": "100000"}
    return Served(Path(folder), **usual | settings | ({"COW_DATABASE_URL": database} if database else {}))


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


def resident(served: Served) -> float:
    """MB of the server's memory that are in use."""
    assert served.process is not None
    status = Path(f"/proc/{served.process.pid}/status").read_text()
    return round(int(status.split("VmRSS:")[1].split()[0]) / 1024, 1)


def callers(served: Served, many: int) -> dict[str, Any]:
    """All at once: how they were answered, and how long the last one waited."""
    started = time.perf_counter()

    def ask(seed: int) -> int:
        return httpx.post(f"{served.http.base_url}/simulate", json=body(seed), timeout=600).status_code

    with ThreadPoolExecutor(many) as pool:
        statuses = list(pool.map(ask, range(many)))
    told = {str(status): statuses.count(status) for status in sorted(set(statuses))}
    return {"callers": many, "statuses": told, "all_answered_s": round(time.perf_counter() - started, 1)}


def full_queue(folder: str, database: str | None) -> dict[str, Any]:
    """Milliseconds until a request of 1 MB is refused because the queue is full, while the server works."""
    with server(folder, database, COW_QUEUE_LIMIT="4") as served:
        for seed in range(4):
            slow = body(seed, generator="slow", generator_options={"seconds": 60})
            served.submit(slow)
        times: list[float] = []
        sent = json.dumps(body(9, question=QUESTION + " " * 3000)).encode() + b" " * 1_000_000
        for _ in range(40):
            started = time.perf_counter()
            answer = served.http.post("/simulate", content=sent, headers={"content-type": "application/json"})
            times.append(1000 * (time.perf_counter() - started))
            assert answer.json()["type"].endswith("queue-full"), answer.text
    return {"p50_ms": round(statistics.median(times), 1), "max_ms": round(max(times), 1)}


def soak(served: Served, requests: int) -> dict[str, Any]:
    """The server's memory along the way."""
    curve: list[float] = []
    with ThreadPoolExecutor(SOAKERS) as pool, httpx.Client(base_url=served.http.base_url, timeout=600) as client:

        def ask(seed: int) -> int:
            return client.post("/simulate", json=body(seed, num_frames=9)).status_code

        statuses: list[int] = []
        for start in range(0, requests, 100):
            statuses += list(pool.map(ask, range(1_000_000 + start, 1_000_000 + start + 100)))
            curve.append(resident(served))
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
    with tempfile.TemporaryDirectory(prefix="cow-load-") as folder, server(folder, given.database) as served:
        told["callers"] = callers(served, given.callers)
        print(json.dumps(told["callers"]), file=sys.stderr)
        told["soak"] = soak(served, given.requests)
    with tempfile.TemporaryDirectory(prefix="cow-load-") as folder:
        told["queue_full"] = full_queue(folder, given.database)
    print(json.dumps(told))
    if given.json:
        given.json.write_text(json.dumps(told, indent=1) + "\n")


if __name__ == "__main__":
    main()
