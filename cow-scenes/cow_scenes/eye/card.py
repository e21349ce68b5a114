"""The card of the weights: what they are, how they were made, what was measured, and what they cannot see."""

import hashlib
import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

from .decode import Calibration, Limits

LARGEST = 3_000_000
"""Bytes that the weights may have."""
ABOUT = (
    "Finds things, supports, what lies flat and what is drawn over a picture. Input `picture` (1, 3, h, w) RGB of 0 to "
    "1, sides multiples of 32, best 640x384. Output `fine` (1, 6, h/2, w/2): logits of other, support, flat, thing, "
    "which exclude each other, of drawn, and of the rim of a thing. Output `coarse` (1, 7, h/4, w/4): logit of a "
    "thing's centre, offset to it (down, right; in units of 32 pixels), logarithm of the inverse depth up to a "
    "constant, normal of the plane (right, down, forward). `cow_scenes/eye/decode.py` makes instances of them with "
    "NumPy and OpenCV."
)
DATA = (
    "Pictures that `cow-scenes eye draw` draws with MuJoCo: 35 kinds of shapes from code, supports, furniture, light "
    "and film by chance. No photograph, but pieces of six pictures of scikit-image's wheel as textures (camera, cell, "
    "hubble_deep_field, ihc, moon, retina; CC0 or in the public domain). No scene, seed or mesh of the families that "
    "it is measured on."
)
CANNOT_SEE = [
    "Names, colours or kinds: it says where something is, not what.",
    "People, animals and machines in photographs. Of those that were tried it outlined all of 24 coins and a coffee "
    "cup, but of two people the heads, of a motorcycle the wheels, of a cat the eyes, one of several fish, no giraffe.",
    "Things smaller than about 12 pixels at 640x384, and glass, smoke or liquids without a vessel.",
    "Where one thing ends and another begins, if they touch and look alike. A thing of two colours may be two.",
    "That the head of a drawn arrow, or a ghost of a trail, is no thing: most masks of nothing in the first family.",
    "A thing as large as a piece of furniture, which it takes for furniture.",
    "Rugs, papers and shadows as well as things: one flat thing in four is found.",
]


def digest(path: Path) -> str:
    """The SHA-256 of a file in hexadecimal."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def write_card(
    weights: Path,
    limits: Limits,
    calibrations: dict[bool, Calibration],
    recipe: dict[str, Any],
    measured: dict[str, Any],
) -> Path:
    """Write `NAME.json` beside the weights."""
    card = {
        "name": weights.name,
        "licence": "Apache-2.0",
        "sha256": digest(weights),
        "bytes": weights.stat().st_size,
        "about": ABOUT,
        "data": DATA,
        "recipe": recipe,
        "limits": asdict(limits),
        "calibration": {"standing": asdict(calibrations[False]), "flat": asdict(calibrations[True])},
        "measured": measured,
        "cannot see": CANNOT_SEE,
    }
    path = weights.with_suffix(".json")
    path.write_text(json.dumps(card, indent=2, ensure_ascii=False) + "\n")
    return path
