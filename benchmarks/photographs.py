"""Asks what-if questions of photographs, with boxes drawn by hand: are there verdicts, and is one sure and wrong?

    python benchmarks/photographs.py [DIR ...] [--json FILE]

The pictures come from scikit-image, where it is installed, and from DIRs; questions of pictures that are found nowhere
are skipped. A verdict is a probability of what is asked, sure or not. `truth` is what a person sees, and what the
measured depth of the motorcycle says; None where nobody can tell. Sure and wrong is a wrong answer with more than 0.8.
"""

from __future__ import annotations

import argparse
import base64
import importlib.util
import json
import sys
import tempfile
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from cow_service.errors import CowError
from cow_service.records import BBox
from cow_service.requests import SimulateRequest
from cow_service.service import Service
from cow_service.settings import Settings

SURE = 0.8

BOXES: dict[str, dict[str, BBox]] = {
    "motorcycle_left.png": {
        "motorcycle": (92, 45, 685, 452), "shelf": (341, 0, 720, 292), "bench": (40, 103, 284, 309),
        "yellow bottle": (399, 51, 420, 93), "red bin": (522, 181, 618, 253), "blue can": (453, 68, 474, 88),
    },
    "coffee.png": {"cup": (172, 18, 410, 309), "saucer": (77, 66, 480, 388), "spoon": (326, 66, 425, 327)},
    "astronaut.png": {
        "astronaut": (20, 15, 362, 512), "helmet": (277, 344, 512, 512), "space shuttle": (355, 0, 473, 290),
    },
    "camera.png": {"man": (0, 63, 332, 512), "tripod": (229, 186, 408, 512), "tower": (411, 117, 433, 194)},
    "rocket.jpg": {"rocket": (305, 126, 340, 406), "tower": (437, 123, 478, 420)},
    "coins.png": {"top left coin": (22, 33, 68, 75), "large coin": (315, 155, 380, 219)},
    "bear.jpg": {"bear": (228, 115, 927, 532), "rock": (963, 190, 1280, 784)},
}  # fmt: skip


# What is asked; what moves, then the others that are given; the truth.
QUESTIONS: dict[str, tuple[tuple[str, str, bool | None], ...]] = {
    "motorcycle_left.png": (
        ("If the motorcycle slides to the right, will it hit the shelf?", "motorcycle, shelf, bench", False),
        ("If the motorcycle slides to the left, will it hit the bench?", "motorcycle, bench, shelf", False),
        ("If the bench is pushed towards the motorcycle, will it hit it?", "bench, motorcycle, shelf", True),
        ("If the bench slides to the right, will it hit the motorcycle?", "bench, motorcycle", False),
        ("If the yellow bottle falls, will it land on the motorcycle?", "yellow bottle, motorcycle, shelf", False),
        ("If the blue can slides to the left, will it hit the yellow bottle?", "blue can, yellow bottle, shelf", True),
        ("If the red bin slides to the left, will it hit the motorcycle?", "red bin, motorcycle, shelf", False),
    ),
    "coffee.png": (
        ("If the cup slides to the left, will it fall off the saucer?", "cup, saucer, spoon", True),
        ("If the cup slides to the right, will it hit the spoon?", "cup, saucer, spoon", True),
        ("If the spoon slides to the right, will it hit the cup?", "spoon, cup, saucer", False),
    ),
    "astronaut.png": (
        ("If the space shuttle falls, will it land on the helmet?", "space shuttle, helmet, astronaut", False),
        ("If the space shuttle slides to the left, will it hit the astronaut?", "space shuttle, astronaut", False),
    ),
    "camera.png": (
        ("If the man walks to the right, will he hit the tower?", "man, tower, tripod", False),
        ("If the man walks to the right, will he hit the tripod?", "man, tripod", True),
    ),
    "rocket.jpg": (("If the rocket falls over to the right, will it hit the tower?", "rocket, tower", None),),
    "coins.png": (
        ("If the top left coin slides to the right, will it hit the large coin?", "top left coin, large coin", False),
    ),
    "bear.jpg": (("If the bear walks to the right, will it hit the rock?", "bear, rock", None),),
}  # fmt: skip


def find_pictures(folders: list[Path]) -> dict[str, Path]:
    """Files of the pictures by name, in folders and in the data of scikit-image."""
    spec = importlib.util.find_spec("skimage")
    if spec is not None and spec.origin is not None:
        folders = [*folders, Path(spec.origin).parent / "data"]
    return {name: folder / name for folder in reversed(folders) for name in BOXES if (folder / name).is_file()}


def ask(service: Service, picture: Path, question: str, names: str, truth: bool | None) -> dict[str, Any]:
    """The verdict on a question, and the camera that it was seen with."""
    mime = "jpeg" if picture.suffix == ".jpg" else "png"
    boxes = [{"object": name, "bbox": BOXES[picture.name][name]} for name in names.split(", ")]
    body = {
        "image": f"data:image/{mime};base64,{base64.b64encode(picture.read_bytes()).decode()}",
        "question": question, "video": False, "grounding": boxes[0], "objects": boxes[1:],
    }  # fmt: skip
    row: dict[str, Any] = {
        "picture": picture.name,
        "question": question,
        "truth": truth,
        "probability": None,
        "sure": False,
    }
    try:
        result = service.simulate(SimulateRequest.model_validate(body))
    except CowError as error:
        return row | {"warnings": [str(error)]}
    trajectory, camera = result.trajectory, result.trajectory.camera
    row["warnings"] = result.warnings
    if camera is not None:
        row |= {"pitch": camera.pitch, "pitch_deviation": camera.deviations.pitch, "source": camera.source}
    if trajectory.outcome is not None:
        told = trajectory.outcome
        row |= {"probability": told.probability, "sure": told.sure, "depends_on": list(told.depends_on)}
    return row


def is_sure_and_wrong(row: dict[str, Any]) -> bool:
    """Whether a row's probability is far from the truth."""
    if row["probability"] is None or row["truth"] is None:
        return False
    return row["probability"] < 1 - SURE if row["truth"] else row["probability"] > SURE


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("folders", type=Path, nargs="*")
    parser.add_argument("--json", type=Path, default=None, help="write rows here")
    arguments = parser.parse_args()
    pictures = find_pictures(arguments.folders)
    with tempfile.TemporaryDirectory() as data, Service(Settings(data_dir=Path(data))) as service:
        rows = [ask(service, pictures[name], *each) for name in pictures for each in QUESTIONS[name]]
    table = Table("picture", "question", "truth", "p", "sure", "depends on", "camera")
    for row in rows:
        camera = f"{row['pitch']:.0f} ± {row['pitch_deviation']:.0f} {row['source']}" if "pitch" in row else ""
        probability = "" if row["probability"] is None else f"{row['probability']:.2f}"
        if is_sure_and_wrong(row):
            probability += " wrong"
        told = str(row["truth"]), probability, str(row["sure"]), " ".join(row.get("depends_on", ())), camera
        table.add_row(row["picture"], row["question"], *told)
    console = Console(width=200)
    console.print(table)
    for row in rows:
        console.print(row["question"], *(f"\n  - {warning}" for warning in row["warnings"]))
    verdicts = sum(row["probability"] is not None for row in rows)
    console.print(f"{len(rows)} questions, {verdicts} verdicts, {sum(map(is_sure_and_wrong, rows))} sure and wrong")
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(rows, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
