from collections import Counter

import pytest

from cow_scenes.errors import UsageError
from cow_scenes.plan import FORMS, LEVELS, TASKS, ItemKey, plan_items
from cow_scenes.settings import Settings


def test_ids_are_those_of_the_public_data():
    assert ItemKey(1, "collision", "L1", 0).id == "Collision_Level_1_0"
    assert ItemKey(1, "trajectory", "L2", 13).id == "Physics_Level_2_13"
    assert ItemKey(1, "occlusion", "L1", 4).id == "Occlusion_Level_1_4"
    assert ItemKey(1, "compatibility", "L1", 7).id == "Compatibility_Level_1_7"


def test_a_larger_count_only_adds_items():
    small, large = plan_items(1, TASKS, LEVELS, 30), plan_items(1, TASKS, LEVELS, 100)
    assert large[:30] == small
    assert len({key.id for key in large}) == 100


def test_each_item_has_numbers_of_its_own():
    drawn = {tuple(key.random("world").integers(0, 2**31, 4)) for key in plan_items(1, TASKS, LEVELS, 50)}
    assert len(drawn) == 50
    key = plan_items(1, TASKS, LEVELS, 1)[0]
    assert key.random("world").uniform() == key.random("world").uniform()
    assert key.random("world").uniform() != key.random("look").uniform()


@pytest.mark.parametrize("group", FORMS)
def test_wanted_answers_are_balanced_per_form(group):
    keys = [ItemKey(1, *group, number) for number in range(60)]
    for form in set(FORMS[group]):
        wants = Counter(key.want for key in keys if key.form == form)
        assert set(wants) == ({0, 1, 2} if form == "first" else {0, 1})
        assert max(wants.values()) - min(wants.values()) <= 1


@pytest.mark.parametrize(
    "bad", [{"count": 0}, {"seed": -1}, {"tasks": ("chess",)}, {"width": 10}, {"samples": 0}, {"height": 800}]
)
def test_bad_arguments_name_the_value(bad):
    with pytest.raises(UsageError, match=str(next(iter(bad.values()))).strip("(),'")):
        Settings(**bad).plan()
