"""diffusers' image-to-video pipeline in three parts that can be timed, cached and canceled: encode, denoise, decode.

The encoding methods and the models are those of the parent class. Added are a condition that differs between the
guided and the unconditional pass, guidance over a window of steps, and a callback after every step.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
import torch
from diffusers import UniPCMultistepScheduler, WanImageToVideoPipeline
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from cow_service.generators.wan.acceleration import reset_cache
from cow_service.generators.wan.checkpoints import TEXT_LENGTH
from cow_service.generators.wan.execution import wait_until_done
from cow_service.generators.wan.sampling import Sampling

LATENT_CHANNELS = 16

StepCallback = Callable[[int, int], None]


@dataclass(frozen=True)
class ImageEmbedding:
    """The first frame as the model takes it."""

    embeds: Tensor  # [1, tokens, C] of the image encoder
    condition: Tensor  # [20, T, h, w] float32: 4 mask channels, 16 latent channels


@dataclass(frozen=True)
class Conditioning:
    """All that conditions the denoising of one clip."""

    prompt: Tensor  # [1, 512, C] text embeddings
    negative_prompt: Tensor | None  # [1, 512, C]; None where no step is guided
    image: Tensor  # [1, tokens, C] of the image encoder
    condition: Tensor  # [20, T, h, w] of the guided pass
    unconditional: Tensor  # [20, T, h, w] of the unconditional pass


def compose(**parts: Any) -> WanTrackPipeline:
    """A pipeline of `transformer`, `vae`, `text_encoder`, `image_encoder`, `tokenizer` and `image_processor`.

    The parent class requires a scheduler, which is not used: every clip is sampled with one of its own.
    """
    scheduler = UniPCMultistepScheduler(prediction_type="flow_prediction", use_flow_sigmas=True, flow_shift=3.0)
    return WanTrackPipeline(scheduler=scheduler, **parts)  # pyright: ignore[reportArgumentType]: any flow scheduler


def latent_shape(width: int, height: int, num_frames: int) -> tuple[int, int, int, int, int]:
    """[1, 16, T, h, w] for a clip of this size (px, multiples of 16) and length (4n + 1 frames)."""
    return 1, LATENT_CHANNELS, (num_frames - 1) // 4 + 1, height // 8, width // 8


def token_count(width: int, height: int, num_frames: int) -> int:
    """Tokens of such a clip, in every layer of the transformer: its patches are 2 x 2 latent cells."""
    _, _, frames, rows, columns = latent_shape(width, height, num_frames)
    return frames * (rows // 2) * (columns // 2)


def image_token_count(image_encoder: Any) -> int:
    """Tokens of the image encoder: its patches, and one for the whole."""
    config = image_encoder.config
    return (config.image_size // config.patch_size) ** 2 + 1


class WanTrackPipeline(WanImageToVideoPipeline):
    """The steps of making one clip. Not safe for two clips at a time."""

    @torch.no_grad()
    def embed_text(self, text: str) -> Tensor:
        """Text embeddings [1, 512, C]."""
        embeds, _ = self.encode_prompt(
            prompt=text,
            do_classifier_free_guidance=False,
            max_sequence_length=TEXT_LENGTH,
            device=self._execution_device,
        )
        return embeds

    @torch.no_grad()
    def embed_image(self, image: NDArray[np.uint8], width: int, height: int, num_frames: int) -> ImageEmbedding:
        """Both encodings of the first frame, RGB [H, W, 3] of any size, for a clip of `width` x `height` px."""
        device = self._execution_device
        picture = Image.fromarray(image)
        # The image encoder takes a square: the whole image is squeezed, as in the public implementation. The pipeline's
        # own processor would crop its centre.
        side = self.image_encoder.config.image_size
        embeds = self.encode_image(picture.resize((side, side), Image.Resampling.BICUBIC), device)
        pixels = self.video_processor.preprocess(picture, height=height, width=width).to(device, torch.float32)
        _, condition = self.prepare_latents(
            pixels,
            batch_size=1,
            num_channels_latents=LATENT_CHANNELS,
            height=height,
            width=width,
            num_frames=num_frames,
            dtype=torch.float32,
            device=device,
            latents=torch.empty(0),  # unused: only the condition is taken from here, the noise is drawn per clip
        )
        return ImageEmbedding(embeds, condition[0])

    @torch.no_grad()
    def denoise(self, noise: Tensor, given: Conditioning, sampling: Sampling, on_step: StepCallback) -> Tensor:
        """Latents [1, 16, T, h, w] from noise of that shape.

        `on_step(done, total)` is called when the device has done a step, and may raise to cancel.
        """
        device = self._execution_device
        dtype = cast(torch.dtype, self.transformer.dtype)  # found by a walk over all weights: once per clip
        schedule = sampling.schedule(device)
        latents = noise.to(device, torch.float32)
        guided, unguided = (part.to(latents)[None] for part in (given.condition, given.unconditional))
        image, prompt = given.image.to(dtype), given.prompt.to(dtype)
        negative = None if given.negative_prompt is None else given.negative_prompt.to(dtype)
        reset_cache(self.transformer, sampling.steps)
        try:
            for step, time in enumerate(schedule.timesteps):
                states = torch.cat([latents, guided], dim=1).to(dtype)
                velocity = self._velocity("cond", states, time, prompt, image)
                if negative is not None and sampling.guides(step):
                    states = torch.cat([latents, unguided], dim=1).to(dtype)
                    plain = self._velocity("uncond", states, time, negative, image)
                    velocity = plain + sampling.guidance_scale * (velocity - plain)
                latents = schedule.step(velocity, time, latents, return_dict=False)[0]
                wait_until_done(device)  # else a solver that never reads a value tells of steps before they are done
                on_step(step + 1, sampling.steps)
        finally:  # what was kept for the next step would lie in memory while the clip is decoded
            reset_cache(self.transformer, sampling.steps)
        return latents

    @torch.no_grad()
    def decode(self, latents: Tensor) -> NDArray[np.uint8]:
        """Frames RGB [F, height, width, 3] of latents [1, 16, T, h, w]."""
        vae = self.vae
        latents = latents.to(self._execution_device, vae.dtype)
        mean, std = (
            torch.tensor(values, device=latents.device, dtype=latents.dtype).view(1, -1, 1, 1, 1)
            for values in (vae.config.latents_mean, vae.config.latents_std)
        )
        video = vae.decode(latents * std + mean, return_dict=False)[0][0]  # [3, F, height, width] in -1..1
        pixels = (video.float() / 2 + 0.5).clamp(0, 1).mul(255).round().to(torch.uint8)
        return pixels.permute(1, 2, 3, 0).cpu().numpy()

    def _velocity(self, branch: str, states: Tensor, time: Tensor, text: Tensor, image: Tensor) -> Tensor:
        """The model's velocity [1, 16, T, h, w] in float32, so that guidance and solver lose nothing to bfloat16."""
        transformer: Any = self.transformer
        with transformer.cache_context(branch):
            return transformer(
                hidden_states=states,
                timestep=time.expand(1),
                encoder_hidden_states=text,
                encoder_hidden_states_image=image,
                return_dict=False,
            )[0].float()
