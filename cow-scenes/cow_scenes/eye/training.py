"""Trains the network: seeded, and resumed from the last checkpoint if there is one."""

import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from .batches import SHAPES, THING, Album, Batch, batch_of
from .learning import losses, relit, to_tensors
from .network import CLASSES, Network, new_network
from .pictures import Shard

REFRESH = 50
"""Steps between looks for new shards."""


@dataclass(frozen=True)
class Recipe:
    """How to train: steps of a batch each, the largest step size (AdamW, a cosine down to 0), seed, threads.

    After every `check` steps a checkpoint is written and the network measured on pictures that are not learned from.
    """

    steps: int = 20_000
    rate: float = 3e-3
    seed: int = 1
    threads: int = 2
    shapes: tuple[tuple[int, int, int], ...] = SHAPES
    decay: float = 0.02
    average: float = 0.998
    check: int = 250

    def rate_at(self, step: int) -> float:
        """The step size: 150 steps of warming up, then half a cosine."""
        return self.rate * min(1.0, (step + 1) / 150) * 0.5 * (1 + float(np.cos(np.pi * step / self.steps))) + 1e-5


def arranged(network: Network, device: torch.device) -> Network:
    """The network on a device, its weights in the order that convolutions are fastest with."""
    for parameter in network.to(device).parameters():
        if parameter.ndim == 4:
            parameter.data = parameter.data.contiguous(memory_format=torch.channels_last)
    return network


class Training:
    """A network in training, its running average (which is what is used later), and the optimizer."""

    def __init__(self, recipe: Recipe, start: Path | None = None) -> None:
        self.recipe, self.step, self.seconds = recipe, 0, 0.0
        self.device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
        torch.set_num_threads(recipe.threads)
        self.network = arranged(new_network(recipe.seed), self.device)
        if start is not None:
            self.network.load_state_dict(torch.load(start, map_location=self.device, weights_only=True))
        self.average = arranged(Network(), self.device)
        self.average.load_state_dict(self.network.state_dict())
        self.optimizer = torch.optim.AdamW(
            self.network.parameters(), recipe.rate, (0.9, 0.99), weight_decay=recipe.decay
        )

    def learn(self, batch: Batch) -> dict[str, float]:
        """One step; the parts of the loss."""
        for group in self.optimizer.param_groups:
            group["lr"] = self.recipe.rate_at(self.step)
        images, targets = to_tensors(batch, self.device)
        images = relit(images, torch.Generator().manual_seed(self.recipe.seed * 1_000_003 + self.step))
        with torch.autocast(self.device.type, torch.bfloat16):
            fine, coarse = self.network(images.contiguous(memory_format=torch.channels_last))
        parts = losses(fine.float(), coarse.float(), targets)
        total = torch.stack(list(parts.values())).sum()
        self.optimizer.zero_grad(set_to_none=True)
        total.backward()
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), 5.0)
        self.optimizer.step()
        self.step += 1
        self.follow()
        return {name: float(part.detach()) for name, part in parts.items()}

    def follow(self) -> None:
        """Move the average towards the network, faster in the beginning."""
        keep = min(self.recipe.average, self.step / (self.step + 20.0))
        with torch.no_grad():
            for mean, value in zip(self.average.state_dict().values(), self.network.state_dict().values(), strict=True):
                if mean.dtype.is_floating_point:
                    mean.lerp_(value, 1 - keep)
                else:
                    mean.copy_(value)

    def save(self, path: Path) -> None:
        """Write a checkpoint."""
        unfinished = path.with_suffix(".part")
        state = {
            "network": self.network.state_dict(), "average": self.average.state_dict(),
            "optimizer": self.optimizer.state_dict(), "step": self.step, "seconds": self.seconds,
        }  # fmt: skip
        torch.save(state, unfinished)
        unfinished.replace(path)

    def load(self, path: Path) -> None:
        """Go on from a checkpoint."""
        state = torch.load(path, map_location=self.device, weights_only=True)
        for name in ("network", "average", "optimizer"):
            getattr(self, name).load_state_dict(state[name])
        self.step, self.seconds = state["step"], state["seconds"]

    def measure(self, batches: list[Batch]) -> dict[str, float]:
        """Parts of the loss of the average, and the intersection over union of all things, on batches (the mean)."""
        self.average.eval()
        rows: list[dict[str, float]] = []
        with torch.no_grad():
            for batch in batches:
                images, targets = to_tensors(batch, self.device)
                fine, coarse = self.average(images)
                found, truth = fine[:, : len(CLASSES)].argmax(1) == THING, targets["classes"] == THING
                row = {name: float(part) for name, part in losses(fine, coarse, targets).items()}
                rows.append(row | {"iou": overlap(found & (targets["classes"] >= 0), truth)})
        return {name: round(sum(row[name] for row in rows) / len(rows), 4) for name in rows[0]}


def overlap(found: Tensor, truth: Tensor) -> float:
    """Intersection over union."""
    return float((found & truth).sum() / (found | truth).sum().clamp_min(1))


def held_out(folder: Path, count: int = 48) -> list[Batch]:
    """Batches of four whole pictures from the first shards of a folder."""
    pictures = [shard[k] for shard in map(Shard, sorted(folder.glob("seed*.npz"))) for k in range(len(shard))][:count]
    halved = [p.__class__(p.image, p.ids[::2, ::2], p.marks[::2, ::2], p.depth, p.normals, p.focal) for p in pictures]
    return [batch_of(halved[k : k + 4]) for k in range(0, len(halved), 4)]


def train(
    pictures: Path,
    held: Path,
    out: Path,
    recipe: Recipe,
    start: Path | None = None,
    tell: Callable[[str], None] = print,
) -> Training:
    """Train on the shards of a folder until the recipe's last step; `out` holds checkpoint, log and the result."""
    out.mkdir(parents=True, exist_ok=True)
    training, checkpoint, album = Training(recipe, start), out / "checkpoint.pt", Album(pictures)
    if checkpoint.exists():
        training.load(checkpoint)
    check, running, began = held_out(held), {}, time.monotonic() - training.seconds
    while training.step < recipe.steps:
        if training.step % REFRESH == 0 or not album.shards:
            album.refresh()
        random = np.random.default_rng((recipe.seed, training.step))
        parts = training.learn(album.batch(random, recipe.shapes[training.step % len(recipe.shapes)]))
        running = {name: 0.97 * running.get(name, value) + 0.03 * value for name, value in parts.items()}
        if training.step % recipe.check == 0 or training.step == recipe.steps:
            training.seconds = time.monotonic() - began
            row = {"step": training.step, "seconds": round(training.seconds), "pictures": album.refresh()}
            row |= {
                "learning": {name: round(value, 4) for name, value in running.items()},
                "held out": training.measure(check),
            }
            training.save(checkpoint)
            with (out / "log.jsonl").open("a") as log:
                log.write(json.dumps(row) + "\n")
            tell(json.dumps(row))
    torch.save(training.average.state_dict(), out / "weights.pt")
    return training
