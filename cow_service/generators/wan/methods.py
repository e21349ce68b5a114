"""ATI and Wan-Move: how each puts tracks into the conditions of the guided and the unconditional pass."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import torch
from torch import Tensor

from cow_service.generators.wan.conditioning import ati_condition, wan_move_condition
from cow_service.generators.wan.tracks import Tracks, to_ati_file, to_ati_tensor

# (condition [20, T, h, w], tracks in px of the clip, its width, its height) -> guided and plain condition
Method: TypeAlias = Callable[[Tensor, Tracks, int, int], tuple[Tensor, Tensor]]


def ati(condition: Tensor, tracks: Tracks, width: int, height: int) -> tuple[Tensor, Tensor]:
    """ATI: both passes are conditioned on the tracks."""
    tensor = torch.from_numpy(to_ati_tensor(to_ati_file(tracks), width, height))
    changed = ati_condition(condition, tensor)
    return changed, changed


def wan_move(condition: Tensor, tracks: Tracks, width: int, height: int) -> tuple[Tensor, Tensor]:
    """Wan-Move: only the guided pass is conditioned on the tracks."""
    points, visible = torch.from_numpy(tracks.points), torch.from_numpy(tracks.visible)
    return wan_move_condition(condition, points, visible), condition
