"""Measures the page in a real browser: first view, dragging, and the time until a new answer is there.

    python benchmarks/page.py [--runs N] [--json FILE]

A `cow serve` of its own and Debian's chromium, 1280 x 900 px, on this machine. First contentful paint, the time until
an example can be pressed (from the start of the navigation, both in ms) and the bytes and requests of the first view
are of new contexts, whose caches are empty. Frames a second are those that the browser shows while the arrow of
`examples/ball-and-mug` is dragged by the mouse for two seconds; `longest_ms` is the longest time between two of them.
The new answer is waited for from the release of the arrow; each drag is to another place. Medians.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import shutil
import statistics
import sys
import tempfile
import time
from itertools import pairwise
from pathlib import Path
from typing import Any

from latency import start_server
from playwright.sync_api import Browser, Page, Request, ViewportSize, sync_playwright

ROOT = Path(__file__).resolve().parents[1]
IMAGE = ROOT / "examples" / "ball-and-mug" / "image.jpg"
QUESTION = "If the yellow ball moves opposite to the direction of the arrow, will it hit the blue mug?"
WINDOW = ViewportSize(width=1280, height=900)  # CSS px
DRAG_SECONDS = 2.0
DRAG_RADIUS = 60.0  # CSS px
# Notes when an example is there, and when each frame is shown.
WATCH = """
window.frameTimes = [];
const tick = (now) => { window.frameTimes.push(now); requestAnimationFrame(tick); };
requestAnimationFrame(tick);
const look = () => {
    if (document.querySelector(".examples button")) window.usableAt ??= performance.now();
};
new MutationObserver(look).observe(document, { childList: true, subtree: true });
"""
PAINT = "performance.getEntriesByName('first-contentful-paint')[0]?.startTime"


def first_view(browser: Browser, address: str) -> dict[str, float]:
    """Of one new context: milliseconds until it is painted and usable, bytes over the wire, requests."""
    context = browser.new_context(viewport=WINDOW)
    page = context.new_page()
    page.add_init_script(WATCH)
    requests: list[Request] = []
    page.on("requestfinished", lambda request: requests.append(request))  # noqa: PLW0108 - playwright refuses builtins
    page.goto(address, wait_until="networkidle")
    sizes = [request.sizes() for request in requests]
    parts = ("requestHeadersSize", "requestBodySize", "responseHeadersSize", "responseBodySize")
    figures: dict[str, float] = {
        "first_contentful_paint_ms": page.evaluate(PAINT),
        "usable_ms": page.evaluate("window.usableAt"),
        "bytes": sum(size[part] for size in sizes for part in parts),
        "requests": len(requests),
    }
    context.close()
    return figures


def shown_result(page: Page, before: str | None = None) -> str:
    """The id of the job whose result is shown, once it is another one than `before`."""
    shown = page.locator(".result[data-job]:not(.old)" + (f":not([data-job='{before}'])" if before else ""))
    shown.wait_for()
    return shown.get_attribute("data-job") or ""


def dragging(browser: Browser, address: str, runs: int) -> tuple[dict[str, float], list[float]]:
    """Frames a second while the arrow is dragged, and the milliseconds from each release to the new answer."""
    context = browser.new_context(viewport=WINDOW, reduced_motion="reduce")
    page = context.new_page()
    page.add_init_script(WATCH)
    page.goto(address)
    page.locator("input[type=file]").first.set_input_files(IMAGE)
    page.locator("#question").fill(QUESTION)
    page.locator("#question").press("Enter")
    job = shown_result(page)
    rates: list[float] = []
    longest: list[float] = []
    waits: list[float] = []
    for run in range(runs):
        tip = page.locator(".handle.tip")
        tip.scroll_into_view_if_needed()
        box = tip.bounding_box()
        assert box is not None
        x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
        page.mouse.move(x, y)
        page.mouse.down()
        began = page.evaluate("performance.now()")
        until = time.perf_counter() + DRAG_SECONDS
        while (left := until - time.perf_counter()) > 0:
            angle = 2 * math.pi * left
            page.mouse.move(x + DRAG_RADIUS * math.cos(angle), y + DRAG_RADIUS * math.sin(angle))
        ended = page.evaluate("performance.now()")
        page.mouse.move(x - 20 - 5 * run, y - 40 - 10 * run)
        released = time.perf_counter()
        page.mouse.up()
        job = shown_result(page, before=job)
        waits.append(1000 * (time.perf_counter() - released))
        times = [at for at in page.evaluate("window.frameTimes") if began <= at <= ended]
        rates.append(1000 * len(times) / (ended - began))
        longest.append(max(after - before for before, after in pairwise(times)))
    context.close()
    return {"p50_fps": statistics.median(rates), "least_fps": min(rates), "longest_ms": max(longest)}, waits


def rounded(figures: dict[str, float]) -> dict[str, float]:
    """To a tenth."""
    return {name: round(value, 1) for name, value in figures.items()}


def measure(chromium: str, runs: int) -> dict[str, Any]:
    """All figures."""
    with tempfile.TemporaryDirectory() as data, sync_playwright() as playwright:
        process, address, _ = start_server(Path(data))
        browser = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        try:
            first_view(browser, address)  # not counted
            views = [first_view(browser, address) for _ in range(runs)]
            frames, waits = dragging(browser, address, runs)
        finally:
            browser.close()
            process.terminate()
            process.communicate()
        return {
            "cores": os.cpu_count(),
            "browser": browser.version,
            "runs": runs,
            "first view": rounded({name: statistics.median(view[name] for view in views) for name in views[0]}),
            "dragging": rounded(frames),
            "release to answer": rounded({"p50_ms": statistics.median(waits), "max_ms": max(waits)}),
        }


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--json", type=Path, default=None, help="write the figures here")
    arguments = parser.parse_args()
    chromium = shutil.which("chromium")
    if chromium is None:
        parser.error("chromium is not installed: apt-get install --no-install-recommends chromium")
    figures = measure(chromium, arguments.runs)
    print(json.dumps(figures, indent=2))
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(figures, indent=2) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
