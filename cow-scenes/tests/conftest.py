"""Shared: a handful of worlds without pictures, found once."""

import pytest

from cow_scenes.accept import find_world
from cow_scenes.plan import LEVELS, TASKS, plan_items

COUNT = 40


@pytest.fixture(scope="session")
def worlds():
    """Worlds of every form and level, at the size of the real pictures."""
    return tuple(find_world(key, 832, 480) for key in plan_items(3, TASKS, LEVELS, COUNT))
