"""The figures of a report: colours that the colour-blind can tell apart, one marker per arm, axes without ornament."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from cow_service.evals.design import BASELINE
from cow_service.evals.items import TASKS
from cow_service.evals.report.summary import ArmSummary, Findings
from cow_service.evals.report.tables import points
from cow_service.evals.statistics import Calibration, Gain, Rates

INK, DIM, LINE, GROUND = "black", "#566360", "#d5dbd8", "white"
# Okabe and Ito 2008. Their yellow is too pale on white, and their black too like the ink: grey instead.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#777777")
MARKERS = ("s", "^", "D", "v", "P", "X", "*", "<", "p", "h", ">")  # a circle is the baseline
LONGEST_NAME = 44  # characters; longer names keep their start and their end
GAIN_ROW, GAINS_WIDTH = 0.25, 8.5  # inches
GAIN_AT, INTERVAL_AT = 1.02, 1.16  # right of the axes, whose width is 1
RATE_PANEL, NARROWEST, WIDEST = 2.1, 5.0, 11.0  # inches
PER_ARM, MARGIN = 0.19, 1.2  # inches across
LABELLED = 0.13  # inches between arms, at least, for a number at each
SQUARE = 5.2  # inches
SMALLEST, LARGEST = 14.0, 420.0  # areas of the markers of bins, points²
# Points that stand together: the rates of the arms that have any, by what they are of and by arm.
Groups = dict[str, dict[str, Rates]]
ArmStyles = Mapping[str, dict[str, Any]]  # by the name of the arm: how matplotlib draws its marker
STYLE = Path(__file__).with_suffix(".mplstyle")


def arm_styles(summaries: Sequence[ArmSummary]) -> dict[str, dict[str, Any]]:
    """Of every arm, the same in every plot: baselines are hollow."""
    found: dict[str, dict[str, Any]] = {}
    baselines = [each for each in summaries if each.arm == BASELINE]
    for number, each in enumerate(baselines):
        found[each.name] = {"marker": ("o", *MARKERS)[number % 12], "color": DIM, "markerfacecolor": GROUND}
    for number, each in enumerate(each for each in summaries if each.arm != BASELINE):
        found[each.name] = {"marker": MARKERS[number % len(MARKERS)], "color": COLOURS[number % len(COLOURS)]}
    return {each.name: {"linestyle": "none", "markersize": 7, "zorder": 3, **found[each.name]} for each in summaries}


def short(name: str, longest: int = LONGEST_NAME) -> str:
    """A name on one line, without what cannot be drawn, cut in the middle where it is long."""
    plain = " ".join("".join(each if each.isprintable() else " " for each in name).split())
    if len(plain) <= longest:
        return plain
    start = (longest - 1) // 2
    return f"{plain[:start]}…{plain[start + 1 - longest :]}"


def draw_gains(findings: Findings) -> Figure | None:
    """A forest plot of what every arm gains over the image alone, in all and by task; None if no arm has a gain."""
    groups = {"All questions": {each.name: each.gain for each in findings.arms if each.gain is not None}}
    for task in TASKS:
        groups[task.capitalize()] = {each.name: each.gains[task] for each in findings.arms if task in each.gains}
    kept = [(heading, group) for heading, group in groups.items() if group]
    if not kept:
        return None
    if len(kept) == 2:  # with one task, its group says the same as all questions
        del kept[0]
    count = sum(1 + len(group) for _, group in kept)
    figure = Figure(figsize=(GAINS_WIDTH, GAIN_ROW * count + 1.1), layout="constrained")
    axes, styles, labels = figure.add_subplot(), arm_styles(findings.arms), list[str]()
    for heading, group in kept:
        questions, scenes = (max(getattr(gain, name) for gain in group.values()) for name in ("questions", "scenes"))
        axes.axhspan(-len(labels) - 0.5, -len(labels) + 0.5, color=LINE, alpha=0.45, linewidth=0, zorder=0)
        labels.append(f"{heading} (questions: {questions}, scenes: {scenes})")
        for name, gain in group.items():
            _draw_gain(axes, -len(labels), gain, styles[name])
            labels.append(short(name))
    axes.axvline(0, color=INK, linewidth=1, zorder=1)
    axes.set_ylim(-count + 0.4, 0.7)
    edge = max(5.0, *(100 * max(abs(gain.low), abs(gain.high)) for _, group in kept for gain in group.values()))
    axes.set_xlim(-1.08 * edge, 1.08 * edge)
    axes.set_yticks(range(0, -count, -1), labels)
    axes.tick_params(axis="y", length=0)
    axes.spines["left"].set_visible(False)
    axes.grid(axis="x")
    axes.set_xlabel(f"Gain in right answers over “{BASELINE}” (percentage points)")
    title = f"Gain of each arm over the image alone (arm “{BASELINE}”)"
    figure.suptitle(title, x=0.01, ha="left", fontsize=10, weight="bold")
    dim: dict[str, Any] = {"transform": axes.get_yaxis_transform(), "fontsize": 8.5, "color": DIM}
    axes.text(GAIN_AT, 0.9, "gain, 95% interval", va="bottom", **dim)
    return figure


def _draw_gain(axes: Axes, y: float, gain: Gain, style: dict[str, Any]) -> None:
    interval = "one scene: no interval"
    if gain.scenes > 1:
        axes.plot([100 * gain.low, 100 * gain.high], [y] * 2, "|-", color=style["color"], linewidth=2.2, zorder=2)
        interval = f"{points(gain.low)} to {points(gain.high)}"
    axes.plot([100 * gain.gain], [y], **style)
    text: dict[str, Any] = {"transform": axes.get_yaxis_transform(), "va": "center", "fontsize": 8.5}
    axes.text(GAIN_AT, y, points(gain.gain), weight="bold", **text)
    axes.text(INTERVAL_AT, y, interval, **text)


def draw_rates(findings: Findings) -> Figure | None:
    """Right answers of every arm, by task and by the levels of each; None if nothing was replied to."""
    summaries = findings.arms
    if not summaries:
        return None
    panels, styles = _rate_panels(summaries), arm_styles(summaries)
    most = max(len(groups) for _, groups in panels)
    width = min(WIDEST, max(NARROWEST, most * max(1.0, PER_ARM * (len(summaries) + 1)) + MARGIN))
    names = [short(name) for name in styles]
    columns = max(1, int(11 * width / (max(map(len, names)) + 6)))  # of the legend, in which a character takes so much
    rows = 1 + len(names) // columns
    figure = Figure(figsize=(width, (RATE_PANEL + 0.1) * len(panels) + 0.25 * rows + 0.5), layout="constrained")
    lines = [Line2D([], [], **style) for style in styles.values()]
    figure.legend(lines, names, loc="outside upper left", ncols=min(columns, len(names)))
    grid = figure.subplots(len(panels), squeeze=False)
    for axes, (title, groups) in zip(grid[:, 0], panels, strict=True):
        axes.set_title(title)
        _draw_rate_panel(axes, groups, styles, (width - MARGIN) / len(groups))
    return figure


def _rate_panels(summaries: Sequence[ArmSummary]) -> list[tuple[str, Groups]]:
    """Titles and groups: by task, then each task that has several levels."""

    def of(task: str, level: str | None) -> dict[str, Rates]:
        return {each.name: each.cells[task, level] for each in summaries if (task, level) in each.cells}

    tasks = [task for task in TASKS if of(task, None)]
    by_task: Groups = {"all": {each.name: each.rates for each in summaries}} if len(tasks) > 1 else {}
    by_task |= {task: of(task, None) for task in tasks}
    several = any(each.rates.tpr.sd is not None for each in summaries)
    whiskers = "mean and SD over repeats" if several else "one repeat, so no SD"
    panels = [(f"Right answers by task (TPR): {whiskers}", by_task)]
    for task in tasks:
        levels = sorted({level for each in summaries for of_task, level in each.cells if of_task == task and level})
        if len(levels) > 1:
            panels.append((f"{task.capitalize()} by level", {level: of(task, level) for level in levels}))
    return panels


def _draw_rate_panel(axes: Axes, groups: Groups, styles: ArmStyles, space: float) -> None:
    """`space`: inches across that a group has."""
    step = 1 / (len(styles) + 1)
    for middle, rates in enumerate(groups.values()):
        for place, (name, style) in enumerate(styles.items(), 1):
            if name not in rates:
                continue
            tpr, x = rates[name].tpr, middle - 0.5 + step * place
            mean, sd = 100 * tpr.mean, 100 * (tpr.sd or 0.0)
            axes.errorbar(x, mean, yerr=sd or None, color=style["color"], linewidth=1.6, capsize=2.5, zorder=2)
            axes.plot([x], [mean], clip_on=False, **style)
            if step * space >= LABELLED:  # above the whisker and the marker, whichever is higher
                label = axes.annotate(f"{mean:.0f}", (x, mean + sd), (0, 5.5), textcoords="offset points", fontsize=7)
                label.set(ha="center", bbox={"facecolor": GROUND, "linewidth": 0, "pad": 0.4})
        if middle:
            axes.axvline(middle - 0.5, color=LINE, linewidth=1)
    counts = {name: max(each.questions for each in rates.values()) for name, rates in groups.items()}
    axes.set_xlim(-0.5, len(groups) - 0.5)
    axes.set_xticks(range(len(groups)), [f"{name}\nn = {count}" for name, count in counts.items()])
    axes.tick_params(axis="x", length=0)
    axes.set_ylim(0, 118)
    axes.set_ylabel("Right answers (%)")
    axes.grid(axis="y")
    axes.set_yticks(range(0, 101, 25))
    axes.spines["left"].set_bounds(0, 100)


def draw_calibration(findings: Findings) -> Figure | None:
    """Predicted probabilities against what happened; None if there are none."""
    curves: list[tuple[list[str], Calibration]] = []
    for each in findings.arms:  # arms that share their simulations tell the same: one curve, with all of their names
        same = next((names for names, found in curves if found == each.calibration), None)
        if same is not None:
            same.append(each.name)
        elif each.calibration is not None:
            curves.append(([each.name], each.calibration))
    return draw_curves(curves) if curves else None


def draw_curves(curves: Sequence[tuple[list[str], Calibration]]) -> Figure:
    """A reliability diagram with a curve for each calibration, whose names it has."""
    figure = Figure(figsize=(SQUARE + 0.6, SQUARE + 0.5 + 0.42 * len(curves)), layout="constrained")
    axes = figure.add_subplot()
    style: dict[str, Any] = {"color": DIM, "linewidth": 1, "linestyle": (0, (1, 2)), "zorder": 1}
    axes.plot([0, 100], [0, 100], label="as predicted (perfect calibration)", **style)
    for place, (arms, found) in enumerate(curves):
        base = sum(each.count * each.happened for each in found.bins) / found.count
        scores = f"Brier score {found.brier:.3f}; base rate {100 * base:.0f}%, always predicted: {found.base_brier:.3f}"
        colour = COLOURS[place % len(COLOURS)]
        told, happened = [100 * each.told for each in found.bins], [100 * each.happened for each in found.bins]
        fullest = max(each.count for each in found.bins)
        areas = [max(SMALLEST, LARGEST * each.count / fullest) for each in found.bins]
        label = f"{short(', '.join(arms), 70)}\n{scores}; n = {found.count}"
        axes.plot(told, happened, color=colour, linewidth=1.6, zorder=2, label=label)
        dots: dict[str, Any] = {"facecolor": colour, "edgecolor": INK, "linewidth": 0.8, "alpha": 0.75}
        axes.scatter(told, happened, s=areas, marker=MARKERS[place % len(MARKERS)], zorder=3, **dots)
    axes.set(xlim=(-6, 108), ylim=(-10, 106), aspect="equal")
    axes.grid()
    axes.set_xlabel("Probability predicted by the simulation (%)")
    axes.set_ylabel("Happened (% of cases)")
    axes.set_title("Predicted probability against what happened\n(bins of 10 points; marker area: number of questions)")
    figure.legend(loc="outside lower left", fontsize=8, handlelength=3)
    return figure


DRAWINGS: dict[str, Callable[[Findings], Figure | None]] = {
    "gains": draw_gains,
    "rates": draw_rates,
    "calibration": draw_calibration,
}
