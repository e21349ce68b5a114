"""The depth of the image, where the server has a model for it and the request gives none: between stages 1 and 2."""

import cv2
import numpy as np
from pydantic import ValidationError

from cow_service.media.images import encode_png
from cow_service.requests import DepthRequest, ImageArtifact, SimulateRequest
from cow_service.stages.keys import EstimatedDepth, StageResult
from cow_service.stages.run import LEAST_NEAREST, Run

FARTHEST = 65_535  # of 16 bits
UNUSABLE = "The depth model saw no usable distances: the simulation relies on the picture alone."
BEYOND = 50.0  # times the usual depth: sky and the like would take all steps of 16 bits


def estimate_depth(run: Run[SimulateRequest]) -> StageResult[EstimatedDepth]:
    """The depth map of the server's model, stored as a request would give it. Raises `PerceptionUnavailable`.

    There is none for a drawing without depth, and none where the model sees next to nothing, or no distances.
    """
    model, exif = run.backends.perception.depth, run.image.info.focal
    assert model is not None, "asked for only where there is a depth model"
    with run.cpu():
        if run.scene.side_view is not None:
            return StageResult(value=EstimatedDepth(depth=None))
        reading = model.estimate(run.scene.undrawn, exif)
        size = run.image.info.width, run.image.info.height
        # Of two surfaces that meet in one pixel, one is shown: their mean would be a thing between them.
        depth = cv2.resize(reading.depth, size, interpolation=cv2.INTER_NEAREST_EXACT)
        known = np.isfinite(depth) & (depth > 0)
        usual = float(np.median(depth[known])) if known.any() else 0.0
        known &= depth < BEYOND * usual
        if not known.any() or (
            reading.scale is None and float(np.percentile(depth[known], 1)) < LEAST_NEAREST * usual  # it has an offset
        ):
            return StageResult(value=EstimatedDepth(depth=None), warnings=(UNUSABLE,))
        step = float(depth[known].max()) / FARTHEST
        stored = np.where(known, np.clip(np.nan_to_num(depth) / step, 1, FARTHEST), 0).astype(np.uint16)
        kept = run.backends.artifacts.put(encode_png(stored), "image/png")
    try:
        request = DepthRequest(
            map=ImageArtifact(artifact=kept.sha256),
            scale=None if reading.scale is None else reading.scale * step,
            focal=None if exif is not None else reading.focal,  # which the model was told
            deviation=reading.deviation,
        )
    except ValidationError:  # what it makes of a picture of nothing
        return StageResult(value=EstimatedDepth(depth=None), warnings=(UNUSABLE,))
    return StageResult(value=EstimatedDepth(depth=request), artifacts=(kept.sha256,))
