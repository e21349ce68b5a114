"""Fills a large hole in a varied background with patches of its surroundings (exemplar-based, from the rim inwards).

Patches are chosen at a coarse size, where a search is cheap, and copied at full size, so that texture stays sharp.
Source of the idea: Criminisi, Perez, Toyama, "Region filling and object removal by exemplar-based inpainting", 2004.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

COARSE_SIDE = 128  # px: the crop is searched at this size
TILE = 9  # px at the coarse size: what one patch fills
CONTEXT = 5  # px around a tile that must fit
FEATHER = 3  # px over which patches overlap

Floats = NDArray[np.float32]
Mask = NDArray[np.bool_]


def quilt(source: Floats, unknown: Mask, forbidden: Mask, shading: Floats) -> Floats:
    """Pixels [h, w, 3] for the unknown ones [h, w], copied from places that are neither unknown nor forbidden.

    `shading` is a smooth first guess of the whole crop; it stays where no patch can be found, and steers the choice.
    """
    height, width = unknown.shape
    scale = min(1.0, COARSE_SIDE / max(height, width))
    size = max(1, round(width * scale)), max(1, round(height * scale))
    guess = np.where(unknown[..., None], shading, source)
    coarse = np.asarray(cv2.resize(guess, size, interpolation=cv2.INTER_AREA), np.float32)
    todo = cv2.resize(unknown.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.01
    barred = cv2.resize((unknown | forbidden).astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.01
    result, weight = np.zeros_like(source), np.zeros(unknown.shape, np.float32)
    inner = todo.copy()
    while inner.any():
        depth = cv2.distanceTransform(np.pad(inner, 1).astype(np.uint8), cv2.DIST_L2, 3)[1:-1, 1:-1]
        depth[~inner] = np.inf
        y, x = (int(v) for v in np.unravel_index(int(depth.argmin()), depth.shape))
        tile = _around(y, TILE // 2, coarse.shape[0]), _around(x, TILE // 2, coarse.shape[1])
        offset = _best_offset(coarse, inner, barred, y, x)
        if offset is not None:
            _copy(result, weight, source, tile, offset, scale)
            moved = tuple(slice(s.start + o, s.stop + o) for s, o in zip(tile, offset, strict=True))
            coarse[tile] = np.where(inner[tile][..., None], coarse[moved], coarse[tile])
        inner[tile] = False
    mixed = result / np.maximum(weight, 1e-6)[..., None]
    return np.where((weight > 1e-3)[..., None], mixed, shading).astype(np.float32)


def _around(centre: int, reach: int, length: int) -> slice:
    return slice(max(0, centre - reach), min(length, centre + reach + 1))


def _best_offset(coarse: Floats, todo: Mask, barred: Mask, y: int, x: int) -> tuple[int, int] | None:
    """Rows and columns from a tile to the place that fits its surroundings best, or None where there is no place."""
    reach = TILE // 2 + CONTEXT
    window = _around(y, reach, coarse.shape[0]), _around(x, reach, coarse.shape[1])
    template = coarse[window]
    trust = np.where(todo[window], 0.05, 1.0).astype(np.float32)  # the smooth guess counts a little
    error = cv2.matchTemplate(coarse, template, cv2.TM_SQDIFF, mask=np.repeat(trust[..., None], 3, axis=2))
    # A place may be used where the tile itself would take no barred pixel.
    tile_y, tile_x = _around(y, TILE // 2, coarse.shape[0]), _around(x, TILE // 2, coarse.shape[1])
    top, left = tile_y.start - window[0].start, tile_x.start - window[1].start
    counts = cv2.integral(barred.astype(np.uint8))
    rows, columns = error.shape
    y0, y1 = top, top + tile_y.stop - tile_y.start
    x0, x1 = left, left + tile_x.stop - tile_x.start
    taken = (
        counts[y1 : y1 + rows, x1 : x1 + columns]
        - counts[y0 : y0 + rows, x1 : x1 + columns]
        - counts[y1 : y1 + rows, x0 : x0 + columns]
        + counts[y0 : y0 + rows, x0 : x0 + columns]
    )
    error[(taken > 0) | ~np.isfinite(error)] = np.inf
    best = np.unravel_index(int(error.argmin()), error.shape)
    if not np.isfinite(error[best]):
        return None
    return int(best[0]) - window[0].start, int(best[1]) - window[1].start


def _copy(
    result: Floats, weight: Floats, source: Floats, tile: tuple[slice, slice], offset: tuple[int, int], scale: float
) -> None:
    """Adds the full-size patch of a coarse tile, fading out at its rim."""
    height, width = weight.shape
    grow = FEATHER / scale
    y0, y1 = max(0, int(tile[0].start / scale - grow)), min(height, int(tile[0].stop / scale + grow))
    x0, x1 = max(0, int(tile[1].start / scale - grow)), min(width, int(tile[1].stop / scale + grow))
    dy, dx = round(offset[0] / scale), round(offset[1] / scale)
    y0, y1 = max(y0, -dy), min(y1, height - dy)
    x0, x1 = max(x0, -dx), min(x1, width - dx)
    if y1 <= y0 or x1 <= x0:
        return
    ramp_y, ramp_x = (
        np.minimum(np.minimum(np.arange(1, n + 1), np.arange(n, 0, -1)) / grow, 1.0) for n in (y1 - y0, x1 - x0)
    )
    fade = np.outer(ramp_y, ramp_x).astype(np.float32) ** 2
    result[y0:y1, x0:x1] += source[y0 + dy : y1 + dy, x0 + dx : x1 + dx] * fade[..., None]
    weight[y0:y1, x0:x1] += fade
