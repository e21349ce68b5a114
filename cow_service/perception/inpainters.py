"""The inpainter `lama`: a network that paints a hole from what lies around it and from the whole picture's frequencies.

Suvorov et al., "Resolution-robust Large Mask Inpainting with Fourier Convolutions", WACV 2022. Modules have the names
of the published weights (github.com/advimman/lama). Those are a pickle with objects of its trainer, which is never
opened here; the manifest names a copy of its generator as safetensors.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import torch
from safetensors.torch import load_file
from torch import Tensor, nn

from cow_service.media.masks import scaled_size, window_of
from cow_service.media.types import Image, Mask
from cow_service.perception.loading import LoadedModel, check_keys, load
from cow_service.settings import Settings
from cow_service.weights.manifests import load_manifests

CONTEXT, LEAST_CONTEXT = 1.0, 96  # of the hole's longer side, and px: so far around it the network sees
MOST_SIDE = 1024  # px: larger crops are painted smaller; what is painted at more gets blotchy
MULTIPLE, LEAST_SIDE = 8, 16  # px: three halvings, and what mirrored padding needs after them
PREFIX = "generator."  # of the names in checkpoints that hold more than the generator

Pair = tuple[Tensor, Tensor | None]
"""Local and global channels [N, C, H, W]; the first layers have none of the latter."""


class Fourier(nn.Module):
    """A 1x1 convolution of the real and imaginary parts of a picture's frequencies."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.conv_layer = nn.Conv2d(2 * channels, 2 * channels, 1, bias=False)
        self.bn = nn.BatchNorm2d(2 * channels)

    def forward(self, x: Tensor) -> Tensor:
        """[N, C, H, W] to the same."""
        waves = torch.fft.rfftn(x, dim=(-2, -1), norm="ortho")
        # Each channel's real part is followed by its imaginary part.
        parts = torch.stack((waves.real, waves.imag), 2).flatten(1, 2)
        parts = self.bn(self.conv_layer(parts)).relu().unflatten(1, (-1, 2))
        waves = torch.complex(parts[:, :, 0].contiguous(), parts[:, :, 1].contiguous())
        return torch.fft.irfftn(waves, s=x.shape[-2:], dim=(-2, -1), norm="ortho")


class Spectral(nn.Module):
    """Global channels from global ones."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        half = channels // 2
        self.conv1 = nn.Sequential(nn.Conv2d(channels, half, 1, bias=False), nn.BatchNorm2d(half), nn.ReLU())
        self.fu = Fourier(half)
        self.conv2 = nn.Conv2d(half, channels, 1, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        """[N, C, H, W] to the same."""
        x = self.conv1(x)
        return self.conv2(x + self.fu(x))


class FastFourierConvolution(nn.Module):
    """Convolutions between local and global channels, as many as there are of either before and after."""

    def __init__(self, before: tuple[int, int], after: tuple[int, int], kernel: int, stride: int, padding: int) -> None:
        super().__init__()
        names = ("l", "g")
        for i, inputs in enumerate(before):
            for o, outputs in enumerate(after):
                if inputs and outputs:
                    conv = nn.Conv2d(inputs, outputs, kernel, stride, padding, bias=False, padding_mode="reflect")
                    self.add_module(f"conv{names[i]}2{names[o]}", Spectral(inputs) if i and o else conv)

    def forward(self, x: Pair) -> Pair:
        """Sums what comes from local and from global channels."""
        sums: dict[str, Tensor] = {}
        for place, source in enumerate(("l", "g")):
            for name in ("l", "g"):
                part, key = x[place], f"conv{source}2{name}"
                if part is not None and hasattr(self, key):
                    found = self.get_submodule(key)(part)
                    sums[name] = sums[name] + found if name in sums else found
        return sums["l"], sums.get("g")


class Layer(nn.Module):
    """A convolution with its normalisation."""

    def __init__(
        self, before: tuple[int, int], after: tuple[int, int], kernel: int = 3, stride: int = 1, padding: int = 1
    ) -> None:
        super().__init__()
        self.ffc = FastFourierConvolution(before, after, kernel, stride, padding)
        self.bn_l = nn.BatchNorm2d(after[0])
        self.bn_g = nn.BatchNorm2d(after[1]) if after[1] else nn.Identity()

    def forward(self, x: Pair) -> Pair:
        """Channels `before` to `after`."""
        local, overall = self.ffc(x)
        return self.bn_l(local).relu(), None if overall is None else self.bn_g(overall).relu()


class Block(nn.Module):
    """Two layers, whose result is added to what goes in."""

    def __init__(self, channels: tuple[int, int]) -> None:
        super().__init__()
        self.conv1, self.conv2 = Layer(channels, channels), Layer(channels, channels)

    def forward(self, x: Pair) -> Pair:
        """The same channels."""
        local, overall = self.conv2(self.conv1(x))
        assert overall is not None
        assert x[1] is not None
        return x[0] + local, x[1] + overall


class Lama(nn.Module):
    """The generator: three halvings, residual blocks, three doublings."""

    def __init__(self, width: int, blocks: int, overall: float) -> None:
        """`width` channels at full size, and the share of `overall` (global) ones at the smallest size."""
        super().__init__()
        deep = 8 * width
        inner = (deep - int(deep * overall), int(deep * overall))
        down = [
            Layer((4, 0), (width, 0), kernel=7, padding=0),
            *(Layer((width * 2**i, 0), (width * 2 ** (i + 1), 0), stride=2) for i in range(2)),
            Layer((4 * width, 0), inner, stride=2),
        ]
        up: list[nn.Module] = []
        for size in (deep, deep // 2, deep // 4):
            up += [nn.ConvTranspose2d(size, size // 2, 3, 2, 1, output_padding=1), nn.BatchNorm2d(size // 2), nn.ReLU()]
        last = [nn.ReflectionPad2d(3), nn.Conv2d(width, 3, 7), nn.Sigmoid()]
        # The place of each is part of the weights' names; the joining of both kinds of channels has one, too.
        self.join = 1 + len(down) + blocks
        paired = [*down, *(Block(inner) for _ in range(blocks))]
        self.model = nn.ModuleList([nn.ReflectionPad2d(3), *paired, nn.Identity(), *up, *last])

    def forward(self, x: Tensor, progress: Callable[[float], None]) -> Tensor:
        """Colours [N, 3, H, W], 0 to 1, of colours without the hole and the hole [N, 4, H, W]."""
        x = self.model[0](x)
        pair: Pair = x, None
        for place, layer in enumerate(self.model[1:], start=1):
            progress(place / len(self.model))
            if place < self.join:
                pair = layer(pair)
            elif place == self.join:
                x = torch.cat([part for part in pair if part is not None], 1)
            else:
                x = layer(x)
        return x


class LamaInpainter:
    """See `Inpainter`."""

    def __init__(self, model: LoadedModel) -> None:
        self._model, self.fingerprint = model, model.fingerprint

    def fill(self, image: Image, hole: Mask, progress: Callable[[float], None]) -> Image:
        """See `Inpainter`. Raises `PerceptionUnavailable` if memory runs out."""
        tight = window_of(hole)
        if tight is None:
            return image
        side = max(each.stop - each.start for each in tight)
        crop = window_of(hole, max(LEAST_CONTEXT, round(CONTEXT * side))) or tight
        inside, seen = hole[crop], image[crop]
        height, width = inside.shape
        scale = min(1.0, MOST_SIDE / max(width, height))
        if scale < 1:
            size = scaled_size(width, height, scale)
            seen = cv2.resize(seen, size, interpolation=cv2.INTER_AREA)
            inside = cv2.resize(inside.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0
        rows, columns = inside.shape
        more = [(0, max(LEAST_SIDE, -(-length // MULTIPLE) * MULTIPLE) - length) for length in (rows, columns)]
        colours = torch.from_numpy(np.pad(seen, [*more, (0, 0)], mode="symmetric")).permute(2, 0, 1)
        gone = torch.from_numpy(np.pad(inside, more, mode="symmetric"))[None]
        with self._model.computing(is_precise=True) as network:
            given = torch.cat((colours / 255 * ~gone, gone)).to(self._model.device, torch.float32)
            found = network(given[None], progress)[0, :, :rows, :columns]
            painted = (found * 255).round().clamp(0, 255).to(torch.uint8).permute(1, 2, 0).cpu().numpy()
        if scale < 1:
            painted = cv2.resize(painted, (width, height), interpolation=cv2.INTER_CUBIC)
        result = image.copy()
        result[crop] = np.where(hole[crop][..., None], painted, image[crop])
        return result


def create_lama(settings: Settings) -> LamaInpainter:
    """Factory for the registry. Raises `PerceptionUnavailable`."""
    return LamaInpainter(load("lama", settings, _build))


def _build(folder: Path) -> Lama:
    manifest = load_manifests()["lama"]
    sizes, file = manifest.architecture, manifest.sources["weights"].files[0]
    with torch.device("meta"):  # weights take their places below
        model = Lama(int(sizes["ngf"]), int(sizes["n_blocks"]), float(sizes["ratio_gin"]))
    weights = {name.removeprefix(PREFIX): tensor for name, tensor in load_file(folder / file).items()}
    wanted = model.state_dict()
    check_keys("lama", [name for name in wanted if name not in weights], [n for n in weights if n not in wanted])
    model.load_state_dict(weights, assign=True)
    return model
