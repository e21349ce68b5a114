"""The speed benchmark at toy size: that its figures hang together and its formula is right. Never how fast it is."""

from __future__ import annotations

import io
import json
import subprocess
import sys
import warnings
from argparse import Namespace
from collections.abc import Iterator
from contextlib import redirect_stdout
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import torch
from conftest import ROOT
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.utils.flop_counter import FlopCounterMode

from cow_service.generators.wan import acceleration
from cow_service.generators.wan.checkpoints import load_transformer
from cow_service.generators.wan.profiles import Profile, Sampling
from cow_service.generators.wan.tiny import make_tiny
from cow_service.weights.manifests import load_manifests

BENCHMARKS = ROOT / "benchmarks"
sys.path.insert(0, str(BENCHMARKS))

import wan_bench  # noqa: E402
import wan_flops  # noqa: E402
import wan_models  # noqa: E402
import wan_plan  # noqa: E402
import wan_rows  # noqa: E402
import wan_speed  # noqa: E402

pytestmark = pytest.mark.slow

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
    @pytest.mark.soak  # twenty seconds of imports; the classes below run the same script with every package
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


@pytest.fixture(scope="module", autouse=True)
def _measured_once() -> Iterator[None]:
    """The machine's peak and the golden figures stay the same: the first survey of this process measures them."""
    with pytest.MonkeyPatch.context() as patch:
        for name in ("matmul_peak", "distances"):
            patch.setattr(wan_speed, name, cache(getattr(wan_speed, name)))
        yield


@pytest.fixture(scope="module")
def parts(tmp_path_factory: pytest.TempPathFactory) -> Whole:
    """All rows of a run within a budget that this machine can run: nothing is compiled but in a test of its own."""
    file = tmp_path_factory.mktemp("rows") / "found.json"
    size = ["--num-frames", "9", "--width", "48", "--height", "32", "--budget", "500"]
    told = io.StringIO()
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(told), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # as in a process of its own
        patch.setattr(torch, "compile", lambda function: function)
        patch.setattr(sys, "argv", ["wan_speed.py", "--model", "tiny-ati", *size, "--json", str(file)])
        assert wan_speed.main() == 0
    return Whole(told.getvalue(), "", json.loads(file.read_text()))


@pytest.mark.soak  # half a minute; what a budget leaves out, and the plan, are tested below
class TestABudget:
    def test_every_row_has_its_figures(self, parts: Whole) -> None:
        status = {result["name"]: result["status"] for result in parts.found["results"]}
        needs_gpu = set() if torch.cuda.is_available() else {"cuDNN", "fp8", "group offload"}
        assert {name for name, each in status.items() if each == "refused"} == needs_gpu
        assert {name for name, each in status.items() if each == "measured"} == set(status) - needs_gpu
        assert [name for name in status if name != "build"] == [row.name for row in wan_rows.rows(SMALLEST, "native")]
        compiled = parts.figures("compiled")
        assert len(compiled["pass_s"]) == 2, "the second pass, and the first size again"
        assert compiled["any_size_tflops"] > 0
        assert (
            min(compiled["cold_s"], compiled["second_size_cold_s"], compiled["second_size_s"], *compiled["pass_s"]) > 0
        )
        guided = parts.figures("both guidance passes")
        assert guided["two_over_one"] == pytest.approx(guided["two_passes_s"] / guided["one_batch_s"], rel=0.01)
        for form in ("float32", "bfloat16", "float32, channels last", "bfloat16, channels last", "float32, tiled"):
            assert min(parts.figures(f"VAE {form}")[key] for key in ("encode_s", "decode_s")) > 0
        clip = parts.figures("turbo clip")
        assert clip["steps"] == TINY.profiles["turbo"]["sampling"]["steps"]
        assert sum(clip["parts_s"].values()) == pytest.approx(clip["total_s"], rel=0.01)

    def test_the_dearest_kernels(self, parts: Whole) -> None:
        found = parts.figures("kernels")
        shares = [one["share"] for one in found["kernels"]]
        assert len(shares) == wan_bench.KERNELS
        assert shares == sorted(shares, reverse=True)
        assert 0.3 < sum(shares) <= 1.001
        assert any("mm" in one["name"] for one in found["kernels"])
        assert not [one["name"] for one in found["kernels"] if "##" in one["name"]]

    def test_whole_clips_are_computed_and_said_to_be(self, parts: Whole) -> None:
        clips = {one["name"]: one for one in parts.found["computed"]}
        assert set(clips) >= {"eager", "compiled"}
        sampling = TINY.profiles["exact"]["sampling"]
        passes = 2 * sampling["steps"] * parts.figures("eager")["pass_s"][-1]
        vae = parts.figures("VAE float32")
        assert clips["eager"]["steps"] == sampling["steps"]
        assert clips["eager"]["total_s"] > passes + vae["encode_s"] + vae["decode_s"]
        assert f"eager, a clip of 4 steps: {clips['eager']['total_s']:g} s (computed)" in parts.told


def test_a_form_is_left_as_it_was_found() -> None:
    """Compiled, cached, tiled and back: the passes are those of the plain model again."""
    bench = wan_bench.Bench(SMALLEST, 1e12)

    def answer() -> torch.Tensor:
        given = bench._inputs(5, 1)
        with torch.no_grad(), bench._transformer.cache_context("cond"):
            return bench._transformer(**given, return_dict=False)[0]

    before, plain = answer(), wan_bench.Acceleration(attention="native")
    bench.put(plain)
    last, calls = bench._transformer.blocks[-1], list[int]()
    handle = last.attn1.register_forward_pre_hook(lambda *_: calls.append(1))
    found = bench.cached()
    handle.remove()
    assert found["at_skip_s"] > 0
    assert len(calls) == 2 + 1, "both passes where nothing is skipped, then the first one"
    assert not bench._transformer.is_cache_enabled
    assert torch.equal(answer(), before)
    for dtype in (torch.bfloat16, torch.float32):
        bench.vae(dtype, channels_last=True, tiled=True)
    vae = bench.pipeline.vae
    assert not vae.use_tiling
    assert all(weight.is_contiguous() and weight.dtype == torch.float32 for weight in vae.parameters())


def test_a_budget_leaves_out_what_would_not_be_done_in_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """What is guessed is made far too little for the first one: the others are then known to take too long."""
    file = tmp_path / "found.json"
    monkeypatch.setattr(wan_speed, "time_attention", lambda case: ())
    monkeypatch.setattr(wan_rows, "reckoned", lambda *_: 1e-6)
    monkeypatch.setattr(wan_rows, "build_seconds", lambda case: 0.0)
    monkeypatch.setattr(wan_plan.Budget, "left", property(lambda _: 0.001))
    found = wan_speed.survey(SMALLEST, [], file, wan_plan.Budget(1))
    first, *others = [
        each for each in json.loads(file.read_text())["results"] if each["name"] not in {"build", "cuDNN"}
    ]
    assert (first["name"], first["status"]) == ("eager", "measured")
    assert first["seconds"] > 0
    assert {each["status"] for each in others} <= {"skipped", "refused"}
    assert "s are left" in next(each["reason"] for each in others if each["name"] == "VAE float32")
    assert "VAE float32: skipped. It would take" in wan_speed.table(found)


def test_a_model_that_does_not_fit_is_a_result(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A real allocation that no machine can serve: what was measured before it is kept."""
    monkeypatch.setattr(wan_bench, "build", lambda *_: torch.empty(2**50, dtype=torch.float64))
    file = tmp_path / "found.json"
    found = wan_speed.survey(SMALLEST, [], file, wan_plan.Budget(1000))
    kept = json.loads(file.read_text())
    assert kept["golden"] == found["golden"]
    assert [(each["name"], each["status"]) for each in kept["results"]] == [("build", "failed")]
    assert "'build' does not fit into memory" in kept["results"][0]["reason"]
    assert "build: failed. 'build' does not fit" in wan_speed.table(found)


@pytest.mark.parametrize("more", [["--profile", "exact"], ["--steps", "4"], ["--against", "plain"], ["--runs", "2"]])
def test_what_a_budget_would_not_heed_is_refused(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], more: list[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["wan_speed.py", "--budget", "60", *more])
    with pytest.raises(SystemExit) as ended:
        wan_speed.main()
    assert ended.value.code == 2
    assert f"{more[0]} is about the clips of profiles" in capsys.readouterr().err


def test_what_is_reckoned_grows_with_the_clip() -> None:
    short, whole = (
        [wan_rows.reckoned(row, replace(SMALLEST, manifest=ATI, num_frames=frames, width=832, height=480), 7e14)
         for row in wan_rows.rows(SMALLEST, "native")]
        for frames in (17, 81)
    )  # fmt: skip
    assert all(one <= other for one, other in zip(short, whole, strict=True))
    assert sum(whole) > 1.1 * sum(short)


@pytest.mark.parametrize("model", ["tiny-ati", "ati"])
def test_the_plan_says_what_would_be_run_and_runs_nothing(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], model: str
) -> None:
    monkeypatch.setattr(wan_models, "build", None)  # building a model fails
    monkeypatch.setattr(wan_speed, "choose_device", lambda name, unavailable: CPU)
    monkeypatch.setattr(sys, "argv", ["wan_speed.py", "--model", model, "--plan", "--budget", "60"])
    assert wan_speed.main() == 0
    told = capsys.readouterr().out
    assert "(reckoned)." in told.splitlines()[0]
    assert "golden figures, attention, build: 2" in told, "what is measured first"
    assert "compiled: " in told
    assert "not within the budget" in told
    if model == "ati":
        assert "NVIDIA H100 (assumed: there is no GPU here)" in told
        assert "refused" not in told
    else:
        assert "group offload: refused. offload: group needs a GPU" in told
        assert "Not installed here: flash-attn>=2.6.3" in told


@pytest.mark.parametrize("options", [{"cache": "first-block"}, {"cache": "dbcache"}])
def test_passes_that_a_cache_skips_are_told_from_the_others(options: dict[str, Any]) -> None:
    """With a threshold that skips whatever may be skipped: dbcache computes the first fifth, then one of four."""
    profile = Profile(
        summary="",
        sampling=Sampling(steps=10, shift=5.0, guidance_scale=5.0),
        dtype="float32",
        acceleration=acceleration.Acceleration(cache_threshold=1e9, **options),
    )
    timing = wan_models.Studio(SMALLEST, profile).clip(profile.sampling)
    assert (timing.passes, timing.computed) == (20, 2 if options["cache"] == "first-block" else 8)


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


def test_weights_are_offloaded_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    """Hooks that move blocks from one memory to another work within one memory, too: only the check is a fake."""
    bench = wan_bench.Bench(SMALLEST, 1e12)
    monkeypatch.setattr(acceleration, "check_device", lambda wanted, device: None)
    old = bench._transformer
    found = bench.offloaded()
    assert bench._transformer is not old
    assert hasattr(bench._transformer.blocks[0], "_diffusers_hook")
    assert min(found["pinning_s"], *found["pass_s"], found["host_peak_gb"]) > 0


@pytest.mark.soak
@pytest.mark.timeout(600)
def test_first_contact_goes_the_whole_way(tmp_path: Path) -> None:
    given = ("--toy", "--num-frames", "5", "--profile", "exact", "--json", str(tmp_path / "found.json"))
    subprocess.run([sys.executable, str(BENCHMARKS / "first_contact.py"), *given], check=True, capture_output=True)
    found = {row["name"]: row for row in json.loads((tmp_path / "found.json").read_text())["rows"]}
    assert found["portable"]["exit"] == 0
    assert found["exact"]["exit"] == (0 if torch.cuda.is_available() else 1)
    assert found["exact"].get("grey_levels_off_portable", 0) < 2
    assert found["serve: cancel"]["status"] == "canceled"
    assert [found[f"serve: {clip}"]["status"] for clip in ("first clip", "after a cancel")] == [200, 200]
