"""Whether the tracks and prompts that a video model gets agree with what is true of scenes with known truth.

    python benchmarks/tracks.py DIR ... [--pictures DIR] [--json FILE]

Each DIR holds one folder per scene with image.jpg, ids.png and meta.json. Counted are: points of the mover that lie in
the true silhouette of something that truly stands before it (2 px inside its outline), where the computed path is
within 10 px of the true one, and those of them that are told visible; bodies that stay, and those of them without a
track; prompts that do not tell an encounter that the clip shows. Nothing needs a GPU: tracks are those of Wan-Move's
density, drawn over the compositor's frames where `--pictures` is given.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from cow_service.errors import CowError
from cow_service.generators.base import GeneratorInput
from cow_service.generators.cutout.generator import CutoutGenerator
from cow_service.generators.wan.tracks import CLIP_FPS, MAX_FRAMES
from cow_service.media.masks import iou, window_of
from cow_service.narration.story import shown
from cow_service.physics.tracks import Density, with_tracks
from cow_service.records import Simulation, Trajectory
from cow_service.requests import SimulateRequest
from cow_service.service import Service
from cow_service.settings import Settings

WAN_MOVE = Density(8, 50, 200)
NEAR_TRUTH = 10.0  # px between the computed and the true path
INSIDE = 2  # px
LEAST_IOU = 0.5  # of a true silhouette's box with that of a body
COLOURS = {"seen": (60, 255, 60), "hidden": (0, 0, 255), "still": (255, 255, 0), "still hidden": (255, 0, 255)}


def watch_the_compositor() -> list[GeneratorInput]:
    """What the compositor is given from now on, the latest last."""
    seen, render = list[GeneratorInput](), CutoutGenerator.render

    def watched(
        self: CutoutGenerator, given: GeneratorInput, indices: Sequence[int], progress: Callable[[float], None]
    ) -> Iterator[Any]:
        seen.append(given)
        return render(self, given, indices, progress)

    CutoutGenerator.render = watched
    return seen


def dense(given: GeneratorInput) -> Trajectory:
    """With the tracks that Wan-Move would get."""
    mover = given.scene.mover
    masks = [mover, *(each.mask for each in given.obstacles)]
    return with_tracks(given.trajectory, masks, given.grounding.point, WAN_MOVE)


def true_boxes(meta: dict[str, Any]) -> Any:
    """The mover's boxes [S, 4] on its true way: of scenes whose mover stays on the floor, else none."""
    boxes = np.array(meta["boxes"].get(meta["object"], ()), float)
    if meta.get("motion", "linear") != "linear" or meta.get("form") == "fall" or not boxes.size:
        return np.zeros((0, 4))
    if boxes.ndim == 1:  # its first box alone: it goes where its centre does
        track = np.array(meta["track"], float)
        boxes = boxes + np.hstack([track - track[0]] * 2)
    return boxes


def iou_with_still(trajectory: Trajectory, mask: Any) -> float:
    """How well a true silhouette [H, W] is the box of something that stays where it is."""
    window, moving = window_of(mask), {each.body for each in trajectory.paths}
    if window is None:
        return 0.0
    box = window[1].start, window[0].start, window[1].stop, window[0].stop
    return max((iou(box, each.bbox) for k, each in enumerate(trajectory.bodies) if k not in moving), default=0.0)


def judged(folder: Path, meta: dict[str, Any], simulation: Simulation, trajectory: Trajectory) -> Counter[str]:
    """The counts of one scene."""
    found, path = Counter[str](), trajectory.path
    moving = {each.body for each in trajectory.paths}
    tracked = {each.body for each in trajectory.still_tracks if each.points}
    found["bodies that stay"] = len(trajectory.bodies) - len(moving)
    found["without a track"] = len(set(range(len(trajectory.bodies))) - moving - tracked)
    prompt = shown(simulation.grounding.object, trajectory)
    last = (trajectory.num_frames - 1) / trajectory.fps
    met = [each for each in trajectory.encounters if not each.subject and each.kind == "touches"]
    met = [each for each in met if (each.time or 0.0) <= last]
    found["first meetings"], named = len(met[:1]), met[0].object if met else ""
    found["not in the prompt"] = int(named.lower() not in prompt.lower())
    found["negations in prompts"] = int(" not " in prompt or "nothing" in prompt)
    boxes, ids_file = true_boxes(meta), folder / "ids.png"
    if not len(boxes) or not ids_file.is_file():
        return found
    ids = np.array(cv2.imread(str(ids_file), cv2.IMREAD_UNCHANGED))
    ids = ids if ids.ndim == 2 else ids[..., 0]
    names = {name: meta.get("id_of", {}).get(name, k) for k, name in enumerate(meta["boxes"], start=1)}
    # Where it is on its way, whatever its speed: no picture tells that.
    centres = (boxes[:, :2] + boxes[:, 2:]) / 2
    ours = np.array(path.points) - np.array(path.points[0]) + centres[0]
    gaps = np.linalg.norm(ours[:, None] - centres, axis=2)
    close, boxes = gaps.min(axis=1) < NEAR_TRUTH, boxes[gaps.argmin(axis=1)]
    points = np.array(path.tracks).transpose(1, 0, 2)
    seen = np.ones(points.shape[:2], bool) if path.tracks_visible is None else np.array(path.tracks_visible).T
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * INSIDE + 1,) * 2)
    for name, number in names.items():
        # What is set moving, in truth or by us, has no silhouette that we know.
        stays = iou_with_still(trajectory, ids == number) > LEAST_IOU
        if name == meta["object"] or not stays or name in (meta.get("removed") or ()):
            continue
        mask = np.array(cv2.erode((ids == number).astype(np.uint8), kernel), bool)
        if not mask.any():
            continue
        nearer = float(np.nonzero(mask)[0].max()) > boxes[:, 3] + INSIDE  # it stands lower in the image
        x, y = np.moveaxis(np.floor(points).astype(int), 2, 0)
        inside = (x >= 0) & (y >= 0) & (x < mask.shape[1]) & (y < mask.shape[0])
        covered = inside & mask[np.where(inside, y, 0), np.where(inside, x, 0)] & (nearer & close)[:, None]
        found["hidden in truth"] += int(covered.sum())
        found["of them told visible"] += int((covered & seen).sum())
    return found


def drawn(given: GeneratorInput, trajectory: Trajectory) -> Any:
    """Four frames of the clip with its tracks: an image BGR."""
    until = max(3, round((trajectory.moving_until or 1.0) * trajectory.fps))
    indices = sorted({min(trajectory.num_frames - 1, until * k // 3) for k in range(4)})
    pictures: list[Any] = []
    for index, frame in zip(indices, CutoutGenerator().render(given, indices, lambda done: None), strict=True):
        picture = cv2.cvtColor(frame, cv2.COLOR_RGB2BGR)
        factor = picture.shape[1] / given.scene.width
        dots = [
            (track[index], "seen" if path.tracks_visible is None or path.tracks_visible[k][index] else "hidden")
            for path in trajectory.paths
            for k, track in enumerate(path.tracks)
        ]
        dots += [
            (point, "still" if each.visible is None or each.visible[k][index] else "still hidden")
            for each in trajectory.still_tracks
            for k, point in enumerate(each.points)
        ]
        for (x, y), kind in dots:
            if max(abs(x), abs(y)) < 1e4:
                cv2.circle(picture, (round(x * factor), round(y * factor)), 2, COLOURS[kind], -1)
        pictures.append(cv2.resize(picture, (480, round(480 * picture.shape[0] / picture.shape[1]))))
    return np.vstack([np.hstack(pictures[:2]), np.hstack(pictures[2:])]) if len(pictures) == 4 else pictures[0]


def main() -> None:
    """Prints a line for each scene, and the counts of all."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("--pictures", type=Path, help="draw the tracks over the clip of each scene here")
    parser.add_argument("--json", type=Path, help="write the counts here")
    asked = parser.parse_args()
    total = Counter[str]()
    with tempfile.TemporaryDirectory() as data, Service(Settings(data_dir=Path(data), reader="embedded")) as service:
        given = watch_the_compositor()
        for folder in sorted(
            each for root in asked.folders for each in root.iterdir() if (each / "meta.json").is_file()
        ):
            meta = json.loads((folder / "meta.json").read_text())
            image = {"artifact": service.keep_image((folder / "image.jpg").read_bytes()).sha256}
            body = {"image": image, "question": meta["question"], "num_frames": MAX_FRAMES, "fps": CLIP_FPS}
            given.clear()
            try:
                simulation = service.simulate(SimulateRequest.model_validate(body | {"video": False}))
            except CowError as error:
                total["refused"] += 1
                print(f"{folder.name}: {error.code}")
                continue
            trajectory = dense(given[0])
            counts = judged(folder, meta, simulation, trajectory)
            total += counts
            total["scenes"] += 1
            print(f"{folder.name}: {dict(+counts)}: {shown(simulation.grounding.object, trajectory)}")
            if asked.pictures is not None:
                asked.pictures.mkdir(exist_ok=True)
                cv2.imwrite(str(asked.pictures / f"{folder.name}.png"), drawn(given[0], trajectory))
    print(json.dumps(total, indent=2))
    if asked.json is not None:
        asked.json.write_text(json.dumps(total, indent=2) + "\n")


if __name__ == "__main__":
    main()
