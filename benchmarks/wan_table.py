"""The figures of `wan_speed.py` as text."""

from __future__ import annotations

from typing import Any

PARTS = ("text encoder", "image encoder", "VAE encode", "condition", "denoising", "decode", "other")


def table(found: dict[str, Any]) -> str:
    """The figures, a column for each profile, and below them what has to be said in words."""
    machine, clip, versions = found["machine"], found["clip"], found["versions"]
    lines = [
        f"{clip['model']}, {clip['size']} size, random weights: {clip['num_frames']} frames, {clip['width']} x "
        f"{clip['height']} px, {clip['tokens']} tokens. Clips per profile: {found['runs']}.",
        f"{machine['device']}: {machine['name']}, {machine['memory_gb']:g} GB, {machine['cores']} cores. torch "
        f"{versions['torch']}, diffusers {versions['diffusers']}.",
        f"Matrix products in bfloat16: {found['matmul_bf16_tflops']:g} TFLOP/s.",
        *(
            f"Off the public implementation in {name}: forward pass {one['forward_pass']:.1g}, sampling "
            f"{one['sampling']:.1g}."
            for name, one in found["golden"].items()
        ),
        *(f"attention {one['name']}: {_attention_words(one)}" for one in found["attention"]),
        "",
        *(_row_lines(found) if "computed" in found else _profile_lines(found["results"])),
    ]
    return "\n".join([*lines, "", *_words(found["results"])]).rstrip()


def _profile_lines(results: list[dict[str, Any]]) -> list[str]:
    measured = [result for result in results if result["figures"]]
    rows = [["", *(result["name"] for result in measured)], *_rows([result["figures"] for result in measured])]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "  ".join([first.ljust(widths[0]), *(cell.rjust(width) for cell, width in zip(cells, widths[1:], strict=True))])
        for first, *cells in rows
    ]


def _row_lines(found: dict[str, Any]) -> list[str]:
    """A line for each row that was measured, the kernels below it, and the clips that were computed."""
    lines: list[str] = []
    for result in found["results"]:
        if result["figures"]:
            shown = (f"{key} {_value(value)}" for key, value in result["figures"].items() if key != "kernels")
            lines.append(f"{result['name']}: {', '.join(shown)}")
            lines += [
                f"    {one['share']:6.1%}  {one['ms']:9.4g} ms  {one['calls']:6d} x  {one['name']}"
                for one in result["figures"].get("kernels", ())
            ]
    clips = (
        f"{one['name']}, a clip of {one['steps']} steps: {one['total_s']:g} s (computed)" for one in found["computed"]
    )
    return [*lines, *clips]


def _value(value: Any) -> str:
    if isinstance(value, dict):
        return "(" + ", ".join(f"{key} {_value(each)}" for key, each in value.items()) + ")"
    return " and ".join(f"{each:g}" for each in value) if isinstance(value, list) else f"{value:g}"


def _attention_words(one: dict[str, Any]) -> str:
    if one["ms"] is None:
        return f"cannot be used ({one['reason']})"
    return f"{one['ms']:g} ms, {one['tflops']:g} TFLOP/s, {one['error']:.1g} off native"


def _rows(figures: list[dict[str, Any]]) -> list[list[str]]:
    """A label, then a cell for each profile. What none of them has is left out."""
    paths: list[tuple[str, tuple[str, ...]]] = [
        ("steps", ("steps",)),
        ("one step, s", ("step_s", "median")),
        ("  fastest", ("step_s", "min")),
        ("  slowest", ("step_s", "max")),
        *((f"{part}, s", ("parts_s", part)) for part in PARTS),
        ("whole clip, s", ("total_s",)),
        ("  plain / this", ("times_as_fast_as_plain", "clip")),
        ("  plain / this, one step", ("times_as_fast_as_plain", "step")),
        ("passes", ("passes",)),
        ("  not skipped", ("passes_computed",)),
        ("PFLOP", ("pflop",)),
        ("TFLOP/s", ("tflops",)),
        ("  share of the peak", ("share_of_peak",)),
        ("peak allocated, GB", ("peak_allocated_gb",)),
        ("peak reserved, GB", ("peak_reserved_gb",)),
        ("peak of the process, GB", ("peak_resident_gb",)),
        ("build, s", ("build_s",)),
        ("warm-up clip, s", ("warm_up_s",)),
    ]
    rows = [[label, *(_cell(figure, path) for figure in figures)] for label, path in paths]
    return [row for row in rows if set(row[1:]) - {"-"}]


def _cell(figures: dict[str, Any], path: tuple[str, ...]) -> str:
    value: Any = figures
    for key in path:
        value = value.get(key, {})
    return "-" if value == {} else f"{value:.4g}"


def _words(results: list[dict[str, Any]]) -> list[str]:
    lines: list[str] = []
    for result in results:
        name, figures = result["name"], result["figures"]
        lines += [f"{name}: {note}." for note in result["notes"]]
        if result["reason"]:
            lines.append(f"{name}: {result['status']}. {result['reason']}")
        if computed := figures.get("computed"):
            run = f"{name}: {figures['steps']} of its steps were run"
            lines.append(f"{run}; x {computed['steps']} steps: {computed['total_s']:g} s (computed).")
    return lines
