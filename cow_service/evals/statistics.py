"""Rates, and the gain of an arm over another: paired by question and repeat, clustered by scene."""

import math
import statistics
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy import stats

from cow_service.evals.items import Observation
from cow_service.records import Record

ALPHA, POWER = 0.05, 0.8
Pairs = NDArray[np.float64]  # (scenes, 3): pairs of replies in which the arm alone is right, the baseline alone; all


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
    low: float = Field(description="Lower end of the 95% interval, clustered by scene.")
    high: float
    helped: int = Field(description="Pairs of replies, wrong in the baseline and right in the arm.")
    hurt: int = Field(description="The other way round.")
    sd: float = Field(description="Standard deviation of the scenes' mean differences.")
    p: float = Field(description="Two-sided; the signs of whole scenes' differences are permuted.")
    p_holm: float | None = Field(default=None, description="The same, adjusted over all contrasts that are shown.")


class PrimaryGain(Record):
    """The primary question: what simulated frames gain over the strongest placebo."""

    placebo: str = Field(description="The strongest: the one with most right replies.")
    gain: Gain = Field(description="Over it. Its interval holds whichever placebo is strongest in truth.")
    p: float = Field(description="The largest of all placebos where all gains have one sign, else 1.")


class Bin(Record):
    """Predicted probabilities between two bounds, and how often the event happened."""

    count: int
    told: float = Field(description="Mean of the probabilities.")
    happened: float = Field(description="Share that happened.")


class Calibration(Record):
    """How good the predicted probabilities are."""

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
    """Of one arm; None if nothing was replied to."""
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
    sd = statistics.stdev(shares) if len(shares) > 1 else None
    return Spread(mean=statistics.fmean(map(is_one, observations)), sd=sd)


def pairs_of(arm: Sequence[Observation], baseline: Sequence[Observation]) -> tuple[Pairs, int]:
    """What both replied to, by scene, and how many questions that are; failed questions count in neither."""
    there = {(each.item, each.repeat): each for each in baseline if each.failure is None}
    replied = [each for each in arm if each.failure is None]
    both = [(each, there[place]) for each in replied if (place := (each.item, each.repeat)) in there]
    sums: dict[str, Pairs] = defaultdict(lambda: np.zeros(3))
    for one, other in both:
        sums[one.scene] += (one.right and not other.right, other.right and not one.right, 1)
    table = np.array([sums[scene] for scene in sorted(sums)]).reshape(-1, 3)
    return table, len({one.item for one, _ in both})


def gain(arm: Sequence[Observation], baseline: Sequence[Observation]) -> Gain | None:
    """Of an arm over a baseline; None if no question was replied to in both."""
    pairs, questions = pairs_of(arm, baseline)
    return gain_of(pairs, questions) if len(pairs) else None


def gain_of(pairs: Pairs, questions: int) -> Gain:
    """The gain, its 95% interval and its p, all with the scenes as clusters."""
    helped, hurt, count = pairs.T
    difference = helped - hurt
    low, high = cluster_interval(pairs)
    return Gain(
        questions=questions,
        scenes=len(pairs),
        gain=float(difference.sum() / count.sum()),
        low=low,
        high=high,
        helped=int(helped.sum()),
        hurt=int(hurt.sum()),
        sd=float(np.std(difference / count, ddof=1)) if len(pairs) > 1 else 0.0,
        p=sign_flip_p(difference),
    )


def sign_flip_p(differences: NDArray[np.float64]) -> float:
    """Two-sided p of the scenes' differences (scenes,), which are whole numbers.

    Where nothing is gained, each difference is as likely with the other sign: this is the exact test of that. It
    permutes whole scenes, so questions on one scene may depend on each other. With one question and one reply per scene
    it is McNemar's exact test.
    """
    steps = np.abs(differences[differences != 0]).astype(np.int64)
    law = np.ones(1)  # of the sum of those before, from its least value in steps of 2
    for step in steps.tolist():
        law = (np.pad(law, (0, step)) + np.pad(law, (step, 0))) / 2
    sums = 2 * np.arange(len(law)) - len(law) + 1
    return min(1.0, float(law[np.abs(sums) >= abs(differences.sum()) - 0.5].sum()))


def primary_gain(placebos: Mapping[str, tuple[Pairs, int]]) -> PrimaryGain | None:
    """Of an arm over the strongest of its placebos, by their names: pairs of replies and questions as of `pairs_of`.

    None if there is no placebo, or one without replies. Which placebo is the strongest is found out from the same
    replies, so one must not only test against that: the gain is one where each placebo is beaten (an intersection-union
    test, Berger 1982). The lower end of the interval is the lowest of all, the upper one the lowest of those with their
    error shared among the placebos.
    """
    if not placebos or not all(len(pairs) for pairs, _ in placebos.values()):
        return None
    found = {name: gain_of(*both) for name, both in placebos.items()}
    strongest = min(found, key=lambda name: found[name].gain)
    low = min(each.low for each in found.values())
    high = min(cluster_interval(pairs, ALPHA / len(found))[1] for pairs, _ in placebos.values())
    one_sign = len({math.copysign(1, each.gain) for each in found.values() if each.gain}) == 1
    return PrimaryGain(
        placebo=strongest,
        gain=found[strongest].model_copy(update={"low": low, "high": max(low, high)}),
        p=max(each.p for each in found.values()) if one_sign else 1.0,
    )


def _quantiles(placebos: int) -> float:
    """The sum of the normal quantiles of level and power: each placebo may fail to be beaten in its share of cases."""
    return float(stats.norm.ppf(1 - ALPHA / 2) + stats.norm.ppf(1 - (1 - POWER) / placebos))


def scenes_needed(effect: float, variance: float, placebos: int) -> int:
    """How many scenes show a gain (a share) over each of several placebos with a power of 80% at 5%, two-sided.

    At most: if all placebos are equally strong, and their replies independent. `variance` is that of the scenes' mean
    differences: of one question and reply each, at most the share of discordant pairs.
    """
    return math.ceil(variance * (_quantiles(placebos) / effect) ** 2)


def effect_shown(scenes: int, variance: float, placebos: int) -> float:
    """The gain that a number of scenes shows; the inverse of `scenes_needed`."""
    return _quantiles(placebos) * math.sqrt(variance / scenes)


def power_of(effect: float, variance: float, scenes: int, placebos: int) -> float:
    """A lower bound of the probability that a number of scenes shows a gain; see `scenes_needed`."""
    missed = stats.norm.sf(effect * math.sqrt(scenes / variance) - stats.norm.ppf(1 - ALPHA / 2))
    return max(0.0, float(1 - placebos * missed))


def upper_variance(sd: float, scenes: int) -> float:
    """A variance that is exceeded in one of five cases, from the standard deviation of a number of scenes."""
    return sd**2 * (scenes - 1) / float(stats.chi2.ppf(0.2, scenes - 1))


def cluster_interval(pairs: Pairs, alpha: float = ALPHA) -> tuple[float, float]:
    """The interval of a gain that leaves out `alpha` / 2 at each side. One scene alone says nothing: [-1, 1].

    A t interval with the standard error of clusters. So that it holds where scenes are few, or where nearly all agree,
    a scene at -1 and one at +1 are added first, as is done for single shares (Agresti and Coull 1998). They are as
    large as the pairs of replies that tell as much as one that stands alone: the design effect, the factor by which the
    replies of a scene go together.
    """
    scenes = len(pairs)
    if scenes < 2:
        return -1.0, 1.0
    helped, hurt, count = pairs.T
    values = np.stack([helped - hurt, count], axis=1)
    total, size = count.sum(), count.mean()
    ratio = values[:, 0].sum() / total
    alone = ((helped + hurt).sum() / total - ratio**2) / total  # its variance, if replies did not go together
    effect = min(max(_standard_error(values, ratio) ** 2 / alone, 1.0), size) if alone > 0 else size
    more = np.vstack([values, [[effect, effect], [-effect, effect]]])
    middle = more[:, 0].sum() / more[:, 1].sum()
    reach = float(stats.t.ppf(1 - alpha / 2, scenes - 1)) * _standard_error(more, middle)
    return max(-1.0, float(middle - reach)), min(1.0, float(middle + reach))


def _standard_error(table: NDArray[np.float64], ratio: float) -> float:
    """Of the ratio of the sums of two columns, linearized: the spread of what each cluster adds to it."""
    count = len(table)
    squares = ((table[:, 0] - ratio * table[:, 1]) ** 2).sum()
    return float(np.sqrt(squares * count / (count - 1)) / table[:, 1].sum())


def holm(values: Sequence[float]) -> list[float]:
    """p values adjusted for their number (Holm 1979), in the given order."""
    order = np.argsort(values)
    stepped = np.arange(len(values), 0, -1) * np.asarray(values)[order]
    adjusted = np.empty(len(values))
    adjusted[order] = np.minimum(np.maximum.accumulate(stepped), 1.0)
    return adjusted.tolist()


def calibration(observations: Iterable[Observation], bins: int = 10) -> Calibration | None:
    """Calibration of the predicted probabilities, each item once; None if there are none."""
    told = {
        each.item: (each.probability, each.happens)
        for each in observations
        if each.probability is not None and each.happens is not None
    }
    return calibration_of(list(told.values()), bins) if told else None


def calibration_of(told: Sequence[tuple[float, bool]], bins: int = 10) -> Calibration:
    """Calibration of one or more probabilities and whether their events happened."""
    table = np.array(told, dtype=np.float64)
    base = table[:, 1].mean()
    places = np.minimum((table[:, 0] * bins).astype(int), bins - 1)
    binned = (table[places == place] for place in np.unique(places))
    found = [Bin(count=len(rows), told=rows[:, 0].mean(), happened=rows[:, 1].mean()) for rows in binned]
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
