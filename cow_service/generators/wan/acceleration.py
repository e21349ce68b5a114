"""Makes a loaded pipeline faster or smaller, and says in words what this machine cannot do.

The order of `accelerate` is that of what lies inside what: weights, attention, the compiled block, the cache that skips
that block, the split among GPUs around the cache, memory. A block compiled with its cache hooks breaks into pieces
(first-block) or is not compiled at all (mag), and a cache around the split compares the whole with a part.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Generator, Iterator
from contextlib import contextmanager
from typing import Any, Literal, cast

import diffusers
import torch
from pydantic import Field
from torch import nn

from cow_service.errors import CowError, GeneratorUnavailable
from cow_service.generators.wan.lora import add_lora
from cow_service.generators.wan.machine import ADA, BACKENDS, PACKAGES, Machine, dotted, look
from cow_service.records import Record

__all__ = ["Acceleration", "Machine", "accelerate", "add_lora", "look", "refusals", "reset_cache"]


class Acceleration(Record):
    """How the model is run: what every option gives, what it costs, and whether it changes the frames."""

    attention: str = Field(
        default="native",
        description="Attention backend, by its name in diffusers. native is PyTorch's own and needs nothing. flash and "
        "_flash_3 (Hopper GPUs only) are exact to rounding and faster; sage computes in 8 bits, faster still, with "
        "small visible differences. Names that end in _hub download their kernel from the Hugging Face hub at start.",
    )
    compile: Literal["none", "regional"] = Field(
        default="none",
        description="regional compiles the transformer's block once for all of its layers; the same to rounding. The "
        "first clips of new shapes wait for the compiler.",
    )
    cache: Literal["none", "first-block", "mag"] = Field(
        default="none",
        description="Skips the transformer in steps that would change little, and so changes the frames. first-block "
        "runs the first layer of every step and skips the others if its output changed by less than `cache_threshold`. "
        "mag decides by `mag_ratios` alone: never in the first fifth of the steps, never more than 3 in a row. Both "
        "keep one to three copies of the hidden states per guidance branch. Of no use with few, distilled steps.",
    )
    cache_threshold: float = Field(
        default=0.05,
        ge=0,
        description="For first-block, relative change of the first layer's output; for mag, the error that may add up. "
        "0 skips nothing; the larger, the faster and the worse.",
    )
    mag_ratios: tuple[float, ...] = Field(
        default=(),
        description="For mag: by how much the model's residual grows from each step to the next, measured on these "
        "weights. They are spread over the steps of a clip.",
    )
    fp8: Literal["none", "weights", "dynamic"] = Field(
        default="none",
        description="Stores the linear layers of the transformer's blocks as float8, half of bfloat16's memory; norms, "
        "embeddings and the last layer stay as they are. Both change the frames slightly. weights computes in the "
        "model's precision, and is slower than none; dynamic also computes in float8, and is faster where compiled.",
    )
    offload: Literal["none", "model", "group", "sequential"] = Field(
        default="none",
        description="Keeps parts in the CPU's memory; the frames stay the same. model moves one whole part at a time, "
        "which costs seconds per clip. group moves one block while the one before it computes: far less memory, and "
        "little time where the connection is fast; it pins the transformer in the CPU's memory. sequential moves every "
        "layer by itself: the least memory of all, and many times slower.",
    )
    vae_tiling: bool = Field(
        default=False,
        description="Encodes and decodes in overlapping tiles of 256 px: less memory, more time, faint seams at most.",
    )
    context_parallel: int = Field(
        default=1,
        ge=1,
        description="GPUs among which the video's tokens are split in every layer (Ulysses); the same to rounding. As "
        "many processes, started with torchrun, must all make the same clip. It must divide the number of attention "
        "heads and that of tokens: latent frames x height / 16 x width / 16.",
    )


def refusals(acceleration: Acceleration, machine: Machine) -> tuple[str, ...]:
    """One sentence for everything that the machine cannot do, with the reason and a remedy; none if it can do all."""
    checks = (_attention, _compiling, _caching, _float8, _offloading, _splitting)
    return tuple(sentence for check in checks for sentence in check(acceleration, machine))


def check_machine(acceleration: Acceleration, device: torch.device) -> None:
    """Raises `GeneratorUnavailable` with everything that this machine cannot do. Quick: nothing is loaded."""
    with _translated(f"device: {device}"):
        sentences = refusals(acceleration, look(device))
    if sentences:
        raise GeneratorUnavailable(f"{' '.join(sentences)} Another profile may do (COW_PROFILE).")


def accelerate(pipeline: object, acceleration: Acceleration, device: torch.device) -> None:
    """Applies every option to the pipeline's parts and puts them where they run; only once per pipeline.

    Raises `GeneratorUnavailable` with what this machine cannot do, before anything is changed, or with the option that
    failed. Compiling happens in the first clip.
    """
    wanted, parts = acceleration, cast(Any, pipeline)
    transformer = parts.transformer
    check_machine(acceleration, device)
    steps: tuple[tuple[str, bool, Callable[[], object]], ...] = (
        (f"fp8: {wanted.fp8}", wanted.fp8 != "none", lambda: _quantise(transformer, wanted, device)),
        (f"attention: {wanted.attention}", True, lambda: transformer.set_attention_backend(wanted.attention)),
        ("compile: regional", wanted.compile != "none", lambda: _compile(transformer)),
        (f"cache: {wanted.cache}", wanted.cache != "none", lambda: _cache(transformer, wanted)),
        ("context_parallel", wanted.context_parallel > 1, lambda: _split(transformer, wanted.context_parallel, device)),
        ("vae_tiling", wanted.vae_tiling, lambda: _tile(parts.vae)),
        (f"offload: {wanted.offload}", True, lambda: _place(parts, wanted.offload, device)),
    )
    for option, applies, apply in steps:
        if applies:
            with _translated(option):
                apply()


def reset_cache(transformer: object, steps: int | None = None) -> None:
    """Forgets what the cache kept; before every clip, so that no residual of one enters the next.

    `steps` of the coming clip: mag's ratios are spread over them; without it, each ratio is one step. Every forward of
    the clip belongs in `transformer.cache_context("cond")` or `("uncond")`, whose caches stay apart.
    """
    from diffusers.hooks.mag_cache import MagCacheConfig, nearest_interp  # noqa: PLC0415

    model = cast(Any, transformer)
    model._reset_stateful_cache()
    config = model._cache_config
    if isinstance(config, MagCacheConfig):  # the hooks of all blocks share this one object
        ratios = cast(Any, config).measured
        config.num_inference_steps = steps or len(ratios)
        config.mag_ratios = nearest_interp(ratios, config.num_inference_steps)


def _quantise(transformer: Any, wanted: Acceleration, device: torch.device) -> None:
    from torchao import quantization as torchao  # noqa: PLC0415

    # torchao's recommended compiler settings hold for the whole process; they are left alone.
    config: Any = (
        torchao.Float8WeightOnlyConfig(set_inductor_config=False)
        if wanted.fp8 == "weights"
        else torchao.Float8DynamicActivationFloat8WeightConfig(granularity=torchao.PerRow(), set_inductor_config=False)
    )
    for block in transformer.blocks:
        block.to(device)  # one at a time: the device never holds all of the large weights
        torchao.quantize_(block, config)
        if wanted.offload != "none":
            block.to("cpu")
    # torchao leaves alone, without a word, what its kernels cannot multiply.
    layers = transformer.blocks.modules()
    if any(isinstance(layer, nn.Linear) and type(layer.weight) is nn.Parameter for layer in layers):
        raise ValueError("the sides of some weights are not multiples of 16")


def _tile(vae: Any) -> None:
    vae.enable_tiling()


def _compile(transformer: Any) -> None:
    # Not `compile_repeated_blocks`: it compiles what stands around `forward` as well, and the hooks stand there.
    for block in transformer.blocks:
        block.forward = torch.compile(block.forward)


def _cache(transformer: Any, wanted: Acceleration) -> None:
    from diffusers.hooks.first_block_cache import FirstBlockCacheConfig  # noqa: PLC0415
    from diffusers.hooks.mag_cache import MagCacheConfig  # noqa: PLC0415

    if wanted.cache == "first-block":
        config = FirstBlockCacheConfig(threshold=wanted.cache_threshold)
    else:
        ratios = torch.tensor(wanted.mag_ratios)
        config = MagCacheConfig(threshold=wanted.cache_threshold, num_inference_steps=len(ratios), mag_ratios=ratios)
        cast(Any, config).measured = ratios
    transformer.enable_cache(config)


def _split(transformer: Any, gpus: int, device: torch.device) -> None:
    if transformer.config.num_attention_heads % gpus:
        raise ValueError(f"{transformer.config.num_attention_heads} attention heads cannot be split among {gpus} GPUs")
    if device.type == "cuda":
        torch.cuda.set_device(device)
    if not torch.distributed.is_initialized():
        torch.distributed.init_process_group()
    transformer.enable_parallelism(config=cast(Any, diffusers).ContextParallelConfig(ulysses_degree=gpus))


def _place(parts: Any, offload: str, device: torch.device) -> None:
    if offload == "none":
        parts.to(device)
    elif offload == "model":
        parts.enable_model_cpu_offload(device=device)
    elif offload == "sequential":
        parts.enable_sequential_cpu_offload(device=device)
    else:
        _place_groups(parts, device)


def _place_groups(parts: Any, device: torch.device) -> None:
    """Blocks of the transformer and layers of the encoders come one by one; the VAE is small and stays."""
    from diffusers.hooks.group_offloading import apply_group_offloading  # noqa: PLC0415

    models = {name: part for name, part in parts.components.items() if isinstance(part, nn.Module)}
    for name, model in models.items():
        if name == "vae":
            model.to(device)
        elif name == "transformer":
            streams = device.type == "cuda"
            apply_group_offloading(model, device, num_blocks_per_group=1, use_stream=streams)
        else:
            apply_group_offloading(model, device, offload_type="leaf_level")


def _attention(wanted: Acceleration, machine: Machine) -> Iterator[str]:
    name, backend = wanted.attention, BACKENDS.get(wanted.attention)
    if backend is None:
        yield f"attention: there is no '{name}'; choose one of {', '.join(BACKENDS)}."
        return
    low, high = backend.at_least, backend.at_most
    if low and (machine.capability is None or not low <= machine.capability <= (high or machine.capability)):
        least = dotted(low) if low == high else f"{dotted(low)} or more"
        yield f"attention: '{name}' needs a GPU of compute capability {least}, and {machine.told}; choose native."
    if backend.package and backend.package not in machine.packages:
        yield f"attention: '{name}' needs {_package(backend.package)}; install it, or choose native."


def _compiling(wanted: Acceleration, machine: Machine) -> Iterator[str]:
    if wanted.compile == "none":
        return
    if machine.device == "cuda" and "triton" not in machine.packages:
        yield f"compile: regional needs {_package('triton')}; install it, or choose none."
    if not machine.compiler:
        yield "compile: regional needs a C++ compiler and Python's headers; install them, or choose none."
    if wanted.offload == "sequential":
        yield "compile: sequential offload moves every layer by itself, which leaves nothing to compile; choose none."


def _caching(wanted: Acceleration, machine: Machine) -> Iterator[str]:
    if wanted.cache == "mag" and not wanted.mag_ratios:
        yield "cache: mag needs `mag_ratios`, measured on these weights; give them, or choose first-block."
    if wanted.cache == "first-block" and wanted.context_parallel > 1:
        # Each measures the change of its own part; one that skips leaves the others waiting for its share.
        yield "cache: GPUs that share a video would not skip the same steps with first-block; choose mag or none."


def _float8(wanted: Acceleration, machine: Machine) -> Iterator[str]:
    if wanted.fp8 == "none":
        return
    if "torchao" not in machine.packages:
        yield f"fp8: {wanted.fp8} needs {_package('torchao')}; install it, or choose none."
    if wanted.fp8 == "dynamic" and (machine.capability or (0, 0)) < ADA:
        yield f"fp8: dynamic needs a GPU of compute capability {dotted(ADA)} or more, and {machine.told}; choose none."
    # Triton has no float8 there.
    if wanted.fp8 == "weights" and wanted.compile != "none" and machine.capability and machine.capability < ADA:
        needed = f"compute capability {dotted(ADA)} or more"
        yield f"fp8: weights can only be compiled for {needed}, and {machine.told}; choose `compile: none`."


def _offloading(wanted: Acceleration, machine: Machine) -> Iterator[str]:
    if wanted.offload == "none":
        return
    if machine.device != "cuda":
        yield f"offload: {wanted.offload} needs a GPU to move weights to, and {machine.told}; choose none."
    if "accelerate" not in machine.packages:
        yield f"offload: {wanted.offload} needs {_package('accelerate')}; install it, or choose none."


def _splitting(wanted: Acceleration, machine: Machine) -> Iterator[str]:
    count = wanted.context_parallel
    if count == 1:
        return
    if machine.gpus < count:
        yield f"context_parallel: {count} needs as many GPUs, and there are {machine.gpus}; choose 1."
    if machine.ranks != count:
        remedy = f"start them with `torchrun --nproc-per-node {count}`, or choose 1"
        yield f"context_parallel: {count} needs as many processes, and there are {machine.ranks}; {remedy}."
    if not BACKENDS.get(wanted.attention, BACKENDS["native"]).splits:
        able = ", ".join(name for name, backend in BACKENDS.items() if backend.splits)
        yield f"context_parallel: attention '{wanted.attention}' cannot be split among GPUs; choose one of {able}."


def _package(name: str) -> str:
    return f"the package {name} {PACKAGES[name]} or newer, which is not installed"


@contextmanager
def _translated(option: str) -> Generator[None]:
    """Whatever a library raises becomes a `GeneratorUnavailable` with the option and the reason, without folders."""
    try:
        yield
    except (CowError, torch.OutOfMemoryError):
        raise
    except Exception as error:
        reason = re.sub(r"(/[\w.+-]+)+/", "", (str(error).splitlines() or [""])[0])[:300]
        raise GeneratorUnavailable(
            f"`{option}` does not work here: {type(error).__name__}: {reason}. Choose another profile (COW_PROFILE)."
        ) from error
