"""Has a compiled model compile before anybody waits for it, and keeps what was compiled for the next start.

PyTorch compiles a block for the first size that it meets, and once more, for any size, when it meets a second one. The
first code stays for its own size, and is the faster one: so the size of most clips comes first.
"""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import torch

from cow_service.generators.wan.denoising import Conditioning, Denoise
from cow_service.generators.wan.pipeline import TEXT_LENGTH, WanTrackPipeline, image_token_count, latent_shape
from cow_service.generators.wan.sampling import Sampling

FRAMES = (81, 17)  # of the two clips: the longest, which is the default of most requests, then any other
CONDITION_CHANNELS = 20

log = logging.getLogger("cow_service")


class ClipSize(NamedTuple):
    """Pixels, and frames."""

    width: int
    height: int
    num_frames: int


def keep_compiled_code(folder: Path) -> None:
    """Has PyTorch keep compiled code in a folder, unless the environment names another one."""
    os.environ.setdefault("TORCHINDUCTOR_CACHE_DIR", str(folder))


def compile_for(pipeline: WanTrackPipeline, denoise: Denoise, sampling: Sampling, sizes: Iterable[ClipSize]) -> None:
    """One denoising step for a clip of each size, with zeros in place of text, image and noise; logs what it takes.

    `denoise`: the pipeline's, or that of several processes.
    """
    step = sampling.model_copy(update={"steps": 1})
    for size in sizes:
        begun = time.perf_counter()
        given = _zeros(pipeline, size, guided=step.guided)
        denoise(torch.zeros(latent_shape(*size)), given, step, lambda done, total: None)
        took = time.perf_counter() - begun
        log.info("compiled for %d x %d px and %d frames in %.1f s", *size, took)


def _zeros(pipeline: WanTrackPipeline, size: ClipSize, *, guided: bool) -> Conditioning:
    config: Any = pipeline.transformer.config
    _, _, frames, rows, columns = latent_shape(*size)
    device = pipeline._execution_device  # pyright: ignore[reportPrivateUsage] - where weights may be offloaded
    text = torch.zeros(1, TEXT_LENGTH, config.text_dim, device=device)
    tokens = image_token_count(pipeline.image_encoder)
    condition = torch.zeros(CONDITION_CHANNELS, frames, rows, columns)
    return Conditioning(
        prompt=text,
        negative_prompt=text if guided else None,
        image=torch.zeros(1, tokens, config.image_dim, device=device),
        condition=condition,
        unconditional=condition,
    )
