"""Stand-ins for models that give masks, depth and a camera: the truth of rendered scenes, with errors of a known size.

    scene = read_truth(Path("cow-scenes/sample/truth/collision/Collision_Level_1_0"))
    depth, focal = with_errors(scene.depth, scene.camera.focal, level=0.05, focal_factor=0.9, seed=1)

A folder has image.jpg, ids.png, meta.json, and depth either as depth.png (made by `cow-scenes`: 16-bit grey, 0 is
unknown, `camera.depth_scale` metres per unit) or as depth.npz (`depth`, metres). Depth is measured along the optical
axis. Pixels: x right, y down, and the centre of the first pixel is at (0.5, 0.5).
"""

from __future__ import annotations

import importlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from cow_service.records import BBox
from cow_service.vision.masks import SAME_OBJECT_IOU, bbox_of, iou
from cow_service.vision.types import Floats, Floats32, Image, Mask

LEVELS = (0.0, 0.03, 0.05, 0.08)  # sizes of the smooth error of depth
FOCAL_FACTORS = (0.9, 0.95, 1.0, 1.05, 1.1)
GRID = (5, 7)  # rows and columns of the field that the smooth error is interpolated from
WHITE = 0.01  # size of the error that each pixel has of its own

# The motorcycle of the Middlebury stereo data of 2014, as scikit-image's `stereo_motorcycle` says: px, px, m.
MOTORCYCLE_FOCAL, MOTORCYCLE_OFFSET, MOTORCYCLE_BASELINE = 994.978, 31.086, 0.193001
MOTORCYCLE_CENTRE = (311.193, 254.877)


@dataclass(frozen=True)
class TrueCamera:
    """A pinhole camera without roll.

    `focal` and the principal point `centre` in px, `pitch` in degrees (positive looks down), `height` above the floor
    in metres; the latter two are None where they are unknown.
    """

    focal: float
    centre: tuple[float, float]
    pitch: float | None
    height: float | None
    roll: float = 0.0


@dataclass(frozen=True)
class TrueThing:
    """A thing at t = 0: name, box [x0, y0, x1, y1] (px, hidden parts included), mask [H, W] of its visible pixels."""

    name: str
    bbox: BBox
    mask: Mask


@dataclass(frozen=True)
class TrueScene:
    """What is known of an image: things in the order of their ids, depth [H, W] in metres (nan: unknown), camera."""

    name: str
    image: Image
    things: tuple[TrueThing, ...]
    depth: Floats32
    camera: TrueCamera

    def thing(self, name: str) -> TrueThing:
        """The thing of that name. Raises KeyError if there is none."""
        for each in self.things:
            if each.name == name:
                return each
        raise KeyError(f"{self.name} has no {name!r}; it has {', '.join(each.name for each in self.things)}")

    def thing_in(self, bbox: BBox) -> TrueThing | None:
        """The thing whose box overlaps a box most; None where none is the same object's."""
        best = max(self.things, key=lambda each: iou(each.bbox, bbox), default=None)
        return best if best and iou(best.bbox, bbox) >= SAME_OBJECT_IOU else None


def read_truth(folder: Path) -> TrueScene:
    """The scene of a folder. Raises FileNotFoundError if a file is missing, e.g. the depth of an older set."""
    meta = json.loads((folder / "meta.json").read_text())
    depth = _read_depth(folder, meta["camera"])
    image, ids = _read_picture(folder / "image.jpg"), _read_picture(folder / "ids.png")
    numbers: dict[str, int] = meta.get("id_of") or {name: i for i, name in enumerate(meta["boxes"], 1)}
    things = [_thing(name, meta["boxes"].get(name), ids == number) for name, number in numbers.items()]
    told = meta["camera"]
    centre = (ids.shape[1] / 2, ids.shape[0] / 2)
    camera = TrueCamera(told["focal"], centre, told["pitch"], told["height"], told.get("roll", 0.0))
    return TrueScene(folder.name, np.ascontiguousarray(image[..., ::-1]), tuple(things), depth, camera)


def motorcycle() -> TrueScene:
    """A photo with measured depth (Middlebury 2014), without masks; pitch and height of its camera are unknown.

    Needs scikit-image, whose wheel holds the data. Raises ModuleNotFoundError without it.
    """
    left, _, disparity = importlib.import_module("skimage.data").stereo_motorcycle()
    shift = np.where(np.isfinite(disparity), disparity, np.nan) + MOTORCYCLE_OFFSET
    depth = np.asarray(MOTORCYCLE_FOCAL * MOTORCYCLE_BASELINE / shift, np.float32)
    camera = TrueCamera(MOTORCYCLE_FOCAL, MOTORCYCLE_CENTRE, None, None)
    return TrueScene("motorcycle", np.asarray(left, np.uint8), (), depth, camera)


def with_errors(
    depth: Floats32, focal: float, level: float, focal_factor: float = 1.0, seed: int = 0
) -> tuple[Floats32, float]:
    """Depth [H, W] and focal length as a model might give them, the same for the same arguments.

    Depth is multiplied by exp(level * field), where the field is interpolated between standard normal numbers on a
    grid of 5 by 7, and by 1 plus white noise of 1%; with a level of 0 it stays as it is. Between the grid's points the
    interpolation averages: over an image the error's standard deviation is about three quarters of `level`. Fields of
    one seed differ by their factor only. The focal length is multiplied by `focal_factor`.
    """
    if level == 0:
        return depth.copy(), focal * focal_factor
    random = np.random.default_rng(seed)
    field = _smooth_field(random.normal(size=GRID), depth.shape[1], depth.shape[0])
    white = 1 + WHITE * random.normal(size=depth.shape)
    return np.asarray(depth * np.exp(level * field) * white, np.float32), focal * focal_factor


def points_of(depth: Floats32, focal: float, centre: tuple[float, float]) -> Floats32:
    """Points [H, W, 3] in metres as the camera sees them (x right, y down, z forward); nan where depth is unknown."""
    x, y = np.meshgrid(np.arange(depth.shape[1]) + 0.5, np.arange(depth.shape[0]) + 0.5)
    rays = np.stack([(x - centre[0]) / focal, (y - centre[1]) / focal, np.ones_like(x)], -1)
    return np.asarray(rays * depth[..., None], np.float32)


def _smooth_field(grid: Floats, width: int, height: int) -> Floats:
    """Values [height, width] between those of a grid that spans the image, without kinks at the grid's lines."""

    def weights(points: int, length: int) -> Floats:
        place = np.linspace(0, points - 1, length)
        low = np.minimum(place.astype(int), points - 2)
        share = place - low
        share = share * share * (3 - 2 * share)
        found = np.zeros((length, points))
        found[np.arange(length), low], found[np.arange(length), low + 1] = 1 - share, share
        return found

    rows, columns = grid.shape
    return weights(rows, height) @ grid @ weights(columns, width).T


def _thing(name: str, boxes: Any, mask: Mask) -> TrueThing:
    """A thing from its box, or its boxes by sample; a table has none but its mask's."""
    if boxes is None:
        return TrueThing(name, bbox_of(mask), mask)
    x0, y0, x1, y1 = boxes[0] if isinstance(boxes[0], list) else boxes
    return TrueThing(name, (x0, y0, x1, y1), mask)


def _read_depth(folder: Path, camera: dict[str, Any]) -> Floats32:
    if (folder / "depth.png").exists():
        units = _read_picture(folder / "depth.png")
        return np.where(units > 0, units * camera["depth_scale"], np.nan).astype(np.float32)
    with np.load(folder / "depth.npz") as arrays:
        metres = arrays["depth"].astype(np.float32)
    return np.where(np.isfinite(metres) & (metres > 0), metres, np.nan).astype(np.float32)


def _read_picture(path: Path) -> Any:
    """Pixels as they are stored, colours in the order of OpenCV."""
    pixels = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if pixels is None:
        raise FileNotFoundError(f"{path} is missing, or is no picture")
    return pixels
