"""What a device and the packages around it can do, as a record that can be made up where there is no such device."""

from __future__ import annotations

import os
import platform
import re
import shutil
import sysconfig
from collections.abc import Mapping
from importlib import metadata
from pathlib import Path
from typing import NamedTuple

import torch
from pydantic import Field

from cow_service.records import Record

Capability = tuple[int, int]
HOPPER, ADA, AMPERE, VOLTA = (9, 0), (8, 9), (8, 0), (7, 0)


class Backend(NamedTuple):
    """What one of diffusers' attention backends needs. Without `at_least` it runs on any device."""

    package: str | None = None
    at_least: Capability | None = None
    at_most: Capability | None = None
    splits: bool = False  # among GPUs


BACKENDS: Mapping[str, Backend] = {
    "native": Backend(splits=True),
    "_native_math": Backend(),
    "_native_flash": Backend(None, AMPERE, splits=True),
    "_native_cudnn": Backend(None, AMPERE, splits=True),
    "_native_efficient": Backend(None, VOLTA),
    "flash": Backend("flash-attn", AMPERE, splits=True),
    "flash_hub": Backend("kernels", AMPERE, splits=True),
    "_flash_3": Backend("flash-attn-3", HOPPER, HOPPER),
    "_flash_3_hub": Backend("kernels", HOPPER, HOPPER, splits=True),
    "sage": Backend("sageattention", AMPERE, splits=True),
    "sage_hub": Backend("kernels", AMPERE, splits=True),
    "_sage_qk_int8_pv_fp16_cuda": Backend("sageattention", AMPERE),
    "_sage_qk_int8_pv_fp8_cuda_sm90": Backend("sageattention", HOPPER, HOPPER),
    "xformers": Backend("xformers", VOLTA),
}
# Distributions and the least versions that diffusers takes (a test compares them).
PACKAGES: Mapping[str, str] = {
    "accelerate": "0.17.0",
    "flash-attn": "2.6.3",
    "flash-attn-3": "3.0.0",
    "kernels": "0.12",
    "sageattention": "2.1.1",
    "torchao": "0.15.0",
    "triton": "3.0.0",
    "xformers": "0.0.29",
}


class Machine(Record):
    """What a device and what is installed around it can do. It does not say what is free at the moment."""

    device: str = Field(description="cuda, cpu, ...")
    name: str
    capability: Capability | None = Field(default=None, description="Compute capability; null without an NVIDIA GPU.")
    memory: int = Field(ge=0, description="Bytes, of the device.")
    gpus: int = Field(ge=0, description="GPUs that PyTorch sees.")
    packages: tuple[str, ...] = Field(default=(), description="Distributions that are installed and new enough.")
    compiler: bool = Field(description="A C++ compiler and Python's headers are here.")
    ranks: int = Field(default=1, ge=1, description="Processes that torchrun started.")

    @property
    def told(self) -> str:
        """The device in words."""
        kind = "" if self.capability is None else f" of compute capability {dotted(self.capability)}"
        return f"this device is {self.name}{kind}" if kind else f"this device is the {self.device.upper()}"


def dotted(capability: Capability) -> str:
    """A compute capability as NVIDIA writes it."""
    return f"{capability[0]}.{capability[1]}"


def look(device: torch.device) -> Machine:
    """The machine as seen from one device."""
    gpu = torch.cuda.get_device_properties(device) if device.type == "cuda" else None
    return Machine(
        device=device.type,
        name=gpu.name if gpu else platform.machine(),
        capability=(gpu.major, gpu.minor) if gpu else None,
        memory=gpu.total_memory if gpu else os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"),
        gpus=torch.cuda.device_count(),
        packages=tuple(name for name, least in PACKAGES.items() if _installed(name, least)),
        compiler=_compiles(),
        ranks=int(os.environ.get("WORLD_SIZE", "1")),
    )


def _installed(name: str, least: str) -> bool:
    try:
        return _numbers(metadata.version(name)) >= _numbers(least)
    except metadata.PackageNotFoundError:
        return False


def _numbers(version: str) -> tuple[int, ...]:
    return tuple(int(number) for number in re.findall(r"\d+", version)[:3])


def _compiles() -> bool:
    """PyTorch's compiler builds C++ for the CPU, and Triton a C launcher for the GPU, both against Python's headers."""
    header = Path(sysconfig.get_paths()["include"]) / "Python.h"
    return header.is_file() and any(shutil.which(name) for name in (os.environ.get("CXX", "g++"), "clang++"))
