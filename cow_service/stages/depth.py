"""The depth of the image: as the request gives it, else as a model of the server sees it between stages 1 and 2."""

import cv2
import numpy as np
from pydantic import ValidationError

from cow_service.errors import FieldError, ImageTooLarge, InvalidRequest
from cow_service.media.images import decode_depth, encode_png
from cow_service.physics.geometry import DepthMap
from cow_service.records import Estimate
from cow_service.requests import DepthRequest, ImageArtifact, SimulateRequest
from cow_service.stages.keys import EstimatedDepth, StageResult
from cow_service.stages.run import UNREADABLE, Run

FARTHEST = 65_535  # of 16 bits
UNUSABLE = "The depth model saw no usable distances: the simulation relies on the picture alone."
LEAST_NEAREST = 0.05  # of the usual depth: relative maps that begin nearer were shifted
MAPPED_DEVIATION, EXIF_DEVIATION = 0.06, 0.08  # relative, of focal lengths: pictures with EXIF may be cropped
BEYOND = 50.0  # times the usual depth: sky and the like would take all steps of 16 bits


def estimate_depth(run: Run[SimulateRequest]) -> StageResult[EstimatedDepth]:
    """The depth map of the server's model, stored as a request would give it. Raises `PerceptionUnavailable`.

    There is none for a drawing without depth, and none where the model sees next to nothing, or no distances.
    """
    model, exif = run.backends.perception.depth, run.image.info.focal
    assert model is not None, "asked for only where there is a depth model"
    with run.cpu():
        observation = run.sight.look()
        if observation.side_view is not None:
            return StageResult(value=EstimatedDepth(depth=None))
        reading = model.estimate(observation.undrawn, exif)
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


def depth_map(run: Run[SimulateRequest], estimated: EstimatedDepth | None) -> DepthMap | None:
    """That of the request, else the estimated one. Raises `InvalidRequest` for a map that is none of the image."""
    given, image = run.request.depth or (None if estimated is None else estimated.depth), run.image.info
    if given is None:
        return None
    assert isinstance(given.map, ImageArtifact), "the pictures of a request are kept before its stages run"
    try:
        data = run.backends.artifacts.read(given.map.artifact)
        values = decode_depth(data, max_megapixels=image.width * image.height / 1e6)
    except ImageTooLarge as error:
        raise _no_depth(f"is larger than the upright image of {image.width} x {image.height} px") from error
    except UNREADABLE as error:
        raise _no_depth(f"cannot be read: {error.detail.rstrip('.')}") from error
    if values.shape != (image.height, image.width):
        size = f"{values.shape[1]} x {values.shape[0]} px"
        raise _no_depth(f"has {size} where the upright image has {image.width} x {image.height} px")
    if not values.any():
        raise _no_depth("is empty: every pixel is 0, which says that nothing is known")
    nearest, usual = (float(value) for value in np.percentile(values[values > 0], (1, 50)))
    if given.scale is None and nearest < LEAST_NEAREST * usual:
        raise _no_depth("begins at the camera itself: depths must be proportional to distances, without an offset")
    depth = np.where(values > 0, values, np.float32(np.nan))  # 16 bits: exact
    source = "request" if run.request.depth is not None else "model"
    return DepthMap(depth, given.scale, given.deviation, given.focal, source)


def _no_depth(fault: str) -> InvalidRequest:
    return InvalidRequest(
        f"`depth.map` {fault}. Give a grey PNG with 16 bits, of the size of the upright image.",
        errors=(FieldError("/depth/map", fault),),
    )


def focal_of(run: Run[SimulateRequest], depth: DepthMap | None) -> Estimate | None:
    """The focal length (px) that the depth map was made with, else the one of the image's EXIF."""
    mapped, exif = None if depth is None else depth.focal, run.image.info.focal
    if mapped is not None:
        return Estimate(value=mapped, deviation=MAPPED_DEVIATION * mapped)
    return None if exif is None else Estimate(value=exif, deviation=EXIF_DEVIATION * exif)
