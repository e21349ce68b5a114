"""Images on their way to a multimodal LLM: at the size at which it sees them, as JPEG."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from cow_service.errors import InternalError, InvalidRequest
from cow_service.readers.mllm.coordinates import View, size_seen
from cow_service.readers.mllm.replies import ReplyError
from cow_service.weights.manifests import Family

MEDIA_TYPE = "image/jpeg"
QUALITY = 95  # percent; fine lines such as drawn arrows stay clean
# Each colour channel keeps its full resolution: a red arrow on green would smear else.
_ENCODING = (cv2.IMWRITE_JPEG_QUALITY, QUALITY, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444)


def view_of(pixels: NDArray[np.uint8], family: Family) -> View:
    """How a family sees an image [h, w, 3]. Raises `InvalidRequest` for a shape that it takes at no size."""
    height, width = pixels.shape[:2]
    try:
        return View(width, height, size_seen(width, height, family.image), family.coordinates)
    except ReplyError as error:
        raise InvalidRequest(f"The image cannot be shown to the multimodal LLM: {error}.") from error


def encode(pixels: NDArray[np.uint8], size: tuple[int, int]) -> bytes:
    """RGB [h, w, 3] as JPEG of `size` (width, height) px."""
    if size != (pixels.shape[1], pixels.shape[0]):
        smaller = size[0] * size[1] < pixels.shape[0] * pixels.shape[1]
        resized = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA if smaller else cv2.INTER_CUBIC)
        pixels = np.asarray(resized, np.uint8)
    done, data = cv2.imencode(".jpg", pixels[..., ::-1], _ENCODING)
    if not done:
        raise InternalError("The image could not be encoded for the multimodal LLM.")
    return data.tobytes()
