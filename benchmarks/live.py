"""Compares the world that the page moves while you drag with the server's: do they agree?

    python benchmarks/live.py [--scenes FOLDER ...] [--count 20] [--drags 5] [--json FILE]

Of each scene (`image.jpg` and `meta.json` with its `question`) the server computes the result and its worlds; then the
arrow is turned to directions drawn at random, and each is computed by the page's code in chromium and by the server.
`first` is the share of drags in which both name the same first contact, or none, within 0.1 s; `path` that in which the
paths are nowhere apart by more than 2% of the picture's width, as far as they lie in it; `share` how far the shares of
the worlds that say yes are apart, on the average. `likeliest_ms` and `futures_ms` are the times of one world and of all
50, medians and 95th percentiles.
"""

from __future__ import annotations

import argparse
import json
import math
import random
import shutil
import statistics
import sys
import tempfile
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import httpx
from latency import start_server
from playwright.sync_api import sync_playwright

ROOT = Path(__file__).resolve().parents[1]
sys.path.append(str(ROOT / "tests"))

from live_worlds import LOAD, RUN, given_again  # noqa: E402

APART = 0.02  # of the picture's width
LATE = 0.1  # s
NEAREST = 0.08  # of its first depth: closer than this, a body has passed the camera


def simulated(address: str, scene: Path, request: dict[str, Any]) -> dict[str, Any] | None:
    """The result; None if the server refuses."""
    question = json.loads((scene / "meta.json").read_text())["question"]
    body = json.dumps({"live": True, "video": False, "frames": {"count": 1}} | request)
    files = {"image": ("image.jpg", (scene / "image.jpg").read_bytes())}
    found = httpx.post(f"{address}/simulate", files=files, data={"question": question, "request": body}, timeout=60)
    return found.json() if found.is_success else None


def farthest(mine: list[list[float]], trajectory: dict[str, Any], start: list[float], width: float) -> float:
    """How far two paths are apart within the picture, of its width. Points of `mine` are [x, y, depth]."""
    x0, y0, depth = mine[0]
    most = 0.0
    for frame, ((x, y), is_seen) in enumerate(zip(*(trajectory[name] for name in ("points", "visible")), strict=True)):
        right, down, away = mine[min(frame, len(mine) - 1)]
        scale = depth / max(away, NEAREST * depth)
        if is_seen:
            here = right + scale * (start[0] - x0), down + scale * (start[1] - y0)
            most = max(most, math.dist(here, (x, y)) / width)
    return most


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=Path, nargs="+", default=[ROOT / "examples"])
    parser.add_argument("--count", type=int, default=20)
    parser.add_argument("--drags", type=int, default=5)
    parser.add_argument("--json", type=Path)
    wanted = parser.parse_args()
    rng, first, path, shares, spent = random.Random(0), [], [], [], []
    scenes = [folder for each in wanted.scenes for folder in sorted(each.iterdir()) if (folder / "image.jpg").exists()]
    chromium = shutil.which("chromium")
    if chromium is None:
        sys.exit("chromium is not installed.")
    with tempfile.TemporaryDirectory() as data, ExitStack() as stack, sync_playwright() as playwright:
        process, address, _ = start_server(Path(data))
        stack.callback(process.terminate)
        page = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox"]).new_page()
        page.goto(address)
        page.evaluate(LOAD)
        used = 0
        for scene in rng.sample(scenes, len(scenes)):
            result = simulated(address, scene, {})
            if used == wanted.count or result is None or result["trajectory"]["live"] is None:
                continue
            used += 1
            motion, names = result["motion"], [body["object"] for body in result["trajectory"]["bodies"]]
            world = httpx.get(f"{address}{result['trajectory']['live']['url']}").json()
            for _ in range(wanted.drags):
                angle = rng.uniform(-math.pi, math.pi)
                direction = [math.cos(angle), math.sin(angle)]
                told = simulated(address, scene, {"motion": given_again(motion, direction)})
                if told is None:
                    continue
                found, trajectory = page.evaluate(RUN, {"world": world, "direction": direction}), told["trajectory"]
                met = [e for e in trajectory["encounters"] if e["kind"] == "touches" and e["subject"] == 0]
                mine, theirs = found["met"], min(met, key=lambda each: each["time"], default=None)
                is_same = mine is None and theirs is None
                if mine is not None and theirs is not None:
                    is_same = names[mine["body"]] == theirs["object"] and abs(mine["time"] - theirs["time"]) < LATE
                first.append(is_same)
                start, width = result["grounding"]["point"], world["size"][0]
                path.append(farthest(found["points"], trajectory["paths"][0], start, width) < APART)
                outcome = trajectory["outcome"]
                if found["shares"] and "first" not in found["shares"] and outcome["probability"] is not None:
                    of_all = found["shares"]["yes"] / found["shares"]["count"]
                    shares.append(abs(of_all - outcome["probability"]))
                spent.append(found["milliseconds"])
    likeliest, futures = (sorted(each) for each in zip(*spent, strict=True))
    figures = {
        "scenes": used,
        "drags": len(first),
        "first": statistics.mean(first),
        "path": statistics.mean(path),
        "share": statistics.mean(shares),
        "likeliest_ms": [statistics.median(likeliest), likeliest[int(0.95 * len(likeliest))]],
        "futures_ms": [statistics.median(futures), futures[int(0.95 * len(futures))]],
    }
    print(json.dumps(figures, indent=2))
    if wanted.json:
        wanted.json.write_text(json.dumps(figures, indent=2) + "\n")


if __name__ == "__main__":
    main()
