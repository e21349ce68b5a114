"""The page of a report: one HTML file that opens without a server, with every question, picture and reply.

What it shows stands in it as JSON: replies and pictures, which come again, are named by their place.
"""

import base64
import hashlib
import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

from jinja2 import Environment, StrictUndefined

from cow_service.evals.design import BASELINE
from cow_service.evals.items import Item, Observation
from cow_service.evals.report.summary import ArmSummary, Findings
from cow_service.evals.report.tables import p_text, points
from cow_service.evals.runs import PICTURES, EvalRun

PAGE = "index.html"
SCRIPTS = ("data.js", "filters.js", "cards.js", "main.js")
STYLES = ("page.css", "cards.css")
TITLES = {
    "gains": "Gains over the image alone",
    "doses": "Dose and response",
    "rates": "Right answers by task and level",
    "calibration": "Calibration of the predicted probabilities",
    "cost": "Right answers against their cost",
}
# Fields of an observation that are known from its item and its arm.
KNOWN = {"item", "task", "level", "scene", "arm", "truth", "abstain"}
ITEMS_PER_BLOCK = 100  # items whose replies are read together, once one of them is opened


def write_page(
    folder: Path,
    runs: Sequence[EvalRun],
    findings: Findings,
    plots: Sequence[Path] = (),
    sections: Sequence[tuple[str, str]] = (),
) -> Path:
    """Writes `index.html` into the folder and returns its path.

    `plots` are files that `write_plots` wrote; the page shows those that are SVG. `sections` are headings and plain
    texts, shown after the summary. The page refers to plots and pictures where they are.
    """
    folder.mkdir(parents=True, exist_ok=True)
    core, replies = page_data(runs, findings.arms)
    known = {path.stem: path for run in reversed(runs) for path in (run.folder / PICTURES).rglob("*.*")}
    core["pictures"] = [_address(folder, known[digest]) if digest in known else None for digest in core["pictures"]]
    style, script = "".join(map(_source, STYLES)), "'use strict';\n" + "".join(map(_source, SCRIPTS))
    # Nothing but this script, this style, and pictures beside the page: whatever a reply says, it does nothing.
    allowed = {
        "default-src": "'none'",
        "img-src": "'self' file: data:",
        "style-src": _digest(style),
        "script-src": _digest(script),
        "base-uri": "'none'",
        "form-action": "'none'",
    }
    template = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    template.filters |= {"percent": _percent, "points": points, "p": p_text}
    drawn = [path for path in plots if path.suffix == ".svg"]
    text = template.from_string(_source("template.html")).render(
        policy="; ".join(f"{name} {value}" for name, value in allowed.items()),
        style=style,
        script=script,
        core=script_json(core),
        replies=map(script_json, replies),
        runs=runs,
        items=len(core["items"]),
        findings=findings,
        summaries=findings.arms,
        against={name: core["arms"][place][0] for name, place in core["arms"] if place is not None},
        sections=sections,
        plots=[(TITLES.get(path.stem, path.stem), _address(folder, path)) for path in drawn],
    )
    partial = folder / f".{PAGE}.partial"
    # A carriage return would change the text that the policy's digests are of.
    partial.write_text(text, encoding="utf-8", errors="replace", newline="\n")
    return partial.replace(folder / PAGE)


def _source(name: str) -> str:
    return (Path(__file__).with_suffix("") / name).read_text(encoding="utf-8")


def _percent(share: float | None, digits: int = 1) -> str:
    return "" if share is None else f"{100 * share:.{digits}f}"


def _digest(text: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


def _place(known: dict[str, int], value: str | None) -> int | None:
    """The place of a value among those that are known, where it is added if it is new; None for None."""
    return None if value is None else known.setdefault(value, len(known))


def _address(folder: Path, path: Path) -> str:
    """Where a file is, for a page in the folder."""
    return quote(os.path.relpath(path.resolve(), folder.resolve()))


def page_data(runs: Sequence[EvalRun], summaries: Sequence[ArmSummary]) -> tuple[dict[str, Any], list[list[str]]]:
    """What the page needs at once, pictures by their digests, and the texts of the replies in blocks of items."""
    places = {(each.run, each.arm): place for place, each in enumerate(summaries)}
    asked: dict[tuple[str, str], Item] = {}  # by the digest of the data, and id
    seen: dict[tuple[str, str, int], list[Observation]] = {}
    for number, run in enumerate(runs):
        for item in run.items.values():
            asked.setdefault((run.info.data_digest, item.id), item)
        for each in run.observations:
            if (number, each.arm) in places:
                seen.setdefault((run.info.data_digest, each.item, places[number, each.arm]), []).append(each)

    names = {run.info.data_digest: run.info.data for run in reversed(runs)}
    pictures: dict[str, int] = {}
    items: list[dict[str, Any]] = []
    blocks: list[dict[str, int]] = []

    def packed(each: Observation) -> dict[str, Any]:
        return each.model_dump(mode="json", exclude=KNOWN) | {
            "reply": _place(blocks[-1], each.reply),
            "frames": [_place(pictures, frame) for frame in each.frames],
            "overlay": _place(pictures, each.overlay),
        }

    for place, (key, item) in enumerate(asked.items()):
        if place % ITEMS_PER_BLOCK == 0:
            blocks.append({})
        replied = [sorted(seen.get((*key, arm), ()), key=lambda each: each.repeat) for arm in range(len(summaries))]
        packed_item = {
            "data": names[key[0]],
            "image": _place(pictures, item.image),
            "oracle": [_place(pictures, picture) for _, picture in (item.truth.pictures if item.truth else ())],
            "seen": [[packed(each) for each in of_arm] for of_arm in replied],
        }
        items.append(item.model_dump(mode="json", exclude={"source_id", "truth"}) | packed_item)
    core = {
        "perBlock": ITEMS_PER_BLOCK,
        "data": list(names.values()),
        # Each arm with the place of its baseline.
        "arms": [
            [each.name, None if each.baseline is None else places.get((each.baseline, BASELINE))] for each in summaries
        ],
        "pictures": list(pictures),
        "items": items,
    }
    return core, [list(block) for block in blocks]


def script_json(value: Any) -> str:
    """JSON that can stand in a script element: nothing in it can end the element or open another."""
    text = json.dumps(value, ensure_ascii=False, separators=(",", ":"))
    for letter in "<>&\u2028\u2029":
        text = text.replace(letter, f"\\u{ord(letter):04x}")
    return text
