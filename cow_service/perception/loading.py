"""What all vision models have in common: finding their weights, loading them, running them, translating errors."""

from __future__ import annotations

import traceback
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from threading import Lock
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from cow_service.errors import CowError, PerceptionUnavailable, WeightsUnavailable, listed
from cow_service.media.types import Image
from cow_service.settings import Settings
from cow_service.weights.device import BUILD_LOCK, choose_device, is_out_of_memory, reason_of
from cow_service.weights.manifests import Manifest, find_manifest
from cow_service.weights.repositories import verify, weights_identity

MEAN, STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # of ImageNet, on which all of these were trained


@dataclass(eq=False)
class LoadedModel:
    """A network on its device. It computes for one caller at a time: two would need the memory twice."""

    manifest: Manifest
    folder: Path
    network: Any
    device: torch.device
    fingerprint: str
    half: torch.dtype | None = None  # precision that it may use on a GPU; None: float32 only
    _lock: Lock = field(default_factory=Lock)

    @contextmanager
    def computing(self, *, is_precise: bool = False) -> Generator[Any]:
        """The network, without gradients; in float32 where it is to be precise.

        Raises `PerceptionUnavailable` for whatever it raises.
        """
        is_half = self.half is not None and self.device.type == "cuda" and not is_precise
        with (
            self._lock,
            translated(self.manifest.name, "cannot compute", self.device),
            torch.inference_mode(),
            torch.autocast(self.device.type, self.half or torch.bfloat16, enabled=is_half),
        ):
            yield self.network

    def pixels(self, image: Image, size: tuple[int, int], mode: str = "bilinear") -> Tensor:
        """An image at a size (width, height), normalised: [1, 3, height, width], float32.

        transformers' own image processors would do the same, but need torchvision.
        """
        values = torch.tensor(image, device=self.device).permute(2, 0, 1)[None].float() / 255
        values = functional.interpolate(values, size[::-1], mode=mode, antialias=True, align_corners=False).clamp(0, 1)
        mean, std = (torch.tensor(each, device=self.device).view(3, 1, 1) for each in (MEAN, STD))
        return (values - mean) / std


def load(
    name: str, settings: Settings, build: Callable[[Path], nn.Module], half: torch.dtype | None = None
) -> LoadedModel:
    """The model of a manifest, made by `build` from the folder that was pulled, or that COW_CHECKPOINTS names.

    Raises `PerceptionUnavailable`: weights are missing or do not fit, memory runs out, there is no such device.
    """
    manifest = find_manifest(name)
    assert manifest is not None, "the built-in models have manifests"
    device = choose_device(settings.device, PerceptionUnavailable)
    try:
        folder = settings.checkpoints.get(name) or verify(manifest.sources["weights"], settings.weights_dir, name)
        identity = weights_identity(manifest, settings)  # before loading: files that change later are not those loaded
    except WeightsUnavailable as error:
        raise PerceptionUnavailable(error.detail) from error
    with BUILD_LOCK, translated(name, "cannot be loaded", device):
        network = build(folder).float().eval().requires_grad_(False).to(device)
    options = [f"{option}={value}" for option, value in sorted(manifest.defaults.items())]
    precision = str(half if half is not None and device.type == "cuda" else torch.float32)
    return LoadedModel(manifest, folder, network, device, " ".join([name, identity[:16], precision, *options]), half)


def load_pretrained(kind: Any, name: str, folder: Path) -> nn.Module:
    """A model of transformers in float32. Opens safetensors only. Raises `PerceptionUnavailable`, as `check_keys`."""
    network, found = kind.from_pretrained(
        folder, dtype=torch.float32, use_safetensors=True, local_files_only=True, output_loading_info=True
    )
    check_keys(name, sorted(found["missing_keys"]), sorted(found["unexpected_keys"]))
    return network


def check_keys(name: str, missing: Sequence[str], unknown: Sequence[str]) -> None:
    """Raises `PerceptionUnavailable` with the first keys that a checkpoint lacks, or that its model does not know.

    transformers only warns of them, and fills what is missing with random numbers.
    """
    for keys, what in ((missing, "lack"), (unknown, "have, beyond its model,")):
        if keys:
            raise PerceptionUnavailable(
                f"The weights of '{name}' {what} {listed(keys)}. Run `cow models pull {name}`, or name a checkpoint of "
                f"this model in COW_CHECKPOINTS."
            )


@contextmanager
def translated(name: str, failing: str, device: torch.device) -> Generator[None]:
    """Whatever transformers, safetensors or PyTorch raise becomes `PerceptionUnavailable`, without names of folders."""
    try:
        yield
    except CowError:
        raise
    except Exception as error:
        # The failed frames hold their tensors, and live as long as the traceback does.
        traceback.clear_frames(error.__traceback__)
        if is_out_of_memory(error):
            if device.type == "cuda":
                torch.cuda.empty_cache()
            raise PerceptionUnavailable(
                f"'{name}' ran out of memory on {device}. Set COW_PERCEPTION to smaller models, such as cpu, or "
                f"COW_DEVICE to a device with more."
            ) from error
        raise PerceptionUnavailable(f"'{name}' {failing}: {reason_of(error)}") from error
