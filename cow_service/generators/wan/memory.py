"""What a machine can run: what profiles it supports, whether weights fit, and what happens when memory runs out."""

import gc
import math
import os
import traceback
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import torch

from cow_service.errors import CheckpointInvalid, DeviceFailed, GeneratorOutOfMemory, GeneratorUnavailable
from cow_service.generators.wan import acceleration, checkpoints
from cow_service.generators.wan.capabilities import detect_capabilities, refusals
from cow_service.generators.wan.profiles import IMAGE_ENCODER_DTYPE, Profile, profile_of
from cow_service.weights.device import is_out_of_memory
from cow_service.weights.manifests import Manifest

BYTES = {"float32": 4, "bfloat16": 2, "float16": 2}
BLOCKS_AT_ONCE = 2  # of the transformer's, with `offload: group`: one computes while the next one comes
# Of blocks that are moved one by one and pinned for it: PyTorch rounds every pinned tensor up to a power of two. In the
# 14B model's blocks, 10 matrices of 52 MB take 67 MB each, and 2 of 142 MB 268 MB.
PINNED = 1.5
CGROUP = Path("/sys/fs/cgroup/memory.max")  # of a container, in bytes or "max"


@dataclass(frozen=True)
class Need:
    """Bytes of weights, without what a clip takes on top."""

    device: int
    host: int  # while loading, or as long as parts are offloaded


def need_of(profile: Profile, parameters: Mapping[str, int], blocks: int) -> Need:
    """What a profile's weights take, by the number of parameters of each part and of the transformer's blocks."""
    wanted = profile.acceleration
    loaded = {
        "transformer": parameters["transformer"] * BYTES[profile.dtype],
        "text_encoder": parameters["text_encoder"] * BYTES[profile.dtype],
        "image_encoder": parameters.get("image_encoder", 0) * BYTES[IMAGE_ENCODER_DTYPE],
        "vae": parameters["vae"] * BYTES[profile.vae_dtype],
    }
    kept = loaded | ({"transformer": parameters["transformer"]} if wanted.fp8 != "none" else {})  # a byte each in fp8
    on_device = {
        "none": sum(kept.values()),
        "model": max(kept.values()),
        "group": kept["vae"] + BLOCKS_AT_ONCE * kept["transformer"] // blocks,
    }[wanted.offload]
    if wanted.offload == "none" and wanted.fp8 not in {"weights", "dynamic"}:  # read straight to the device
        return Need(on_device, 0)
    on_host = sum((kept if wanted.keeps_float8 else loaded).values())
    if wanted.offload == "group":
        on_host += int((PINNED - 1) * kept["transformer"])
    return Need(on_device, wanted.ranks * on_host)


def check_machine(manifest: Manifest, name: str, folders: Mapping[str, Path], device: torch.device) -> None:
    """Raises `GeneratorUnavailable` for what the profile of that name needs and is not here, naming those that can run.

    Whether weights fit is read from the headers in `folders` (`transformer` and `base`), once all are here.
    """
    with acceleration.naming_option(f"device: {device}"):
        machine = detect_capabilities(device)
    parameters, has_float8 = _read_headers(folders, tuple(manifest.parameters))

    def lacking(profile: Profile) -> str:
        sentences = refusals(profile.acceleration, machine)
        if device.type == "cpu" and manifest.sources and profile.acceleration.compile != "none":
            sentences += (f"It is meant for GPUs, and {machine.description}.",)
        if sentences:
            return " ".join(sentences)
        if profile.acceleration.keeps_float8 and not has_float8:
            fp8 = profile.acceleration.fp8
            return f"fp8: {fp8} needs a checkpoint stored in float8: name one in COW_CHECKPOINTS."
        return lacking_room(profile, parameters, int(manifest.architecture["num_layers"]), device)

    if problem := lacking(profile_of(manifest, name)):
        able = [other for other in manifest.profiles if not lacking(profile_of(manifest, other))]
        remedy = f"can run: {', '.join(able)} (COW_PROFILE)" if able else "can run none of its profiles"
        pull = "" if parameters else f" Its weights are not all here either: run `cow models pull {manifest.name}`."
        raise GeneratorUnavailable(
            f"'{manifest.name}', profile '{name}': {problem} This machine {remedy}.{pull}",
            remedy="Or use `generator: cutout`, which needs no GPU and no weights.",
        )


def lacking_room(profile: Profile, parameters: Mapping[str, int], blocks: int, device: torch.device) -> str:
    """Which memory the weights do not fit into, in a sentence; empty if they do, or are not here yet."""
    if not parameters:
        return ""
    need = need_of(profile, parameters, blocks)
    room, host = _room(device), os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    limit = CGROUP.read_text().strip() if CGROUP.is_file() else "max"
    host = min(host, int(limit)) if limit.isdecimal() else host
    if device.type == "cpu":  # where both are the same memory
        need = Need(0, max(need.device, need.host))
    if need.device > room:
        return f"Its weights take {need.device / 1e9:.0f} GB of the GPU's memory, which has {room / 1e9:.0f} GB."
    if need.host > host:
        return f"Its weights take {need.host / 1e9:.0f} GB of this machine's memory, which has {host / 1e9:.0f} GB."
    return ""


def _read_headers(folders: Mapping[str, Path], parts: Sequence[str]) -> tuple[dict[str, int], bool]:
    """How many numbers each part has, nothing where one is not here, and whether the transformer has some in float8."""
    counts: dict[str, int] = {}
    has_float8 = False
    with suppress(CheckpointInvalid, OSError, KeyError):  # loading says why
        files = {"transformer": checkpoints.checkpoint_files(folders["transformer"])[1]}
        files |= {part: tuple((folders["base"] / part).glob("*.safetensors")) for part in parts if part not in files}
        for part, some in files.items():
            entries = [each for file in some for each in checkpoints.read_headers([file]).values()]
            has_float8 = has_float8 or any(each.dtype in checkpoints.FLOAT8 for each in entries)
            counts[part] = sum(math.prod(each.shape) for each in entries)
    return counts if len(counts) == len(parts) and all(counts.values()) else {}, has_float8


def _room(device: torch.device) -> int:
    """Bytes that a GPU has in all."""
    return torch.cuda.get_device_properties(device).total_memory if device.type == "cuda" else 0


def wait_until_done(device: torch.device) -> None:
    """Waits for what was given to the device so far: a GPU takes work long before it does it."""
    if device.type == "cuda":
        done = torch.cuda.Event()
        done.record(torch.cuda.current_stream(device))
        done.synchronize()


@contextmanager
def within_memory(device: torch.device, clear_caches: Callable[[], None], what: str) -> Generator[None]:
    """Turns running out of memory into `GeneratorOutOfMemory`, after `clear_caches` and after freeing all tensors.

    A GPU that fails becomes `DeviceFailed`: nothing can be computed on it in this process any more. `what` begins the
    messages: what was being made.
    """
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
    try:
        yield
    except RuntimeError as error:
        if not is_out_of_memory(error):
            if not has_failed(device, error):
                raise
            reason = (str(error).splitlines() or [""])[0][:200]
            raise DeviceFailed(
                f"{what} was not finished: the GPU failed ({reason}). A worker process is replaced, and the job tried "
                "again; without workers (COW_WORKERS=false) restart the server. If it fails repeatedly, look at "
                "`nvidia-smi` and at the Xid messages of the system's log: the GPU may need a reset."
            ) from error
        # The frames of the failed call hold its tensors, and live as long as the traceback does.
        traceback.clear_frames(error.__traceback__)
        remedy = " of this machine. Ask for fewer frames."
        if device.type == "cuda":
            peak = torch.cuda.max_memory_allocated(device) / 1e9
            remedy = (
                f": {peak:.1f} GB were in use at the peak, of {_room(device) / 1e9:.1f} GB. "
                "Ask for fewer frames, or start the server with a profile that offloads or tiles (COW_PROFILE)."
            )
        failure = GeneratorOutOfMemory(f"{what} does not fit into memory{remedy}")
    else:
        return
    clear_caches()
    gc.collect()
    if device.type == "cuda":
        torch.cuda.empty_cache()
    raise failure


def has_failed(device: torch.device, error: RuntimeError) -> bool:
    """Whether the GPU can be used no more after an error of whatever library. Not every error of CUDA is so."""
    if device.type != "cuda":
        return isinstance(error, torch.AcceleratorError)
    try:
        torch.cuda.synchronize(device)
    except RuntimeError:
        return True
    return False
