"""Times the attention backends of a machine, each by itself, on random inputs of a clip's shape.

PyTorch's own choice, `native`, was within 4% of the fastest on the one GPU measured (results/wan_speed_h100.json), so
the profiles take it.
"""

import statistics
import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from diffusers.models.attention_dispatch import attention_backend, dispatch_attention_fn
from torch import Tensor

from cow_service.generators.wan.checkpoints import TEXT_LENGTH, diffusers_config
from cow_service.generators.wan.conditioning import CELL
from cow_service.generators.wan.memory import has_failed, wait_until_done
from cow_service.generators.wan.pipeline import token_count
from cow_service.weights.device import is_out_of_memory

NATIVE = "native"  # what the others are compared with
# Those that compute the same as native to rounding, where the machine has them.
BACKENDS = (
    NATIVE, "_native_flash", "_native_cudnn", "_native_efficient", "flash", "flash_hub", "_flash_3", "_flash_3_hub",
    "flash_4_hub", "xformers",
)  # fmt: skip
TRIALS = 3  # after one that is not counted
MARGIN = 1.05  # of two that are closer, the first one is taken: else noise would choose, each time another
MAX_ERROR = 0.02  # of the largest value: the roundings of bfloat16 stay below it
CROSS_KEYS = TEXT_LENGTH, 257  # of text and picture, to which a clip attends besides itself


class AttentionShape(NamedTuple):
    """What a self-attention is given: queries, keys and values, each [1, tokens, heads, width]."""

    tokens: int
    heads: int
    width: int


@dataclass(frozen=True)
class TimedBackend:
    """One backend at one shape."""

    name: str
    seconds: float | None  # median; None if it cannot be used
    error: float | None  # largest difference from native, as a share of native's largest value
    reason: str | None = None  # why it cannot be used

    @property
    def usable(self) -> bool:
        """Whether it computes the same to rounding."""
        return self.seconds is not None and self.error is not None and self.error <= MAX_ERROR

    def __str__(self) -> str:
        if self.seconds is None or self.error is None:
            return f"{self.name} cannot be used ({self.reason})"
        return f"{self.name} {1000 * self.seconds:.3g} ms" + ("" if self.usable else f", off by {self.error:.2g}")


def shape_of(architecture: Mapping[str, Any], width: int, height: int, num_frames: int) -> AttentionShape:
    """The shape at which a model attends to a clip of that size (px)."""
    config = diffusers_config(architecture)
    tokens = token_count(width, height, num_frames, CELL)
    return AttentionShape(tokens, config["num_attention_heads"], config["attention_head_dim"])


def time_backends(
    names: Iterable[str], shape: AttentionShape, dtype: torch.dtype, device: torch.device
) -> tuple[TimedBackend, ...]:
    """Times each backend on the same random inputs. One that fails says why; a GPU that fails is raised."""
    drawn = torch.Generator(device).manual_seed(0)
    q, k, v = (torch.randn(1, *shape, generator=drawn, device=device).to(dtype) for _ in range(3))
    attended = [(k[:, :keys], v[:, :keys]) for keys in (shape.tokens, *CROSS_KEYS)]
    expected = [_attended(NATIVE, q, *each) for each in attended]

    def timed(name: str) -> TimedBackend:
        try:
            errors = [
                (_attended(name, q, *each) - wanted).abs().max() / wanted.abs().max()
                for each, wanted in zip(attended, expected, strict=True)
            ]
            seconds: list[float] = []
            for _ in range(TRIALS):
                begun = time.perf_counter()
                _attended(name, q, k, v)
                seconds.append(time.perf_counter() - begun)
            return TimedBackend(name, statistics.median(seconds), float(torch.stack(errors).max()))
        except Exception as problem:
            if isinstance(problem, RuntimeError) and not is_out_of_memory(problem) and has_failed(device, problem):
                raise  # nothing can be computed on the device any more
            return TimedBackend(name, None, None, _first_line(problem))

    return tuple(timed(name) for name in names)


@torch.no_grad()
def _attended(name: str, q: Tensor, k: Tensor, v: Tensor) -> Tensor:
    with attention_backend(name):
        found = dispatch_attention_fn(q, k, v)
    wait_until_done(q.device)
    return found


def fastest(timed: Iterable[TimedBackend]) -> str:
    """The first of those that compute the same than which none is clearly faster; native where there is none."""
    seconds = {one.name: one.seconds for one in timed if one.usable and one.seconds is not None}
    best = min(seconds.values(), default=0.0)
    return next((name for name, each in seconds.items() if each <= MARGIN * best), NATIVE)


def _first_line(problem: Exception) -> str:
    return f"{type(problem).__name__}: {(str(problem).splitlines() or [''])[0]}"
