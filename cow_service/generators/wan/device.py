"""One clip at a time on a device, and memory that runs out as an error that leaves the device usable."""

from __future__ import annotations

import gc
import traceback
from collections.abc import Callable, Generator
from contextlib import contextmanager
from threading import Lock

import torch

from cow_service.errors import GeneratorOutOfMemory, GeneratorUnavailable

# What the CPU's allocator, the CUDA runtime, cuBLAS and cuDNN say, all in plain runtime errors.
OUT_OF_MEMORY = ("can't allocate memory", "CUDA error: out of memory", "_STATUS_ALLOC_FAILED")
WAIT = 0.2  # seconds between looks at whether the one who waits still wants it

_locks: dict[str, Lock] = {}
_locks_lock = Lock()


def choose_device(name: str) -> torch.device:
    """`auto` is the first GPU, else the CPU. Raises `GeneratorUnavailable` for a GPU that is not here."""
    if name == "auto":
        return torch.device("cuda:0" if torch.cuda.is_available() else "cpu")
    device = torch.device("cuda:0" if name == "cuda" else name)
    if device.type == "cuda" and (device.index or 0) >= torch.cuda.device_count():
        raise GeneratorUnavailable(
            f"There is no GPU '{name}': PyTorch {torch.__version__} sees {torch.cuda.device_count()}. Set COW_DEVICE."
        )
    return device


@contextmanager
def alone_on(device: torch.device, still_wanted: Callable[[], None]) -> Generator[None]:
    """Holds the device for one clip. While another has it, `still_wanted` is called, and may raise to give up."""
    with _locks_lock:
        lock = _locks.setdefault(str(device), Lock())
    while not lock.acquire(timeout=WAIT):
        still_wanted()
    try:
        yield
    finally:
        lock.release()


@contextmanager
def on_threads(count: int | None) -> Generator[None]:
    """Computes on that many CPU threads; null leaves PyTorch's own number.

    Small operations gain nothing from a second thread, and lose much where the cores are busy.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(count or before)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@contextmanager
def within_memory(device: torch.device, forget: Callable[[], None], what: str) -> Generator[None]:
    """Turns running out of memory into `GeneratorOutOfMemory`, after `forget` has let go of what was kept.

    `what` says what was being made. The tensors that the failed frames held are freed before the error is raised.
    """
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
    try:
        yield
    except RuntimeError as error:
        if not _is_out_of_memory(error):
            raise
        # The failed call's frames hold its tensors, and live as long as the traceback does.
        traceback.clear_frames(error.__traceback__)
        failure = GeneratorOutOfMemory(f"{what} does not fit into memory{_memory(device)}. {_remedy(device)}")
    else:
        return
    forget()
    gc.collect()
    if device.type == "cuda":
        torch.cuda.empty_cache()
    raise failure


def _is_out_of_memory(error: RuntimeError) -> bool:
    return isinstance(error, torch.OutOfMemoryError) or any(words in str(error) for words in OUT_OF_MEMORY)


def _memory(device: torch.device) -> str:
    if device.type != "cuda":
        return " of this machine"
    peak = torch.cuda.max_memory_allocated(device) / 1e9
    total = torch.cuda.get_device_properties(device).total_memory / 1e9
    return f": {peak:.1f} GB were in use at the peak, of {total:.1f} GB"


def _remedy(device: torch.device) -> str:
    if device.type != "cuda":
        return "Ask for fewer frames."
    return "Ask for fewer frames, or start the server with a profile that offloads or tiles (COW_PROFILE)."
