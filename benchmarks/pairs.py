"""Compares two checkouts by one benchmark, in turn: A B B A A B ..., and prints the ratio of each figure.

    python benchmarks/pairs.py CHECKOUT_A CHECKOUT_B [--pairs N] [--json FILE] -- latency.py --runs 5

The benchmark is that beside this file, so that both are measured alike; it runs in each checkout's folder and imports
its `cow_service`. Before the first pair each runs once, uncounted. A machine's speed may drift by half while it is
measured: trust the ratios B/A pair by pair, their median and their spread, before any milliseconds. Every benchmark
that has `--json` can be compared; figures are told by their path in its JSON.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent


def measured(checkout: Path, command: list[str]) -> dict[str, float]:
    """The figures of one run."""
    with tempfile.TemporaryDirectory() as folder:
        told = Path(folder) / "figures.json"
        script = [sys.executable, str(HERE / command[0]), *command[1:], "--json", str(told)]
        environment = os.environ | {"PYTHONPATH": str(checkout)}
        subprocess.run(script, cwd=checkout, env=environment, check=True, stdout=subprocess.DEVNULL)
        return figures(json.loads(told.read_text()))


def figures(value: Any, path: str = "") -> dict[str, float]:
    """All numbers of a JSON value by their path."""
    if isinstance(value, bool) or value is None or isinstance(value, str):
        return {}
    if isinstance(value, int | float):
        return {path: float(value)}
    named = enumerate(value) if isinstance(value, list) else value.items()
    found: dict[str, float] = {}
    for name, part in named:
        found |= figures(part, f"{path}.{name}" if path else str(name))
    return found


def compared(a: list[dict[str, float]], b: list[dict[str, float]]) -> dict[str, dict[str, float]]:
    """Per figure that all runs have: the medians, and the ratios B/A of the pairs."""
    common = set.intersection(*(set(run) for run in (*a, *b)))
    found: dict[str, dict[str, float]] = {}
    for name in (name for name in a[0] if name in common and all(run[name] > 0 for run in a)):
        ratios = [after[name] / before[name] for before, after in zip(a, b, strict=True)]
        found[name] = {
            "a": round(statistics.median(run[name] for run in a), 3),
            "b": round(statistics.median(run[name] for run in b), 3),
            "ratio": round(statistics.median(ratios), 3),
            "least": round(min(ratios), 3),
            "most": round(max(ratios), 3),
        }
    return found


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("a", type=Path)
    parser.add_argument("b", type=Path)
    parser.add_argument("--pairs", type=int, default=5)
    parser.add_argument("--only", default="", help="figures whose path has this in it")
    parser.add_argument("--json", type=Path)
    ours, command = sys.argv[1:], []
    if "--" in ours:
        ours, command = ours[: ours.index("--")], ours[ours.index("--") + 1 :]
    given = parser.parse_args(ours)
    if not command:
        parser.error("name a benchmark behind --, as in: -- latency.py --runs 5")
    checkouts = given.a.resolve(), given.b.resolve()
    for checkout in checkouts:
        if (checkout / "hatch_build.py").exists():  # makes the modules that an installation makes
            subprocess.run([sys.executable, "hatch_build.py"], cwd=checkout, check=True)
        measured(checkout, command)
    runs: dict[Path, list[dict[str, float]]] = {checkout: [] for checkout in checkouts}
    for number in range(given.pairs):
        for checkout in checkouts if number % 2 == 0 else checkouts[::-1]:
            runs[checkout].append(measured(checkout, command))
    load = os.getloadavg()[0]
    found = compared(*(runs[checkout] for checkout in checkouts))
    told = {name: each for name, each in found.items() if given.only in name}
    print(f"{' '.join(command)}: {given.pairs} pairs, {os.cpu_count()} cores, load {load:.1f}")
    print(f"{'A':>12} {'B':>12} {'B/A':>7} {'least':>7} {'most':>7}  figure")
    for name, each in told.items():
        row = f"{each['a']:>12.2f} {each['b']:>12.2f} {each['ratio']:>7.2f} {each['least']:>7.2f} {each['most']:>7.2f}"
        print(f"{row}  {name}")
    if given.json:
        about = {"command": command, "pairs": given.pairs, "cores": os.cpu_count(), "load": load}
        given.json.write_text(json.dumps({**about, "figures": told}, indent=1) + "\n")


if __name__ == "__main__":
    main()
