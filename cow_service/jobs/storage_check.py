"""Whether artifacts can be stored just now, for all who wait for jobs: these wait while they cannot."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

from cow_service.errors import StorageUnavailable
from cow_service.media.artifacts import ArtifactStore

MAX_AGE_SECONDS = 2.0  # of what was found


class StorageCheck:
    """Looks at most every two seconds, however many ask. Safe to use from every thread."""

    def __init__(self, artifacts: Callable[[], ArtifactStore]) -> None:
        self._artifacts = artifacts
        self._lock = threading.Lock()
        self._looked = -MAX_AGE_SECONDS
        self._fault: str | None = None

    def check(self) -> None:
        """Raises `StorageUnavailable` where they cannot."""
        with self._lock:
            if time.monotonic() - self._looked > MAX_AGE_SECONDS:
                self._fault = self._found()
                self._looked = time.monotonic()
            fault = self._fault
        if fault is not None:
            raise StorageUnavailable(f"{fault} The job goes on when that is over.")

    def _found(self) -> str | None:
        try:
            self._artifacts().check()
        except StorageUnavailable as error:
            return error.detail
        return None
