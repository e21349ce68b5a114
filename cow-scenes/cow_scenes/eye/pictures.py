"""Pictures with their truth: picture N of seed S is always the same, whoever draws it and whenever.

A shard is one stage's pictures in an .npz file: `pictures` and `ids` are encoded images, one after the other,
with `picture_ends` and `id_ends`; `depth` (n, 96, 160) float16 metres; `normals` (n, 256, 3) float16 by id, in the
camera's axes (right, down, forward); `focal` (n,) pixels.
"""

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import mujoco
import numpy as np

from .camera import aim, draw_view
from .furniture import furnish
from .lights import develop, expose, light
from .overlays import draw_over
from .room import FIRST_FLAT, FIRST_SUPPORT, FIRST_THING, FIRST_WALL, IGNORED
from .stage import HEIGHT, WIDTH, Stage
from .things import cast_from_outside, dress, place_things

PER_STAGE = 16
LEAST_PIXELS = 60
"""A thing of fewer pixels counts neither as one nor as none."""
DEPTH_STEP = 4
DRAWN, SHADOW = 1, 2
"""Bits of a picture's marks."""
SHADOW_SHARE = 0.72
"""A support is in shadow where it has less than this of its brightness without shadows."""


@dataclass(frozen=True)
class Picture:
    """A picture (h, w, 3) uint8 RGB and its truth.

    `ids` (h, w) uint8: things from 1, flat things from 150, supports from 200, walls from 230, 255 to be ignored, 0
    anything else. `marks` (h, w) uint8: bit 1 drawn over, bit 2 in shadow. `depth` (h/4, w/4) float16 in metres along
    the optical axis. `normals` (256, 3) float16 by id. `focal` in pixels.
    """

    image: np.ndarray
    ids: np.ndarray
    marks: np.ndarray
    depth: np.ndarray
    normals: np.ndarray
    focal: float


def stage_random(seed: int, group: int) -> np.random.Generator:
    """The randomness of a stage."""
    return np.random.default_rng((seed, group, 0))


def draw_on(stage: Stage, random: np.random.Generator) -> Picture:
    """One picture of a stage."""
    stage.clear()
    view = draw_view(random)
    aim(stage, view)
    room = furnish(stage, view, random)
    placed = place_things(room)
    dress(room, placed)
    lamps = light(stage, random)
    if random.random() < 0.25:
        cast_from_outside(room, placed, lamps.towards_first)
    ids = dict(room.ids)
    for k, thing in enumerate(placed):
        body = stage.bodies[thing.number]
        first = int(stage.model.body_geomadr[body])
        ids |= dict.fromkeys(range(first, first + int(stage.model.body_geomnum[body])), FIRST_THING + k)
    lit, even = expose(stage, lamps, random)
    geoms, depth = stage.geoms()
    table = np.zeros(stage.model.ngeom + 1, np.uint8)
    table[list(ids)] = list(ids.values())
    numbered = table[geoms]
    count = np.bincount(numbered.ravel(), minlength=256)
    kept = np.where(
        (count < LEAST_PIXELS) & (np.arange(256) > 0) & (np.arange(256) < FIRST_SUPPORT), IGNORED, np.arange(256)
    )
    numbered = kept.astype(np.uint8)[numbered]
    shadow = in_shadow(lit, even) & (numbered >= FIRST_SUPPORT) & (numbered < FIRST_WALL)
    regions = [numbered == k for k in np.flatnonzero(count[:FIRST_FLAT] >= LEAST_PIXELS) if k >= FIRST_THING]
    image, drawn = draw_over(develop(lit, random), regions, random)
    return Picture(
        image, numbered, (DRAWN * drawn + SHADOW * shadow).astype(np.uint8),
        depth[2::DEPTH_STEP, 2::DEPTH_STEP].astype(np.float16), room.normals.astype(np.float16), view.focal,
    )  # fmt: skip


def in_shadow(lit: np.ndarray, even: np.ndarray) -> np.ndarray:
    """Where (h, w) a picture is much darker than the one of half its size without shadows; by the green channel."""
    dark = cv2.resize(np.ascontiguousarray(lit[..., 1]), even.shape[1::-1], interpolation=cv2.INTER_AREA)
    ratio = cv2.blur(dark, (3, 3)) / np.maximum(cv2.blur(even[..., 1].astype(np.float32), (3, 3)), 1)
    return cv2.resize(ratio, lit.shape[1::-1]) < SHADOW_SHARE


def draw_group(seed: int, group: int) -> Iterator[Picture]:
    """The pictures of one stage: numbers `group * PER_STAGE` and following."""
    stage = Stage(stage_random(seed, group))
    try:
        for k in range(PER_STAGE):
            yield draw_on(stage, np.random.default_rng((seed, group, 1 + k)))
    finally:
        stage.close()


class Pen:
    """OSMesa's drawing context for this thread, as a context manager."""

    def __enter__(self) -> "Pen":
        self.context = mujoco.GLContext(WIDTH, HEIGHT)
        self.context.make_current()
        return self

    def __exit__(self, *_: object) -> None:
        self.context.free()


def packed(images: list[np.ndarray], suffix: str, quality: list[int]) -> tuple[np.ndarray, np.ndarray]:
    """Encoded images one after the other, and where each ends."""
    encoded = [cv2.imencode(suffix, image, quality)[1].ravel() for image in images]
    return np.concatenate(encoded), np.cumsum([len(e) for e in encoded])


def write_shard(folder: Path, seed: int, group: int) -> Path:
    """Draw a group and write its shard; one that is there is left alone."""
    path = folder / f"seed{seed}-{group:05d}.npz"
    if path.exists():
        return path
    drawn = list(draw_group(seed, group))
    images, image_ends = packed([p.image[..., ::-1] for p in drawn], ".jpg", [cv2.IMWRITE_JPEG_QUALITY, 95])
    truths, truth_ends = packed(
        [np.dstack([p.ids, p.marks, 0 * p.ids]) for p in drawn], ".png", [cv2.IMWRITE_PNG_COMPRESSION, 3]
    )
    folder.mkdir(parents=True, exist_ok=True)
    unfinished = folder / f".{path.name}.{os.getpid()}.npz"
    np.savez(
        unfinished, pictures=images, picture_ends=image_ends, ids=truths, id_ends=truth_ends,
        depth=np.stack([p.depth for p in drawn]), normals=np.stack([p.normals for p in drawn]),
        focal=np.array([p.focal for p in drawn], np.float32),
    )  # fmt: skip
    unfinished.replace(path)
    return path


class Shard:
    """A shard in memory; its images are decoded when they are asked for."""

    def __init__(self, path: Path) -> None:
        with np.load(path) as held:
            self.held = {name: held[name] for name in held.files}
        self.path = path

    def __len__(self) -> int:
        return len(self.held["focal"])

    def __getitem__(self, k: int) -> Picture:
        def part(data: str, ends: str) -> np.ndarray:
            bounds = np.r_[0, self.held[ends]]
            return np.asarray(cv2.imdecode(self.held[data][bounds[k] : bounds[k + 1]], cv2.IMREAD_COLOR))

        truth = part("ids", "id_ends")
        return Picture(
            np.ascontiguousarray(part("pictures", "picture_ends")[..., ::-1]), truth[..., 0], truth[..., 1],
            self.held["depth"][k], self.held["normals"][k], float(self.held["focal"][k]),
        )  # fmt: skip
