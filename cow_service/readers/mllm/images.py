"""Images for a multimodal LLM: at the size at which it sees them, as JPEG."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from cow_service.errors import InternalError, InvalidRequest
from cow_service.readers.mllm.coordinates import CoordinateFrame, size_seen
from cow_service.readers.mllm.replies import ReplyError
from cow_service.weights.manifests import Family

MEDIA_TYPE = "image/jpeg"
QUALITY = 95  # percent; fine lines such as drawn arrows stay clean
# Each colour channel keeps its full resolution: a red arrow on green would smear else.
_ENCODING = (cv2.IMWRITE_JPEG_QUALITY, QUALITY, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444)


@dataclass(frozen=True)
class EncodedImage:
    """An image as it is sent: JPEG, and how the model sees it."""

    jpeg: bytes
    coordinate_frame: CoordinateFrame


def encode(pixels: NDArray[np.uint8], family: Family) -> EncodedImage:
    """RGB [h, w, 3] for a family of models. Raises `InvalidRequest` for a shape that it takes at no size."""
    height, width = pixels.shape[:2]
    try:
        size = size_seen(width, height, family.image)
    except ReplyError as error:
        raise InvalidRequest(f"The image cannot be shown to the multimodal LLM: {error}.") from error
    if size != (width, height):
        smaller = size[0] * size[1] < width * height
        resized = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA if smaller else cv2.INTER_CUBIC)
        pixels = np.asarray(resized, np.uint8)
    done, data = cv2.imencode(".jpg", pixels[..., ::-1], _ENCODING)
    if not done:
        raise InternalError("The image could not be encoded for the multimodal LLM.")
    return EncodedImage(data.tobytes(), CoordinateFrame(width, height, size, family.coordinates))
