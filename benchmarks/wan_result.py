"""The result of one measurement of `wan_speed.py`; an error in it becomes its result, too."""

from __future__ import annotations

import gc
import traceback
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal

import torch
from wan_models import Case

from cow_service.errors import CowError
from cow_service.generators.wan.memory import within_memory
from cow_service.weights.device import cpu_threads


@dataclass(frozen=True)
class Result:
    """One profile, or one row of a run within a budget."""

    name: str
    status: Literal["measured", "refused", "failed", "skipped"]
    reason: str | None = None
    notes: tuple[str, ...] = ()
    figures: dict[str, Any] = field(default_factory=dict)
    seconds: float = 0.0  # that all of it took


def guarded(name: str, case: Case, run: Callable[[], dict[str, Any]], notes: tuple[str, ...] = ()) -> Result:
    """Runs it; the memory of one that fails is free afterwards."""
    defaults = case.manifest.defaults
    try:
        with (
            cpu_threads(int(defaults["threads"]) if "threads" in defaults else None),
            within_memory(case.device, lambda: None, f"'{name}'"),
        ):
            return Result(name, "measured", None, notes, run())
    except CowError as error:
        return Result(name, "failed", error.detail)
    except Exception as error:  # noqa: BLE001 - the others are measured all the same
        traceback.print_exc()
        traceback.clear_frames(error.__traceback__)  # they hold the model
        return Result(name, "failed", f"{type(error).__name__}: {error}")
    finally:
        gc.collect()
        if case.device.type == "cuda":
            torch.cuda.empty_cache()


def rounded(value: float) -> float:
    """To four digits."""
    return float(f"{value:.4g}")
