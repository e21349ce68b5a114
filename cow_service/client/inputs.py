"""Images as callers give them: a file, bytes, a PIL image, an array, a URL, or an artifact of the server."""

from __future__ import annotations

import io
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias, cast

from cow_service.errors import FieldError, InvalidRequest
from cow_service.records import Artifact, Frame, ImageInfo, Record

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray
    from PIL import Image

    from cow_service.requests import ImageArtifact, ImageUrl

    # A text is a path, or a URL where it begins with http://, https:// or data:. Arrays are RGB, see `encoded_array`.
    ImageLike: TypeAlias = (
        str
        | os.PathLike[str]
        | bytes
        | bytearray
        | memoryview
        | Image.Image
        | NDArray[np.uint8]
        | Artifact
        | Frame
        | ImageInfo
        | ImageArtifact
        | ImageUrl
        | Mapping[str, str]  # as it stands in a request
    )
else:
    ImageLike = Any

URLS = ("http://", "https://", "data:")
_ALPHA_MODES = {"PA": "RGBA", "RGBa": "RGBA", "La": "LA"}  # modes with alpha that PNG lacks, and those that keep it


def is_url(text: str) -> bool:
    """Whether a text is a URL, and no path."""
    return text[:8].lower().startswith(URLS)


@dataclass(frozen=True)
class Upload:
    """An image to be sent as a file. It holds the bytes themselves, so that every attempt sends the same."""

    data: bytes


@dataclass(frozen=True)
class Reference:
    """An image that the request names: a URL, a data URL or an artifact."""

    json: str | dict[str, str]


def image_input(image: ImageLike) -> Upload | Reference:
    """How an image is sent.

    Raises `OSError` where a file cannot be read, and `InvalidRequest` for anything that is no image.
    """
    if isinstance(image, str) and is_url(image):
        return Reference(image if image[:5].lower() == "data:" else {"url": image})
    if isinstance(image, str | os.PathLike):
        return Upload(Path(image).read_bytes())
    if isinstance(image, bytes | bytearray | memoryview):
        return Upload(bytes(image))
    if isinstance(image, Mapping | Record) and (reference := _reference(image)) is not None:
        return reference
    # Neither library is loaded for this: whoever has such an image has loaded it.
    if hasattr(image, "__array_interface__") and hasattr(image, "dtype"):
        return Upload(encoded_array(cast("NDArray[np.uint8]", image)))
    if hasattr(image, "save") and hasattr(image, "mode"):
        return Upload(encoded_picture(cast("Image.Image", image)))
    raise _wrong(
        f"got {type(image).__name__}; give a path, bytes, a PIL image, an array (height, width, 3) of uint8, a URL, or "
        "an artifact"
    )


def _reference(image: Mapping[str, str] | Record) -> Reference | None:
    from cow_service.requests import ImageArtifact, ImageUrl  # noqa: PLC0415 - not needed to import the SDK

    if isinstance(image, Mapping):
        return Reference(dict(image))
    if isinstance(image, Artifact | Frame | ImageInfo):
        return Reference({"artifact": image.sha256})
    return Reference(image.model_dump()) if isinstance(image, ImageArtifact | ImageUrl) else None


def encoded_array(array: NDArray[np.uint8]) -> bytes:
    """PNG of an array: (height, width) grey, (height, width, 3) RGB or (height, width, 4) RGBA, uint8."""
    from PIL import Image  # noqa: PLC0415

    shape, kind = tuple(array.shape), str(array.dtype)
    if kind != "uint8" or len(shape) not in (2, 3) or (len(shape) == 3 and shape[2] not in (3, 4)) or 0 in shape:
        raise _wrong(
            f"is an array {shape} of {kind}; give (height, width), or (height, width, 3 or 4), of uint8 in RGB"
        )
    return _png(Image.fromarray(array))


def encoded_picture(picture: Image.Image) -> bytes:
    """PNG of a PIL image, upright: its EXIF orientation is applied, and no EXIF sent."""
    from PIL import ImageOps  # noqa: PLC0415

    if 0 in picture.size or picture.mode in ("I", "F"):
        raise _wrong(
            f"is a PIL image {picture.size} of mode {picture.mode}; give one of at least one pixel, of 8 or 16 bits a "
            "channel: of I and F nothing says what is white"
        )
    upright = ImageOps.exif_transpose(picture)
    if upright.mode.startswith("I;16"):
        upright = upright.convert("I").convert("I;16")
    elif upright.mode in _ALPHA_MODES:
        upright = upright.convert(_ALPHA_MODES[upright.mode])
    elif upright.mode not in ("1", "L", "LA", "P", "RGB", "RGBA"):
        upright = upright.convert("RGB")
    return _png(upright)


def _png(picture: Image.Image) -> bytes:
    buffer = io.BytesIO()
    # Speed matters more than size: it is sent once. An ICC profile would be that of the mode before conversion.
    picture.save(buffer, "PNG", compress_level=1, icc_profile=None)
    return buffer.getvalue()


def _wrong(detail: str) -> InvalidRequest:
    return InvalidRequest(f"`image` {detail}.", errors=(FieldError("/image", detail),))
