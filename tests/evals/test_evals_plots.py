"""The plots of a report: made for every shape of results, the same bytes each time, with the figures in their text."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING
from xml.etree import ElementTree

import pytest
from asked_runs import run
from PIL import Image

from cow_service.evals.items import Task

if TYPE_CHECKING:
    from cow_service.evals.report.summary import Findings

pytestmark = pytest.mark.slow

PLOTS = ["gains", "rates", "calibration"]
ARMS = ("never", "always", "always:vote-3", "placebo-still", "encounters", "oracle")
TASKS = ("collision", "trajectory", "compatibility", "occlusion")
LONG = "hf/a-multimodal-model-with-a-very-long-name-and-a-suffix-72B-instruct"
ODD = ("_hidden", "a/$x$ <b> & 模型\n\x07", LONG)


def found(folder: Path, count: int, arms: Sequence[str], repeats: int, tasks: Sequence[Task] = TASKS) -> Findings:
    from cow_service.evals.report.summary import Price, summarize

    return summarize([run(folder, count, arms, repeats, tasks)], {"openai/small": Price(input=0.2, output=0.8)})


def drawn(folder: Path, findings: Findings) -> list[Path]:
    from cow_service.evals.report.write import write_plots

    return list(write_plots(folder, findings))


def words(path: Path) -> str:
    return " ".join("".join(each.itertext()) for each in ElementTree.parse(path).iter() if each.tag.endswith("text"))


def test_every_plot_is_a_vector_and_a_picture_with_its_figures_in_the_text(tmp_path: Path) -> None:
    findings = found(tmp_path, 48, ARMS, 3)
    plots = drawn(tmp_path / "plots", findings)
    assert [path.name for path in plots] == [f"{name}{suffix}" for name in PLOTS for suffix in (".svg", ".png")]
    for path in plots[1::2]:
        with Image.open(path) as picture:
            assert min(picture.size) > 300
            assert round(picture.info["dpi"][0]) == 150
    assert {ElementTree.parse(path).getroot().tag for path in plots[::2]} == {"{http://www.w3.org/2000/svg}svg"}
    said = {path.stem: words(path) for path in plots[::2]}
    for each in findings.arms:
        assert f"{100 * each.rates.tpr.mean:.0f}" in said["rates"]
        assert each.name in said["rates"]
        if each.gain is not None:
            assert f"{100 * each.gain.gain:+.1f}".replace("-", "−") in said["gains"]
    told = next(each.calibration for each in findings.arms if each.calibration)
    assert f"Brier score {told.brier:.3f}" in said["calibration"]
    assert f"n = {told.count}" in said["calibration"]


def test_the_same_findings_make_the_same_bytes_and_one_scene_has_no_interval(tmp_path: Path) -> None:
    findings = found(tmp_path, 2, ("never", "always"), 1, ("compatibility",))
    one, other = drawn(tmp_path / "a", findings), drawn(tmp_path / "b", findings)
    assert [a.read_bytes() for a in one[::2]] == [b.read_bytes() for b in other[::2]]
    assert "one scene: no interval" in words(tmp_path / "a" / "gains.svg")


def test_one_arm_has_no_gains_and_no_calibration_and_odd_names_are_drawn(tmp_path: Path) -> None:
    from cow_service.evals.report.summary import summarize

    (tmp_path / "gains.svg").write_text("of an earlier report")
    runs = [run(tmp_path / str(place), 6, ("never",), 1, ("collision",), name) for place, name in enumerate(ODD)]
    paths = drawn(tmp_path, summarize(runs))
    assert {path.stem for path in paths} == {"rates"}
    assert not (tmp_path / "gains.svg").exists()
    said = words(tmp_path / "rates.svg")
    assert "one repeat, so no SD" in said
    for name in ("_hidden, never", "a/$x$ <b> & 模型 , never", "72B-instruct, never"):
        assert name in said
    assert LONG not in said
    assert drawn(tmp_path, summarize([])) == []
