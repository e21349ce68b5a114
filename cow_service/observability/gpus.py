"""Memory of the GPUs that this process uses."""

from __future__ import annotations

import sys

from cow_service.records import GpuMemory


def gpu_memory() -> tuple[GpuMemory, ...]:
    """Of each GPU, where this process already uses them: asking starts neither PyTorch nor CUDA."""
    cuda = getattr(sys.modules.get("torch"), "cuda", None)
    if cuda is None or not cuda.is_available() or not cuda.is_initialized():
        return ()
    return tuple(
        GpuMemory(
            device=f"cuda:{index}",
            allocated_mb=cuda.memory_allocated(index) / 1e6,
            reserved_mb=cuda.memory_reserved(index) / 1e6,
            total_mb=cuda.get_device_properties(index).total_memory / 1e6,
        )
        for index in range(cuda.device_count())
    )
