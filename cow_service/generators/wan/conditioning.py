"""ATI and Wan-Move: how tracks change the condition of Wan2.1's image-to-video model.

The condition [20, T, h, w] is 4 mask channels, then 16 latent channels. Both methods copy features of the image's own
latent frame along the tracks; latent frame 0 is not changed. Any device and dtype; computed in float32.
Shapes: T latent frames of h x w cells, N tracks, and F = 4 (T - 1) + 1 clip frames.

Sources: the public implementations of ATI (arXiv 2505.22944) and Wan-Move (arXiv 2512.08765).
"""

from collections.abc import Callable
from typing import TypeAlias

import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from cow_service.generators.wan.tracks import STRIDE, Tracks, to_ati_file, to_ati_tensor

MASK_CHANNELS = 4
CELL = 8  # px of the clip per latent cell, each way
SHARPNESS = 220.0  # of ATI's Gaussian; positions are in half short sides of the image
NEAREST = 2  # tracks that count at a cell

# (condition [20, T, h, w], tracks in px of the clip, its width, its height) -> guided and unconditional condition
TrackConditioning: TypeAlias = Callable[[Tensor, Tracks, int, int], tuple[Tensor, Tensor]]


def ati(condition: Tensor, tracks: Tracks, width: int, height: int) -> tuple[Tensor, Tensor]:
    """ATI: both passes are conditioned on the tracks."""
    tensor = torch.from_numpy(to_ati_tensor(to_ati_file(tracks), width, height))
    changed = ati_condition(condition, tensor)
    return changed, changed


def wan_move(condition: Tensor, tracks: Tracks, width: int, height: int) -> tuple[Tensor, Tensor]:
    """Wan-Move: only the guided pass is conditioned on the tracks."""
    points, visible = torch.from_numpy(tracks.points), torch.from_numpy(tracks.visible)
    latent = wan_move_latent(condition[MASK_CHANNELS:], points, visible)
    return torch.cat([condition[:MASK_CHANNELS], latent]), condition


def ati_condition(condition: Tensor, tracks: Tensor) -> Tensor:
    """The condition [20, T, h, w] with ATI's motion in it; `tracks` [>= F, N, 4] as from `tracks.to_ati_tensor`."""
    latent = condition[MASK_CHANNELS:].float()
    _, frames, height, width = latent.shape
    tracks = tracks[: STRIDE * (frames - 1) + 1].to(latent.device, torch.float32)
    changed = torch.empty_like(condition)
    changed[:MASK_CHANNELS, 0] = 1
    changed[:, 1:] = 0
    changed[MASK_CHANNELS:] = condition[MASK_CHANNELS:]
    if not tracks.shape[1] or frames == 1:
        return changed
    weight, nearest = _gaussians(tracks, height, width)  # [T - 1, h, w, K] each
    features = _features_at(latent[:, 0], tracks[0, :, 1:3])  # [N, 16]
    carried = torch.einsum("thwk,thwkc->cthw", weight, features[nearest])
    total = weight.sum(-1)
    changed[:MASK_CHANNELS, 1:] = total.to(changed.dtype)
    changed[MASK_CHANNELS:, 1:] = (carried + latent[:, 1:] * (1 - total.clamp(max=1))).to(changed.dtype)
    return changed


def wan_move_latent(latent: Tensor, points: Tensor, visible: Tensor) -> Tensor:
    """The latent [16, T, h, w] with each track's first cell copied to where the track is.

    `points` [>= F, N, 2] are px of the clip, `visible` [>= F, N]. A track that is not visible inside the first frame
    has no feature to carry. Where several tracks end in one cell, the last one in order is kept (the public
    implementation keeps a random one).
    """
    _, frames, height, width = latent.shape
    steps = slice(0, STRIDE * (frames - 1) + 1, STRIDE)
    points, visible = points[steps].to(latent.device), visible[steps].to(latent.device)
    x, y = points[..., 0], points[..., 1]
    seen = visible & (x >= 0) & (y >= 0) & (x < CELL * width) & (y < CELL * height)
    # Clamped before it becomes an integer: a far point must not overflow into the image.
    column = torch.where(seen, x / CELL, 0).floor().long()
    row = torch.where(seen, y / CELL, 0).floor().long()
    cell = row * width + column
    moved = seen & seen[:1]
    moved[0] = False
    # One scatter of track numbers settles which track a cell takes, the same on every device.
    owner = torch.full((frames, height * width), -1, dtype=torch.long, device=latent.device)
    numbers = torch.arange(points.shape[1], device=latent.device).expand_as(cell)
    owner.scatter_reduce_(1, cell, torch.where(moved, numbers, -1), "amax")
    taken = owner.view(frames, height, width) >= 0
    source = cell[0][owner.clamp(min=0)] if points.shape[1] else owner
    features = latent[:, 0].flatten(1)[:, source.clamp(min=0)].view_as(latent)
    return torch.where(taken, features, latent)


def _gaussians(tracks: Tensor, height: int, width: int) -> tuple[Tensor, Tensor]:
    """Weights and track numbers [T - 1, h, w, K] of the K tracks that count most at each cell."""
    short = min(height, width)
    x = torch.linspace(-width / short, width / short, width, device=tracks.device)
    y = torch.linspace(-height / short, height / short, height, device=tracks.device)
    visible = ((tracks[1:, :, 3:] + 1) / 2).unflatten(0, (-1, STRIDE))
    count = visible.sum(1)  # [T - 1, N, 1]
    centre = (visible * tracks[1:, :, 1:3].unflatten(0, (-1, STRIDE))).sum(1) / (count + 1e-5)
    across = (centre[:, None, :, 0] - x[:, None]).square()  # [T - 1, w, N]
    down = (centre[:, None, :, 1] - y[:, None]).square()  # [T - 1, h, N]
    gaussian = torch.exp(-SHARPNESS * (down[:, :, None] + across[:, None])) * count[:, None, None, :, 0].clamp(max=1)
    best = gaussian.topk(min(NEAREST, gaussian.shape[-1]), dim=-1)
    return best.values, best.indices


def _features_at(image: Tensor, positions: Tensor) -> Tensor:
    """Bilinear features [N, C] of a latent frame [C, h, w] at positions [N, 2] (x, y); beyond its edge lies zero."""
    _, height, width = image.shape
    short = min(height, width)
    reach = positions.new_tensor([width / short, height / short])
    places = (positions / reach).clamp(-1, 1)
    sampled = grid_sample(image[None], places[None, None], mode="bilinear", padding_mode="zeros", align_corners=False)
    return sampled[0, :, 0].T
