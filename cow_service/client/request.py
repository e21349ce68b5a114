"""What calls send: images in any form, the fields of a request, and the body that they become."""

from __future__ import annotations

import base64
import hashlib
import io
import json
import os
import re
import secrets
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias, cast

import httpx
from pydantic import BaseModel

from cow_service.errors import FieldError, InvalidRequest
from cow_service.records import Artifact, Frame, ImageInfo, JobKind, Record


def to_json(value: Any) -> bytes:
    """JSON of plain values, records and arrays."""
    return json.dumps(value, default=plain, ensure_ascii=False, separators=(",", ":")).encode()


def plain(value: Any) -> Any:
    """A JSON value for a record, a NumPy array or number, or a time; tuples and lists stay."""
    if isinstance(value, BaseModel):
        return value.model_dump(mode="json", exclude_unset=True)
    if hasattr(value, "tolist"):
        return value.tolist()
    if hasattr(value, "isoformat"):
        return (value if value.tzinfo else value.astimezone()).isoformat()
    if isinstance(value, Mapping):
        return dict(value)
    if isinstance(value, list | tuple | str | int | float):
        return value
    raise TypeError(f"{type(value).__name__} cannot be sent; give plain values, records or arrays")


if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray
    from PIL import Image

    from cow_service.requests import ImageArtifact, ImageUrl

    # A text is a path, or a URL where it begins with http://, https:// or data:. Arrays are RGB, see `encoded_array`.
    # A mapping is an image as it stands in a request.
    Pixels: TypeAlias = bytes | bytearray | memoryview | Image.Image | NDArray[np.uint8]
    KnownImage: TypeAlias = Artifact | Frame | ImageInfo | ImageArtifact | ImageUrl
    ImageLike: TypeAlias = str | os.PathLike[str] | Pixels | KnownImage | Mapping[str, str]
else:
    ImageLike = Any

URLS = ("http://", "https://", "data:")
_ALPHA_MODES = {"PA": "RGBA", "RGBa": "RGBA", "La": "LA"}  # modes with alpha that PNG lacks, and those that keep it


def is_url(text: str) -> bool:
    """Whether a text is a URL, and no path."""
    return text[:8].lower().startswith(URLS)


def image_input(image: ImageLike) -> bytes | str | dict[str, str]:
    """How an image is sent: as a file with these bytes, or named in the request: a URL, a data URL, an artifact.

    Raises `OSError` if a file cannot be read, and `InvalidRequest` for anything that is no image.
    """
    sent: bytes | str | dict[str, str] | None = None
    if isinstance(image, str) and is_url(image):
        sent = image if image[:5].lower() == "data:" else {"url": image}
    elif isinstance(image, str | os.PathLike):
        sent = Path(image).read_bytes()
    elif isinstance(image, bytes | bytearray | memoryview):
        sent = bytes(image)
    elif isinstance(image, Mapping):
        sent = dict(image)
    elif isinstance(image, Artifact | Frame | ImageInfo):
        sent = {"artifact": image.sha256}
    elif isinstance(image, Record):
        from cow_service.requests import ImageArtifact, ImageUrl  # noqa: PLC0415 - most calls do not need it

        sent = image.model_dump() if type(image) in (ImageArtifact, ImageUrl) else None
    # Neither library is loaded for this: a program with such an image has loaded it.
    elif hasattr(image, "__array_interface__") and hasattr(image, "dtype"):
        sent = encoded_array(cast("NDArray[np.uint8]", image))
    elif hasattr(image, "save") and hasattr(image, "mode"):
        sent = encoded_picture(cast("Image.Image", image))
    if sent is None:
        raise _wrong(
            f"got {type(image).__name__}; give a path, bytes, a PIL image, an array (height, width, 3) of uint8, a "
            "URL, or an artifact"
        )
    return sent


def encoded_array(array: NDArray[np.uint8]) -> bytes:
    """PNG of an array: (height, width) grey, (height, width, 3) RGB or (height, width, 4) RGBA, uint8."""
    from PIL import Image  # noqa: PLC0415

    shape, kind = tuple(array.shape), str(array.dtype)
    if kind != "uint8" or len(shape) not in (2, 3) or (len(shape) == 3 and shape[2] not in (3, 4)) or 0 in shape:
        raise _wrong(f"is an array {shape} of {kind}; give (height, width) or (height, width, 3 or 4), of uint8 in RGB")
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


def request_fields(options: Mapping[str, Any]) -> dict[str, Any]:
    """The fields; those that are None are left out.

    Raises `InvalidRequest` for two different laws, and what `image_input` raises for a mask.
    """
    fields = {name: value for name, value in options.items() if value is not None}
    if "law" in fields:
        law, motion = fields.pop("law"), dict(plain(fields.get("motion") or {}))
        if motion.get("law", law) != law:
            detail = f"is {motion['law']!r}, and `law` is {law!r}: give one of them"
            raise InvalidRequest(f"`motion.law` {detail}.", errors=(FieldError("/motion/law", detail),))
        fields["motion"] = {**motion, "law": law}
    if "grounding" in fields:
        fields["grounding"] = _with_picture(fields["grounding"], "mask")
    if "objects" in fields:
        fields["objects"] = [_with_picture(given, "mask") for given in fields["objects"]]
    if "depth" in fields:
        fields["depth"] = _with_picture(fields["depth"], "map")
    return fields


def _with_picture(given: Any, name: str) -> Any:
    """A record with the picture that a field holds as JSON has it; unchanged where it has none."""
    picture = given.get(name) if isinstance(given, Mapping) else getattr(given, name, None)
    if picture is None:
        return given
    kind, scale = getattr(getattr(picture, "dtype", None), "kind", ""), dict[str, float]()
    if kind == "b":
        picture = picture.astype("uint8") * 255
    elif kind == "f" and name == "map":  # metres; infinity and what is no number are not known
        if plain(given).get("scale") is not None:
            detail = "is an array of metres, which takes no `scale`: leave it out, or give 16-bit integers"
            raise InvalidRequest(f"`depth.map` {detail}.", errors=(FieldError("/depth/scale", detail),))
        metres = picture.astype("float64")
        known = abs(metres) < MOST_METRES
        metres[~known] = 0.0
        unit = max(float(metres.max(initial=0.0)), 1e-3) / 65535
        picture, scale = (metres.clip(0) / unit).round().astype("uint16"), {"scale": unit}
    shape, dtype = tuple(getattr(picture, "shape", ())), str(getattr(picture, "dtype", "uint16"))
    if name == "map" and (dtype != "uint16" or len(shape) not in (0, 2)):
        detail = f"is an array {shape} of {dtype}; give (height, width) of metres, or of 16-bit integers without a sign"
        raise InvalidRequest(f"`depth.map` {detail}.", errors=(FieldError("/depth/map", detail),))
    if str(getattr(picture, "dtype", "")) == "uint16":
        from PIL import Image  # noqa: PLC0415

        picture = _png(Image.fromarray(picture))
    sent = image_input(picture)
    if isinstance(sent, bytes):
        sent = f"data:image/png;base64,{base64.b64encode(sent).decode()}"
    return {**plain(given), **scale, name: sent}


MOST_METRES = 1000.0  # of a depth map: what lies beyond is as good as unknown, and would coarsen all the rest

MINIMAL = "return=minimal"  # the preference of RFC 7240
_KEY = re.compile(r"[\x21-\x7e]{1,255}")


@dataclass(frozen=True)
class JobRequest:
    """A request for a simulation or an answer: the same bytes and idempotency key in every attempt."""

    kind: JobKind
    content: bytes
    media_type: str
    key: str
    fresh: bool = False
    minimal: bool = False  # the result without its long lists

    def headers(self, prefer: str) -> dict[str, str]:
        """The headers of an attempt; `prefer` says whether the server should wait for the result."""
        return {
            "Content-Type": self.media_type,
            "Idempotency-Key": self.key,
            "Prefer": f"{prefer}, {MINIMAL}" if self.minimal else prefer,
            **({"Cache-Control": "no-cache"} if self.fresh else {}),
        }


def job_request(
    kind: JobKind,
    image: ImageLike,
    question: str,
    options: Mapping[str, Any],
    key: str | None,
    fresh: bool,
    minimal: bool = False,
) -> JobRequest:
    """Encodes a request; without a key it gets a random one.

    Raises what `image_input` and `request_fields` raise, and `InvalidRequest` for a key that no header can hold and for
    text that cannot be encoded.
    """
    if key is not None and not _KEY.fullmatch(key):
        detail = "takes 1 to 255 printable ASCII characters without spaces"
        raise InvalidRequest(f"`idempotency_key` {detail}, got {key[:80]!r}.", errors=(FieldError("", detail),))
    sent = image_input(image)
    fields = request_fields(options)
    try:
        if isinstance(sent, bytes):
            boundary = hashlib.sha256(sent).hexdigest()[:32]  # the same in every attempt, and nothing the image holds
            form = httpx.Request(
                "POST",
                "http://form",
                files={"image": ("image", sent, "application/octet-stream")},
                data={"question": question, "request": to_json(fields).decode()},
                headers={"Content-Type": f"multipart/form-data; boundary={boundary}"},
            )
            content, media_type = form.read(), form.headers["content-type"]
        else:
            content, media_type = to_json({**fields, "image": sent, "question": question}), "application/json"
    except UnicodeEncodeError as error:
        detail = f"holds half of a surrogate pair ({error.object[error.start]!r}), which is no text"
        raise InvalidRequest(f"The request {detail}.", errors=(FieldError("", detail),)) from error
    return JobRequest(kind, content, media_type, key or secrets.token_urlsafe(18), fresh, minimal)
