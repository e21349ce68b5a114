"""Makes the video generators: finds and checks their weights, loads them, applies the profile."""

from __future__ import annotations

import logging
from functools import partial
from pathlib import Path

import torch

from cow_service.errors import GeneratorOutOfMemory, GeneratorUnavailable
from cow_service.generators.wan import conditioning
from cow_service.generators.wan.acceleration import accelerate, check_device
from cow_service.generators.wan.attention import with_attention
from cow_service.generators.wan.checkpoints import checkpoint_files, load_transformer
from cow_service.generators.wan.compiling import keep_compiled_code
from cow_service.generators.wan.components import assemble
from cow_service.generators.wan.execution import within_memory
from cow_service.generators.wan.generator import USUAL_SIDES, LoadedModel, WanGenerator, clip_size
from cow_service.generators.wan.lora import add_lora
from cow_service.generators.wan.memory import check_memory
from cow_service.generators.wan.pipeline import WanTrackPipeline
from cow_service.generators.wan.profiles import Profile, profile_of
from cow_service.generators.wan.tiny import make_tiny
from cow_service.settings import Settings
from cow_service.weights.building import BUILD_LOCK
from cow_service.weights.device import choose_device
from cow_service.weights.lock import folder_of, read_lock, verify, weights_identity
from cow_service.weights.manifests import Manifest, load_manifests

log = logging.getLogger("cow_service")


def load(name: str, track_conditioning: conditioning.TrackConditioning, settings: Settings) -> WanGenerator:
    """The generator of a manifest. One without sources is built with random weights, at the sizes that it gives.

    Raises `WeightsUnavailable`, `CheckpointInvalid`, `GeneratorOutOfMemory`, or `GeneratorUnavailable` for what this
    machine cannot do.
    """
    keep_compiled_code(settings.data_dir / "compiled")  # first: PyTorch sets its own folder when it is first used
    manifest = load_manifests()[name]
    profile = profile_of(manifest, settings.profile)
    device = choose_device(settings.device, GeneratorUnavailable)
    if profile.acceleration.context_parallel > 1:
        raise GeneratorUnavailable(
            "`context_parallel` needs several processes that make the same clip; a server is one. Set COW_PROFILE."
        )
    check_device(profile.acceleration, device)
    own = settings.checkpoints.get(name)
    if own is not None:
        checkpoint_files(own)
    identity = weights_identity(manifest, settings)  # before loading: files that change later are not those loaded
    max_area = int(manifest.defaults["max_area"])
    with BUILD_LOCK, within_memory(device, lambda: None, f"'{name}'"):
        profile = with_attention(profile, manifest.architecture, *clip_size(max_area, *USUAL_SIDES), device)
        if manifest.sources:
            pipeline = _from_weights(manifest, profile, settings, device)
        else:
            pipeline = make_tiny(manifest.architecture)
        pipeline.set_progress_bar_config(disable=True)
        accelerate(pipeline, profile.acceleration, device)
    revisions = _revisions(manifest, profile, settings)
    repository = manifest.sources["transformer"].repository if manifest.sources else None
    generator = WanGenerator(
        LoadedModel(
            name=name,
            repository=repository if own is None else own.name,
            revision=revisions.pop("transformer", None),
            revisions=revisions,
            weights_identity=identity,
            pipeline=pipeline,
            device=device,
            profile_name=settings.profile,
            profile=profile,
            conditioning=track_conditioning,
            max_area=max_area,
            negative_prompt=str(manifest.defaults.get("negative_prompt", "")),
            threads=int(manifest.defaults["threads"]) if "threads" in manifest.defaults else None,
        )
    )
    if settings.warmup:
        try:
            generator.compile()
        except GeneratorOutOfMemory as error:  # shorter clips may fit
            log.warning("not compiled beforehand: %s", error.detail)
    return generator


# The factories of the entry points in pyproject.toml.
create_ati = partial(load, "ati", conditioning.ati)
create_wan_move = partial(load, "wan-move", conditioning.wan_move)
create_tiny_ati = partial(load, "tiny-ati", conditioning.ati)
create_tiny_wan_move = partial(load, "tiny-wan-move", conditioning.wan_move)


def _from_weights(manifest: Manifest, profile: Profile, settings: Settings, device: torch.device) -> WanTrackPipeline:
    """The pipeline of the pulled weights, except for parts that come from the user's own checkpoint."""
    own = settings.own_parts(manifest.name)

    def unverified(part: str) -> Path:
        repository = manifest.sources[part].repository
        return settings.checkpoints[manifest.name] if part in own else folder_of(settings.weights_dir, repository)

    def folder(part: str) -> Path:
        if part in own:
            return settings.checkpoints[manifest.name]
        return verify(manifest.sources[part], settings.weights_dir, manifest.name)

    check_memory(manifest, settings.profile, unverified("transformer"), unverified("base"), device)
    checkpoint, base = folder("transformer"), folder("base")
    lora = profile.lora
    lora_file = None if lora is None else folder(lora.source) / manifest.sources[lora.source].files[0]
    # With offloading or quantisation the device need not hold all unquantised weights at once.
    direct = profile.acceleration.offload == "none" and profile.acceleration.fp8 == "none"
    dtype, vae_dtype = (getattr(torch, name) for name in (profile.dtype, profile.vae_dtype))
    transformer = load_transformer(checkpoint, manifest.architecture, dtype, device if direct else torch.device("cpu"))
    pipeline = assemble(transformer, base, dtype, vae_dtype)
    if lora_file is not None and lora is not None:
        add_lora(pipeline, lora_file, lora.scale)
    return pipeline


def _revisions(manifest: Manifest, profile: Profile, settings: Settings) -> dict[str, str]:
    """The revision of every pulled part that the model is made of."""
    used = {"transformer", "base"} - set(settings.own_parts(manifest.name))
    if profile.lora is not None:
        used.add(profile.lora.source)
    locks = {
        part: read_lock(settings.weights_dir, source.repository)
        for part, source in manifest.sources.items()
        if part in used
    }
    return {part: lock.revision for part, lock in locks.items() if lock is not None}
