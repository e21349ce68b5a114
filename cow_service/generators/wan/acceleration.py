"""Applies the acceleration of a profile to a loaded pipeline.

The order of `accelerate` follows how the parts enclose each other: weights, attention, the compiled block, the cache
that skips blocks, memory; at last context parallelism around the cache, which `sharing` adds. A block compiled together
with its cache hooks breaks its graph (first-block) or is not compiled at all (mag); a cache around context parallelism
would compare a whole tensor with a shard.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager
from typing import Any, cast

import torch
from torch import nn

from cow_service.errors import CowError, GeneratorUnavailable
from cow_service.generators.wan.capabilities import detect_capabilities, refusals
from cow_service.generators.wan.float8 import check_float8
from cow_service.generators.wan.profiles import Acceleration
from cow_service.generators.wan.step_caches import enable_cache


def check_device(
    acceleration: Acceleration, device: torch.device, others: Mapping[str, Acceleration] | None = None
) -> None:
    """Raises `GeneratorUnavailable` listing everything that the device cannot do. Nothing is loaded.

    `others`: those of the model's profiles, of which the error names the ones that the device can run.
    """
    with translated(f"device: {device}"):
        machine = detect_capabilities(device)
    sentences = refusals(acceleration, machine)
    if sentences:
        able = ", ".join(name for name, each in (others or {}).items() if not refusals(each, machine))
        remedy = f"This machine can run: {able}" if able else "Another profile may do"
        raise GeneratorUnavailable(f"{' '.join(sentences)} {remedy} (COW_PROFILE).")


def accelerate(pipeline: object, acceleration: Acceleration, device: torch.device) -> None:
    """Applies every option to the pipeline's parts and moves them to the device. Call it once per pipeline.

    Raises `GeneratorUnavailable`: for what the device cannot do, before anything is changed, or naming the option that
    failed. Compilation happens in the first clip.
    """
    wanted, parts = acceleration, cast(Any, pipeline)
    accelerate_transformer(parts.transformer, wanted, device)
    _apply(
        ("vae_tiling", wanted.vae_tiling, lambda: parts.vae.enable_tiling()),  # noqa: PLW0108 - there may be no VAE
        (f"offload: {wanted.offload}", True, lambda: _place(parts, wanted.offload, device)),
    )


def accelerate_transformer(transformer: Any, wanted: Acceleration, device: torch.device) -> None:
    """The same for a transformer without the other parts, which stays where it is."""
    check_device(wanted, device)
    _apply(
        (f"fp8: {wanted.fp8}", wanted.fp8 in {"weights", "dynamic"}, lambda: _quantise(transformer, wanted, device)),
        ("fp8: stored", wanted.fp8 == "stored", lambda: check_float8(transformer)),
        (f"attention: {wanted.attention}", True, lambda: transformer.set_attention_backend(wanted.attention)),
        ("compile: regional", wanted.compile != "none", lambda: _compile(transformer)),
        (f"cache: {wanted.cache}", wanted.cache != "none", lambda: enable_cache(transformer, wanted)),
    )


def _apply(*steps: tuple[str, bool, Callable[[], object]]) -> None:
    """Those that apply, in order; an error names the option."""
    for option, applies, apply in steps:
        if applies:
            with translated(option):
                apply()


def _quantise(transformer: Any, wanted: Acceleration, device: torch.device) -> None:
    from torchao import quantization as torchao  # noqa: PLC0415

    # torchao's recommended compiler settings hold for the whole process; they are left alone.
    config: Any = (
        torchao.Float8WeightOnlyConfig(set_inductor_config=False)
        if wanted.fp8 == "weights"
        else torchao.Float8DynamicActivationFloat8WeightConfig(granularity=torchao.PerRow(), set_inductor_config=False)
    )
    for block in transformer.blocks:
        block.to(device)  # one at a time: the device never holds all unquantised weights
        torchao.quantize_(block, config)
        if wanted.offload != "none":
            block.to("cpu")
    # torchao silently skips layers whose shape its kernels do not support.
    layers = transformer.blocks.modules()
    if any(isinstance(layer, nn.Linear) and type(layer.weight) is nn.Parameter for layer in layers):
        raise ValueError("the sides of some weights are not multiples of 16")


def _compile(transformer: Any) -> None:
    # Code that was compiled for one size is looked for before that for any size, which would fit as well and is slower:
    # by default the newest comes first.
    cast(Any, torch)._C._dynamo.eval_frame._set_lru_cache(False)
    # Not `compile_repeated_blocks`: that also compiles the wrappers around `forward`, where the cache hooks are.
    for block in transformer.blocks:
        block.forward = torch.compile(block.forward)


def _place(parts: Any, offload: str, device: torch.device) -> None:
    if offload == "none":
        parts.to(device)
    elif offload == "model":
        parts.enable_model_cpu_offload(device=device)
    elif offload == "sequential":
        parts.enable_sequential_cpu_offload(device=device)
    else:
        _offload_groups(parts, device)


def _offload_groups(parts: Any, device: torch.device) -> None:
    """Offloads the transformer by block and the encoders by layer; the VAE is small and stays on the device."""
    from diffusers.hooks.group_offloading import apply_group_offloading  # noqa: PLC0415

    models = {name: part for name, part in parts.components.items() if isinstance(part, nn.Module)}
    for name, model in models.items():
        if name == "vae":
            model.to(device)
        elif name == "transformer":
            streams = device.type == "cuda"
            if streams:
                for block in cast(Any, model).blocks:
                    pin(block)
            # With `record_stream` the CPU does not wait for the copies of each block.
            apply_group_offloading(model, device, num_blocks_per_group=1, use_stream=streams, record_stream=streams)
        else:
            apply_group_offloading(model, device, offload_type="leaf_level")


def pin(module: nn.Module) -> None:
    """Puts weights into pinned memory, one by one: the memory of each is free again before the next one is pinned.

    diffusers pins copies of all before it lets go of any; what is pinned already it takes as it is.
    """
    for tensor in (*module.parameters(), *module.buffers()):
        if names := getattr(type(tensor), "tensor_data_names", ()):  # torchao's, which are made of others
            for name in names:
                setattr(tensor, name, getattr(tensor, name).pin_memory())
        else:
            tensor.data = tensor.data.pin_memory()


@contextmanager
def translated(option: str) -> Generator[None]:
    """Turns any exception of a library into `GeneratorUnavailable` naming the option and the reason, without paths."""
    try:
        yield
    except (CowError, torch.OutOfMemoryError, torch.AcceleratorError):
        raise
    except Exception as error:
        reason = re.sub(r"(/[\w.+-]+)+/", "", (str(error).splitlines() or [""])[0])[:300]
        raise GeneratorUnavailable(
            f"`{option}` does not work here: {type(error).__name__}: {reason}. Choose another profile (COW_PROFILE)."
        ) from error
