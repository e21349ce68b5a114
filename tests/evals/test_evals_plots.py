"""The plots of a report: made for every shape of results, the same bytes each time, with the figures in their text."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from xml.etree import ElementTree

import pytest
from asked_runs import run
from PIL import Image

pytest.importorskip("matplotlib")
pytest.importorskip("scipy")

from cow_service.evals.report.page import TITLES as PLOTS
from cow_service.evals.report.summary import Findings, Price, summarize
from cow_service.evals.report.write import write_plots

pytestmark = pytest.mark.slow

ARMS = (
    "never",
    "always",
    "auto",
    "always:vote-3",
    "placebo-still",
    "placebo-direction",
    "encounters",
    "frames-only",
    "oracle:error-0",
    "oracle:error-2",
)
TASKS = ("collision", "trajectory", "compatibility", "occlusion")
LONG = "hf/a-multimodal-model-with-a-very-long-name-and-a-suffix-72B-instruct"
ODD = ("_hidden", "a/$x$ <b> & 模型\n\x07", LONG)


@pytest.fixture(scope="module")
def nine(tmp_path_factory: pytest.TempPathFactory) -> Findings:
    found = run(tmp_path_factory.mktemp("nine"), 48, ARMS, 3, TASKS)
    return summarize([found], {"openai/small": Price(input=0.2, output=0.8)})


def names(paths: Sequence[Path]) -> set[str]:
    return {path.stem for path in paths}


def words(path: Path) -> str:
    return " ".join("".join(each.itertext()) for each in ElementTree.parse(path).iter() if each.tag.endswith("text"))


@pytest.fixture(scope="module")
def plots(nine: Findings, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, ...]:
    return tuple(write_plots(tmp_path_factory.mktemp("plots"), nine))


def test_every_plot_is_a_vector_and_a_picture(plots: tuple[Path, ...]) -> None:
    assert [path.name for path in plots] == [f"{name}{suffix}" for name in PLOTS for suffix in (".svg", ".png")]
    for path in plots:
        if path.suffix == ".png":
            with Image.open(path) as picture:
                assert min(picture.size) > 300
                assert round(picture.info["dpi"][0]) == 150
        else:
            assert ElementTree.parse(path).getroot().tag == "{http://www.w3.org/2000/svg}svg"


def test_the_same_findings_make_the_same_bytes(tmp_path: Path) -> None:
    found = summarize([run(tmp_path, 6, ("never", "always", "oracle:error-0", "oracle:error-2"), 2, TASKS[:1])])
    one, other = write_plots(tmp_path / "a", found), write_plots(tmp_path / "b", found)
    vectors = [(a, b) for a, b in zip(one, other, strict=True) if a.suffix == ".svg"]
    assert [a.name for a, b in vectors if a.read_bytes() != b.read_bytes()] == []


def test_the_figures_stand_in_the_text(nine: Findings, plots: tuple[Path, ...]) -> None:
    said = {path.stem: words(path) for path in plots if path.suffix == ".svg"}
    for each in nine.arms:
        assert f"{100 * each.rates.tpr.mean:.0f}" in said["rates"]
        assert all(each.name in said[name] for name in ("rates", "cost"))
        if each.gain is not None:
            assert f"{100 * each.gain.gain:+.1f}".replace("-", "−") in said["gains"]
    told = next(each.calibration for each in nine.arms if each.calibration)
    assert f"Brier score {told.brier:.3f}" in said["calibration"]
    assert f"n = {told.count}" in said["calibration"]
    assert "Money per question" in said["cost"]
    assert "Error of the path shown" in said["doses"]


def test_one_arm_has_no_gains_and_no_calibration(tmp_path: Path) -> None:
    (tmp_path / "gains.svg").write_text("of an earlier report")
    paths = write_plots(tmp_path, summarize([run(tmp_path, 6, ("never",), 1, ("collision",))]))
    assert names(paths) == {"rates", "cost"}
    assert not (tmp_path / "gains.svg").exists()
    assert "one repeat, so no SD" in words(tmp_path / "rates.svg")


def test_one_scene_has_no_interval(tmp_path: Path) -> None:
    write_plots(tmp_path, summarize([run(tmp_path, 2, ("never", "always"), 1, ("compatibility",))]))
    assert "one scene: no interval" in words(tmp_path / "gains.svg")


def test_nothing_asked_draws_nothing(tmp_path: Path) -> None:
    assert write_plots(tmp_path, summarize([])) == ()


@pytest.mark.soak  # twelve seconds of drawing
def test_odd_names_of_models_are_drawn(tmp_path: Path) -> None:
    runs = [run(tmp_path / str(place), 12, ("never", "always"), 2, mllm=name) for place, name in enumerate(ODD)]
    assert names(write_plots(tmp_path, summarize(runs))) == set(PLOTS) - {"doses"}
    said = words(tmp_path / "rates.svg")
    assert "_hidden, always" in said
    assert "a/$x$ <b> & 模型 , always" in said
    assert LONG not in said
    assert "72B-instruct, always" in said


@pytest.mark.soak
def test_matplotlib_is_imported_where_it_is_used() -> None:
    code = "import cow_service.evals.report.write, sys; print('matplotlib' in sys.modules)"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "False"
