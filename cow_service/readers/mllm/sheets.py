"""Fits the images of a call to what a server takes: few images, or a small body.

Where a call takes fewer images than there are, frames share one contact sheet. Where a body is too large, frames are
made smaller first, then fewer; at last the first image is compressed more. It keeps its size, as places are told in it.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from cow_service.media.images import decode_own, encode_jpeg
from cow_service.media.overlay import named_strip
from cow_service.records import ServerCapabilities

FEWER_FRAMES = 3  # reductions from which only the first, middle and last frame are sent
AFTER_FIRST = "All images after the first are on one sheet, from left to right and row by row."
SMALLER_NOTE = "The multimodal LLM's server takes no larger requests, so images were made smaller"
SHEET_NOTE = "The multimodal LLM's server takes fewer images a call: frames were sent on one sheet."
QUALITIES = {FEWER_FRAMES + 1: 80, FEWER_FRAMES + 2: 60}  # JPEG, percent, of the first image by reduction


@dataclass(frozen=True)
class FittedImages:
    """The images (JPEG) of a call, and what was changed."""

    jpegs: tuple[bytes, ...]
    caption: str = ""  # for the model: how images are laid out
    note: str = ""  # for the caller


def fit_images(jpegs: Sequence[bytes], takes: ServerCapabilities) -> FittedImages:
    """The images of a call, the first of which is the picture itself, as a server takes them. CPU work."""
    most = len(jpegs) if takes.images is None else takes.images
    if len(jpegs) <= most and (not takes.reduction or (len(jpegs) == 1 and takes.reduction <= FEWER_FRAMES)):
        return FittedImages(tuple(jpegs))
    first, *frames = map(decode_own, jpegs)
    captions, notes = list[str](), list[str]()
    if takes.reduction:
        if takes.reduction >= FEWER_FRAMES and len(frames) > FEWER_FRAMES:
            middle, last = len(frames) // 2, len(frames) - 1
            captions.append(f"Of the {len(frames)} frames these are numbers 1, {middle + 1}, {last + 1}.")
            frames = [frames[0], frames[middle], frames[last]]
        notes.append(f"{SMALLER_NOTE}{' and frames fewer' if captions else ''}.")
        scale = 0.5 ** min(takes.reduction, FEWER_FRAMES - 1)
        frames = [_resized(each, round(scale * each.shape[1]), round(scale * each.shape[0])) for each in frames]
    if len(frames) >= most:
        if most == 1:
            first, frames = sheet_of([first, *frames], 1), []
        else:
            frames = [sheet_of(frames, 2)]
        captions.append(AFTER_FIRST if frames else AFTER_FIRST.replace(" after the first", ""))
        notes.insert(0, SHEET_NOTE)
    quality = QUALITIES.get(takes.reduction)
    encoded = encode_jpeg(first) if quality is None else encode_jpeg(first, quality)
    return FittedImages((encoded, *map(encode_jpeg, frames)), " ".join(captions), " ".join(notes))


def sheet_of(images: Sequence[NDArray[np.uint8]], begin: int) -> NDArray[np.uint8]:
    """Images [h, w, 3] in rows, each at the size of the smallest; the first has the number `begin`."""
    height, width = min((each.shape[:2] for each in images), key=lambda size: size[0] * size[1])
    name = f"Images {begin} to {begin + len(images) - 1}, row by row"
    return named_strip([_resized(each, width, height) for each in images], name)


def _resized(pixels: NDArray[np.uint8], width: int, height: int) -> NDArray[np.uint8]:
    return np.asarray(cv2.resize(pixels, (width, height), interpolation=cv2.INTER_AREA), np.uint8)
