"""Rates, and what is gained by an arm over another: paired by question and repeat, drawn by scene."""

import math
import statistics
import zlib
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.stats import binomtest
from scipy.stats import t as student_t

from cow_service.evals.items import Observation
from cow_service.records import Record

RESAMPLES = 10_000
CONFIDENCE = 0.95


class Spread(Record):
    """A share of replies, and the standard deviation of those of the repeats (one repeat has none)."""

    mean: float
    sd: float | None


class Rates(Record):
    """What one arm came to on some questions."""

    questions: int = Field(description="Different ones with a reply.")
    replies: int
    failed: int = Field(description="Questions asked without a reply, over all repeats; they count nowhere else.")
    tpr: Spread = Field(description="Right of all; an unreadable reply is not right.")
    nsr: Spread = Field(description="Abstained of all.")
    tpr_as_paper: Spread = Field(description="Right of all as the paper's rules read the replies.")
    unreadable: int
    imagined: float = Field(description="Share of replies that rest on a simulation.")
    refused: float = Field(description="Share of replies for which a simulation was wanted and refused.")


class Gain(Record):
    """What an arm gains over a baseline on the questions that both replied to, as shares of questions."""

    questions: int
    scenes: int
    gain: float
    low: float = Field(description="Lower end of the 95% interval: bootstrap over scenes.")
    high: float
    helped: int = Field(description="Pairs of replies, wrong in the baseline and right in the arm.")
    hurt: int = Field(description="The other way round.")
    discordant: tuple[int, int] = Field(description="Questions right in most repeats of only the arm, the baseline.")
    p: float = Field(description="Exact McNemar test on these questions, two-sided.")
    p_holm: float | None = Field(default=None, description="The same, adjusted over the tasks that are compared.")


class Bin(Record):
    """Told probabilities between two bounds, and how often what they tell of happened."""

    count: int
    told: float = Field(description="Mean of the probabilities.")
    happened: float = Field(description="Share that happened.")


class Calibration(Record):
    """How good the told probabilities are."""

    count: int
    brier: float
    base_brier: float = Field(description="Of one who always tells the share that happened.")
    bins: tuple[Bin, ...]


class Cost(Record):
    """What the replies of an arm cost; sums."""

    replies: int
    calls: int
    input_tokens: int
    output_tokens: int
    seconds: float
    imaginations: int
    money: float | None = Field(default=None, description="In the currency of the price table; null without one.")


def rates(observations: Sequence[Observation]) -> Rates | None:
    """Of one arm; None where nothing was replied to."""
    replied = [each for each in observations if each.failure is None]
    if not replied:
        return None
    return Rates(
        questions=len({each.item for each in replied}),
        replies=len(replied),
        failed=len(observations) - len(replied),
        tpr=_spread(replied, lambda each: each.right),
        nsr=_spread(replied, lambda each: each.abstained),
        tpr_as_paper=_spread(replied, lambda each: each.read_as_paper == each.truth),
        unreadable=sum(each.unreadable for each in replied),
        imagined=statistics.fmean(each.imaginations > 0 for each in replied),
        refused=statistics.fmean(each.refusal is not None for each in replied),
    )


def _spread(observations: Sequence[Observation], is_one: Callable[[Observation], bool]) -> Spread:
    """The share of all replies, and the deviation of the shares of the repeats."""
    by_repeat: dict[int, list[bool]] = defaultdict(list)
    for each in observations:
        by_repeat[each.repeat].append(is_one(each))
    shares = [statistics.fmean(values) for values in by_repeat.values()]
    return Spread(
        mean=statistics.fmean(map(is_one, observations)), sd=statistics.stdev(shares) if len(shares) > 1 else None
    )


def gain(arm: Sequence[Observation], baseline: Sequence[Observation], resamples: int = RESAMPLES) -> Gain | None:
    """Of an arm over a baseline; None where no question was replied to in both.

    The interval is a bootstrap over scenes, studentized, and never narrower than few scenes allow.
    """
    there = {(each.item, each.repeat): each for each in baseline if each.failure is None}
    replied = [each for each in arm if each.failure is None]
    pairs = [(each, there[place]) for each in replied if (place := (each.item, each.repeat)) in there]
    if not pairs:
        return None
    sums: dict[str, list[float]] = defaultdict(lambda: [0.0, 0.0])
    by_item: dict[str, list[tuple[bool, bool]]] = defaultdict(list)
    for one, other in pairs:
        sums[one.scene][0] += one.right - other.right
        sums[one.scene][1] += 1
        by_item[one.item].append((one.right, other.right))
    table = np.array([sums[scene] for scene in sorted(sums)])
    low, high = bootstrap_interval(table, resamples)
    # Whether most replies to a question are right, in the arm and in the baseline.
    majority = [[statistics.fmean(side) > 0.5 for side in zip(*values, strict=True)] for values in by_item.values()]
    won = sum(a and not b for a, b in majority)
    lost = sum(b and not a for a, b in majority)
    return Gain(
        questions=len(by_item),
        scenes=len(table),
        gain=float(table[:, 0].sum() / table[:, 1].sum()),
        low=low,
        high=high,
        helped=sum(one.right and not other.right for one, other in pairs),
        hurt=sum(other.right and not one.right for one, other in pairs),
        discordant=(won, lost),
        p=float(binomtest(won, won + lost).pvalue) if won + lost else 1.0,
    )


def bootstrap_interval(table: NDArray[np.float64], resamples: int = RESAMPLES) -> tuple[float, float]:
    """The 95% interval of a ratio of sums, from a table (clusters, 2) of numerators and denominators.

    A bootstrap-t over clusters with the linearized standard error (Efron and Tibshirani 1993, section 12.5), and at
    least as wide as `_plus_two_interval`: of few clusters, or of nearly equal ones, a bootstrap sees too little. The
    random numbers are fixed by the table.
    """
    count = len(table)
    low, high = _plus_two_interval(table)
    total = table.sum(axis=0)
    ratio = total[0] / total[1]
    error = _standard_error(table, np.ones((1, count)), np.array([ratio]))[0]
    if error > 0:
        draws = np.random.default_rng(zlib.crc32(np.ascontiguousarray(table).tobytes()))
        weights = draws.multinomial(count, np.full(count, 1 / count), size=resamples).astype(np.float64)
        drawn = weights @ table
        ratios = drawn[:, 0] / drawn[:, 1]
        errors = _standard_error(table, weights, ratios)
        usable = errors > 0
        edge = (1 - CONFIDENCE) / 2
        below, above = np.quantile((ratios[usable] - ratio) / errors[usable], [1 - edge, edge])
        low, high = min(low, float(ratio - below * error)), max(high, float(ratio - above * error))
    return max(-1.0, low), min(1.0, high)


def _plus_two_interval(table: NDArray[np.float64]) -> tuple[float, float]:
    """A t interval after one cluster of mean size at -1 and one at 1 were added.

    The same idea as for single shares (Agresti and Coull 1998). One cluster alone says nothing: [-1, 1].
    """
    count, size = len(table), table[:, 1].mean()
    if count < 2:
        return -1.0, 1.0
    more = np.vstack([table, [[size, size], [-size, size]]])
    ratio = more[:, 0].sum() / more[:, 1].sum()
    error = _standard_error(more, np.ones((1, count + 2)), np.array([ratio]))[0]
    reach = float(student_t.ppf((1 + CONFIDENCE) / 2, count - 1)) * error
    return float(ratio - reach), float(ratio + reach)


def _standard_error(
    table: NDArray[np.float64], weights: NDArray[np.float64], ratios: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Of ratios of weighted sums (draws,), linearized: the spread of what each cluster adds to its ratio."""
    count = len(table)
    added = table[None, :, 0] - ratios[:, None] * table[None, :, 1]
    squares = (weights * added**2).sum(axis=1)
    return np.sqrt(squares * count / max(count - 1, 1)) / (weights @ table[:, 1])


def holm(values: Sequence[float]) -> list[float]:
    """p values adjusted for their number (Holm 1979), in the given order."""
    order = np.argsort(values)
    stepped = np.arange(len(values), 0, -1) * np.asarray(values)[order]
    adjusted = np.empty(len(values))
    adjusted[order] = np.minimum(np.maximum.accumulate(stepped), 1.0)
    return adjusted.tolist()


def calibration(observations: Iterable[Observation], bins: int = 10) -> Calibration | None:
    """Of the told probabilities, each item once; None where none was told."""
    told = {
        each.item: (each.probability, each.happens)
        for each in observations
        if each.probability is not None and each.happens is not None
    }
    return calibration_of(list(told.values()), bins) if told else None


def calibration_of(told: Sequence[tuple[float, bool]], bins: int = 10) -> Calibration:
    """Of probabilities and whether what they are about happened: one or more."""
    table = np.array(told, dtype=np.float64)
    base = table[:, 1].mean()
    places = np.minimum((table[:, 0] * bins).astype(int), bins - 1)
    found: list[Bin] = []
    for place in np.unique(places).tolist():
        rows = table[places == place]
        mean, happened = map(float, rows.mean(axis=0))
        found.append(Bin(count=len(rows), told=mean, happened=happened))
    return Calibration(
        count=len(table),
        brier=float(np.mean((table[:, 0] - table[:, 1]) ** 2)),
        base_brier=float(base * (1 - base)),
        bins=tuple(found),
    )


def cost(observations: Sequence[Observation], input_price: float = math.nan, output_price: float = math.nan) -> Cost:
    """Sums over the replies. Prices are per million tokens; without both there is no sum of money."""
    replied = [each for each in observations if each.failure is None]
    given, made = sum(each.input_tokens for each in replied), sum(each.output_tokens for each in replied)
    money = (given * input_price + made * output_price) / 1e6
    return Cost(
        replies=len(replied),
        calls=sum(each.calls for each in replied),
        input_tokens=given,
        output_tokens=made,
        seconds=sum(each.seconds for each in replied),
        imaginations=sum(each.imaginations for each in replied),
        money=None if math.isnan(money) else money,
    )
