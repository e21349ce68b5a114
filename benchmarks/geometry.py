"""Measures what true masks and depth bring: answers, camera and places of bodies, by the errors that depth has.

    python benchmarks/geometry.py DIR ... [--limit N] [--motorcycle] [--json FILE]

Each DIR holds one folder per scene of `cow-scenes`, or of another source with ids.png, depth and a camera in meta.json
(see stand_ins.py). Each scene is asked by image and question alone, with true masks, and with masks and a depth map
whose errors are smooth, of 0, 3, 5 and 8%, with a focal length that is off by up to 10%; then by image and question of
a server that sees with stand-ins for models, whose detector misses things and finds others. Right, wrong and not sure
are counted, wrong ones that are told with more than 0.8 apart; then the error of the camera's pitch (degrees), and that
of where bodies stand (of their distance, in the likeliest world; where the scene tells where they stand).
"""

from __future__ import annotations

import argparse
import base64
import json
import statistics
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rich.console import Console
from rich.table import Table
from stand_ins import TrueModels, TrueScene, read_truth, with_errors

from cow_service.errors import CowError
from cow_service.media.images import encode_png
from cow_service.media.types import Floats32
from cow_service.perception.base import Perception
from cow_service.requests import AnswerRequest
from cow_service.service import Service
from cow_service.settings import Settings

ARMS: dict[str, dict[str, Any] | None] = {
    "picture alone": None,
    "masks": {},
    "masks, depth 0%": {"level": 0.0},
    "masks, depth 3%": {"level": 0.03},
    "masks, depth 5%, focal -10%": {"level": 0.05, "focal_factor": 0.9},
    "masks, depth 8%, focal +5%": {"level": 0.08, "focal_factor": 1.05},
}
SEEN: dict[str, dict[str, Any]] = {  # the picture alone, which the server sees with models
    "models see": {},
    "models see, 10% missed, 10% false": {"missed": 0.1, "false": 0.1},
    "models see, 10% missed, 10% false, depth 3%": {"missed": 0.1, "false": 0.1, "depth_level": 0.03},
}
LEAST_DEVIATION = 0.01  # what a caller would say of a map that is nearly true
SURE = 0.8  # a wrong answer told with more is the worst
UNITS = 0.00025  # m


def data_url(png: bytes) -> str:
    """As a request takes a picture."""
    return f"data:image/png;base64,{base64.b64encode(png).decode()}"


def depth_field(depth: Floats32, focal: float, deviation: float) -> dict[str, Any]:
    """The `depth` of a request, by metres [H, W] (nan: not known) and a focal length (px)."""
    units = np.clip(np.nan_to_num(depth / UNITS), 0, 65535).round().astype(np.uint16)
    encoded, png = cv2.imencode(".png", units)
    assert encoded
    return {"map": data_url(png.tobytes()), "scale": UNITS, "focal": focal, "deviation": deviation}


def request_of(meta: dict[str, Any], truth: TrueScene, folder: Path, arm: dict[str, Any] | None, seed: int) -> Any:
    """The body of a request as one arm has it."""
    image = base64.b64encode((folder / "image.jpg").read_bytes()).decode()
    body: dict[str, Any] = {
        "image": f"data:image/jpeg;base64,{image}", "question": meta["question"], "video": False,
    }  # fmt: skip
    if arm is None:
        return body
    mover = truth.thing(meta["object"])
    body["grounding"] = {"mask": data_url(encode_png(mover.mask)), "object": mover.name}
    others = [each for each in truth.things if each is not mover and np.count_nonzero(each.mask) > 20]
    body["objects"] = [{"object": each.name, "mask": data_url(encode_png(each.mask))} for each in others]
    if arm:
        depth, focal = with_errors(truth.depth, truth.camera.focal, seed=seed, **arm)
        body["depth"] = depth_field(depth, focal, max(LEAST_DEVIATION, arm["level"]))
    return body


def place_errors(meta: dict[str, Any], bodies: Any) -> list[float]:
    """How far off bodies are over the floor, of their distance, where the scene says where they stand."""
    if "world" not in meta or "world_from_camera" not in meta["camera"]:
        return []
    pose = np.array(meta["camera"]["world_from_camera"])
    right, ahead = pose[:3, 0], pose[:3, 2] * np.array([1.0, 1.0, 0.0])
    found: list[float] = []
    for body in bodies:
        if body.object in meta["world"] and body.footprint is not None:
            away = np.array(meta["world"][body.object][0]) - pose[:3, 3]
            there = np.array([away @ right, away @ ahead / np.linalg.norm(ahead)])
            found.append(float(np.linalg.norm(np.array(body.footprint.centre) - there) / np.linalg.norm(there)))
    return found


def measure(
    service: Service, folders: list[Path], name: str, first: int
) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """A row per scene of one arm, and its summary."""
    rows: list[dict[str, Any]] = []
    for seed, folder in enumerate(folders, start=first):
        meta, truth = json.loads((folder / "meta.json").read_text()), read_truth(folder)
        body = request_of(meta, truth, folder, ARMS.get(name), seed)
        service.perception = TrueModels(truth, seed=seed, **SEEN[name]) if name in SEEN else Perception(Settings())
        started = time.process_time()
        row: dict[str, Any] = {"scene": folder.name, "arm": name, "truth": meta["answer"]}
        try:
            answer = service.answer(AnswerRequest.model_validate(body))
        except CowError as error:
            rows.append(row | {"outcome": "not sure", "why": str(error)[:160]})
            continue
        trajectory = None if answer.simulation is None else answer.simulation.trajectory
        row["outcome"] = "not sure" if answer.not_sure else "right" if answer.answer == meta["answer"] else "wrong"
        row["cpu_ms"] = round(1000 * (time.process_time() - started), 1)
        if trajectory is not None and trajectory.camera is not None:
            told = trajectory.outcome
            row["probability"] = None if told is None else told.probability
            row["asked"] = None if told is None else told.asked.form
            row["depends_on"] = [] if told is None else list(told.depends_on)
            row["pitch_error"] = abs(trajectory.camera.pitch - (truth.camera.pitch or 0.0))
            row["source"] = trajectory.camera.source
            row["place_errors"] = place_errors(meta, trajectory.bodies)
        rows.append(row)
    told = [
        (row["probability"], row["truth"] == "A")
        for row in rows
        if row.get("probability") is not None and row["asked"] == "whether"
    ]
    pitches = [row["pitch_error"] for row in rows if "pitch_error" in row]
    places = [each for row in rows for each in row.get("place_errors", ())]
    sure = [row for row in rows if row["outcome"] == "wrong" and not 1 - SURE < (row.get("probability") or 0.0) < SURE]
    summary: dict[str, Any] = {
        outcome: sum(row["outcome"] == outcome for row in rows) for outcome in ("right", "wrong", "not sure")
    }
    summary |= {
        "sure and wrong": len(sure),
        "brier": round(statistics.fmean((p - is_so) ** 2 for p, is_so in told), 3) if told else None,
        "pitch_mean": round(statistics.fmean(pitches), 2) if pitches else None,
        "pitch_p90": round(float(np.percentile(pitches, 90)), 2) if pitches else None,
        "place_median": round(statistics.median(places), 3) if places else None,
        "cpu_ms": round(statistics.median(row.get("cpu_ms", 0.0) for row in rows), 1),
    }
    return rows, summary


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("folders", type=Path, nargs="*")
    parser.add_argument("--limit", type=int, default=None, help="scenes of each folder")
    parser.add_argument("--arm", action="append", choices=[*ARMS, *SEEN], help="only these; may be given several times")
    parser.add_argument("--seed", type=int, default=0, help="of the errors in the first scene")
    parser.add_argument("--motorcycle", action="store_true", help="the photograph of scikit-image, too")
    parser.add_argument("--json", type=Path, default=None, help="write rows and summaries here")
    arguments = parser.parse_args()
    table, results = Table("scenes", "arm"), list[dict[str, Any]]()
    with tempfile.TemporaryDirectory() as data, Service(Settings(data_dir=Path(data))) as service:
        for each in arguments.folders:
            folders = sorted(path.parent for path in each.rglob("meta.json"))[: arguments.limit]
            for name in arguments.arm or (*ARMS, *SEEN):
                rows, summary = measure(service, folders, name, arguments.seed)
                results.append({"scenes": each.name, "arm": name, "summary": summary, "rows": rows})
                if len(table.columns) == 2:
                    for column in summary:
                        table.add_column(column)
                table.add_row(each.name, name, *(str(value) for value in summary.values()))
    Console(width=200).print(table)
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(results, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
