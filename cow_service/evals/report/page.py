"""The page of a report: one HTML file that opens without a server, with every question, picture and reply.

What it shows stands in it as compact JSON: texts, pictures and lists that come again are named by their place.
"""

import base64
import hashlib
import json
import os
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any
from urllib.parse import quote
from xml.etree import ElementTree

from jinja2 import Environment, StrictUndefined
from markupsafe import Markup

from cow_service.evals.items import Item, Observation
from cow_service.evals.report.summary import BASELINE, ArmSummary, baseline_run
from cow_service.evals.report.tables import p_text, points
from cow_service.evals.runs import PICTURES, EvalRun

PAGE = "index.html"
SCRIPTS = ("data.js", "filters.js", "cards.js", "main.js")
STYLES = ("page.css", "cards.css")
TITLES = {
    "gains": "Gains over the image alone",
    "rates": "Right answers by task and level",
    "calibration": "Calibration of the told probabilities",
    "cost": "Right answers against their cost",
}
ITEMS_PER_BLOCK = 100  # items whose replies are read together, once one of them is opened
SVG, LINK = "{http://www.w3.org/2000/svg}", "{http://www.w3.org/1999/xlink}href"
# The four colours of figures.py that are not an arm's own.
THEMED = {"#17211f": "var(--ink)", "#566360": "var(--dim)", "#d5dbd8": "var(--line)", "#fefefe": "var(--panel)"}
PIXELS_PER_POINT = 1.2


def write_page(
    folder: Path,
    runs: Sequence[EvalRun],
    summaries: Sequence[ArmSummary],
    plots: Sequence[Path] = (),
    sections: Sequence[tuple[str, str]] = (),
) -> Path:
    """Writes `index.html` into the folder and returns its path.

    `plots` are files that `write_plots` wrote; those that are SVG stand in the page. `sections` are headings and plain
    texts, shown after the summary. The page refers to the pictures where the runs have them.
    """
    folder.mkdir(parents=True, exist_ok=True)
    arms = page_arms(runs, summaries)
    core, replies = page_data(runs, arms)
    core["pictures"] = _addresses(folder, runs, core["pictures"])
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
    template.filters["percent"] = _percent
    template.filters["points"] = points
    template.filters["p"] = p_text
    titled = [(TITLES.get(path.stem, path.stem), path) for path in plots if path.suffix == ".svg"]
    text = template.from_string(_source("template.html")).render(
        policy="; ".join(f"{name} {value}" for name, value in allowed.items()),
        style=Markup(style),
        script=Markup(script),
        core=Markup(script_json(core)),
        replies=[Markup(script_json(block)) for block in replies],
        runs=runs,
        arms=arms,
        items=len(core["items"]),
        summaries=summaries,
        against={each.name: arms[each.against].name for each in arms if each.against is not None},
        sections=sections,
        plots=[(title, Markup(inline_svg(path, title))) for title, path in titled],
    )
    partial = folder / f".{PAGE}.partial"
    # A carriage return would change the text that the policy's digests are of.
    partial.write_text(text, encoding="utf-8", errors="replace", newline="\n")
    return partial.replace(folder / PAGE)


def _source(name: str) -> str:
    return (files("cow_service.evals.report") / "page" / name).read_text(encoding="utf-8")


def _percent(share: float | None, digits: int = 1) -> str:
    return "" if share is None else f"{100 * share:.{digits}f}"


def _digest(text: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


def _place(known: dict[Any, int], value: Any) -> int | None:
    """The place of a value among those that are known, where it is added if it is new; None for None."""
    return None if value is None else known.setdefault(value, len(known))


@dataclass(frozen=True)
class PageArm:
    """One arm of one run; `against`: the place of its baseline among the arms."""

    name: str
    run: int
    arm: str
    against: int | None = None


def page_arms(runs: Sequence[EvalRun], summaries: Sequence[ArmSummary]) -> tuple[PageArm, ...]:
    """Of all runs; those without any reply too, of which there is no summary."""
    names = {(each.run, each.arm): each.name for each in summaries}
    keys = [(number, arm) for number, run in enumerate(runs) for arm in run.info.arms]
    arms: list[PageArm] = []
    for number, arm in keys:
        own = f"{runs[number].info.mllm}, {arm} ({number + 1})" if len(runs) > 1 else arm
        baseline = None if arm == BASELINE else baseline_run(runs, runs[number])
        against = None if baseline is None else keys.index((runs.index(baseline), BASELINE))
        arms.append(PageArm(names.get((number, arm)) or own, number, arm, against))
    return tuple(arms)


def _addresses(folder: Path, runs: Sequence[EvalRun], digests: Sequence[str]) -> list[str | None]:
    """Where the pictures of these digests are, relative to the page's folder; None for a file that is not there."""
    known: dict[str, Path] = {}
    for run in reversed(runs):
        known |= {path.stem: path for path in (run.folder / PICTURES).glob("*")}
    found = (known.get(digest) for digest in digests)
    beside = folder.resolve()
    return [None if path is None else quote(os.path.relpath(path.resolve(), beside)) for path in found]


def page_data(runs: Sequence[EvalRun], arms: Sequence[PageArm]) -> tuple[dict[str, Any], list[list[str]]]:
    """What the page needs at once, pictures by their digests, and the texts of the replies in blocks of items."""
    data, pictures, shown, reasons, replies = (dict[Any, int]() for _ in range(5))

    def packed_observation(each: Observation) -> list[Any]:
        """The order is that of `readObservation` in page/data.js."""
        return [
            each.repeat,
            "".join(each.options),
            each.read,
            each.read_as_paper,
            _place(replies, each.reply),
            _place(shown, tuple(_place(pictures, frame) for frame in each.frames)),
            _place(pictures, each.overlay),
            _place(reasons, each.refusal),
            _place(reasons, each.failure),
            None if each.probability is None else round(each.probability, 4),
            each.happens,
            round(each.seconds, 2),
            each.imaginations,
        ]

    def packed_item(item: Item, of_data: int, seen: Sequence[Sequence[Observation]]) -> list[Any]:
        """The order is that of `readItem` in page/data.js."""
        return [
            of_data,
            item.id,
            item.row,
            item.scene,
            item.task,
            item.level,
            item.question,
            [[each.letter, each.text] for each in item.options],
            item.answer,
            item.abstain,
            _place(pictures, item.image),
            [_place(pictures, each) for each in item.oracle],
            [[packed_observation(each) for each in of_arm] for of_arm in seen],
        ]

    asked: dict[tuple[int, str], Item] = {}
    seen: dict[tuple[int, str, int], list[Observation]] = defaultdict(list)
    places = {(each.run, each.arm): place for place, each in enumerate(arms)}
    for number, run in enumerate(runs):
        of_data = data.setdefault(run.info.data_digest, len(data))
        for item in run.items.values():
            asked.setdefault((of_data, item.id), item)
        for each in run.observations:
            if (number, each.arm) in places:
                seen[of_data, each.item, places[number, each.arm]].append(each)
    items: list[list[Any]] = []
    blocks: list[dict[Any, int]] = []
    for place, (key, item) in enumerate(asked.items()):
        if place % ITEMS_PER_BLOCK == 0:
            replies = dict[Any, int]()
            blocks.append(replies)
        of_arms = [sorted(seen.get((*key, arm), ()), key=lambda each: each.repeat) for arm in range(len(arms))]
        items.append(packed_item(item, key[0], of_arms))
    names = {each.data_digest: each.data for each in (run.info for run in reversed(runs))}
    core = {
        "perBlock": ITEMS_PER_BLOCK,
        "data": [names[digest] for digest in data],
        "arms": [[each.name, each.against] for each in arms],
        "shown": list(shown),
        "reasons": list(reasons),
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


def inline_svg(path: Path, name: str) -> str:
    """The file's drawing for an HTML page. `name` is what a screen reader calls it."""
    root = ElementTree.parse(path).getroot()
    for parent in list(root.iter()):
        for child in list(parent):
            if child.tag == f"{SVG}style" or not child.tag.startswith(SVG) or child.tag == f"{SVG}metadata":
                parent.remove(child)
    kept = {each.attrib[LINK][1:] for each in root.iter() if LINK in each.attrib}
    kept |= {each.attrib["id"] for each in root.iter(f"{SVG}clipPath")}
    for each in root.iter():
        each.tag = each.tag.removeprefix(SVG)
        if each.attrib.get("id") not in kept:
            each.attrib.pop("id", None)
        if LINK in each.attrib:
            each.attrib["href"] = each.attrib.pop(LINK)
        # Declarations of the style attribute become attributes of their own.
        for declaration in each.attrib.pop("style", "").split(";"):
            key, _, value = declaration.partition(":")
            if value:
                each.attrib[key.strip()] = THEMED.get(value.strip(), value.strip())
    for side in ("width", "height"):
        root.attrib[side] = f"{float(root.attrib[side].removesuffix('pt')) * PIXELS_PER_POINT:.0f}"
    # What matplotlib says in a style element, which the policy of the page does not let in.
    root.attrib |= {"stroke-linejoin": "round", "role": "img", "aria-label": name}
    return ElementTree.tostring(root, encoding="unicode")
