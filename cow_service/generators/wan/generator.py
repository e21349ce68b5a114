"""The generator behind `ati`, `wan-move` and their toy-sized twins: one clip from image, tracks and sentence."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from cow_service.errors import FieldError, InvalidRequest
from cow_service.generators.base import Shot
from cow_service.generators.wan.device import alone_on, on_threads, within_memory
from cow_service.generators.wan.encodings import Encodings
from cow_service.generators.wan.methods import Method
from cow_service.generators.wan.pipeline import Guide, WanTrackPipeline, latent_shape
from cow_service.generators.wan.profiles import Profile
from cow_service.generators.wan.sampling import Sampling
from cow_service.generators.wan.tracks import nearest_lengths, tracks_of
from cow_service.records import GeneratorInfo

SIDE_UNIT = 16  # px: the sides of a clip are multiples of it
LONGEST_SIDE = 1024 * SIDE_UNIT  # px: the model knows 1024 positions each way
STEPS_SHARE = 0.9  # of the progress; the rest is decoding

Image = NDArray[np.uint8]


class WanOptions(BaseModel):
    """What `generator_options` may hold for a video model. What is not given is as the profile says."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    steps: int | None = Field(default=None, ge=1, le=200, description="Denoising steps.")
    shift: float | None = Field(default=None, gt=0, le=50, description="Shift of the noise schedule.")
    guidance_scale: float | None = Field(default=None, ge=0, le=30, description="1 does without guidance.")
    prompt: str | None = Field(default=None, max_length=4000, description="By default the sentence of the motion.")
    negative_prompt: str | None = Field(default=None, max_length=4000, description="By default that of the model.")
    clean_cues: bool = Field(default=True, description="Take drawn arrows and boxes out of the first frame.")


@dataclass(frozen=True)
class Model:
    """A loaded model, and what would have to be the same to make its clips again."""

    name: str
    repository: str | None
    revision: str | None
    revisions: dict[str, str]  # of the other parts that were pulled
    pipeline: WanTrackPipeline
    device: torch.device
    profile_name: str
    profile: Profile
    method: Method
    max_area: int  # px per frame
    negative_prompt: str
    threads: int | None  # CPU threads; null leaves PyTorch's own number


class WanGenerator:
    """Wan2.1 image-to-video, conditioned on tracks. One clip at a time on its device; others wait."""

    options_model = WanOptions
    concurrency = 1

    def __init__(self, model: Model) -> None:
        self._model = model
        self._encodings = Encodings(model.pipeline)

    def nearest_lengths(self, num_frames: int) -> tuple[int, ...]:
        """4n + 1 frames, 5 to 81."""
        return nearest_lengths(num_frames)

    def size(self, width: int, height: int) -> tuple[int, int]:
        """The model's area at the image's aspect ratio, sides rounded down to multiples of 16 px.

        Raises `InvalidRequest` for an image so narrow that no clip of that shape can be made.
        """
        area = self._model.max_area
        sides = math.sqrt(area * width / height), math.sqrt(area * height / width)
        # The small term keeps an exact 480 from becoming 464 when the root is a hair below it.
        across, down = (max(SIDE_UNIT, int(side / SIDE_UNIT + 1e-6) * SIDE_UNIT) for side in sides)
        if max(across, down) > LONGEST_SIDE:
            detail = f"{width} x {height} px is too narrow for a video model: crop it"
            raise InvalidRequest(f"`image`: {detail}.", errors=(FieldError("/image", detail),))
        return across, down

    def describe(self, shot: Shot) -> GeneratorInfo:
        """The same model, revision, seed, options and inputs give the same clip on the same kind of device."""
        model, sampling = self._model, self._sampling(shot)
        acceleration = model.profile.acceleration.model_dump(exclude_defaults=True, mode="json")
        return GeneratorInfo(
            name=model.name,
            model=model.repository,
            revision=model.revision,
            seed=shot.seed,
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
                "prompt": self._prompt(shot),
                "negative_prompt": self._negative_prompt(shot) if sampling.guided else "",
                "clean_cues": _options(shot).clean_cues,
            }
            | {f"{part}_revision": revision for part, revision in model.revisions.items()}
            | {
                name: value if isinstance(value, bool | int | float | str) else str(value)
                for name, value in acceleration.items()
            },
        )

    def render(self, shot: Shot, wanted: Sequence[int], progress: Callable[[float], None]) -> Iterator[Image]:
        """The wanted frames, RGB [h, w, 3]. Raises `GeneratorOutOfMemory`, and whatever `progress` raises.

        `progress` hears of every denoising step; once it has raised, nothing more is computed.
        """
        model, frames = self._model, len(shot.trajectory.points)
        width, height = self.size(shot.scene.width, shot.scene.height)
        clip = f"A clip of {frames} frames at {width} x {height}"
        with (
            alone_on(model.device, lambda: progress(0.0)),
            on_threads(model.threads),
            within_memory(model.device, self._encodings.forget, clip),
        ):
            video = self._video(shot, width, height, progress)
        progress(1.0)
        for index in wanted:
            yield video[index]

    def _video(self, shot: Shot, width: int, height: int, progress: Callable[[float], None]) -> Image:
        """All frames [F, height, width, 3]."""
        pipeline, frames = self._model.pipeline, len(shot.trajectory.points)
        # Drawn on the CPU: a seed gives the same noise whatever the device.
        drawn = torch.Generator().manual_seed(shot.seed)
        noise = torch.randn(latent_shape(width, height, frames), generator=drawn)
        progress(0.0)
        try:
            sampling = self._sampling(shot)
            guide = self._guide(shot, width, height, guided=sampling.guided)
            progress(0.0)
            latents = pipeline.denoise(noise, guide, sampling, lambda done, steps: progress(STEPS_SHARE * done / steps))
            return pipeline.decode(latents)
        finally:
            pipeline.vae.clear_cache()  # features of a clip that was not decoded to its end
            pipeline.maybe_free_model_hooks()  # offloaded parts go back to the CPU, also after a failure

    def _guide(self, shot: Shot, width: int, height: int, *, guided: bool) -> Guide:
        scene, frames = shot.scene, len(shot.trajectory.points)
        first = scene.clean if _options(shot).clean_cues else scene.image
        picture = self._encodings.picture(first, width, height, frames)
        tracks = tracks_of(shot.trajectory, scene.width, scene.height)
        # In pixels of the clip: its sides are rounded, so that its aspect ratio is not quite the image's.
        tracks = tracks.scaled(width / scene.width, height / scene.height)
        condition, plain = self._model.method(picture.condition, tracks, width, height)
        return Guide(
            prompt=self._encodings.text(self._prompt(shot)),
            negative=self._encodings.text(self._negative_prompt(shot)) if guided else None,
            image=picture.embeds,
            condition=condition,
            plain=plain,
        )

    def _sampling(self, shot: Shot) -> Sampling:
        given = _options(shot).model_dump(include={"steps", "shift", "guidance_scale"}, exclude_none=True)
        return self._model.profile.sampling.model_copy(update=given)

    def _prompt(self, shot: Shot) -> str:
        given = _options(shot).prompt
        return shot.motion.sentence if given is None else given

    def _negative_prompt(self, shot: Shot) -> str:
        given = _options(shot).negative_prompt
        return self._model.negative_prompt if given is None else given


def _options(shot: Shot) -> WanOptions:
    return shot.options if isinstance(shot.options, WanOptions) else WanOptions()
