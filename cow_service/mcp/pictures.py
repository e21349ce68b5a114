"""Pictures of a simulation as blocks that a model looks at: the overlay, then the frames."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence

from anyio import to_thread
from mcp_types import ImageContent
from PIL import Image

from cow_service.client import AsyncClient
from cow_service.records import Simulation

MAX_SIDE_PX = 1024  # models do not see more
MAX_BYTES = 500_000  # of all pictures of a result together: in base64 a third more, and clients refuse messages of 1 MB
# Tried in turn when pictures are too large, as PNGs of photographs are: quality of JPEG, scale of the sides.
_SMALLER = ((90, 1.0), (80, 1.0), (75, 0.75), (75, 0.5), (70, 0.35), (60, 0.25), (50, 0.15))
_JPEG, _PNG = "image/jpeg", "image/png"


async def pictures_of(simulation: Simulation, client: AsyncClient) -> list[ImageContent]:
    """Downloads the pictures; as they are where they are small enough together, else JPEGs."""
    names = (simulation.overlay.sha256, *(frame.sha256 for frame in simulation.frames))
    kept = [await client.artifact(sha256) for sha256 in names]
    shown = await to_thread.run_sync(fitted, kept)
    return [ImageContent(data=base64.b64encode(data).decode(), mime_type=media_type) for media_type, data in shown]


def fitted(pictures: Sequence[bytes]) -> list[tuple[str, bytes]]:
    """Media types and pictures of at most `MAX_SIDE_PX` on the longest side and `MAX_BYTES` together."""
    shown = [_fit(picture) for picture in pictures]
    for quality, scale in _SMALLER:
        if sum(len(data) for _, data in shown) <= MAX_BYTES:
            break
        shown = [(_JPEG, _saved(_thumbnail(picture, scale), "JPEG", quality=quality)) for picture in pictures]
    return shown


def _fit(data: bytes) -> tuple[str, bytes]:
    with Image.open(io.BytesIO(data)) as picture:
        media_type = _JPEG if picture.format == "JPEG" else _PNG
        if max(picture.size) <= MAX_SIDE_PX:
            return media_type, data
    kind = "JPEG" if media_type == _JPEG else "PNG"
    return media_type, _saved(_thumbnail(data, 1.0), kind)


def _thumbnail(data: bytes, scale: float) -> Image.Image:
    with Image.open(io.BytesIO(data)) as picture:
        small = picture.convert("RGB")
    side = scale * min(MAX_SIDE_PX, max(small.size))
    small.thumbnail((side, side), Image.Resampling.LANCZOS)
    return small


def _saved(picture: Image.Image, kind: str, **options: int) -> bytes:
    buffer = io.BytesIO()
    picture.save(buffer, kind, **options)
    return buffer.getvalue()
