"""Measures what is painted behind a moving object: its difference to the true background, in the hole and around it.

    python benchmarks/backgrounds.py DIR [--json FILE]

DIR holds scenes of `cow-scenes`. Each is asked by image and question alone (the masks are cut from the image), with
true masks, and with true masks and a stand-in for an inpainting model: the true background, blurred by 2 px, with white
noise of 3 grey levels, and a smooth error of colour of 4. The residue is that of scenes.py, in grey levels.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from geometry import request_of
from scenes import pixels_of, residue
from stand_ins import GRID, read_truth

from cow_service.errors import CowError
from cow_service.generators.base import GeneratorInput
from cow_service.generators.cutout import generator as cutout
from cow_service.generators.cutout.layers import Layers, take_apart
from cow_service.requests import SimulateRequest
from cow_service.service import Service
from cow_service.settings import Settings
from cow_service.vision.types import Image, Mask

BLUR, NOISE, TINT = 2.0, 3.0, 4.0  # px, grey levels, grey levels
ARMS: dict[str, dict[str, Any] | None] = {"cut masks": None, "true masks": {}, "true masks, painted": {}}


class StandIn:
    """Paints as a model might: nearly the truth."""

    fingerprint = "stand-in"

    def __init__(self, folder: Path, seed: int) -> None:
        self.truth = pixels_of((folder / "background.jpg").read_bytes()).astype(np.float32)
        self.random = np.random.default_rng(seed)

    def fill(self, image: Image, hole: Mask, progress: Callable[[float], None]) -> Image:
        """See `Inpainter`."""
        tint = cv2.resize(self.random.normal(0, TINT, (*GRID, 3)), hole.shape[::-1], interpolation=cv2.INTER_CUBIC)
        painted = cv2.GaussianBlur(self.truth, (0, 0), BLUR) + tint + self.random.normal(0, NOISE, image.shape)
        return np.where(hole[..., None], np.clip(painted, 0, 255), image).astype(np.uint8)


def measure(service: Service, folder: Path, name: str, seed: int) -> dict[str, Any]:
    """One scene in one arm."""
    meta, truth = json.loads((folder / "meta.json").read_text()), read_truth(folder)
    body = request_of(meta, truth, folder, ARMS[name], seed) | {"frames": {"indices": [0]}}
    held: list[GeneratorInput] = []

    def hold(given: GeneratorInput, progress: Callable[[float], None]) -> Layers:
        held.append(given)
        return take_apart(given, progress)

    cutout.take_apart = hold
    row: dict[str, Any] = {"scene": folder.name, "arm": name}
    try:
        service.simulate(SimulateRequest.model_validate(body))
    except CowError as error:
        return row | {"residue": None, "why": error.code}
    given = replace(held[0], inpainter=StandIn(folder, seed)) if name.endswith("painted") else held[0]
    started = time.process_time()
    layers = take_apart(given)
    row["cpu_ms"] = round(1000 * (time.process_time() - started), 1)
    things = np.logical_or.reduce([thing.mask for thing in truth.things])
    return row | {"residue": residue(layers, folder, truth.thing(meta["object"]).mask, things)}


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--json", type=Path, default=None, help="write rows and summaries here")
    arguments = parser.parse_args()
    folders, results = sorted(path.parent for path in arguments.folder.rglob("meta.json")), list[dict[str, Any]]()
    with tempfile.TemporaryDirectory() as data, Service(Settings(data_dir=Path(data))) as service:
        for name in ARMS:
            rows = [measure(service, folder, name, seed) for seed, folder in enumerate(folders)]
            kept = [row for row in rows if row["residue"] is not None]
            mean, worst = (round(of([row["residue"] for row in kept]), 2) for of in (statistics.fmean, max))
            summary = {"scenes": len(kept), "residue, mean": mean, "residue, worst": worst}
            summary["take_apart, median CPU ms"] = statistics.median(row["cpu_ms"] for row in kept)
            print(name, summary)
            results.append({"arm": name, "summary": summary, "rows": rows})
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(results, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
