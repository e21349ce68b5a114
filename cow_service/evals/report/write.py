"""Writes a report: tables, plots, a page with every item, and a manifest."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from cow_service.errors import InvalidRequest, StorageUnavailable
from cow_service.evals.report.contents import gains_in_short, in_short, pairs, tables
from cow_service.evals.report.page import write_page
from cow_service.evals.report.paper import differences
from cow_service.evals.report.plots import write_plots
from cow_service.evals.report.summary import ArmSummary, Price, summarize
from cow_service.evals.report.tables import csv_text, latex, markdown
from cow_service.evals.runs import Run

FORMATS = {"md": markdown, "csv": csv_text, "tex": latex}


def write_report(runs: Sequence[Run], out: Path, prices: Mapping[str, Price]) -> str:
    """Writes all files of a report into a folder; returns its main tables as text.

    Raises `InvalidRequest` where nothing has been replied to, and `StorageUnavailable`.
    """
    summaries = summarize(runs, prices)
    if not summaries:
        reasons = {each.failure for run in runs for each in run.observations if each.failure is not None}
        why = f" Every question failed: {sorted(reasons)[0]}" if reasons else ""
        raise InvalidRequest(f"There is nothing to report: no question has a reply.{why}")
    try:
        _write(runs, summaries, out)
    except OSError as error:
        raise StorageUnavailable(f"'{out}' cannot be written: {error.strerror or error}.") from error
    shown = [table for table in (in_short(summaries), gains_in_short(summaries)) if table.rows]
    return "\n\n".join(markdown(table) for table in shown)


def _write(runs: Sequence[Run], summaries: Sequence[ArmSummary], out: Path) -> None:
    (out / "tables").mkdir(parents=True, exist_ok=True)
    known = tables(summaries)
    for table in (*known, pairs(runs, summaries)):
        for extension, text in FORMATS.items():
            if table.name != "pairs" or extension == "csv":
                (out / "tables" / f"{table.name}.{extension}").write_text(text(table), encoding="utf-8")
    plots = write_plots(out / "plots", summaries)
    sections = [(f"Differences from the paper: {about.lower()}", "\n".join(told)) for about, told in differences()]
    write_page(out, runs, summaries, plots, sections)
    parts = [f"## {table.title}\n\n{markdown(table)}" for table in known]
    (out / "report.md").write_text("\n\n".join(["# Evaluation", _asked(runs), *parts, _differences()]) + "\n", "utf-8")
    _write_manifest(runs, out)


def _asked(runs: Sequence[Run]) -> str:
    """What was asked, and what was found in the data."""
    lines: list[str] = []
    for run in runs:
        info = run.info
        lines.append(
            f"{info.mllm}, asked by {info.ask}: {len(run.items)} questions of {info.data}, arms "
            f"{', '.join(info.arms)}, {info.repeats} repeats, seed {info.seed}."
        )
        lines += [f"- {told}" for told in (*info.notes, *(f"left out: {fault}" for fault in info.faults))]
        failures = sorted({each.failure for each in run.observations if each.failure is not None})
        lines += [f"- failed: {' '.join(failure.split())}" for failure in failures]
    return "\n".join(lines)


def _differences() -> str:
    parts = ["## Differences from the paper"]
    for about, told in differences():
        parts.append(f"{about}:\n\n" + "\n".join(f"- {each}" for each in told))
    return "\n\n".join(parts)


def _write_manifest(runs: Sequence[Run], out: Path) -> None:
    """What was asked, with which versions, prompts and seeds, and the digest of every file of the report."""
    files: dict[str, str] = {}
    for path in sorted(path for path in out.rglob("*") if path.is_file() and path.name != "manifest.json"):
        files[path.relative_to(out).as_posix()] = hashlib.sha256(path.read_bytes()).hexdigest()
    manifest: dict[str, Any] = {"runs": [run.info.model_dump(mode="json") for run in runs], "files": files}
    (out / "manifest.json").write_text(json.dumps(manifest, indent=2, ensure_ascii=False) + "\n", encoding="utf-8")
