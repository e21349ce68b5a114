"""Rendered scenes with known truth, as cases of tests."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from conftest import EXAMPLES, SHARED_SCENES


def folders_of(scenes: Path) -> list[Path]:
    return sorted(path.parent for path in scenes.glob("*/meta.json"))


def scene_rows() -> list[Any]:
    """The folders of our own examples and, in `make soak` and where it is at hand, of the larger shared set."""
    rows = [pytest.param(path, id=path.name) for path in folders_of(EXAMPLES)]
    return rows + [pytest.param(path, id=path.name, marks=pytest.mark.soak) for path in folders_of(SHARED_SCENES)]
