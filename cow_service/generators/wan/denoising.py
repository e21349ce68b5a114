"""From noise to latents: the steps of one clip, which one process takes or several share.

Other than in diffusers' pipeline, the condition differs between the guided and the unconditional pass, guidance holds
for a window of steps, and a callback is called after every step.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias, cast

import torch
from torch import Tensor

from cow_service.generators.wan.execution import wait_until_done
from cow_service.generators.wan.sampling import Sampling
from cow_service.generators.wan.step_caches import reset_cache

Branch: TypeAlias = Literal["cond", "uncond"]  # the guided and the unconditional pass of a step
StepCallback: TypeAlias = Callable[[int, int], None]
# What a pass comes to, a tensor like the last argument, whoever computes it: the function may be called, or not.
Share: TypeAlias = Callable[[Branch, Callable[[], Tensor], Tensor], Tensor]


@dataclass(frozen=True)
class Conditioning:
    """All that conditions the denoising of one clip."""

    prompt: Tensor  # [1, 512, C] text embeddings
    negative_prompt: Tensor | None  # [1, 512, C]; None where no step is guided
    image: Tensor  # [1, tokens, C] of the image encoder
    condition: Tensor  # [20, T, h, w] of the guided pass
    unconditional: Tensor  # [20, T, h, w] of the unconditional pass


Denoise: TypeAlias = Callable[[Tensor, Conditioning, Sampling, StepCallback], Tensor]


def alone(branch: Branch, compute: Callable[[], Tensor], like: Tensor) -> Tensor:
    """Computes every pass here."""
    return compute()


@torch.no_grad()
def denoise(
    transformer: object,
    device: torch.device,
    noise: Tensor,
    given: Conditioning,
    sampling: Sampling,
    on_step: StepCallback,
    share: Share = alone,
) -> Tensor:
    """Latents [1, 16, T, h, w] from noise of that shape.

    `on_step(done, total)` is called when the device has done a step, and may raise to cancel.
    """
    model: Any = transformer
    dtype = cast(torch.dtype, model.dtype)  # found by a walk over all weights: once per clip
    schedule = sampling.schedule(device)
    latents = noise.to(device, torch.float32)
    guided, unguided = (part.to(latents)[None] for part in (given.condition, given.unconditional))
    image, prompt = given.image.to(device, dtype), given.prompt.to(device, dtype)
    negative = None if given.negative_prompt is None else given.negative_prompt.to(device, dtype)

    def velocity_of(branch: Branch, condition: Tensor, time: Tensor, text: Tensor) -> Tensor:
        """[1, 16, T, h, w] in float32, so that guidance and solver lose nothing to bfloat16."""

        def compute() -> Tensor:
            with model.cache_context(branch):
                return model(
                    hidden_states=torch.cat([latents, condition], dim=1).to(dtype),
                    timestep=time.expand(1),
                    encoder_hidden_states=text,
                    encoder_hidden_states_image=image,
                    return_dict=False,
                )[0].float()

        return share(branch, compute, latents)

    branches = 1 if negative is None else 2
    reset_cache(model, sampling.steps, branches)
    try:
        for step, time in enumerate(schedule.timesteps):
            velocity = velocity_of("cond", guided, time, prompt)
            if negative is not None and sampling.guides(step):
                plain = velocity_of("uncond", unguided, time, negative)
                velocity = plain + sampling.guidance_scale * (velocity - plain)
            latents = schedule.step(velocity, time, latents, return_dict=False)[0]
            wait_until_done(device)  # else a solver that never reads a value tells of steps before they are done
            on_step(step + 1, sampling.steps)
    finally:  # what was kept for the next step would lie in memory while the clip is decoded
        reset_cache(model, sampling.steps, branches)
    return latents
