"""Checks the statistics of `cow eval` by simulation: how often intervals hold the true gain, how often p is below 5%.

    python benchmarks/eval_statistics.py --out benchmarks/results/eval_statistics.json

Each design draws replies whose true gain is known: how many scenes, questions on each, repeats, and how scenes differ
in difficulty and in what looking gains there. Where nothing is gained, p should be below 5% in 5% of the data sets (the
test of the primary question, which must beat each of several placebos, in at most 5%).
"""

import argparse
import json
import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cow_service.evals.statistics import Pairs, primary_gain

WITHIN = 0.02


@dataclass(frozen=True)
class Design:
    """Data sets of one kind."""

    name: str
    scenes: int
    questions: tuple[int, int]  # of a scene, from and to
    repeats: int
    base: tuple[float, float] = (0.5, 0.5)  # how often a scene is right of the image alone, from and to
    gained: float = 0.0  # on the mean of all scenes
    spread: float = 0.0  # of the gains of scenes: one half has so much more, the other so much less
    placebos: int = 1


DESIGNS = (
    Design("60 scenes, a question, once", 60, (1, 1), 1),
    Design("60 scenes, a question, five times", 60, (1, 1), 5),
    Design("60 scenes, easy or hard, five times", 60, (1, 1), 5, base=(0.05, 0.95)),
    Design("40 scenes of 8 questions, scene-wide effects", 40, (8, 8), 1, spread=0.3),
    Design("100 scenes of 4, five times, scene-wide effects", 100, (4, 4), 5, spread=0.2),
    Design("50 scenes of 1 to 12 questions, scene-wide effects", 50, (1, 12), 1, base=(0.3, 0.7), spread=0.25),
    Design("200 scenes of 2, gain 2.4 points", 200, (2, 2), 5, base=(0.2, 0.8), gained=0.024, spread=0.1),
    Design("60 scenes, three times, gain 30 points", 60, (1, 1), 3, gained=0.3),
    Design("24 scenes, once, gain 30 points", 24, (1, 1), 1, gained=0.3),
    Design("60 scenes, three placebos", 60, (1, 1), 3, placebos=3),
)


def trial(design: Design, seed: int) -> tuple[bool, bool]:
    """Whether the interval of one data set holds the true gain, and whether its p is below 5%."""
    draws = np.random.default_rng(seed)
    base = draws.uniform(*design.base, design.scenes)
    own = design.gained + design.spread * draws.choice([-1.0, 1.0], design.scenes)
    sizes = draws.integers(design.questions[0], design.questions[1] + 1, design.scenes) * design.repeats
    scene = np.repeat(np.arange(design.scenes), sizes)  # of each pair of replies

    def right(shares: NDArray[np.float64]) -> NDArray[np.bool_]:
        return draws.random(len(scene)) < np.clip(shares, 0, 1)[scene]

    def pairs(one: NDArray[np.bool_], other: NDArray[np.bool_]) -> Pairs:
        sums = (np.bincount(scene[which], minlength=design.scenes) for which in (one & ~other, other & ~one))
        return np.stack([*sums, sizes], axis=1).astype(np.float64)

    looking = right(base + own)
    found = primary_gain({f"placebo {n}": (pairs(looking, right(base)), design.scenes) for n in range(design.placebos)})
    assert found is not None
    return found.gain.low <= design.gained <= found.gain.high, found.p < 0.05


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sets", type=int, default=2000, help="data sets of each design")
    parser.add_argument("--out", type=Path)
    given = parser.parse_args()
    rows, fails = [], 0
    with ProcessPoolExecutor() as pool:
        for design in DESIGNS:
            told = list(pool.map(partial(trial, design), range(given.sets), chunksize=50))
            held, rejected = (sum(values) / given.sets for values in zip(*told, strict=True))
            nothing = design.gained == 0
            is_kept = held >= 0.95 - WITHIN and (not nothing or rejected <= 0.05 + WITHIN)
            fails += not is_kept
            rows.append({**asdict(design), "sets": given.sets, "covered": held, "rejected": rejected})
            kind = "rejected" if nothing else "power"
            print(f"{design.name:52} covered {held:.3f}  {kind:8} {rejected:.3f}{'' if is_kept else '  NOT KEPT'}")
    if given.out:
        given.out.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
    return int(fails > 0)


if __name__ == "__main__":
    sys.exit(main())
