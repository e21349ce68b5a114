"""Asks what-if questions of photographs, with boxes drawn by hand: is there a verdict, and is any sure but wrong?

    python benchmarks/photographs.py [DIR ...] [--masks [--depth]] [--frames DIR] [--json FILE]

The pictures come from scikit-image, where it is installed, and from DIRs; questions of pictures that are found nowhere
are skipped. A verdict is a probability of what is asked, sure or not. `truth` is what a person sees, and what the
measured depth of the motorcycle says; None if that cannot be told. Sure and wrong is a wrong answer with more than 0.8.
With --masks a stand-in for a segmenter outlines the things by hand-drawn polygons; with --depth the motorcycle has its
measured depth, too. --frames writes three frames of each clip beside each other, to be looked at.
"""

from __future__ import annotations

import argparse
import base64
import importlib.util
import json
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rich.console import Console
from rich.table import Table
from stand_ins import TrueCamera, TrueModels, TrueScene, TrueThing, motorcycle

from cow_service.errors import CowError
from cow_service.media.images import decode, decode_own, encode_png
from cow_service.media.masks import bbox_of
from cow_service.records import BBox, Simulation
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


# Outlines, each without those before it, which lie in front of it; one of two points is a box, "o" an ellipse in it.
OUTLINES: dict[str, dict[str, str]] = {
    "motorcycle_left.png": {
        "motorcycle": "92,195 108,193 148,190 140,165 142,150 155,145 165,150 165,160 195,165 245,170 265,185 300,195 "
        "345,190 357,195 372,178 395,168 440,155 465,160 463,150 430,150 405,140 385,155 378,165 360,172 355,165 "
        "375,145 392,135 335,138 332,125 370,112 400,125 425,118 460,140 468,130 497,118 502,105 520,100 535,115 "
        "530,125 565,125 575,118 582,130 575,142 560,145 560,165 548,185 553,200 580,262 610,270 645,305 640,312 "
        "655,320 675,350 685,400 675,435 650,450 620,448 580,430 550,400 525,360 515,325 505,325 510,300 530,272 "
        "512,230 495,230 470,240 480,250 478,290 472,320 455,350 430,375 395,378 350,370 345,385 352,405 340,408 "
        "335,435 325,432 330,400 325,375 280,370 240,395 195,400 160,385 135,360 122,320 122,290 130,265 150,245 "
        "112,245 102,240 115,220 92,215",
        "yellow bottle": "401,52 418,93", "blue can": "454,69 474,88",
        "red bin": "522,183 617,183 608,250 530,250",
        "bench": "40,110 275,105 283,190 250,185 200,165 165,160 140,170 140,195 100,200 62,205 62,260 65,280 52,305 "
        "46,240 42,190",
        "shelf": "341,0 720,0 712,200 700,292 610,275 590,262 575,250 555,200 341,165",
    },
    "coffee.png": {
        "cup": "173,110 180,75 205,45 250,22 290,18 340,24 385,50 405,85 408,110 398,150 370,210 345,240 330,270 "
        "285,283 255,280 235,290 215,307 197,300 200,265 218,240 205,215 180,160",
        "spoon": "412,130 425,75 415,66 402,75 410,120 388,210 372,245 340,255 328,285 345,315 366,326 390,318 404,290 "
        "400,262 388,245 395,200",
        "saucer": "o 77,68 479,388",
    },
    "astronaut.png": {
        "helmet": "278,512 280,440 295,390 330,360 380,345 420,345 460,370 490,410 497,460 505,512",
        "astronaut": "20,512 20,450 25,380 40,290 60,250 115,205 125,170 150,150 180,150 165,110 155,85 160,60 200,25 "
        "250,17 290,40 300,80 285,120 265,140 255,170 290,195 305,230 340,255 355,300 362,345 320,365 290,400 278,512",
        "space shuttle": "395,20 410,0 430,0 437,45 450,45 453,110 453,230 458,260 472,275 440,285 365,285 370,270 "
        "385,230 355,225 358,205 378,190 380,120 383,45 395,60",
    },
    "camera.png": {
        "man": "0,270 20,235 60,190 75,145 130,125 160,105 170,85 200,65 235,70 260,95 270,115 255,140 253,165 245,185 "
        "240,210 270,210 280,205 300,175 325,170 332,185 325,215 305,240 303,275 285,290 250,310 205,295 170,350 "
        "140,385 150,440 150,512 0,512",
        "tripod": "287,215 297,215 298,312 312,320 320,335 395,480 408,512 398,512 312,335 300,340 298,485 287,485 "
        "290,335 285,330 240,500 230,512 245,460 278,330 278,315 288,312",
        "tower": "412,118 432,194",
    },
    "rocket.jpg": {
        "rocket": "310,150 318,128 328,128 333,150 334,250 335,400 312,400",
        "tower": "443,123 450,123 457,195 470,300 478,420 437,420 440,195",
    },
    "coins.png": {"top left coin": "o 22,33 68,75", "large coin": "o 315,155 380,219"},
    "bear.jpg": {
        "bear": "228,480 260,450 310,430 320,390 350,350 420,310 440,270 455,255 432,215 430,190 460,188 500,205 "
        "600,160 690,113 760,130 820,180 870,250 890,300 925,440 890,465 830,455 780,480 700,470 620,495 540,500 "
        "430,510 300,520 240,500",
        "rock": "960,560 985,500 1035,400 1050,320 1100,250 1180,205 1280,190 1280,760 1180,710 1100,720 1010,700 "
        "975,690",
    },
}  # fmt: skip


# The question; the moving object, then the others that are given; the truth.
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


def outlined(picture: Path) -> TrueScene:
    """The scene of a photograph whose things are outlined by hand; its depth is that of the motorcycle, or unknown."""
    image = decode(picture.read_bytes()).pixels
    taken, things = np.zeros(image.shape[:2], bool), list[TrueThing]()
    for name, drawn in OUTLINES[picture.name].items():
        points = np.array([[int(each) for each in pair.split(",")] for pair in drawn.removeprefix("o ").split()])
        canvas = np.zeros(image.shape[:2], np.uint8)
        if drawn.startswith("o "):
            (x0, y0), (x1, y1) = points.tolist()
            cv2.ellipse(canvas, ((x0 + x1) // 2, (y0 + y1) // 2), ((x1 - x0) // 2, (y1 - y0) // 2), 0, 0, 360, 1, -1)
        elif len(points) == 2:
            canvas[points[0][1] : points[1][1], points[0][0] : points[1][0]] = 1
        else:
            cv2.fillPoly(canvas, [points], 1)
        mask = (canvas > 0) & ~taken
        taken |= mask
        things.append(TrueThing(name, bbox_of(mask), mask))
    if picture.name == "motorcycle_left.png":
        return replace(motorcycle(), things=tuple(things))
    depth, camera = np.full(taken.shape, np.nan, np.float32), TrueCamera(1.0, (0.0, 0.0), None, None)
    return TrueScene(picture.name, image, tuple(things), depth, camera)


def write_frames(service: Service, result: Simulation, file: Path) -> None:
    """The first, a middle and the last frame of a clip, side by side."""
    shown = (result.frames[0], result.frames[len(result.frames) // 2], result.frames[-1])
    pixels = [decode_own(service.artifacts.read(each.sha256)) for each in shown]
    file.write_bytes(encode_png(np.concatenate(pixels, axis=1)))


def ask(
    service: Service, picture: Path, question: str, names: str, truth: bool | None, file: Path | None = None
) -> dict[str, Any]:
    """The verdict on a question, and the camera that it was seen with. Frames are written to `file`."""
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
    if file is not None:
        write_frames(service, result, file)
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
    parser.add_argument("--masks", action="store_true", help="a segmenter's stand-in outlines things")
    parser.add_argument("--depth", action="store_true", help="with --masks: the motorcycle's picture has its depth")
    parser.add_argument("--frames", type=Path, default=None, help="write three frames of each clip here")
    arguments = parser.parse_args()
    pictures = find_pictures(arguments.folders)
    with tempfile.TemporaryDirectory() as data, Service(Settings(data_dir=Path(data))) as service:
        rows: list[dict[str, Any]] = []
        for name, picture in pictures.items():
            if arguments.masks:
                level = 0.0 if arguments.depth and name == "motorcycle_left.png" else None
                service.perception = TrueModels(outlined(picture), depth_level=level)
            for place, each in enumerate(QUESTIONS[name]):
                file = None if arguments.frames is None else arguments.frames / f"{picture.stem}-{place}.png"
                rows.append(ask(service, picture, *each, file))
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
