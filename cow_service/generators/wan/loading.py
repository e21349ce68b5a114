"""Makes the video generators: weights found and checked, loaded, accelerated as the profile says."""

from __future__ import annotations

from pathlib import Path
from threading import Lock

import torch

from cow_service.errors import GeneratorUnavailable
from cow_service.generators.wan import methods
from cow_service.generators.wan.acceleration import accelerate, check_machine
from cow_service.generators.wan.checkpoints import checkpoint_files, load_transformer
from cow_service.generators.wan.components import assemble
from cow_service.generators.wan.device import choose_device, within_memory
from cow_service.generators.wan.generator import Model, WanGenerator
from cow_service.generators.wan.lora import add_lora
from cow_service.generators.wan.pipeline import WanTrackPipeline
from cow_service.generators.wan.profiles import Profile, profile_of
from cow_service.generators.wan.tiny import make_tiny
from cow_service.settings import Settings
from cow_service.weights.lock import read_lock, verify
from cow_service.weights.manifests import Manifest, load_manifests

# Seeds and lazy initialisation are the whole process's: two models made at once would get into each other's weights.
_one_at_a_time = Lock()


def create_ati(settings: Settings) -> WanGenerator:
    """ATI on Wan2.1-I2V-14B."""
    return load("ati", methods.ati, settings)


def create_wan_move(settings: Settings) -> WanGenerator:
    """Wan-Move on Wan2.1-I2V-14B."""
    return load("wan-move", methods.wan_move, settings)


def create_tiny_ati(settings: Settings) -> WanGenerator:
    """ATI at toy size."""
    return load("tiny-ati", methods.ati, settings)


def create_tiny_wan_move(settings: Settings) -> WanGenerator:
    """Wan-Move at toy size."""
    return load("tiny-wan-move", methods.wan_move, settings)


def load(name: str, method: methods.Method, settings: Settings) -> WanGenerator:
    """The generator of a manifest. A manifest without sources is made here, at the sizes that it gives.

    Raises `WeightsUnavailable`, `CheckpointInvalid`, `GeneratorOutOfMemory`, or `GeneratorUnavailable` for what this
    machine cannot do.
    """
    manifest = load_manifests()[name]
    profile = profile_of(manifest, settings.profile)
    device = choose_device(settings.device)
    if profile.acceleration.context_parallel > 1:
        raise GeneratorUnavailable(
            "`context_parallel` needs several processes that make the same clip; a server is one. Set COW_PROFILE."
        )
    check_machine(profile.acceleration, device)
    own = settings.checkpoints.get(name)
    if own is not None:
        checkpoint_files(own)
    with _one_at_a_time, within_memory(device, lambda: None, f"'{name}'"):
        if manifest.sources:
            pipeline = _from_weights(manifest, profile, settings, device)
        else:
            pipeline = make_tiny(manifest.architecture)
        pipeline.set_progress_bar_config(disable=True)
        accelerate(pipeline, profile.acceleration, device)
    revisions = _revisions(manifest, profile, settings)
    repository = manifest.sources["transformer"].repository if manifest.sources else None
    return WanGenerator(
        Model(
            name=name,
            repository=repository if own is None else own.name,
            revision=revisions.pop("transformer", None),
            revisions=revisions,
            pipeline=pipeline,
            device=device,
            profile_name=settings.profile,
            profile=profile,
            method=method,
            max_area=int(manifest.defaults["max_area"]),
            negative_prompt=str(manifest.defaults.get("negative_prompt", "")),
            threads=int(manifest.defaults["threads"]) if "threads" in manifest.defaults else None,
        )
    )


def _from_weights(manifest: Manifest, profile: Profile, settings: Settings, device: torch.device) -> WanTrackPipeline:
    """The pipeline of the pulled weights, but for the parts that come from a checkpoint of one's own."""
    own = settings.own_parts(manifest.name)

    def folder(part: str) -> Path:
        if part in own:
            return settings.checkpoints[manifest.name]
        return verify(manifest.sources[part], settings.weights_dir, manifest.name)

    checkpoint, base = folder("transformer"), folder("base")
    lora = profile.lora
    added = None if lora is None else folder(lora.source) / manifest.sources[lora.source].files[0]
    # Where parts are offloaded, or their weights made smaller, the device need not hold all of them at once.
    direct = profile.acceleration.offload == "none" and profile.acceleration.fp8 == "none"
    dtype, vae_dtype = (getattr(torch, name) for name in (profile.dtype, profile.vae_dtype))
    transformer = load_transformer(checkpoint, manifest.architecture, dtype, device if direct else torch.device("cpu"))
    pipeline = assemble(transformer, base, dtype, vae_dtype)
    if added is not None and lora is not None:
        add_lora(pipeline, added, lora.scale)
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
