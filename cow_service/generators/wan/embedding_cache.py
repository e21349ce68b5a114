"""Caches the text and image embeddings of recent clips, so that the same text or image is encoded once."""

from __future__ import annotations

from collections import OrderedDict
from functools import lru_cache
from hashlib import sha256

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from cow_service.generators.wan.pipeline import ImageEmbedding, WanTrackPipeline

MAX_TEXTS = 64  # one is 4 MB in bfloat16
MAX_IMAGES = 8  # one is 11 MB at 832 x 480 x 81


class EmbeddingCache:
    """The least recently used embeddings are dropped. Not safe for two threads at a time."""

    def __init__(self, pipeline: WanTrackPipeline) -> None:
        self._pipeline = pipeline
        self._images: OrderedDict[tuple[object, ...], ImageEmbedding] = OrderedDict()
        self.text = lru_cache(MAX_TEXTS)(self._text)

    def image(self, image: NDArray[np.uint8], width: int, height: int, num_frames: int) -> ImageEmbedding:
        """Embedding of the first frame of a clip of this size (px) and length."""
        key = (sha256(image.tobytes()).digest(), image.shape, width, height, num_frames)
        if key not in self._images:
            self._images[key] = self._pipeline.embed_image(image, width, height, num_frames)
        self._images.move_to_end(key)
        if len(self._images) > MAX_IMAGES:
            self._images.popitem(last=False)
        return self._images[key]

    def _text(self, text: str) -> Tensor:
        """Embeddings [1, 512, C]."""
        return self._pipeline.embed_text(text)

    def clear(self) -> None:
        """Drops everything."""
        self.text.cache_clear()
        self._images.clear()
