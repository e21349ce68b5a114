"""Measures what is painted behind a moving object: its difference to the true background, in the hole and around it.

    python benchmarks/backgrounds.py DIR [--json FILE]

DIR holds scenes of `cow-scenes`: asked with masks that are cut from the image, with true ones, then with a stand-in for
an inpainting model: the true background, blurred by 2 px, with white noise of 3 grey levels and a smooth error of
colour of 4, or exact; then what is left is the compositor's own. The residue is that of scenes.py, in grey levels.
"""

from __future__ import annotations

import argparse
import json
import statistics
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from geometry import request_of
from scenes import Composed, pixels_of, residue
from stand_ins import GRID, read_truth

from cow_service.errors import CowError
from cow_service.generators.cutout.layers import take_apart
from cow_service.media.types import Image, Mask
from cow_service.requests import SimulateRequest
from cow_service.service import Service
from cow_service.settings import Settings

BLUR, NOISE, TINT = 2.0, 3.0, 4.0  # px, grey levels, grey levels


class StandIn:
    """Paints nearly the truth, or the truth."""

    fingerprint = "stand-in"

    def __init__(self, folder: Path, seed: int, errors: bool) -> None:
        truth, random = pixels_of((folder / "background.jpg").read_bytes()), np.random.default_rng(seed)
        tint = cv2.resize(random.normal(0, TINT, (*GRID, 3)), truth.shape[1::-1], interpolation=cv2.INTER_CUBIC)
        wrong = cv2.GaussianBlur(truth, (0, 0), BLUR) + tint + random.normal(0, NOISE, truth.shape)
        self.painted = np.clip(wrong, 0, 255).astype(np.uint8) if errors else truth

    def fill(self, image: Image, hole: Mask, progress: Callable[[float], None]) -> Image:
        """See `Inpainter`."""
        return np.where(hole[..., None], self.painted, image)


def measure(service: Service, composed: Composed, folder: Path, seed: int) -> list[dict[str, Any]]:
    """One scene, a row per arm."""
    meta, truth, rows = json.loads((folder / "meta.json").read_text()), read_truth(folder), list[dict[str, Any]]()
    mover, things = truth.thing(meta["object"]).mask, np.logical_or.reduce([thing.mask for thing in truth.things])
    painters = {"painted": StandIn(folder, seed, True), "painted exactly": StandIn(folder, seed, False)}
    for masks, arm in (("cut masks", None), ("true masks", {})):
        try:
            body = request_of(meta, truth, folder, arm, seed) | {"frames": {"indices": [0]}}
            service.simulate(SimulateRequest.model_validate(body))
        except CowError as error:
            rows.append({"scene": folder.name, "arm": masks, "error": error.code})
            continue
        for name, painter in ({"filled": None} | (painters if arm is not None else {})).items():
            started = time.process_time()
            layers = take_apart(replace(composed.given, inpainter=painter))
            spent = round(1000 * (time.process_time() - started), 1)
            off = residue(layers, folder, mover, things)
            rows.append({"scene": folder.name, "arm": f"{masks}, {name}", "residue": off, "cpu_ms": spent})
    return rows


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--json", type=Path, default=None, help="write rows and summaries here")
    arguments = parser.parse_args()
    folders, composed = sorted(path.parent for path in arguments.folder.rglob("meta.json")), Composed()
    with tempfile.TemporaryDirectory() as data, Service(Settings(data_dir=Path(data))) as service:
        rows = [row for seed, folder in enumerate(folders) for row in measure(service, composed, folder, seed)]
    summary: dict[str, Any] = {}
    for arm in dict.fromkeys(row["arm"] for row in rows if "residue" in row):
        kept = [row for row in rows if row["arm"] == arm and row["residue"] is not None]
        mean, worst = (round(of([row["residue"] for row in kept]), 2) for of in (statistics.fmean, max))
        spent = [row["cpu_ms"] for row in kept]
        cost = {"cpu_ms_median": statistics.median(spent), "cpu_ms_mean": round(statistics.fmean(spent), 1)}
        summary[arm] = {"scenes": len(kept), "mean": mean, "worst": worst, **cost}
        print(arm, summary[arm])
    if arguments.json is not None:
        arguments.json.write_text(json.dumps({"summary": summary, "rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
