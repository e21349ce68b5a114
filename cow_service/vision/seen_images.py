"""What was measured in the latest images, for other questions about them: half of a request's time."""

from __future__ import annotations

from collections import OrderedDict
from threading import Lock

from cow_service.vision.scene import Measured, Scene

MOST_IMAGES = 8
ImageKey = tuple[str | None, str]
"""Whose image it is, so that nobody learns by the time it takes what others ask about; and its SHA-256."""
MOST_PIXELS = 13_000_000  # of all of them together: each holds some bytes per pixel


class SeenImages:
    """The measurements of images, the latest used last. Safe to use from several threads."""

    def __init__(self) -> None:
        self._lock = Lock()
        self._kept: OrderedDict[ImageKey, tuple[int, Measured]] = OrderedDict()

    def recall(self, key: ImageKey, scene: Scene) -> None:
        """Gives a scene what is known of its image."""
        with self._lock:
            found = self._kept.get(key)
            if found is None:
                return
            self._kept.move_to_end(key)
        scene.take(found[1])

    def keep(self, key: ImageKey, scene: Scene) -> None:
        """Keeps what a scene has measured of its image."""
        measured = scene.measured()
        with self._lock:
            self._kept[key] = scene.width * scene.height, measured
            self._kept.move_to_end(key)
            while len(self._kept) > MOST_IMAGES or sum(pixels for pixels, _ in self._kept.values()) > MOST_PIXELS:
                self._kept.popitem(last=False)
