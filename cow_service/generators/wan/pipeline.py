"""diffusers' image-to-video pipeline in three parts that can be timed, cached and canceled: encode, denoise, decode.

The encoding methods and the models are those of the parent class. Other than in its own loop, the condition differs
between the guided and the unconditional pass, several processes can share the steps of a clip, and a callback is called
after every step.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from hashlib import sha256
from typing import Any, Literal, TypeAlias, cast

import numpy as np
import torch
from diffusers import FlowMatchEulerDiscreteScheduler, UniPCMultistepScheduler, WanImageToVideoPipeline
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from cow_service.generators.wan import acceleration, memory
from cow_service.generators.wan.checkpoints import TEXT_LENGTH
from cow_service.generators.wan.profiles import Sampling

LATENT_CHANNELS = 16
TRAIN_STEPS = 1000
MAX_TEXTS = 64  # embeddings kept; one is 4 MB in bfloat16
MAX_IMAGES = 8  # embeddings kept; one is 11 MB at 832 x 480 x 81

Branch: TypeAlias = Literal["cond", "uncond"]  # the guided and the unconditional pass of a step
StepCallback: TypeAlias = Callable[[int, int], None]
# The result of a pass, a tensor like the last argument, whoever computes it: the function may be called, or not.
Share: TypeAlias = Callable[[Branch, Callable[[], Tensor], Tensor], Tensor]


@dataclass(frozen=True)
class ImageEmbedding:
    """The first frame as the model takes it."""

    embeds: Tensor | None  # [1, tokens, C] of the image encoder; None of a model without one
    condition: Tensor  # float32, as `Conditioning.condition`; of [20, T, h, w] the first 4 are mask channels


@dataclass(frozen=True)
class Conditioning:
    """All that conditions the denoising of one clip.

    A condition is what a model takes beside the noise: [20, T, h, w] as more channels, or, of Wan2.2-TI2V, the first
    latent frame [C, 1, h, w], which then has no noise in it.
    """

    prompt: Tensor  # [1, 512, C] text embeddings
    negative_prompt: Tensor | None  # [1, 512, C]; None if no step is guided
    image: Tensor | None  # [1, tokens, C] of the image encoder
    condition: Tensor  # of the guided pass
    unconditional: Tensor  # of the unconditional pass
    coarse: Tensor | None = None  # [1, C, T, h, w]: latents of the clip that sampling begins with
    moving: Tensor | None = None  # [1, 1, T, h, w], bool: where something moves in it


Denoise: TypeAlias = Callable[[Tensor, Conditioning, Sampling, StepCallback], Tensor]


def latent_shape(
    width: int, height: int, num_frames: int, channels: int = LATENT_CHANNELS, cell: int = 8
) -> tuple[int, int, int, int, int]:
    """[1, C, T, h, w] for a clip of this size (px, multiples of two cells) and length (4n + 1 frames)."""
    return 1, channels, (num_frames - 1) // 4 + 1, height // cell, width // cell


def token_count(width: int, height: int, num_frames: int, cell: int = 8) -> int:
    """Tokens of such a clip, in every layer of the transformer: its patches are 2 x 2 latent cells."""
    _, _, frames, rows, columns = latent_shape(width, height, num_frames, cell=cell)
    return frames * (rows // 2) * (columns // 2)


def image_token_count(image_encoder: Any) -> int:
    """Tokens of the image encoder: its patches, and one for the whole."""
    config = image_encoder.config
    return (config.image_size // config.patch_size) ** 2 + 1


def compose(**parts: Any) -> "WanTrackPipeline":
    """A pipeline of `transformer`, `vae`, `text_encoder`, `image_encoder`, `tokenizer` and `image_processor`.

    Wan2.2-TI2V has no image encoder, and no channels for a condition. The parent class requires a scheduler, which is
    not used: every clip is sampled with one of its own.
    """
    config = parts["transformer"].config
    return WanTrackPipeline(
        scheduler=FlowMatchEulerDiscreteScheduler(), expand_timesteps=config.in_channels == config.out_channels, **parts
    )


class WanTrackPipeline(WanImageToVideoPipeline):
    """The steps of making one clip. Not safe for two clips at a time."""

    @property
    def compute_device(self) -> torch.device:
        """Where the parts compute, also where their weights are offloaded."""
        return self._execution_device

    @torch.no_grad()
    def embed_text(self, text: str) -> Tensor:
        """Text embeddings [1, 512, C]."""
        embeds, _ = self.encode_prompt(
            prompt=text, do_classifier_free_guidance=False, max_sequence_length=TEXT_LENGTH, device=self.compute_device
        )
        return embeds

    @torch.no_grad()
    def embed_image(self, image: NDArray[np.uint8], width: int, height: int, num_frames: int) -> ImageEmbedding:
        """Both encodings of the first frame, RGB [H, W, 3] of any size, for a clip of `width` x `height` px."""
        device, embeds = self.compute_device, None
        picture = Image.fromarray(image)
        if self.image_encoder is not None:
            # It takes a square: the whole image is squeezed, as in the public implementation. The pipeline's own
            # processor would crop its centre.
            side = self.image_encoder.config.image_size
            embeds = self.encode_image(picture.resize((side, side), Image.Resampling.BICUBIC), device)
        pixels = self.video_processor.preprocess(picture, height=height, width=width).to(device, torch.float32)
        _, condition, *_ = self.prepare_latents(
            pixels,
            batch_size=1,
            num_channels_latents=self.vae.config.z_dim,
            height=height,
            width=width,
            num_frames=num_frames,
            dtype=torch.float32,
            device=device,
            latents=torch.empty(0),  # unused: only the condition is taken from here, the noise is drawn per clip
        )
        return ImageEmbedding(embeds, condition[0])

    def denoise(self, noise: Tensor, given: Conditioning, sampling: Sampling, on_step: StepCallback) -> Tensor:
        """As the function `denoise`, in this process alone."""
        return denoise(self.transformer, self.compute_device, noise, given, sampling, on_step)

    @torch.no_grad()
    def encode(self, video: NDArray[np.uint8]) -> Tensor:
        """Latents [1, C, T, h, w], float32, of frames RGB [F, height, width, 3]."""
        pixels = torch.from_numpy(video).permute(3, 0, 1, 2)[None].to(self.compute_device, self.vae.dtype) / 127.5 - 1
        latents = self.vae.encode(pixels, return_dict=False)[0].mode().float()
        mean, std = self._scale(latents)
        return (latents - mean) / std

    @torch.no_grad()
    def decode(self, latents: Tensor) -> NDArray[np.uint8]:
        """Frames RGB [F, height, width, 3] of latents [1, C, T, h, w]."""
        latents = latents.to(self.compute_device, self.vae.dtype)
        mean, std = self._scale(latents)
        video = self.vae.decode(latents * std + mean, return_dict=False)[0][0]  # [3, F, height, width] in -1..1
        pixels = (video.float() / 2 + 0.5).clamp(0, 1).mul(255).round().to(torch.uint8)
        return pixels.permute(1, 2, 3, 0).cpu().numpy()

    def _scale(self, like: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation of the VAE's latents, [1, C, 1, 1, 1] each."""
        mean, std = (
            torch.tensor(values, device=like.device, dtype=like.dtype).view(1, -1, 1, 1, 1)
            for values in (self.vae.config.latents_mean, self.vae.config.latents_std)
        )
        return mean, std


class EmbeddingCache:
    """Encodes the same text or image once. Drops the least recently used. Not safe for two threads at a time."""

    def __init__(self, pipeline: WanTrackPipeline) -> None:
        self._pipeline = pipeline
        self._images: dict[tuple[object, ...], ImageEmbedding] = {}  # the one that was used last is the last one
        self.text = lru_cache(MAX_TEXTS)(pipeline.embed_text)

    def image(self, image: NDArray[np.uint8], width: int, height: int, num_frames: int) -> ImageEmbedding:
        """Embedding of the first frame of a clip of this size (px) and length."""
        key = (sha256(image.tobytes()).digest(), image.shape, width, height, num_frames)
        found = self._images.pop(key, None) or self._pipeline.embed_image(image, width, height, num_frames)
        self._images[key] = found
        if len(self._images) > MAX_IMAGES:
            del self._images[next(iter(self._images))]
        return found

    def clear(self) -> None:
        """Drops everything."""
        self.text.cache_clear()
        self._images.clear()


def make_schedule(sampling: Sampling, device: torch.device, uncorrected: Sequence[int] = ()) -> Any:
    """A fresh scheduler of diffusers with its steps set; it holds the state of one clip.

    After the `uncorrected` steps the latents that it is handed count: UniPC would go on from those that it made itself.

    UniPC starts at the noise level of the public Wan2.1 implementation, 0.999 before the shift (diffusers: 1.0).
    """
    if sampling.solver == "euler":
        # Distilled weights know the noise levels 1, 1 - 1/n, ... before the shift (lightx2v: 1000, 750, 500, 250).
        schedule = FlowMatchEulerDiscreteScheduler(num_train_timesteps=TRAIN_STEPS, shift=sampling.shift)
        sigmas = [1 - i / sampling.steps for i in range(sampling.steps)]
    else:
        schedule = UniPCMultistepScheduler(
            num_train_timesteps=TRAIN_STEPS,
            prediction_type="flow_prediction",
            use_flow_sigmas=True,
            flow_shift=sampling.shift,
            disable_corrector=list(uncorrected),
        )
        sigmas = np.linspace(1 - 1 / TRAIN_STEPS, 0, sampling.steps + 1)[:-1]
    schedule.set_timesteps(sigmas=cast(Any, sigmas), device=device)
    # Steps are counted: found by their times, which are whole numbers, two with the same would be taken for one.
    schedule.set_begin_index(0)
    return schedule


@torch.no_grad()
def denoise(
    transformer: Any,
    device: torch.device,
    noise: Tensor,
    given: Conditioning,
    sampling: Sampling,
    on_step: StepCallback,
    share: Share = lambda branch, compute, like: compute(),
) -> Tensor:
    """Latents [1, C, T, h, w] from such noise. `on_step(done, total)` follows each step, and may raise to cancel.

    Where the conditioning has a coarse clip, sampling begins with that clip and noise, and puts it back for a while
    where something moves (Time-to-Move, arXiv 2511.08633).
    """
    dtype = cast(torch.dtype, transformer.dtype)  # found by a walk over all weights: once per clip
    first, held = (sampling.first_step, sampling.held_steps) if given.coarse is not None else (0, 0)
    schedule = make_schedule(sampling, device, range(first, held))
    schedule.set_begin_index(first)
    noise = noise.to(device, torch.float32)
    guided, unguided = (part.to(noise)[None] for part in (given.condition, given.unconditional))
    prompt, image = given.prompt.to(device, dtype), None if given.image is None else given.image.to(device, dtype)
    negative = None if given.negative_prompt is None else given.negative_prompt.to(device, dtype)
    coarse = None if given.coarse is None else given.coarse.to(noise)
    moving = None if given.moving is None else given.moving.to(device)
    latents = noise if coarse is None else torch.lerp(coarse, noise, float(schedule.sigmas[first]))

    def velocity_of(branch: Branch, condition: Tensor, time: Tensor, text: Tensor) -> Tensor:
        """[1, C, T, h, w] in float32, so that guidance and solver lose nothing to bfloat16."""

        def compute() -> Tensor:
            states, times = _with_condition(latents, condition, time)
            with transformer.cache_context(branch):  # each pass has its own state of the step cache
                return transformer(
                    hidden_states=states.to(dtype),
                    timestep=times,
                    encoder_hidden_states=text,
                    encoder_hidden_states_image=image,
                    return_dict=False,
                )[0].float()

        return share(branch, compute, latents)

    total = sampling.steps - first
    acceleration.reset_cache(transformer)
    try:
        for step, time in enumerate(schedule.timesteps[first:], first):
            velocity = velocity_of("cond", guided, time, prompt)
            if negative is not None and sampling.is_guided:
                plain = velocity_of("uncond", unguided, time, negative)
                velocity = plain + sampling.guidance_scale * (velocity - plain)
            latents = schedule.step(velocity, time, latents, return_dict=False)[0]
            if coarse is not None and moving is not None and step < held:
                latents = torch.where(moving, torch.lerp(coarse, noise, float(schedule.sigmas[step + 1])), latents)
            memory.wait_until_done(device)  # else a solver that never reads a value tells of steps before they are done
            on_step(step + 1 - first, total)
    finally:  # what was kept for the next step would lie in memory while the clip is decoded
        acceleration.reset_cache(transformer)
    return torch.cat([guided, latents[:, :, 1:]], dim=2) if _is_first_frame(guided, latents) else latents


def _is_first_frame(condition: Tensor, latents: Tensor) -> bool:
    """Whether a condition is the first latent frame, and not further channels."""
    return condition.shape[1] == latents.shape[1]


def _with_condition(latents: Tensor, condition: Tensor, time: Tensor) -> tuple[Tensor, Tensor]:
    """What the transformer takes: latents with their condition, and the times that tell how noisy they are."""
    if not _is_first_frame(condition, latents):
        return torch.cat([latents, condition], dim=1), time.expand(1)
    times = time.expand(latents[0, 0, :, ::2, ::2].shape).clone()  # one for each token
    times[0] = 0
    return torch.cat([condition, latents[:, :, 1:]], dim=2), times.flatten()[None]
