"""Rendered scenes with known truth, as cases of tests."""

from __future__ import annotations

from typing import Any

import pytest
from conftest import EXAMPLES, SHARED_SCENES


def scene_rows() -> list[Any]:
    """The folders of our own examples and, in `make soak` and where it is at hand, of the larger shared set."""
    own, shared = (sorted(path.parent for path in folder.glob("*/meta.json")) for folder in (EXAMPLES, SHARED_SCENES))
    rows = [pytest.param(path, id=path.name) for path in own]
    return rows + [pytest.param(path, id=path.name, marks=pytest.mark.soak) for path in shared]
