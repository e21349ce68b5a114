"""The generator behind `ati`, `wan-move` and their toy-sized twins: one clip from image, tracks and sentence."""

from __future__ import annotations

import logging
import math
import os
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import NamedTuple, cast

import torch

from cow_service.errors import FieldError, InvalidRequest
from cow_service.generators.base import GeneratorInput
from cow_service.generators.wan.conditioning import TrackConditioning
from cow_service.generators.wan.memory import exclusive_use, within_memory
from cow_service.generators.wan.pipeline import (
    TEXT_LENGTH,
    Conditioning,
    Denoise,
    EmbeddingCache,
    WanTrackPipeline,
    image_token_count,
    latent_shape,
)
from cow_service.generators.wan.profiles import Profile, Sampling, WanLimits, WanOptions
from cow_service.generators.wan.ranks import RankGroup
from cow_service.generators.wan.tracks import tracks_of
from cow_service.records import GeneratorInfo
from cow_service.vision.types import Image
from cow_service.weights.device import cpu_threads

USUAL_SIDES = 832, 480  # their ratio
SIDE_MULTIPLE = 16  # px: the sides of a clip are multiples of it
MAX_SIDE = 1024 * SIDE_MULTIPLE  # px: the model has 1024 positions each way
DENOISING_SHARE = 0.9  # of the progress; the rest is decoding
# Frames of the two clips to compile for: the longest, which is the default of most requests, then any other.
COMPILED_FRAMES = (81, 17)
CONDITION_CHANNELS = 20

log = logging.getLogger("cow_service")


class ClipSize(NamedTuple):
    """Pixels, and frames."""

    width: int
    height: int
    num_frames: int


def clip_size(max_area: int, width: int, height: int) -> tuple[int, int]:
    """An area (px) at an aspect ratio, sides rounded down to multiples of 16 px."""
    sides = math.sqrt(max_area * width / height), math.sqrt(max_area * height / width)
    # The small term keeps an exact 480 from becoming 464 when the root is a hair below it.
    clip_width, clip_height = (max(SIDE_MULTIPLE, int(side / SIDE_MULTIPLE + 1e-6) * SIDE_MULTIPLE) for side in sides)
    return clip_width, clip_height


@dataclass(frozen=True)
class LoadedModel:
    """A loaded model, and what would have to be the same to make its clips again."""

    name: str
    repository: str | None
    revision: str | None
    revisions: dict[str, str]  # of the other parts that were pulled
    weights_identity: str  # as `weights_identity`, taken before the weights were loaded
    pipeline: WanTrackPipeline
    group: RankGroup | None  # of processes that denoise with this one
    device: torch.device
    profile_name: str
    profile: Profile
    conditioning: TrackConditioning
    max_area: int  # px per frame
    negative_prompt: str
    threads: int | None  # CPU threads; None keeps PyTorch's own number

    @property
    def denoise(self) -> Denoise:
        """Of this process, or of several."""
        return (self.group or self.pipeline).denoise

    @property
    def fingerprint(self) -> str:
        """SHA-256 of everything that decides a clip besides its input."""
        parts = (
            *(self.name, self.repository, self.revision, sorted(self.revisions.items()), self.weights_identity),
            *(self.device.type, self.profile_name, self.profile.model_dump_json(), self.max_area, self.negative_prompt),
        )
        return sha256(repr(parts).encode()).hexdigest()


class WanGenerator(WanLimits):
    """Wan2.1 image-to-video, conditioned on tracks. One clip at a time on its device; others wait."""

    concurrency = 1

    def __init__(self, model: LoadedModel) -> None:
        self.fingerprint = model.fingerprint
        self._model = model
        self._embeddings = EmbeddingCache(model.pipeline)

    def size(self, width: int, height: int) -> tuple[int, int]:
        """The model's area at the image's aspect ratio, sides rounded down to multiples of 16 px.

        Raises `InvalidRequest` for an image so narrow that no clip of that shape can be made.
        """
        clip_width, clip_height = clip_size(self._model.max_area, width, height)
        if max(clip_width, clip_height) > MAX_SIDE:
            detail = f"{width} x {height} px is too narrow for a video model: crop it"
            raise InvalidRequest(f"`image`: {detail}.", errors=(FieldError("/image", detail),))
        return clip_width, clip_height

    def compile(self) -> None:
        """Compiles for clips of any size, most images' first; does nothing where the profile compiles nothing.

        Else the first clip would wait for it, and the first of a second size once more.
        """
        model = self._model
        if model.profile.acceleration.compile == "none":
            return
        width, height = self.size(*USUAL_SIDES)
        sizes = [ClipSize(width, height, frames) for frames in COMPILED_FRAMES]
        with (
            exclusive_use(model.device, lambda: None),
            cpu_threads(model.threads),
            within_memory(model.device, self._embeddings.clear, f"A clip of {width} x {height}"),
        ):
            compile_for(model.pipeline, model.denoise, model.profile.sampling, sizes)

    def close(self) -> None:
        """Ends the processes that share its clips."""
        if self._model.group is not None:
            self._model.group.close()

    def describe(self, given: GeneratorInput) -> GeneratorInfo:
        """The same model, revision, seed, options and inputs give the same clip on the same kind of device."""
        model, options, sampling = self._model, _options(given), self._sampling(given)
        acceleration = model.profile.acceleration.model_dump(exclude_defaults=True, mode="json")
        return GeneratorInfo(
            name=model.name,
            model=model.repository,
            revision=model.revision,
            seed=given.seed,
            steps=sampling.steps,
            options={
                "profile": model.profile_name,
                "solver": sampling.solver,
                "shift": sampling.shift,
                "guidance_scale": sampling.guidance_scale,
                "guidance_window": str(list(sampling.guidance_window)),
                "dtype": model.profile.dtype,
                "vae_dtype": model.profile.vae_dtype,
                "device": model.device.type,
                "prompt": _prompt(given),
                "negative_prompt": self._negative_prompt(options) if sampling.guided else "",
                "clean_cues": options.clean_cues,
            }
            | {f"{part}_revision": revision for part, revision in model.revisions.items()}
            | {
                name: value if isinstance(value, bool | int | float | str) else str(value)
                for name, value in acceleration.items()
            },
        )

    def render(
        self, given: GeneratorInput, indices: Sequence[int], progress: Callable[[float], None]
    ) -> Iterator[Image]:
        """The frames of these indices, RGB [h, w, 3]. Raises `GeneratorOutOfMemory`, and whatever `progress` raises.

        `progress` is called after every denoising step; once it has raised, nothing more is computed.
        """
        model, num_frames = self._model, given.trajectory.num_frames
        width, height = self.size(given.scene.width, given.scene.height)
        with (
            exclusive_use(model.device, lambda: progress(0.0)),
            cpu_threads(model.threads),
            within_memory(model.device, self._embeddings.clear, f"A clip of {num_frames} frames at {width} x {height}"),
        ):
            video = self._video(given, width, height, progress)
        progress(1.0)
        for index in indices:
            yield video[index]

    def _video(self, given: GeneratorInput, width: int, height: int, progress: Callable[[float], None]) -> Image:
        """All frames [F, height, width, 3]."""
        model, pipeline, num_frames = self._model, self._model.pipeline, given.trajectory.num_frames
        # Drawn on the CPU: a seed gives the same noise whatever the device.
        random = torch.Generator().manual_seed(given.seed)
        noise = torch.randn(latent_shape(width, height, num_frames), generator=random)
        progress(0.0)
        try:
            sampling = self._sampling(given)
            conditioning = self._conditioning(given, width, height, guided=sampling.guided)
            if model.profile.acceleration.offload == "model":  # else the last encoder stays beside the transformer
                pipeline.maybe_free_model_hooks()
            progress(0.0)
            latents = model.denoise(
                noise, conditioning, sampling, lambda done, total: progress(DENOISING_SHARE * done / total)
            )
            return pipeline.decode(latents)
        finally:
            pipeline.vae.clear_cache()  # features of a clip that was not decoded to its end
            pipeline.maybe_free_model_hooks()  # offloaded parts go back to the CPU, also after a failure

    def _conditioning(self, given: GeneratorInput, width: int, height: int, *, guided: bool) -> Conditioning:
        scene, options = given.scene, _options(given)
        first_frame = scene.clean if options.clean_cues else scene.image
        image = self._embeddings.image(first_frame, width, height, given.trajectory.num_frames)
        tracks = tracks_of(given.trajectory, scene.width, scene.height)
        # In pixels of the clip: its sides are rounded, so that its aspect ratio is not quite the image's.
        tracks = tracks.scaled(width / scene.width, height / scene.height)
        condition, unconditional = self._model.conditioning(image.condition, tracks, width, height)
        return Conditioning(
            prompt=self._embeddings.text(_prompt(given)),
            negative_prompt=self._embeddings.text(self._negative_prompt(options)) if guided else None,
            image=image.embeds,
            condition=condition,
            unconditional=unconditional,
        )

    def _sampling(self, given: GeneratorInput) -> Sampling:
        update = _options(given).model_dump(include={"steps", "shift", "guidance_scale"}, exclude_none=True)
        return self._model.profile.sampling.model_copy(update=update)

    def _negative_prompt(self, options: WanOptions) -> str:
        return self._model.negative_prompt if options.negative_prompt is None else options.negative_prompt


def _options(given: GeneratorInput) -> WanOptions:
    return cast(WanOptions, given.options)  # the generator's own `options_model`


def _prompt(given: GeneratorInput) -> str:
    prompt = _options(given).prompt
    return given.motion.sentence if prompt is None else prompt


def keep_compiled_code(folder: Path) -> None:
    """Makes PyTorch keep compiled code in a folder for the next start, unless the environment names another one."""
    os.environ.setdefault("TORCHINDUCTOR_CACHE_DIR", str(folder))


def compile_for(pipeline: WanTrackPipeline, denoise: Denoise, sampling: Sampling, sizes: Iterable[ClipSize]) -> None:
    """One denoising step for a clip of each size, with zeros in place of text, image and noise; logs what it takes.

    PyTorch compiles a block for the first size that it meets, and once more, for any size, when it meets a second one.
    The first code stays for its own size, and is the faster one: so the size of most clips comes first.

    `denoise`: the pipeline's, or that of several processes.
    """
    step = sampling.model_copy(update={"steps": 1})
    config, device = pipeline.transformer.config, pipeline.compute_device
    text = torch.zeros(1, TEXT_LENGTH, config.text_dim, device=device)
    image = torch.zeros(1, image_token_count(pipeline.image_encoder), config.image_dim, device=device)
    for size in sizes:
        begun = time.perf_counter()
        noise = torch.zeros(latent_shape(*size))
        condition = torch.zeros(CONDITION_CHANNELS, *noise.shape[2:])
        given = Conditioning(text, text if step.guided else None, image, condition, condition)
        denoise(noise, given, step, lambda done, total: None)
        log.info("compiled for %d x %d px and %d frames in %.1f s", *size, time.perf_counter() - begun)
