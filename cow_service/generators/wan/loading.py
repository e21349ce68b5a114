"""Makes the video generators: finds and checks their weights, loads them, applies the profile."""

from __future__ import annotations

import logging
from functools import partial
from pathlib import Path
from typing import cast

import torch
from diffusers import WanTransformer3DModel
from torch import distributed, nn

from cow_service.errors import GeneratorOutOfMemory, GeneratorUnavailable
from cow_service.generators.wan import conditioning
from cow_service.generators.wan.acceleration import accelerate, accelerate_transformer, check_device, translated
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
from cow_service.generators.wan.rank_group import RankGroup
from cow_service.generators.wan.tiny import make_tiny
from cow_service.settings import Settings
from cow_service.weights.device import BUILD_LOCK, choose_device
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
    own = settings.checkpoints.get(name)
    others = {each: profile_of(manifest, each).acceleration for each in manifest.profiles}
    if own is None:  # what is pulled is not in float8
        others = {each: other for each, other in others.items() if other.fp8 != "stored"}
    check_device(profile.acceleration, device, others)
    if own is not None:
        checkpoint_files(own)
    identity = weights_identity(manifest, settings)  # before loading: files that change later are not those loaded
    max_area = int(manifest.defaults["max_area"])
    with BUILD_LOCK, within_memory(device, lambda: None, f"'{name}'"):
        kept = settings.data_dir / "attention.json"
        profile = with_attention(profile, manifest.architecture, *clip_size(max_area, *USUAL_SIDES), device, kept)
        pipeline, group = _loaded(manifest, profile, settings, device)
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
            group=group,
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
            if group is not None:  # which has ended
                raise
            log.warning("not compiled beforehand: %s", error.detail)
        except BaseException:
            generator.close()
            raise
    return generator


# The factories of the entry points in pyproject.toml.
create_ati = partial(load, "ati", conditioning.ati)
create_wan_move = partial(load, "wan-move", conditioning.wan_move)
create_tiny_ati = partial(load, "tiny-ati", conditioning.ati)
create_tiny_wan_move = partial(load, "tiny-wan-move", conditioning.wan_move)


def load_rank(name: str, profile: Profile, settings: Settings, device: torch.device) -> WanTransformer3DModel:
    """The transformer alone, for one more process that shares the clips of a model: rank 0 has checked the weights.

    Raises as `load` does.
    """
    keep_compiled_code(settings.data_dir / "compiled")
    manifest = load_manifests()[name]
    with within_memory(device, lambda: None, f"'{name}' on {device}"):
        if manifest.sources:
            transformer = _transformer(manifest, profile, settings, device)
        else:
            transformer = make_tiny(manifest.architecture).transformer
        accelerate_transformer(transformer, profile.acceleration, device)
        cast(nn.Module, transformer).to(device)
        return transformer


def _loaded(
    manifest: Manifest, profile: Profile, settings: Settings, device: torch.device
) -> tuple[WanTrackPipeline, RankGroup | None]:
    """The pipeline on its device, and the processes that share its clips, which load at the same time."""
    if manifest.sources:
        _check_weights(manifest, profile, settings, device)
    if profile.acceleration.ranks > 1 and distributed.is_initialized():
        raise GeneratorUnavailable(
            f"'{manifest.name}': another model of this process shares the GPUs. Use one of them."
        )
    group = None if profile.acceleration.ranks == 1 else RankGroup(manifest.name, profile, settings, device)
    try:
        if manifest.sources:
            transformer = _transformer(manifest, profile, settings, device)
            dtype, vae_dtype = (getattr(torch, name) for name in (profile.dtype, profile.vae_dtype))
            pipeline = assemble(transformer, _folder("base", manifest, settings), dtype, vae_dtype)
        else:
            pipeline = make_tiny(manifest.architecture)
        pipeline.set_progress_bar_config(disable=True)
        accelerate(pipeline, profile.acceleration, device)
        if group is not None:
            with translated(f"{profile.acceleration.ranks} GPUs"):
                group.join(pipeline.transformer)
    except BaseException:
        if group is not None:
            group.close()
        raise
    return pipeline, group


def _check_weights(manifest: Manifest, profile: Profile, settings: Settings, device: torch.device) -> None:
    """Raises for weights that cannot fit, before any is read, and for files that are not those that were pulled."""
    transformer, base = (_folder(part, manifest, settings) for part in ("transformer", "base"))
    check_memory(manifest, settings.profile, transformer, base, device)
    parts = {"transformer", "base"} | ({profile.lora.source} if profile.lora is not None else set())
    for part in sorted(parts - set(settings.own_parts(manifest.name))):
        verify(manifest.sources[part], settings.weights_dir, manifest.name)


def _folder(part: str, manifest: Manifest, settings: Settings) -> Path:
    """Of a pulled part, or the user's own checkpoint."""
    if part in settings.own_parts(manifest.name):
        return settings.checkpoints[manifest.name]
    return folder_of(settings.weights_dir, manifest.sources[part].repository)


def _transformer(
    manifest: Manifest, profile: Profile, settings: Settings, device: torch.device
) -> WanTransformer3DModel:
    """With its LoRA."""
    # With offloading or quantisation the device need not hold all unquantised weights at once.
    fp8 = profile.acceleration.fp8
    direct = profile.acceleration.offload == "none" and fp8 in {"none", "stored"}
    transformer = load_transformer(
        _folder("transformer", manifest, settings),
        manifest.architecture,
        getattr(torch, profile.dtype),
        device if direct else torch.device("cpu"),
        keep_float8=fp8 == "stored",
    )
    if profile.lora is not None:
        file = _folder(profile.lora.source, manifest, settings) / manifest.sources[profile.lora.source].files[0]
        add_lora(transformer, file, profile.lora.scale)
    return transformer


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
