"""Measures calls that adapt, against a simulated MLLM that refuses calls beyond a limit with status 429.

    python benchmarks/adaptive.py [--questions 1320] [--seconds 2] [--accepts 64] [--only NAME] [--json FILE]

The MLLM is an asyncio server in a process of its own. It is asked one call a question: by the MLLM client alone, with
several bounds; by `cow batch` through a `cow serve` of two workers, for answers without imagination; and by `cow eval`
in its arm `never`. `ratio` is the time from the first call to the last reply over the ideal, questions x seconds /
accepts; `refused` is the share of calls that got status 429.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import numpy as np

ROOT = Path(__file__).resolve().parents[1]
IMAGE = ROOT / "examples" / "ball-and-mug" / "image.jpg"
QUESTION = "If the yellow ball moves to the left, will it hit the blue mug? (A) Yes (B) No"
REPLY = {"role": "assistant", "content": '{"reasoning": "It rolls.", "answer": "A"}\n{\'Answer\': \'(A)\'}'}
BOUNDS = (64, 256)  # of the MLLM client
COW = [sys.executable, "-m", "cow_service.cli.main"]


class Mllm:
    """The simulated MLLM: `accepts` calls at once, `seconds` each."""

    def __init__(self, accepts: int, seconds: float) -> None:
        self.accepts, self.seconds = accepts, seconds
        self.reset()

    def reset(self) -> None:
        """Resets the counts."""
        self.at_once = self.most = self.calls = self.refused = 0
        self.first = self.last = 0.0

    def counts(self) -> dict[str, Any]:
        """What it was asked since."""
        return {"calls": self.calls, "refused": self.refused, "most": self.most, "seconds": self.last - self.first}

    async def reply(self, path: str) -> tuple[int, Any]:
        """Status and JSON."""
        if path == "/counts":
            return 200, self.counts()
        if path == "/reset":
            return 200, self.reset()
        self.calls += 1
        self.first = self.first or time.monotonic()
        if self.at_once >= self.accepts:
            self.refused += 1
            return 429, {"error": {"message": "busy", "type": "rate_limit"}}
        self.at_once += 1
        self.most = max(self.most, self.at_once)
        try:
            await asyncio.sleep(self.seconds)
        finally:
            self.at_once -= 1
        self.last = time.monotonic()
        usage = {"prompt_tokens": 1, "completion_tokens": 1, "total_tokens": 2}
        choices = [{"index": 0, "finish_reason": "stop", "message": REPLY}]
        return 200, {
            "id": "x", "object": "chat.completion", "created": 1, "model": "m", "choices": choices, "usage": usage,
        }  # fmt: skip

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """One connection."""
        try:
            while head := await reader.readuntil(b"\r\n\r\n"):
                length = re.search(rb"(?i)content-length: *(\d+)", head)
                if length is not None:
                    await reader.readexactly(int(length[1]))
                status, value = await self.reply(head.split()[1].decode())
                body = json.dumps(value).encode()
                fields = f"content-type: application/json\r\ncontent-length: {len(body)}"
                writer.write(f"HTTP/1.1 {status} x\r\n{fields}\r\n\r\n".encode() + body)
                await writer.drain()
        except (asyncio.IncompleteReadError, ConnectionError):
            pass
        finally:
            writer.close()


async def serve_mllm(accepts: int, seconds: float) -> None:
    """Serves for ever, and prints its address first."""
    server = await asyncio.start_server(Mllm(accepts, seconds).serve, "127.0.0.1", 0, limit=2**24, backlog=512)
    print(f"http://127.0.0.1:{server.sockets[0].getsockname()[1]}", flush=True)
    await server.serve_forever()


@contextmanager
def started(command: list[str], **settings: str) -> Generator[str]:
    """A process, and the first address that it prints; ended with the block."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith("COW_")} | settings
    with (
        tempfile.NamedTemporaryFile("w+") as log,
        subprocess.Popen(command, stdout=log, stderr=log, env=environment) as one,
    ):
        try:
            while (found := re.search(r"http://[\d.]+:\d+", Path(log.name).read_text())) is None:
                time.sleep(0.1)
            yield found[0]
        finally:
            one.terminate()


def by_client(address: str, questions: int, bound: int) -> None:
    """All calls are given to one `MllmClient` at once."""
    from cow_service.readers.base import ReaderInput  # noqa: PLC0415 - the MLLM's own process needs none of it
    from cow_service.readers.mllm.client import MllmClient, PromptCall  # noqa: PLC0415
    from cow_service.readers.mllm.models import configure  # noqa: PLC0415
    from cow_service.settings import Settings  # noqa: PLC0415

    settings = Settings(mllm="generic", mllm_base_url=f"{address}/v1", mllm_concurrency=bound, mllm_budget=3600)
    client = MllmClient(configure(settings), settings)
    inputs: dict[str, object] = {"question": QUESTION, "shown": "nothing", "facts": ()}
    calls = [PromptCall("eval-question", inputs, (), {}, str, vote) for vote in range(questions)]
    given = ReaderInput(np.zeros((8, 8, 3), np.uint8), QUESTION)
    failed = sum(not isinstance(reply, str) for reply in client.complete_all(calls, given))
    client.close()
    if failed:
        raise SystemExit(f"{failed} calls failed")


def by_batch(address: str, questions: int, folder: Path) -> str:
    """`cow batch` through a server; returns the last line of its progress that says what limits it."""
    settings = {"COW_MLLM": "generic", "COW_MLLM_BASE_URL": f"{address}/v1", "COW_DATA_DIR": str(folder / "data")}
    lines = [{"id": f"q{n}", "image": str(IMAGE), "question": QUESTION, "seed": n} for n in range(questions)]
    path = folder / "questions.jsonl"
    path.write_text("".join(json.dumps({**line, "imagine": "never"}) + "\n" for line in lines))
    with started([*COW, "serve"], COW_PORT="0", **settings) as url:
        while httpx.get(f"{url}/readyz").status_code != 200:
            time.sleep(0.2)
        command = [*COW, "batch", str(path), "--out", str(folder / "out"), "--url", url]
        done = subprocess.run(command, check=False, capture_output=True, text=True)
        if done.returncode:
            raise SystemExit(done.stdout + done.stderr)
    limits = [line.partition("; ")[2] for line in done.stderr.splitlines() if "limited by" in line]
    return limits[-1] if limits else ""


def by_eval(address: str, questions: int, folder: Path) -> None:
    """`cow eval` of the questions of the sample, again and again, in the arm that imagines nothing."""
    sample = ROOT / "cow-scenes" / "sample"
    own = ["--mllm", "openai-api/local/m", "--base-url", f"{address}/v1", "--arm", "never", "--out", str(folder)]
    repeats = ["--repeats", str(questions // 12)]  # the sample has 12
    environment = {**os.environ, "LOCAL_API_KEY": "none"}
    subprocess.run([*COW, "eval", str(sample), *own, *repeats], check=True, env=environment, stdout=subprocess.DEVNULL)


def main() -> None:
    """Measures, and prints or writes what was found."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--questions", type=int, default=1320)
    parser.add_argument("--seconds", type=float, default=2.0)
    parser.add_argument("--accepts", type=int, default=64)
    parser.add_argument("--only", default="")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--serve", action="store_true", help=argparse.SUPPRESS)
    wanted = parser.parse_args()
    if wanted.serve:
        asyncio.run(serve_mllm(wanted.accepts, wanted.seconds))
    ideal = wanted.questions * wanted.seconds / wanted.accepts
    rows: dict[str, Any] = {}
    ways = [f"MLLM client, at most {bound}" for bound in BOUNDS] + ["cow batch", "cow eval"]
    command = [sys.executable, __file__, "--serve", "--accepts", str(wanted.accepts), "--seconds", str(wanted.seconds)]
    for way in [way for way in ways if wanted.only in way]:
        with started(command) as address, tempfile.TemporaryDirectory() as folder:
            begun, limited = time.monotonic(), ""
            if way == "cow batch":
                limited = by_batch(address, wanted.questions, Path(folder))
            elif way == "cow eval":
                by_eval(address, wanted.questions, Path(folder))
            else:
                by_client(address, wanted.questions, int(way.split()[-1]))
            total, counts = time.monotonic() - begun, httpx.get(f"{address}/counts").json()
        rows[way] = {
            "ratio": round(counts["seconds"] / ideal, 3),
            "refused": round(counts["refused"] / counts["calls"], 4),
            "most_at_once": counts["most"],
            "calls": counts["calls"],
            "seconds": round(counts["seconds"], 1),
            "seconds_with_start": round(total, 1),
            **({"limited": limited} if limited else {}),
        }
        print(way, json.dumps(rows[way]), flush=True)
    if wanted.json:
        given = {"questions": wanted.questions, "seconds": wanted.seconds, "accepts": wanted.accepts}
        about = {**given, "ideal_seconds": round(ideal, 2), "cores": os.cpu_count()}
        wanted.json.write_text(json.dumps({**about, "ways": rows}, indent=2) + "\n")


if __name__ == "__main__":
    main()
