"""Wan2.1 and Wan2.2-TI2V at toy size: the real classes with seeded random weights and a toy tokenizer.

Without settings or OpenCV.
"""

from collections.abc import Mapping
from typing import Any

import torch
import transformers
from diffusers import AutoencoderKLWan, WanTransformer3DModel
from tokenizers import Tokenizer, decoders, models, pre_tokenizers, processors

from cow_service.generators.wan import checkpoints, pipeline

TINY_SEED = 0


def make_tiny(architecture: Mapping[str, Any]) -> pipeline.WanTrackPipeline:
    """A pipeline of these sizes (as in a manifest); the same sizes give the same weights."""
    # Every byte is a token; 0 pads and 1 ends, as in T5.
    alphabet = sorted(pre_tokenizers.ByteLevel.alphabet())
    vocabulary = {token: i for i, token in enumerate(["<pad>", "</s>", *alphabet])}
    tokenizer = Tokenizer(models.BPE(vocab=vocabulary, merges=[]))
    tokenizer.pre_tokenizer = pre_tokenizers.ByteLevel(add_prefix_space=False)
    tokenizer.decoder = decoders.ByteLevel()
    tokenizer.post_processor = processors.TemplateProcessing(single="$A </s>", special_tokens=[("</s>", 1)])
    text_width, image_width = architecture["text_dim"], architecture.get("image_dim")
    text_config = transformers.UMT5Config(
        vocab_size=len(vocabulary), d_model=text_width, d_kv=8, d_ff=2 * text_width, num_layers=1, num_heads=2
    )
    # The VAE of Wan2.2 folds patches into channels, and leaves twice as little each way.
    patches: dict[str, Any] = {"in_channels": 12, "out_channels": 12, "patch_size": 2, "scale_factor_spatial": 16}
    stats = {"latents_mean": [0.0] * architecture["out_dim"], "latents_std": [1.0] * architecture["out_dim"]}
    patches |= stats | {"is_residual": True, "decoder_base_dim": 4}
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(TINY_SEED)
        parts = {  # in this order, by which the seed gives the same weights
            "transformer": WanTransformer3DModel(**checkpoints.diffusers_config(architecture)),
            "vae": AutoencoderKLWan(
                base_dim=4,
                z_dim=architecture["out_dim"],
                dim_mult=[1, 1, 1, 1],
                num_res_blocks=1,
                temperal_downsample=[False, True, True],
                **({} if image_width else patches),
            ),
            "text_encoder": transformers.UMT5EncoderModel(text_config),
            "image_encoder": transformers.CLIPVisionModel(_image_config(image_width)) if image_width else None,
        }
    for part in filter(None, parts.values()):
        part.eval().requires_grad_(False)
    square: Any = {"size": {"shortest_edge": 32}, "crop_size": {"height": 32, "width": 32}}
    return pipeline.compose(
        tokenizer=transformers.PreTrainedTokenizerFast(tokenizer_object=tokenizer, pad_token="<pad>", eos_token="</s>"),
        image_processor=transformers.CLIPImageProcessor(**square) if image_width else None,
        **parts,
    )


def _image_config(width: int) -> transformers.CLIPVisionConfig:
    return transformers.CLIPVisionConfig(
        hidden_size=width, intermediate_size=2 * width, num_hidden_layers=2, num_attention_heads=2, image_size=32,
        patch_size=8,
    )  # fmt: skip
