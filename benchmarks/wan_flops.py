"""Floating-point operations of the video model, by formula."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from cow_service.generators.wan.checkpoints import diffusers_config
from cow_service.generators.wan.pipeline import TEXT_LENGTH, token_count

IMAGE_TOKENS = 257  # of CLIP ViT-H: 16 x 16 patches and one for the whole


def pass_flops(
    architecture: Mapping[str, Any],
    num_frames: int,
    width: int,
    height: int,
    image_tokens: int = IMAGE_TOKENS,
    layers: int | None = None,
) -> int:
    """Floating-point operations of the matrix products in one pass through the transformer, or through `layers` of it.

    A linear layer takes 2 x its weights per token. With L tokens of the video, C of text and image, width d and inner
    width f, each layer takes
        2 L (6 d^2 + 2 d f)   self-attention's query, key, value, output; cross-attention's query, output; feed-forward
        2 C (2 d^2)           cross-attention's keys and values
        4 L^2 d + 4 L C d     self- and cross-attention: 2 for scores, 2 for their product with the values
    and around the layers lie patches, embeddings of time, text and image, and the last layer: a thousandth.
    """
    config = diffusers_config(architecture)
    tokens, context = token_count(width, height, num_frames), TEXT_LENGTH + image_tokens
    d, f = int(architecture["dim"]), int(config["ffn_dim"])
    text, image, frequencies = config["text_dim"], config["image_dim"], config["freq_dim"]
    linear = 2 * tokens * (6 * d * d + 2 * d * f) + 2 * context * 2 * d * d
    attention = 4 * tokens * tokens * d + 4 * tokens * context * d
    patches = 2 * tokens * 4 * d * (config["in_channels"] + config["out_channels"])
    embeddings = 2 * (TEXT_LENGTH * (text * d + d * d) + image_tokens * (image * image + image * d))
    times = 2 * (frequencies * d + 7 * d * d)
    count = config["num_layers"] if layers is None else layers
    return count * (linear + attention) + patches + embeddings + times
