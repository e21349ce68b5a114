"""What a profile's weights take of a device's and of the machine's memory, known before any of them is read."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open

from cow_service.errors import CheckpointInvalid, GeneratorUnavailable
from cow_service.generators.wan.acceleration import check_device
from cow_service.generators.wan.checkpoints import FLOAT8 as FLOAT8_DTYPES
from cow_service.generators.wan.checkpoints import checkpoint_files
from cow_service.generators.wan.profiles import IMAGE_ENCODER_DTYPE, Profile, profile_of
from cow_service.weights.manifests import Manifest

BYTES = {"float32": 4, "bfloat16": 2, "float16": 2}
FLOAT8 = 1
BLOCKS_AT_ONCE = 2  # of the transformer's, with `offload: group`: one computes while the next one comes
# Of blocks that are moved one by one and pinned for it: PyTorch rounds every pinned tensor up to a power of two. In the
# 14B model's blocks, 10 matrices of 52 MB take 67 MB each, and 2 of 142 MB 268 MB.
PINNED = 1.5
BASE_PARTS = ("text_encoder", "image_encoder", "vae")
CGROUP = Path("/sys/fs/cgroup/memory.max")  # of a container, in bytes or "max"


@dataclass(frozen=True)
class Need:
    """Bytes of weights, without what a clip takes on top."""

    device: int
    host: int  # while loading, or as long as parts are offloaded


def need_of(profile: Profile, parameters: Mapping[str, int], blocks: int) -> Need:
    """What a profile's weights take, by the number of parameters of each part and of the transformer's blocks."""
    wanted = profile.acceleration
    sizes = {
        "transformer": parameters["transformer"] * BYTES[profile.dtype],
        "text_encoder": parameters["text_encoder"] * BYTES[profile.dtype],
        "image_encoder": parameters["image_encoder"] * BYTES[IMAGE_ENCODER_DTYPE],
        "vae": parameters["vae"] * BYTES[profile.vae_dtype],
    }
    whole = sum(sizes.values())
    stored = sizes | ({"transformer": parameters["transformer"] * FLOAT8} if wanted.fp8 != "none" else {})
    held = {
        "none": sum(stored.values()),
        "model": max(stored.values()),
        "group": stored["vae"] + BLOCKS_AT_ONCE * stored["transformer"] // blocks,
        "sequential": 0,
    }[wanted.offload]
    through_host = wanted.offload != "none" or wanted.fp8 in {"weights", "dynamic"}
    if wanted.fp8 == "stored":
        whole = sum(stored.values())
    more = int((PINNED - 1) * stored["transformer"]) if wanted.offload == "group" else 0
    return Need(held, wanted.ranks * (whole + more) if through_host else 0)


def check_memory(manifest: Manifest, name: str, checkpoint: Path, base: Path, device: torch.device) -> None:
    """Raises `GeneratorUnavailable` where the weights of the profile of that name cannot fit, naming those that can.

    What lies in the folders is not read but for the shapes in its headers; where that fails, loading says why.
    """
    parameters = _parameters(checkpoint, base)
    if parameters is None:
        return
    has_float8 = any(dtype in FLOAT8_DTYPES for dtype in _dtypes(checkpoint_files(checkpoint)[1]))
    if profile_of(manifest, name).acceleration.fp8 == "stored" and not has_float8:
        raise GeneratorUnavailable(
            f"The profile '{name}' keeps the float8 of a checkpoint, and that of '{manifest.name}' has none: give one "
            "that does (COW_CHECKPOINTS), or set COW_PROFILE."
        )
    blocks = int(manifest.architecture["num_layers"])
    room = _room(device), _host()
    need = need_of(profile_of(manifest, name), parameters, blocks)
    short = _short(need, room, device)
    if short is None:
        return
    fitting = [
        other
        for other in manifest.profiles
        if _short(need_of(profile_of(manifest, other), parameters, blocks), room, device) is None
        and _runs(profile_of(manifest, other), device)
        and (has_float8 or profile_of(manifest, other).acceleration.fp8 != "stored")
    ]
    remedy = f"Of its profiles fit: {', '.join(fitting)} (COW_PROFILE)." if fitting else "None of its profiles fits."
    raise GeneratorUnavailable(f"The weights of '{manifest.name}' with the profile '{name}' take {short}. {remedy}")


def _short(need: Need, room: tuple[int, int], device: torch.device) -> str | None:
    """What there is too little of, in words; None where all fits. On a CPU both are the same memory."""
    if device.type == "cpu":
        need = Need(0, max(need.device, need.host))
    if need.device > room[0]:
        return f"{need.device / 1e9:.0f} GB of the GPU's memory, and it has {room[0] / 1e9:.0f} GB"
    if need.host > room[1]:
        return f"{need.host / 1e9:.0f} GB of this machine's memory, and it has {room[1] / 1e9:.0f} GB"
    return None


def _runs(profile: Profile, device: torch.device) -> bool:
    try:
        check_device(profile.acceleration, device)
    except GeneratorUnavailable:
        return False
    return True


def _room(device: torch.device) -> int:
    """Bytes that a GPU has in all."""
    return torch.cuda.get_device_properties(device).total_memory if device.type == "cuda" else 0


def _host() -> int:
    """Bytes that this machine, or its container, has in all."""
    there = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    limit = CGROUP.read_text().strip() if CGROUP.is_file() else "max"
    return min(there, int(limit)) if limit.isdecimal() else there


def _parameters(checkpoint: Path, base: Path) -> dict[str, int] | None:
    """How many numbers each part has by its files' headers; None where they cannot be read."""
    try:
        counts = {"transformer": _count(checkpoint_files(checkpoint)[1])}
        counts |= {part: _count(sorted((base / part).glob("*.safetensors"))) for part in BASE_PARTS}
    except (CheckpointInvalid, SafetensorError, OSError):
        return None
    return counts if all(counts.values()) else None


def _dtypes(files: Iterable[Path]) -> set[str]:
    found: set[str] = set()
    for file in files:
        with safe_open(file, framework="pt") as held:
            found |= {held.get_slice(name).get_dtype() for name in held.keys()}  # noqa: SIM118
    return found


def _count(files: Iterable[Path]) -> int:
    total = 0
    for file in files:
        with safe_open(file, framework="pt") as held:
            total += sum(torch.Size(held.get_slice(name).get_shape()).numel() for name in held.keys())  # noqa: SIM118
    return total
