"""The generator behind `ati`, `wan-move`, `refine` and their toy-sized twins: one clip of a video model.

The inputs of a model come from the world: tracks of all bodies, what happens in words, and, where it refines one, the
compositor's clip. All of it has the model's own frame rate; the frames that are shown are those nearest in time.
"""

import logging
import math
import time
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from hashlib import sha256
from typing import TypeAlias, cast

import cv2
import numpy as np
import torch

from cow_service.concurrency import PrioritySemaphore
from cow_service.errors import FieldError, InvalidRequest
from cow_service.generators.base import GeneratorInput
from cow_service.generators.cutout.generator import compose, moving_mask
from cow_service.generators.cutout.layers import CutoutOptions, take_apart
from cow_service.generators.wan import checkpoints, memory, ranks
from cow_service.generators.wan import pipeline as wan
from cow_service.generators.wan.conditioning import CELL, TrackConditioning
from cow_service.generators.wan.profiles import Profile, Sampling, WanLimits, WanOptions
from cow_service.generators.wan.tracks import STRIDE, Tracks, clip_length, tracks_of
from cow_service.media.types import Image, Mask
from cow_service.narration.story import shown
from cow_service.physics.tracks import Density, at_rate, with_tracks
from cow_service.records import GeneratorInfo
from cow_service.settings import Settings
from cow_service.weights.device import cpu_threads
from cow_service.weights.manifests import Manifest

CAMERA = "The camera stays still."
_STRENGTHS = "coarse_strength", "object_strength"
USUAL_SIDES = 832, 480  # their ratio
PATCH = 2  # latent cells, each way: the sides of a clip are multiples of it
POSITIONS = 1024  # of tokens, that the model has each way
DENOISING_SHARE = 0.9  # of the progress; the rest is decoding
COMPILED_FRAMES = 17  # of the clip that stands for any but the longest, which is the default of most requests

ClipSize: TypeAlias = tuple[int, int, int]  # width and height (px), frames

_DEVICES: dict[str, PrioritySemaphore] = {}  # by name: each makes one clip at a time, whatever the model

log = logging.getLogger("cow_service")


def clip_size(max_area: int, width: int, height: int, cell: int = CELL) -> tuple[int, int]:
    """An area (px) at an aspect ratio, sides rounded down to multiples of two cells (px)."""
    sides, multiple = (math.sqrt(max_area * width / height), math.sqrt(max_area * height / width)), PATCH * cell
    # The small term keeps an exact 480 from becoming 464 when the root is a hair below it.
    clip_width, clip_height = (max(multiple, int(side / multiple + 1e-6) * multiple) for side in sides)
    return clip_width, clip_height


@dataclass(frozen=True)
class CoarseClip:
    """The compositor's clip, at the size and frame rate of a video model."""

    frames: Image  # [F, height, width, 3]
    moving: Mask  # [F, height, width]: where what moves is seen


@dataclass(eq=False)
class WanGenerator(WanLimits):
    """Wan image-to-video, conditioned on tracks or refining a clip. One clip at a time on its device; others wait."""

    concurrency = 1
    fingerprint: str = field(init=False)  # SHA-256 of everything that decides a clip besides its input

    manifest: Manifest
    settings: Settings
    revisions: dict[str, str]  # of the parts that were pulled
    weights_identity: str  # as `weights_identity`, taken before the weights were loaded
    pipeline: wan.WanTrackPipeline
    group: ranks.RankGroup | None  # of processes that denoise with this one
    device: torch.device
    profile: Profile  # that of the settings, with the attention backend that was chosen
    conditioning: TrackConditioning | None  # of a model that takes tracks

    def __post_init__(self) -> None:
        own, source = self.settings.checkpoints.get(self.manifest.name), self.manifest.sources.get("transformer")
        self._repository = own.name if own is not None else None if source is None else source.repository
        defaults = self.manifest.defaults
        self._max_area, self._fps = int(defaults["max_area"]), float(defaults["fps"])  # px per frame; of the model's
        self._cell, self._channels = self.pipeline.vae_scale_factor_spatial, self.pipeline.vae.config.z_dim
        self._embeddings = wan.EmbeddingCache(self.pipeline)
        self._negative_prompt = str(self.manifest.defaults.get("negative_prompt", ""))
        threads = self.manifest.defaults.get("threads")
        self.threads = None if threads is None else int(threads)  # of the CPU; None keeps PyTorch's own number
        parts = (
            *(self.manifest.name, self._repository, sorted(self.revisions.items()), self.weights_identity),
            *(self.device.type, self.settings.profile, self.profile.model_dump_json()),
            sorted(defaults.items()),
        )
        self.fingerprint = sha256(repr(parts).encode()).hexdigest()

    @property
    def denoise(self) -> wan.Denoise:
        """Of this process, or of several."""
        return (self.group or self.pipeline).denoise

    def size(self, width: int, height: int) -> tuple[int, int]:
        """Of a clip, at the image's aspect ratio, in whole patches. Raises `InvalidRequest` if too narrow."""
        clip_width, clip_height = clip_size(self._max_area, width, height, self._cell)
        if max(clip_width, clip_height) > POSITIONS * PATCH * self._cell:
            detail = f"{width} x {height} px is too narrow for a video model: crop the image"
            raise InvalidRequest(f"`image`: {detail}.", errors=(FieldError("/image", detail),))
        return clip_width, clip_height

    def compile(self) -> None:
        """Compiles for clips of any size, where the profile does: else the first clips would wait for it."""
        if self.profile.acceleration.compile == "none":
            return
        width, height = self.size(*USUAL_SIDES)
        with self._own_device(f"A clip of {width} x {height}", lambda: None):
            longest = int(self.manifest.defaults["num_frames"])
            sizes = [(width, height, frames) for frames in (longest, COMPILED_FRAMES)]
            compile_for(self.pipeline, self.denoise, self.profile.sampling, sizes)

    @contextmanager
    def _own_device(self, what: str, check_canceled: Callable[[], None]) -> Generator[None]:
        with (
            _DEVICES.setdefault(str(self.device), PrioritySemaphore(1)).held(check_canceled=check_canceled),
            cpu_threads(self.threads),
            memory.within_memory(self.device, self._embeddings.clear, what),
        ):
            yield

    def close(self) -> None:
        """Ends the processes that share its clips."""
        if self.group is not None:
            self.group.close()

    def describe(self, given: GeneratorInput) -> GeneratorInfo:
        """The same model, revision, seed, options and inputs give the same clip on the same kind of device."""
        options = cast(WanOptions, given.options)  # the generator's own `options_model`
        sampling, prompt, negative = self._chosen(options, given)
        wanted = self.profile.acceleration.model_dump(exclude_defaults=True, mode="json")
        return GeneratorInfo(
            name=self.manifest.name,
            model=self._repository,
            revision=self.revisions.get("transformer"),
            seed=given.seed,
            steps=sampling.steps - sampling.first_step,
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
                "fps": self._fps,
                "num_frames": self._length(given),
            }
            | {name: value for name in _STRENGTHS if (value := getattr(sampling, name))}
            | {f"{part}_revision": revision for part, revision in self.revisions.items() if part != "transformer"}
            | {
                name: value if isinstance(value, bool | int | float | str) else str(value)
                for name, value in wanted.items()
            },
        )

    def render(
        self, given: GeneratorInput, indices: Sequence[int], progress: Callable[[float], None]
    ) -> Iterator[Image]:
        """The frames of these indices, RGB [h, w, 3]. Raises `GeneratorOutOfMemory`, and whatever `progress` raises.

        `progress` is called after every denoising step; once it has raised, nothing more is computed.
        """
        width, height = self.size(given.scene.width, given.scene.height)
        length, rate = self._length(given), self._fps / given.trajectory.fps
        sampling, prompt, negative = self._chosen(cast(WanOptions, given.options), given)
        retimed = replace(given, trajectory=at_rate(given.trajectory, self._fps, length))
        if given.before is not None:
            before = at_rate(given.before.trajectory, self._fps, length, lead=1)
            retimed = replace(retimed, before=replace(given.before, trajectory=before))
        # What needs no device is done before it is waited for.
        coarse = coarse_clip(retimed, width, height, progress) if sampling.held_steps else None
        if coarse is not None and sampling.first_step == sampling.steps:
            video = coarse.frames  # nothing is left to sample
        else:
            tracks = None if self.conditioning is None else self._tracks(retimed, width, height)
            with self._own_device(f"A clip of {length} frames at {width} x {height}", lambda: progress(0.0)):
                video = self._make_clip(retimed, width, height, tracks, coarse, sampling, (prompt, negative), progress)
        progress(1.0)
        for index in indices:
            yield video[min(math.floor(index * rate + 0.5), length - 1)]

    def _tracks(self, given: GeneratorInput, width: int, height: int) -> Tracks:
        """On the frames of a clip (px): of its bodies, as many as the model takes, and the anchors."""
        spacing, least, most = (self.manifest.defaults[f"track_{name}"] for name in ("spacing", "least", "most"))
        scene, trajectory = given.scene, given.trajectory
        if not trajectory.tracks_given:
            masks = [scene.mover, *(each.mask for each in given.obstacles)]
            density = Density(float(spacing) * scene.width / width, int(least), int(most))
            trajectory = with_tracks(trajectory, masks, given.grounding.point, density)
        # The sides of a clip are rounded, so that its aspect ratio is not quite the image's.
        found = tracks_of(trajectory, scene.width, scene.height)
        return found.scaled(width / scene.width, height / scene.height)

    def _length(self, given: GeneratorInput) -> int:
        """Frames of the model's clip."""
        return clip_length(given.trajectory.num_frames, given.trajectory.fps, self._fps)

    def _make_clip(
        self,
        given: GeneratorInput,
        width: int,
        height: int,
        tracks: Tracks | None,
        coarse: CoarseClip | None,
        sampling: Sampling,
        texts: tuple[str, str | None],
        progress: Callable[[float], None],
    ) -> Image:
        """All frames [F, height, width, 3] of a trajectory at the model's frame rate."""
        # Drawn on the CPU: a seed gives the same noise whatever the device.
        random, length = torch.Generator().manual_seed(given.seed), given.trajectory.num_frames
        noise = torch.randn(wan.latent_shape(width, height, length, self._channels, self._cell), generator=random)
        progress(0.0)
        try:
            # Before the texts: with their encoder loaded there may be no room for the VAE.
            latents = None if coarse is None else self.pipeline.encode(coarse.frames)
            progress(0.0)
            clean, (prompt, negative) = cast(WanOptions, given.options).clean_cues, texts
            first_frame = given.scene.clean if clean else given.scene.image
            image = self._embeddings.image(first_frame, width, height, length)
            condition = unconditional = image.condition
            if self.conditioning is not None and tracks is not None:
                condition, unconditional = self.conditioning(condition, tracks, width, height)
            conditioning = wan.Conditioning(
                prompt=self._embeddings.text(prompt),
                negative_prompt=None if negative is None else self._embeddings.text(negative),
                image=image.embeds,
                condition=condition,
                unconditional=unconditional,
                coarse=latents,
                moving=None if coarse is None else latent_mask(coarse.moving, noise.shape),
            )
            if self.profile.acceleration.offload == "model":  # else the last encoder stays with the transformer
                self.pipeline.maybe_free_model_hooks()
            progress(0.0)
            latents = self.denoise(
                noise, conditioning, sampling, lambda done, total: progress(DENOISING_SHARE * done / total)
            )
            return self.pipeline.decode(latents)
        finally:
            self.pipeline.vae.clear_cache()  # features of a clip that was not decoded to its end
            self.pipeline.maybe_free_model_hooks()  # offloaded parts go back to the CPU, also after a failure

    def _chosen(self, options: WanOptions, given: GeneratorInput) -> tuple[Sampling, str, str | None]:
        """Sampling, prompt and negative prompt, None if no step is guided: the request's, else the model's."""
        update = options.model_dump(include={"steps", "shift", "guidance_scale", *_STRENGTHS}, exclude_none=True)
        sampling = self.profile.sampling.model_copy(update=update)
        prompt = options.prompt
        if prompt is None:
            trajectory, mover = given.trajectory, given.grounding.object
            # Where something is put somewhere, the motion's sentence names the place.
            is_put = trajectory.placement is not None
            prompt = given.motion.sentence if is_put else f"{shown(mover, trajectory)} {CAMERA}"
        negative = self._negative_prompt if options.negative_prompt is None else options.negative_prompt
        return sampling, prompt, negative if sampling.is_guided else None


def coarse_clip(given: GeneratorInput, width: int, height: int, progress: Callable[[float], None]) -> CoarseClip:
    """Of an input whose trajectory has the model's frame rate."""
    options = CutoutOptions(clean_cues=cast(WanOptions, given.options).clean_cues)
    source, earlier = (given, 0) if given.before is None else (given.before, 1)
    layers = take_apart(replace(source, options=options), lambda done: progress(0.0))
    frames, masks = list[Image](), list[Mask]()
    for index in range(earlier, earlier + given.trajectory.num_frames):
        progress(0.0)
        frame, mask = compose(layers, index), moving_mask(layers, index).astype(np.uint8)
        shrinks = frame.shape[1] >= width
        resampling = cv2.INTER_AREA if shrinks else cv2.INTER_CUBIC
        frames.append(np.asarray(cv2.resize(frame, (width, height), interpolation=resampling), np.uint8))
        masks.append(np.asarray(cv2.resize(mask, (width, height), interpolation=cv2.INTER_NEAREST), bool))
    return CoarseClip(np.stack(frames), np.stack(masks))


def latent_mask(moving: Mask, shape: Sequence[int]) -> torch.Tensor:
    """Which latent cells of `shape` [1, C, T, h, w] hold a part of a mask [F, height, width]: [1, 1, T, h, w]."""
    frames = torch.from_numpy(moving)
    grouped = torch.cat([frames[:1], frames[1:].unflatten(0, (-1, STRIDE)).any(dim=1)]).float()
    return torch.nn.functional.adaptive_max_pool2d(grouped, tuple(shape[3:]))[None, None] > 0


def compile_for(
    pipeline: wan.WanTrackPipeline, denoise: wan.Denoise, sampling: Sampling, sizes: Iterable[ClipSize]
) -> None:
    """One denoising step for a clip of each size, with zeros in place of text, image and noise; logs what it takes.

    PyTorch compiles a block for the first size that it meets, and once more, for any size, when it meets a second one.
    The first code stays for its own size, and is the faster one: so the size of most clips comes first.
    """
    step = sampling.model_copy(update={"steps": 1})
    config, device = pipeline.transformer.config, pipeline.compute_device
    text, image = torch.zeros(1, checkpoints.TEXT_LENGTH, config.text_dim, device=device), None
    if pipeline.image_encoder is not None:
        image = torch.zeros(1, wan.image_token_count(pipeline.image_encoder), config.image_dim, device=device)
    for size in sizes:
        begun = time.perf_counter()
        noise = torch.zeros(wan.latent_shape(*size, config.out_channels, pipeline.vae_scale_factor_spatial))
        more = config.in_channels - config.out_channels
        condition = torch.zeros(more, *noise.shape[2:]) if more else noise[0, :, :1]
        given = wan.Conditioning(text, text if step.is_guided else None, image, condition, condition)
        denoise(noise, given, step, lambda done, total: None)
        log.info("compiled for %d x %d px and %d frames in %.1f s", *size, time.perf_counter() - begun)
