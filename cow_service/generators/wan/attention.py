"""Which attention backend is the fastest for a clip: those that a machine has are timed once, at the clip's shape.

No rule tells: cuDNN's is the faster one on some GPUs and the slower one on others, and lacks shapes.
"""

import json
import logging
import os
import statistics
import time
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import diffusers
import torch
from diffusers.models.attention_dispatch import attention_backend, dispatch_attention_fn
from torch import Tensor

from cow_service.generators.wan.capabilities import AUTO, backends_for_auto, detect_capabilities
from cow_service.generators.wan.checkpoints import TEXT_LENGTH, diffusers_config
from cow_service.generators.wan.conditioning import CELL
from cow_service.generators.wan.memory import has_failed, wait_until_done
from cow_service.generators.wan.pipeline import token_count
from cow_service.generators.wan.profiles import Acceleration, Profile
from cow_service.weights.device import is_out_of_memory

NATIVE = "native"  # what the others are compared with
TRIALS = 3  # after one that is not counted
MARGIN = 1.05  # of two that are closer, the first one is taken: else noise would choose, each time another
MAX_ERROR = 0.02  # of the largest value: the roundings of bfloat16 stay below it
FRAMES = 81  # of the longest clip
CROSS_KEYS = TEXT_LENGTH, 257  # of text and picture, to which a clip attends besides itself

log = logging.getLogger("cow_service")


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


def shape_of(
    architecture: Mapping[str, Any], width: int, height: int, num_frames: int = FRAMES, cell: int = CELL
) -> AttentionShape:
    """The shape at which a model attends to a clip of that size (px)."""
    config = diffusers_config(architecture)
    tokens = token_count(width, height, num_frames, cell)
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


def with_attention(
    profile: Profile,
    architecture: Mapping[str, Any],
    width: int,
    height: int,
    device: torch.device,
    kept: Path | None = None,
    num_frames: int = FRAMES,
    cell: int = CELL,
) -> Profile:
    """The profile with the backend that `attention: auto` chooses on this device; any other profile as it is.

    `width`, `height`, `num_frames`: of the longest clip, px; `cell`: px of its latent cells. `kept`: file of earlier
    choices. Without it another start of the same versions on the same GPU might choose another backend, and cached
    clips would not be found.
    """
    wanted = profile.acceleration
    if wanted.attention != AUTO:
        return profile
    machine, shape = detect_capabilities(device), shape_of(architecture, width, height, num_frames, cell)
    names = tuple(name for name in backends_for_auto(wanted, machine) if _fetched(name) is None)
    situation = repr((machine.name, torch.__version__, diffusers.__version__, profile.dtype, tuple(shape), names))
    before: dict[str, str] = {}
    if kept is not None:
        with suppress(OSError, ValueError, TypeError):  # there is none yet, or it is damaged
            before = dict(json.loads(kept.read_text()))
    chosen = before.get(situation)
    if chosen in names:
        log.info("attention: %s, as was chosen before", chosen)
    else:
        timed = () if len(names) < 2 else time_backends(names, shape, getattr(torch, profile.dtype), device)
        chosen = fastest(timed)
        log.info("attention: %s", "; ".join(map(str, (chosen, *timed))))
        if kept is not None and all(one.seconds is not None for one in timed):  # else one may be there the next time
            kept.parent.mkdir(parents=True, exist_ok=True)
            part = kept.with_name(f"{kept.name}.{os.getpid()}")
            part.write_text(json.dumps(before | {situation: chosen}, indent=2) + "\n")
            part.replace(kept)
    return profile.model_copy(update={"acceleration": wanted.model_copy(update={"attention": chosen})})


def fetch_kernels(wanted: Iterable[Acceleration], device: torch.device) -> dict[str, str | None]:
    """Downloads the attention kernels that such options may use here; by backend, why one could not be fetched."""
    machine = detect_capabilities(device)
    names = [
        name
        for each in wanted
        for name in (backends_for_auto(each, machine) if each.attention == AUTO else (each.attention,))
        if name.endswith("_hub")
    ]
    return {name: _fetched(name) for name in dict.fromkeys(names)}


def _fetched(name: str) -> str | None:
    """Fetches a backend's kernel where it has one. Returns why it cannot be used; None if it can."""
    try:
        with attention_backend(name):
            return None
    except Exception as problem:  # noqa: BLE001 - of the hub, of the package kernels, or of the kernel's own code
        return _first_line(problem)


def _first_line(problem: Exception) -> str:
    return f"{type(problem).__name__}: {(str(problem).splitlines() or [''])[0]}"
