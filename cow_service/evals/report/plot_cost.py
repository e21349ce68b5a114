"""What right answers cost: seconds, tokens and money per question."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, cast

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Annotation, Text
from matplotlib.ticker import FuncFormatter, NullFormatter
from matplotlib.transforms import Bbox

from cow_service.evals.report.plot_looks import DIM, Look, looks, percent_axis, short
from cow_service.evals.report.summary import ArmSummary
from cow_service.evals.statistics import Cost

PANEL, WIDTH = 3.3, 7.5  # inches
RANGE_FOR_LOG = 12.0  # between the dearest and the cheapest arm
# Where a label may stand, in points from its marker: near ones first.
PLACES = [
    (across * (far + 2 if down == 0 else far), down * far)
    for far in (7, 14, 24, 36, 50, 66, 84)
    for across, down in ((1, 0), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1), (0, 1), (0, -1))
]
LEADER = 16  # points: a label that is further away has a line to its marker


@dataclass(frozen=True)
class Measure:
    """One kind of cost, per question; None where it is not known."""

    axis: str
    title: str
    of: Callable[[Cost], float | None]


MEASURES = (
    Measure("Seconds per question", "time", lambda each: each.seconds / max(each.replies, 1)),
    Measure(
        "Tokens per question (input and output)",
        "tokens",
        lambda each: (each.input_tokens + each.output_tokens) / max(each.replies, 1),
    ),
    Measure(
        "Money per question (currency of the price table)",
        "money",
        lambda each: None if each.money is None else each.money / max(each.replies, 1),
    ),
)


def draw_cost(summaries: Sequence[ArmSummary]) -> Figure | None:
    """None where nothing is known to have cost anything."""
    shown = [(measure, found) for measure in MEASURES if (found := _known(summaries, measure))]
    if not shown:
        return None
    figure = Figure(figsize=(WIDTH, PANEL * len(shown) + 0.2), layout="constrained")
    canvas = FigureCanvasAgg(figure)
    grid = figure.subplots(len(shown), squeeze=False)
    styles = looks(summaries)
    labels = [_draw(axes, measure, found, styles) for axes, (measure, found) in zip(grid[:, 0], shown, strict=True)]
    canvas.draw()
    # Labels are placed once the axes have their size; they must not change it again.
    figure.set_layout_engine("none")
    for axes, found in zip(grid[:, 0], labels, strict=True):
        _place(axes, found, canvas)
    return figure


def _known(summaries: Sequence[ArmSummary], measure: Measure) -> list[tuple[ArmSummary, float]]:
    values = [(each, measure.of(each.cost)) for each in summaries]
    known = [(each, value) for each, value in values if value is not None]
    return known if any(value > 0 for _, value in known) else []


def _draw(
    axes: Axes, measure: Measure, found: Sequence[tuple[ArmSummary, float]], styles: dict[str, Look]
) -> list[Annotation]:
    labels: list[Annotation] = []
    for each, value in found:
        tpr, look = each.rates.tpr, styles[each.name]
        y = 100 * tpr.mean
        if tpr.sd is not None:
            axes.errorbar(value, y, yerr=100 * tpr.sd, color=look.colour, linewidth=1.2, capsize=2, zorder=2)
        axes.plot([value], [y], linestyle="none", zorder=3, **look.marked(8))
        label = axes.annotate(
            short(each.name, 34),
            (value, y),
            PLACES[0],
            textcoords="offset points",
            fontsize=8,
            va="center",
            zorder=4,
            arrowprops={"arrowstyle": "-", "color": DIM, "linewidth": 0.6, "shrinkA": 0, "shrinkB": 4},
        )
        labels.append(label)
    values = [value for _, value in found]
    if min(values) > 0 and max(values) / min(values) > RANGE_FOR_LOG:
        axes.set_xscale("log")
        axes.set_xlim(min(values) / 2, max(values) * 2)
    else:
        axes.set_xlim(0, 1.15 * max(values))
    # Tens and units as they are written: no powers, and no offset in the corner.
    axes.xaxis.set_major_formatter(FuncFormatter(_number))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set_xlabel(measure.axis)
    axes.set_title(f"Right answers against {measure.title}{_whiskers(found)}")
    tops = [100 * (each.rates.tpr.mean + (each.rates.tpr.sd or 0)) for each, _ in found]
    ends = [100 * (each.rates.tpr.mean - (each.rates.tpr.sd or 0)) for each, _ in found]
    percent_axis(axes, max(-3, min(ends) - 12), min(103, max(tops) + 12))
    axes.grid()
    return labels


def _number(value: float, _: int | None = None) -> str:
    return f"{value:,.6g}"


def _whiskers(found: Sequence[tuple[ArmSummary, float]]) -> str:
    return " (whiskers: SD over repeats)" if any(each.rates.tpr.sd is not None for each, _ in found) else ""


def _place(axes: Axes, labels: Sequence[Annotation], canvas: FigureCanvasAgg) -> None:
    """Each label at the first place where it covers no marker and no other label, and stays in the panel."""
    renderer = cast(Any, canvas).get_renderer()
    panel = axes.get_window_extent(renderer)
    taken = [_around(axes.transData.transform(label.xy), 6 * axes.figure.dpi / 72) for label in labels]
    for label in labels:
        best: tuple[int, tuple[float, float]] | None = None
        for place in PLACES:
            _move(label, place)
            text = _text_box(label, renderer)
            faults = sum(text.overlaps(other) for other in taken) + (not _inside(text, panel))
            if best is None or faults < best[0]:
                best = (faults, place)
            if faults == 0:
                break
        assert best is not None
        _move(label, best[1])
        taken.append(_text_box(label, renderer))


def _move(label: Annotation, place: tuple[float, float]) -> None:
    across, down = place
    label.set_position(place)
    label.set(
        ha="center" if across == 0 else "left" if across > 0 else "right",
        va="center" if down == 0 else "bottom" if down > 0 else "top",
    )
    if label.arrow_patch is not None:
        label.arrow_patch.set_visible(max(abs(across), abs(down)) > LEADER)


def _text_box(label: Annotation, renderer: Any) -> Bbox:
    """Of the text alone, without the line to the marker."""
    label.update_positions(renderer)
    return Text.get_window_extent(label, renderer)


def _around(centre: Any, reach: float) -> Bbox:
    x, y = centre
    return Bbox([[x - reach, y - reach], [x + reach, y + reach]])


def _inside(box: Bbox, panel: Bbox) -> bool:
    return box.x0 >= panel.x0 and box.x1 <= panel.x1 and box.y0 >= panel.y0 and box.y1 <= panel.y1
