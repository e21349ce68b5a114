"""How many questions each arm answers rightly: by task, and by the levels of each task."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from cow_service.evals.items import TASKS, Task
from cow_service.evals.report.plot_looks import DIM, GROUND, LINE, Look, legend, looks, percent_axis
from cow_service.evals.report.summary import ArmSummary
from cow_service.evals.statistics import Rates

PANEL, NARROWEST, WIDEST = 2.1, 5.0, 11.0  # inches
PER_ARM, MARGIN = 0.19, 1.2  # inches across
LABELLED = 0.13  # inches between arms, at least, for a number at each


@dataclass(frozen=True)
class Group:
    """Points that stand together: what they are of, and the rates of the arms that have any."""

    name: str
    rates: dict[str, Rates]

    @property
    def label(self) -> str:
        """With how many questions it is of."""
        return f"{self.name}\nn = {max(each.questions for each in self.rates.values())}"


@dataclass(frozen=True)
class Panel:
    """Groups that are compared with each other."""

    title: str
    groups: tuple[Group, ...]


def draw_rates(summaries: Sequence[ArmSummary]) -> Figure | None:
    """None where nothing was replied to."""
    if not summaries:
        return None
    panels, styles = _panels(summaries), looks(summaries)
    most = max(len(panel.groups) for panel in panels)
    width = min(WIDEST, max(NARROWEST, most * max(1.0, PER_ARM * (len(summaries) + 1)) + MARGIN))
    rows = 1 + len(summaries) * (max(len(each.name) for each in summaries) + 6) // round(11 * width)
    figure = Figure(figsize=(width, (PANEL + 0.1) * len(panels) + 0.25 * rows + 0.5), layout="constrained")
    legend(figure, list(styles.items()), width)
    grid = figure.subplots(len(panels), squeeze=False)
    for axes, panel in zip(grid[:, 0], panels, strict=True):
        _draw(axes, panel, styles, (width - MARGIN) / len(panel.groups))
    return figure


def _panels(summaries: Sequence[ArmSummary]) -> list[Panel]:
    """By task, then each task that has several levels."""
    tasks: list[Task] = [task for task in TASKS if any(cell.task == task for each in summaries for cell in each.cells)]
    by_task = [_group(summaries, task, None, task) for task in tasks]
    if len(tasks) > 1:
        by_task.insert(0, Group("all", {each.name: each.rates for each in summaries}))
    several = any(each.rates.tpr.sd is not None for each in summaries)
    whiskers = ": mean and SD over repeats" if several else ": one repeat, so no SD"
    panels = [Panel(f"Right answers by task (TPR){whiskers}", tuple(by_task))]
    for task in tasks:
        found = {cell.level for each in summaries for cell in each.cells if cell.task == task and cell.level}
        if len(found) > 1:
            groups = tuple(_group(summaries, task, level, level) for level in sorted(found))
            panels.append(Panel(f"{task.capitalize()} by level", groups))
    return panels


def _group(summaries: Sequence[ArmSummary], task: Task, level: str | None, name: str) -> Group:
    return Group(
        name,
        {
            each.name: cell.rates
            for each in summaries
            for cell in each.cells
            if cell.task == task and cell.level == level
        },
    )


def _draw(axes: Axes, panel: Panel, styles: dict[str, Look], space: float) -> None:
    """`space`: inches across that a group has."""
    step = 1 / (len(styles) + 1)
    for middle, group in enumerate(panel.groups):
        for place, (name, look) in enumerate(styles.items()):
            if name not in group.rates:
                continue
            tpr = group.rates[name].tpr
            x, y = middle - 0.5 + step * (place + 1), 100 * tpr.mean
            reach = 100 * (tpr.sd or 0.0)
            if tpr.sd is not None:
                axes.errorbar(x, y, yerr=reach, color=look.colour, linewidth=1.6, capsize=2.5, zorder=2)
            axes.plot([x], [y], linestyle="none", zorder=3, clip_on=False, **look.marked(6.5))
            if step * space >= LABELLED:
                # Above the whisker and the marker, whichever is higher.
                label = axes.annotate(f"{y:.0f}", (x, y + reach), (0, 5.5), textcoords="offset points", fontsize=7)
                label.set(ha="center", bbox={"facecolor": GROUND, "linewidth": 0, "pad": 0.4})
        if middle:
            axes.axvline(middle - 0.5, color=LINE, linewidth=1)
    axes.set_xlim(-0.5, len(panel.groups) - 0.5)
    axes.set_xticks(range(len(panel.groups)), [group.label for group in panel.groups])
    axes.tick_params(axis="x", length=0)
    axes.set_title(panel.title)
    percent_axis(axes, 0, 118)
    axes.set_yticks(range(0, 101, 25))
    axes.spines["left"].set_bounds(0, 100)
    axes.axhline(100, color=DIM, linewidth=0.5)
