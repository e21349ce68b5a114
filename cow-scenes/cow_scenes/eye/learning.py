"""What is minimized, and how pictures vary in light and colour while the network learns."""

import torch
from torch import Tensor
from torch.nn import functional

from .batches import FLAT, THING, Batch
from .network import CLASSES

Targets = dict[str, Tensor]


def to_tensors(batch: Batch, device: torch.device) -> tuple[Tensor, Targets]:
    """Images (n, 3, h, w) of 0 to 1, and the targets by name."""
    images = torch.from_numpy(batch.images).to(device).permute(0, 3, 1, 2).float().div(255)
    names = ("classes", "drawn", "rim", "near", "centres", "offsets", "belongs", "log_depth", "has_depth", "normals")
    targets = {name: torch.from_numpy(getattr(batch, name)).to(device) for name in names}
    return images, {k: t.float() if t.dtype == torch.bool else t for k, t in targets.items()}


def relit(images: Tensor, random: torch.Generator) -> Tensor:
    """Images (n, 3, h, w) with other exposure, contrast, saturation, tint, channels, gradients, gamma and noise."""
    count, _, height, width = images.shape

    def draw(low: float, high: float, chance: float, channels: int = 1) -> Tensor:
        """A number per image from `low` to `high`, or 0 with a probability of 1 - `chance`."""
        value = low + (high - low) * torch.rand((count, channels, 1, 1), generator=random)
        return (value * (torch.rand((count, 1, 1, 1), generator=random) < chance)).to(images.device)

    mean = images.mean((1, 2, 3), keepdim=True)
    # Three in four are exposed as a camera would; the others stay as dark as they were drawn.
    gain = (draw(0.3, 0.65, 0.75) / mean.clamp_min(0.02)).clamp_max(3)
    images = images * torch.where(gain > 0, gain, 1)
    mean = images.mean((1, 2, 3), keepdim=True)
    images = (images - mean) * (1 + draw(-0.6, 0.5, 0.8)) + mean
    grey = images.mean(1, keepdim=True)
    images = (grey + (images - grey) * (1 + draw(-0.9, 0.7, 0.7))) * (1 + draw(-0.3, 0.3, 0.6, 3))
    for k in torch.nonzero(torch.rand(count, generator=random) < 0.3).ravel().tolist():
        images[k] = images[k][torch.randperm(3, generator=random).to(images.device)]
    down = torch.linspace(-1, 1, height, device=images.device).view(1, 1, height, 1)
    right = torch.linspace(-1, 1, width, device=images.device).view(1, 1, 1, width)
    images = images * (1 + draw(-0.5, 0.5, 0.5) * down + draw(-0.5, 0.5, 0.5) * right)
    images = images.clamp(1e-3, 1.2) * (1 + draw(-0.5, 0.55, 0.7))
    images = images.clamp(1e-3, 1) ** torch.exp(draw(-0.6, 0.6, 0.6))
    noise = torch.randn(images.shape, generator=random).to(images.device)
    return (images + draw(0, 0.05, 0.5) * noise).clamp(0, 1)


def overlap_loss(probability: Tensor, truth: Tensor) -> Tensor:
    """One minus the Dice coefficient, the mean over images; small regions weigh little."""
    common = (probability * truth).sum((1, 2))
    return (1 - (2 * common + 20) / (probability.sum((1, 2)) + truth.sum((1, 2)) + 20)).mean()


def fine_losses(fine: Tensor, targets: Targets) -> dict[str, Tensor]:
    """Losses of the classes, of what is drawn, and of rims."""
    classes = targets["classes"]
    known, is_thing = (classes >= 0).float(), (classes == THING).float()
    weight = (1 + is_thing + (classes == FLAT).float() + 2 * targets["near"]) * known
    logits = fine[:, : len(CLASSES)]
    entropy = functional.cross_entropy(logits, classes.clamp_min(0), reduction="none")
    probability = torch.softmax(logits, 1)[:, THING] * known
    drawn, rim = fine[:, len(CLASSES)], fine[:, len(CLASSES) + 1]
    cross = functional.binary_cross_entropy_with_logits
    # One pixel in three hundred is drawn over.
    rare = 1 + 30 * targets["drawn"]
    return {
        "classes": 2.0 * (entropy * weight).sum() / weight.sum().clamp_min(1),
        "overlap": overlap_loss(probability, is_thing),
        "drawn": (cross(drawn, targets["drawn"], reduction="none") * rare).sum() / rare.sum()
        + 0.5 * overlap_loss(torch.sigmoid(drawn), targets["drawn"]),
        "rim": 0.5 * (cross(rim, targets["rim"], reduction="none", pos_weight=rim.new_tensor(3.0)) * known).mean(),
    }  # fmt: skip


def coarse_losses(coarse: Tensor, targets: Targets) -> dict[str, Tensor]:
    """Losses of centres, offsets, depth and normals."""
    bumps, belongs, has_depth = targets["centres"], targets["belongs"], targets["has_depth"]
    entropy = functional.binary_cross_entropy_with_logits(coarse[:, 0], bumps, reduction="none")
    away = (coarse[:, 1:3] - targets["offsets"]).abs().sum(1)
    error = coarse[:, 3] - targets["log_depth"]
    mean = (error * has_depth).sum((1, 2), keepdim=True) / has_depth.sum((1, 2), keepdim=True).clamp_min(1)
    normals = targets["normals"]
    has_normal = normals.square().sum(1).gt(0.5).float()
    angle = 1 - functional.cosine_similarity(coarse[:, 4:7], normals, dim=1)
    return {
        "centres": 0.04 * (entropy * (1 + 15 * bumps)).sum() / (bumps.sum() + 12),
        "offsets": 0.6 * (away * belongs).sum() / belongs.sum().clamp_min(1),
        "depth": 0.25 * ((error - mean).abs() * has_depth).sum() / has_depth.sum().clamp_min(1),
        "normals": 0.3 * (angle * has_normal).sum() / has_normal.sum().clamp_min(1),
    }


def losses(fine: Tensor, coarse: Tensor, targets: Targets) -> dict[str, Tensor]:
    """All parts of the loss by name, weighted; their sum is minimized."""
    return fine_losses(fine, targets) | coarse_losses(coarse, targets)
