"""Measures how fast the video model runs on this machine: each profile of a manifest, part by part.

    python benchmarks/wan_speed.py [--model ati] [--profile exact ...] [--against plain] [--num-frames 81]
        [--width 832 --height 480] [--steps N] [--runs N] [--budget SECONDS] [--plan] [--json FILE]

On a GPU it is the 14B model with random weights; without one, the toy. Every profile gets a pipeline of its own and one
clip that is not counted, of the full size and two steps, in which everything is compiled. Then come `--runs` clips,
whose medians are given; text and picture are encoded anew in each. `plain` is diffusers' own pipeline, in the same run.
First, a toy with the public implementation's weights is compared with its figures, in float32 and bfloat16, and every
attention backend that the machine has is timed alone, at the shape of the clip.

With `--budget` no profile is run: one build of the model is put into one form after the other, of which single passes
are timed (eager, compiled, cached, float8, offloaded), the VAE's both ways in each precision and layout, the kernels of
a pass, and one whole turbo clip; whole clips of the others are computed from these, and marked so. What will not be
done in time is left out; `--plan` says what would be run and what it is reckoned to take, for an H100 where there is no
GPU. The file has each row as soon as it is known.

Floating-point operations are counted by formula (`pass_flops`), 135 PFLOP for 832x480x81 in 40 guided steps; those that
a cache skipped are left out. Their share of the peak is that of bfloat16 matrix products measured here, whatever the
profile computes in. How many passes a cache skips depends on the weights: on random ones it says nothing.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import resource
import statistics
import sys
import time
from collections.abc import Iterable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import accelerate
import diffusers
import torch
import transformers

# On a bare GPU machine the package is not installed.
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from wan_attention import BACKENDS, AttentionShape, TimedBackend, fastest, shape_of, time_backends
from wan_flops import pass_flops
from wan_golden import distances
from wan_models import Case, Clock, Studio, Timing, do_without_ftfy
from wan_plan import ASSUMED, ASSUMED_PEAK, FIRST_SECONDS, Budget, missing_packages
from wan_result import Result, guarded, rounded
from wan_rows import build_seconds, measure_rows, reckoned, refused, rows, totals
from wan_table import PARTS, table

from cow_service.errors import CowError, GeneratorUnavailable
from cow_service.generators.wan.capabilities import detect_capabilities, refusals
from cow_service.generators.wan.pipeline import image_token_count
from cow_service.generators.wan.profiles import Profile, profile_of
from cow_service.generators.wan.tracks import MAX_FRAMES, STRIDE
from cow_service.weights.device import choose_device
from cow_service.weights.manifests import load_manifests

PLAIN = "plain"
WARM_UP_STEPS = 2
MATMUL_SECONDS, MATMUL_TRIES = 0.2, 5  # the best try counts


def matmul_peak(device: torch.device) -> float:
    """FLOP/s of large square matrix products in bfloat16."""
    side = 8192 if device.type == "cuda" else 512
    a, b = (torch.randn(side, side, device=device).to(torch.bfloat16) for _ in range(2))
    clock, best, count = Clock(device), 0.0, 3
    for _ in range(MATMUL_TRIES + 1):
        begun = clock.now()
        for _ in range(count):
            torch.matmul(a, b)
        rate = count / (clock.now() - begun)
        best, count = max(best, rate), max(1, int(rate * MATMUL_SECONDS))
    return best * 2 * side**3


def measure(name: str, case: Case, peak: float) -> Result:
    """One profile, or `plain`; whatever goes wrong becomes its result, and the memory is free afterwards."""
    profile = measured_profile(name, case)
    sentences = refusals(profile.acceleration, detect_capabilities(case.device))
    if profile.acceleration.ranks > 1:
        sentences = (*sentences, "Several processes share its clips, and this is one.")
    if sentences:
        return Result(name, "refused", " ".join(sentences))
    begun = time.monotonic()
    try:
        result = guarded(name, case, lambda: _figures(name, profile, case, peak), _notes(name, profile))
    finally:
        torch.compiler.reset()  # the next pipeline's layers would count as recompilations, which are limited
    return replace(result, seconds=rounded(time.monotonic() - begun))


def measured_profile(name: str, case: Case) -> Profile:
    """The profile of that name; `plain` takes the sampling alone of the first one."""
    profile = profile_of(case.manifest, next(iter(case.manifest.profiles)) if name == PLAIN else name)
    return Profile(summary="", sampling=profile.sampling) if name == PLAIN else profile


def _notes(name: str, profile: Profile) -> tuple[str, ...]:
    notes = {
        "diffusers' own pipeline, attention and precisions; nothing is compiled": name == PLAIN,
        "without its LoRA, which once loaded is part of the weights and takes no time": profile.lora is not None,
        "how many passes its cache skips is due to random weights": profile.acceleration.cache != "none",
    }
    return tuple(note for note, applies in notes.items() if applies)


def _figures(name: str, profile: Profile, case: Case, peak: float) -> dict[str, Any]:
    """Builds, warms up, measures."""
    sampling = case.sampled(profile.sampling)
    studio = Studio(case, None if name == PLAIN else profile)
    warm_up = studio.clip(sampling.model_copy(update={"steps": min(WARM_UP_STEPS, sampling.steps)})).total
    if case.device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(case.device)
    timings = [studio.clip(sampling) for _ in range(case.runs)]
    flops = _flops(profile, case, timings[-1], image_token_count(studio.pipeline.image_encoder))
    return {
        "steps": sampling.steps,
        **_seconds(timings, profile.sampling.steps),
        "passes": timings[-1].passes,
        "passes_computed": timings[-1].computed,
        **_rates(timings, flops, peak),
        **_memory(case.device),
        "build_s": rounded(studio.built),
        "warm_up_s": rounded(warm_up),
    }


def _seconds(timings: list[Timing], steps_of_profile: int) -> dict[str, Any]:
    """Medians over the clips and, where other steps were run than the profile's, what all of its own would take."""
    steps = [step for timing in timings for step in timing.steps]
    parts = {part: statistics.median(timing.parts[part] for timing in timings) for part in timings[0].parts}
    total = statistics.median(timing.total for timing in timings)
    ratio = steps_of_profile / len(timings[0].steps)
    computed = total + (ratio - 1) * parts["denoising"]
    return {
        "step_s": {
            name: rounded(of(steps)) for name, of in (("median", statistics.median), ("min", min), ("max", max))
        },
        "parts_s": {part: rounded(parts[part]) for part in PARTS if part in parts},
        "total_s": rounded(total),
    } | ({} if ratio == 1 else {"computed": {"steps": steps_of_profile, "total_s": rounded(computed)}})


def _flops(profile: Profile, case: Case, timing: Timing, image_tokens: int) -> int:
    """Of one clip's denoising; of a pass that the cache skipped, only what is computed before it decides."""
    size = case.manifest.architecture, case.num_frames, case.width, case.height, image_tokens
    looked_at = 1 if profile.acceleration.cache == "first-block" else 0
    skipped = timing.passes - timing.computed
    return timing.computed * pass_flops(*size) + skipped * pass_flops(*size, layers=looked_at)


def _rates(timings: list[Timing], flops: int, peak: float) -> dict[str, float]:
    rate = flops / statistics.median(timing.parts["denoising"] for timing in timings)
    return {"pflop": rounded(flops / 1e15), "tflops": rounded(rate / 1e12), "share_of_peak": rounded(rate / peak)}


def _memory(device: torch.device) -> dict[str, float]:
    """Largest so far, GB: on a GPU since the warm-up, else of the whole process."""
    if device.type == "cuda":
        allocated, reserved = torch.cuda.max_memory_allocated(device), torch.cuda.max_memory_reserved(device)
        return {"peak_allocated_gb": rounded(allocated / 1e9), "peak_reserved_gb": rounded(reserved / 1e9)}
    kib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return {"peak_resident_gb": rounded(kib * 1024 / 1e9)}


def survey(case: Case, names: Iterable[str], file: Path | None, budget: Budget | None = None) -> dict[str, Any]:
    """Measures one after the other: profiles, or with a budget the rows. What is there so far is always in `file`."""
    peak = matmul_peak(case.device)
    found = {**_surroundings(case), "matmul_bf16_tflops": rounded(peak / 1e12), "results": []}

    def keep(results: list[Result]) -> None:
        print("  ".join(f"{one.name}: {one.status}" for one in results[-1:]), file=sys.stderr, flush=True)
        found["results"] = [asdict(result) for result in results]
        if budget is not None:
            found["computed"] = totals(case, results)
        if file is not None:
            file.write_text(json.dumps(found, indent=2) + "\n")

    found["golden"] = {
        name: {part: rounded(value) for part, value in distances(case.device, getattr(torch, name)).items()}
        for name in ("float32", "bfloat16")
    }
    keep([])
    timed = time_attention(case)
    found["attention"] = [attention_figures(one, case) for one in timed]
    keep([])
    if budget is not None:
        measure_rows(case, peak, fastest(timed), budget, keep)
        return found
    results: list[Result] = []
    for name in names:
        results.append(measure(name, case, peak))
        keep(_compared(results))
    return found


def time_attention(case: Case) -> tuple[TimedBackend, ...]:
    """Each attention backend that this machine has, by itself, at the shape of the clip."""
    # On a GPU, the matrix of tokens x tokens of `_native_math` would not fit.
    names = BACKENDS if case.device.type == "cuda" else ("native", "_native_math")
    dtype = torch.bfloat16 if case.device.type == "cuda" else torch.float32
    return time_backends(names, _attention_shape(case), dtype, case.device)


def attention_figures(one: TimedBackend, case: Case) -> dict[str, Any]:
    """As JSON."""
    shape = _attention_shape(case)
    flop = 4 * shape.tokens**2 * shape.heads * shape.width
    return {
        "name": one.name,
        "ms": None if one.seconds is None else rounded(1000 * one.seconds),
        "tflops": None if one.seconds is None else rounded(flop / one.seconds / 1e12),
        "error": None if one.error is None else rounded(one.error),
        "reason": one.reason,
    }


def _attention_shape(case: Case) -> AttentionShape:
    return shape_of(case.manifest.architecture, case.width, case.height, case.num_frames)


def plan(case: Case, budget: Budget | None) -> str:
    """What a run within a budget would do, in this order, and what it is reckoned to take."""
    is_here = case.toy or case.device.type == "cuda"
    machine = detect_capabilities(case.device) if is_here else ASSUMED
    peak = matmul_peak(case.device) if is_here else ASSUMED_PEAK
    total = FIRST_SECONDS + build_seconds(case)
    lines = [f"golden figures, attention, build: {total:.0f} s (reckoned)"]
    for row in rows(case, "native"):
        seconds, reason = reckoned(row, case, peak), refused(row, machine)
        left_out = budget is not None and total + seconds > budget.seconds
        if reason:
            lines.append(f"{row.name}: refused. {reason}")
            continue
        total += 0 if left_out else seconds
        lines.append(f"{row.name}: {seconds:.0f} s (reckoned)" + (", not within the budget" * left_out))
    if is_here and (missing := missing_packages()):
        lines.append(f"Not installed here: {', '.join(missing)}.")
    return "\n".join([f"{machine.name}: in all {total:.0f} s (reckoned).", *lines])


def _compared(results: list[Result]) -> list[Result]:
    """Once `plain` is measured, with how many times longer its clip and its step take."""
    plain = next((r.figures for r in results if r.name == PLAIN and r.status == "measured"), None)
    compared: list[Result] = []
    for result in results:
        own, added = result.figures, {}
        if plain is not None and own and result.name != PLAIN:
            clip, step = plain["total_s"] / own["total_s"], plain["step_s"]["median"] / own["step_s"]["median"]
            added = {"times_as_fast_as_plain": {"clip": rounded(clip), "step": rounded(step)}}
        compared.append(replace(result, figures={**own, **added}))
    return compared


def _surroundings(case: Case) -> dict[str, Any]:
    """Machine, versions and clip."""
    machine = detect_capabilities(case.device)
    return {
        "machine": {
            "device": machine.device,
            "name": machine.name,
            "memory_gb": rounded(machine.memory / 1e9),
            "gpus": machine.gpus,
            "cores": os.cpu_count(),
            "packages": list(machine.packages),
        },
        "versions": {"python": platform.python_version(), "cuda": torch.version.cuda}
        | {library.__name__: str(library.__version__) for library in (torch, diffusers, transformers, accelerate)},
        "clip": {
            "model": case.manifest.name,
            "size": "toy" if case.toy else "full",
            "weights": "random",
            "num_frames": case.num_frames,
            "width": case.width,
            "height": case.height,
            "tokens": case.tokens,
        },
        "runs": case.runs,
        "warm_up_steps": WARM_UP_STEPS,
    }


def case_of(arguments: argparse.Namespace) -> Case:
    """What was asked for. Raises `ValueError` with a sentence for what cannot be measured here."""
    device = choose_device("auto", GeneratorUnavailable)
    models = {
        name: manifest
        for name, manifest in load_manifests().items()
        if manifest.architecture and manifest.role == "generator"
    }
    name = arguments.model or ("tiny-ati" if device.type == "cpu" else "ati")
    if name not in models:
        raise ValueError(f"There is no model '{name}'. There are: {', '.join(models)}.")
    toy = not models[name].sources
    if device.type == "cpu" and not toy and not arguments.plan:
        raise ValueError(f"'{name}' at its real size needs a GPU, and there is none here. Take tiny-ati.")
    frames, width, height, runs = (17, 112, 64, 5) if toy else (81, 832, 480, 1)
    case = Case(
        manifest=models[name],
        device=device,
        num_frames=arguments.num_frames or frames,
        width=arguments.width or width,
        height=arguments.height or height,
        steps=arguments.steps,
        runs=arguments.runs or runs,
    )
    if case.num_frames % STRIDE != 1 or not STRIDE < case.num_frames <= MAX_FRAMES:
        raise ValueError(f"A clip has 4n + 1 frames, 5 to 81, not {case.num_frames}.")
    if case.width % 16 or case.height % 16 or min(case.width, case.height) < 16:
        raise ValueError(f"The sides of a clip are multiples of 16 px, not {case.width} x {case.height}.")
    return case


def _count(text: str) -> int:
    number = int(text)
    if number < 1:
        raise argparse.ArgumentTypeError("1 or more")
    return number


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("--model", help="a manifest's name; by default ati on a GPU, else tiny-ati")
    parser.add_argument("--profile", action="append", help="one of the manifest's, or plain; by default all of them")
    parser.add_argument("--against", choices=[PLAIN], help="diffusers' own pipeline as well")
    parser.add_argument("--num-frames", type=_count)
    parser.add_argument("--width", type=_count, help="px")
    parser.add_argument("--height", type=_count, help="px")
    parser.add_argument("--steps", type=_count, help="instead of the profile's own")
    parser.add_argument("--runs", type=_count, help="clips that count; by default 1, of a toy 5")
    parser.add_argument("--budget", type=_count, help="seconds for all of it: parts instead of profiles")
    parser.add_argument("--plan", action="store_true", help="say what a run within a budget would do, and do nothing")
    parser.add_argument("--json", type=Path, help="write the figures here")
    arguments = parser.parse_args()
    of_profiles = [name for name in ("profile", "against", "steps", "runs") if getattr(arguments, name) is not None]
    if of_profiles and (arguments.budget is not None or arguments.plan):
        parser.error(f"--{of_profiles[0]} is about the clips of profiles, of which --budget and --plan run none")
    try:
        case = case_of(arguments)
        names = list(arguments.profile or case.manifest.profiles) + [PLAIN] * (arguments.against == PLAIN)
        for name in {*names} - {PLAIN}:
            profile_of(case.manifest, name)
    except (ValueError, CowError) as error:
        print(error, file=sys.stderr)
        return 2
    if do_without_ftfy():
        print("ftfy is not installed: texts are encoded without its clean-up, which takes no time.", file=sys.stderr)
    budget = None if arguments.budget is None else Budget(arguments.budget)
    if arguments.plan:
        print(plan(case, budget))
        return 0
    found = survey(case, dict.fromkeys(names), arguments.json, budget)
    print(table(found))
    return 1 if any(result["status"] == "failed" for result in found["results"]) else 0


if __name__ == "__main__":
    sys.exit(main())
