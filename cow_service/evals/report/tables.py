"""Tables as Markdown, CSV and LaTeX."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass

_LATEX = {
    **{character: f"\\{character}" for character in "&%$#_{}"},
    **{"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "±": r"$\pm$"},
}


@dataclass(frozen=True)
class Table:
    """A title, the names of columns, and rows of text. The first column is to the left, the others to the right."""

    name: str  # of its files
    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


def markdown(table: Table) -> str:
    """With pipes; cells are padded, so that it can be read as it stands."""
    lines = [tuple(map(_plain, row)) for row in (table.header, *table.rows)]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]

    def line(cells: Sequence[str]) -> str:
        padded = (cell.ljust(width) if place == 0 else cell.rjust(width) for place, (cell, width) in _places(cells))
        return f"| {' | '.join(padded)} |"

    def _places(cells: Sequence[str]) -> enumerate[tuple[str, int]]:
        return enumerate(zip(cells, widths, strict=True))

    rule = [":" + "-" * (width - 1) if place == 0 else "-" * (width - 1) + ":" for place, width in enumerate(widths)]
    return "\n".join([line(lines[0]), f"| {' | '.join(rule)} |", *map(line, lines[1:])])


def csv_text(table: Table) -> str:
    """As a spreadsheet reads it."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([table.header, *table.rows])
    return text.getvalue()


def latex(table: Table) -> str:
    """A `table` with the rules of the package booktabs."""
    columns = "l" + "r" * (len(table.header) - 1)
    body = [" & ".join(map(_latex, row)) + r" \\" for row in table.rows]
    return "\n".join(
        [
            r"\begin{table}",
            r"\centering",
            rf"\caption{{{_latex(table.title)}}}",
            rf"\begin{{tabular}}{{{columns}}}",
            r"\toprule",
            " & ".join(map(_latex, table.header)) + r" \\",
            r"\midrule",
            *body,
            r"\bottomrule",
            r"\end{tabular}",
            r"\end{table}",
            "",
        ]
    )


def _plain(text: str) -> str:
    return " ".join(text.replace("|", "\\|").split())


def _latex(text: str) -> str:
    return "".join(_LATEX.get(character, character) for character in text)
