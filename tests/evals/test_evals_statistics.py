"""Rates and gains, against values known from the literature and against draws whose true gain is known."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from conftest import ROOT, SCALE
from hypothesis import given
from hypothesis import strategies as st

from cow_service.evals.items import Observation


@pytest.fixture(scope="module")
def statistics() -> Any:
    """What is tested; scipy comes with it."""
    from cow_service.evals import statistics

    return statistics


def seen(item: str, arm: str, repeat: int, read: str | None, **known: Any) -> Observation:
    fields = {"task": "collision", "level": "L1", "scene": item, "options": ("A", "B", "C"), "abstain": "C"}
    asked = {"item": item, "arm": arm, "repeat": repeat, "truth": "A"}
    return Observation.model_validate({**fields, **asked, "reply": "", "read": read, "read_as_paper": read, **known})


def test_rates_are_means_over_repeats_with_their_deviation(statistics: Any) -> None:
    letters: Sequence[Sequence[str | None]] = (("A", "A", "C", "B"), ("A", "B", "C", None))
    replies = [
        seen(f"{place}", "never", repeat, letter)
        for repeat, of_repeat in enumerate(letters, 1)
        for place, letter in enumerate(of_repeat)
    ]
    failed = seen("4", "never", 1, None, reply=None, failure="it was away")
    found = statistics.rates([*replies, failed])
    assert found is not None
    assert (found.questions, found.replies, found.failed, found.unreadable) == (4, 8, 1, 1)
    assert (found.tpr.mean, found.nsr.mean) == (0.375, 0.25)
    assert found.tpr.sd == pytest.approx(math.sqrt(2) * 0.125)
    assert statistics.rates([failed]) is None


def test_the_exact_test_and_the_counts_of_a_known_table(statistics: Any) -> None:
    """Ten questions right in the arm alone, two in the baseline alone: p = 0.0386, as by McNemar's exact test."""
    pairs = [("A", "B")] * 10 + [("B", "A")] * 2 + [("A", "A")] * 5
    arm = [seen(f"{place}", "always", 1, a) for place, (a, _) in enumerate(pairs)]
    never = [seen(f"{place}", "never", 1, b) for place, (_, b) in enumerate(pairs)]
    found = statistics.gain(arm, never)
    assert found is not None
    assert (found.helped, found.hurt) == (10, 2)
    assert found.p == pytest.approx(0.03857, abs=1e-5)
    assert found.gain == pytest.approx(8 / 17)
    assert -1 <= found.low < found.gain < found.high <= 1


def test_what_failed_in_one_arm_counts_in_neither(statistics: Any) -> None:
    arm = [seen("1", "always", 1, None, failure="away"), seen("2", "always", 1, "A"), seen("3", "always", 1, "A")]
    never = [seen("1", "never", 1, "A"), seen("2", "never", 1, "B")]
    found = statistics.gain(arm, never)
    assert found is not None
    assert (found.questions, found.gain) == (1, 1.0)
    assert statistics.gain(arm[:1], never) is None


def test_holm_adjusts_as_in_the_literature(statistics: Any) -> None:
    assert statistics.holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert statistics.holm([]) == []


@given(st.lists(st.floats(0, 1), max_size=8))
def test_adjusted_values_are_no_smaller_and_keep_their_order(statistics: Any, values: list[float]) -> None:
    adjusted = statistics.holm(values)
    assert all(low <= high <= 1 for low, high in zip(values, adjusted, strict=True))
    ranked = sorted(range(len(values)), key=lambda place: (values[place], adjusted[place]))
    assert [adjusted[place] for place in ranked] == sorted(adjusted)


def test_intervals_hold_the_gain_and_nothing_is_found_where_nothing_is(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of 95% intervals at least 90% hold it, of p values at most 10% are below 5%; all in benchmarks/eval_statistics.

    Questions on one scene share what looking does there: a test of single questions rejects a third of these.
    """
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    from eval_statistics import DESIGNS, trial

    trials = 60 * SCALE
    for design in DESIGNS if SCALE > 1 else DESIGNS[3::3]:
        told = [trial(design, seed) for seed in range(trials)]
        assert sum(held for held, _ in told) >= 0.9 * trials, design.name
        assert design.gained or sum(rejected for _, rejected in told) <= 0.1 * trials, design.name


def test_few_scenes_say_nothing_and_unanimous_ones_little(statistics: Any) -> None:
    one = np.array([[1.0, 0.0, 1.0]])
    assert statistics.cluster_interval(one) == (-1.0, 1.0)
    low, high = statistics.cluster_interval(np.repeat(one, 30, axis=0))
    assert 0.7 < low < 0.95
    assert high == 1.0
    low, high = statistics.cluster_interval(np.repeat(one * [0, 0, 1], 30, axis=0))
    assert -0.15 < low < 0 < high < 0.15


@pytest.mark.parametrize(("scenes", "share"), [(7, 0.9), (12, 0.8), (25, 0.92), (120, 0.02)])
@pytest.mark.parametrize("together", [1, 5])
def test_intervals_hold_where_scenes_are_few_or_nearly_alike(
    statistics: Any, scenes: int, share: float, together: int
) -> None:
    """Even if a scene's replies are all the same: five of them say no more than one."""
    trials, held = 60 * SCALE, 0
    for number in range(trials):
        right = (np.random.default_rng(number).random(scenes) < share).astype(float)
        low, high = statistics.cluster_interval(together * np.stack([right, np.zeros(scenes), np.ones(scenes)], axis=1))
        held += low <= share <= high
    assert held >= 0.9 * trials


def test_looking_must_beat_every_placebo(statistics: Any) -> None:
    """The primary question: p is the largest, the gain the smallest, and of two signs nothing is said."""
    strong = np.array([[1.0, 0.0, 1.0]] * 12 + [[0.0, 0.0, 1.0]] * 20)
    weak = np.array([[1.0, 0.0, 1.0]] * 4 + [[0.0, 0.0, 1.0]] * 28)
    found = statistics.primary_gain({"still": (strong, 32), "other": (weak, 32)})
    assert found is not None
    assert (found.placebo, found.gain.gain, found.p) == ("other", 0.125, 0.125)
    assert found.gain.low == statistics.cluster_interval(weak)[0]
    opposed = statistics.primary_gain({"still": (strong, 32), "other": (weak[:, [1, 0, 2]], 32)})
    assert opposed is not None
    assert opposed.p == 1.0
    assert statistics.primary_gain({}) is None
    assert statistics.primary_gain({"still": (strong, 32), "other": (weak[:0], 0)}) is None, "one was not replied to"


def test_a_plan_asks_for_as_many_scenes_as_the_normal_law_says(statistics: Any) -> None:
    """0.2 discordant pairs and the paper's 2.4 points: some thousands, and more to beat each of three placebos."""
    assert statistics.scenes_needed(0.024, 0.2, 1) == 2726
    assert statistics.scenes_needed(0.024, 0.2, 3) == 4160
    for placebos, scenes in ((1, 2726), (3, 4160)):
        assert statistics.power_of(0.024, 0.2, scenes, placebos) == pytest.approx(0.8, abs=1e-3)
        assert statistics.effect_shown(scenes, 0.2, placebos) == pytest.approx(0.024, abs=1e-5)
    assert statistics.power_of(0.024, 0.2, 100, 1) < 0.1
    assert statistics.upper_variance(0.4, 400) == pytest.approx(0.16, rel=0.08)
    assert statistics.upper_variance(0.4, 10) > 0.25, "few scenes say little"


def test_a_sign_flip_test_is_exact(statistics: Any) -> None:
    """By all signs of few scenes, and with p far below what draws could tell for many."""
    draws = np.random.default_rng(3)
    for _ in range(20):
        found = draws.integers(-4, 5, 8).astype(np.float64)
        signs = np.array(np.meshgrid(*[[-1, 1]] * 8)).reshape(8, -1).T
        assert statistics.sign_flip_p(found) == pytest.approx(np.mean(abs(signs @ abs(found)) >= abs(found.sum())))
    assert 0 < statistics.sign_flip_p(np.ones(100)) < 1e-25
    assert statistics.sign_flip_p(np.zeros(5)) == 1.0


def test_calibration_counts_each_question_once(statistics: Any) -> None:
    told = [("1", 0.9, True), ("1", 0.9, True), ("2", 0.2, False), ("3", 0.95, False), ("4", None, True)]
    replies = [
        seen(item, "always", repeat, "A", probability=probability, happens=happens)
        for repeat, (item, probability, happens) in enumerate(told, 1)
    ]
    found = statistics.calibration(replies)
    assert found is not None
    assert (found.count, [each.count for each in found.bins]) == (3, [1, 2])
    assert found.brier == pytest.approx((0.01 + 0.04 + 0.9025) / 3)
    assert found.base_brier == pytest.approx(2 / 9)
    assert statistics.calibration(replies[-1:]) is None


def test_costs_are_sums_and_money_needs_prices(statistics: Any) -> None:
    replies = [seen("1", "always", 1, "A", calls=3, input_tokens=1000, output_tokens=100, seconds=2.5, imaginations=1)]
    failed = seen("2", "always", 1, None, failure="away", input_tokens=7)
    assert statistics.cost([*replies, failed]).money is None
    assert statistics.cost([*replies, failed], 2.0, 10.0).money == pytest.approx(0.003)
    assert statistics.cost(replies).input_tokens == 1000
