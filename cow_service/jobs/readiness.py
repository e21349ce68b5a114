"""Whether the server can serve the default request: its backends load in the background, for minutes perhaps."""

from __future__ import annotations

import shutil
import threading
from collections.abc import Callable

from cow_service.errors import CowError, NotReady, StorageUnavailable
from cow_service.service import Service

MIN_FREE_BYTES = 200_000_000  # on the disk of the data folder


class Readiness:
    """Waits once until the default backends are loaded, in a thread of its own."""

    def __init__(
        self, service: Service, load: Callable[[], None] | None = None, warm_up: Callable[[], None] = lambda: None
    ) -> None:
        """`load` returns once they are loaded, and raises the `CowError` for which they cannot be. `warm_up` is called
        once, then."""
        self._service = service
        self._load_backends = load or service.check
        self._warm_up = warm_up
        self._warming = threading.Lock()  # held while it warms up, and for ever once the process ends
        self._done = threading.Event()
        self._started = False
        self.error: CowError | None = None

    def start(self, failed: Callable[[], None] = lambda: None) -> None:
        """Starts loading; `failed` is called where that raises."""
        self._started = True
        threading.Thread(target=self._load, args=(failed,), name="cow-loading", daemon=True).start()

    def wait(self, seconds: float) -> None:
        """Waits at most so long until all is loaded. Raises the `CowError` for which it cannot be."""
        self._done.wait(seconds)
        if self.error is not None:
            raise self.error

    def end(self) -> None:
        """Waits until no thread warms up, and has none begin: a process that ends in the middle of one crashes."""
        self._warming.acquire()

    def check(self) -> None:
        """Raises `NotReady` while loading, `StorageUnavailable`, `ReaderUnavailable`, `GeneratorUnavailable`."""
        if self._started and not self._done.is_set():
            raise NotReady("The default reader and generator are being loaded. Ask again in a while.")
        self._service.artifacts.check()
        self._load_backends()
        free = shutil.disk_usage(self._service.settings.data_dir).free
        if free < MIN_FREE_BYTES:
            needed = MIN_FREE_BYTES / 1e6
            raise StorageUnavailable(
                f"The disk of the data folder has {free / 1e6:.0f} MB left, and {needed:.0f} MB are needed."
            )

    def _load(self, failed: Callable[[], None]) -> None:
        try:
            self._load_backends()
            with self._warming:
                self._warm_up()
        except CowError as error:
            self.error = error
            failed()
        finally:
            self._done.set()
