"""How the cost of a simulation grows: with the image's size, the clip's length and the number of objects.

    python benchmarks/growth.py [--runs N] [--json FILE] [--plot FILE.svg]

The pipeline runs in this process, without server and job engine, every time anew; milliseconds are medians. The slope
is that of a line through the logarithms: 1 is linear growth. Of the jobs that are kept see `jobs.py`: `--jobs FILE`
takes its figures into the plot.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from profile_stages import EXAMPLE, GIVEN, PHOTO, photograph  # beside this file

from cow_service.media.images import encode_png
from cow_service.requests import SimulateRequest
from cow_service.service import Service
from cow_service.settings import Settings

MEGAPIXELS = (0.4, 1.5, 3, 6, 12, 24)
FRAMES = (17, 33, 49, 81, 121, 161)
OBJECTS = (1, 2, 5, 10, 20, 40)
META = json.loads((EXAMPLE / "meta.json").read_text())
MOVER = [  # box in the photograph, px
    side * whole / small for side, whole, small in zip(META["bbox"], PHOTO * 2, META["image_size"] * 2, strict=True)
]
QUESTION = "If the ball moves to the right, what does it hit?"
COLUMNS, CELL = 8, 90  # of the objects beside the mover; px


def of_size(megapixels: float) -> tuple[bytes, dict[str, Any]]:
    """A photograph with a number of millions of pixels, and its mover."""
    scale = math.sqrt(megapixels * 1e6 / (PHOTO[0] * PHOTO[1]))
    image = photograph(round(PHOTO[0] * scale), round(PHOTO[1] * scale))
    return image, {**GIVEN, "grounding": {"bbox": [side * scale for side in MOVER]}}


def of_objects(count: int) -> tuple[bytes, dict[str, Any]]:
    """A picture of that many separate objects; the first one moves."""
    height, width = 600, (COLUMNS + 2) * CELL
    image = np.full((height, width, 3), 170, np.uint8)
    image[:90] = 215
    cv2.circle(image, (CELL // 2, 400), 28, (210, 60, 40), -1, cv2.LINE_AA)
    for number in range(count - 1):
        x, y = CELL * 3 // 2 + number % COLUMNS * CELL, 140 + number // COLUMNS * CELL
        colour = cv2.cvtColor(np.array([[[number * 37 % 180, 200, 200]]], np.uint8), cv2.COLOR_HSV2RGB)[0, 0].tolist()
        cv2.rectangle(image, (x, y), (x + 44, y + 44), colour, -1)
    motion = {"direction": [1.0, 0.0]}
    place = {"bbox": [CELL / 2 - 28, 372, CELL / 2 + 28, 428], "object": "ball"}
    return encode_png(image), {"grounding": place, "motion": motion, "video": False}


def of_frames(count: int) -> tuple[bytes, dict[str, Any]]:
    """The smallest photograph, with a clip of a number of frames."""
    image, request = of_size(MEGAPIXELS[0])
    return image, {**request, "num_frames": count, "video": True}


CURVES: dict[str, tuple[tuple[Any, ...], Callable[[Any], tuple[bytes, dict[str, Any]]]]] = {
    "megapixels": (MEGAPIXELS, of_size),
    "frames": (FRAMES, of_frames),
    "objects": (OBJECTS, of_objects),
}


def timed(service: Service, image: bytes, request: dict[str, Any], runs: int) -> dict[str, Any]:
    """Median milliseconds of a simulation, and how many bodies its world has."""
    times: list[float] = []
    bodies = 0
    for number in range(runs + 1):
        started = time.perf_counter()
        artifact = service.keep_image(image)
        asked = {"image": {"artifact": artifact.sha256}, "question": QUESTION, **request}
        found = service.simulate(SimulateRequest.model_validate(asked))
        bodies = len(found.trajectory.bodies)
        if number:
            times.append(1000 * (time.perf_counter() - started))
    return {"ms": round(statistics.median(times), 1), "bodies": bodies}


def slope(rows: list[dict[str, Any]], of: str) -> float:
    """Of a line through the logarithms, least squares."""
    return round(float(np.polyfit(np.log([row[of] for row in rows]), np.log([row["ms"] for row in rows]), 1)[0]), 2)


def plot(told: dict[str, Any], path: Path) -> None:
    """The curves on logarithmic axes, with a line of linear growth."""
    import matplotlib as mpl  # noqa: PLC0415 # of the extra `evals`

    mpl.use("svg")
    mpl.rcParams |= {"svg.hashsalt": "cow", "svg.fonttype": "none", "font.size": 8}
    from matplotlib import pyplot as plt  # noqa: PLC0415

    names = [name for name in (*CURVES, "jobs") if name in told]
    figure, axes = plt.subplots(1, len(names), figsize=(3.2 * len(names), 3), layout="constrained")
    for axis, name in zip(np.atleast_1d(axes), names, strict=True):
        rows = told[name]["rows"]
        x, y = np.array([row[name] for row in rows], float), np.array([row["ms"] for row in rows])
        axis.plot(x, y[0] * x / x[0], color="0.7", linestyle="--", linewidth=1, label="linear growth")
        axis.plot(x, y, color="#0072b2", marker="o", markersize=4, label="measured")
        axis.set(xscale="log", yscale="log", xlabel=name, title=f"slope {told[name]['slope']}")
        axis.set_ylim(y.min() / 2, y.max() * 4)
        axis.set_xticks(x, [f"{value:g}" if value < 1e4 else f"{value / 1000:g}k" for value in x])
        axis.yaxis.set_major_formatter("{x:g}")
        axis.minorticks_off()
        axis.grid(True, which="major", linewidth=0.3)
    first = np.atleast_1d(axes)[0]
    first.set_ylabel("milliseconds")
    first.legend(fontsize=7, frameon=False)
    figure.savefig(path, metadata={"Date": None})


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--jobs", type=Path, help="figures of jobs.py: the page of failed jobs is a curve, too")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--plot", type=Path)
    given = parser.parse_args()
    told: dict[str, Any] = {"cores": os.cpu_count(), "runs": given.runs}
    with tempfile.TemporaryDirectory() as folder:
        service = Service(Settings(data_dir=Path(folder)))
        for name, (values, make) in CURVES.items():
            rows = [{name: value, **timed(service, *make(value), given.runs)} for value in values]
            told[name] = {"rows": rows, "slope": slope(rows, name)}
            print(name, json.dumps(told[name]), flush=True)
    if given.jobs:
        rows = [{"jobs": row["jobs"], "ms": row["failed_ms"]} for row in json.loads(given.jobs.read_text())]
        told["jobs"] = {"rows": rows, "slope": slope(rows, "jobs")}
    if given.json:
        given.json.write_text(json.dumps(told, indent=1) + "\n")
    if given.plot:
        plot(told, given.plot)


if __name__ == "__main__":
    main()
