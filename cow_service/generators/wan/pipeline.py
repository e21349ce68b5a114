"""diffusers' image-to-video pipeline in three parts that can be timed, cached and canceled: encode, denoise, decode.

The encoding methods and the models are those of the parent class.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from diffusers import UniPCMultistepScheduler, WanImageToVideoPipeline
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from cow_service.generators.wan.checkpoints import TEXT_LENGTH
from cow_service.generators.wan.denoising import Conditioning, StepCallback, denoise
from cow_service.generators.wan.sampling import Sampling

LATENT_CHANNELS = 16


@dataclass(frozen=True)
class ImageEmbedding:
    """The first frame as the model takes it."""

    embeds: Tensor  # [1, tokens, C] of the image encoder
    condition: Tensor  # [20, T, h, w] float32: 4 mask channels, 16 latent channels


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

    def denoise(self, noise: Tensor, given: Conditioning, sampling: Sampling, on_step: StepCallback) -> Tensor:
        """As `denoising.denoise`, in this process alone."""
        return denoise(self.transformer, self._execution_device, noise, given, sampling, on_step)

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
