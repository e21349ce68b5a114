"""Fixtures of this folder, which takes seconds to import what they are made of: a plugin that its test files name."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from types import ModuleType
from typing import TYPE_CHECKING

import pytest
from filmed import rolling

from cow_service.generators.base import GeneratorInput

if TYPE_CHECKING:
    from cow_service.generators.wan.generator import WanGenerator


@pytest.fixture(scope="session")
def toys() -> ModuleType:
    """The module: it imports PyTorch."""
    import toys

    return toys


@pytest.fixture(scope="session")
def made(toys: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], WanGenerator]:
    """Toy models by name, made once: tests leave them as they were."""
    return cache(lambda name: toys.model(name, tmp_path_factory.mktemp(name)))


@pytest.fixture(scope="session")
def scene() -> GeneratorInput:
    return rolling()
