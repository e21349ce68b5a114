"""Wan2.1 at toy size: the real classes with seeded random weights and a toy tokenizer.

It makes a clip in a second on a CPU. The frames mean nothing: it is for tests, and to try a deployment out.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from diffusers import AutoencoderKLWan, WanTransformer3DModel
from tokenizers import Tokenizer, decoders, models, pre_tokenizers, processors
from transformers import (
    CLIPImageProcessor,
    CLIPVisionConfig,
    CLIPVisionModel,
    PreTrainedTokenizerFast,
    UMT5Config,
    UMT5EncoderModel,
)

from cow_service.generators.wan.checkpoints import diffusers_config
from cow_service.generators.wan.pipeline import LATENT_CHANNELS, WanTrackPipeline, compose

SEED = 0


def make_tiny(architecture: Mapping[str, Any]) -> WanTrackPipeline:
    """A pipeline of these sizes (as in a manifest); the same sizes give the same weights."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(SEED)
        transformer = WanTransformer3DModel(**diffusers_config(architecture))
        parts = {
            "transformer": transformer,
            "vae": _vae(),
            "text_encoder": _text_encoder(architecture["text_dim"]),
            "image_encoder": _image_encoder(architecture["image_dim"]),
        }
    for part in parts.values():
        part.eval().requires_grad_(False)
    return compose(
        tokenizer=_tokenizer(),
        image_processor=CLIPImageProcessor(size={"shortest_edge": 32}, crop_size={"height": 32, "width": 32}),
        **parts,
    )


def _vae() -> AutoencoderKLWan:
    return AutoencoderKLWan(
        base_dim=4,
        z_dim=LATENT_CHANNELS,
        dim_mult=[1, 1, 1, 1],
        num_res_blocks=1,
        temperal_downsample=[False, True, True],
    )


def _text_encoder(width: int) -> UMT5EncoderModel:
    return UMT5EncoderModel(
        UMT5Config(vocab_size=len(_vocabulary()), d_model=width, d_kv=8, d_ff=2 * width, num_layers=1, num_heads=2)
    )


def _image_encoder(width: int) -> CLIPVisionModel:
    return CLIPVisionModel(
        CLIPVisionConfig(
            hidden_size=width, intermediate_size=2 * width, num_hidden_layers=2, num_attention_heads=2,
            image_size=32, patch_size=8,
        )
    )  # fmt: skip


def _vocabulary() -> dict[str, int]:
    """Every byte is a token; 0 pads and 1 ends, as in T5."""
    return {token: i for i, token in enumerate(["<pad>", "</s>", *sorted(pre_tokenizers.ByteLevel.alphabet())])}


def _tokenizer() -> PreTrainedTokenizerFast:
    tokenizer = Tokenizer(models.BPE(vocab=_vocabulary(), merges=[]))
    tokenizer.pre_tokenizer = pre_tokenizers.ByteLevel(add_prefix_space=False)
    tokenizer.decoder = decoders.ByteLevel()
    tokenizer.post_processor = processors.TemplateProcessing(single="$A </s>", special_tokens=[("</s>", 1)])
    return PreTrainedTokenizerFast(tokenizer_object=tokenizer, pad_token="<pad>", eos_token="</s>")
