"""A forest plot: what every arm gains over the image alone, on all questions and on each task."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from cow_service.evals.items import TASKS
from cow_service.evals.report.plot_looks import DIM, INK, LINE, Look, looks, points, short
from cow_service.evals.report.summary import BASELINE, ArmSummary
from cow_service.evals.statistics import Gain

ROW, WIDTH = 0.25, 8.5  # inches
GAIN_AT, INTERVAL_AT = 1.02, 1.16  # right of the axes, whose width is 1


@dataclass(frozen=True)
class Row:
    """One line of the plot: the heading of a group, or the gain of an arm."""

    text: str
    look: Look | None = None
    gain: Gain | None = None


def draw_gains(summaries: Sequence[ArmSummary]) -> Figure | None:
    """None where no arm has a gain."""
    rows = _rows(summaries)
    if not rows:
        return None
    figure = Figure(figsize=(WIDTH, ROW * len(rows) + 1.1), layout="constrained")
    axes = figure.add_subplot()
    for place, row in enumerate(rows):
        _draw(axes, -place, row)
    axes.axvline(0, color=INK, linewidth=1, zorder=1)
    axes.set_ylim(-len(rows) + 0.4, 0.7)
    edge = max(5.0, *(100 * abs(end) for row in rows if row.gain for end in (row.gain.low, row.gain.high)))
    axes.set_xlim(-1.08 * edge, 1.08 * edge)
    axes.set_yticks([-place for place in range(len(rows))], [row.text for row in rows])
    for label, row in zip(axes.get_yticklabels(), rows, strict=True):
        label.set_fontweight("normal" if row.gain else "bold")
    axes.tick_params(axis="y", length=0)
    axes.spines["left"].set_visible(False)
    axes.grid(axis="x")
    axes.set_xlabel(f"Gain in right answers over “{BASELINE}” (percentage points)")
    figure.suptitle(
        f"Gain of each arm over the image alone (arm “{BASELINE}”)", x=0.01, ha="left", fontsize=10, weight="bold"
    )
    axes.text(
        GAIN_AT, 0.9, "gain, 95% interval", transform=axes.get_yaxis_transform(), fontsize=8.5, color=DIM, va="bottom"
    )
    return figure


def _rows(summaries: Sequence[ArmSummary]) -> list[Row]:
    styles = looks(summaries)
    groups = {"All questions": [(each, each.gain) for each in summaries]}
    for task in TASKS:
        own = [(each, next((found.gain for found in each.gains if found.task == task), None)) for each in summaries]
        groups[task.capitalize()] = own
    with_gain = {
        heading: [(each, gain) for each, gain in group if gain is not None] for heading, group in groups.items()
    }
    # With one task, its group would say the same again.
    kept = {heading: group for heading, group in with_gain.items() if group}
    if len(kept) == 2:
        kept = {list(kept)[1]: list(kept.values())[1]}
    rows: list[Row] = []
    for heading, group in kept.items():
        questions = max(gain.questions for _, gain in group)
        scenes = max(gain.scenes for _, gain in group)
        rows.append(Row(f"{heading} ({questions} questions, {scenes} scene{'s' if scenes > 1 else ''})"))
        rows += [Row(short(each.name), styles[each.name], gain) for each, gain in group]
    return rows


def _draw(axes: Axes, height: float, row: Row) -> None:
    across = axes.get_yaxis_transform()
    if row.gain is None or row.look is None:
        axes.axhspan(height - 0.5, height + 0.5, color=LINE, alpha=0.45, linewidth=0, zorder=0)
        return
    gain = row.gain
    if gain.scenes > 1:
        axes.plot([100 * gain.low, 100 * gain.high], [height] * 2, color=row.look.colour, linewidth=2.2, zorder=2)
        axes.plot([100 * gain.low, 100 * gain.high], [height] * 2, "|", color=row.look.colour, markersize=7, zorder=2)
        interval = f"{points(gain.low)} to {points(gain.high)}"
    else:
        interval = "one scene: no interval"
    axes.plot([100 * gain.gain], [height], linestyle="none", zorder=3, **row.look.marked())
    axes.text(GAIN_AT, height, points(gain.gain), transform=across, va="center", weight="bold", fontsize=8.5)
    axes.text(INTERVAL_AT, height, interval, transform=across, va="center", fontsize=8.5)
