"""Figures that the public implementations computed, kept in parts that are each under 1 MB."""

from __future__ import annotations

import shutil
from functools import cache
from pathlib import Path

import numpy as np
import torch
from safetensors.torch import load_file, save_file

DATA = Path(__file__).parent / "data" / "golden"
ROWS = "img_emb.proj.1.weight"  # the one tensor that is larger: kept as groups of rows


@cache
def figures(name: str) -> dict[str, np.ndarray]:
    with np.load(DATA / f"{name}.npz") as arrays:
        return dict(arrays)


@cache
def tensors(name: str) -> dict[str, torch.Tensor]:
    return {key: torch.from_numpy(value) for key, value in figures(name).items()}


@cache
def image_embeds() -> torch.Tensor:
    parts = [figures(f"tiny_image_embeds_{i}")["part"] for i in range(2)]
    return torch.from_numpy(np.concatenate(parts, axis=1))


@cache
def original_weights() -> dict[str, torch.Tensor]:
    """The toy transformer under its original names."""
    rows = [load_file(DATA / "tiny_ati" / f"rows_{i}.safetensors")[ROWS] for i in range(8)]
    return load_file(DATA / "tiny_ati" / "rest.safetensors") | {ROWS: torch.cat(rows)}


def original_folder(folder: Path, shards: int = 1, weights: dict[str, torch.Tensor] | None = None) -> Path:
    """The toy transformer as the original checkpoints are laid out."""
    folder.mkdir(parents=True, exist_ok=True)
    shutil.copy(DATA / "tiny_ati" / "config.json", folder / "config.json")
    held = original_weights() if weights is None else weights
    names = sorted(held)
    for i in range(shards):
        file = f"diffusion_pytorch_model-{i + 1:05d}-of-{shards:05d}.safetensors"
        part = {name: held[name].contiguous() for name in names[i::shards]}
        save_file(part, folder / (file if shards > 1 else "diffusion_pytorch_model.safetensors"))
    return folder
