"""What constructed worlds answer to a question, and how sure: probabilities, forms, negation, what it depends on."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cow_service.physics.draws import COLUMN, NAMES, PARAMETERS, ensemble
from cow_service.physics.ensemble import (
    BATCHES,
    MAY_CHANGE,
    MAY_CHANGE_ROBUST,
    ROBUST,
    SURE,
    Decided,
    Query,
    Told,
    answers_of,
    batches,
    decide,
    decide_change,
    decide_each,
    is_settled,
)
from cow_service.physics.events import KINDS, NEVER, Events, WorldEvents
from cow_service.records import Asked, AskedForm, AskedRelation

COUNT = 100
DRAWS = ensemble(COUNT)


def events(touches=None, occludes=None, covered=None, count=COUNT, bodies=4, stands_on=()) -> WorldEvents:
    """Times [K] per body; what is not given never happens."""
    times = {}
    for kind, given in zip(KINDS, (touches, occludes, covered), strict=True):
        times[kind] = np.full((count, bodies), NEVER)
        for body, values in (given or {}).items():
            times[kind][:, body] = values
    eligible = np.array([i != 0 and i not in stands_on for i in range(bodies)])
    found = Events(times, {kind: np.zeros((count, bodies)) for kind in KINDS}, eligible, times)
    never = np.full((count, bodies), NEVER)
    return WorldEvents({0: found}, never, never, never, never)


def share(value: float, time: float = 1.0) -> np.ndarray:
    """Times, a share of them finite, spread evenly over the draws."""
    return np.where(np.argsort(np.argsort(np.modf(np.arange(COUNT) * 0.618)[0])) < value * COUNT, time, NEVER)


def asked(
    form: AskedForm = "whether", relation: AskedRelation = "touches", target: str | None = "box", negated: bool = False
) -> Asked:
    return Asked(form=form, relation=relation, target=target, negated=negated)


def decided(question: Asked, target: int | None, found: WorldEvents, draws=DRAWS) -> Decided:
    return decide(Query(question, target), found, draws)


@pytest.mark.parametrize(("value", "sure"), [(0.0, True), (0.45, False), (0.6, False), (0.9, True)])
def test_probability_and_sureness_of_whether(value: float, sure: bool) -> None:
    found = decided(asked(), 2, events(touches={2: share(value), 1: 0.5}))
    assert found.probability == pytest.approx(value)
    assert found.sure == sure
    missed = decided(asked(negated=True), 2, events(touches={2: share(value), 1: 0.5}))
    assert missed.probability == pytest.approx(1 - value)
    assert missed.sure == sure


def test_what_comes_too_late_does_not_count() -> None:
    for within, probability in ((1.0, 1.0), (0.99, 0.0)):
        in_time = asked().model_copy(update={"within": within})
        assert decided(in_time, 1, events(touches={1: 1.0})).probability == probability


def test_worlds_that_were_misread_tell_neither_way() -> None:
    for value, told in ((0.0, 0.3), (1.0, 0.7)):
        found = replace(events(touches={2: share(value)}), misread=np.arange(COUNT) < 0.6 * COUNT)
        answer = decided(asked(), 2, found)
        assert answer.probability == pytest.approx(told)
        assert answer.depends_on[:1] == ("place",)


def test_each_relation_looks_at_its_own_kind_of_event() -> None:
    relations: dict[AskedRelation, str] = {"touches": "touches", "covers": "occludes", "covered": "covered"}
    for relation, kind in relations.items():
        found = events(**{kind: {1: 1.0}})
        for other in relations:
            assert decided(asked(relation=other), 1, found).probability == (1.0 if other == relation else 0.0)


def test_of_anything_any_will_do_but_what_it_stands_on() -> None:
    halves = share(0.5)
    found = events(touches={1: halves, 2: np.where(np.isfinite(halves), NEVER, 2.0), 3: 0.0}, stands_on=(3,))
    assert decided(asked(target=None), None, found).probability == 1.0
    assert decided(asked(target=None), None, events(touches={3: 0.0}, stands_on=(3,))).probability == 0.0
    assert decided(asked(), 1, found).probability == pytest.approx(0.5)


def test_of_several_things_one_will_do_or_each_is_meant() -> None:
    found = events(touches={1: share(0.8), 2: 2.0, 3: 0.1})
    for every, probability, time in ((False, 1.0, 1.0), (True, 0.8, 2.0)):
        several = asked(target=None).model_copy(update={"every": every})
        answer = decide(Query(several, among=(1, 2)), found, DRAWS)
        assert (answer.probability, answer.time) == (pytest.approx(probability), time)
        with_taken = decide(Query(several, among=(2, 4)), found, DRAWS)  # numbered behind the bodies that are there
        assert with_taken.probability == (0.0 if every else 1.0)


def test_which_is_met_first() -> None:
    soon, late = share(0.8, 0.5), np.full(COUNT, 1.0)
    found = decided(asked("which-first", target=None), None, events(touches={2: soon, 1: late}))
    assert (found.first, found.probability, found.sure) == (2, pytest.approx(0.8), True)
    none = decided(asked("which-first", target=None), None, events())
    assert (none.first, none.probability, none.sure) == (None, 1.0, True)
    open_ = decided(asked("which-first", target=None), None, events(touches={2: share(0.5, 0.5), 1: late}))
    assert not open_.sure


def test_which_are_met_is_told_of_each_and_sure_where_all_are() -> None:
    which, halves = Query(asked("which", target=None), among=(1, 2, 3)), share(0.5)

    def told(found: WorldEvents, query: Query = which) -> Decided:
        return decide_each(query, found, [Told.by(query.of(body), found) for body in query.among], DRAWS)

    found = told(events(touches={1: 1.0, 2: share(0.9)}))
    assert [(each.body, each.probability, each.sure) for each in found.candidates] == [
        (1, 1.0, True), (2, pytest.approx(0.9), True), (3, 0.0, True),
    ]  # fmt: skip
    assert (found.probability, found.sure, found.robust) == (pytest.approx(0.9), True, True)
    found = told(events(touches={1: 1.0, 2: halves}))
    assert [each.sure for each in found.candidates] == [True, False, True]
    assert (found.probability, found.sure) == (0.5, False)
    assert not is_settled(found, which, 15, 50), "what of each is said may change"
    # Each is likely, and hardly ever both: then nothing is sure of the two.
    apart = np.roll(share(0.25), 1)
    apart[np.isfinite(share(0.25))] = NEVER
    found = told(events(touches={1: share(0.25), 2: apart}), replace(which, among=(1, 2)))
    assert [each.sure for each in found.candidates] == [True, True]
    assert (found.probability, found.sure) == (pytest.approx(0.5, abs=0.05), False)
    missed = told(events(touches={1: 1.0}), Query(asked("which", target=None, negated=True), among=(1, 2)))
    assert [each.probability for each in missed.candidates] == [0.0, 1.0]
    throw = replace(which, among=(1,), sure_of_miss=0.85)
    assert [told(events(touches={1: share(value)}), throw).candidates[0].sure for value in (0.2, 0.1, 0.8)] == [
        False, True, True,
    ]  # fmt: skip
    misread = replace(events(touches={1: 1.0}), misread=np.arange(COUNT) < 0.4 * COUNT)
    assert told(misread, throw).candidates[0].probability == pytest.approx(0.8)


def test_to_take_something_away_helps_only_where_it_would_happen() -> None:
    query = Query(asked("which-to-remove"), 2, among=(1, 2))

    def told(as_it_is: float, without: float, query: Query = query) -> Decided:
        own = [Told.by(query.of(1), events(touches={2: share(without)})), Told.by(query.of(2), events())]
        return decide_each(query, events(touches={2: share(as_it_is)}), own, DRAWS)

    found = told(0.9, 0.0)
    assert [each.probability for each in found.candidates] == [1.0, 1.0]
    assert (found.as_it_is, found.probability, found.sure, found.time) == (pytest.approx(0.9), found.as_it_is, True, 1)
    found = told(0.9, 0.9)
    assert [(each.probability, each.sure) for each in found.candidates] == [(pytest.approx(0.1), True), (1.0, True)]
    assert not told(0.6, 0.0).sure, "it may happen or not"
    needless = told(0.05, 0.05)
    assert (needless.as_it_is, needless.probability, needless.sure) == (pytest.approx(0.05), pytest.approx(0.95), True)
    turned = told(0.05, 0.95, replace(query, asked=asked("which-to-remove", negated=True)))
    assert [each.probability for each in turned.candidates] == [pytest.approx(0.95), 0.0], "so that it is met"
    assert (turned.as_it_is, turned.sure) == (pytest.approx(0.95), True)


def test_when_it_happens() -> None:
    times = np.linspace(1, 2, COUNT)
    times[:10] = NEVER
    found = decided(asked("when"), 1, events(touches={1: times}))
    assert found.probability == pytest.approx(0.9)
    assert found.time == pytest.approx(np.median(times[10:]))
    assert found.time_band == pytest.approx((np.quantile(times[10:], 0.1), np.quantile(times[10:], 0.9)))
    never = decided(asked("when"), 1, events())
    assert (never.probability, never.time, never.time_band) == (0.0, None, None)


def test_how_many_are_met() -> None:
    found = decided(asked("how-many", target=None), None, events(touches={1: 1.0, 2: share(0.85), 3: share(0.05)}))
    assert found.count == 2
    assert found.probability == pytest.approx(0.8, abs=0.051)
    assert found.sure
    none = decided(asked("how-many", target=None), None, events())
    assert (none.count, none.probability) == (0, 1.0)


@pytest.mark.parametrize("name", ["speed", "depth", "pitch", "friction", "size", "slant_ahead"])
def test_it_depends_on_what_goes_with_the_answer(name: str) -> None:
    column = COLUMN[name]
    found = decided(asked(), 1, events(touches={1: np.where(DRAWS[:, column] > 0.6, 1.0, NEVER)}))
    assert found.depends_on[0] == PARAMETERS[name]


def test_it_is_sure_and_robust_from_the_stated_shares_on_and_then_depends_on_nothing() -> None:
    for value, expected in ((0.69, (False, False)), (0.7, (True, False)), (0.89, (True, False)), (0.9, (True, True))):
        found = decided(asked(), 1, events(touches={1: share(value)}))
        assert (found.sure, found.robust) == expected
    assert decided(asked(), 1, events(touches={1: 1.0})).depends_on == ()
    throw = Query(asked(), 1, sure_of_miss=0.85)
    for value, sure in ((0.15, True), (0.16, False), (0.7, True)):
        assert decide(throw, events(touches={1: share(value)}), DRAWS).sure == sure


def test_what_happens_is_the_same_however_it_is_asked_for() -> None:
    around = events(touches={1: share(0.8)})
    for negated in (False, True):
        assert answers_of(Query(asked(negated=negated), 1), around) == np.isfinite(share(0.8)).astype(int).tolist()


def test_whether_a_change_makes_a_difference_is_counted_draw_by_draw() -> None:
    changed, factual = events(touches={1: share(0.9)}), events(touches={1: share(0.1)})
    for negated, probability in ((False, 0.8), (True, 0.2)):
        question = asked("changes", negated=negated)
        found = decide_change(Query(question, 1), changed, factual, DRAWS)
        assert (found.probability, found.sure, found.robust) == (pytest.approx(probability), True, False)
    same = decide_change(Query(asked("changes"), 1), changed, changed, DRAWS)
    assert (same.probability, same.sure, same.robust, same.depends_on) == (0.0, True, True, ())
    met = decide_change(Query(asked("changes", target=None)), changed, events(touches={2: share(0.9)}), DRAWS)
    assert met.probability == pytest.approx(0.9), "something else is met first"


class TestDraws:
    def test_of_each_parameter_every_quantile_occurs_once(self) -> None:
        for count in (1, 7, 100):
            rows = ensemble(count)
            assert rows.shape == (count, len(NAMES))
            assert (np.sort(rows, axis=0) == np.sort(rows[:, :1], axis=0)).all()
            assert np.abs(rows.mean(axis=0)).max() < 1e-9
        assert DRAWS.std(axis=0) == pytest.approx(np.ones(len(NAMES)), abs=0.05)
        mixed = np.abs(np.corrcoef(DRAWS.T) - np.eye(len(NAMES)))
        assert mixed.max() < 0.4


@pytest.mark.parametrize("agreeing", [0, 15, 34, 36, 44, 46])
def test_worlds_left_out_would_rarely_have_changed_the_verdict(agreeing: int) -> None:
    """Some of 50 worlds are run: how often does an early stop give another answer than all of them?"""
    size, tries, random = 50, 400, np.random.default_rng(agreeing)
    changed_sure = changed_robust = 0
    whole = agreeing / size
    for _ in range(tries):
        worlds = random.permutation(size) < agreeing
        looks = (count for count in BATCHES if is_settled(told_with(worlds[:count].mean()), None, count, size))
        share = worlds[: next(looks, size)].mean()
        changed_sure += (share >= SURE) != (whole >= SURE)
        changed_robust += (share >= ROBUST) != (whole >= ROBUST)
    assert changed_sure <= tries * 2.5 * MAY_CHANGE  # it is asked twice
    assert changed_robust <= tries * 2.5 * MAY_CHANGE_ROBUST


def test_what_all_of_the_first_worlds_agree_onis_settled_and_what_is_close_is_not() -> None:
    assert is_settled(told_with(1.0), None, 15, 50)
    assert not is_settled(told_with(11 / 15), None, 15, 50)
    assert not is_settled(told_with(21 / 30), None, 30, 50)


@pytest.mark.parametrize("size", [2, 16, 17, 31, 32, 500])
def test_no_world_is_run_alone_after_others(size: int) -> None:
    ends = batches(size)
    assert ends[-1] == size
    assert min(after - before for before, after in zip((0, *ends), ends, strict=False)) > 1


def told_with(probability: float) -> Decided:
    return Decided(probability=float(probability), sure=False, robust=False, depends_on=())
