"""What a device and the installed packages support, and which options of an `Acceleration` they do not."""

import os
import platform
import re
import shutil
import sysconfig
from collections.abc import Mapping
from importlib import metadata
from pathlib import Path

import torch
from pydantic import Field

from cow_service.generators.wan.profiles import Acceleration
from cow_service.records import Record

ComputeCapability = tuple[int, int]
ADA = (8, 9)
# Distributions and the minimum versions that diffusers accepts.
MINIMUM_VERSIONS: Mapping[str, str] = {"torchao": "0.15.0", "triton": "3.0.0"}


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
        packages=tuple(name for name, least in MINIMUM_VERSIONS.items() if is_installed(name, least)),
        compiler=header.is_file() and any(shutil.which(name) for name in compilers),
    )


def refusals(wanted: Acceleration, available: Capabilities) -> tuple[str, ...]:
    """One sentence, with reason and remedy, for each option that is not supported; empty if all are."""
    has, own, here = available.packages, available.compute_capability, available.description
    on_gpu, compiles = available.device == "cuda", wanted.compile != "none"
    fp8, parallel = wanted.fp8, wanted.context_parallel
    found = {
        f"compile: regional needs {_package('triton')}; install it, or choose none.": (
            compiles and on_gpu and "triton" not in has
        ),
        "compile: regional needs a C++ compiler and Python's headers; install them, or choose none.": (
            compiles and not available.compiler
        ),
        # Each GPU measures the change of its own shard; if only some skip, the others wait for their tensors forever.
        "cache: GPUs that share a video would not skip the same steps with first-block; choose none.": (
            wanted.cache == "first-block" and parallel > 1
        ),
        f"fp8: {fp8} needs {_package('torchao')}; install it, or choose none.": fp8 != "none" and "torchao" not in has,
        f"fp8: {fp8} needs a GPU of compute capability {_dotted(ADA)} or more, and {here}; choose none.": (
            fp8.endswith("dynamic") and (own is None or own < ADA)
        ),
        f"offload: {wanted.offload} needs a GPU to move weights to, and {here}; choose none.": (
            wanted.offload != "none" and not on_gpu
        ),
        f"{wanted.ranks} GPUs are to share a clip, from that of COW_DEVICE on, and there are {available.gpus}.": (
            on_gpu and available.gpus < wanted.ranks
        ),
        f"context_parallel: {parallel} needs GPUs, and {here}; choose 1.": parallel > 1 and not on_gpu,
    }
    return tuple(sentence for sentence, applies in found.items() if applies)


def _dotted(capability: ComputeCapability) -> str:
    return f"{capability[0]}.{capability[1]}"


def _package(name: str) -> str:
    return f"the package {name} {MINIMUM_VERSIONS[name]} or newer, which is not installed"


def is_installed(name: str, least: str) -> bool:
    """Whether a distribution is installed in at least that version."""
    try:
        found = metadata.version(name)
    except metadata.PackageNotFoundError:
        return False
    numbers, wanted = ([int(number) for number in re.findall(r"\d+", version)[:3]] for version in (found, least))
    return numbers >= wanted
