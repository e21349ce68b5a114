"""The figures of a report: colours that the colour-blind can tell apart, one marker per arm, axes without ornament."""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import NullFormatter, StrMethodFormatter

from cow_service.evals.design import BASELINE
from cow_service.evals.items import TASKS
from cow_service.evals.report.summary import ArmSummary, Dose, Findings
from cow_service.evals.report.tables import points
from cow_service.evals.statistics import Calibration, Cost, Gain, Rates, Spread

INK, DIM, LINE, GROUND = "black", "#566360", "#d5dbd8", "white"
# Okabe and Ito 2008. Their yellow is too pale on white, and their black too like the ink: grey instead.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#777777")
MARKERS = ("s", "^", "D", "v", "P", "X", "*", "<", "p", "h", ">")  # a circle is the baseline
LONGEST_NAME = 44  # characters; longer names keep their start and their end
LEGEND_WIDTH = 110  # characters of a row of the legend
ROUND_FIRST = ("o", *MARKERS)
GAIN_ROW, GAINS_WIDTH = 0.25, 8.5  # inches
GAIN_AT, INTERVAL_AT = 1.02, 1.16  # right of the axes, whose width is 1
RATE_PANEL, NARROWEST, WIDEST = 2.1, 5.0, 11.0  # inches
PER_ARM, MARGIN = 0.19, 1.2  # inches across
LABELLED = 0.13  # inches between arms, at least, for a number at each
SQUARE = 5.2  # inches
LARGEST = 420.0  # area of the marker of the fullest bin, points²
SMALLEST = 14.0
COST_PANEL, COST_WIDTH = 2.9, 7.5  # inches
RANGE_FOR_LOG = 12.0  # between the dearest and the cheapest arm
# Points that stand together: the rates of the arms that have any, by what they are of and by arm.
Groups = dict[str, dict[str, Rates]]
MEASURES: dict[str, tuple[str, Callable[[Cost], float | None]]] = {  # by title: axis, and a sum over all replies
    "time": ("Seconds per question", lambda cost: cost.seconds),
    "tokens": ("Tokens per question (input and output)", lambda cost: float(cost.input_tokens + cost.output_tokens)),
    "money": ("Money per question (currency of the price table)", lambda cost: cost.money),
}
STYLE = Path(__file__).with_suffix(".mplstyle")


@dataclass(frozen=True)
class ArmStyle:
    """How one arm is drawn, the same in every plot."""

    colour: str
    marker: str
    hollow: bool  # as the baseline is

    def marked(self, size: float = 7.0) -> dict[str, Any]:
        """Options of matplotlib that draw its marker."""
        return {
            "linestyle": "none",
            "marker": self.marker,
            "markersize": size,
            "markerfacecolor": GROUND if self.hollow else self.colour,
            "markeredgecolor": self.colour if self.hollow else INK,
            "markeredgewidth": 1.4 if self.hollow else 0.7,
            "zorder": 3,
        }


def arm_styles(summaries: Sequence[ArmSummary]) -> dict[str, ArmStyle]:
    """Of every arm, by its name in the report."""
    found: dict[str, ArmStyle] = {}
    drawn: Counter[bool] = Counter()  # baselines, and other arms
    for each in summaries:
        hollow = each.arm == BASELINE
        number, markers = drawn[hollow], ROUND_FIRST if hollow else MARKERS
        colour = DIM if hollow else COLOURS[number % len(COLOURS)]
        found[each.name] = ArmStyle(colour, markers[number % len(markers)], hollow)
        drawn[hollow] += 1
    return found


def short(name: str, longest: int = LONGEST_NAME) -> str:
    """A name on one line, without what cannot be drawn, cut in the middle where it is long."""
    plain = " ".join("".join(each if each.isprintable() else " " for each in name).split())
    if len(plain) <= longest:
        return plain
    start = (longest - 1) // 2
    return f"{plain[:start]}…{plain[start + 1 - longest :]}"


def _add_arm_legend(figure: Figure, styles: Mapping[str, ArmStyle], width: float) -> None:
    """Above the panels, in as many columns as fit a figure of this width in inches."""
    lines, names = [Line2D([], [], **style.marked()) for style in styles.values()], list(map(short, styles))
    fitting = int(width * LEGEND_WIDTH / 10 / (max(map(len, names)) + 6))
    columns = min(max(1, fitting), len(names))
    figure.legend(lines, names, loc="outside upper left", ncols=columns, columnspacing=1.4, handletextpad=0.3)


def _draw_right_answers(axes: Axes, x: float, tpr: Spread, style: ArmStyle, size: float, **whisker: Any) -> None:
    """The share of right answers of an arm, with its deviation over the repeats."""
    if tpr.sd is not None:
        axes.errorbar(x, 100 * tpr.mean, yerr=100 * tpr.sd, color=style.colour, zorder=2, **whisker)
    axes.plot([x], [100 * tpr.mean], clip_on=False, **style.marked(size))


def _percent_axis(axes: Axes, low: float, high: float) -> None:
    axes.set_ylim(low, high)
    axes.set_ylabel("Right answers (%)")
    axes.grid(axis="y")


def draw_gains(findings: Findings) -> Figure | None:
    """A forest plot of what every arm gains over the image alone, in all and by task; None if no arm has a gain."""
    summaries, styles = findings.arms, arm_styles(findings.arms)
    groups = {"All questions": [(each.name, each.gain) for each in summaries if each.gain is not None]}
    for task in TASKS:
        groups[task.capitalize()] = [(each.name, each.gains[task]) for each in summaries if task in each.gains]
    kept = [(heading, group) for heading, group in groups.items() if group]
    if not kept:
        return None

    # Rows of the plot: headings of groups, and below each the gains of its arms.
    rows: list[tuple[str, ArmStyle | None, Gain | None]] = []
    # With one task, its group says the same as all questions.
    for heading, group in kept[1:] if len(kept) == 2 else kept:
        questions = max(gain.questions for _, gain in group)
        scenes = max(gain.scenes for _, gain in group)
        rows.append((f"{heading} (questions: {questions}, scenes: {scenes})", None, None))
        rows += [(short(name), styles[name], gain) for name, gain in group]

    figure = Figure(figsize=(GAINS_WIDTH, GAIN_ROW * len(rows) + 1.1), layout="constrained")
    axes = figure.add_subplot()
    for place, (_, style, gain) in enumerate(rows):
        if style is None or gain is None:
            axes.axhspan(-place - 0.5, -place + 0.5, color=LINE, alpha=0.45, linewidth=0, zorder=0)
            continue
        interval = "one scene: no interval"
        if gain.scenes > 1:
            ends = [100 * gain.low, 100 * gain.high]
            axes.plot(ends, [-place] * 2, "|-", color=style.colour, linewidth=2.2, markersize=7, zorder=2)
            interval = f"{points(gain.low)} to {points(gain.high)}"
        axes.plot([100 * gain.gain], [-place], **style.marked())
        text: dict[str, Any] = {"transform": axes.get_yaxis_transform(), "va": "center", "fontsize": 8.5}
        axes.text(GAIN_AT, -place, points(gain.gain), weight="bold", **text)
        axes.text(INTERVAL_AT, -place, interval, **text)
    axes.axvline(0, color=INK, linewidth=1, zorder=1)
    axes.set_ylim(-len(rows) + 0.4, 0.7)
    edge = max(5.0, *(100 * abs(end) for _, _, gain in rows if gain for end in (gain.low, gain.high)))
    axes.set_xlim(-1.08 * edge, 1.08 * edge)
    axes.set_yticks([-place for place in range(len(rows))], [text for text, _, _ in rows])
    for label, (_, _, gain) in zip(axes.get_yticklabels(), rows, strict=True):
        label.set_fontweight("normal" if gain else "bold")
    axes.tick_params(axis="y", length=0)
    axes.spines["left"].set_visible(False)
    axes.grid(axis="x")
    axes.set_xlabel(f"Gain in right answers over “{BASELINE}” (percentage points)")
    title = f"Gain of each arm over the image alone (arm “{BASELINE}”)"
    figure.suptitle(title, x=0.01, ha="left", fontsize=10, weight="bold")
    dim: dict[str, Any] = {"transform": axes.get_yaxis_transform(), "fontsize": 8.5, "color": DIM}
    axes.text(GAIN_AT, 0.9, "gain, 95% interval", va="bottom", **dim)
    return figure


def draw_doses(findings: Findings) -> Figure | None:
    """The gain over the error of the path that is shown; None if frames of no two errors were shown."""
    by_run: dict[str, list[Dose]] = {}
    for each in findings.doses:
        by_run.setdefault(each.name.rpartition(", ")[0], []).append(each)
    by_run = {name: sorted(doses, key=lambda dose: dose.error) for name, doses in by_run.items() if len(doses) > 1}
    if not by_run:
        return None
    figure = Figure(figsize=(SQUARE + 1.4, SQUARE - 1.4), layout="constrained")
    axes = figure.add_subplot()
    for place, (name, doses) in enumerate(by_run.items()):
        colour, marker = COLOURS[place % len(COLOURS)], ROUND_FIRST[place % len(ROUND_FIRST)]
        errors, gains = [each.error for each in doses], [100 * each.gain.gain for each in doses]
        reach = [[100 * (each.gain.gain - each.gain.low), 100 * (each.gain.high - each.gain.gain)] for each in doses]
        ends: Any = list(zip(*reach, strict=True))
        options: dict[str, Any] = {"color": colour, "marker": marker, "capsize": 3, "markeredgecolor": INK}
        axes.errorbar(errors, gains, yerr=ends, label=short(name) if name else None, **options)
        for each, gain in zip(doses, gains, strict=True):
            if each.path_error is not None:
                text = f"{100 * each.path_error:.1f}%"
                axes.annotate(text, (each.error, gain), (6, 6), textcoords="offset points", fontsize=7.5, color=DIM)
    axes.axhline(0, color=INK, linewidth=1, zorder=1)
    axes.grid()
    axes.set_xlabel("Error of the path shown, in units of the simulation's own (small print: % of the width)")
    axes.set_ylabel(f"Gain over “{BASELINE}” (percentage points)")
    axes.set_title("What frames are worth whose path is off by so much (95% intervals)")
    if any(by_run):
        axes.legend()
    return figure


def draw_rates(findings: Findings) -> Figure | None:
    """Right answers of every arm, by task and by the levels of each; None if nothing was replied to."""
    summaries = findings.arms
    if not summaries:
        return None
    panels, styles = _rate_panels(summaries), arm_styles(summaries)
    most = max(len(groups) for _, groups in panels)
    width = min(WIDEST, max(NARROWEST, most * max(1.0, PER_ARM * (len(summaries) + 1)) + MARGIN))
    rows = 1 + len(styles) * (max(map(len, styles)) + 6) // round(11 * width)
    figure = Figure(figsize=(width, (RATE_PANEL + 0.1) * len(panels) + 0.25 * rows + 0.5), layout="constrained")
    _add_arm_legend(figure, styles, width)
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


def _draw_rate_panel(axes: Axes, groups: Groups, styles: dict[str, ArmStyle], space: float) -> None:
    """`space`: inches across that a group has."""
    step = 1 / (len(styles) + 1)
    for middle, rates in enumerate(groups.values()):
        for place, (name, style) in enumerate(styles.items(), 1):
            if name not in rates:
                continue
            tpr, x = rates[name].tpr, middle - 0.5 + step * place
            _draw_right_answers(axes, x, tpr, style, 6.5, linewidth=1.6, capsize=2.5)
            if step * space >= LABELLED:
                # Above the whisker and the marker, whichever is higher.
                top = 100 * (tpr.mean + (tpr.sd or 0.0))
                text = f"{100 * tpr.mean:.0f}"
                label = axes.annotate(text, (x, top), (0, 5.5), textcoords="offset points", fontsize=7)
                label.set(ha="center", bbox={"facecolor": GROUND, "linewidth": 0, "pad": 0.4})
        if middle:
            axes.axvline(middle - 0.5, color=LINE, linewidth=1)
    counts = {name: max(each.questions for each in rates.values()) for name, rates in groups.items()}
    axes.set_xlim(-0.5, len(groups) - 0.5)
    axes.set_xticks(range(len(groups)), [f"{name}\nn = {count}" for name, count in counts.items()])
    axes.tick_params(axis="x", length=0)
    _percent_axis(axes, 0, 118)
    axes.set_yticks(range(0, 101, 25))
    axes.spines["left"].set_bounds(0, 100)
    axes.axhline(100, color=DIM, linewidth=0.5)


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
    (diagonal,) = axes.plot([0, 100], [0, 100], color=DIM, linewidth=1, linestyle=(0, (1, 2)), zorder=1)
    lines, names = [diagonal], ["as predicted (perfect calibration)"]
    for place, (arms, found) in enumerate(curves):
        base = sum(each.count * each.happened for each in found.bins) / found.count
        scores = f"Brier score {found.brier:.3f}; base rate {100 * base:.0f}%, always predicted: {found.base_brier:.3f}"
        colour, marker = COLOURS[place % len(COLOURS)], ROUND_FIRST[place % len(ROUND_FIRST)]
        told = [100 * each.told for each in found.bins]
        happened = [100 * each.happened for each in found.bins]
        fullest = max(each.count for each in found.bins)
        areas = [max(SMALLEST, LARGEST * each.count / fullest) for each in found.bins]
        axes.plot(told, happened, color=colour, linewidth=1.6, zorder=2)
        dots: dict[str, Any] = {"marker": marker, "facecolor": colour, "edgecolor": INK, "linewidth": 0.8}
        axes.scatter(told, happened, s=areas, zorder=3, alpha=0.75, **dots)
        edge: dict[str, Any] = {"markersize": 7, "markeredgecolor": INK, "markeredgewidth": 0.7}
        lines.append(Line2D([], [], color=colour, marker=marker, **edge))
        names.append(f"{short(', '.join(arms), 70)}\n{scores}; n = {found.count}")
    axes.set(xlim=(-6, 108), ylim=(-10, 106), aspect="equal")
    axes.grid()
    axes.set_xlabel("Probability predicted by the simulation (%)")
    axes.set_ylabel("Happened (% of cases)")
    axes.set_title("Predicted probability against what happened\n(bins of 10 points; marker area: number of questions)")
    figure.legend(lines, names, loc="outside lower left", fontsize=8, handlelength=3)
    return figure


def draw_cost(findings: Findings) -> Figure | None:
    """Right answers against their cost; None if nothing is known to have cost anything."""
    shown: dict[str, list[tuple[ArmSummary, float]]] = {}
    for title, (_, sum_of) in MEASURES.items():
        known = [(each, sum_of(each.cost)) for each in findings.arms]
        means = [(each, value / max(each.cost.replies, 1)) for each, value in known if value is not None]
        if any(mean > 0 for _, mean in means):
            shown[title] = means
    if not shown:
        return None
    figure = Figure(figsize=(COST_WIDTH, COST_PANEL * len(shown) + 0.6), layout="constrained")
    grid = figure.subplots(len(shown), squeeze=False)
    styles = arm_styles(findings.arms)
    _add_arm_legend(figure, styles, COST_WIDTH)
    for axes, (title, means) in zip(grid[:, 0], shown.items(), strict=True):
        for each, mean in means:
            _draw_right_answers(axes, mean, each.rates.tpr, styles[each.name], 8, linewidth=1.2, capsize=2)
        cheapest, dearest = min(mean for _, mean in means), max(mean for _, mean in means)
        if cheapest > 0 and dearest / cheapest > RANGE_FOR_LOG:
            axes.set_xscale("log")
            axes.set_xlim(cheapest / 2, dearest * 2)
        else:
            axes.set_xlim(0, 1.15 * dearest)
        # Tens and units as they are written: no powers, and no offset in the corner.
        axes.xaxis.set_major_formatter(StrMethodFormatter("{x:,.6g}"))
        axes.xaxis.set_minor_formatter(NullFormatter())
        axes.set_xlabel(MEASURES[title][0])
        spreads = [each.rates.tpr for each, _ in means]
        whiskers = " (whiskers: SD over repeats)" if any(tpr.sd is not None for tpr in spreads) else ""
        axes.set_title(f"Right answers against {title}{whiskers}")
        lowest = min(100 * (tpr.mean - (tpr.sd or 0)) for tpr in spreads)
        highest = max(100 * (tpr.mean + (tpr.sd or 0)) for tpr in spreads)
        _percent_axis(axes, max(-3, lowest - 12), min(103, highest + 12))
        axes.grid(visible=True)
    return figure


DRAWINGS: dict[str, Callable[[Findings], Figure | None]] = {
    "gains": draw_gains,
    "doses": draw_doses,
    "rates": draw_rates,
    "calibration": draw_calibration,
    "cost": draw_cost,
}
