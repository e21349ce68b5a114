"""Applies the acceleration of a profile to a loaded pipeline.

The order of `accelerate` follows how the parts enclose each other: weights, attention, the compiled block, the cache
that skips blocks, memory, and last, in `ranks`, context parallelism around the cache. A block compiled together with
its cache hooks breaks its graph; a cache around context parallelism would compare a whole tensor with a shard.
"""

import re
from collections.abc import Generator
from contextlib import contextmanager
from typing import Any, cast

import torch

from cow_service.errors import CowError, GeneratorUnavailable
from cow_service.generators.wan.capabilities import detect_capabilities, refusals
from cow_service.generators.wan.profiles import Acceleration


def check_device(acceleration: Acceleration, device: torch.device) -> None:
    """Raises `GeneratorUnavailable` for all that the device cannot do."""
    with naming_option(f"device: {device}"):
        machine = detect_capabilities(device)
    if sentences := refusals(acceleration, machine):
        raise GeneratorUnavailable(f"{' '.join(sentences)} Another profile may work (COW_PROFILE).")
    from diffusers.models.attention_dispatch import attention_backend  # noqa: PLC0415

    with naming_option(f"attention: {acceleration.attention}"), attention_backend(acceleration.attention):
        pass  # diffusers has looked for what the backend needs, and fetched its kernel


def accelerate(pipeline: Any, wanted: Acceleration, device: torch.device) -> None:
    """Applies every option to the pipeline's parts and moves them to the device. Call it once per pipeline.

    Raises `GeneratorUnavailable`: for what the device cannot do, before anything is changed, or naming the option that
    failed. Compilation happens in the first clip.
    """
    accelerate_transformer(pipeline.transformer, wanted, device)
    if wanted.vae_tiling:
        with naming_option("vae_tiling"):
            pipeline.vae.enable_tiling()
    with naming_option(f"offload: {wanted.offload}"):
        if wanted.offload == "none":
            pipeline.to(device)
        elif wanted.offload == "model":
            pipeline.enable_model_cpu_offload(device=device)
        else:  # the transformer by block and the encoders by layer; the VAE is small and stays on the device
            from diffusers.hooks.group_offloading import apply_group_offloading  # noqa: PLC0415

            transformer, streams = pipeline.transformer, device.type == "cuda"
            for block in transformer.blocks if streams else ():
                pin(block)
            # With `record_stream` the CPU does not wait for the copies of each block.
            apply_group_offloading(
                transformer, device, num_blocks_per_group=1, use_stream=streams, record_stream=streams
            )
            if pipeline.vae is not None:
                pipeline.vae.to(device)
            for encoder in filter(None, (pipeline.text_encoder, pipeline.image_encoder)):
                apply_group_offloading(encoder, device, offload_type="leaf_level")


def accelerate_transformer(transformer: Any, wanted: Acceleration, device: torch.device) -> None:
    """The same for a transformer without the other parts, which stays where it is."""
    check_device(wanted, device)
    with naming_option(f"fp8: {wanted.fp8}"):
        if wanted.fp8 in {"weights", "dynamic"}:
            from torchao import quantization as torchao  # noqa: PLC0415

            # torchao's recommended compiler settings hold for the whole process; they are left alone.
            own: dict[str, Any] = {"set_inductor_config": False}
            config: Any = (
                torchao.Float8WeightOnlyConfig(**own)
                if wanted.fp8 == "weights"
                else torchao.Float8DynamicActivationFloat8WeightConfig(granularity=torchao.PerRow(), **own)
            )
            for block in transformer.blocks:
                block.to(device)  # one at a time: the device never holds all unquantised weights
                torchao.quantize_(block, config)
                if wanted.offload != "none":
                    block.to("cpu")
    with naming_option(f"attention: {wanted.attention}"):
        transformer.set_attention_backend(wanted.attention)
    if wanted.compile != "none":
        with naming_option("compile: regional"):
            # Try the code that was compiled for one size before that for any size, which fits as well and is slower:
            # by default the newest comes first.
            cast(Any, torch)._C._dynamo.eval_frame._set_lru_cache(False)
            # Not `compile_repeated_blocks`: that also compiles the wrappers around `forward`, with the hooks of caches.
            for block in transformer.blocks:
                block.forward = torch.compile(block.forward)
    with naming_option(f"cache: {wanted.cache}"):
        if wanted.cache == "first-block":
            from diffusers.hooks.first_block_cache import FirstBlockCacheConfig  # noqa: PLC0415

            transformer.enable_cache(FirstBlockCacheConfig(threshold=wanted.cache_threshold))


def reset_cache(transformer: Any) -> None:
    """Clears the step cache. Call it before every clip, so that no residual of one clip enters the next."""
    transformer._reset_stateful_cache()  # removing and adding them again would change the order of the hooks


def pin(module: torch.nn.Module) -> None:
    """Puts weights into pinned memory, one by one: the memory of each is free again before the next one is pinned.

    diffusers pins copies of all weights before it releases any; those that are pinned already it takes as they are.
    """
    for tensor in (*module.parameters(), *module.buffers()):
        if names := getattr(type(tensor), "tensor_data_names", ()):  # torchao's, which are made of others
            for name in names:
                setattr(tensor, name, getattr(tensor, name).pin_memory())
        else:
            tensor.data = tensor.data.pin_memory()


@contextmanager
def naming_option(option: str) -> Generator[None]:
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
