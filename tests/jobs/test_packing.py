"""JSON as the job database keeps it: exact, and small where it holds paths."""

from __future__ import annotations

import json
import math
from typing import Any

from hypothesis import example, given
from hypothesis import strategies as st

from cow_service.jobs.packing import packed, packed_paths, unpacked

DECIMALS = st.integers(0, 7)
NUMBERS = st.builds(lambda units, decimals: units / 10**decimals, st.integers(-(10**9), 10**9), DECIMALS)
ROWS = st.integers(1, 4).flatmap(lambda width: st.lists(st.lists(NUMBERS, min_size=width, max_size=width), max_size=40))
ODD = st.sampled_from([-0.0, 1e300, 5e-324, 1, True, None, "1.5", [1.5], {"a": 1.5}])
VALUES = st.recursive(
    st.one_of(NUMBERS, ODD, st.lists(NUMBERS, max_size=40), ROWS, st.lists(st.one_of(NUMBERS, ODD), max_size=40)),
    lambda parts: st.one_of(st.lists(parts, max_size=4), st.dictionaries(st.text(max_size=4), parts, max_size=4)),
    max_leaves=8,
)


@given(VALUES)
@example([[]] * 16)
@example([1.5] * 16 + ["2"])
@example([[1.5, 2.5]] * 16 + [[1.5, True]])
@example([[[1.5]]] * 16)
def test_what_is_packed_comes_back_as_the_same_text(value: Any) -> None:
    text = json.dumps(value)
    for pack in (packed, packed_paths):
        assert json.dumps(unpacked(pack(text))) == text


def test_paths_take_less_than_half_of_the_room() -> None:
    path = [[round(275 + 9 * t - t * t / 30, 3), round(225 + 40 * math.sin(t / 9), 3)] for t in range(81)]
    text = json.dumps({"paths": [{"points": path, "tracks": [path] * 2, "visible": [True] * 81}]})
    assert 2 * len(packed_paths(text)) < len(packed(text))
