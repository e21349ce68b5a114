"""Merges a LoRA into a transformer's weights, so that it costs nothing per step.

Distilled LoRAs hold more than pairs of low-rank matrices: full differences of norms, biases and modulation. diffusers'
`load_lora_weights` silently drops those, and layers that the model lacks with a warning only; here either every tensor
of the file is added or the file is refused. Names may be diffusers' or those of the original Wan.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor, nn

from cow_service.errors import CheckpointInvalid, GeneratorUnavailable, WeightsUnavailable
from cow_service.generators.wan.checkpoints import diffusers_names
from cow_service.weights.device import listed

PREFIXES = ("base_model.model.", "model.", "diffusion_model.", "transformer.")
# How a tensor's name ends, which part of its layer's change it is, and the parameter of the layer that it changes.
ENDS = (
    (".lora_down.weight", "down", ".weight"),
    (".lora_A.weight", "down", ".weight"),
    (".lora_A.default.weight", "down", ".weight"),
    (".lora_up.weight", "up", ".weight"),
    (".lora_B.weight", "up", ".weight"),
    (".lora_B.default.weight", "up", ".weight"),
    (".alpha", "alpha", ".weight"),
    (".diff", "whole", ".weight"),
    (".diff_b", "whole", ".bias"),
    (".lora_B.bias", "whole", ".bias"),
    (".diff_m", "whole", ".modulation"),
)
MAX_LISTED = 3  # names in a message


@dataclass(frozen=True)
class _Change:
    """What is added to one parameter: a whole difference, a low-rank product, or both."""

    whole: Tensor | None = None
    down: Tensor | None = None
    up: Tensor | None = None
    alpha: Tensor | None = None

    def fits(self, parameter: Tensor) -> bool:
        """Whether it is complete and of the parameter's shape."""
        if self.whole is not None and self.whole.shape != parameter.shape:
            return False
        if self.down is None or self.up is None:
            return self.whole is not None and self.down is self.up is self.alpha is None
        product = (self.up.shape[0], *self.down.shape[1:])
        return product == tuple(parameter.shape) and self.up.flatten(1).shape[1] == self.down.shape[0]

    def on(self, device: torch.device) -> Tensor:
        """The difference in float32."""
        total = torch.zeros((), device=device)
        if self.whole is not None:
            total = total + self.whole.to(device, torch.float32)
        if self.down is not None and self.up is not None:
            up, down = self.up.to(device, torch.float32), self.down.to(device, torch.float32)
            factor = 1.0 if self.alpha is None else self.alpha.item() / down.shape[0]
            total = total + factor * (up.flatten(1) @ down.flatten(1)).reshape(up.shape[0], *down.shape[1:])
        return total


@torch.no_grad()
def add_lora(transformer: nn.Module, file: Path, scale: float) -> None:
    """Adds `scale` times the LoRA in a safetensors file to the weights of a transformer.

    Before `accelerate`: weights in float8 cannot be added to. Raises `CheckpointInvalid` for a file with a tensor that
    does not belong to the model or has another shape, before anything is changed; `WeightsUnavailable` without a file.
    """
    parameters = dict(transformer.named_parameters())
    if any(type(parameter) is not nn.Parameter or parameter.is_meta for parameter in parameters.values()):
        raise GeneratorUnavailable("A LoRA must be added before the weights are made float8 or offloaded.")
    changes = _changes(_read(file), parameters, file.name)
    for name, change in changes.items():
        parameter = parameters[name]
        parameter.copy_(parameter.float() + scale * change.on(parameter.device))


def _read(file: Path) -> dict[str, Tensor]:
    if not file.is_file():
        raise WeightsUnavailable(f"There is no LoRA '{file.name}'. Pull it with `cow models pull`.")
    try:
        with safe_open(file, framework="pt") as opened:
            keys: list[str] = list(opened.keys())
            tensors: dict[str, Tensor] = {key: opened.get_tensor(key) for key in keys}
            said: dict[str, str] = opened.metadata() or {}
        adapter: dict[str, Any] = json.loads(said.get("lora_adapter_metadata", "{}"))
    except (OSError, ValueError, SafetensorError) as error:
        raise CheckpointInvalid(f"LoRA '{file.name}' is not a readable safetensors file. Pull it again.") from error
    for key, alpha in adapter.items():
        stem = key.removesuffix("lora_alpha")
        if (stem != key and alpha != adapter.get(f"{stem}r")) or (key.endswith("alpha_pattern") and alpha):
            raise CheckpointInvalid(
                f"LoRA '{file.name}' is scaled by its metadata. Save it with the scale in its weights."
            )
    if broken := [key for key, tensor in tensors.items() if not tensor.isfinite().all()]:
        raise CheckpointInvalid(f"LoRA '{file.name}' holds infinite or undefined values: {_some(broken)}.")
    return tensors


def _changes(tensors: Mapping[str, Tensor], parameters: Mapping[str, Tensor], file: str) -> dict[str, _Change]:
    """The changes by the name of their parameter. Raises `CheckpointInvalid` where the file does not fit."""
    found: dict[str, dict[str, Tensor]] = {}
    unknown: list[str] = []
    for key, tensor in tensors.items():
        target, part = _target(key)
        layer = found.setdefault(target, {})
        if not part or part in layer:
            unknown.append(key)
        layer[part] = tensor
    names = _in_diffusers(found, parameters)
    unknown += [target for target in found if names[target] not in parameters]
    if unknown or not found:
        misplaced = _some(unknown) or "an empty one"
        raise CheckpointInvalid(f"LoRA '{file}' is not one for this model, which has no place for {misplaced}.")
    changes = {names[target]: _Change(**parts) for target, parts in found.items()}
    if misfits := [name for name, change in changes.items() if not change.fits(parameters[name])]:
        raise CheckpointInvalid(
            f"LoRA '{file}' does not fit this model: half of a pair or another shape for {_some(misfits)}."
        )
    return changes


def _target(key: str) -> tuple[str, str]:
    """The parameter that a tensor changes, as the file names it, and which part of the change it is; "" if unknown."""
    bare = key
    for prefix in PREFIXES:
        bare = bare.removeprefix(prefix)
    for end, part, parameter in ENDS:
        if bare.endswith(end):
            return bare.removesuffix(end) + parameter, part
    return key, ""


def _in_diffusers(targets: Iterable[str], parameters: Mapping[str, Tensor]) -> dict[str, str]:
    """Their names in diffusers' model."""
    names = {target: target for target in targets}
    if all(name in parameters for name in names):
        return names
    return {original: name for name, original in diffusers_names(names).items()}


def _some(names: list[str]) -> str:
    return listed(sorted(names), MAX_LISTED)
