"""Measures how much longer a chat through COW takes than the same chat sent to its MLLM directly.

    python benchmarks/chat.py [--runs N] [--json FILE]

The MLLM is a server on loopback that replies at once, in a process of its own; COW is a `cow serve` of its own. Chats
are sent in turn, directly and through COW, over connections that stay open. Medians and 95th percentiles, milliseconds.
"""

from __future__ import annotations

import argparse
import base64
import json
import os
import re
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Generator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import httpx
from rich.console import Console
from rich.table import Table

ROOT = Path(__file__).resolve().parents[1]
IMAGE = ROOT / "examples" / "ball-and-mug" / "image.jpg"
QUESTION = "If the yellow ball moves opposite to the direction of the arrow, will it hit the blue mug? (A) Yes (B) No"
MODEL = "cow/qwen3-vl-8b"


class Instant(BaseHTTPRequestHandler):
    """Replies at once, streamed where that is asked for."""

    protocol_version = "HTTP/1.1"
    disable_nagle_algorithm = True

    def log_message(self, format: str, *args: object) -> None:
        """Says nothing."""

    def do_POST(self) -> None:
        """One completion."""
        asked = json.loads(self.rfile.read(int(self.headers["content-length"])))
        head = {"id": "x", "object": "chat.completion", "created": 0, "model": "instant"}
        message = {"role": "assistant", "content": "ANSWER: A"}
        kind, data = "application/json", json.dumps(head | {"choices": [{"index": 0, "message": message}]})
        if asked.get("stream"):
            chunk = json.dumps(head | {"choices": [{"index": 0, "delta": message}]})
            kind, data = "text/event-stream", f"data: {chunk}\n\n" * 20 + "data: [DONE]\n\n"
        self.send_response(200)
        self.send_header("content-type", kind)
        self.send_header("content-length", str(len(data)))
        self.end_headers()
        self.wfile.write(data.encode())


def serve_instant() -> None:
    with ThreadingHTTPServer(("127.0.0.1", 0), Instant) as server:
        print(f"http://127.0.0.1:{server.server_port}/v1", flush=True)
        server.serve_forever()


@contextmanager
def started(command: list[str], **settings: str) -> Generator[subprocess.Popen[str]]:
    environment = {name: value for name, value in os.environ.items() if not name.startswith("COW_")} | settings
    streams: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
    with subprocess.Popen(command, env=environment, **streams) as process:
        try:
            yield process
        finally:
            process.terminate()


def address_of(process: subprocess.Popen[str], pattern: str) -> str:
    """The first address of that form that a process prints."""
    assert process.stdout is not None
    for line in process.stdout:
        if found := re.search(pattern, line):
            return found[0]
    raise RuntimeError("the server ended before it was ready")


def chats() -> dict[str, dict[str, Any]]:
    """What is sent, by name: nothing of it is imagined but the last."""
    url = "data:image/jpeg;base64," + base64.b64encode(IMAGE.read_bytes()).decode()
    content = [{"type": "image_url", "image_url": {"url": url}}, {"type": "text", "text": QUESTION}]
    text, seen = [{"role": "user", "content": "hello"}], [{"role": "user", "content": content}]
    return {
        "text": {"model": MODEL, "messages": text},
        "text, streamed": {"model": MODEL, "messages": text, "stream": True},
        "image, :no-imagination": {"model": MODEL + ":no-imagination", "messages": seen},
        "image, imagined before": {"model": MODEL, "messages": seen, "cow": {"reader": "embedded"}},
    }


def measure(direct: str, through: str, body: dict[str, Any], runs: int) -> dict[str, float]:
    """Milliseconds of both ways, in turn."""
    times: dict[str, list[float]] = {direct: [], through: []}
    with httpx.Client(timeout=60) as client:
        for run in range(runs + 3):
            for address, taken in times.items():
                started_at = time.perf_counter()
                response = client.post(f"{address}/chat/completions", json=body)
                response.raise_for_status()
                if run >= 3:  # the first ones open connections, and imagine
                    taken.append(1000 * (time.perf_counter() - started_at))
    added = [b - a for a, b in zip(times[direct], times[through], strict=True)]
    return {
        "direct p50_ms": round(statistics.median(times[direct]), 2),
        "through COW p50_ms": round(statistics.median(times[through]), 2),
        "added p50_ms": round(statistics.median(added), 2),
        "added p95_ms": round(statistics.quantiles(added, n=20)[-1], 2),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--json", type=Path, default=None)
    parser.add_argument("--instant", action="store_true", help="be the MLLM's server")
    given = parser.parse_args()
    if given.instant:
        serve_instant()
        return
    with tempfile.TemporaryDirectory() as data, started([sys.executable, __file__, "--instant"]) as instant:
        direct = address_of(instant, r"http://\S+/v1")
        own = {"COW_DATA_DIR": data, "COW_PORT": "0", "COW_MLLM": "qwen3-vl-8b", "COW_MLLM_BASE_URL": direct}
        command = [str(Path(sys.executable).with_name("cow")), "serve"]
        with started(command, **own) as cow:
            through = address_of(cow, r"http://127\.0\.0\.1:\d+") + "/v1"
            rows = {name: measure(direct, through, body, given.runs) for name, body in chats().items()}
    table = Table("chat", *next(iter(rows.values())))
    for name, row in rows.items():
        table.add_row(name, *(f"{value:.1f}" for value in row.values()))
    Console().print(table)
    if given.json is not None:
        given.json.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
