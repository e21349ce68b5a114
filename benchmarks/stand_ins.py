"""Stand-ins for models that give masks, depth and a camera: the truth of rendered scenes, with errors of a known size.

    scene = read_truth(Path("cow-scenes/sample/truth/collision/Collision_Level_1_0"))
    depth, focal = with_errors(scene.depth, scene.camera.focal, level=0.05, focal_factor=0.9, seed=1)

    service.perception = TrueModels(scene, missed=0.1, false=0.1, seed=1)

A folder has image.jpg, ids.png, meta.json, and depth either as depth.png (made by `cow-scenes`: 16-bit grey, 0 is
unknown, `camera.depth_scale` metres per unit) or as depth.npz (`depth`, metres). Depth is measured along the optical
axis. Pixels: x right, y down, and the centre of the first pixel is at (0.5, 0.5).
"""

from __future__ import annotations

import importlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from cow_service.media.masks import SAME_OBJECT_IOU, bbox_of, iou
from cow_service.media.types import Floats, Floats32, Image, Mask
from cow_service.perception.base import DepthReading, Detection, Perception, PerceptionKind, Prompt, Segment
from cow_service.records import BBox
from cow_service.settings import Settings

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
    in metres; the latter two are None if they are unknown.
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
        """The thing whose box overlaps a box most; None if none is the same object's."""
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


SAYS = 8.0  # logit inside of a mask, and less that outside
SURE_SCORE, PART_SCORE, SCRAP_SCORE = 0.95, 0.8, 0.6  # of the whole thing, of a part of it, of nothing in particular


class TrueModels(Perception):
    """Models that see a scene as it is, but for errors of a known size: to be set as `Service.perception`.

    The detector misses a share of what it is asked for, and gives as many false boxes: on another thing, or where
    nothing is. The segmenter outlines what fills a box, and what is at a point beside a part of it; elsewhere its masks
    are scraps, no two alike. `depth_level` is that of `with_errors`; None: there is no depth model.
    """

    def __init__(
        self, scene: TrueScene, missed: float = 0.0, false: float = 0.0, depth_level: float | None = None, seed: int = 0
    ) -> None:
        super().__init__(Settings())
        self._scene, self._missed, self._false, self._level, self._seed = scene, missed, false, depth_level, seed
        self.names: dict[PerceptionKind, str] = {"segmenter": "true-segmenter", "detector": "true-detector"}
        if depth_level is not None:
            self.names["depth"] = "true-depth"
        self.fingerprint = f"{scene.name} {missed} {false} {depth_level} {seed}"

    def load(self, kind: PerceptionKind) -> TrueModels | TrueSegmenter | None:
        """Itself: it is all of them, but for the segmenter."""
        if kind not in self.names:
            return None
        return TrueSegmenter(self._scene, self.fingerprint) if kind == "segmenter" else self

    def detect(self, image: Image, phrases: Sequence[str]) -> tuple[Detection, ...]:
        """See `Detector`. A phrase means the things whose names end in its last word."""
        random, found = np.random.default_rng(self._seed), list[Detection]()
        for phrase in phrases:
            meant = [each for each in self._scene.things if each.name.split()[-1] == phrase.split()[-1]]
            for each in meant:
                if random.random() >= self._missed and each.mask.any():
                    found.append(Detection(phrase, bbox_of(each.mask), 0.8))
            if random.random() < self._false:
                height, width = image.shape[:2]
                x, y = random.uniform(0, 0.8) * width, random.uniform(0.3, 0.8) * height
                box = x, y, x + 0.15 * width, min(height, y + 0.15 * width)
                others = [each for each in self._scene.things if each not in meant and each.mask.any()]
                if others and random.random() < 0.5:
                    box = bbox_of(others[int(random.integers(len(others)))].mask)
                found.append(Detection(phrase, box, 0.5))
        return tuple(found)

    def estimate(self, image: Image, focal: float | None) -> DepthReading:
        """See `DepthEstimator`."""
        level = self._level or 0.0
        depth, told = with_errors(self._scene.depth, self._scene.camera.focal, level, seed=self._seed)
        return DepthReading(depth.astype(np.float64), 1.0, told, max(0.01, level))


@dataclass(frozen=True)
class TrueSegmenter:
    """Outlines the things of a scene as they are."""

    scene: TrueScene
    fingerprint: str

    def embed(self, image: Image) -> None:
        """See `Segmenter`."""

    def segment(self, embedding: None, prompts: Sequence[Prompt]) -> tuple[tuple[Segment, ...], ...]:
        """See `Segmenter`."""
        return tuple(self._at(prompt) for prompt in prompts)

    def _at(self, prompt: Prompt) -> tuple[Segment, ...]:
        things = [each for each in self.scene.things if each.mask.any()]
        shape, scrap = self.scene.depth.shape, np.zeros(self.scene.depth.shape, np.uint8)
        if prompt.bbox is not None:
            x0, y0, x1, y1 = prompt.bbox
            best = max(things, key=lambda each: iou(bbox_of(each.mask), (x0, y0, x1, y1)), default=None)
            if best is not None and iou(bbox_of(best.mask), (x0, y0, x1, y1)) > 0.5:
                return (_segment(best.mask, SURE_SCORE),)
            middle, axes = (round((x0 + x1) / 2), round((y0 + y1) / 2)), (round((x1 - x0) / 2), round((y1 - y0) / 2))
            cv2.ellipse(scrap, middle, axes, 0, 0, 360, 1, -1)
            return (_segment(scrap > 0, SCRAP_SCORE),)
        assert prompt.point is not None, "a prompt has a box or a point"
        x, y = (int(min(max(value, 0), most - 1)) for value, most in zip(prompt.point, shape[::-1], strict=True))
        under = next((each for each in things if each.mask[y, x]), None)
        cv2.circle(scrap, (x, y), max(4, shape[1] // 60), 1, -1)
        if under is None:
            return (_segment(scrap > 0, SCRAP_SCORE),)
        return _segment(under.mask, SURE_SCORE), _segment((scrap > 0) & under.mask, PART_SCORE)


def _segment(mask: Mask, score: float) -> Segment:
    return Segment(np.where(mask, SAYS, -SAYS).astype(np.float32), score)


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
