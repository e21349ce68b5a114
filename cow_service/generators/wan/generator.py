"""The generator behind `ati`, `wan-move` and their toy-sized twins: one clip from image, tracks and sentence."""

import logging
import math
import time
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from hashlib import sha256
from typing import TypeAlias, cast

import torch

from cow_service.concurrency import PrioritySemaphore
from cow_service.errors import FieldError, InvalidRequest
from cow_service.generators.base import GeneratorInput
from cow_service.generators.wan.conditioning import TrackConditioning
from cow_service.generators.wan.memory import within_memory
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
from cow_service.settings import Settings
from cow_service.vision.types import Image
from cow_service.weights.device import cpu_threads
from cow_service.weights.manifests import Manifest

USUAL_SIDES = 832, 480  # their ratio
SIDE_MULTIPLE = 16  # px: the sides of a clip are multiples of it
MAX_SIDE = 1024 * SIDE_MULTIPLE  # px: the model has 1024 positions each way
DENOISING_SHARE = 0.9  # of the progress; the rest is decoding
# Frames of the two clips to compile for: the longest, which is the default of most requests, then any other.
COMPILED_FRAMES = (81, 17)
CONDITION_CHANNELS = 20

ClipSize: TypeAlias = tuple[int, int, int]  # width and height (px), frames

_DEVICES: dict[str, PrioritySemaphore] = {}  # by name: each makes one clip at a time, whatever the model

log = logging.getLogger("cow_service")


def clip_size(max_area: int, width: int, height: int) -> tuple[int, int]:
    """An area (px) at an aspect ratio, sides rounded down to multiples of 16 px."""
    sides = math.sqrt(max_area * width / height), math.sqrt(max_area * height / width)
    # The small term keeps an exact 480 from becoming 464 when the root is a hair below it.
    clip_width, clip_height = (max(SIDE_MULTIPLE, int(side / SIDE_MULTIPLE + 1e-6) * SIDE_MULTIPLE) for side in sides)
    return clip_width, clip_height


@dataclass(eq=False)
class WanGenerator(WanLimits):
    """Wan2.1 image-to-video, conditioned on tracks. One clip at a time on its device; others wait."""

    concurrency = 1
    fingerprint: str = field(init=False)  # SHA-256 of everything that decides a clip besides its input

    manifest: Manifest
    settings: Settings
    revisions: dict[str, str]  # of the parts that were pulled
    weights_identity: str  # as `weights_identity`, taken before the weights were loaded
    pipeline: WanTrackPipeline
    group: RankGroup | None  # of processes that denoise with this one
    device: torch.device
    profile: Profile  # that of the settings, with the attention backend that was chosen
    conditioning: TrackConditioning

    def __post_init__(self) -> None:
        own, source = self.settings.checkpoints.get(self.manifest.name), self.manifest.sources.get("transformer")
        self._repository = own.name if own is not None else None if source is None else source.repository
        self._max_area = int(self.manifest.defaults["max_area"])  # px per frame
        self._embeddings = EmbeddingCache(self.pipeline)
        self._negative_prompt = str(self.manifest.defaults.get("negative_prompt", ""))
        threads = self.manifest.defaults.get("threads")
        self.threads = None if threads is None else int(threads)  # of the CPU; None keeps PyTorch's own number
        parts = (
            *(self.manifest.name, self._repository, sorted(self.revisions.items()), self.weights_identity),
            *(self.device.type, self.settings.profile, self.profile.model_dump_json()),
            *(self._max_area, self._negative_prompt),
        )
        self.fingerprint = sha256(repr(parts).encode()).hexdigest()

    @property
    def denoise(self) -> Denoise:
        """Of this process, or of several."""
        return (self.group or self.pipeline).denoise

    def size(self, width: int, height: int) -> tuple[int, int]:
        """Of a clip, at the image's aspect ratio, in multiples of 16 px. Raises `InvalidRequest` if too narrow."""
        clip_width, clip_height = clip_size(self._max_area, width, height)
        if max(clip_width, clip_height) > MAX_SIDE:
            detail = f"{width} x {height} px is too narrow for a video model: crop it"
            raise InvalidRequest(f"`image`: {detail}.", errors=(FieldError("/image", detail),))
        return clip_width, clip_height

    def compile(self) -> None:
        """Compiles for clips of any size, where the profile does: else the first clips would wait for it."""
        if self.profile.acceleration.compile == "none":
            return
        width, height = self.size(*USUAL_SIDES)
        with self._own_device(f"A clip of {width} x {height}", lambda: None):
            sizes = [(width, height, frames) for frames in COMPILED_FRAMES]
            compile_for(self.pipeline, self.denoise, self.profile.sampling, sizes)

    @contextmanager
    def _own_device(self, what: str, check_canceled: Callable[[], None]) -> Generator[None]:
        with (
            _DEVICES.setdefault(str(self.device), PrioritySemaphore(1)).held(check_canceled=check_canceled),
            cpu_threads(self.threads),
            within_memory(self.device, self._embeddings.clear, what),
        ):
            yield

    def close(self) -> None:
        """Ends the processes that share its clips."""
        if self.group is not None:
            self.group.close()

    def describe(self, given: GeneratorInput) -> GeneratorInfo:
        """The same model, revision, seed, options and inputs give the same clip on the same kind of device."""
        options = cast(WanOptions, given.options)  # the generator's own `options_model`
        sampling, prompt, negative = self._chosen(options, given.motion.sentence)
        changed = self.profile.acceleration.model_dump(exclude_defaults=True, mode="json").items()
        return GeneratorInfo(
            name=self.manifest.name,
            model=self._repository,
            revision=self.revisions.get("transformer"),
            seed=given.seed,
            steps=sampling.steps,
            is_toy=not self.manifest.sources,
            options={
                "profile": self.settings.profile,
                "solver": sampling.solver,
                "shift": sampling.shift,
                "guidance_scale": sampling.guidance_scale,
                "dtype": self.profile.dtype,
                "vae_dtype": self.profile.vae_dtype,
                "device": self.device.type,
                "prompt": prompt,
                "negative_prompt": negative or "",
                "clean_cues": options.clean_cues,
            }
            | {f"{part}_revision": revision for part, revision in self.revisions.items() if part != "transformer"}
            | {name: value if isinstance(value, bool | int | float | str) else str(value) for name, value in changed},
        )

    def render(
        self, given: GeneratorInput, indices: Sequence[int], progress: Callable[[float], None]
    ) -> Iterator[Image]:
        """The frames of these indices, RGB [h, w, 3]. Raises `GeneratorOutOfMemory`, and whatever `progress` raises.

        `progress` is called after every denoising step; once it has raised, nothing more is computed.
        """
        width, height = self.size(given.scene.width, given.scene.height)
        what = f"A clip of {given.trajectory.num_frames} frames at {width} x {height}"
        with self._own_device(what, lambda: progress(0.0)):
            video = self._make_clip(given, width, height, progress)
        progress(1.0)
        for index in indices:
            yield video[index]

    def _make_clip(self, given: GeneratorInput, width: int, height: int, progress: Callable[[float], None]) -> Image:
        """All frames [F, height, width, 3]."""
        # Drawn on the CPU: a seed gives the same noise whatever the device.
        random = torch.Generator().manual_seed(given.seed)
        noise = torch.randn(latent_shape(width, height, given.trajectory.num_frames), generator=random)
        progress(0.0)
        try:
            scene, options = given.scene, cast(WanOptions, given.options)
            sampling, prompt, negative = self._chosen(options, given.motion.sentence)
            first_frame = scene.clean if options.clean_cues else scene.image
            image = self._embeddings.image(first_frame, width, height, given.trajectory.num_frames)
            tracks = tracks_of(given.trajectory, scene.width, scene.height)
            # In pixels of the clip: its sides are rounded, so that its aspect ratio is not quite the image's.
            tracks = tracks.scaled(width / scene.width, height / scene.height)
            condition, unconditional = self.conditioning(image.condition, tracks, width, height)
            conditioning = Conditioning(
                prompt=self._embeddings.text(prompt),
                negative_prompt=None if negative is None else self._embeddings.text(negative),
                image=image.embeds,
                condition=condition,
                unconditional=unconditional,
            )
            if self.profile.acceleration.offload == "model":  # else the last encoder stays beside the transformer
                self.pipeline.maybe_free_model_hooks()
            progress(0.0)
            latents = self.denoise(
                noise, conditioning, sampling, lambda done, total: progress(DENOISING_SHARE * done / total)
            )
            return self.pipeline.decode(latents)
        finally:
            self.pipeline.vae.clear_cache()  # features of a clip that was not decoded to its end
            self.pipeline.maybe_free_model_hooks()  # offloaded parts go back to the CPU, also after a failure

    def _chosen(self, options: WanOptions, sentence: str) -> tuple[Sampling, str, str | None]:
        """Sampling, prompt and negative prompt, None where no step is guided: the request's, else the model's."""
        update = options.model_dump(include={"steps", "shift", "guidance_scale"}, exclude_none=True)
        sampling = self.profile.sampling.model_copy(update=update)
        prompt = sentence if options.prompt is None else options.prompt
        negative = self._negative_prompt if options.negative_prompt is None else options.negative_prompt
        return sampling, prompt, negative if sampling.is_guided else None


def compile_for(pipeline: WanTrackPipeline, denoise: Denoise, sampling: Sampling, sizes: Iterable[ClipSize]) -> None:
    """One denoising step for a clip of each size, with zeros in place of text, image and noise; logs what it takes.

    PyTorch compiles a block for the first size that it meets, and once more, for any size, when it meets a second one.
    The first code stays for its own size, and is the faster one: so the size of most clips comes first.
    """
    step = sampling.model_copy(update={"steps": 1})
    config, device = pipeline.transformer.config, pipeline.compute_device
    text = torch.zeros(1, TEXT_LENGTH, config.text_dim, device=device)
    image = torch.zeros(1, image_token_count(pipeline.image_encoder), config.image_dim, device=device)
    for size in sizes:
        begun = time.perf_counter()
        noise = torch.zeros(latent_shape(*size))
        condition = torch.zeros(CONDITION_CHANNELS, *noise.shape[2:])
        given = Conditioning(text, text if step.is_guided else None, image, condition, condition)
        denoise(noise, given, step, lambda done, total: None)
        log.info("compiled for %d x %d px and %d frames in %.1f s", *size, time.perf_counter() - begun)
