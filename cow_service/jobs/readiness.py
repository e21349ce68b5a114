"""Whether the server can do what it is asked by default: its backends are loaded beside it, and may take minutes."""

from __future__ import annotations

import shutil
import threading
from collections.abc import Callable

from cow_service.errors import CowError, NotReady, StorageUnavailable
from cow_service.service import Service

LEAST_FREE = 200_000_000  # bytes on the disk of the data folder


class Readiness:
    """Loads the default backends once, in a thread of its own."""

    def __init__(self, service: Service) -> None:
        self._service = service
        self._done = threading.Event()
        self._started = False
        self.error: CowError | None = None

    def start(self, failed: Callable[[], None] = lambda: None) -> None:
        """Begins to load; `failed` is called where that cannot be done."""
        self._started = True
        threading.Thread(target=self._load, args=(failed,), name="cow-loading", daemon=True).start()

    def wait(self, seconds: float) -> None:
        """Waits for a while until all is loaded. Raises the `CowError` for which it cannot be."""
        self._done.wait(seconds)
        if self.error is not None:
            raise self.error

    def check(self) -> None:
        """Raises `NotReady` while loading, `StorageUnavailable`, `ReaderUnavailable`, `GeneratorUnavailable`."""
        if self._started and not self._done.is_set():
            raise NotReady("The default reader and generator are being loaded. Ask again in a while.")
        self._service.check()
        free = shutil.disk_usage(self._service.settings.data_dir).free
        if free < LEAST_FREE:
            raise StorageUnavailable(
                f"The disk of the data folder has {free / 1e6:.0f} MB left, and {LEAST_FREE / 1e6:.0f} MB are needed."
            )

    def _load(self, failed: Callable[[], None]) -> None:
        try:
            self._service.check()
        except CowError as error:
            self.error = error
            failed()
        finally:
            self._done.set()
