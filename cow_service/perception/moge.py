"""MoGe-2 (Wang et al., 2025, arXiv:2507.02546): a metric point map from one image.

The modules have the names and shapes of the public code (github.com/microsoft/MoGe, MIT), so that a checkpoint fits key
by key. What it has for normals is not read. The network's points are those of the scene but for a shift along the
optical axis, which is recovered with the focal length from where each point is seen.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from cow_service.media.types import Floats, Mask
from cow_service.perception.loading import check_keys

PATCH = 14  # px
BACKBONES = {"dinov2_vits14": (384, 12, 6), "dinov2_vitb14": (768, 12, 12), "dinov2_vitl14": (1024, 24, 16)}
"""Width, blocks and heads of the DINOv2 encoders."""
UNUSED = ("normal_head.", "encoder.image_mean", "encoder.image_std", "encoder.backbone.mask_token")
SIDE = 64  # points along a side of the map from which shift and focal length are recovered
DECADES = 3.0  # of the nearest point's distance over the width of the scene, either way, among which it is sought


class Attention(nn.Module):
    """Of all tokens [B, N, C] to each other."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.qkv = nn.Linear(width, 3 * width)
        self.proj = nn.Linear(width, width)

    def forward(self, tokens: Tensor) -> Tensor:
        """[B, N, C]."""
        query, key, value = self.qkv(tokens).unflatten(-1, (3, self.heads, -1)).permute(2, 0, 3, 1, 4)
        return self.proj(functional.scaled_dot_product_attention(query, key, value).transpose(1, 2).flatten(2))


class Block(nn.Module):
    """One layer of DINOv2's transformer."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.norm1, self.norm2 = (nn.LayerNorm(width, eps=1e-6) for _ in range(2))
        self.attn = Attention(width, heads)
        self.ls1, self.ls2 = (nn.ParameterDict({"gamma": nn.Parameter(torch.ones(width))}) for _ in range(2))
        self.mlp = nn.ModuleDict({"fc1": nn.Linear(width, 4 * width), "fc2": nn.Linear(4 * width, width)})

    def forward(self, tokens: Tensor) -> Tensor:
        """[B, N, C]."""
        tokens = tokens + self.ls1["gamma"] * self.attn(self.norm1(tokens))
        return tokens + self.ls2["gamma"] * self.mlp["fc2"](functional.gelu(self.mlp["fc1"](self.norm2(tokens))))


class Dinov2(nn.Module):
    """The vision transformer; its input is [B, 3, 14 * rows, 14 * columns]."""

    def __init__(self, width: int, blocks: int, heads: int, grid: int = 37) -> None:
        super().__init__()
        self.grid = grid  # patches along a side of the images that it was trained on
        self.cls_token = nn.Parameter(torch.zeros(1, 1, width))
        self.pos_embed = nn.Parameter(torch.zeros(1, 1 + grid**2, width))
        self.patch_embed = nn.ModuleDict({"proj": nn.Conv2d(3, width, PATCH, PATCH)})
        self.blocks = nn.ModuleList(Block(width, heads) for _ in range(blocks))
        self.norm = nn.LayerNorm(width, eps=1e-6)

    def forward(self, pixels: Tensor, layers: Sequence[int]) -> list[Tensor]:
        """Normalised tokens [B, 1 + rows * columns, C] after each of the layers."""
        patches = self.patch_embed["proj"](pixels)
        rows, columns = patches.shape[-2:]
        places = self.pos_embed[:, 1:].float().unflatten(1, (self.grid, self.grid)).permute(0, 3, 1, 2)
        if (rows, columns) != (self.grid, self.grid):
            # The tenth of a patch is DINOv2's own, and decides where exactly it samples.
            scale = ((rows + 0.1) / self.grid, (columns + 0.1) / self.grid)
            places = functional.interpolate(places, scale_factor=scale, mode="bicubic")
        tokens = (patches + places).flatten(2).transpose(1, 2)
        tokens = torch.cat((self.cls_token + self.pos_embed[:, :1], tokens), dim=1)
        found: list[Tensor] = []
        for index, block in enumerate(self.blocks):
            tokens = block(tokens)
            if index in layers:
                found.append(self.norm(tokens))
        return found


class Encoder(nn.Module):
    """DINOv2, and the sum of what some of its layers found."""

    def __init__(self, backbone: str, intermediate_layers: int | Sequence[int], dim_out: int, **_: Any) -> None:
        super().__init__()
        width, blocks, heads = BACKBONES[backbone]
        self.backbone = Dinov2(width, blocks, heads)
        last = intermediate_layers
        self.layers = range(blocks - last, blocks) if isinstance(last, int) else tuple(last)
        self.output_projections = nn.ModuleList(nn.Conv2d(width, dim_out, 1) for _ in self.layers)

    def forward(self, pixels: Tensor) -> tuple[Tensor, Tensor]:
        """Features [B, C, rows, columns] and the class token [B, C] of the last layer."""
        found = self.backbone(pixels, self.layers)
        grid = pixels.shape[-2] // PATCH, pixels.shape[-1] // PATCH
        maps = [tokens[:, 1:].transpose(1, 2).unflatten(2, grid) for tokens in found]
        projected = [project(each) for project, each in zip(self.output_projections, maps, strict=True)]
        return torch.stack(projected).sum(dim=0), found[-1][:, 0]


def _conv(channels: int, out: int) -> nn.Conv2d:
    return nn.Conv2d(channels, out, 3, padding=1, padding_mode="replicate")


def _resampler(kind: str, channels: int, out: int) -> nn.Sequential:
    """Doubles the size."""
    if kind == "conv_transpose":
        return nn.Sequential(nn.ConvTranspose2d(channels, out, 2, 2), _conv(out, out))
    if kind == "pixel_shuffle":
        return nn.Sequential(_conv(channels, 4 * out), nn.PixelShuffle(2), _conv(out, out))
    corners = {"bilinear": False, "nearest": None}[kind]
    return nn.Sequential(nn.Upsample(scale_factor=2, mode=kind, align_corners=corners), _conv(channels, out))


def _norm(kind: str, channels: int) -> nn.Module:
    groups = {"none": 0, "layer_norm": 1, "group_norm": channels // 32}[kind]
    return nn.GroupNorm(groups, channels) if groups else nn.Identity()


class ResidualBlock(nn.Module):
    """Two convolutions beside the identity."""

    def __init__(self, channels: int, hidden: int, norms: tuple[str, str]) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            *(_norm(norms[0], channels), nn.ReLU(), _conv(channels, hidden)),
            *(_norm(norms[1], hidden), nn.ReLU(), _conv(hidden, channels)),
        )

    def forward(self, features: Tensor) -> Tensor:
        """[B, C, h, w]."""
        return features + self.layers(features)


class ConvStack(nn.Module):
    """Levels of features, each twice as large as the one before and joined to what comes from it: neck and heads."""

    def __init__(
        self,
        dim_in: Sequence[int],
        dim_res_blocks: Sequence[int],
        dim_out: Sequence[int | None] | None,
        resamplers: str | Sequence[str],
        num_res_blocks: int | Sequence[int] = 1,
        dim_times_res_block_hidden: int = 1,
        res_block_in_norm: str = "layer_norm",
        res_block_hidden_norm: str = "group_norm",
    ) -> None:
        super().__init__()
        widths, norms = list(dim_res_blocks), (res_block_in_norm, res_block_hidden_norm)
        kinds = [resamplers] * (len(widths) - 1) if isinstance(resamplers, str) else resamplers
        counts = [num_res_blocks] * len(widths) if isinstance(num_res_blocks, int) else num_res_blocks
        outs = dim_out or [None] * len(widths)
        self.input_blocks = nn.ModuleList(nn.Conv2d(each, w, 1) for each, w in zip(dim_in, widths, strict=True))
        self.resamplers = nn.ModuleList(map(_resampler, kinds, widths[:-1], widths[1:]))
        self.res_blocks = nn.ModuleList(
            nn.Sequential(*(ResidualBlock(w, dim_times_res_block_hidden * w, norms) for _ in range(count)))
            for w, count in zip(widths, counts, strict=True)
        )
        self.output_blocks = nn.ModuleList(
            nn.Identity() if out is None else nn.Conv2d(w, out, 1) for w, out in zip(widths, outs, strict=True)
        )

    def forward(self, features: Sequence[Tensor]) -> list[Tensor]:
        """Of each level."""
        found: list[Tensor] = []
        level: Tensor | None = None
        for index, (enter, refine, leave) in enumerate(
            zip(self.input_blocks, self.res_blocks, self.output_blocks, strict=True)
        ):
            entered = enter(features[index])
            level = refine(entered if level is None else entered + self.resamplers[index - 1](level))
            found.append(leave(level))
        return found


class Moge(nn.Module):
    """The network, made from the configuration that stands in its checkpoint."""

    def __init__(
        self,
        encoder: dict[str, Any],
        neck: dict[str, Any],
        points_head: dict[str, Any],
        mask_head: dict[str, Any],
        scale_head: dict[str, Any],
        remap_output: str,
        num_tokens_range: Sequence[int],
        **_: Any,
    ) -> None:
        super().__init__()
        if remap_output != "exp":
            raise ValueError(f"remap_output {remap_output!r} is not that of the published MoGe-2 models, 'exp'")
        self.encoder = Encoder(**encoder)
        self.neck = ConvStack(**neck)
        self.points_head, self.mask_head = ConvStack(**points_head), ConvStack(**mask_head)
        dims: Sequence[int] = scale_head["dims"]
        layers = [each for pair in pairwise(dims) for each in (nn.Linear(*pair), nn.ReLU())]
        self.scale_head = nn.Sequential(*layers[:-1])
        self.fewest, self.most = num_tokens_range  # patches of an image in training

    def grid(self, tokens: int, aspect: float) -> tuple[int, int]:
        """Columns and rows of about so many patches, of an image of an aspect ratio (width / height)."""
        tokens = min(max(tokens, self.fewest), self.most)
        return max(1, round(math.sqrt(tokens * aspect))), max(1, round(math.sqrt(tokens / aspect)))

    def forward(self, pixels: Tensor, aspect: float) -> tuple[Tensor, Tensor, Tensor]:
        """Points [h, w, 3] up to a shift along z, how sure they are [h, w] (0..1), and metres per unit.

        `pixels` [1, 3, 14 * rows, 14 * columns] is the whole image, normalised; the map has 16 times as many points
        each way as there are patches. x is to the right, y down, z away from the camera.
        """
        features, token = self.encoder(pixels)
        rows, columns = features.shape[-2:]
        levels: list[Tensor] = []
        for index in range(len(self.neck.input_blocks)):
            u, v = viewing_plane(columns * 2**index, rows * 2**index, aspect)
            plane = torch.tensor(np.stack(np.meshgrid(u, v)), dtype=torch.float32, device=pixels.device)[None]
            levels.append(torch.cat((features, plane), dim=1) if index == 0 else plane)
        levels = self.neck(levels)
        raw = self.points_head(levels)[-1][0].float().permute(1, 2, 0)
        z = raw[..., 2:].exp()
        sure = self.mask_head(levels)[-1][0, 0].float().sigmoid()
        return torch.cat((raw[..., :2] * z, z), dim=-1), sure, self.scale_head(token)[0, 0].float().exp()


def load_moge(name: str, folder: Path) -> Moge:
    """The network of `model.pt`, a pickle with the keys `model_config` and `model`.

    It is read with `weights_only`: tensors and plain values, and nothing that could run code. (That holds from PyTorch
    2.6 on; the extra `perception` takes 2.8.) Raises `PerceptionUnavailable` naming keys that are missing or unknown.
    """
    checkpoint = torch.load(folder / "model.pt", map_location="cpu", weights_only=True)
    with torch.device("meta"):
        network = Moge(**checkpoint["model_config"])
    weights = {key: value for key, value in checkpoint["model"].items() if not key.startswith(UNUSED)}
    misfits = network.load_state_dict(weights, strict=False, assign=True)
    check_keys(name, misfits.missing_keys, misfits.unexpected_keys)
    return network


def viewing_plane(columns: int, rows: int, aspect: float) -> tuple[Floats, Floats]:
    """x [columns] and y [rows] of the middles of pixels, in halves of the image's diagonal from its middle."""
    across, down = aspect / math.hypot(aspect, 1), 1 / math.hypot(aspect, 1)
    x, y = (2 * np.arange(count) + 1.0 for count in (columns, rows))
    return across * (x / columns - 1), down * (y / rows - 1)


def recover_camera(points: Floats, known: Mask, aspect: float, focal: float | None = None) -> tuple[float, float]:
    """Focal length (in halves of the image's diagonal) and shift of z by which points are seen where they are.

    `points` [h, w, 3] where `known` [h, w], which at least two are, of a whole image of that aspect ratio. Minimises
    the sum of squares of f * xy / (z + shift) - uv, in which f has a closed form for each shift; `focal` is f where
    that is known.
    """
    rows, columns = (np.linspace(0, n - 1, min(n, SIDE)).round().astype(int) for n in known.shape)
    seen = known[np.ix_(rows, columns)]
    if np.count_nonzero(seen) < 2:
        rows, columns = (np.arange(n) for n in known.shape)
        seen = known
    u, v = viewing_plane(known.shape[1], known.shape[0], aspect)
    uv = np.stack(np.meshgrid(u[columns], v[rows]), axis=-1)[seen]  # [N, 2]
    xy, z = np.split(points[np.ix_(rows, columns)][seen], [2], axis=1)
    nearest, wide = float(z.min()), float(np.hypot(*xy.T).max())
    distances = np.log(wide) + np.linspace(-DECADES, DECADES, 121) * np.log(10)  # of the nearest point, logarithms
    as_predicted = np.clip(np.log(max(nearest, 1e-9)), distances[0], distances[-1])

    def fit(distance: float) -> tuple[float, float]:
        """The focal length for a distance of the nearest point, and how bad it is: 0 to 1 where f is free."""
        g = xy / (z - nearest + np.exp(distance))
        along, square = float((g * uv).sum()), float((g * g).sum())
        f = max(along, 1e-9) / square if focal is None else focal
        # A scene of one depth fits any shift: then the predicted depth stays.
        return f, float(np.square(f * g - uv).sum() / np.square(uv).sum()) + 1e-6 * (distance - as_predicted) ** 2

    best = 0.0
    for _ in range(3):  # each 20 times as fine as the one before
        best = float(min(distances, key=lambda each: fit(float(each))[1]))
        step = distances[1] - distances[0]
        distances = np.linspace(best - step, best + step, 41)
    return fit(best)[0], float(np.exp(best)) - nearest
