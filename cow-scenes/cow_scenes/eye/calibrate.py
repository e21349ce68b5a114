"""Makes the eye's confidence a probability, on drawn pictures that were not learned from."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from .decode import Calibration, Eye, Limits, sigmoid
from .evaluate import LEAST_PIXELS, overlaps
from .pictures import Picture
from .room import FIRST_FLAT, FIRST_SUPPORT, FIRST_THING, IGNORED

CENTRES, MEMBERS = (0.2, 0.3, 0.4), (0.4, 0.5, 0.6)
"""Limits that are tried."""
RIDGE = 1.0
"""How strongly the regression's weights are held back, in observations."""
Evidence = dict[bool, tuple[np.ndarray, np.ndarray, int]]
"""By whether things lie flat: evidence (n, 4), best IoU with a true thing (n,), and how many true things there are."""


def gather(eye: Eye, pictures: Sequence[Picture], maps: Sequence[tuple[np.ndarray, np.ndarray]]) -> Evidence:
    """What an eye that reports everything finds in the maps of pictures, beside the truth."""
    rows: dict[bool, list[tuple[np.ndarray, float]]] = {False: [], True: []}
    counts = {False: 0, True: 0}
    for picture, (fine, coarse) in zip(pictures, maps, strict=True):
        found = eye.interpret(fine, coarse, *picture.ids.shape).instances
        size = np.bincount(picture.ids.ravel(), minlength=256)
        for is_flat, first, limit in ((False, FIRST_THING, FIRST_FLAT), (True, FIRST_FLAT, FIRST_SUPPORT)):
            truths = [picture.ids == k for k in range(first, limit) if size[k] >= LEAST_PIXELS]
            counts[is_flat] += len(truths)
            ignored = np.isin(picture.ids, [IGNORED, *(k for k in range(first, limit) if size[k] < LEAST_PIXELS)])
            chosen = [t for t in found if t.is_flat == is_flat and (t.mask & ignored).sum() < 0.3 * t.mask.sum()]
            table = overlaps(truths, [thing.mask for thing in chosen])
            rows[is_flat] += [
                (thing.evidence, best) for thing, best in zip(chosen, table.max(0, initial=0), strict=True)
            ]
    return {
        is_flat: (
            np.array([evidence for evidence, _ in found]).reshape(-1, 4),
            np.array([best for _, best in found]),
            counts[is_flat],
        )
        for is_flat, found in rows.items()
    }


def fit(evidence: np.ndarray, is_true: np.ndarray) -> Calibration:
    """The logistic regression, by Newton's steps."""
    inputs, weights = np.c_[np.ones(len(evidence)), evidence], np.array([0.0, 1.0, 0.5, 0.0, 0.0])
    prior, hold = weights.copy(), RIDGE * np.eye(5)
    for _ in range(30):
        expected = sigmoid(inputs @ weights)
        slope = inputs.T @ (is_true - expected) - hold @ (weights - prior)
        curve = (inputs * (expected * (1 - expected))[:, None]).T @ inputs + hold
        weights = weights + np.linalg.solve(curve, slope)
    return Calibration(*(round(float(w), 4) for w in weights))


def best_probability(told: np.ndarray, is_true: np.ndarray, wanted: int) -> tuple[float, float]:
    """The least probability to report, which makes F2 largest, and that F2.

    Recall counts twice as much as precision: what is reported says how probable it is, what is missed says nothing.
    """
    choices = np.linspace(0.1, 0.8, 15)
    scores = [5 * is_true[told >= c].sum() / max(1, (told >= c).sum() + 4 * wanted) for c in choices]
    return round(float(choices[int(np.argmax(scores))]), 2), float(max(scores))


def calibrated(eye: Eye, pictures: Sequence[Picture]) -> tuple[Limits, dict[bool, Calibration]]:
    """The limits with the best F2 of standing things at an IoU of 0.75, and the calibrations that go with them."""
    best: tuple[float, Limits, dict[bool, Calibration]] | None = None
    maps = [eye.maps(picture.image) for picture in pictures]
    for centre in CENTRES:
        for member in MEMBERS:
            eye.limits = Limits(centre=centre, member=member, probability=0.0)
            evidence = gather(eye, pictures, maps)
            fits = {is_flat: fit(values, best >= 0.5) for is_flat, (values, best, _) in evidence.items()}
            values, matches, wanted = evidence[False]
            told = np.array([fits[False].probability(v) for v in values])
            least, _ = best_probability(told, matches >= 0.5, wanted)
            score = 5 * (matches[told >= least] >= 0.75).sum() / max(1, (told >= least).sum() + 4 * wanted)
            if best is None or score > best[0]:
                best = score, replace(eye.limits, probability=least), fits
    assert best is not None
    return best[1], best[2]
