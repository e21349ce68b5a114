"""Depth estimators: MoGe-2, which tells the focal length, too, and metric models of Depth Anything V2."""

from __future__ import annotations

import math
from functools import partial

import numpy as np
import torch
from transformers import DepthAnythingForDepthEstimation

from cow_service.errors import PerceptionUnavailable
from cow_service.media.types import Image
from cow_service.perception.base import DepthReading
from cow_service.perception.loading import LoadedModel, load, load_pretrained
from cow_service.perception.moge import PATCH, load_moge, recover_camera
from cow_service.settings import Settings


class MogeEstimator:
    """A `DepthEstimator`: depth in metres, nan where the model sees no surface, such as in the sky.

    Of the manifest it takes `tokens`, the patches that an image is cut into: more show finer things and take longer.
    """

    def __init__(self, model: LoadedModel) -> None:
        self._model = model
        self.fingerprint = model.fingerprint

    def estimate(self, image: Image, focal: float | None) -> DepthReading:
        """With a focal length of its own where none is given. Raises `PerceptionUnavailable`."""
        height, width = image.shape[:2]
        aspect, diagonal = width / height, math.hypot(width, height)
        with self._model.computing() as network:
            columns, rows = network.grid(int(self._model.manifest.defaults["tokens"]), aspect)
            found = network(self._model.pixels(image, (PATCH * columns, PATCH * rows)), aspect)
            points, sure, scale = (each.cpu().numpy().astype(np.float64) for each in found)
        known = (sure > 0.5) & np.isfinite(points).all(axis=2)
        depth = np.full(known.shape, np.nan)
        if np.count_nonzero(known) > 1:
            relative, shift = recover_camera(points, known, aspect, None if focal is None else 2 * focal / diagonal)
            focal = relative * diagonal / 2
            depth = np.where(known & (points[..., 2] + shift > 0), (points[..., 2] + shift) * scale, np.nan)
        return DepthReading(depth, 1.0, focal, float(self._model.manifest.defaults["deviation"]))


class DepthAnythingEstimator:
    """A `DepthEstimator`: depth in metres everywhere, whatever the camera, whose focal length it does not tell."""

    def __init__(self, model: LoadedModel) -> None:
        self._model = model
        config = model.network.config
        if config.depth_estimation_type != "metric":
            raise PerceptionUnavailable(f"The checkpoint of '{model.manifest.name}' is not one of the metric models.")
        self._side, self._patch = int(config.backbone_config.image_size), int(config.patch_size)
        self.fingerprint = model.fingerprint

    def estimate(self, image: Image, focal: float | None) -> DepthReading:
        """`focal` is not used. Raises `PerceptionUnavailable`."""
        # One side as long as in training, that which changes less; both multiples of a patch.
        height, width = image.shape[:2]
        scale = min(self._side / width, self._side / height, key=lambda each: abs(1 - each))
        size = tuple(max(1, round(each * scale / self._patch)) * self._patch for each in (width, height))
        with self._model.computing() as network:
            depth = network(self._model.pixels(image, (size[0], size[1]), "bicubic")).predicted_depth[0]
            depth = depth.float().cpu().numpy().astype(np.float64)
        return DepthReading(depth, 1.0, None, float(self._model.manifest.defaults["deviation"]))


def load_moge_estimator(name: str, settings: Settings) -> MogeEstimator:
    """Factory of the entry points. Raises `PerceptionUnavailable`."""
    # The public code computes in float16 on GPUs, too.
    return MogeEstimator(load(name, settings, partial(load_moge, name), torch.float16))


def create_depth_anything_indoor(settings: Settings) -> DepthAnythingEstimator:
    """Factory of the entry point. Raises `PerceptionUnavailable`."""
    name = "depth-anything-indoor"
    return DepthAnythingEstimator(load(name, settings, partial(load_pretrained, DepthAnythingForDepthEstimation, name)))


create_moge_2_small = partial(load_moge_estimator, "moge-2-small")
create_moge_2_large = partial(load_moge_estimator, "moge-2-large")
