"""Finds backends by name among the installed entry points and loads one only when it is asked for.

The built-in backends are registered in `pyproject.toml` exactly as those of a third party would be.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from importlib.metadata import EntryPoint, entry_points
from threading import Lock
from typing import Generic, TypeVar, cast

from cow_service.errors import CowError
from cow_service.settings import Settings

Backend = TypeVar("Backend")


class Registry(Generic[Backend]):
    """Backends of one kind: a name to a lazy factory, which is given the settings.

    `unavailable` is raised for one that cannot be loaded.
    """

    def __init__(self, group: str, unavailable: type[CowError], settings: Settings) -> None:
        self.group = group
        self._unavailable = unavailable
        self._settings = settings
        self._made: dict[str, Backend] = {}
        self._guard = Lock()
        self._locks: dict[str, Lock] = {}

    @cached_property
    def _points(self) -> dict[str, EntryPoint]:
        return {point.name: point for point in entry_points(group=self.group)}

    def names(self) -> tuple[str, ...]:
        """Registered names, in alphabetical order. Nothing is imported."""
        return tuple(sorted(self._points))

    def get(self, name: str) -> Backend:
        """The backend of that name, made once. Raises `KeyError` for a name that is not registered."""
        point = self._points[name]
        with self._guard:
            lock = self._locks.setdefault(name, Lock())
        with lock:  # one that takes minutes to load keeps nobody from the others
            if name not in self._made:
                try:
                    factory = cast(Callable[[Settings], Backend], point.load())
                except ModuleNotFoundError as error:
                    missing = error.name or "a module"
                    raise self._unavailable(
                        f"'{name}' needs the Python package that provides '{missing}', which is not installed here. "
                        f"`cow doctor` shows the line that installs it."
                    ) from error
                self._made[name] = factory(self._settings)
            return self._made[name]
