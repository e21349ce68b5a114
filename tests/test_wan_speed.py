"""The speed benchmark at toy size: that its figures hang together and its formula is right. Never how fast it is."""

from __future__ import annotations

import json
import subprocess
import sys
from argparse import Namespace
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest
import torch
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.utils.flop_counter import FlopCounterMode

from cow_service.generators.wan.checkpoints import load_transformer
from cow_service.generators.wan.profiles import Profile
from cow_service.generators.wan.tiny import make_tiny
from cow_service.weights.manifests import load_manifests

BENCHMARKS = Path(__file__).resolve().parents[1] / "benchmarks"
sys.path.insert(0, str(BENCHMARKS))

import wan_flops  # noqa: E402
import wan_models  # noqa: E402
import wan_plan  # noqa: E402
import wan_speed  # noqa: E402

CPU = torch.device("cpu")
ATI, TINY = load_manifests()["ati"], load_manifests()["tiny-ati"]
SMALLEST = wan_models.Case(TINY, CPU, num_frames=5, width=32, height=32, steps=2, runs=1)

# Runs the script as on a machine with PyTorch and diffusers, but nothing else that the package needs, nor itself.
BARE = """
import runpy, sys
from importlib.machinery import PathFinder

script, root, hidden = sys.argv[1], sys.argv[2], sys.argv[3].split(",")

class Bare(PathFinder):
    @classmethod
    def find_spec(cls, name, path=None, target=None):
        return None if name.partition(".")[0] in hidden else super().find_spec(name, path, target)

sys.meta_path = [Bare if finder is PathFinder else finder for finder in sys.meta_path]
sys.path = [script.rpartition("/")[0], *(folder for folder in sys.path if folder not in ("", root))]
sys.argv = [script, *sys.argv[4:]]
runpy.run_path(script, run_name="__main__")
"""
HIDDEN = (
    "aiofiles", "av", "cv2", "fastapi", "ftfy", "jinja2", "platformdirs", "pydantic_settings", "python_multipart",
    "rich", "starlette", "torchao", "torchvision", "typer", "uvicorn",
)  # fmt: skip


def run_bare(*arguments: str, folder: Path) -> subprocess.CompletedProcess[str]:
    script = (str(BENCHMARKS / "wan_speed.py"), str(BENCHMARKS.parent), ",".join(HIDDEN))
    command = [sys.executable, "-c", BARE, *script, *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False, cwd=folder)


@dataclass(frozen=True)
class Whole:
    """One run of the script."""

    told: str
    warned: str
    found: dict[str, Any]

    def figures(self, name: str) -> dict[str, Any]:
        return next(result["figures"] for result in self.found["results"] if result["name"] == name)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Whole:
    """Two profiles and diffusers' own pipeline, on a bare machine."""
    folder = tmp_path_factory.mktemp("speed")
    size = ("--num-frames", "9", "--width", "48", "--height", "32", "--steps", "3", "--runs", "2")
    profiles = ("--profile", "exact", "--profile", "fast", "--against", "plain", "--json", "found.json")
    done = run_bare("--model", "tiny-ati", *size, *profiles, folder=folder)
    assert done.returncode == 0, done.stderr
    return Whole(done.stdout, done.stderr, json.loads((folder / "found.json").read_text()))


@pytest.mark.slow
class TestTheScript:
    def test_it_runs_where_only_the_models_libraries_are(self, whole: Whole) -> None:
        assert "ftfy is not installed" in whole.warned
        assert [result["status"] for result in whole.found["results"]] == ["measured"] * 3

    def test_it_says_what_was_measured(self, whole: Whole) -> None:
        assert whole.found["machine"]["device"] == ("cuda" if torch.cuda.is_available() else "cpu")
        assert whole.found["versions"]["torch"] == torch.__version__
        clip = {"model": "tiny-ati", "size": "toy", "weights": "random"}
        assert whole.found["clip"] == clip | {"num_frames": 9, "width": 48, "height": 32, "tokens": 18}
        assert whole.found["matmul_bf16_tflops"] > 0

    @pytest.mark.parametrize("name", ["exact", "fast", "plain"])
    def test_the_figures_hang_together(self, whole: Whole, name: str) -> None:
        figures = whole.figures(name)
        parts, step = figures["parts_s"], figures["step_s"]
        assert set(parts) == {*wan_speed.PARTS} - ({"condition"} if name == "plain" else set())
        assert all(seconds > 0 for seconds in parts.values())
        assert sum(parts.values()) == pytest.approx(figures["total_s"], rel=0.05)
        assert 0 < step["min"] <= step["median"] <= step["max"] < parts["denoising"]
        assert figures["steps"] == 3
        assert figures["passes"] == 6
        assert 2 <= figures["passes_computed"] <= 6
        assert figures["share_of_peak"] == pytest.approx(
            figures["tflops"] / whole.found["matmul_bf16_tflops"], rel=0.01
        )
        assert figures["tflops"] == pytest.approx(1000 * figures["pflop"] / parts["denoising"], rel=0.01)
        assert min(figures["build_s"], figures["warm_up_s"]) > 0

    def test_what_a_cache_skips_is_not_counted(self, whole: Whole) -> None:
        exact, fast = whole.figures("exact"), whole.figures("fast")
        assert exact["passes_computed"] == whole.figures("plain")["passes_computed"] == 6
        assert fast["passes_computed"] < 6
        assert fast["pflop"] < exact["pflop"] == whole.figures("plain")["pflop"]

    def test_all_steps_are_computed_and_said_to_be(self, whole: Whole) -> None:
        figures = whole.figures("exact")
        assert figures["computed"]["steps"] == 4
        expected = figures["total_s"] + figures["parts_s"]["denoising"] / 3
        assert figures["computed"]["total_s"] == pytest.approx(expected, rel=0.01)
        seconds = f"{figures['computed']['total_s']:g}"
        assert f"exact: 3 of its steps were run; x 4 steps: {seconds} s (computed)." in whole.told

    def test_against_plain(self, whole: Whole) -> None:
        plain = whole.figures("plain")
        assert "times_as_fast_as_plain" not in plain
        for name in ("exact", "fast"):
            ratios = whole.figures(name)["times_as_fast_as_plain"]
            assert ratios["clip"] == pytest.approx(plain["total_s"] / whole.figures(name)["total_s"], rel=0.01)
        assert "plain / this" in whole.told


def test_the_real_size_is_refused_without_a_gpu(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(wan_speed, "choose_device", lambda name, unavailable: CPU)
    monkeypatch.setattr(sys, "argv", ["wan_speed.py", "--model", "ati"])
    assert wan_speed.main() == 2
    told = capsys.readouterr()
    assert told.out == ""
    assert told.err == "'ati' at its real size needs a GPU, and there is none here. Take tiny-ati.\n"


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"model": "ati2"}, "There is no model 'ati2'"),
        ({"num_frames": 16}, "4n \\+ 1 frames"),
        ({"width": 100}, "multiples of 16 px, not 100 x 64"),
    ],
)
def test_what_cannot_be_measured_is_said(changes: dict[str, Any], told: str) -> None:
    nothing = dict.fromkeys(("model", "num_frames", "width", "height", "steps", "runs"))
    with pytest.raises(ValueError, match=told):
        wan_speed.case_of(Namespace(**(nothing | {"model": "tiny-ati"} | changes)))


def test_golden_figures_are_compared_in_both_precisions(whole: Whole) -> None:
    golden = whole.found["golden"]
    assert max(golden["float32"].values()) < 1e-5
    assert 1e-4 < max(golden["bfloat16"].values()) < 0.1, "that is the precision, and it was really used"
    assert "Off the public implementation in bfloat16: forward pass 0.0" in whole.told


def test_attention_is_timed_alone(whole: Whole) -> None:
    rows = {row["name"]: row for row in whole.found["attention"]}
    assert {"native", "_native_math"} <= set(rows)
    assert rows["native"]["error"] == 0
    assert all(row["ms"] > 0 and row["tflops"] > 0 for row in rows.values() if row["reason"] is None)
    assert "attention native: " in whole.told


def test_a_budget_leaves_out_what_would_not_be_done_in_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """What is guessed is made far too little for the first one: the others are then known to take too long."""
    file, case = tmp_path / "found.json", replace(SMALLEST, steps=None)
    monkeypatch.setattr(wan_speed, "reckoned_seconds", lambda *_: 0.001)
    budget = wan_plan.Budget(20)
    monkeypatch.setattr(wan_plan.Budget, "left", property(lambda _: 0.01))
    wan_speed.survey(case, ["exact", "turbo"], file, budget)
    exact, turbo = json.loads(file.read_text())["results"]
    assert exact["status"] == "measured"
    assert exact["figures"]["steps"] == TINY.profiles["exact"]["sampling"]["steps"] == wan_plan.BUDGET_STEPS
    assert exact["seconds"] > 0.01
    assert turbo["status"] == "skipped"
    assert "s are left" in turbo["reason"]


def test_steps_of_a_budget_are_few(monkeypatch: pytest.MonkeyPatch) -> None:
    case = replace(SMALLEST, manifest=ATI, steps=None)
    steps = {name: wan_plan.steps_within_budget(case, wan_speed.measured_profile(name, case)) for name in ATI.profiles}
    assert set(steps.values()) == {4}
    peak = 800e12  # FLOP/s
    whole, short = (
        wan_plan.reckoned_seconds(replace(case, steps=steps, num_frames=81, width=832, height=480),
                                  wan_speed.measured_profile("exact", case), peak, 2)
        for steps in (None, 4)
    )  # fmt: skip
    assert whole > 3 * short


def test_the_plan_says_what_would_be_run_and_runs_nothing(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(wan_models, "build", None)  # whoever builds a model fails
    arguments = ["--model", "tiny-ati", "--plan", "--budget", "5", "--profile", "exact", "--profile", "turbo"]
    monkeypatch.setattr(sys, "argv", ["wan_speed.py", *arguments])
    assert wan_speed.main() == 0
    told = capsys.readouterr().out
    assert "In all 15 s (reckoned)." in told, "what is measured first"
    assert "exact: 4 steps, 10 s (reckoned), not within the budget" in told
    assert "Not installed here: flash-attn>=2.6.3" in told


def with_profile(name: str, **options: Any) -> wan_models.Case:
    profile = {**TINY.profiles["exact"], "acceleration": options}
    return replace(SMALLEST, manifest=TINY.model_copy(update={"profiles": {name: profile, **TINY.profiles}}))


def test_a_profile_that_this_machine_refuses_is_listed(capfd: pytest.CaptureFixture[str]) -> None:
    found = wan_speed.survey(with_profile("small", offload="model"), ["small"], None)
    assert found["results"][0]["status"] == "refused"
    assert "offload: model needs a GPU" in found["results"][0]["reason"]
    assert "small: refused. offload: model needs a GPU" in wan_speed.table(found)


def test_one_that_fails_takes_no_other_with_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """A real allocation that no machine can serve, then a fault of the code, then one that works."""
    file = tmp_path / "found.json"
    build = wan_models.build

    def fail(case: wan_models.Case, profile: Profile) -> Any:
        if profile.acceleration.cache == "none" and profile.sampling.solver == "unipc":
            torch.empty(2**50, dtype=torch.float64)
        if profile.acceleration.cache != "none":
            raise ZeroDivisionError("a fault")
        return build(case, profile)

    monkeypatch.setattr(wan_models, "build", fail)
    wan_speed.survey(SMALLEST, ["exact", "fast", "turbo"], file)
    results = {result["name"]: result for result in json.loads(file.read_text())["results"]}
    assert [result["status"] for result in results.values()] == ["failed", "failed", "measured"]
    assert "'exact' does not fit into memory" in results["exact"]["reason"]
    assert results["fast"]["reason"] == "ZeroDivisionError: a fault"
    assert results["turbo"]["figures"]["passes"] == 2


class TestTheFormula:
    def test_the_whole_clip_of_the_14b_model(self) -> None:
        one = wan_flops.pass_flops(ATI.architecture, 81, 832, 480)
        assert 80 * one == pytest.approx(135e15, rel=0.03)
        assert wan_flops.pass_flops(ATI.architecture, 81, 832, 480, layers=0) < 0.002 * one

    @pytest.mark.parametrize(("num_frames", "width", "height"), [(5, 32, 48), (17, 112, 64)])
    def test_it_counts_what_pytorch_counts(self, num_frames: int, width: int, height: int) -> None:
        transformer = make_tiny(TINY.architecture).transformer
        states = torch.zeros(1, 36, (num_frames - 1) // 4 + 1, height // 8, width // 8)
        with torch.no_grad(), sdpa_kernel(SDPBackend.MATH), FlopCounterMode(display=False) as counter:
            transformer(states, torch.ones(1), torch.zeros(1, 512, 16), torch.zeros(1, 17, 32))
        assert wan_flops.pass_flops(TINY.architecture, num_frames, width, height, 17) == counter.get_total_flops()


class TestTheModels:
    def test_they_have_the_real_sizes(self) -> None:
        parts = wan_models.empty_parts(ATI)
        counts = {name: sum(p.numel() for p in part.parameters()) for name, part in parts.items()}
        assert counts == ATI.parameters

    def test_the_transformer_has_the_precisions_with_which_the_service_loads_it(self, tmp_path: Path) -> None:
        toy = make_tiny(TINY.architecture).transformer
        toy.save_pretrained(tmp_path)
        loaded = load_transformer(tmp_path, TINY.architecture, torch.bfloat16, CPU)
        wan_models.fill(toy, torch.bfloat16, CPU, CPU, toy._keep_in_fp32_modules)
        assert {n: p.dtype for n, p in toy.named_parameters()} == {n: p.dtype for n, p in loaded.named_parameters()}
        assert toy.blocks[0].norm2.weight.eq(1).all()

    def test_the_way_of_the_real_size(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """All but the sizes of it: parts without memory that are filled, in bfloat16 where a profile says nothing."""
        small = {"vocab_size": 300, "d_model": 16, "d_kv": 8, "d_ff": 32, "num_layers": 1, "num_heads": 2}
        monkeypatch.setattr(wan_models, "TEXT_ENCODER", wan_models.TEXT_ENCODER | small)
        small = {"hidden_size": 32, "intermediate_size": 64, "num_hidden_layers": 2, "num_attention_heads": 2}
        monkeypatch.setattr(wan_models, "IMAGE_ENCODER", wan_models.IMAGE_ENCODER | small)
        vae = make_tiny(TINY.architecture).vae
        monkeypatch.setattr(wan_models, "AutoencoderKLWan", lambda: vae)
        case = replace(SMALLEST, manifest=ATI.model_copy(update={"architecture": TINY.architecture}))
        assert not case.toy
        default = Profile.model_validate({"summary": "", "sampling": TINY.profiles["exact"]["sampling"]})
        for profile in (default, None):
            studio = wan_models.Studio(case, profile)
            parts = {name: part.dtype for name, part in studio.pipeline.components.items() if hasattr(part, "dtype")}
            names = ("transformer", "text_encoder", "image_encoder", "vae")
            assert [parts[name] for name in names] == [torch.bfloat16, torch.bfloat16, torch.float32, torch.float32]
            assert studio.clip(case.sampled(default.sampling)).passes == 4

    def test_plain_takes_no_attention_from_who_ran_before(self) -> None:
        before = {**TINY.profiles["exact"], "acceleration": {"attention": "_native_math"}}
        wan_models.Studio(SMALLEST, Profile.model_validate(before))
        plain = wan_models.Studio(SMALLEST, None).pipeline
        assert plain.transformer.blocks[0].attn1.processor._attention_backend == "native"
