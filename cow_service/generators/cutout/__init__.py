"""The CPU compositor: what moves is cut out and drawn along its path, with its shadow, over an inpainted background."""

from cow_service.generators.cutout.generator import MAX_SIDE, CutoutGenerator, CutoutOptions, create

__all__ = ["MAX_SIDE", "CutoutGenerator", "CutoutOptions", "create"]
