"""Pictures of a simulation as blocks that a model looks at: the overlay, then the frames."""

from __future__ import annotations

import base64
import io

from anyio import to_thread
from mcp_types import ImageContent
from PIL import Image

from cow_service.client import AsyncClient
from cow_service.records import Simulation

MOST = 1024  # px of the longest side: of more, models see no more


async def pictures_of(simulation: Simulation, client: AsyncClient) -> list[ImageContent]:
    """PNGs; downloads them."""
    blocks: list[ImageContent] = []
    for sha256 in (simulation.overlay.sha256, *(frame.sha256 for frame in simulation.frames)):
        shown = await to_thread.run_sync(fit, await client.artifact(sha256))
        blocks.append(ImageContent(data=base64.b64encode(shown).decode(), mime_type="image/png"))
    return blocks


def fit(png: bytes) -> bytes:
    """A PNG of at most `MOST` pixels on its longest side: the same bytes where it is."""
    with Image.open(io.BytesIO(png)) as picture:
        if max(picture.size) <= MOST:
            return png
        small = picture.convert("RGB")
    small.thumbnail((MOST, MOST), Image.Resampling.LANCZOS)
    buffer = io.BytesIO()
    small.save(buffer, "PNG")
    return buffer.getvalue()
