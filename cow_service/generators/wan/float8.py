"""Weights that stay in the float8 in which a checkpoint holds them; torchao computes with them."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn


def held_in_float8(weight: Tensor, scale: Tensor | None, dtype: torch.dtype) -> Tensor:
    """A float8 matrix times one number, or as it is, as a weight that computes in `dtype`: no value is rounded anew."""
    from torchao.quantization import Float8Tensor  # noqa: PLC0415

    factor = torch.ones((), device=weight.device) if scale is None else scale
    return Float8Tensor(
        qdata=weight,
        scale=factor.float().reshape(1, 1),
        block_size=list(weight.shape),
        dtype=dtype,
    )


def check_float8(transformer: Any) -> None:
    """Raises `ValueError` where no weight of the blocks is in float8."""
    layers = [layer for layer in transformer.blocks.modules() if isinstance(layer, nn.Linear)]
    if all(type(layer.weight) is nn.Parameter for layer in layers):
        raise ValueError("the checkpoint holds no weights in float8: give one that does (COW_CHECKPOINTS)")
