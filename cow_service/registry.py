"""Finds backends by name among the installed entry points and loads each when it is first used.

The built-in backends are registered in `pyproject.toml` exactly as those of a third party would be.
"""

import time
from collections.abc import Callable
from functools import cached_property
from importlib.metadata import EntryPoint, entry_points
from threading import Lock
from typing import Generic, Protocol, TypeVar, cast, runtime_checkable

from cow_service.errors import CowError
from cow_service.settings import Settings

RETRY_SECONDS = 30.0  # before a backend that failed to load is tried again: checking its weights takes long

Backend = TypeVar("Backend")


@runtime_checkable
class Closable(Protocol):
    """A backend that holds something open, such as connections."""

    def close(self) -> None:
        """Closes it."""
        ...


class Registry(Generic[Backend]):
    """Backends of one kind: a name to a lazy factory, which is given the settings.

    `unavailable` is raised for one that cannot be loaded.
    """

    def __init__(self, group: str, unavailable: type[CowError], settings: Settings) -> None:
        self.group = group
        self._unavailable = unavailable
        self._settings = settings
        self._made: dict[str, Backend] = {}
        # When, and why; not the error itself: its traceback would keep half-loaded tensors alive.
        self._failed: dict[str, tuple[float, type[CowError], str]] = {}
        self._guard = Lock()
        self._locks: dict[str, Lock] = {}

    @cached_property
    def _points(self) -> dict[str, EntryPoint]:
        return {point.name: point for point in entry_points(group=self.group)}

    def names(self) -> tuple[str, ...]:
        """Registered names, in alphabetical order. Nothing is imported."""
        return tuple(sorted(self._points))

    def get(self, name: str) -> Backend:
        """The backend of that name, made once. Raises `KeyError` for a name that is not registered.

        What its factory raises passes through, and is raised again without another try for the next 30 seconds.
        """
        point = self._points[name]
        with self._guard:
            lock = self._locks.setdefault(name, Lock())
        with lock:  # one per name: a backend that takes minutes to load does not delay the others
            if name not in self._made:
                self._made[name] = self._make(name, point)
            return self._made[name]

    def is_made(self, name: str) -> bool:
        """Whether the backend of that name is loaded."""
        return name in self._made

    def close(self) -> None:
        """Closes the backends that were made and can be closed; each is created again on its next use."""
        with self._guard:
            made, self._made = self._made, {}
        for backend in made.values():
            if isinstance(backend, Closable):
                backend.close()

    def _make(self, name: str, point: EntryPoint) -> Backend:
        if name in self._failed:
            since, kind, detail = self._failed[name]
            if time.monotonic() < since + RETRY_SECONDS:
                raise kind(detail)
        try:
            factory = cast(Callable[[Settings], Backend], point.load())
            return factory(self._settings)
        except ModuleNotFoundError as error:
            missing = error.name or "a module"
            raise self._unavailable(
                f"'{name}' needs the Python package that provides '{missing}', which is not installed here. "
                f"`cow doctor` shows the line that installs it."
            ) from error
        except CowError as error:
            self._failed[name] = time.monotonic(), type(error), error.detail
            raise
