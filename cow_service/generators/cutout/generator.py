"""The generator `cutout`: all bodies that move are drawn as sprites along their paths, in the order of their depths."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

from cow_service import __version__
from cow_service.generators.base import GeneratorInput
from cow_service.generators.cutout.composition import Compositor
from cow_service.generators.cutout.layers import MAX_SIDE, CutoutOptions
from cow_service.records import GeneratorInfo
from cow_service.settings import Settings
from cow_service.vision.masks import Image, scaled_size

__all__ = ["MAX_SIDE", "CutoutGenerator", "CutoutOptions", "create"]


class CutoutGenerator:
    """Milliseconds per frame, no weights. It moves and turns sprites: nothing breaks, and no other side is seen."""

    options_model = CutoutOptions
    concurrency = None
    fingerprint = f"cutout {__version__}"

    def describe(self, given: GeneratorInput) -> GeneratorInfo:
        """The same image, trajectory and version give the same frames; the seed changes nothing."""
        return GeneratorInfo(name="cutout", revision=__version__, seed=given.seed, options=given.options.model_dump())

    def nearest_lengths(self, num_frames: int) -> tuple[int, ...]:
        """Any length."""
        return (num_frames,)

    def size(self, width: int, height: int) -> tuple[int, int]:
        """The image's own size, up to 1280 px on the longer side."""
        return scaled_size(width, height, min(1.0, MAX_SIDE / max(width, height)))

    def render(
        self, given: GeneratorInput, indices: Sequence[int], progress: Callable[[float], None]
    ) -> Iterator[Image]:
        """The frames of these indices, RGB [h, w, 3]; only the windows of what moves are composed."""
        source, earlier = (given, 0) if given.before is None else (given.before, 1)
        compositor = Compositor.of(source)
        for done, index in enumerate(indices):
            progress(done / len(indices))
            yield compositor.frame(index + earlier)


def create(settings: Settings) -> CutoutGenerator:
    """Factory for the registry."""
    return CutoutGenerator()
