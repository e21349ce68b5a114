"""The base of all records, and types of the fields that callers fill in: strict numbers, text, points, images."""

import json
import math
from typing import Annotated, Any

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field

Point = tuple[float, float]
BBox = tuple[float, float, float, float]
Vector = tuple[float, float]
Sha256 = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
MAX_NAME = 100  # characters of a backend's name


class Record(BaseModel):
    """A frozen record; unknown fields are an error, so that a misspelt one is never ignored."""

    # Validators are built at first use, so that importing the SDK or the command line stays quick.
    model_config = ConfigDict(frozen=True, extra="forbid", defer_build=True)


def _number(value: Any) -> Any:
    """Numbers only: `true` is not 1 and "81" is not 81, but 81.0 is 81."""
    if isinstance(value, bool | str):
        raise ValueError(f"must be a number, without quotes, got {json.dumps(value)[:40]}")
    return value


def writable(text: str) -> str:
    """Text that every database and file can store."""
    if "\0" in text:
        raise ValueError(f"contains the character NUL (U+0000) at position {text.index(chr(0))}; leave it out")
    return text


def _says_something(text: str) -> str:
    """Text with at least one visible character."""
    if not any(character.isprintable() and not character.isspace() for character in text):
        raise ValueError(f"is empty: it holds only {len(text)} blank or invisible characters")
    return text


Finite = Annotated[float, Field(strict=True, allow_inf_nan=False)]  # strict: no strings, no booleans
WHOLE = BeforeValidator(_number)  # comes after the limits of an integer: in a union, the JSON schema omits later ones
Whole = Annotated[int, WHOLE]
Flag = Annotated[bool, Field(strict=True)]
Words = Annotated[str, AfterValidator(writable), AfterValidator(_says_something)]
Name = Annotated[str, Field(max_length=MAX_NAME)]
# Only the first wrong element of a long list is reported: all of them would fill the memory.
Near = Annotated[Finite, Field(ge=-1e6, le=1e6)]  # px, of a point in the image or not too far from it
Points = Annotated[tuple[tuple[Near, Near], ...], Field(fail_fast=True)]
MAX_OBJECT_WORDS = 200  # characters
MAX_SECONDS = 3600
ObjectWords = Annotated[Words, Field(min_length=1, max_length=MAX_OBJECT_WORDS)]
Seconds = Annotated[Finite, Field(gt=0, le=MAX_SECONDS)]


def _with_area(bbox: BBox) -> BBox:
    if bbox[2] - bbox[0] < 2 or bbox[3] - bbox[1] < 2:
        raise ValueError(f"[x0, y0, x1, y1] must have x1 and y1 at least 2 px beyond x0 and y0, got {list(bbox)}")
    return bbox


def _has_length(direction: Vector) -> Vector:
    if not 1e-9 < math.hypot(*direction) < 1e12:
        raise ValueError(f"[dx, dy] must not have zero length, got {list(direction)}")
    return direction


Box = Annotated[tuple[Finite, Finite, Finite, Finite], AfterValidator(_with_area)]
Direction = Annotated[tuple[Finite, Finite], AfterValidator(_has_length)]
Flags = Annotated[tuple[Flag, ...], Field(fail_fast=True)]


class ImageArtifact(Record):
    """An image that the service already has, by its SHA-256."""

    artifact: Sha256


class ImageUrl(Record):
    """An image for the server to fetch; only from hosts that the server allows."""

    url: str = Field(max_length=4096)


ImageRef = Annotated[str, Field(description="data:image/png;base64,... (PNG, JPEG or WebP)")] | ImageArtifact | ImageUrl


def _no_address(mask: str | ImageArtifact) -> str | ImageArtifact:
    """Masks are drawn by the caller, so none is fetched from a URL."""
    if isinstance(mask, str) and not mask[:5].lower() == "data:":
        raise ValueError('must be a data URL (data:image/png;base64,...) or {"artifact": "<sha256>"}')
    return mask


MaskRef = Annotated[
    Annotated[str, Field(description="data:image/png;base64,...")] | ImageArtifact, AfterValidator(_no_address)
]
