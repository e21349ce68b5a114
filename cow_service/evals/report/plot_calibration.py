"""Whether what the simulation tells with 70% happens in 70% of the cases."""

from __future__ import annotations

from collections.abc import Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from cow_service.evals.report.plot_looks import COLOURS, DIM, INK, LINES, MARKERS, short
from cow_service.evals.report.summary import ArmSummary
from cow_service.evals.statistics import Calibration

SIZE = 5.2  # inches
LARGEST = 420.0  # area of the marker of the fullest bin, points²
SMALLEST = 14.0
COUNTED = 2  # curves, at most, whose markers have their counts beside them


def draw_calibration(summaries: Sequence[ArmSummary]) -> Figure | None:
    """None where no probability was told."""
    curves = _curves(summaries)
    if not curves:
        return None
    figure = Figure(figsize=(SIZE + 0.6, SIZE + 0.5 + 0.42 * len(curves)), layout="constrained")
    axes = figure.add_subplot()
    (diagonal,) = axes.plot([0, 100], [0, 100], color=DIM, linewidth=1, linestyle=(0, (1, 2)), zorder=1)
    handles = [diagonal]
    names = ["as told (perfect calibration)"]
    for place, (arms, found) in enumerate(curves):
        handles.append(_draw(axes, found, place, counted=len(curves) <= COUNTED))
        names.append(_legend(arms, found))
    axes.set_xlim(-6, 108)
    axes.set_ylim(-10, 106)
    axes.set_aspect("equal")
    axes.grid()
    axes.set_xlabel("Probability told by the simulation (%)")
    axes.set_ylabel("Happened (% of cases)")
    axes.set_title("Told probability against what happened\n(bins of 10 points; marker area: number of questions)")
    legend = figure.legend(
        handles, [str(place) for place in range(len(names))], loc="outside lower left", fontsize=8, handlelength=3
    )
    for text, name in zip(legend.get_texts(), names, strict=True):
        text.set_text(name)
    return figure


def _curves(summaries: Sequence[ArmSummary]) -> list[tuple[list[str], Calibration]]:
    """Arms that share their simulations tell the same: one curve, with all of their names."""
    curves: list[tuple[list[str], Calibration]] = []
    for each in summaries:
        if each.calibration is None:
            continue
        same = next((names for names, found in curves if found == each.calibration), None)
        if same is None:
            curves.append(([each.name], each.calibration))
        else:
            same.append(each.name)
    return curves


def _legend(arms: Sequence[str], found: Calibration) -> str:
    base = sum(each.count * each.happened for each in found.bins) / found.count
    scores = f"Brier score {found.brier:.3f}; base rate {100 * base:.0f}%, always told: {found.base_brier:.3f}"
    return f"{short(', '.join(arms), 70)}\n{scores}; n = {found.count}"


def _draw(axes: Axes, found: Calibration, place: int, counted: bool) -> Line2D:
    colour, line, marker = COLOURS[place % 7], LINES[place % 4], ("o", *MARKERS)[place % (len(MARKERS) + 1)]
    told = [100 * each.told for each in found.bins]
    happened = [100 * each.happened for each in found.bins]
    fullest = max(each.count for each in found.bins)
    areas = [max(SMALLEST, LARGEST * each.count / fullest) for each in found.bins]
    axes.plot(told, happened, color=colour, linestyle=line, linewidth=1.6, zorder=2)
    axes.scatter(
        told, happened, s=areas, marker=marker, facecolor=colour, alpha=0.75, edgecolor=INK, linewidth=0.8, zorder=3
    )
    if counted:
        for x, y, area, each in zip(told, happened, areas, found.bins, strict=True):
            # The first curve's counts stand below to the right, the second's above to the left: a curve that rises
            # runs through neither.
            side = -1 if place else 1
            offset = 0.36 * area**0.5 + 1.5
            axes.annotate(
                f"{each.count}",
                (x, y),
                (side * offset, -side * offset),
                textcoords="offset points",
                va="top" if side > 0 else "bottom",
                ha="left" if side > 0 else "right",
                fontsize=7.5,
            )
    return Line2D(
        [], [], color=colour, linestyle=line, marker=marker, markersize=7, markeredgecolor=INK, markeredgewidth=0.7
    )
