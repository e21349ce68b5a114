"""Loads the other parts from a diffusers folder: VAE, text encoder, image encoder, tokenizer, image processor."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from diffusers import AutoencoderKLWan, WanTransformer3DModel
from safetensors import SafetensorError
from transformers import AutoTokenizer, CLIPImageProcessor, CLIPVisionModel, UMT5EncoderModel

from cow_service.errors import CheckpointInvalid
from cow_service.generators.wan.checkpoints import counted
from cow_service.generators.wan.pipeline import WanTrackPipeline, compose
from cow_service.generators.wan.profiles import IMAGE_ENCODER_DTYPE


def assemble(
    transformer: WanTransformer3DModel, base: Path, dtype: torch.dtype, vae_dtype: torch.dtype
) -> WanTrackPipeline:
    """The pipeline of a transformer and the other parts in the diffusers folder `base`, all still on the CPU.

    The image encoder has `IMAGE_ENCODER_DTYPE`, whatever `dtype` is.
    Raises `CheckpointInvalid` naming the part and what does not fit.
    """
    text_encoder = _model(UMT5EncoderModel, base, "text_encoder", dtype)
    image_encoder = _model(CLIPVisionModel, base, "image_encoder", getattr(torch, IMAGE_ENCODER_DTYPE))
    sizes: Any = transformer.config
    for name, wanted, found in (
        ("text_encoder", sizes.text_dim, text_encoder.config.d_model),
        ("image_encoder", sizes.image_dim, image_encoder.config.hidden_size),
    ):
        if wanted != found:
            raise CheckpointInvalid(f"'{name}' is {found} wide, and the transformer takes {wanted}.")
    return compose(
        transformer=transformer,
        vae=_model(AutoencoderKLWan, base, "vae", vae_dtype),
        text_encoder=text_encoder,
        image_encoder=image_encoder,
        tokenizer=_part(AutoTokenizer, base, "tokenizer"),
        image_processor=_part(CLIPImageProcessor, base, "image_processor"),
    )


def _model(kind: Any, base: Path, part: str, dtype: torch.dtype) -> Any:
    """A model whose checkpoint fits it name by name: the libraries only warn, and initialise the rest at random."""
    model, report = _part(kind, base, part, torch_dtype=dtype, use_safetensors=True, output_loading_info=True)
    kinds = {"unknown": "unexpected_keys", "missing": "missing_keys", "of another shape": "mismatched_keys"}
    misfits = counted({kind: sorted(map(str, report.get(key) or ())) for kind, key in kinds.items()})
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
