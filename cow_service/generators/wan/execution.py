"""Exclusive use of a device, one clip at a time, and running out of its memory as an error that leaves it usable."""

from __future__ import annotations

import gc
import traceback
from collections import defaultdict
from collections.abc import Callable, Generator
from contextlib import contextmanager
from threading import Lock

import torch

from cow_service.errors import DeviceFailed, GeneratorOutOfMemory
from cow_service.weights.device import is_out_of_memory

CANCEL_POLL_SECONDS = 0.2  # how often a caller that waits for the device checks whether it was canceled

_locks: defaultdict[str, Lock] = defaultdict(Lock)
_locks_guard = Lock()


@contextmanager
def exclusive_use(device: torch.device, check_canceled: Callable[[], None]) -> Generator[None]:
    """Holds the device for one clip. While another clip has it, `check_canceled` is called, and may raise."""
    with _locks_guard:
        lock = _locks[str(device)]
    while not lock.acquire(timeout=CANCEL_POLL_SECONDS):
        check_canceled()
    try:
        yield
    finally:
        lock.release()


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
            if has_failed(device, error):
                raise _failed(what, error) from error
            raise
        # The frames of the failed call hold its tensors, and live as long as the traceback does.
        traceback.clear_frames(error.__traceback__)
        failure = GeneratorOutOfMemory(f"{what} does not fit into memory{_usage_and_remedy(device)}")
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


def _failed(what: str, error: RuntimeError) -> DeviceFailed:
    reason = (str(error).splitlines() or [""])[0][:200]
    return DeviceFailed(
        f"{what} was not finished: the GPU failed ({reason}). A worker process is replaced, and the job tried "
        "again; without workers (COW_WORKERS=false) restart the server. If it fails again and again, look at "
        "`nvidia-smi` and at the Xid messages of the system's log: the GPU may need a reset."
    )


def _usage_and_remedy(device: torch.device) -> str:
    if device.type != "cuda":
        return " of this machine. Ask for fewer frames."
    peak = torch.cuda.max_memory_allocated(device) / 1e9
    total = torch.cuda.get_device_properties(device).total_memory / 1e9
    return (
        f": {peak:.1f} GB were in use at the peak, of {total:.1f} GB. "
        "Ask for fewer frames, or start the server with a profile that offloads or tiles (COW_PROFILE)."
    )
