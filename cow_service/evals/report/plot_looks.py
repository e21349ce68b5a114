"""How the plots look: colours that the colour-blind can tell apart, one marker per arm, and axes without ornament."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from cow_service.evals.report.summary import BASELINE, ArmSummary

# The page replaces these four by the colours of its light or dark style; nothing else may use them.
INK, DIM, LINE, GROUND = "#17211f", "#566360", "#d5dbd8", "#fefefe"
# Okabe and Ito 2008. Their yellow is too pale on white, and their black too dark on a dark page: grey instead.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#777777")
MARKERS = ("s", "^", "D", "v", "P", "X", "*", "<", "p", "h", ">")  # a circle is the baseline
LINES = ("-", "--", "-.", ":")
LONGEST_NAME = 44  # characters; longer names keep their start and their end
LEGEND_WIDTH = 110  # characters of a row of the legend
STYLE = {
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans", "Verdana", "sans-serif"],
    "font.size": 9,
    "axes.titlesize": 10,
    "axes.titlelocation": "left",
    "axes.titleweight": "bold",
    "axes.labelcolor": INK,
    "axes.edgecolor": DIM,
    "axes.linewidth": 0.8,
    "axes.facecolor": GROUND,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "figure.facecolor": GROUND,
    "grid.color": LINE,
    "grid.linewidth": 0.7,
    "text.color": INK,
    "text.parse_math": False,  # a name with two dollar signs is a name
    "xtick.color": DIM,
    "xtick.labelcolor": INK,
    "ytick.color": DIM,
    "ytick.labelcolor": INK,
    "legend.frameon": False,
    "svg.fonttype": "none",  # text stays text: it can be searched, and read aloud
    "axes.axisbelow": True,
}


@dataclass(frozen=True)
class Look:
    """Of one arm, the same in every plot."""

    colour: str
    marker: str
    line: str
    face: str  # the baseline is hollow

    def marked(self, size: float = 7.0) -> dict[str, Any]:
        """Options of matplotlib that draw its marker."""
        edge = self.colour if self.face == GROUND else INK
        return {
            "marker": self.marker,
            "markersize": size,
            "markerfacecolor": self.face,
            "markeredgecolor": edge,
            "markeredgewidth": 1.4 if self.face == GROUND else 0.7,
        }


def looks(summaries: Sequence[ArmSummary]) -> dict[str, Look]:
    """Of every arm, by its name in the report."""
    found: dict[str, Look] = {}
    others = baselines = 0
    for each in summaries:
        if each.arm == BASELINE:
            marker = ("o", *MARKERS)[baselines % (len(MARKERS) + 1)]
            found[each.name] = Look(DIM, marker, LINES[baselines % len(LINES)], GROUND)
            baselines += 1
        else:
            colour = COLOURS[others % len(COLOURS)]
            found[each.name] = Look(colour, MARKERS[others % len(MARKERS)], LINES[others % len(LINES)], colour)
            others += 1
    return found


def short(name: str, longest: int = LONGEST_NAME) -> str:
    """A name on one line, without what cannot be drawn, cut in the middle where it is long."""
    plain = " ".join("".join(each if each.isprintable() else " " for each in name).split())
    if len(plain) <= longest:
        return plain
    start = (longest - 1) // 2
    return f"{plain[:start]}…{plain[start + 1 - longest :]}"


def points(share: float) -> str:
    """A difference of shares, in percentage points, with its sign."""
    return f"{100 * share:+.1f}".replace("-", "−").replace("+0.0", "0.0").replace("−0.0", "0.0")


def legend(figure: Figure, entries: Sequence[tuple[str, Look]], width: float) -> None:
    """Above the panels, in as many columns as fit a figure of this width in inches."""
    names = [short(name) for name, _ in entries]
    columns = max(1, int(width * LEGEND_WIDTH / 10 / (max(map(len, names)) + 6)))
    handles = [Line2D([], [], linestyle="none", **look.marked()) for _, look in entries]
    drawn = figure.legend(
        handles,
        [str(place) for place in range(len(names))],
        loc="outside upper left",
        ncols=min(columns, len(names)),
        columnspacing=1.4,
        handletextpad=0.3,
    )
    # Set afterwards: matplotlib leaves out an entry whose name starts with an underscore.
    for text, name in zip(drawn.get_texts(), names, strict=True):
        text.set_text(name)


def percent_axis(axes: Axes, low: float = 0.0, high: float = 100.0) -> None:
    """Right answers on the y axis, with lines to read them by."""
    axes.set_ylim(low, high)
    axes.set_ylabel("Right answers (%)")
    axes.grid(axis="y")
