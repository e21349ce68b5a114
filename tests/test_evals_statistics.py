"""Rates and gains, against values known from the literature and against draws whose true gain is known."""

from __future__ import annotations

import math
import random
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from conftest import SCALE
from hypothesis import given
from hypothesis import strategies as st

from cow_service.evals.items import Observation
from cow_service.evals.statistics import bootstrap_interval, calibration, cost, gain, holm, rates

SCENES, REPEATS, RUNS, WITHIN = 42, 5, 20, 18
WITHOUT, WITH_FRAMES = 0.5, 0.75


def seen(item: str, arm: str, repeat: int, read: str | None, **known: Any) -> Observation:
    fields = {
        "task": "collision",
        "level": "L1",
        "scene": item,
        "options": ("A", "B", "C"),
        "abstain": "C",
        "reply": "",
    }
    return Observation.model_validate(
        {
            **fields,
            "item": item,
            "arm": arm,
            "repeat": repeat,
            "truth": "A",
            "read": read,
            "read_as_paper": read,
            **known,
        }
    )


def drawn(arm: str, share: float, draws: random.Random, repeats: int = REPEATS) -> list[Observation]:
    """Replies of a model that is right so often."""
    return [
        seen(f"scene {place}", arm, repeat, "A" if draws.random() < share else "B")
        for place in range(SCENES)
        for repeat in range(1, repeats + 1)
    ]


def test_rates_are_means_over_repeats_with_their_deviation() -> None:
    letters: Sequence[Sequence[str | None]] = (("A", "A", "C", "B"), ("A", "B", "C", None))
    replies = [
        seen(f"{place}", "never", repeat, letter)
        for repeat, of_repeat in enumerate(letters, 1)
        for place, letter in enumerate(of_repeat)
    ]
    failed = seen("4", "never", 1, None, reply=None, failure="it was away")
    found = rates([*replies, failed])
    assert found is not None
    assert (found.questions, found.replies, found.failed, found.unreadable) == (4, 8, 1, 1)
    assert (found.tpr.mean, found.nsr.mean) == (0.375, 0.25)
    assert found.tpr.sd == pytest.approx(math.sqrt(2) * 0.125)
    assert rates([failed]) is None


def test_the_exact_test_and_the_counts_of_a_known_table() -> None:
    """Ten questions right in the arm alone, two in the baseline alone: p = 0.0386 (exact McNemar)."""
    pairs = [("A", "B")] * 10 + [("B", "A")] * 2 + [("A", "A")] * 5
    arm = [seen(f"{place}", "always", 1, a) for place, (a, _) in enumerate(pairs)]
    never = [seen(f"{place}", "never", 1, b) for place, (_, b) in enumerate(pairs)]
    found = gain(arm, never)
    assert found is not None
    assert (found.helped, found.hurt, found.discordant) == (10, 2, (10, 2))
    assert found.p == pytest.approx(0.03857, abs=1e-5)
    assert found.gain == pytest.approx(8 / 17)
    assert -1 <= found.low < found.gain < found.high <= 1


def test_what_failed_in_one_arm_counts_in_neither() -> None:
    arm = [seen("1", "always", 1, None, failure="away"), seen("2", "always", 1, "A"), seen("3", "always", 1, "A")]
    never = [seen("1", "never", 1, "A"), seen("2", "never", 1, "B")]
    found = gain(arm, never)
    assert found is not None
    assert (found.questions, found.gain) == (1, 1.0)
    assert gain(arm[:1], never) is None


def test_holm_adjusts_as_in_the_literature() -> None:
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm([]) == []


@given(st.lists(st.floats(0, 1), max_size=8))
def test_adjusted_values_are_no_smaller_and_keep_their_order(values: list[float]) -> None:
    adjusted = holm(values)
    assert all(low <= high <= 1 for low, high in zip(values, adjusted, strict=True))
    ranked = sorted(range(len(values)), key=lambda place: (values[place], adjusted[place]))
    assert [adjusted[place] for place in ranked] == sorted(adjusted)


def test_the_true_gain_lies_in_the_interval_and_a_placebo_gains_nothing() -> None:
    covered = nothing = 0
    for seed in range(RUNS):
        draws = random.Random(f"gain {seed}")
        never = drawn("never", WITHOUT, draws)
        always = gain(drawn("always", WITH_FRAMES, draws), never)
        placebo = gain(drawn("placebo-still", WITHOUT, draws), never)
        assert always is not None
        assert placebo is not None
        covered += always.low <= WITH_FRAMES - WITHOUT <= always.high
        nothing += placebo.low <= 0 <= placebo.high
    assert covered >= WITHIN
    assert nothing >= WITHIN


def test_intervals_hold_what_they_promise_where_scenes_differ() -> None:
    """Of 95% intervals at least 90% hold the truth, where scenes differ in difficulty and in what looking gains."""
    trials, held = 60 * SCALE, 0
    for trial in range(trials):
        draws = np.random.default_rng(trial)
        easy, helped = draws.uniform(0.1, 0.7, SCENES), draws.uniform(-0.1, 0.3, SCENES)
        right = draws.binomial(REPEATS, easy + helped) - draws.binomial(REPEATS, easy)
        low, high = bootstrap_interval(np.stack([right, np.full(SCENES, REPEATS)], axis=1).astype(float), 1000)
        held += low <= 0.1 <= high
    assert held >= 0.9 * trials


def test_few_scenes_say_nothing_and_unanimous_ones_little() -> None:
    one = np.array([[1.0, 1.0]])
    assert bootstrap_interval(one) == (-1.0, 1.0)
    low, high = bootstrap_interval(np.repeat(one, 30, axis=0))
    assert 0.7 < low < 0.95
    assert high == 1.0
    low, high = bootstrap_interval(np.repeat(one * [0, 1], 30, axis=0))
    assert -0.15 < low < 0 < high < 0.15


@pytest.mark.parametrize(("scenes", "share"), [(7, 0.9), (12, 0.8), (25, 0.92), (120, 0.02)])
def test_intervals_hold_where_scenes_are_few_or_nearly_alike(scenes: int, share: float) -> None:
    trials, held = 60 * SCALE, 0
    for trial in range(trials):
        right = (np.random.default_rng(trial).random(scenes) < share).astype(float)
        low, high = bootstrap_interval(np.stack([right, np.ones(scenes)], axis=1), 500)
        held += low <= share <= high
    assert held >= 0.9 * trials


def test_calibration_counts_each_question_once() -> None:
    told = [("1", 0.9, True), ("1", 0.9, True), ("2", 0.2, False), ("3", 0.95, False), ("4", None, True)]
    replies = [
        seen(item, "always", repeat, "A", probability=probability, happens=happens)
        for repeat, (item, probability, happens) in enumerate(told, 1)
    ]
    found = calibration(replies)
    assert found is not None
    assert (found.count, [each.count for each in found.bins]) == (3, [1, 2])
    assert found.brier == pytest.approx((0.01 + 0.04 + 0.9025) / 3)
    assert found.base_brier == pytest.approx(2 / 9)
    assert calibration(replies[-1:]) is None


def test_costs_are_sums_and_money_needs_prices() -> None:
    replies = [seen("1", "always", 1, "A", calls=3, input_tokens=1000, output_tokens=100, seconds=2.5, imaginations=1)]
    failed = seen("2", "always", 1, None, failure="away", input_tokens=7)
    assert cost([*replies, failed]).money is None
    assert cost([*replies, failed], 2.0, 10.0).money == pytest.approx(0.003)
    assert cost(replies).input_tokens == 1000
