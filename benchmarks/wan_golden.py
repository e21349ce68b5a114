"""How far the video model's path is from the public implementation's figures, on a device and in a precision.

The figures are those of the tests: one forward pass of a toy transformer with the original's weights, and a whole
sampling of four guided steps. A relative distance of 1e-6 is rounding in float32; bfloat16 has about 1e-2.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import torch
from torch import Tensor

from cow_service.generators.wan.checkpoints import load_transformer
from cow_service.generators.wan.pipeline import Conditioning
from cow_service.generators.wan.profiles import Sampling
from cow_service.generators.wan.tiny import make_tiny
from cow_service.weights.manifests import load_manifests

sys.path.append(str(Path(__file__).resolve().parents[1] / "tests"))

from golden import image_embeds, original_folder, tensors

SAMPLING = Sampling(steps=4, shift=5.0, guidance_scale=5.0)


def distances(device: torch.device, dtype: torch.dtype) -> dict[str, float]:
    """Relative distance of the forward pass and of the sampling's latents."""
    golden = tensors("tiny_denoise")
    pipeline = make_tiny(load_manifests()["tiny-ati"].architecture)
    with tempfile.TemporaryDirectory() as folder:
        pipeline.transformer = load_transformer(original_folder(Path(folder)), {}, dtype, device)
    pipeline.to(device)
    condition = golden["condition_after"]
    prompt, negative = (golden[name][None].to(device) for name in ("prompt_embeds", "negative_prompt_embeds"))
    given = Conditioning(prompt, negative, image_embeds().to(device), condition, condition)
    states = torch.cat([golden["noise"], condition])[None].to(device, dtype)
    with torch.no_grad():
        velocity = pipeline.transformer(
            hidden_states=states,
            timestep=torch.tensor([500], device=device),
            encoder_hidden_states=given.prompt.to(dtype),
            encoder_hidden_states_image=image_embeds().to(device, dtype),
        ).sample[0]
    latents = pipeline.denoise(golden["noise"][None], given, SAMPLING, lambda done, steps: None)[0]
    return {
        "forward_pass": _distance(velocity, golden["velocity_t500"]),
        "sampling": _distance(latents, golden["latents_s4_shift5.0_g5.0"]),
    }


def _distance(found: Tensor, wanted: Tensor) -> float:
    found = found.float().cpu()
    return ((found - wanted).norm() / wanted.norm()).item()
