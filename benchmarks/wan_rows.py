"""The measurements of a run within a budget, most informative first, and which of them there is time for.

One build of the model serves all of them. A row is written as soon as it is known.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import torch
from wan_bench import Bench
from wan_flops import pass_flops
from wan_models import Case
from wan_plan import (
    COMPILE_SECONDS,
    FILL_BYTES_PER_SECOND,
    MOVED_BYTES_PER_SECOND,
    OTHER_SECONDS,
    SHARE_OF_PEAK,
    TOY_SECONDS,
    VAE_SECONDS,
    Budget,
)
from wan_result import Result, guarded, rounded

from cow_service.generators.wan.capabilities import Capabilities, detect_capabilities, refusals
from cow_service.generators.wan.profiles import Acceleration, profile_of


@dataclass(frozen=True)
class Row:
    """One measurement."""

    name: str
    run: Callable[[Bench], dict[str, Any]]
    form: Acceleration | None = None  # of the transformer; None if it does not matter
    passes: float = 0.0  # of the full size, that it takes
    seconds: float = 0.0  # that it takes besides them


def rows(case: Case, best: str) -> tuple[Row, ...]:
    """All of them. `best`: the attention backend to compile with."""
    eager, compiled = Acceleration(attention="native"), Acceleration(attention=best, compile="regional")
    fp8, offload = compiled.model_copy(update={"fp8": "dynamic"}), Acceleration(offload="group")
    turbo = profile_of(case.manifest, "turbo").sampling.steps
    small = 0.2  # of a pass: a clip of the second size
    transformer = 2 * case.manifest.parameters.get("transformer", 0)  # bytes
    moved = transformer / MOVED_BYTES_PER_SECOND
    both = (("float32", torch.float32), ("bfloat16", torch.bfloat16))
    return (
        Row("eager", Bench.passes, eager, 2),
        Row("cuDNN", Bench.passes, Acceleration(attention="_native_cudnn"), 2),
        Row("compiled", Bench.compiled, compiled, 4 + 2 * small, 2 * COMPILE_SECONDS),
        Row("kernels", Bench.kernels, compiled, 2, 5),
        Row("turbo clip", partial(Bench.clip, profile="turbo"), compiled, turbo, OTHER_SECONDS),
        *(Row(f"VAE {name}", partial(Bench.vae, dtype=dtype), None, 0, VAE_SECONDS) for name, dtype in both),
        Row("first-block cache", Bench.cached, compiled, 3),
        *(
            Row(f"VAE {name}, channels last", partial(Bench.vae, dtype=dtype, channels_last=True), None, 0, VAE_SECONDS)
            for name, dtype in both
        ),
        Row("both guidance passes", Bench.both_guidance_passes, compiled, 6, COMPILE_SECONDS),
        # From here on the weights are others.
        Row("fp8", Bench.passes, fp8, 1, COMPILE_SECONDS),
        Row("group offload", Bench.offloaded, offload, 2, transformer / FILL_BYTES_PER_SECOND + 4 * moved),
        *(
            Row(f"VAE {name}, tiled", partial(Bench.vae, dtype=dtype, tiled=True), None, 0, 2 * VAE_SECONDS)
            for name, dtype in both
        ),
    )


def refused(row: Row, machine: Capabilities) -> str:
    """Why this machine cannot run it; empty if it can."""
    return "" if row.form is None else " ".join(refusals(row.form, machine))


def reckoned(row: Row, case: Case, peak: float) -> float:
    """Seconds, by operations and bytes. `peak`: FLOP/s of matrix products in bfloat16."""
    if case.toy:
        return TOY_SECONDS
    flops = pass_flops(case.manifest.architecture, case.num_frames, case.width, case.height)
    return row.seconds + row.passes * flops / (SHARE_OF_PEAK * peak)


def build_seconds(case: Case) -> float:
    """To make all parts, reckoned."""
    weights = 2 * sum(case.manifest.parameters.values())
    return TOY_SECONDS if case.toy else weights / FILL_BYTES_PER_SECOND


def measure_rows(case: Case, peak: float, best: str, budget: Budget, keep: Callable[[list[Result]], None]) -> None:
    """Runs what there is time for; `keep` is given all results so far whenever there is one more."""
    results: list[Result] = []
    machine = detect_capabilities(case.device)
    benches: list[Bench] = []  # one, once it is built

    def build() -> dict[str, Any]:
        benches.append(Bench(case, peak))
        return {"build_s": rounded(benches[0].built)}

    for row in rows(case, best):
        begun = time.monotonic()
        expected, left = budget.expected(reckoned(row, case, peak)), budget.left
        if reason := refused(row, machine):
            result = Result(row.name, "refused", reason)
        elif expected + (0 if benches else build_seconds(case)) > left:
            late = f"It would take {expected:.0f} s (reckoned), and {max(0, left):.0f} s are left."
            result = Result(row.name, "skipped", late)
        else:
            if not benches:
                results.append(guarded("build", case, build))
                begun = time.monotonic()
            if not benches:  # none of the rows can be measured
                keep(results)
                return
            result = _measured(row, benches[0])
            took = time.monotonic() - begun
            if result.status == "measured":
                budget.took(reckoned(row, case, peak), took)
            result = replace(result, seconds=rounded(took))
        results.append(result)
        keep(results)


def _measured(row: Row, bench: Bench) -> Result:
    def run() -> dict[str, Any]:
        if row.form is not None and row.form.fp8 != "none":  # else its weights would be taken for one more size
            torch.compiler.reset()
        if row.form is not None and row.form.offload == "none":  # that is part of what is measured
            bench.put(row.form)
        return row.run(bench)

    return guarded(row.name, bench.case, run)


def totals(case: Case, results: list[Result]) -> list[dict[str, Any]]:
    """What whole clips of the profile `exact` come to, computed from passes, and from the rest of a measured clip."""
    figures = {result.name: result.figures for result in results if result.status == "measured"}
    sampling = profile_of(case.manifest, "exact").sampling
    clip, vae = figures.get("turbo clip"), figures.get("VAE float32")
    if clip is None or vae is None:
        return []
    parts: dict[str, float] = clip["parts_s"]
    rest = sum(seconds for name, seconds in parts.items() if name not in {"denoising", "VAE encode", "decode"})
    passes = sampling.steps * (2 if sampling.is_guided else 1)
    return [
        {
            "name": name,
            "steps": sampling.steps,
            "total_s": rounded(passes * figures[name]["pass_s"][-1] + rest + vae["encode_s"] + vae["decode_s"]),
        }
        for name in ("eager", "cuDNN", "compiled", "fp8", "group offload")
        if name in figures
    ]
