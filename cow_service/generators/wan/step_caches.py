"""Caches that skip most of the transformer in steps that would change little: two of diffusers', one of cache-dit."""

from __future__ import annotations

import os
import sys
from typing import Any

import torch

from cow_service.generators.wan.profiles import Acceleration

WARM_UP_SHARE = 5  # the first fifth of the steps is never skipped, as with mag
MAX_SKIPPED = 3  # steps in a row, as with mag
FIRST_LAYERS = 5  # a fifth of the layers is computed in every step, and decides


def enable_cache(transformer: Any, wanted: Acceleration) -> None:
    """Puts the cache that is wanted around the blocks of a transformer."""
    if wanted.cache == "first-block":
        from diffusers.hooks.first_block_cache import FirstBlockCacheConfig  # noqa: PLC0415

        transformer.enable_cache(FirstBlockCacheConfig(threshold=wanted.cache_threshold))
    elif wanted.cache == "mag":
        from diffusers.hooks.mag_cache import MagCacheConfig  # noqa: PLC0415

        ratios = torch.tensor(wanted.mag_ratios)
        config: Any = MagCacheConfig(
            threshold=wanted.cache_threshold, num_inference_steps=len(ratios), mag_ratios=ratios
        )
        config.measured = ratios
        transformer.enable_cache(config)
    else:
        _enable_dbcache(transformer, wanted)


def reset_cache(transformer: object, steps: int | None = None, branches: int = 2) -> None:
    """Clears the step cache. Call it before every clip, so that no residual of one clip enters the next.

    `steps`: denoising steps of the coming clip; by default one per ratio of mag. `branches`: passes of each step here.
    Run every pass in `transformer.cache_context("cond")` or `("uncond")`, one after the other: each has its own state.
    """
    model: Any = transformer
    if "cache_dit" in sys.modules and _is_dbcached(model):
        _reset_dbcache(model, steps, branches)
        return
    from diffusers.hooks.mag_cache import MagCacheConfig, nearest_interp  # noqa: PLC0415

    model._reset_stateful_cache()
    config = model._cache_config
    if isinstance(config, MagCacheConfig):  # the hooks of all blocks share this one object
        ratios = config.measured  # pyright: ignore[reportAttributeAccessIssue] - of `enable_cache`
        config.num_inference_steps = steps or len(ratios)
        config.mag_ratios = nearest_interp(ratios, config.num_inference_steps)


def _enable_dbcache(transformer: Any, wanted: Acceleration) -> None:
    os.environ.setdefault("CACHE_DIT_LOG_LEVEL", "WARNING")
    import cache_dit  # noqa: PLC0415

    if _is_dbcached(transformer):
        raise ValueError("a cache has already been enabled")
    config = cache_dit.DBCacheConfig(
        Fn_compute_blocks=max(1, len(transformer.blocks) // FIRST_LAYERS),
        residual_diff_threshold=wanted.cache_threshold,
        max_continuous_cached_steps=MAX_SKIPPED,
        enable_separate_cfg=True,
    )
    order = wanted.cache_taylor_order
    calibrator = (
        # The text is the same in every step.
        cache_dit.TaylorSeerCalibratorConfig(taylorseer_order=order, enable_encoder_calibrator=False) if order else None
    )
    cache_dit.enable_cache(transformer, cache_config=config, calibrator_config=calibrator)


def _is_dbcached(transformer: Any) -> bool:
    return getattr(transformer, "_is_cached", False)  # set by cache-dit


def _reset_dbcache(transformer: Any, steps: int | None, branches: int) -> None:
    import cache_dit  # noqa: PLC0415

    changed = cache_dit.DBCacheConfig().reset(
        num_inference_steps=steps,
        max_warmup_steps=None if steps is None else -(-steps // WARM_UP_SHARE),
        enable_separate_cfg=branches == 2,
    )
    cache_dit.refresh_context(transformer, cache_config=changed)
    for name in transformer._context_names:  # else the old one would be held until the next pass
        transformer._context_manager.set_context(name)
