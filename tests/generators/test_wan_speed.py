"""The speed benchmark at toy size: that its figures hang together and its formula is right. Never how fast it is."""

from __future__ import annotations

import json
import subprocess
import sys
import warnings
from collections.abc import Callable
from pathlib import Path

import pytest
from conftest import ROOT

from cow_service.weights.manifests import load_manifests

pytest_plugins = "toy_fixtures"
pytestmark = pytest.mark.slow

BENCHMARKS = ROOT / "benchmarks"
sys.path.insert(0, str(BENCHMARKS))
ATI, TINY = load_manifests()["ati"], load_manifests()["tiny-ati"]
CLIP = ("--model", "tiny-ati", "--num-frames", "5", "--width", "32", "--height", "32")


@pytest.fixture
def wan_speed(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str]]:
    """The script with arguments, in this process: its exit code, and what it said."""
    import wan_speed

    def run(*arguments: str) -> tuple[int, str]:
        monkeypatch.setattr(sys, "argv", ["wan_speed.py", *arguments])
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # as in a process of its own
            code = wan_speed.main()
        told = capsys.readouterr()
        return code, told.out + told.err

    return run


def test_the_figures_of_profiles_and_of_diffusers_own_pipeline_hang_together(wan_speed, tmp_path) -> None:
    from wan_table import PARTS

    file = tmp_path / "found.json"
    profiles = ("--profile", "exact", "--profile", "fast", "--against", "plain")
    code, told = wan_speed(*CLIP, "--steps", "3", "--runs", "2", *profiles, "--json", str(file))
    assert code == 0, told
    found = json.loads(file.read_text())
    figures = {result["name"]: result["figures"] for result in found["results"]}
    for name, each in figures.items():
        parts = each["parts_s"]
        assert set(parts) == {*PARTS} - ({"condition"} if name == "plain" else set())
        assert sum(parts.values()) == pytest.approx(each["total_s"], rel=0.05)
        assert (each["steps"], each["passes"]) == (3, 6)
        assert each["share_of_peak"] == pytest.approx(each["tflops"] / found["matmul_bf16_tflops"], rel=0.01)
        assert each["tflops"] == pytest.approx(1000 * each["pflop"] / parts["denoising"], rel=0.01)
    exact, fast, plain = figures.values()
    assert exact["passes_computed"] == plain["passes_computed"] == 6 > fast["passes_computed"] >= 2
    assert fast["pflop"] < exact["pflop"] == plain["pflop"], "what a cache skips is not counted"
    ratio = fast["times_as_fast_as_plain"]["clip"]
    assert ratio == pytest.approx(plain["total_s"] / fast["total_s"], rel=0.01)
    assert max(found["golden"]["float32"].values()) < 1e-5
    assert 1e-4 < max(found["golden"]["bfloat16"].values()) < 0.1, "that is the precision, and it was really used"
    attention = {row["name"]: row for row in found["attention"]}
    assert attention["native"]["error"] == 0


def test_a_budget_plans_what_it_would_measure(wan_speed) -> None:
    code, planned = wan_speed("--model", "tiny-ati", "--budget", "500", "--plan")
    assert code == 0
    assert len(planned.splitlines()) > 10


def test_the_formula_counts_what_pytorch_counts(toys) -> None:
    from torch.nn.attention import SDPBackend, sdpa_kernel
    from torch.utils.flop_counter import FlopCounterMode
    from wan_flops import pass_flops

    transformer, zeros = toys.make_tiny(TINY.architecture).transformer, toys.torch.zeros
    with toys.torch.no_grad(), sdpa_kernel(SDPBackend.MATH), FlopCounterMode(display=False) as counter:
        transformer(zeros(1, 36, 2, 6, 4), toys.torch.ones(1), zeros(1, 512, 16), zeros(1, 17, 32))
    assert pass_flops(TINY.architecture, 5, 32, 48, 17) == counter.get_total_flops()
    one = pass_flops(ATI.architecture, 81, 832, 480)
    assert 80 * one == pytest.approx(135e15, rel=0.03)
    assert pass_flops(ATI.architecture, 81, 832, 480, layers=0) < 0.002 * one


@pytest.mark.soak
@pytest.mark.timeout(600)
def test_first_contact_goes_the_whole_way(toys, tmp_path: Path) -> None:
    given = ("--toy", "--num-frames", "5", "--profile", "exact", "--json", str(tmp_path / "found.json"))
    subprocess.run([sys.executable, str(BENCHMARKS / "first_contact.py"), *given], check=True, capture_output=True)
    found = {row["name"]: row for row in json.loads((tmp_path / "found.json").read_text())["rows"]}
    assert found["portable"]["exit"] == 0
    assert found["exact"]["exit"] == (0 if toys.torch.cuda.is_available() else 1)
    assert found["exact"].get("grey_levels_off_portable", 0) < 2
    assert found["serve: cancel"]["status"] == "canceled"
    assert [found[f"serve: {clip}"]["status"] for clip in ("first clip", "after a cancel")] == [200, 200]
