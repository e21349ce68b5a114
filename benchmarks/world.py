"""Measures stage 3 and its answers against scenes with known truth.

    python benchmarks/world.py DIR [DIR ...] [--json FILE]

Each DIR holds one folder per scene with image.jpg and meta.json, as `examples/` does. A scene is asked by image and
question alone. Per scene: the answer against the truth, with its probability; path error (% of the image's width:
mean distance of the true centres, up to the first contact, to the path) and the same with the true path moved to
where the path begins (the middle of a box is not where the middle of a car or a candle is seen), size error (% of the
apparent size at the nearest point of the path, for what stands on a floor), push error (of what is pushed: distance
of its last centre to the true one, as a share of how far off it would be if it had stayed), and whether the path
shown agrees with the answer.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from cow_service.errors import CowError
from cow_service.records import Answer, Trajectory
from cow_service.requests import AnswerRequest
from cow_service.service import Service
from cow_service.settings import Settings

LINEAR = ("linear", "slide", "slide-occlude", "car")
PUSHED = 5.0  # px: what truly moves less is not pushed
TOUCHING = 1.15  # of the summed half extents: bodies of one path that come nearer than this are shown to touch

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Row:
    """What one scene gave; None if a figure does not apply."""

    scene: str
    form: str
    truth: str
    outcome: str  # right, wrong, not sure, or the code of an error
    probability: float | None = None
    path_error: float | None = None
    moved_path_error: float | None = None
    size_error: float | None = None
    push_error: float | None = None
    agrees: bool | None = None
    seconds: float | None = None
    story: str = ""


def measure(service: Service, folder: Path) -> Row | None:
    """Runs one scene as a caller would."""
    meta = json.loads((folder / "meta.json").read_text())
    form = meta.get("form") or meta["motion"]
    image = service.keep_image((folder / "image.jpg").read_bytes())
    body: dict[str, Any] = {"image": {"artifact": image.sha256}, "question": meta["question"]}
    try:
        answer = service.answer(AnswerRequest.model_validate(body))
    except CowError as error:
        return Row(folder.name, form, meta["answer"], error.code)
    if answer.simulation is None:
        problem = answer.simulation_problem
        return Row(folder.name, form, meta["answer"], "failed" if problem is None else problem.code)
    return _row(folder, form, meta, answer, answer.simulation.trajectory)


def _row(folder: Path, form: str, meta: dict[str, Any], answer: Answer, trajectory: Trajectory) -> Row:
    said = "not sure" if answer.not_sure else "right" if answer.answer == meta["answer"] else "wrong"
    told = trajectory.outcome
    happens = None if answer.not_sure else answer.option is not None and answer.option.lower().startswith("yes")
    simulation = answer.simulation
    return Row(
        scene=folder.name,
        form=form,
        truth=meta["answer"],
        outcome=said,
        probability=None if told is None else told.probability,
        path_error=_path_error(trajectory, meta),
        moved_path_error=_path_error(trajectory, meta, moved=True),
        size_error=_size_error(trajectory, meta) if meta["motion"] == "linear" and form != "table" else None,
        push_error=_push_error(trajectory, meta),
        agrees=None if happens is None else _happens(trajectory, meta) == happens,
        seconds=None if simulation is None else simulation.timings.get("trajectory"),
        story="" if simulation is None else simulation.narration.story,
    )


def _happens(trajectory: Trajectory, meta: dict[str, Any]) -> bool:
    """Whether the event in question happens in the world shown."""
    if trajectory.placement is not None:
        return trajectory.placement.result == "inside"
    return _shown(trajectory, meta)


def _until_contact(meta: dict[str, Any]) -> int:
    return int(min(meta["hits"].values(), default=len(meta["track"]) - 1))


def _fine(points: tuple[tuple[float, float], ...]) -> Floats:
    path = np.array(points)
    stamps = np.linspace(0, len(path) - 1, 4000)
    return np.stack([np.interp(stamps, np.arange(len(path)), path[:, axis]) for axis in (0, 1)], axis=1)


def _path_error(trajectory: Trajectory, meta: dict[str, Any], moved: bool = False) -> float:
    true = np.array(meta["track"][: _until_contact(meta) + 1])
    true = true + moved * (np.array(trajectory.path.points[0]) - true[0])
    gaps = np.linalg.norm(true[:, None] - _fine(trajectory.path.points)[None], axis=2).min(axis=1)
    return float(100 * gaps.mean() / meta["image_size"][0])


def _size_error(trajectory: Trajectory, meta: dict[str, Any]) -> float:
    """Mean difference of the apparent size, by the widths and heights of the true boxes while they are inside."""
    width, height = meta["image_size"]
    boxes = np.array(meta["boxes"][meta["object"]][: _until_contact(meta) + 1])
    inside = (boxes[:, 0] > 1) & (boxes[:, 1] > 1) & (boxes[:, 2] < width - 1) & (boxes[:, 3] < height - 1)
    true = np.array(meta["track"][: len(boxes)])
    size = np.sqrt((boxes[:, 2] - boxes[:, 0]) * (boxes[:, 3] - boxes[:, 1]))
    near = np.linalg.norm(true[:, None] - np.array(trajectory.path.points)[None], axis=2).argmin(axis=1)
    seen = np.array(trajectory.path.scale)[near]
    return float(100 * np.abs(seen / (size / size[0]) - 1)[inside].mean())


def _push_error(trajectory: Trajectory, meta: dict[str, Any]) -> float | None:
    """Of bodies that were truly pushed: distance of the shown end to the true one, of that of the start."""
    ratios: list[float] = []
    for name, boxes in meta["boxes"].items():
        centres = np.array([[(b[0] + b[2]) / 2, (b[1] + b[3]) / 2] for b in boxes])
        moved = float(np.linalg.norm(centres[-1] - centres[0]))
        body = _body_at(trajectory, boxes[0])
        if name == meta["object"] or moved < PUSHED or body is None:
            continue
        path = next((path for path in trajectory.paths if path.body == body), None)
        shift = np.zeros(2) if path is None else np.array(path.points[-1]) - np.array(path.points[0])
        ratios.append(float(np.linalg.norm(centres[-1] - centres[0] - shift)) / moved)
    return statistics.mean(ratios) if ratios else None


def _body_at(trajectory: Trajectory, box: list[float]) -> int | None:
    middle = np.array([(box[0] + box[2]) / 2, (box[1] + box[3]) / 2])
    gaps = [
        float(np.linalg.norm(middle - [(b.bbox[0] + b.bbox[2]) / 2, (b.bbox[1] + b.bbox[3]) / 2]))
        for b in trajectory.bodies
    ]
    best = int(np.argmin(gaps))
    return best if best and gaps[best] < 0.3 * (box[2] - box[0] + box[3] - box[1]) else None


def _shown(trajectory: Trajectory, meta: dict[str, Any]) -> bool:
    """Whether the event in question can be seen on the paths: by places and sizes, or by the share that is covered."""
    told = trajectory.outcome
    body = _body_at(trajectory, meta["boxes"][meta["target"]][0])
    if body is None or told is None:
        return False
    if told.asked.relation != "touches":
        kind = "occludes" if told.asked.relation == "covers" else "occluded-by"
        return any(met.body == body and met.kind == kind for met in trajectory.encounters)
    mover, other = trajectory.bodies[0], trajectory.bodies[body]
    mine = np.array(trajectory.path.states)[:, :3]
    path = next((path for path in trajectory.paths if path.body == body), None)
    theirs = np.array(other.position)[None] if path is None else np.array(path.states)[:, :3]
    gap = np.abs(np.linalg.norm(mine - theirs, axis=1))
    reach = max(mover.size) / 2 + np.hypot(max(other.size[0], other.size[2]), other.size[1]) / 2
    return bool((gap < TOUCHING * reach).any()) and any(
        contact.a == 0 and contact.b == body for contact in trajectory.contacts
    )


def show(rows: list[Row]) -> dict[str, Any]:
    """Prints the table and returns its summary."""
    table = Table(box=None, pad_edge=False)
    for name in ("scene", "form", "truth", "outcome", "p", "path %", "size %", "push", "agrees", "s"):
        table.add_column(name, no_wrap=True)
    for row in rows:
        numbers = (row.probability, row.path_error, row.size_error, row.push_error)
        agrees = "-" if row.agrees is None else "yes" if row.agrees else "NO"
        table.add_row(
            row.scene, row.form, row.truth, row.outcome, *(_text(n) for n in numbers), agrees, _text(row.seconds)
        )
    Console(width=140).print(table)
    summary = summarise(rows)
    for name, value in summary.items():
        print(f"{name}: {value}")
    return summary


def summarise(rows: list[Row]) -> dict[str, Any]:
    """Means, worst cases and counts over all scenes."""
    given = [row for row in rows if row.outcome in ("right", "wrong")]
    told = [(row.probability, row.truth == "A") for row in rows if row.probability is not None]
    certain = [r for r in given if r.probability is not None and not 0.1 <= r.probability <= 0.9]
    throws = [row for row in rows if row.form in ("projectile", "throw", "table")]
    return {
        "scenes": len(rows),
        "answers given": f"{len(given)} of {len(rows)}",
        "right where given": f"{sum(row.outcome == 'right' for row in given)} of {len(given)}",
        "wrong with a probability over 0.9": sum(row.outcome == "wrong" for row in certain),
        "Brier score": round(statistics.mean((p - truth) ** 2 for p, truth in told), 4) if told else None,
        "path error, throws parallel to the image": _spread(rows, "path_error", ("projectile",)),
        "path error, all throws and falls from tables": _spread(throws, "path_error", None),
        "path error, linear": _spread(rows, "path_error", LINEAR),
        "path error, linear, from the same first point": _spread(rows, "moved_path_error", LINEAR),
        "size error, linear": _spread(rows, "size_error", None),
        "push error": _spread(rows, "push_error", None),
        "shown against the answer": sum(row.agrees is False for row in rows),
        "stage 3, median (s)": _median([row.seconds for row in rows if row.seconds is not None]),
    }


def _spread(rows: list[Row], name: str, forms: tuple[str, ...] | None) -> str:
    values = [
        getattr(row, name) for row in rows if (forms is None or row.form in forms) and getattr(row, name) is not None
    ]
    return f"mean {statistics.mean(values):.2f}, most {max(values):.2f} ({len(values)})" if values else "-"


def _median(values: list[float]) -> float | None:
    return round(statistics.median(values), 3) if values else None


def _text(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("folders", type=Path, nargs="+")
    parser.add_argument("--json", type=Path, default=None, help="write rows and summary here")
    arguments = parser.parse_args()
    scenes = sorted(path.parent for folder in arguments.folders for path in folder.glob("*/meta.json"))
    if not scenes:
        print("No scenes found: folders with image.jpg and meta.json are needed.", file=sys.stderr)
        return 2
    with tempfile.TemporaryDirectory() as data, Service(Settings(data_dir=Path(data), reader="embedded")) as service:
        rows = [row for row in (measure(service, scene) for scene in scenes) if row is not None]
    summary = show(rows)
    if arguments.json is not None:
        arguments.json.write_text(
            json.dumps({"summary": summary, "scenes": [asdict(r) for r in rows]}, indent=2) + "\n"
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
