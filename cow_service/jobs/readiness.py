"""Whether the server can serve the default request, and store what jobs make.

Its backends load in the background, for minutes perhaps.
"""

import logging
import shutil
import threading
import time
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

from cow_service.errors import CowError, NotReady, StorageUnavailable
from cow_service.media.artifacts import ArtifactStore
from cow_service.requests import ImageArtifact, SimulateRequest
from cow_service.service import Service
from cow_service.settings import Settings
from cow_service.weights.manifests import EXAMPLES

MAX_AGE_SECONDS = 2.0  # of what was found of the store
MIN_FREE_BYTES = 200_000_000  # on the disk of the data folder


class Readiness:
    """Waits once until the default backends are loaded, in a thread of its own."""

    def __init__(
        self,
        service: Service,
        load: Callable[[], None] | None = None,
        warm_up: Callable[[], None] = lambda: None,
        fault: Callable[[], str | None] = lambda: None,
    ) -> None:
        """`load` returns once they are loaded, and raises the `CowError` for which they cannot be. `warm_up` is called
        once, when all is ready. `fault` says what holds up the jobs, and passes by itself."""
        self._service = service
        self._load_backends, self._fault = load or service.check, fault
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
        fault = self._fault()
        if fault is not None or (self._started and not self._done.is_set()):
            raise NotReady(fault or "The default reader and generator are being loaded. Ask again later.")
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
        except CowError as error:
            self.error = error
            failed()
            return
        finally:
            self._done.set()
        with self._warming:
            self._warm_up()


class StorageCheck:
    """Looks at most every two seconds, however many ask. Safe to use from every thread."""

    def __init__(self, artifacts: ArtifactStore) -> None:
        self._artifacts = artifacts
        self._lock = threading.Lock()
        self._looked = -MAX_AGE_SECONDS
        self._fault: str | None = None

    def check(self) -> None:
        """Raises `StorageUnavailable` if they cannot."""
        with self._lock:
            if time.monotonic() - self._looked > MAX_AGE_SECONDS:
                self._fault = None
                try:
                    self._artifacts.check()
                except StorageUnavailable as error:
                    self._fault = error.detail
                self._looked = time.monotonic()
            if self._fault is not None:
                raise StorageUnavailable(f"{self._fault} The job continues when that is fixed.")


QUESTION = "If the yellow ball moves opposite to the direction of the arrow, will it hit the blue mug?"

log = logging.getLogger("cow_service")


def warm_up(settings: Settings) -> None:
    """Imagines with the backends that need no weights. Nothing of it is kept; a failure is logged."""
    try:
        with TemporaryDirectory(prefix="cow-warm-up-") as folder:
            alone = {"data_dir": Path(folder), "artifacts": None, "reader": "embedded", "generator": "cutout"}
            service = Service(settings.model_copy(update=alone))
            artifact = service.keep_image(EXAMPLES["ball-and-mug"].file("image").read_bytes())
            request = SimulateRequest(image=ImageArtifact(artifact=artifact.sha256), question=QUESTION, num_frames=9)
            service.simulate(request).model_dump_json()
            service.close()
    except (CowError, OSError) as error:
        log.warning("the warm-up failed, so the first request will take longer: %s", error)
