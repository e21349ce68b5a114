"""Fetches the attention kernels that a profile names, so that a start finds them."""

from collections.abc import Iterable

import torch
from diffusers.models.attention_dispatch import attention_backend

from cow_service.generators.wan.profiles import Acceleration


def fetch_kernels(wanted: Iterable[Acceleration], device: torch.device) -> dict[str, str | None]:
    """Downloads the hub's kernels of such options, for a GPU; by backend, why one could not be fetched."""
    fetched: dict[str, str | None] = {}
    for name in dict.fromkeys(each.attention for each in wanted if device.type == "cuda"):
        if name.endswith("_hub"):
            try:
                with attention_backend(name):
                    fetched[name] = None
            except Exception as problem:  # noqa: BLE001 - of the hub, of the package kernels, or of the kernel's own code
                fetched[name] = f"{type(problem).__name__}: {(str(problem).splitlines() or [''])[0]}"
    return fetched
