"""Measures the default backends against scenes with known truth.

    python benchmarks/scenes.py DIR [--json FILE]

DIR holds one folder per scene with image.jpg, clean.jpg, ids.png and meta.json, as `examples/` does. Per scene: box
IoU, direction error (degrees), path error (% of the image's width: mean distance of the true centres, up to the first
contact, to the computed path), centre error (px: where the mover is found in rendered frames against its trajectory),
background error (grey levels: the largest difference to the input away from mover, hole and drawing), arrow error (grey
levels: mean difference to clean.jpg where the arrow stood), mask IoU of the mover, residue (grey levels: mean
difference of the background that frames are composed on to the true one, background.jpg where a scene has it, where
the mover and its shadow were and in a ring around), and whether the encounters give the true answer.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import tempfile
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from cow_service.errors import CowError
from cow_service.generators.base import GeneratorInput
from cow_service.generators.cutout import generator as cutout
from cow_service.generators.cutout.layers import Layers, take_apart
from cow_service.media.masks import iou
from cow_service.perception.observation import Observation, look
from cow_service.records import BBox, Simulation
from cow_service.requests import SimulateRequest
from cow_service.service import Service
from cow_service.settings import Settings

DRAWN = 40  # grey levels between image and clean image where something was drawn
SHADED = 8  # grey levels between the clean image and the true background where the mover's shadow is
AWAY = 15  # px around the true mover, its hole and the drawing that may differ
LOST = 900  # squared grey levels: the best match is no match
INDICES = (0, 2, 4, 8, 12, 16, 24, 32, 40, 60, 80)

Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Row:
    """What one scene gave; None if a figure does not apply."""

    scene: str
    task: str
    outcome: str
    iou: float | None = None
    direction_error: float | None = None
    path_error: float | None = None
    centre_error: float | None = None
    background_error: float | None = None
    arrow_error: float | None = None
    mask_iou: float | None = None
    residue: float | None = None
    encounter: str | None = None
    truth: str | None = None
    agrees: bool | None = None
    seconds: float | None = None


class Composed:
    """Keeps what the compositor composes its frames of."""

    def __init__(self) -> None:
        self.given: GeneratorInput
        self.last: Layers | None = None
        cutout.take_apart = self.take_apart

    def take_apart(self, given: GeneratorInput, progress: Callable[[float], None]) -> Layers:
        """As the compositor's own."""
        self.given, self.last = given, take_apart(given, progress)
        return self.last


def residue(composed: Layers, folder: Path, mover: Mask, others: Mask) -> float | None:
    """Mean difference (grey levels) to the true background where mover and shadow were, and around; None without one.

    `mover` and `others` [H, W] are true masks; what the other things hide or may have moved to is left out.
    """
    if not (folder / "background.jpg").exists() or composed.background.shape[:2] != mover.shape:
        return None
    truth, clean = (pixels_of((folder / name).read_bytes()).astype(int) for name in ("background.jpg", "clean.jpg"))
    shadow = np.asarray(np.abs(clean - truth).max(axis=2) > SHADED)
    ring = np.asarray(cv2.dilate(mover.astype(np.uint8), np.ones((2 * AWAY + 1, 2 * AWAY + 1), np.uint8)) > 0)
    there = (ring | shadow) & ~(others & ~mover)
    for body in composed.moving[1:]:  # what is drawn over the background, too
        there &= ~body.mask
    return float(np.abs(composed.background.astype(int) - truth)[there].mean())


def measure(service: Service, folder: Path, composed: Composed) -> Row:
    """Runs one scene by image and question alone, as a caller would, and holds the result against the truth."""
    meta = json.loads((folder / "meta.json").read_text())
    image = service.keep_image((folder / "image.jpg").read_bytes())
    body: dict[str, Any] = {
        "image": {"artifact": image.sha256},
        "question": meta["question"],
        "frames": {"indices": INDICES, "max_side": None},
    }
    composed.last = None
    try:
        simulation = service.simulate(SimulateRequest.model_validate(body))
    except CowError as error:
        return Row(folder.name, meta["task"], error.code, truth=meta["answer"])
    return _row(service, folder, meta, simulation, composed)


def _row(service: Service, folder: Path, meta: dict[str, Any], simulation: Simulation, composed: Composed) -> Row:
    pixels, clean = (pixels_of((folder / name).read_bytes()) for name in ("image.jpg", "clean.jpg"))
    frames = [pixels_of(service.artifacts.read(frame.sha256)) for frame in simulation.frames]
    ids = cv2.imread(str(folder / "ids.png"), cv2.IMREAD_UNCHANGED)
    truth = np.asarray(ids == meta["id_of"][meta["object"]])
    layers = composed.last
    seen = None if layers is None or layers.moving[0].mask.shape != truth.shape else layers.moving[0].mask
    others = [tuple(boxes[0]) for name, boxes in meta["boxes"].items() if name != meta["object"]]
    centre, background, arrow = _frame_errors(
        simulation, frames, look(np.ascontiguousarray(pixels)), clean, truth, others
    )
    kinds = [
        encounter.kind
        for encounter in simulation.trajectory.encounters
        if iou(encounter.bbox, tuple(meta["boxes"][meta["target"]][0])) > 0.4
    ]
    occlusion = "occluded" in meta["question"]
    yes = bool(kinds) and (any(kind != "occluded-by" for kind in kinds) if occlusion else "touches" in kinds)
    direction = simulation.motion.direction
    return Row(
        scene=folder.name,
        task=meta["task"],
        outcome="ok",
        iou=iou(simulation.grounding.bbox, tuple(meta["bbox"])),
        direction_error=None if direction is None else _angle(direction, meta["direction"]),
        path_error=_path_error(simulation, meta),
        centre_error=centre,
        background_error=background,
        arrow_error=arrow,
        mask_iou=None if seen is None else float((seen & truth).sum() / (seen | truth).sum()),
        residue=None if layers is None else residue(layers, folder, truth, np.asarray(ids) > 0),
        encounter=", ".join(kinds) or "-",
        truth=meta["answer"],
        agrees=yes == (meta["answer"] == "A"),
        seconds=sum(simulation.timings.values()),
    )


def pixels_of(encoded: bytes) -> NDArray[np.uint8]:
    """RGB [h, w, 3] of an encoded image."""
    pixels = cv2.imdecode(np.frombuffer(encoded, np.uint8), cv2.IMREAD_COLOR)
    if pixels is None:
        raise ValueError("not an image that OpenCV reads")
    return np.asarray(pixels[..., ::-1], np.uint8)


def _frame_errors(
    simulation: Simulation,
    frames: list[NDArray[np.uint8]],
    scene: Observation,
    clean: NDArray[np.uint8],
    truth: Mask,
    others: list[BBox],
) -> tuple[float | None, float, float | None]:
    """Largest centre error (px), background error and arrow error (grey levels) over the frames.

    `truth` [H, W] is the true mask of the mover, `others` the boxes of the other objects: where the mover meets one it
    may be hidden, and is not looked for. What was drawn is where the image differs from the clean one.
    """
    start = np.array(simulation.grounding.point)
    drawn = np.abs(scene.image.astype(int) - clean).max(axis=2) > DRAWN
    kernel = np.ones((2 * AWAY + 1, 2 * AWAY + 1), np.uint8)
    still = np.asarray(cv2.dilate((truth | drawn).astype(np.uint8), kernel), np.uint8)
    centres: list[float] = []
    backgrounds: list[float] = []
    arrows: list[float] = []
    for frame, pixels in zip(simulation.frames, frames, strict=True):
        shift = np.array(simulation.trajectory.path.points[frame.index]) - start
        move = np.array([[1, 0, shift[0]], [0, 1, shift[1]]], np.float64)
        here = np.asarray(cv2.warpAffine(truth.astype(np.uint8), move, (truth.shape[1], truth.shape[0])), np.uint8)
        changed = np.asarray(cv2.dilate(here, kernel), np.uint8) | still
        backgrounds.append(float(np.abs(pixels.astype(int) - scene.image)[changed == 0].max(initial=0)))
        hole = here | truth.astype(np.uint8)
        free = drawn & (cv2.dilate(hole, np.ones((11, 11), np.uint8)) == 0) if frame.index else drawn
        if free.sum() > 0.5 * drawn.sum() > 0:
            arrows.append(float(np.abs(pixels.astype(int) - clean)[free].mean()))
        beside = _shifted(simulation.grounding.bbox, shift)
        if simulation.trajectory.path.visible[frame.index] and not any(_meet(beside, other) for other in others):
            found = _locate(scene, truth, pixels, shift)
            if found is not None:
                centres.append(found)
    return max(centres, default=None), max(backgrounds), max(arrows, default=None)


def _shifted(bbox: BBox, shift: NDArray[np.float64]) -> BBox:
    dx, dy = float(shift[0]), float(shift[1])
    return bbox[0] + dx, bbox[1] + dy, bbox[2] + dx, bbox[3] + dy


def _meet(a: BBox, b: BBox) -> bool:
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]


def _locate(scene: Observation, mover: Mask, pixels: NDArray[np.uint8], shift: NDArray[np.float64]) -> float | None:
    """Distance (px) from where the mover should be to where it is best found in a frame; None next to the border.

    A mover that is not found at all counts as far off.
    """
    rows, columns = np.nonzero(mover.any(axis=1))[0], np.nonzero(mover.any(axis=0))[0]
    window = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
    template, mask = scene.clean[window], np.repeat(mover[window][..., None], 3, axis=2).astype(np.float32)
    reach = 8
    x, y = round(columns[0] + shift[0]) - reach, round(rows[0] + shift[1]) - reach
    height, width = template.shape[:2]
    if x < 0 or y < 0 or x + width + 2 * reach > pixels.shape[1] or y + height + 2 * reach > pixels.shape[0]:
        return None
    search = pixels[y : y + height + 2 * reach, x : x + width + 2 * reach]
    error = cv2.matchTemplate(np.ascontiguousarray(search), template, cv2.TM_SQDIFF, mask=mask) / mask.sum()
    best = np.unravel_index(int(error.argmin()), error.shape)
    if error[best] > LOST:
        return float(reach)
    offset = np.array([best[1], best[0]]) - reach - (shift - np.round(shift))
    return float(np.hypot(*offset))


def _path_error(simulation: Simulation, meta: dict[str, Any]) -> float:
    last = min(meta["hits"].values(), default=len(meta["track"]) - 1)
    true = np.array(meta["track"][: last + 1])
    path = np.array(simulation.trajectory.path.points)
    fine = np.stack(
        [np.interp(np.linspace(0, len(path) - 1, 4000), np.arange(len(path)), path[:, i]) for i in (0, 1)], 1
    )
    gaps = np.linalg.norm(true[:, None] - fine[None], axis=2).min(axis=1)
    return float(100 * gaps.mean() / simulation.image.width)


def _angle(a: tuple[float, float], b: list[float]) -> float:
    return float(abs(np.degrees(np.arctan2(a[0] * b[1] - a[1] * b[0], a[0] * b[0] + a[1] * b[1]))))


def show(rows: list[Row]) -> dict[str, Any]:
    """Prints the table and returns its summary."""
    table = Table(box=None, pad_edge=False)
    columns = (
        "scene",
        "task",
        "outcome",
        "IoU",
        "dir °",
        "path %",
        "centre px",
        "bg",
        "arrow",
        "mask",
        "residue",
        "encounters",
        "truth",
        "s",
    )
    for name in columns:
        table.add_column(name, no_wrap=True)
    for row in rows:
        numbers = [_text(v) for v in (row.iou, row.direction_error, row.path_error, row.centre_error)]
        errors = [_text(v, 1) for v in (row.background_error, row.arrow_error)]
        errors += [_text(row.mask_iou), _text(row.residue, 1)]
        verdict = "" if row.agrees is None else (" ✓" if row.agrees else " ✗")
        table.add_row(
            row.scene,
            row.task,
            row.outcome,
            *numbers,
            *errors,
            (row.encounter or "-") + verdict,
            row.truth,
            _text(row.seconds),
        )
    Console(width=150).print(table)
    summary = summarise(rows)
    for name, value in summary.items():
        print(f"{name}: {value}")
    return summary


def summarise(rows: list[Row]) -> dict[str, Any]:
    """Medians, worst cases and shares over all scenes."""
    ious = [row.iou for row in rows if row.iou is not None]
    read = [row.direction_error for row in rows if row.direction_error is not None and row.outcome == "ok"]
    judged = [row.agrees for row in rows if row.agrees is not None and row.task in ("collision", "occlusion")]
    judged_all = [row.agrees for row in rows if row.agrees is not None]
    return {
        "scenes": len(rows),
        "refused": sum(row.outcome not in ("ok", "not refused") for row in rows),
        "box IoU, least": round(min(ious, default=0.0), 3),
        "box IoU, median": round(statistics.median(ious), 3) if ious else None,
        "direction error, median (degrees)": round(statistics.median(read), 2) if read else None,
        "direction error, worst (degrees)": round(max(read), 2) if read else None,
        "centre error, worst (px)": _worst(rows, "centre_error"),
        "background error, worst (grey levels)": _worst(rows, "background_error"),
        "arrow error, worst (grey levels)": _worst(rows, "arrow_error"),
        "mover mask IoU, mean and least": _mean_and(rows, "mask_iou", min),
        "residue, mean and worst (grey levels)": _mean_and(rows, "residue", max),
        "path error, median (% of width)": round(
            statistics.median(r.path_error for r in rows if r.path_error is not None), 2
        ),
        "encounters agree, collision and occlusion": f"{sum(judged)} of {len(judged)}",
        "encounters agree, all tasks": f"{sum(judged_all)} of {len(judged_all)}",
    }


def _worst(rows: list[Row], name: str) -> float | None:
    values = [getattr(row, name) for row in rows if getattr(row, name) is not None]
    return round(max(values), 2) if values else None


def _mean_and(rows: list[Row], name: str, worst: Callable[[list[float]], float]) -> list[float] | None:
    values = [getattr(row, name) for row in rows if getattr(row, name) is not None]
    return [round(statistics.mean(values), 3), round(worst(values), 3)] if values else None


def _text(value: float | None, digits: int = 2) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--json", type=Path, default=None, help="write rows and summary here")
    arguments = parser.parse_args()
    folders = sorted(path.parent for path in arguments.folder.glob("*/meta.json"))
    if not folders:
        print(
            f"No scenes in {arguments.folder}: it needs folders with image.jpg, clean.jpg, ids.png and meta.json.",
            file=sys.stderr,
        )
        return 2
    with tempfile.TemporaryDirectory() as data:
        service = Service(Settings(data_dir=Path(data)))
        composed = Composed()
        rows = [measure(service, folder, composed) for folder in folders]
    summary = show(rows)
    if arguments.json is not None:
        arguments.json.write_text(
            json.dumps({"summary": summary, "scenes": [asdict(row) for row in rows]}, indent=2) + "\n"
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
