"""What a device and the installed packages support, and which options of an `Acceleration` they do not."""

import os
import platform
import re
import shutil
import sysconfig
from collections.abc import Iterator, Mapping
from importlib import metadata
from pathlib import Path
from typing import NamedTuple

import torch
from pydantic import Field

from cow_service.generators.wan.profiles import Acceleration
from cow_service.records import Record

AUTO = "auto"  # in place of a backend's name
ComputeCapability = tuple[int, int]
HOPPER, ADA, AMPERE, VOLTA = (9, 0), (8, 9), (8, 0), (7, 0)


class AttentionBackend(NamedTuple):
    """What one of diffusers' attention backends needs. Without `at_least` it runs on any device."""

    package: str | None = None
    at_least: ComputeCapability | None = None
    at_most: ComputeCapability | None = None
    context_parallel: bool = False  # whether several GPUs can share one clip
    in_auto: bool = True  # whether `auto` may choose it: it computes the same as native to rounding


ATTENTION_BACKENDS: Mapping[str, AttentionBackend] = {
    "native": AttentionBackend(context_parallel=True),
    "_native_math": AttentionBackend(in_auto=False),  # its memory grows with the square of the tokens
    "_native_flash": AttentionBackend(None, AMPERE, context_parallel=True),
    "_native_cudnn": AttentionBackend(None, AMPERE, context_parallel=True),
    "_native_efficient": AttentionBackend(None, VOLTA),
    "flash": AttentionBackend("flash-attn", AMPERE, context_parallel=True),
    "flash_hub": AttentionBackend("kernels", AMPERE, context_parallel=True),
    "_flash_3": AttentionBackend("flash-attn-3", HOPPER, HOPPER),
    "_flash_3_hub": AttentionBackend("kernels", HOPPER, HOPPER, context_parallel=True),
    "flash_4_hub": AttentionBackend("kernels", HOPPER),
    "sage": AttentionBackend("sageattention", AMPERE, context_parallel=True, in_auto=False),
    "sage_hub": AttentionBackend("kernels", AMPERE, context_parallel=True, in_auto=False),
    "_sage_qk_int8_pv_fp16_cuda": AttentionBackend("sageattention", AMPERE, in_auto=False),
    "_sage_qk_int8_pv_fp8_cuda": AttentionBackend("sageattention", ADA, in_auto=False),
    "_sage_qk_int8_pv_fp8_cuda_sm90": AttentionBackend("sageattention", HOPPER, HOPPER, in_auto=False),
    "xformers": AttentionBackend("xformers", VOLTA),
}
# What to take in place of a package that has to be built: the backend that fetches the kernel from the hub.
HUB: Mapping[str, str] = {"flash-attn": "flash_hub", "flash-attn-3": "_flash_3_hub", "sageattention": "sage_hub"}
# Distributions and the minimum versions that diffusers accepts (a test compares them).
MINIMUM_VERSIONS: Mapping[str, str] = {
    "accelerate": "0.17.0",
    "cache-dit": "1.5.0",
    "flash-attn": "2.6.3",
    "flash-attn-3": "3.0.0",
    "kernels": "0.12.3",
    "sageattention": "2.1.1",
    "torchao": "0.15.0",
    "triton": "3.0.0",
    "xformers": "0.0.29",
}


class Capabilities(Record):
    """What a device and the installed packages support. It does not say how much memory is free."""

    device: str = Field(description="cuda, cpu, ...")
    name: str
    compute_capability: ComputeCapability | None = Field(default=None, description="Null without an NVIDIA GPU.")
    memory: int = Field(ge=0, description="Bytes, of the device.")
    gpus: int = Field(ge=0, description="GPUs that PyTorch sees, from this one on.")
    packages: tuple[str, ...] = Field(default=(), description="Installed in at least the minimum version.")
    compiler: bool = Field(description="A C++ compiler and Python's headers are installed.")

    @property
    def description(self) -> str:
        """The device in words, for messages."""
        if self.compute_capability is None:
            return f"this device is the {self.device.upper()}"
        return f"this device is {self.name} of compute capability {_dotted(self.compute_capability)}"


def detect_capabilities(device: torch.device) -> Capabilities:
    """What this machine supports on a device."""
    gpu = torch.cuda.get_device_properties(device) if device.type == "cuda" else None
    # PyTorch's compiler builds C++ for the CPU, and Triton a C launcher for the GPU, both against Python's headers.
    header = Path(sysconfig.get_paths()["include"]) / "Python.h"
    compilers = os.environ.get("CXX", "g++"), "clang++"
    return Capabilities(
        device=device.type,
        name=gpu.name if gpu else platform.machine(),
        compute_capability=(gpu.major, gpu.minor) if gpu else None,
        memory=gpu.total_memory if gpu else os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"),
        gpus=max(0, torch.cuda.device_count() - (device.index or 0)),
        packages=tuple(name for name, least in MINIMUM_VERSIONS.items() if _is_installed(name, least)),
        compiler=header.is_file() and any(shutil.which(name) for name in compilers),
    )


def backends_for_auto(acceleration: Acceleration, available: Capabilities) -> tuple[str, ...]:
    """The attention backends that a device supports and `attention: auto` may choose; native is one of them."""
    return tuple(
        name
        for name, backend in ATTENTION_BACKENDS.items()
        if backend.in_auto
        and (backend.context_parallel or acceleration.context_parallel == 1)
        and not any(_refuse_attention(acceleration.model_copy(update={"attention": name}), available))
    )


def is_from_hub(name: str) -> bool:
    """Whether diffusers downloads the kernel of an attention backend."""
    backend = ATTENTION_BACKENDS.get(name)
    return backend is not None and backend.package == "kernels"


def refusals(acceleration: Acceleration, available: Capabilities) -> tuple[str, ...]:
    """One sentence, with reason and remedy, for each option that is not supported; empty if all are."""
    checks = _refuse_attention, _refuse_computing, _refuse_placing
    return tuple(sentence for refuse in checks for sentence in refuse(acceleration, available))


def _refuse_attention(wanted: Acceleration, available: Capabilities) -> Iterator[str]:
    name, backend, here = wanted.attention, ATTENTION_BACKENDS.get(wanted.attention), available.description
    if name == AUTO:
        if available.device != "cuda":
            yield f"attention: auto needs a GPU, whose backends it times, and {here}; choose native."
        return
    if backend is None:
        yield f"attention: there is no '{name}'; choose one of {', '.join((AUTO, *ATTENTION_BACKENDS))}."
        return
    low, high, own = backend.at_least, backend.at_most, available.compute_capability
    if low and (own is None or not low <= own <= (high or own)):
        needed = _dotted(low) if low == high else f"{_dotted(low)} or more"
        yield f"attention: '{name}' needs a GPU of compute capability {needed}, and {here}; choose native."
    if backend.package and backend.package not in available.packages:
        others = f"{HUB[backend.package]} or native" if backend.package in HUB else "native"
        yield f"attention: '{name}' needs {_package(backend.package)}; install it, or choose {others}."


def _refuse_computing(wanted: Acceleration, available: Capabilities) -> Iterator[str]:
    """What `compile`, `cache` and `fp8` lack."""
    has, own, here = available.packages, available.compute_capability, available.description
    if wanted.compile != "none":
        if available.device == "cuda" and "triton" not in has:
            yield f"compile: regional needs {_package('triton')}; install it, or choose none."
        if not available.compiler:
            yield "compile: regional needs a C++ compiler and Python's headers; install them, or choose none."
        if wanted.offload == "sequential":
            remedy = "which leaves nothing to compile; choose none"
            yield f"compile: sequential offload moves every layer by itself, {remedy}."
    if wanted.cache == "mag" and not wanted.mag_ratios:
        yield "cache: mag needs `mag_ratios`, measured on these weights; give them, or choose first-block."
    if wanted.cache == "dbcache" and "cache-dit" not in has:
        yield f"cache: dbcache needs {_package('cache-dit')}; install it, or choose first-block."
    if wanted.cache == "dbcache" and wanted.ranks > 1:  # it counts passes, of which each GPU sees its own
        yield "cache: dbcache is for one GPU; choose mag or none."
    if wanted.cache == "first-block" and wanted.context_parallel > 1:
        # Each GPU measures the change of its own shard; if only some skip, the others wait for their tensors forever.
        yield "cache: GPUs that share a video would not skip the same steps with first-block; choose mag or none."
    if wanted.fp8 != "none" and "torchao" not in has:
        yield f"fp8: {wanted.fp8} needs {_package('torchao')}; install it, or choose none."
    needed = f"compute capability {_dotted(ADA)} or more"
    if wanted.fp8 == "dynamic" and (own is None or own < ADA):
        yield f"fp8: dynamic needs a GPU of {needed}, and {here}; choose none."
    if wanted.fp8 in {"stored", "weights"} and wanted.compile != "none" and own and own < ADA:  # Triton lacks it there
        yield f"fp8: {wanted.fp8} can only be compiled for {needed}, and {here}; choose `compile: none`."


def _refuse_placing(wanted: Acceleration, available: Capabilities) -> Iterator[str]:
    """What `offload`, `context_parallel` and `guidance_parallel` lack."""
    on_gpu, here = available.device == "cuda", available.description
    if wanted.offload != "none":
        if not on_gpu:
            yield f"offload: {wanted.offload} needs a GPU to move weights to, and {here}; choose none."
        if "accelerate" not in available.packages:
            yield f"offload: {wanted.offload} needs {_package('accelerate')}; install it, or choose none."
    if wanted.ranks > 1:
        if on_gpu and available.gpus < wanted.ranks:
            share = f"{wanted.ranks} GPUs are to share a clip, from that of COW_DEVICE on"
            yield f"{share}, and there are {available.gpus}."
        if wanted.offload != "none":
            yield f"offload: {wanted.offload} is for one GPU, and {wanted.ranks} are to share a clip; choose none."
    if wanted.context_parallel > 1:
        if not on_gpu:
            yield f"context_parallel: {wanted.context_parallel} needs GPUs, and {here}; choose 1."
        if not ATTENTION_BACKENDS.get(wanted.attention, ATTENTION_BACKENDS["native"]).context_parallel:
            able = ", ".join(name for name, backend in ATTENTION_BACKENDS.items() if backend.context_parallel)
            yield f"context_parallel: attention '{wanted.attention}' cannot be split among GPUs; choose one of {able}."


def _dotted(capability: ComputeCapability) -> str:
    return f"{capability[0]}.{capability[1]}"


def _package(name: str) -> str:
    return f"the package {name} {MINIMUM_VERSIONS[name]} or newer, which is not installed"


def _is_installed(name: str, least: str) -> bool:
    try:
        found = metadata.version(name)
    except metadata.PackageNotFoundError:
        return False
    numbers, wanted = ([int(number) for number in re.findall(r"\d+", version)[:3]] for version in (found, least))
    return numbers >= wanted
