"""Makes the video generators: finds and checks their weights, loads them, applies the profile.

`create_...` are the factories of the entry points in pyproject.toml. Those of the tiny models have the real classes at
toy size, with seeded random weights and a toy tokenizer: they make a clip in a second on a CPU. Its frames mean
nothing; it is for tests, and to try a deployment out.
"""

import logging
import os
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, cast

import torch
from diffusers import AutoencoderKLWan, WanTransformer3DModel
from safetensors import SafetensorError
from transformers import AutoTokenizer, CLIPImageProcessor, CLIPVisionModel, UMT5EncoderModel

from cow_service.errors import CheckpointInvalid, GeneratorOutOfMemory, GeneratorUnavailable
from cow_service.generators.wan import acceleration, checkpoints, conditioning, memory, tiny
from cow_service.generators.wan.generator import WanGenerator
from cow_service.generators.wan.pipeline import WanTrackPipeline, compose
from cow_service.generators.wan.profiles import IMAGE_ENCODER_DTYPE, Profile, profile_of
from cow_service.generators.wan.ranks import RankGroup
from cow_service.settings import Settings
from cow_service.weights.device import BUILD_LOCK, choose_device
from cow_service.weights.manifests import Manifest, Source, load_manifests
from cow_service.weights.repositories import folder_of, read_lock, verify, weights_identity

CODE_FOLDER = "TORCHINDUCTOR_CACHE_DIR"

log = logging.getLogger("cow_service")


def load(name: str, track_conditioning: conditioning.TrackConditioning | None, settings: Settings) -> WanGenerator:
    """The generator of a manifest; without `track_conditioning` it takes no tracks.

    One without sources is built with random weights, at the sizes that it gives. Raises `WeightsUnavailable`,
    `CheckpointInvalid`, `GeneratorOutOfMemory`, or `GeneratorUnavailable` for what this machine cannot do.
    """
    # Keeps compiled code for the next start. This comes first, as PyTorch sets its own folder at first use.
    os.environ.setdefault(CODE_FOLDER, str(settings.data_dir / "compiled"))
    manifest = load_manifests()[name]
    profile = profile_of(manifest, settings.profile)
    device = choose_device(settings.device, GeneratorUnavailable)
    if name in settings.checkpoints:
        checkpoints.checkpoint_files(settings.checkpoints[name])
    weights = Weights(manifest, profile, settings)
    folders = {part: weights.folder(part) for part in manifest.sources}
    memory.check_machine(manifest, settings.profile, folders, device)
    acceleration.check_device(profile.acceleration, device)
    identity = weights_identity(manifest, settings)  # before loading: files that change later are not those loaded
    with BUILD_LOCK, memory.within_memory(device, lambda: None, f"'{name}'"):
        pipeline, group = weights.load_pipeline(device)
    generator = WanGenerator(
        manifest, settings, weights.revisions(), identity, pipeline, group, device, profile, track_conditioning
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


create_ati = partial(load, "ati", conditioning.ati)
create_wan_move = partial(load, "wan-move", conditioning.wan_move)
create_refine = partial(load, "refine", None)
create_refine_5b = partial(load, "refine-5b", None)
create_tiny_ati = partial(load, "tiny-ati", conditioning.ati)
create_tiny_wan_move = partial(load, "tiny-wan-move", conditioning.wan_move)
create_tiny_refine = partial(load, "tiny-refine", None)


def load_rank(name: str, profile: Profile, settings: Settings, device: torch.device) -> WanTransformer3DModel:
    """The transformer alone, for one more process that shares clips; rank 0 has checked it. Raises as `load` does."""
    os.environ.setdefault(CODE_FOLDER, str(settings.data_dir / "compiled"))
    manifest = load_manifests()[name]
    with memory.within_memory(device, lambda: None, f"'{name}' on {device}"):
        if manifest.sources:
            transformer = Weights(manifest, profile, settings).load_transformer(device)
        else:
            transformer = tiny.make_tiny(manifest.architecture).transformer
        acceleration.accelerate_transformer(transformer, profile.acceleration, device)
        cast(torch.nn.Module, transformer).to(device)
        return transformer


@dataclass(frozen=True)
class Weights:
    """Those of a model in a profile: what was pulled, and the user's own."""

    manifest: Manifest
    profile: Profile
    settings: Settings

    def pulled(self) -> dict[str, Source]:
        """By part, the sources that the model is made of and that are not the user's own."""
        used = {"transformer", "base"} | ({self.profile.lora} if self.profile.lora is not None else set())
        used -= set(self.settings.own_parts(self.manifest.name))
        return {part: source for part, source in sorted(self.manifest.sources.items()) if part in used}

    def revisions(self) -> dict[str, str]:
        """Of every pulled part."""
        locks = {part: read_lock(self.settings.weights_dir, each.repository) for part, each in self.pulled().items()}
        return {part: lock.revision for part, lock in locks.items() if lock is not None}

    def folder(self, part: str) -> Path:
        """Of a pulled part, or the user's own checkpoint."""
        if part in self.settings.own_parts(self.manifest.name):
            return self.settings.checkpoints[self.manifest.name]
        return folder_of(self.settings.weights_dir, self.manifest.sources[part].repository)

    def load_transformer(self, device: torch.device) -> WanTransformer3DModel:
        """With its LoRA."""
        # With offloading or quantisation the device need not hold all unquantised weights at once.
        wanted, lora = self.profile.acceleration, self.profile.lora
        direct = wanted.offload == "none" and (wanted.fp8 == "none" or wanted.keeps_float8)
        transformer = checkpoints.load_transformer(
            self.folder("transformer"),
            self.manifest.architecture,
            getattr(torch, self.profile.dtype),
            device if direct else torch.device("cpu"),
            keep_float8=wanted.fp8 if wanted.keeps_float8 else None,
        )
        if lora is not None:
            checkpoints.add_lora(transformer, self.folder(lora) / self.manifest.sources[lora].files[0])
        return transformer

    def load_pipeline(self, device: torch.device) -> tuple[WanTrackPipeline, RankGroup | None]:
        """The pipeline on its device, and the processes that share its clips, which load at the same time.

        Files that are not those that were pulled are refused before any is read.
        """
        manifest, profile, settings, ranks = self.manifest, self.profile, self.settings, self.profile.acceleration.ranks
        if manifest.sources:
            for source in self.pulled().values():
                verify(source, settings.weights_dir, manifest.name)
        if ranks > 1 and torch.distributed.is_initialized():
            raise GeneratorUnavailable(
                f"'{manifest.name}': another model of this process shares the GPUs. Use one of them."
            )
        group = None if ranks == 1 else RankGroup(manifest.name, profile, settings, device)
        try:
            if manifest.sources:
                dtype, vae_dtype = (getattr(torch, name) for name in (profile.dtype, profile.vae_dtype))
                pipeline = assemble(self.load_transformer(device), self.folder("base"), dtype, vae_dtype)
            else:
                pipeline = tiny.make_tiny(manifest.architecture)
            pipeline.set_progress_bar_config(disable=True)
            acceleration.accelerate(pipeline, profile.acceleration, device)
            if group is not None:
                with acceleration.naming_option(f"{ranks} GPUs"):
                    group.join(pipeline.transformer)
        except BaseException:
            if group is not None:
                group.close()
            raise
        return pipeline, group


def assemble(
    transformer: WanTransformer3DModel, base: Path, dtype: torch.dtype, vae_dtype: torch.dtype
) -> WanTrackPipeline:
    """The pipeline of a transformer and the other parts in the diffusers folder `base`, all still on the CPU.

    The image encoder, of a model that takes one, has `IMAGE_ENCODER_DTYPE`, whatever `dtype` is.
    Raises `CheckpointInvalid` naming the part and what does not fit.
    """
    text_encoder = _model(UMT5EncoderModel, base, "text_encoder", dtype)
    vae = _model(AutoencoderKLWan, base, "vae", vae_dtype)
    sizes: Any = transformer.config
    widths = [("text_encoder", sizes.text_dim, text_encoder.config.d_model), ("vae", sizes.out_channels, vae.z_dim)]
    image_encoder = image_processor = None
    if sizes.image_dim is not None:
        image_encoder = _model(CLIPVisionModel, base, "image_encoder", getattr(torch, IMAGE_ENCODER_DTYPE))
        image_processor = _part(CLIPImageProcessor, base, "image_processor")
        widths.append(("image_encoder", sizes.image_dim, image_encoder.config.hidden_size))
    for name, wanted, found in widths:
        if wanted != found:
            raise CheckpointInvalid(f"'{name}' is {found} wide, and the transformer takes {wanted}.")
    return compose(
        transformer=transformer,
        vae=vae,
        text_encoder=text_encoder,
        image_encoder=image_encoder,
        tokenizer=_part(AutoTokenizer, base, "tokenizer"),
        image_processor=image_processor,
    )


def _model(kind: Any, base: Path, part: str, dtype: torch.dtype) -> Any:
    """A model whose checkpoint fits it name by name: the libraries only warn, and initialise the rest at random."""
    model, report = _part(kind, base, part, torch_dtype=dtype, use_safetensors=True, output_loading_info=True)
    kinds = {"unknown": "unexpected_keys", "missing": "missing_keys", "of another shape": "mismatched_keys"}
    misfits = checkpoints.counted({kind: sorted(map(str, report.get(key) or ())) for kind, key in kinds.items()})
    if misfits:
        raise CheckpointInvalid(f"The weights of '{part}' do not fit. {misfits}.")
    return model.eval().requires_grad_(False)


def _part(kind: Any, base: Path, part: str, **options: Any) -> Any:
    if not (base / part).is_dir():
        raise CheckpointInvalid(f"The checkpoint has no folder '{part}'.")
    try:
        return kind.from_pretrained(str(base / part), local_files_only=True, **options)
    except (OSError, ValueError, RuntimeError, SafetensorError) as error:
        reason = (str(error).replace(str(base), "").splitlines() or [type(error).__name__])[0]
        raise CheckpointInvalid(f"'{part}' cannot be loaded: {reason}") from error
