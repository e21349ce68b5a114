"""Inpainting: fills the hole after a thin drawing or a whole object is removed from an image."""

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np

from cow_service.media.masks import dilated, scaled_size, three_channels, window_of
from cow_service.media.types import Floats, Floats32, Image, Mask


class FillRules(NamedTuple):
    """How a hole is filled.

    Set by hand on rendered scenes. `benchmarks/backgrounds.py` measures the whole: 1.6 grey levels off behind the
    moving objects of 40 scenes. No single number has a measurement of its own.
    """

    inpaint_radius: int = 4  # px
    wide: float = 0.6  # of the hole's size: so far around it exemplars are looked for
    margin: int = 8  # px around a drawing that inpainting may use
    texture_width: float = 0.2  # of the hole's size: half of what finer detail is texture, not shading
    texture_least: float = 5.0  # px, of the same
    varied: float = 18.0  # grey levels of deviation around a hole: with more, exemplars are copied
    structured: float = 4.0  # the same from a smooth surface
    most_unrest: float = 1.5  # of the detail around the hole: with more, a place shows the edge of something
    rim: float = 0.04  # of the hole's size: next to it the fill fades out, and nothing is learnt
    rim_least: float = 3.0  # px, of the same
    beside: float = 0.15  # of the hole's size: so far around it shading is taken from
    beside_least: float = 6.0  # px, of the same
    most_samples: int = 1500  # pixels of a ring
    shadow_step: float = 14.0  # grey levels
    shadow_reach: float = 0.15  # of the hole's size: so far around it its shadow is looked for
    least_weight: float = 1e-3  # of a pyramid cell known: with less, the coarser level says more
    fade: float = 0.14  # of the hole's size: how far out its shadow is taken away
    fade_most: float = 0.011  # of the image's longer side: and no further
    coarse_side: int = 96  # px: the crop is searched at this size
    tile: int = 9  # px at the coarse size: what one patch fills
    context: int = 5  # px around a tile that must fit
    feather: int = 3  # px over which patches overlap
    blend: int = 2  # px inside a hole over which a fill that was made elsewhere comes in
    seam: int = 6  # px on either side of a hole's rim whose colours are compared
    seam_width: int = 31  # px along the rim: so many are averaged, or texture would count as an error of the fill
    seam_noise: float = 2.0  # grey levels of such a difference that are left alone
    seam_most: float = 24.0  # grey levels of it that are corrected at most


FILL = FillRules()
# In sizes of the hole: where texture is looked for.
SHIFTS = ((1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (-1, 1), (1, -1), (-1, -1))


def erase_drawing(image: Image, mask: Mask) -> Image:
    """The image [H, W, 3] with thin masked strokes inpainted by Telea's method."""
    crop = window_of(mask, FILL.margin)
    if crop is None:
        return image
    result = image.copy()
    result[crop] = cv2.inpaint(image[crop], mask[crop].astype(np.uint8), FILL.inpaint_radius, cv2.INPAINT_TELEA)
    return result


def fill_hole(image: Image, hole: Mask, avoid: Mask | None = None) -> Image:
    """The image [H, W, 3] with a hole [H, W] closed: shading drawn in from the rim, texture copied from next to it.

    Pixels of `avoid` (other objects) give neither shading nor texture, unless nothing else is left. The object's own
    shadow around the hole gives none either; it fades out over the few pixels next to it.
    """
    size = float(np.sqrt(np.count_nonzero(hole)))
    reach = FILL.rim * size + FILL.rim_least + max(FILL.beside_least, FILL.beside * size)
    around = _surroundings(image, hole, avoid, max(round(reach), round(FILL.fade * size)) + 2)
    if around is None:
        return image
    varied = _is_varied(around.source, around.inside, around.trusted)
    if varied:
        around = _surroundings(image, hole, avoid, max(24, int(FILL.wide * size))) or around
    beside = around.trusted & (around.away < reach)
    if not beside.any():
        beside = around.trusted
    shading = push_pull(around.source, beside)
    if varied:
        filled = exemplar_inpaint(around.source, around.inside | (around.away <= around.rim), ~around.trusted, shading)
    else:
        width = 2 * round(max(FILL.texture_least, FILL.texture_width * size)) + 1
        detail = np.abs(shading - cv2.blur(shading, (width, width)))[beside]
        most = FILL.most_unrest * float(np.percentile(detail, 99))
        filled = shading + _texture(image, hole, avoid, around.crop, width, most)
    # It fades out next to the hole, and over a longer way in the object's shadow.
    fade = min(max(3.0, FILL.fade * size), FILL.fade_most * max(image.shape[:2]))
    reaches = np.where(dilated(around.shadow, 5), np.float32(max(fade, around.rim)), np.float32(around.rim))
    share = np.asarray(np.clip(1 - around.away / reaches, 0, 1) * around.known, np.float32)
    share[around.inside] = 1
    result = image.copy()
    mixed = around.source + (filled - around.source) * three_channels(share)
    result[around.crop] = cv2.convertScaleAbs(np.maximum(mixed, 0))
    return result


def blend_fill(image: Image, filled: Image, hole: Mask, avoid: Mask) -> Image:
    """The image [H, W, 3] with its hole [H, W] from another image, in the shading of what lies around the hole.

    Pixels of `avoid` (other objects) say nothing of the shading. Outside the hole nothing changes.
    """
    crop = window_of(hole, FILL.seam + 1)
    if crop is None:
        return image
    inside, source = hole[crop], image[crop].astype(np.float32)
    known = ~(inside | dilated(avoid[crop]))
    new = filled[crop].astype(np.float32)
    beyond, within = (
        cv2.distanceTransform((~there).astype(np.uint8), cv2.DIST_L2, 5) for there in (inside, known)
    )  # px from the hole, and from what is known around it
    around, most = _mean_along(source, known & (beyond <= FILL.seam))
    own, least = _mean_along(new, inside & (within <= FILL.seam))
    seen = inside & (within <= FILL.seam) & (most > FILL.seam_width) & (least > FILL.seam_width)
    if seen.any():
        off = push_pull(np.asarray(around - own, np.float32), seen)
        new += np.sign(off) * np.clip(np.abs(off) - FILL.seam_noise, 0, FILL.seam_most)
    share = three_channels(np.asarray(np.clip(within / (FILL.blend + 1), 0, 1), np.float32))
    result = image.copy()
    mixed = cv2.convertScaleAbs(np.maximum(source + (new - source) * share, 0))
    result[crop] = np.where(inside[..., None], mixed, image[crop])
    return result


def _mean_along(values: Floats32, band: Mask) -> tuple[Floats32, Floats32]:
    """Per pixel, the mean colour [h, w, 3] of what lies next to it in a band [h, w], and how many pixels that are."""
    weight = band.astype(np.float32)
    total = cv2.boxFilter(values * weight[..., None], -1, (FILL.seam_width,) * 2, normalize=False)
    count = cv2.boxFilter(weight, -1, (FILL.seam_width,) * 2, normalize=False)
    return np.asarray(total / np.maximum(count, 1)[..., None], np.float32), np.asarray(count, np.float32)


def shadow_beside(image: Image, hole: Mask, avoid: Mask) -> Mask:
    """What is much darker [H, W] than most right around a hole, not in `avoid`: the shadow of the removed object."""
    found = np.zeros_like(hole)
    around = _surroundings(image, hole, avoid, round(FILL.shadow_reach * float(np.sqrt(np.count_nonzero(hole)))) + 4)
    if around is not None:
        found[around.crop] = around.shadow
    return found


@dataclass(frozen=True)
class _Surroundings:
    """What lies around a hole, in a crop of the image."""

    crop: tuple[slice, slice]
    source: Floats32  # [h, w, 3]
    inside: Mask  # [h, w]: the hole
    known: Mask  # [h, w]: neither the hole nor to be avoided
    trusted: Mask  # [h, w]: of these, neither at the rim nor in the object's shadow
    shadow: Mask  # [h, w]
    away: Floats32  # [h, w] px from the hole
    rim: float  # px: next to the hole nothing is learnt


def _surroundings(image: Image, hole: Mask, avoid: Mask | None, margin: int) -> _Surroundings | None:
    """Within a margin (px) of a hole; None if there is no hole, or nothing else."""
    crop = window_of(hole, margin)
    if crop is None:
        return None
    inside = hole[crop]
    known = ~(inside | avoid[crop]) if avoid is not None else ~inside
    if not known.any():
        known = ~inside
    if not known.any():
        return None
    source = image[crop].astype(np.float32)
    away = np.asarray(cv2.distanceTransform((~inside).astype(np.uint8), cv2.DIST_L2, 5), np.float32)
    rim = max(FILL.rim_least, FILL.rim * float(np.sqrt(np.count_nonzero(inside))))
    # What is much darker than most at the hole's rim is the object's own shadow, no shading to draw in.
    width = 2 * max(3, int(FILL.shadow_reach * np.sqrt(np.count_nonzero(inside)))) + 1
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (width, width))
    shadow = (cv2.dilate(inside.astype(np.uint8), kernel) > 0) & known
    if shadow.any():
        grey = source @ np.full(3, 1 / 3, np.float32)
        shadow &= grey < np.percentile(grey[shadow], 65) - FILL.shadow_step
    trusted = known & ~shadow & (away > rim)
    return _Surroundings(crop, source, inside, known, trusted if trusted.any() else known, shadow, away, rim)


def _is_varied(source: Floats32, inside: Mask, known: Mask) -> bool:
    """Whether what lies around the hole is no plain surface: it has texture, or several colours, or an edge runs in."""
    reach = 2 * max(4, int(0.25 * np.sqrt(np.count_nonzero(inside)))) + 1
    ring = dilated(inside, reach) & known
    if not ring.any():
        return False
    if float(source[ring].std(axis=0).max()) > FILL.varied:
        return True
    ys, xs = np.nonzero(ring)
    every = max(1, len(ys) // FILL.most_samples)
    ys, xs = ys[::every], xs[::every]
    values = np.asarray(cv2.blur(source, (7, 7)), np.float64)[ys, xs]
    terms = quadratic_terms((xs - xs.mean()) / max(1.0, float(xs.std())), (ys - ys.mean()) / max(1.0, float(ys.std())))
    rest = values - terms @ np.linalg.lstsq(terms, values, rcond=None)[0]
    return float(rest.std(axis=0).max()) > FILL.structured  # coarser than texture, from a quadratic surface


def quadratic_terms(u: Floats, v: Floats) -> Floats:
    """The terms [N, 6] of a quadratic surface at coordinates [N]."""
    return np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=1).astype(np.float64)


def push_pull(source: Floats32, known: Mask) -> Floats32:
    """Unknown pixels of [h, w, 3] from known ones: averages down a pyramid, then back up (push-pull)."""
    weight = known.astype(np.float32)
    kept = three_channels(weight)
    levels = [(source * kept, weight)]
    while min(levels[-1][1].shape) > 1 and not (levels[-1][1] > FILL.least_weight).all():
        colours, weights = (np.asarray(cv2.pyrDown(layer), np.float32) for layer in levels[-1])
        levels.append((colours, weights))
    colours, weights = levels[-1]
    value = colours / three_channels(np.maximum(weights, FILL.least_weight))
    for colours, weights in reversed(levels[:-1]):
        coarse = cv2.resize(value, (weights.shape[1], weights.shape[0]), interpolation=cv2.INTER_LINEAR)
        trust = np.where(weights > FILL.least_weight, np.minimum(weights, 1), 0)
        own = np.asarray(trust / np.maximum(weights, FILL.least_weight), np.float32)
        rest = np.asarray(1 - np.minimum(weights, 1), np.float32)
        value = colours * three_channels(own) + coarse * three_channels(rest)
    for _ in range(2):
        value = np.asarray(cv2.GaussianBlur(value, (0, 0), 2.0), np.float32)
        value += (source - value) * kept
    return value


def _texture(
    image: Image, hole: Mask, avoid: Mask | None, crop: tuple[slice, slice], width: int, most: float
) -> Floats32:
    """Detail finer than a width (px) for the crop, from the calmest neighbouring place of the hole's shape.

    Zero where each has detail of more than `most` grey levels: an edge of something else.
    """
    rows, columns = crop
    height, across = hole.shape
    inner = window_of(hole, 2) or crop
    step_y, step_x = inner[0].stop - inner[0].start, inner[1].stop - inner[1].start
    unusable = hole if avoid is None else hole | avoid
    shape, half = hole[inner][::2, ::2], width // 2
    best: tuple[float, tuple[slice, slice]] | None = None
    for sx, sy in SHIFTS:
        y, x = inner[0].start + sy * step_y, inner[1].start + sx * step_x
        place = slice(y, y + step_y), slice(x, x + step_x)
        is_inside = y >= 0 and x >= 0 and y + step_y <= height and x + step_x <= across
        if not is_inside or not shape.any() or (unusable[place][::2, ::2] & shape).any():
            continue
        patch = image[place][::2, ::2].astype(np.float32)  # every other pixel tells enough of its unrest
        unrest = float(np.percentile(np.abs(patch - cv2.blur(patch, (half, half)))[shape], 99))
        if unrest < (most if best is None else best[0]):
            best = unrest, place
    texture = np.zeros((rows.stop - rows.start, columns.stop - columns.start, 3), np.float32)
    if best is not None:
        patch = image[best[1]].astype(np.float32)
        top, left = inner[0].start - rows.start, inner[1].start - columns.start
        texture[top : top + step_y, left : left + step_x] = patch - cv2.blur(patch, (width, width))
    return texture


def exemplar_inpaint(source: Floats32, unknown: Mask, forbidden: Mask, shading: Floats32) -> Floats32:
    """Pixels [h, w, 3] for the unknown ones [h, w], copied from places that are neither unknown nor forbidden.

    Patches are chosen from the rim inwards at a coarse size, where a search is cheap, and copied at full size, so that
    texture stays sharp. `shading`, a smooth first guess of the whole crop, steers the choice, and stays where no patch
    is found. After Criminisi, Perez, Toyama, "Region filling and object removal by exemplar-based inpainting", 2004.
    """
    height, width = unknown.shape
    scale = min(1.0, FILL.coarse_side / max(height, width))
    size = scaled_size(width, height, scale)
    guess = np.where(unknown[..., None], shading, source)
    coarse = np.asarray(cv2.resize(guess, size, interpolation=cv2.INTER_AREA), np.float32)
    todo = cv2.resize(unknown.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.01
    barred = cv2.resize((unknown | forbidden).astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.01
    result, weight = np.zeros_like(source), np.zeros(unknown.shape, np.float32)
    inner, grow = todo.copy(), FILL.feather / scale
    while inner.any():
        depth = cv2.distanceTransform(np.pad(inner, 1).astype(np.uint8), cv2.DIST_L2, 3)[1:-1, 1:-1]
        depth[~inner] = np.inf
        y, x = (int(v) for v in np.unravel_index(int(depth.argmin()), depth.shape))
        tile = _around(y, FILL.tile // 2, coarse.shape[0]), _around(x, FILL.tile // 2, coarse.shape[1])
        offset = _best_offset(coarse, inner, barred, y, x)
        if offset is not None:
            moved = tuple(slice(s.start + o, s.stop + o) for s, o in zip(tile, offset, strict=True))
            coarse[tile] = np.where(inner[tile][..., None], coarse[moved], coarse[tile])
            # The full-size patch, inside the image where it lies and where it is taken from, fades out at its rim.
            shifts = [round(o / scale) for o in offset]
            spans = [
                (max(0, -shift, int(s.start / scale - grow)), min(n, n - shift, int(s.stop / scale + grow)))
                for s, shift, n in zip(tile, shifts, (height, width), strict=True)
            ]
            if all(last > first for first, last in spans):
                ramp_y, ramp_x = (
                    np.minimum(np.minimum(np.arange(1, n + 1), np.arange(n, 0, -1)) / grow, 1.0)
                    for n in (last - first for first, last in spans)
                )
                fade = np.outer(ramp_y, ramp_x).astype(np.float32) ** 2
                there = tuple(slice(first, last) for first, last in spans)
                taken = tuple(slice(s.start + o, s.stop + o) for s, o in zip(there, shifts, strict=True))
                result[there] += source[taken] * fade[..., None]
                weight[there] += fade
        inner[tile] = False
    mixed = result / np.maximum(weight, 1e-6)[..., None]
    return np.where((weight > 1e-3)[..., None], mixed, shading).astype(np.float32)


def _around(centre: int, reach: int, length: int) -> slice:
    return slice(max(0, centre - reach), min(length, centre + reach + 1))


def _best_offset(coarse: Floats32, todo: Mask, barred: Mask, y: int, x: int) -> tuple[int, int] | None:
    """Rows and columns from a tile to the place that fits its surroundings best, or None if there is no place."""
    reach = FILL.tile // 2 + FILL.context
    window = _around(y, reach, coarse.shape[0]), _around(x, reach, coarse.shape[1])
    template = coarse[window]
    trust = np.where(todo[window], 0.05, 1.0).astype(np.float32)  # the smooth guess counts a little
    error = cv2.matchTemplate(coarse, template, cv2.TM_SQDIFF, mask=np.repeat(trust[..., None], 3, axis=2))
    # A place may be used where the tile itself would take no barred pixel.
    tile_y, tile_x = _around(y, FILL.tile // 2, coarse.shape[0]), _around(x, FILL.tile // 2, coarse.shape[1])
    top, left = tile_y.start - window[0].start, tile_x.start - window[1].start
    size = tile_x.stop - tile_x.start, tile_y.stop - tile_y.start
    taken = cv2.boxFilter(barred.astype(np.float32), -1, size, anchor=(0, 0), normalize=False)
    taken = taken[top : top + error.shape[0], left : left + error.shape[1]]
    error[(taken > 0.5) | ~np.isfinite(error)] = np.inf
    best = np.unravel_index(int(error.argmin()), error.shape)
    if not np.isfinite(error[best]):
        return None
    return int(best[0]) - window[0].start, int(best[1]) - window[1].start
