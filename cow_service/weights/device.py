"""Where weights run: the device that COW_DEVICE names, its CPU threads, and how PyTorch says that memory ran out."""

import re
from collections.abc import Generator
from contextlib import contextmanager
from threading import Lock

import torch

from cow_service.errors import CowError

CUDA_ERROR_MEMORY_ALLOCATION = 2  # cudaErrorMemoryAllocation, the CUDA runtime's error code
# PyTorch has no type or code for these: its CPU allocator, and cuBLAS and cuDNN, raise plain runtime errors.
OUT_OF_MEMORY_TEXTS = ("can't allocate memory", "_STATUS_ALLOC_FAILED")


def choose_device(name: str, unavailable: type[CowError]) -> torch.device:
    """`auto` is the first GPU, else the CPU. Raises `unavailable` for a GPU that does not exist."""
    if name == "auto":
        return torch.device("cuda:0" if torch.cuda.is_available() else "cpu")
    device = torch.device("cuda:0" if name == "cuda" else name)
    if device.type == "cuda" and (device.index or 0) >= torch.cuda.device_count():
        raise unavailable(
            f"There is no GPU '{name}': PyTorch {torch.__version__} sees {torch.cuda.device_count()}. Set COW_DEVICE."
        )
    return device


@contextmanager
def cpu_threads(count: int | None) -> Generator[None]:
    """Computes on that many CPU threads; None keeps PyTorch's own number.

    Small operations gain nothing from a second thread, and lose much where the cores are busy.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(count or before)
    try:
        yield
    finally:
        torch.set_num_threads(before)  # part of it is global to the process


def is_out_of_memory(error: BaseException) -> bool:
    """Whether an exception of PyTorch says that memory ran out, of the CPU or of a GPU."""
    if isinstance(error, torch.OutOfMemoryError):
        return True
    if getattr(error, "error_code", None) == CUDA_ERROR_MEMORY_ALLOCATION:  # torch.AcceleratorError
        return True
    return isinstance(error, RuntimeError) and any(text in str(error) for text in OUT_OF_MEMORY_TEXTS)


# Seeds, and what libraries patch while they initialise, are global to the process: two models built at once, be they of
# a reader and of a generator, would mix up their weights.
BUILD_LOCK = Lock()


def reason_of(error: Exception) -> str:
    """The kind of a foreign exception and how its text begins, without the folders that it names; for messages."""
    line = re.sub(r"(?<!\w)(/[\w.+-]+)+/?", "…", " ".join(str(error).split()))[:300]
    return f"{type(error).__name__}: {line}"
