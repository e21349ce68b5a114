"""Models and clips for `wan_speed.py`: a manifest's pipeline with random weights, and one clip of it part by part.

Nothing is downloaded: weights of the real size are made where they run. The time of a pass does not depend on their
values, unless a cache decides by them whether to skip it.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Generator, Iterable
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from importlib import import_module
from itertools import pairwise
from typing import Any, ParamSpec, TypeVar, cast

import numpy as np
import torch
from accelerate import init_empty_weights
from diffusers import AutoencoderKLWan, WanImageToVideoPipeline, WanTransformer3DModel
from diffusers.utils.import_utils import is_ftfy_available
from numpy.typing import NDArray
from PIL import Image
from torch import nn
from transformers import CLIPImageProcessor, CLIPVisionConfig, CLIPVisionModel, UMT5Config, UMT5EncoderModel

from cow_service.generators.wan import conditioning
from cow_service.generators.wan.acceleration import accelerate
from cow_service.generators.wan.checkpoints import diffusers_config
from cow_service.generators.wan.pipeline import Conditioning, WanTrackPipeline, latent_shape, token_count
from cow_service.generators.wan.profiles import Profile, Sampling
from cow_service.generators.wan.tiny import make_tiny
from cow_service.generators.wan.tracks import Tracks
from cow_service.weights.manifests import Manifest, load_manifests

SEED = 0
SPREAD = 0.02  # of the random weights: what such models start their training with
# umt5-xxl and CLIP ViT-H, as in the configurations of Wan2.1's weights.
TEXT_ENCODER: dict[str, Any] = {
    "vocab_size": 256384, "d_model": 4096, "d_kv": 64, "d_ff": 10240, "num_layers": 24, "num_heads": 64,
    "feed_forward_proj": "gated-gelu",
}  # fmt: skip
IMAGE_ENCODER: dict[str, Any] = {
    "hidden_size": 1280, "intermediate_size": 5120, "num_hidden_layers": 32, "num_attention_heads": 16,
    "image_size": 224, "patch_size": 14, "hidden_act": "gelu",
}  # fmt: skip
PROMPT = "The yellow ball rolls from the left to the right across the table and touches the blue mug."
TRACKS, ANCHORS = 9, 24

P = ParamSpec("P")
R = TypeVar("R")


@dataclass(frozen=True)
class Case:
    """What is measured: clips of one size from a model on a device."""

    manifest: Manifest
    device: torch.device
    num_frames: int
    width: int
    height: int
    steps: int | None  # instead of those of the profile
    runs: int

    @property
    def toy(self) -> bool:
        """The service itself makes the model from nothing."""
        return not self.manifest.sources

    @property
    def tokens(self) -> int:
        """Of the video, in every layer."""
        return token_count(self.width, self.height, self.num_frames)

    @cached_property
    def picture(self) -> NDArray[np.uint8]:
        """A first frame, RGB [height, width, 3]."""
        return np.random.default_rng(SEED).integers(0, 256, (self.height, self.width, 3), np.uint8)

    @cached_property
    def tracks(self) -> Tracks:
        """Some tracks half across the picture, then still ones."""
        start = np.random.default_rng(SEED).random((TRACKS + ANCHORS, 2)) * (self.width, self.height)
        way = np.zeros_like(start)
        way[:TRACKS, 0] = self.width / 2
        points = start + np.linspace(0, 1, self.num_frames)[:, None, None] * way
        return Tracks(points.astype(np.float32), points[..., 0] < self.width)

    @property
    def negative(self) -> str:
        """The model's negative prompt."""
        return str(self.manifest.defaults.get("negative_prompt", ""))

    def sampled(self, sampling: Sampling) -> Sampling:
        """The sampling with the steps that were asked for."""
        return sampling if self.steps is None else sampling.model_copy(update={"steps": self.steps})


class Clock:
    """Seconds by part; at every look the device has finished its work."""

    def __init__(self, device: torch.device) -> None:
        self._device = device
        self.parts: dict[str, float] = {}

    def now(self) -> float:
        """Seconds since some moment."""
        if self._device.type == "cuda":
            torch.cuda.synchronize(self._device)
        return time.perf_counter()

    @contextmanager
    def part(self, name: str) -> Generator[None]:
        """Adds the time inside to a part."""
        begun = self.now()
        yield
        self.parts[name] = self.parts.get(name, 0.0) + self.now() - begun

    def around(self, name: str, function: Callable[P, R]) -> Callable[P, R]:
        """The function, with its time added to a part."""

        def timed(*args: P.args, **kwargs: P.kwargs) -> R:
            with self.part(name):
                return function(*args, **kwargs)

        return timed


@dataclass(frozen=True)
class Passes:
    """Counts passes through a transformer, and those of them whose layers a cache did not skip."""

    all: list[int] = field(default_factory=list)
    computed: list[int] = field(default_factory=list)

    def watch(self, transformer: nn.Module) -> None:
        """From now on. After `accelerate`, so that nothing that is compiled is changed by it."""

        def passed(module: nn.Module, args: object) -> None:
            self.all.append(1)

        def computed(module: nn.Module, args: object) -> None:
            self.computed.append(1)

        transformer.register_forward_pre_hook(passed)
        # A cache is a hook of diffusers' own, which calls the layer's original forward unless it skips it.
        registry = getattr(cast(Any, transformer).blocks[-1], "_diffusers_hook", None)
        references = [hook.fn_ref for hook in registry.hooks.values()] if registry else []
        caching = next((reference for reference in references if reference.original_forward is not None), None)
        if caching is None:
            transformer.register_forward_pre_hook(computed)
            return
        caching.original_forward = self._counting(caching.original_forward)

    def _counting(self, original: Callable[..., Any]) -> Callable[..., Any]:
        def counted(*args: Any, **kwargs: Any) -> Any:
            self.computed.append(1)
            return original(*args, **kwargs)

        return counted


@dataclass(frozen=True)
class Timing:
    """One clip: seconds of its parts, which add up to the total, and of its steps; passes through the transformer."""

    parts: dict[str, float]
    steps: list[float]
    total: float
    passes: int
    computed: int


class Studio:
    """A pipeline that is ready to run, as a profile has it or, without one, as diffusers has it."""

    def __init__(self, case: Case, profile: Profile | None) -> None:
        self._case = case
        self._clock = Clock(case.device)
        self._passes = Passes()
        begun = self._clock.now()
        if profile is None:
            self.pipeline = build_plain(case)
            self._film = film_plain
        else:
            self.pipeline = build(case, profile)
            accelerate(self.pipeline, profile.acceleration, case.device)
            self._film = film_tracks
        self.built = self._clock.now() - begun  # seconds
        self._passes.watch(cast(nn.Module, self.pipeline.transformer))
        time_parts(self.pipeline, self._clock)

    def clip(self, sampling: Sampling) -> Timing:
        """One clip; `other` is what no part has taken."""
        clock, passes = self._clock, self._passes
        for count in (clock.parts, passes.all, passes.computed):
            count.clear()
        begun = clock.now()
        moments = self._film(cast(Any, self.pipeline), self._case, clock, sampling)
        total = clock.now() - begun
        parts = {**clock.parts, "denoising": moments[-1] - moments[0]}
        parts["other"] = total - sum(parts.values())
        steps = [after - before for before, after in pairwise(moments)]
        return Timing(parts, steps, total, len(passes.all), len(passes.computed))


def time_parts(pipeline: object, clock: Clock) -> None:
    """Has the encoders' time added to their parts from now on."""
    parts: Any = pipeline
    parts.encode_prompt = clock.around("text encoder", parts.encode_prompt)
    parts.encode_image = clock.around("image encoder", parts.encode_image)
    parts.vae.encode = clock.around("VAE encode", parts.vae.encode)


def film_tracks(pipeline: WanTrackPipeline, case: Case, clock: Clock, sampling: Sampling) -> list[float]:
    """A clip as the service makes its first; the moments at which its first step began and each step ended."""
    drawn = torch.Generator().manual_seed(SEED)
    noise = torch.randn(latent_shape(case.width, case.height, case.num_frames), generator=drawn)
    try:
        image = pipeline.embed_image(case.picture, case.width, case.height, case.num_frames)
        with clock.part("condition"):
            method = conditioning.wan_move if "wan-move" in case.manifest.name else conditioning.ati
            guided, plain = method(image.condition, case.tracks, case.width, case.height)
        texts = pipeline.embed_text(PROMPT), pipeline.embed_text(case.negative)
        moments = [clock.now()]
        given = Conditioning(*texts, image.embeds, guided, plain)
        latents = pipeline.denoise(noise, given, sampling, lambda done, steps: moments.append(clock.now()))
        with clock.part("decode"):
            pipeline.decode(latents)
    finally:
        pipeline.maybe_free_model_hooks()
    return moments


def film_plain(pipeline: WanImageToVideoPipeline, case: Case, clock: Clock, sampling: Sampling) -> list[float]:
    """A clip by diffusers' own call; the moments at which its first step began and each step ended."""
    moments: list[float] = []
    parts: Any = pipeline
    bar = parts.progress_bar

    def begin(*args: Any, **kwargs: Any) -> Any:
        moments.append(clock.now())
        return bar(*args, **kwargs)

    def step_ended(*_: Any) -> dict[str, Any]:
        moments.append(clock.now())
        return {}

    parts.progress_bar = begin  # nothing else is called just before the first step
    try:
        parts(
            image=Image.fromarray(case.picture),
            prompt=PROMPT,
            negative_prompt=case.negative,
            width=case.width,
            height=case.height,
            num_frames=case.num_frames,
            num_inference_steps=sampling.steps,
            guidance_scale=sampling.guidance_scale,
            callback_on_step_end=step_ended,
        )
    finally:
        parts.progress_bar = bar
    clock.parts["decode"] = clock.now() - moments[-1]
    return moments


def build(case: Case, profile: Profile) -> WanTrackPipeline:
    """The manifest's pipeline as the service loads it, before `accelerate`; without the profile's LoRA."""
    if case.toy:
        pipeline = make_tiny(case.manifest.architecture)
    else:
        # Where parts are offloaded they start on the CPU.
        place = case.device if profile.acceleration.offload == "none" else torch.device("cpu")
        dtype, vae_dtype = (getattr(torch, name) for name in (profile.dtype, profile.vae_dtype))
        pipeline = _random_pipeline(case, dtype, vae_dtype, place)
    pipeline.set_progress_bar_config(disable=True)
    return pipeline


def build_plain(case: Case) -> WanImageToVideoPipeline:
    """diffusers' own pipeline in the precisions that its documentation gives, on the device, with nothing changed."""
    parts = (
        make_tiny(case.manifest.architecture)
        if case.toy
        else _random_pipeline(case, torch.bfloat16, torch.float32, case.device)
    )
    pipeline = WanImageToVideoPipeline(**parts.components)
    # diffusers' default, said because the choice of a profile that ran before holds for the whole process.
    pipeline.transformer.set_attention_backend("native")
    pipeline.set_progress_bar_config(disable=True)
    return pipeline.to(case.device)


def empty_parts(manifest: Manifest) -> dict[str, Any]:
    """Transformer, text encoder, image encoder and VAE at the real size. Only buffers and the VAE have memory."""
    with init_empty_weights():
        transformer = WanTransformer3DModel(**diffusers_config(manifest.architecture))
        text_encoder = UMT5EncoderModel(UMT5Config(**TEXT_ENCODER))
        image_encoder = CLIPVisionModel(CLIPVisionConfig(**IMAGE_ENCODER))
    text_encoder.tie_weights()
    vae = AutoencoderKLWan()
    return {"transformer": transformer, "text_encoder": text_encoder, "image_encoder": image_encoder, "vae": vae}


def do_without_ftfy() -> bool:
    """Lets texts be encoded where ftfy is not installed, which diffusers calls all the same; whether that was so."""
    if is_ftfy_available():
        return False
    module: Any = import_module("diffusers.pipelines.wan.pipeline_wan_i2v")
    module.prompt_clean = str.strip
    return True


def _random_pipeline(case: Case, dtype: torch.dtype, vae_dtype: torch.dtype, place: torch.device) -> WanTrackPipeline:
    """Made on the case's device, whose random numbers are fast, and put to `place`; its image encoder is float32.

    Tokenizer and scheduler are the toy's: neither takes time.
    """
    parts = empty_parts(case.manifest)
    fill(parts["transformer"], dtype, case.device, place, parts["transformer"]._keep_in_fp32_modules)
    # transformers keeps nothing in float32, unless all the rest is float16.
    fill(parts["text_encoder"], dtype, case.device, place)
    fill(parts["image_encoder"], torch.float32, case.device, place)
    parts["text_encoder"].tie_weights()
    for part in parts.values():
        part.to(place).eval().requires_grad_(False)
    parts["vae"].to(vae_dtype)
    toy = make_tiny(load_manifests()["tiny-ati"].architecture)
    return WanTrackPipeline(
        tokenizer=toy.tokenizer, image_processor=CLIPImageProcessor(), scheduler=toy.scheduler, **parts
    )


def fill(
    model: nn.Module, dtype: torch.dtype, device: torch.device, place: torch.device, precise: Iterable[str] = ()
) -> None:
    """Gives every parameter memory and values, those of modules named `precise` in float32.

    Scales of norms are 1, all else is small and normal.
    """
    kept = set(precise)
    drawn = torch.Generator(device).manual_seed(SEED)
    for name, parameter in list(model.named_parameters()):
        owner, _, leaf = name.rpartition(".")
        kind = torch.float32 if kept & {*name.split(".")} else dtype
        values = torch.empty(parameter.shape, dtype=kind, device=device)
        if leaf == "weight" and values.ndim == 1:
            values.fill_(1)
        else:
            values.normal_(0, SPREAD, generator=drawn)
        setattr(model.get_submodule(owner), leaf, nn.Parameter(values.to(place), requires_grad=False))
