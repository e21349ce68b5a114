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
# Tried in turn when PNGs are too large, as those of photographs are: quality of JPEG, scale of the sides.
_SMALLER = ((90, 1.0), (80, 1.0), (75, 0.75), (75, 0.5), (70, 0.35), (60, 0.25), (50, 0.15))


async def pictures_of(simulation: Simulation, client: AsyncClient) -> list[ImageContent]:
    """Downloads the pictures; PNGs where they are small enough together, else JPEGs."""
    names = (simulation.overlay.sha256, *(frame.sha256 for frame in simulation.frames))
    kept = [await client.artifact(sha256) for sha256 in names]
    media_type, shown = await to_thread.run_sync(fitted, kept)
    return [ImageContent(data=base64.b64encode(data).decode(), mime_type=media_type) for data in shown]


def fitted(pngs: Sequence[bytes]) -> tuple[str, list[bytes]]:
    """The media type, and pictures of at most `MAX_SIDE_PX` on the longest side and `MAX_BYTES` together."""
    shown = [_fit(png) for png in pngs]
    media_type = "image/png"
    for quality, scale in _SMALLER:
        if sum(map(len, shown)) <= MAX_BYTES:
            break
        media_type, shown = "image/jpeg", [_jpeg(png, quality, scale) for png in pngs]
    return media_type, shown


def _fit(png: bytes) -> bytes:
    with Image.open(io.BytesIO(png)) as picture:
        if max(picture.size) <= MAX_SIDE_PX:
            return png
    return _saved(_thumbnail(png, 1.0), "PNG")


def _jpeg(png: bytes, quality: int, scale: float) -> bytes:
    return _saved(_thumbnail(png, scale), "JPEG", quality=quality)


def _thumbnail(png: bytes, scale: float) -> Image.Image:
    with Image.open(io.BytesIO(png)) as picture:
        small = picture.convert("RGB")
    side = scale * min(MAX_SIDE_PX, max(small.size))
    small.thumbnail((side, side), Image.Resampling.LANCZOS)
    return small


def _saved(picture: Image.Image, kind: str, **options: int) -> bytes:
    buffer = io.BytesIO()
    picture.save(buffer, kind, **options)
    return buffer.getvalue()
