"""The page of a report: one HTML file that opens without a server, with every question, picture and reply."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

from jinja2 import Environment, StrictUndefined
from markupsafe import Markup

from cow_service.evals.report.page_data import Pictures, page_arms, page_data, script_json
from cow_service.evals.report.page_svg import inline_svg
from cow_service.evals.report.summary import ArmSummary
from cow_service.evals.runs import Run

PAGE = "index.html"
SCRIPTS = ("data.js", "filters.js", "cards.js", "main.js")
STYLES = ("page.css", "cards.css")
TITLES = {
    "gains": "Gains over the image alone",
    "rates": "Right answers by task and level",
    "calibration": "Calibration of the told probabilities",
    "cost": "Right answers against their cost",
}


def write_page(
    folder: Path,
    runs: Sequence[Run],
    summaries: Sequence[ArmSummary],
    plots: Sequence[Path] = (),
    sections: Sequence[tuple[str, str]] = (),
    copy_pictures: bool = False,
) -> Path:
    """Writes `index.html` into the folder and returns its path.

    `plots` are files that `write_plots` wrote; those that are SVG stand in the page. `sections` are headings and plain
    texts, shown after the summary. The page refers to the pictures where the runs have them; with `copy_pictures` they
    are copied beside it, so that the folder can be sent as a whole.
    """
    folder.mkdir(parents=True, exist_ok=True)
    arms = page_arms(runs, summaries)
    core, replies = page_data(runs, arms, Pictures(folder, runs, copy_pictures))
    style, script = _joined(STYLES), "'use strict';\n" + _joined(SCRIPTS)
    template = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    template.filters |= {"percent": _percent, "points": _points, "p": _p}
    text = template.from_string(_source("template.html")).render(
        policy=_policy(style, script),
        style=Markup(style),
        script=Markup(script),
        core=Markup(script_json(core)),
        replies=[Markup(script_json(block)) for block in replies],
        runs=runs,
        arms=arms,
        items=len(core["items"]),
        summaries=summaries,
        against={each.name: arms[each.against].name for each in arms if each.against is not None},
        gains={(each.name, of.task): of.gain for each in summaries for of in each.gains},
        sections=sections,
        plots=[
            (TITLES.get(path.stem, path.stem), Markup(inline_svg(path, TITLES.get(path.stem, path.stem))))
            for path in plots
            if path.suffix == ".svg"
        ],
    )
    partial = folder / f".{PAGE}.partial"
    # A carriage return would change the text that the policy's digests are of.
    partial.write_text(text, encoding="utf-8", errors="replace", newline="\n")
    return partial.replace(folder / PAGE)


def _source(name: str) -> str:
    return (files("cow_service.evals.report") / "page" / name).read_text(encoding="utf-8")


def _joined(names: Sequence[str]) -> str:
    return "".join(_source(name) for name in names)


def _policy(style: str, script: str) -> str:
    """Nothing but this script, this style, and pictures beside the page: whatever a reply says, it does nothing."""

    def digest(text: str) -> str:
        return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"

    rules = {
        "default-src": "'none'",
        "img-src": "'self' file: data:",
        "style-src": digest(style),
        "script-src": digest(script),
        "base-uri": "'none'",
        "form-action": "'none'",
    }
    return "; ".join(f"{name} {value}" for name, value in rules.items())


def _percent(share: float | None, digits: int = 1) -> str:
    return "" if share is None else f"{100 * share:.{digits}f}"


def _points(share: float) -> str:
    return f"{100 * share:+.1f}".replace("-", "−")


def _p(value: Any) -> str:
    if value is None:
        return ""
    return "< 0.001" if value < 0.001 else f"{value:.3f}"
