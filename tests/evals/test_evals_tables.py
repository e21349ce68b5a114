"""The tables of a report, as they are: Markdown, CSV and LaTeX of a run that is always the same."""

from __future__ import annotations

import csv
import io
import json
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from asked_runs import HOSTILE, run
from conftest import ROOT

if TYPE_CHECKING:
    from cow_service.evals.report.summary import Findings
    from cow_service.evals.runs import EvalRun

pytestmark = pytest.mark.slow

GOLDEN = ROOT / "tests" / "data" / "evals"
TASKS = ("collision", "trajectory", "compatibility", "occlusion")


@pytest.fixture(scope="module")
def asked(tmp_path_factory: pytest.TempPathFactory) -> EvalRun:
    return run(tmp_path_factory.mktemp("run"), count=24, repeats=3, tasks=TASKS)


@pytest.fixture(scope="module")
def summaries(asked: EvalRun, tmp_path_factory: pytest.TempPathFactory) -> Findings:
    from cow_service.evals.report.summary import read_prices, summarize

    prices = tmp_path_factory.mktemp("prices") / "prices.yaml"
    prices.write_text("openai/small: {input: 2, output: 10}\n")
    return summarize([asked], read_prices(prices))


def test_tables_are_as_they_were(summaries: Findings) -> None:
    """A wanted change: write the reported text into tests/data/evals."""
    from cow_service.evals.report.tables import csv_text, latex, markdown, tables

    for form, write in {"md": markdown, "csv": csv_text, "tex": latex}.items():
        told = "\n".join(f"{table.title}\n{write(table)}" for table in tables(summaries, published=True))
        assert told == (GOLDEN / f"tables.{form}").read_text(encoding="utf-8")


def test_each_reply_has_a_row(asked: EvalRun) -> None:
    from cow_service.evals.report.tables import csv_text, replies

    replied = [each for each in asked.observations if each.failure is None]
    assert len(replied) > 24
    for row, each in zip(csv.DictReader(io.StringIO(csv_text(replies([asked])))), replied, strict=True):
        assert (row["item"], row["arm"], row["repeat"]) == (each.item, each.arm, str(each.repeat))
        assert (row["chosen"], row["right"]) == (each.read or "", str(int(each.right)))


def test_text_that_means_something_to_a_format_is_text_in_it() -> None:
    from cow_service.evals.report.tables import Table, csv_text, latex, markdown

    table = Table("x", "100% of \\ & _", ("a|b", "c"), ((HOSTILE.replace("\u2028", " "), "50% & 3_4"),))
    assert markdown(table).splitlines()[0].count("|") == 4
    assert list(csv.reader(io.StringIO(csv_text(table))))[1][1] == "50% & 3_4"
    text = latex(table)
    assert r"50\% \& 3\_4 \\" in text
    assert r"\caption{100\% of \textbackslash{} \& \_}" in text


def test_runs_of_two_models_are_compared_each_with_its_own_baseline(tmp_path: Path) -> None:
    from cow_service.evals.report.summary import summarize
    from cow_service.evals.report.write import write_report

    large = run(tmp_path / "large", mllm="openai/large", arms=("never",), repeats=2)
    more = run(tmp_path / "more", mllm="openai/large", arms=("always",), repeats=2)
    small = run(tmp_path / "small", arms=("never", "always"), repeats=2)
    found = {each.name: each for each in summarize([large, more, small]).arms}
    assert set(found) == {"openai/large, never", "openai/large, always", "openai/small, never", "openai/small, always"}
    assert found["openai/large, always"].gain is not None, "its baseline is in another folder"
    write_report([large, more, small], tmp_path / "report", {})
    manifest = json.loads((tmp_path / "report" / "manifest.json").read_text())
    assert [each["mllm"] for each in manifest["runs"]] == ["openai/large", "openai/large", "openai/small"]
    assert (tmp_path / "report" / "report.md").is_file()
