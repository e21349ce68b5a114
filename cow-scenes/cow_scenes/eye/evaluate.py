"""Measures an eye on folders of scenes with true masks, such as those that this package makes.

A scene is a folder with `image.jpg`, `ids.png` and `meta.json`. The ids of its things are `id_of` of the record, or
places in `order` or `boxes`, from 1. `object` names what moves.
"""

import itertools
import json
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from .decode import Eye, Instance

LEAST_PIXELS = 150
"""A thing of fewer pixels is not asked for."""
BINS = np.array([0.0, 0.3, 0.5, 0.7, 0.9, 1.01])
"""Bounds of the probabilities that are compared with what is true."""


@dataclass(frozen=True)
class Scene:
    """A picture (h, w, 3) uint8 RGB, the true masks (h, w) of its things, and which of them moves."""

    name: str
    image: np.ndarray
    masks: dict[str, np.ndarray]
    mover: str


@dataclass(frozen=True)
class Score:
    """What was found in one scene: the best IoU of each thing, of the mover, and of each mask with any thing.

    `outside` is the share of each mask that lies on no thing; `probabilities` are the masks'.
    """

    best: np.ndarray
    mover: float | None
    matches: np.ndarray
    outside: np.ndarray
    probabilities: np.ndarray
    milliseconds: float


def scenes(folder: Path) -> Iterator[Scene]:
    """The scenes below a folder, in the order of their names."""
    for path in sorted(folder.rglob("meta.json")):
        record = json.loads(path.read_text())
        ids = np.asarray(cv2.imread(str(path.with_name("ids.png")), cv2.IMREAD_UNCHANGED))
        ids = ids if ids.ndim == 2 else ids[..., 0]
        names = record.get("order") or record["boxes"]
        numbers = record.get("id_of") or {name: k + 1 for k, name in enumerate(names)}
        masks = {name: ids == number for name, number in numbers.items()}
        image = np.asarray(cv2.imread(str(path.with_name("image.jpg")), cv2.IMREAD_COLOR))[..., ::-1]
        seen = {name: mask for name, mask in masks.items() if mask.sum() > LEAST_PIXELS}
        yield Scene(path.parent.name, np.ascontiguousarray(image), seen, record["object"])


def overlaps(truths: list[np.ndarray], found: list[np.ndarray]) -> np.ndarray:
    """Intersections over unions (truths, found)."""
    made = np.zeros((len(truths), len(found)))
    for i, truth in enumerate(truths):
        for j, mask in enumerate(found):
            common = np.count_nonzero(truth & mask)
            made[i, j] = common / max(1, np.count_nonzero(truth) + np.count_nonzero(mask) - common)
    return made


def score(scene: Scene, found: tuple[Instance, ...], milliseconds: float) -> Score:
    """How well standing things were found; flat ones are no part of it."""
    standing = [thing for thing in found if not thing.is_flat]
    masks, truths = [thing.mask for thing in standing], list(scene.masks.values())
    table = overlaps(truths, masks)
    best = table.max(1, initial=0)
    anything = np.any(truths, 0) if truths else np.zeros(scene.image.shape[:2], bool)
    return Score(
        best, float(best[list(scene.masks).index(scene.mover)]) if scene.mover in scene.masks else None,
        table.max(0, initial=0),
        np.array([1 - np.count_nonzero(m & anything) / max(1, np.count_nonzero(m)) for m in masks]),
        np.array([thing.probability for thing in standing]), milliseconds,
    )  # fmt: skip


def look_at(folder: Path, eye: Eye) -> list[Score]:
    """Scores of all scenes below a folder, each with the CPU time of looking."""
    made = []
    for scene in scenes(folder):
        began = time.process_time()
        sight = eye.look(scene.image)
        made.append(score(scene, sight.instances, 1000 * (time.process_time() - began)))
    return made


def summary(scores: list[Score]) -> dict[str, float]:
    """The figures of a family of scenes; `nothing` are masks per picture that match no thing."""
    best = np.concatenate([s.best for s in scores])
    movers = [s.mover for s in scores if s.mover is not None]
    matches = np.concatenate([s.matches for s in scores])
    outside = np.concatenate([s.outside for s in scores])
    figures = {
        "pictures": len(scores), "things": len(best),
        "found at 0.5": (best >= 0.5).mean(), "found at 0.75": (best >= 0.75).mean(),
        "mover": np.mean(movers) if movers else 0.0, "nothing": (matches < 0.5).sum() / len(scores),
        "background": (outside > 0.7).sum() / len(scores), "milliseconds": np.median([s.milliseconds for s in scores]),
    }  # fmt: skip
    return {name: round(float(value), 3) for name, value in figures.items()}


def reliability(scores: list[Score]) -> list[dict[str, float]]:
    """For each range of probabilities: how many masks, their mean probability, and the share that is a thing."""
    probabilities = np.concatenate([s.probabilities for s in scores])
    is_thing = np.concatenate([s.matches for s in scores]) >= 0.5
    rows = []
    for low, high in itertools.pairwise(BINS):
        chosen = (probabilities >= low) & (probabilities < high)
        if chosen.any():
            values = {"masks": chosen.sum(), "told": probabilities[chosen].mean(), "true": is_thing[chosen].mean()}
            rows.append({name: round(float(value), 3) for name, value in values.items()})
    return rows
