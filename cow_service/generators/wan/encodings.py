"""Encodings of recent inputs: the same text or image is encoded once."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable
from dataclasses import dataclass, field
from hashlib import sha256
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from cow_service.generators.wan.pipeline import Picture, WanTrackPipeline

TEXTS = 64  # kept; one is 4 MB in bfloat16
PICTURES = 8  # kept; one is 11 MB at 832 x 480 x 81

Value = TypeVar("Value")


class Recent(Generic[Value]):
    """The values of the last `size` keys that were asked for."""

    def __init__(self, size: int) -> None:
        self._size = size
        self._values: OrderedDict[Hashable, Value] = OrderedDict()

    def get(self, key: Hashable, make: Callable[[], Value]) -> Value:
        """The key's value, made if it is not kept."""
        if key not in self._values:
            self._values[key] = make()
        self._values.move_to_end(key)
        while len(self._values) > self._size:
            self._values.popitem(last=False)
        return self._values[key]

    def clear(self) -> None:
        """Keeps nothing."""
        self._values.clear()


@dataclass(frozen=True)
class Encodings:
    """Text and image encodings of a pipeline."""

    pipeline: WanTrackPipeline
    _texts: Recent[Tensor] = field(default_factory=lambda: Recent[Tensor](TEXTS))
    _pictures: Recent[Picture] = field(default_factory=lambda: Recent[Picture](PICTURES))

    def text(self, text: str) -> Tensor:
        """Embeddings [1, 512, C]."""
        return self._texts.get(text, lambda: self.pipeline.embed_text(text))

    def picture(self, image: NDArray[np.uint8], width: int, height: int, num_frames: int) -> Picture:
        """Encodings of the first frame of a clip of this size (px) and length."""
        key = (sha256(image.tobytes()).digest(), image.shape, width, height, num_frames)
        return self._pictures.get(key, lambda: self.pipeline.embed_picture(image, width, height, num_frames))

    def forget(self) -> None:
        """Lets go of everything."""
        self._texts.clear()
        self._pictures.clear()
