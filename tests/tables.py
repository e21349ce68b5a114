"""Long tables of cases: a named core that always runs, and the rest, which runs in `make soak`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import pytest


def rows(core: Mapping[str, Any], rest: Iterable[Any] = ()) -> list[Any]:
    """Cases for `pytest.mark.parametrize`.

    `core` maps the reason why a case must always run, which is its id, to its value: a tuple where the test takes
    several arguments. Cases of `rest` are marked `soak`.
    """
    always = [pytest.param(*arguments(value), id=reason) for reason, value in core.items()]
    return always + [pytest.param(*arguments(value), marks=pytest.mark.soak) for value in rest]


def arguments(value: Any) -> tuple[Any, ...]:
    return value if isinstance(value, tuple) else (value,)
