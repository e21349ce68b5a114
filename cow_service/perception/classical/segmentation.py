"""Segments an object with GrabCut: from its box, from a point on it, or from a first guess of its mask."""

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from cow_service.media.masks import bbox_of, mask_iou, outer_contour, outline_of, resized_mask, scaled
from cow_service.media.types import Floats, Floats32, Image, Mask
from cow_service.records import BBox


class CutRules(NamedTuple):
    """How GrabCut is asked for an object.

    Set by hand on rendered scenes and photographs; no single number has a measurement of its own.
    """

    working_side: int = 224  # px: crops are cut at this size, then enlarged
    point_side: int = 1280  # px: an object is looked for around a point in an image of at most this size
    point_working_side: int = 144  # px: the same for the tries around a point
    iterations: int = 2  # of GrabCut
    grow: float = 0.05  # of its size: how far a guess may be from the object, outwards
    shrink: float = 0.04  # and inwards
    least_background: float = 0.15  # of a crop, to learn the background from
    core: float = 0.25  # of the box: the central ellipse that is labelled as sure foreground
    large_core: float = 0.6  # the same for a second try
    span: float = 0.7  # of the box's sides: boxes are tight, so a mask that spans less is cut again with the large core
    gamma: float = 0.5  # brightens what is cut: dark hair on a dark wall differs by few grey levels
    margin: float = 0.25  # of the box, kept around it as sure background
    stability_weight: float = 0.6  # in the score: how much a mask stays the same when more of the image is used
    # half sides tried around a point, of the image's shorter side
    point_reaches: tuple[float, float, float, float, float] = (0.07, 0.11, 0.16, 0.24, 0.34)


CUT = CutRules()


class ObjectRules(NamedTuple):
    """When what was cut out around a point, or lies in a box, is an object.

    Objects of scenes with known truth have an area of 0.009 and more; of their good cuts one in twenty has less on
    edges, most tufts of fur or grass have. Of 135 boxes of floors all are bare; of 32 things that no region shows,
    four.
    """

    area: float = 0.0025  # of the square of the image's shorter side
    on_edge: float = 0.75  # of the outline
    solidity: float = 0.5  # its area as a share of that of its convex hull
    colour_step: int = 6  # 8-bit Lab: colours no further apart are alike
    bare: float = 0.95  # share of pixels whose like is around
    contrast: float = 10.0  # in 8-bit Lab: what lies inside and outside a piece of outline differs by at least this


OBJECT = ObjectRules()


def fault_of(image: Image, mask: Mask) -> str | None:
    """Why a mask [H, W], not empty, that was cut from an image [H, W, 3] can be no whole object, in words."""
    height, width = mask.shape
    bbox = bbox_of(mask)
    if np.count_nonzero(mask) / min(height, width) ** 2 < OBJECT.area:
        return f"what lies there is only {bbox[2] - bbox[0]:.0f} x {bbox[3] - bbox[1]:.0f} px large"
    rows, columns = _crop_around(bbox, width, height)
    scale = min(1.0, CUT.working_side / max(rows.stop - rows.start, columns.stop - columns.start))
    lab = cv2.cvtColor(scaled(image[rows, columns], scale), cv2.COLOR_RGB2LAB).astype(np.float32)
    inside = resized_mask(mask[rows, columns], (lab.shape[1], lab.shape[0]))
    reach = max(1.5, 0.04 * float(np.sqrt(inside.sum())))  # px on either side of the outline that are compared
    means: list[Floats32] = []  # [h, w, 3]: colours near each pixel, inside and outside
    for where in (inside, ~inside):
        weights = where.astype(np.float32)
        summed = cv2.GaussianBlur(lab * weights[..., None], (0, 0), reach)
        means.append(np.asarray(summed / (cv2.GaussianBlur(weights, (0, 0), reach)[..., None] + 1e-4), np.float32))
    apart = np.linalg.norm(means[0] - means[1], axis=2)[outline_of(inside)]
    on_edge = float(np.mean(apart >= OBJECT.contrast)) if apart.size else 0.0
    if on_edge < OBJECT.on_edge:
        return f"only {on_edge:.0%} of the outline of what lies there can be seen"
    largest = outer_contour(inside)
    hull = cv2.contourArea(cv2.convexHull(largest))
    if hull <= 0 or cv2.contourArea(largest) / hull < OBJECT.solidity:
        return "what lies there is ragged, and looks like a part of something"
    return None


def is_bare(image: Image, bbox: BBox) -> bool:
    """Whether the middle of a box has but the colours that are around it: then nothing that stands out is in it."""
    height, width = image.shape[:2]
    x0, y0, x1, y1 = _inside(bbox, width, height)
    rows, columns = _crop_around((x0, y0, x1, y1), width, height)
    lab = cv2.cvtColor(image[rows, columns], cv2.COLOR_RGB2LAB) // OBJECT.colour_step
    inner = _ellipse(height, width, (x0, y0, x1, y1))[rows, columns]
    around = np.ones(inner.shape, bool)
    around[int(y0) - rows.start : int(y1) + 1 - rows.start, int(x0) - columns.start : int(x1) + 1 - columns.start] = (
        False
    )
    known = np.zeros((256 // OBJECT.colour_step + 2,) * 3, bool)
    known[tuple(lab[around].T)] = True
    for axis in range(3):
        known |= np.roll(known, 1, axis) | np.roll(known, -1, axis)
    return bool(known[tuple(lab[inner].T)].mean() >= OBJECT.bare) if inner.any() and around.any() else False


def _crop_around(bbox: BBox, width: int, height: int) -> tuple[slice, slice]:
    """Rows and columns of an image around a box."""
    x0, y0, x1, y1 = bbox
    pad = CUT.margin * max(x1 - x0, y1 - y0) + 6
    rows = slice(max(0, int(y0 - pad)), min(height, int(np.ceil(y1 + pad))))
    return rows, slice(max(0, int(x0 - pad)), min(width, int(np.ceil(x1 + pad))))


def mask_from_bbox(image: Image, bbox: BBox, guess: Mask | None = None) -> Mask:
    """Mask [H, W] of the object in a box, by GrabCut; a guess [H, W] of it makes the cut surer and faster.

    Falls back to the ellipse in the box where colour does not separate the object. Never empty.
    """
    height, width = image.shape[:2]
    x0, y0, x1, y1 = _inside(bbox, width, height)
    rows, columns = _crop_around((x0, y0, x1, y1), width, height)
    crop = image[rows, columns]
    scale = min(1.0, CUT.working_side / max(crop.shape[:2]))
    small = scaled(crop, scale)
    h, w = small.shape[:2]
    box = np.array([x0 - columns.start, y0 - rows.start, x1 - columns.start, y1 - rows.start]) * scale
    if guess is None:
        cut = _grabcut(small, _labels_from_box(h, w, box, CUT.core))
        inside = _tidy(cut, box)
        left, top, right, bottom = bbox_of(inside) if inside.any() else (0.0, 0.0, 0.0, 0.0)
        if right - left < CUT.span * (box[2] - box[0]) or bottom - top < CUT.span * (box[3] - box[1]):
            cut = _grabcut(small, _labels_from_box(h, w, box, CUT.large_core))  # it was a part, such as a face
    else:
        near = cv2.resize(guess[rows, columns].astype(np.uint8), (w, h), interpolation=cv2.INTER_AREA)
        size = float(np.sqrt(near.sum()))
        outer, inner = (
            cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
            for reach in (max(2, int(CUT.grow * size)), max(1, int(CUT.shrink * size)))
        )
        labels = np.full(near.shape, cv2.GC_BGD, np.uint8)
        labels[cv2.dilate(near, outer) > 0] = cv2.GC_PR_BGD
        labels[near > 0] = cv2.GC_PR_FGD
        labels[cv2.erode(near, inner, borderValue=1) > 0] = cv2.GC_FGD
        cut = _grabcut(small, labels)
        # A guess may have missed a highlight: its box is not the object's.
        grow = CUT.grow * float(np.sqrt((box[2] - box[0]) * (box[3] - box[1])))
        box = box + grow * np.array([-1, -1, 1, 1])
    soft = cv2.GaussianBlur(_tidy(cut, box).astype(np.float32), (0, 0), 0.7)
    mask = np.zeros((height, width), bool)
    mask[rows, columns] = cv2.resize(soft, (crop.shape[1], crop.shape[0]), interpolation=cv2.INTER_LINEAR) > 0.5
    share = np.count_nonzero(mask) / max(1.0, (x1 - x0) * (y1 - y0))
    if not 0.12 < share < 1.3:
        mask = guess.copy() if guess is not None else _ellipse(height, width, (x0, y0, x1, y1))
    return mask


def mask_from_point(image: Image, point: tuple[float, float]) -> Mask:
    """Mask [H, W] of the object at a point [x, y]: of several sizes, the one whose outline lies best on edges.

    The sizes are tried in an image of at most `CutRules.point_side`; the best is cut again in the image itself.
    """
    height, width = image.shape[:2]
    small = scaled(image, CUT.point_side / max(height, width))
    at = point[0] * (small.shape[1] / width), point[1] * (small.shape[0] / height)
    tries = [_cut_around(small, at, reach * min(small.shape[:2])) for reach in CUT.point_reaches]
    guess, most = None, 0.0
    for (score, cut), (_, larger) in zip(tries, [*tries[1:], (0.0, None)], strict=True):
        if cut is None:
            continue
        stability = 0.0 if larger is None else mask_iou(cut, larger)
        if guess is None or score + CUT.stability_weight * stability > most + 0.02:
            guess, most = cut, score + CUT.stability_weight * stability
    if guess is None:
        half = CUT.point_reaches[0] * min(height, width)
        box = (point[0] - half, point[1] - half, point[0] + half, point[1] + half)
        return _ellipse(height, width, _inside(box, width, height))
    if small is not image:
        enlarged = cv2.resize(guess.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR)
        guess = np.asarray(enlarged > 0.5)
    return mask_from_bbox(image, bbox_of(guess), guess)


def _cut_around(image: Image, point: tuple[float, float], half: float) -> tuple[float, Mask | None]:
    """One try around a point: how well its outline lies on edges, and the mask [H, W], about `half` px in radius."""
    height, width = image.shape[:2]
    outer = 1.6 * half
    rows = slice(max(0, int(point[1] - outer)), min(height, int(point[1] + outer) + 1))
    columns = slice(max(0, int(point[0] - outer)), min(width, int(point[0] + outer) + 1))
    crop = image[rows, columns]
    scale = min(1.0, CUT.point_working_side / max(crop.shape[:2]))
    small = scaled(crop, scale)
    h, w = small.shape[:2]
    x, y, r = (point[0] - columns.start) * scale, (point[1] - rows.start) * scale, half * scale
    box = _inside((x - r, y - r, x + r, y + r), w, h)
    labels = np.full((h, w), cv2.GC_BGD, np.uint8)
    cv2.rectangle(labels, (int(box[0]), int(box[1])), (int(box[2]), int(box[3])), int(cv2.GC_PR_BGD), -1)
    cv2.circle(labels, (round(x), round(y)), max(3, int(0.6 * r)), int(cv2.GC_PR_FGD), -1)
    cv2.circle(labels, (round(x), round(y)), max(2, int(0.15 * r)), int(cv2.GC_FGD), -1)
    _, parts = cv2.connectedComponents(_grabcut(small, labels).astype(np.uint8), connectivity=4)
    part = parts[min(h - 1, max(0, round(y))), min(w - 1, max(0, round(x)))]
    cut = parts == part
    if not part or cut.sum() < 30:
        return 0.0, None
    lab = cv2.GaussianBlur(cv2.cvtColor(small, cv2.COLOR_RGB2LAB).astype(np.float32), (0, 0), 1.2)
    dx, dy = cv2.Sobel(lab, cv2.CV_32F, 1, 0), cv2.Sobel(lab, cv2.CV_32F, 0, 1)
    edges = np.sqrt((dx * dx + dy * dy).sum(axis=2))
    outline = outline_of(cut)
    on_edge = float(np.minimum(edges[outline] / (float(np.percentile(edges, 90)) + 1e-3), 1.5).mean())
    left, top, right, bottom = bbox_of(cut)
    cramped = float(np.mean([left <= box[0] + 1, top <= box[1] + 1, right >= box[2] - 1, bottom >= box[3] - 1]))
    soft = cv2.resize(cv2.GaussianBlur(cut.astype(np.float32), (0, 0), 0.8), (crop.shape[1], crop.shape[0]))
    mask = np.zeros((height, width), bool)
    mask[rows, columns] = soft > 0.5
    return on_edge - 0.6 * cramped, mask if mask.any() else None


def _inside(bbox: BBox, width: int, height: int) -> BBox:
    """The part of a box inside the image, at least 2 px each way."""
    x0, y0 = min(max(0.0, bbox[0]), width - 2.0), min(max(0.0, bbox[1]), height - 2.0)
    return x0, y0, min(max(bbox[2], x0 + 2), float(width)), min(max(bbox[3], y0 + 2), float(height))


def _labels_from_box(height: int, width: int, box: Floats, core: float) -> NDArray[np.uint8]:
    """GrabCut's labels: background outside the box, probable foreground in its ellipse, sure in the `core` of that."""
    labels = np.full((height, width), cv2.GC_BGD, np.uint8)
    x0, y0, x1, y1 = (int(v) for v in np.round(box))
    labels[max(0, y0) : y1, max(0, x0) : x1] = cv2.GC_PR_BGD
    centre, axes = ((x0 + x1) // 2, (y0 + y1) // 2), (max(1, (x1 - x0) // 2), max(1, (y1 - y0) // 2))
    cv2.ellipse(labels, centre, axes, 0, 0, 360, int(cv2.GC_PR_FGD), -1)
    inner = max(1, int(core * axes[0])), max(1, int(core * axes[1]))
    cv2.ellipse(labels, centre, inner, 0, 0, 360, int(cv2.GC_FGD), -1)
    if np.mean(labels == cv2.GC_BGD) < CUT.least_background:  # the box fills the image: its upper corners must serve
        rise, run = max(2, (y1 - y0) // 7), max(2, (x1 - x0) // 7)
        for corner in (labels[: y0 + rise, : x0 + run], labels[: y0 + rise, x1 - run :]):
            corner[:] = cv2.GC_BGD
    return labels


def _grabcut(image: Image, labels: NDArray[np.uint8]) -> Mask:
    """GrabCut from labels; the labels' own guess where it has nothing to learn from."""
    foreground = cv2.GC_FGD, cv2.GC_PR_FGD
    guess = np.isin(labels, foreground)
    if guess.any() and not guess.all():
        light = np.clip(255 * (image / 255.0) ** CUT.gamma, 0, 255).astype(np.uint8)
        cv2.setRNGSeed(0)  # its clustering draws random numbers: the same image must give the same mask
        no_box, models = (0, 0, 0, 0), (np.zeros((1, 65)), np.zeros((1, 65)))  # labels say it all
        cv2.grabCut(light, labels, no_box, *models, CUT.iterations, cv2.GC_INIT_WITH_MASK)
    return np.isin(labels, foreground)


def _tidy(cut: Mask, box: Floats) -> Mask:
    """Keeps the main blob inside the box, and closes its holes."""
    x0, y0, x1, y1 = box
    kept = np.zeros(cut.shape, np.uint8)
    window = slice(max(0, int(y0) - 1), int(np.ceil(y1)) + 1), slice(max(0, int(x0) - 1), int(np.ceil(x1)) + 1)
    kept[window] = cut[window]
    kept = cv2.morphologyEx(kept, cv2.MORPH_OPEN, np.ones((2, 2), np.uint8))
    if not kept.any():
        return kept.astype(bool)
    whole = cv2.drawContours(np.zeros(cut.shape, np.uint8), [outer_contour(kept > 0)], -1, 1, cv2.FILLED)
    holes = (whole > 0) & (kept == 0)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(holes.astype(np.uint8), connectivity=4)
    for i, area in enumerate(stats[:, 4]):
        if i and area > 0.04 * whole.sum():  # the hole of a handle stays one
            whole[labels == i] = 0
    return whole.astype(bool)


def _ellipse(height: int, width: int, box: BBox) -> Mask:
    mask = np.zeros((height, width), np.uint8)
    centre = round((box[0] + box[2]) / 2), round((box[1] + box[3]) / 2)
    axes = max(1, round((box[2] - box[0]) / 2)), max(1, round((box[3] - box[1]) / 2))
    cv2.ellipse(mask, centre, axes, 0, 0, 360, 1, -1)
    return mask.astype(bool)
