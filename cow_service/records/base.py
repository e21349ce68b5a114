"""What every record is made of: the base class, and vectors, boxes and artifacts."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

Point = tuple[float, float]
BBox = tuple[float, float, float, float]
Vector = tuple[float, float]
Position = tuple[float, float, float]
State = tuple[float, float, float, float, float, float]
Sha256 = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]


class Record(BaseModel):
    """A frozen record; unknown fields are an error, so that a misspelt one is never ignored."""

    # Validators are built when first used: whoever imports the SDK or the command line must not wait for all of them.
    model_config = ConfigDict(frozen=True, extra="forbid", defer_build=True)


class Artifact(Record):
    """Bytes kept by the service. It names them; it does not hold them."""

    sha256: Sha256
    url: str = Field(description="Path of the bytes on the server that made them.")
    media_type: str
    size: int = Field(ge=0, description="Bytes.")


class ImageInfo(Record):
    """The input image, upright. `sha256` is that of the bytes as they were sent."""

    width: int = Field(gt=0, description="Pixels.")
    height: int = Field(gt=0, description="Pixels.")
    sha256: Sha256
