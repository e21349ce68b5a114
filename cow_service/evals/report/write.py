"""Writes a report: tables, plots and a manifest."""

import hashlib
import json
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path

from cow_service.errors import InvalidRequest, StorageUnavailable
from cow_service.evals.report import tables
from cow_service.evals.report.summary import Findings, Price, summarize
from cow_service.evals.runs import EvalRun

SUFFIXES = (".svg", ".png")
PNG_DPI = 150
PUBLISHED = "causalspatial"  # in the name of the data whose figures the paper printed
FORMATS = {"md": tables.markdown, "csv": tables.csv_text, "tex": tables.latex}


def write_report(runs: Sequence[EvalRun], out: Path, prices: Mapping[str, Price]) -> str:
    """Writes all files of a report into a folder; returns its main tables as text.

    Raises `InvalidRequest` if nothing has been replied to, and `StorageUnavailable`.
    """
    findings = summarize(runs, prices)
    if not findings.arms:
        reasons = {each.failure for run in runs for each in run.observations if each.failure is not None}
        why = f" Every question failed: {sorted(reasons)[0]}" if reasons else ""
        raise InvalidRequest(f"There is nothing to report: no question has a reply.{why}")
    try:
        _write(runs, findings, out)
    except OSError as error:
        raise StorageUnavailable(f"'{out}' cannot be written: {error.strerror or error}.") from error
    main = tables.overview(findings.arms), tables.contrasts(findings, by_task=False), tables.primary(findings)
    return "\n\n".join(tables.markdown(table) for table in main if table.rows)


def _write(runs: Sequence[EvalRun], findings: Findings, out: Path) -> None:
    (out / "tables").mkdir(parents=True, exist_ok=True)
    published = all(PUBLISHED in run.info.data.lower() for run in runs)
    known = tables.tables(findings, published=published)
    for table in known:
        for extension, text in FORMATS.items():
            (out / "tables" / f"{table.name}.{extension}").write_text(text(table), encoding="utf-8")
    (out / "tables" / "replies.csv").write_text(tables.csv_text(tables.replies(runs)), encoding="utf-8")
    write_plots(out / "plots", findings)
    parts = ["# Evaluation", "\n".join(line for run in runs for line in facts_of_run(run))]
    if not findings.primaries:
        parts.append("No placebo was asked: a gain over the image alone may come from more pictures.")
    parts += [f"## {table.title}\n\n{tables.markdown(table)}" for table in known]
    for about, told in tables.DIFFERENCES.items():
        parts.append(f"## Differences from the paper: {about.lower()}\n\n" + "\n".join(f"- {each}" for each in told))
    (out / "report.md").write_text("\n\n".join(parts) + "\n", "utf-8")

    # What was asked, with which versions, prompts and seeds, and the digest of every file of the report.
    files = sorted(path for path in out.rglob("*") if path.is_file() and path.name != "manifest.json")
    digests = {path.relative_to(out).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}
    manifest = {"runs": [run.info.model_dump(mode="json") for run in runs], "files": digests}
    (out / "manifest.json").write_text(json.dumps(manifest, indent=2, ensure_ascii=False) + "\n", encoding="utf-8")


def facts_of_run(run: EvalRun) -> list[str]:
    """What was asked in a run, what was found in its data, and what failed."""
    info = run.info
    failures = sorted({each.failure for each in run.observations if each.failure is not None})
    return [
        f"{info.mllm}, asked by {info.ask}: {len(run.items)} questions of {info.data}, arms "
        f"{', '.join(info.arms)}, repeats {info.repeats}, seed {info.seed}, design {info.design_digest[:12]}, "
        f"{info.versions.get('cow-service')} at commit {info.versions.get('commit')}.",
        *(f"- {told}" for told in info.notes),
        *(f"- left out: {fault}" for fault in info.faults),
        *(f"- failed: {' '.join(failure.split())}" for failure in failures),
    ]


def write_plots(folder: Path, findings: Findings) -> tuple[Path, ...]:
    """Writes the plots for which there is something to draw, and removes those of an earlier report.

    The files are `gains`, `rates` and `calibration`, each as `.svg` and `.png`. The same findings make
    the same bytes of SVG.
    """
    # A second of imports, needed only to write a report.
    from matplotlib import style  # noqa: PLC0415

    from cow_service.evals.report import figures  # noqa: PLC0415

    folder.mkdir(parents=True, exist_ok=True)
    written: list[Path] = []
    for name, draw in figures.DRAWINGS.items():
        with style.context(figures.STYLE), warnings.catch_warnings():
            # Names of models may have letters that the font has not: the SVG keeps them as text.
            warnings.filterwarnings("ignore", message="Glyph .* missing from")
            figure = draw(findings)
            for suffix in SUFFIXES:
                path = folder / f"{name}{suffix}"
                path.unlink(missing_ok=True)
                if figure is None:
                    continue
                kept_out = {"Date": None, "Creator": None} if suffix == ".svg" else {"Software": None}
                figure.savefig(path, dpi=PNG_DPI, bbox_inches="tight", pad_inches=0.12, metadata=kept_out)
                written.append(path)
    return tuple(written)
