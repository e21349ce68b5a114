"""`cow eval` as it is run: a real process, a real server in it, and an MLLM on loopback whose accuracy is known.

The processes are forked from one that has made the imports, which take most of a small run's time; that of Inspect's
own command begins from nothing.
"""

from __future__ import annotations

import json
import math
import os
import shutil
import signal
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.metadata import entry_points
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from conftest import EXAMPLES, ROOT, SCALE
from forked import Template, template
from refusals import refused
from truth_mllm import TruthMllm, truth_mllm
from waiting import eventually

from cow_service.evals.items import Item, Pictures
from cow_service.evals.loaders import load
from cow_service.media.images import decode

if TYPE_CHECKING:
    from cow_service.evals.report.summary import ArmSummary, Findings
    from cow_service.evals.runs import EvalRun

pytestmark = [pytest.mark.slow, pytest.mark.timeout(420)]
SAMPLE = ROOT / "cow-scenes" / "sample"
ALL_ARMS = (
    *("never", "always", "auto", "gate", "always:vote-2", "never:vote-2", "placebo-still"),
    *("placebo-direction", "placebo-item", "encounters", "frames-only", "oracle"),
)
PICTURES_SHOWN = {"never": 1, "always": 4, "encounters": 1, "frames-only": 3, "oracle": 4}
PICTURES_SHOWN |= {"placebo-still": 4, "placebo-item": 4}
LIMIT, REPEATS = (4, 1) if SCALE == 1 else (12, 2)
MODEL = "openai-api/local/fake"
# What a run imports, Inspect's own parts among it.
IMPORTED = (
    *(
        "cow_service.evals.run",
        "cow_service.evals.report.figures",
        "cow_service.server",
        "matplotlib.backends.backend_svg",
    ),
    *("inspect_ai.model._providers.openai_compatible", "inspect_ai.model._providers.anthropic", "acp", "json_repair"),
)


@pytest.fixture(scope="module")
def items(tmp_path_factory: pytest.TempPathFactory) -> list[Item]:
    return load(str(SAMPLE), Pictures(tmp_path_factory.mktemp("pictures"))).items[:LIMIT]


@pytest.fixture
def mllm(items: list[Item]) -> Iterator[TruthMllm]:
    with truth_mllm(items) as one:
        yield one


@pytest.fixture(scope="module")
def imported(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Template]:
    with template(tmp_path_factory.mktemp("imported"), IMPORTED, environment()) as one:
        yield one


def environment() -> dict[str, str]:
    kept = {name: value for name, value in os.environ.items() if not name.startswith(("COW_", "INSPECT_"))}
    # The server computes in its own process: a worker takes longer to start than it would have to do.
    own = {"COW_CONCURRENCY": "1", "COW_WORKERS": "false", "COW_WARMUP": "false"}
    return {**kept, **own, "LOCAL_API_KEY": "none"}


def own(mllm: TruthMllm) -> tuple[str, ...]:
    return "--mllm", MODEL, "--base-url", mllm.address


def evaluated(imported: Template, out: Path, *arguments: str, code: int = 0) -> subprocess.CompletedProcess[str]:
    """A command `cow eval` that has ended."""
    done = imported.begin(["eval", *arguments, "--out", str(out)], out.parent, environment()).done()
    assert done.returncode == code, done.stdout[-2000:] + done.stderr[-4000:]
    assert "Traceback" not in done.stderr
    return done


def read_run(folder: Path) -> EvalRun:
    from cow_service.evals.runs import read_run

    return read_run(folder)


def summarize(run: EvalRun) -> Findings:
    from cow_service.evals.report.summary import summarize

    return summarize([run])


@dataclass(frozen=True)
class Done:
    """A run of all arms, and what was asked in it."""

    run: EvalRun
    arms: dict[str, ArmSummary]
    findings: Findings
    mllm: TruthMllm
    out: Path
    told: str


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory, items: list[Item], imported: Template) -> Iterator[Done]:
    out = tmp_path_factory.mktemp("all") / "run"
    with truth_mllm(items, without=0.3, with_frames=1.0, seed=1) as mllm:
        asked = ("--arm", ",".join(ALL_ARMS), "--repeats", str(REPEATS), "--limit", str(LIMIT))
        told = evaluated(imported, out, str(SAMPLE), *own(mllm), *asked)
        run = read_run(out)
        found = summarize(run)
        yield Done(run, {each.arm: each for each in found.arms}, found, mllm, out, told.stdout)


def test_every_question_is_asked_once_in_every_arm_and_repeat(done: Done, items: list[Item]) -> None:
    seen = done.run.observations
    repeats = range(1, REPEATS + 1)
    assert Counter((each.arm, each.item, each.repeat) for each in seen) == Counter(
        (arm, item.id, repeat) for arm in ALL_ARMS for item in items for repeat in repeats
    )
    assert [each.failure for each in seen if each.failure] == []
    assert sum(each.calls for each in seen) == sum(done.mllm.asked.values()), "one request for each reply"
    cost = done.arms["never"].cost
    assert (cost.input_tokens, cost.output_tokens) == (400 * cost.replies, 20 * cost.replies)
    orders: dict[tuple[str, int], set[tuple[str, ...]]] = {}
    for each in seen:
        orders.setdefault((each.item, each.repeat), set()).add(each.options)
    assert {len(shown) for shown in orders.values()} == {1}, "the same order in all arms"
    assert len({next(iter(shown)) for shown in orders.values()}) > 2


def test_an_arm_shows_what_it_is_named_for(done: Done) -> None:
    frames = {arm: {each.item: each.frames for each in done.run.of_arm(arm)} for arm in ALL_ARMS}
    for arm, pictures in PICTURES_SHOWN.items():
        shown = {len(each.frames) for each in done.run.of_arm(arm) if each.refusal is None}
        assert shown == {pictures - (arm != "frames-only")}, arm
    assert {len(set(shown)) for shown in frames["placebo-still"].values() if shown} == {1}
    borrowed = frames["placebo-item"]
    assert any(borrowed.values())
    assert not any({*frames["always"][item]} & {*shown} for item, shown in borrowed.items()), "of another item"
    assert [item for item, shown in frames["always"].items() if shown == frames["placebo-direction"][item] != ()] == []
    pictures = Pictures(done.out / "pictures")

    def sizes(arm: str) -> dict[str, tuple[int, ...]]:
        return {item: decode(pictures.read(shown[0])).pixels.shape for item, shown in frames[arm].items() if shown}

    own_sizes = sizes("always")
    for arm in ("placebo-still", "placebo-direction", "placebo-item", "oracle"):
        assert all(own_sizes.get(item, shape) == shape for item, shape in sizes(arm).items()), arm


def test_what_frames_are_worth_is_what_the_mllm_makes_of_them(done: Done) -> None:
    """It is always right where it sees frames, and no better for a placebo than without."""
    looked = [each for each in done.run.of_arm("always") if each.refusal is None]
    assert looked
    assert all(each.right for each in looked)
    assert all(each.right for each in done.run.of_arm("oracle"))
    assert done.arms["placebo-still"].rates.tpr.mean < 0.8 > done.arms["never"].rates.tpr.mean
    gained = done.arms["always"].gain
    assert gained is not None
    assert gained.gain > 0.2
    assert gained.helped > 2 * REPEATS > gained.hurt


def test_the_gate_asks_thrice_before_and_imagines_where_answers_differ(done: Done) -> None:
    calls = {arm: {each.item: each.calls for each in done.run.of_arm(arm)} for arm in ALL_ARMS}
    imagined = {each.item: bool(each.frames) or each.refusal is not None for each in done.run.of_arm("auto")}
    assert calls["auto"] == {item: 3 + looked for item, looked in imagined.items()}
    assert calls["gate"] == calls["auto"]
    assert set(imagined.values()) == {False, True}
    assert {*calls["always:vote-2"].values(), *calls["never:vote-2"].values()} == {2}
    assert {each.imaginations for each in done.run.of_arm("always:vote-2") if each.refusal is None} == {2}
    assert not any(each.frames for each in done.run.of_arm("gate")), "nothing is shown"


def test_true_frames_are_drawn_along_the_true_path(done: Done) -> None:
    assert {each.path_error for each in done.run.of_arm("oracle")} == {0.0}
    errors = [each.path_error for each in done.run.of_arm("always") if each.refusal is None]
    assert all(error is not None and 0 < error < 0.2 for error in errors)
    simulations = [each for each in done.run.of_arm("always") if each.probability is not None]
    assert any(each.event_shown for each in simulations)
    assert not any(each.event_shown is False for each in simulations), "the default frames go on to the moment"
    assert {each.by for each in done.findings.splits} > {"simulation", "frames"}


def test_the_record_says_what_was_asked_of_whom_and_keeps_a_picture_once(done: Done) -> None:
    told = json.loads((done.out / "run.json").read_text())
    assert told["versions"]["commit"]
    assert told["replied_as"] == ["fake"]
    assert told["arms"]["always:vote-2"]["votes"] == 2
    assert (told["options"]["seed"], told["options"]["mllm"]) == (0, MODEL)
    pictures, artifacts = done.out / "pictures", done.out / "server" / "artifacts"
    both = [(path, artifacts / path.relative_to(pictures)) for path in pictures.rglob("*.png")]
    both = [(path, same) for path, same in both if same.is_file()]
    assert len(both) > 10
    assert all(path.samefile(same) for path, same in both)
    logs = sum(path.stat().st_size for path in (done.out / "logs").glob("*.eval"))
    assert logs < 2_000_000, "no pictures in the logs"


def test_the_report_has_tables_plots_pictures_and_a_manifest(done: Done) -> None:
    report = done.out / "report"
    names = {path.relative_to(report).as_posix() for path in report.rglob("*") if path.is_file()}
    kinds = ("primary", "levels", "arms", "gains", "why", "cost")
    tables = {f"tables/{name}.{form}" for name in kinds for form in ("md", "csv", "tex")}
    tables |= {f"plots/{name}.svg" for name in ("gains", "rates", "calibration")}
    assert {"report.md", "manifest.json", "tables/replies.csv", *tables} <= names
    manifest = json.loads((report / "manifest.json").read_text())
    assert manifest["runs"][0]["versions"]["prompts/eval-question"].startswith("1 (sha256 ")
    assert set(manifest["files"]) == names - {"manifest.json"}
    assert "| always" in done.told
    assert "GPT-5 (paper)" not in (report / "report.md").read_text(), "these are other data"


def test_a_plan_is_asked_and_followed_and_failures_are_retried_on_request(
    tmp_path: Path, items: list[Item], mllm: TruthMllm, imported: Template
) -> None:
    plan, run, limit = tmp_path / "plan.json", tmp_path / "run", ("--limit", "2")
    asked = (str(SAMPLE), *own(mllm), "--arm", "never,always,placebo-still", *limit)
    planned = ("--plan", str(plan))
    assert "2,726 scenes" in evaluated(imported, plan, "plan", *asked).stdout
    assert not mllm.asked

    def failures() -> set[str]:
        return {str(each.failure) for each in read_run(run).observations if each.failure}

    mllm.refuses = items[0].question[0][:40]
    refused_items = [item for item in items[:2] if mllm.refuses in item.question[0]]
    begun = evaluated(imported, run, *planned, code=3)
    assert "--retry-failed" in begun.stderr
    assert f"{3 * len(refused_items)} questions failed" in begun.stdout
    assert failures()
    assert all("The model is away." in reason for reason in failures())
    before, mllm.refuses = mllm.asked.total(), ""
    departed = evaluated(imported, run, str(SAMPLE), *own(mllm), "--arm", "encounters", *limit, code=3)
    assert "explored besides: encounters" in departed.stdout
    assert mllm.asked.total() == before + 2, "failures are not asked again by themselves"
    assert "as planned" in evaluated(imported, run, *planned, "--retry-failed").stdout
    assert (len(read_run(run).observations), mllm.asked.total(), failures()) == (8, 8, set())
    assert "--seed" in evaluated(imported, run, *planned, "--seed", "4", code=1).stderr


@pytest.mark.scaled
def test_killed_or_interrupted_no_reply_is_asked_for_twice(tmp_path: Path, mllm: TruthMllm, imported: Template) -> None:
    """Only what was under way when the run was killed, or ended in peace, is asked again."""
    limit = 3 * min(SCALE, 3)
    out, repeats, arms, in_flight = tmp_path / "run", 3, 2, 2
    asked = [str(SAMPLE), *own(mllm), "--arm", "never,always", "--repeats", str(repeats)]
    asked += ["--limit", str(limit), "--concurrency", str(in_flight)]
    lost: Counter[str] = Counter()
    for number, (by, code) in enumerate([(signal.SIGKILL, -signal.SIGKILL), (signal.SIGINT, 130)], 1):
        mllm.hold_after(5)
        process = imported.begin(["eval", *asked, "--out", str(out)], tmp_path, environment())
        # All places wait for the MLLM: the replies before were read, and are kept.
        eventually(lambda: mllm.left == 0 and mllm.waiting.total() == in_flight)
        lost += mllm.waiting
        process.send_signal(by)
        done = process.done()
        assert done.returncode == code, done.stderr
        assert "Traceback" not in done.stderr
        assert mllm.asked.total() == number * (5 + in_flight)
        mllm.hold_after(math.inf)
        eventually(lambda: mllm.waiting.total() == 0)
    told = evaluated(imported, out, *asked).stdout
    assert lost.total() == 2 * in_flight
    assert mllm.asked.total() == arms * limit * repeats + lost.total()
    seen = read_run(out).observations
    assert len({(each.arm, each.item, each.repeat) for each in seen}) == len(seen) == arms * limit * repeats
    assert {each.failure for each in seen} == {None}
    assert evaluated(imported, out, *asked).stdout == told, "a finished run says the same"
    assert mllm.asked.total() == arms * limit * repeats + lost.total(), "and asks nothing more"
    assert "--seed 0, not 7" in evaluated(imported, out, *asked, "--seed", "7", code=1).stderr


# What is asked for, and what the refusal names.
REFUSED: dict[str, dict[str, Any]] = {
    "sometimes": {"arms": ["sometimes"]},
    "placebo-still": {"arms": ["placebo-still"], "ask": "answer", "mllm": None},
    "--temperature": {"ask": "answer", "mllm": None, "temperature": 0.0},
    "--max-tokens": {"ask": "answer", "mllm": None, "max_tokens": 9},
    "--mllm": {"mllm": None},
    "--url": {"ask": "answer", "url": "http://127.0.0.1:9"},
    "mockllm": {"ask": "answer", "arms": ["always"]},
    "nobody/nothing": {"mllm": "nobody/nothing"},
}


@pytest.mark.parametrize("named", REFUSED)
def test_what_cannot_be_asked_is_refused_before_the_first_call(tmp_path: Path, named: str) -> None:
    from cow_service.evals.request import EvalRequest
    from cow_service.evals.run import evaluate

    wanted = {"mllm": "mockllm/model"} | REFUSED[named]
    with refused("invalid-request") as caught:
        evaluate(EvalRequest(str(EXAMPLES), tmp_path, **wanted), lambda told: None)
    assert named in str(caught.value)
    assert not (tmp_path / "run.json").exists(), "the folder stays free"


@pytest.mark.parametrize(
    ("asked", "code"),
    {
        ("--url", "http://127.0.0.1:9"): "server-unreachable",
        ("--reader", "embeded"): "invalid-request",
        ("--prices", "nothing.yaml"): "invalid-request",
        ("--plan", "nothing.json"): "invalid-request",
    }.items(),
    ids=str,
)
def test_what_a_command_cannot_use_is_named(
    tmp_path: Path, mllm: TruthMllm, imported: Template, asked: tuple[str, str], code: str
) -> None:
    data = () if "--plan" in asked else (str(EXAMPLES), *own(mllm))
    told = evaluated(imported, tmp_path / "run", *data, *asked, code=1).stderr
    assert told.startswith(f"{code}: ")
    assert asked[1] in told
    assert not mllm.asked
    assert not (tmp_path / "run" / "run.json").exists(), "the folder stays free"


def test_without_an_mllm_the_embedded_reader_answers(tmp_path: Path, imported: Template) -> None:
    scenes = tmp_path / "scenes"
    for name in ("ball-and-mug", "car-forward"):
        shutil.copytree(EXAMPLES / name, scenes / name)
    unclear = scenes / "car-forward" / "meta.json"
    unclear.write_text(unclear.read_text().replace(" moves forward", " moves"))
    told = evaluated(imported, tmp_path / "run", str(scenes)).stdout
    run = read_run(tmp_path / "run")
    known = {(each.arm, each.item): each for each in run.observations}
    assert all(known["never", item].abstained for item in run.items), "it sees nothing in the image alone"
    assert known["always", "collision_108"].right
    assert {each.refusal for each in run.of_arm("always")} == {None, "cannot-read-direction"}
    assert "| always" in told


def test_inspect_finds_the_task() -> None:
    (entry,) = entry_points(group="inspect_ai", name="cow_service")
    assert len(entry.load().causalspatial(data=str(SAMPLE), arm="always").dataset) == 12


@pytest.mark.soak  # it begins from nothing, which takes as long as everything else here
def test_inspects_own_command_runs_the_task(tmp_path: Path, mllm: TruthMllm) -> None:
    given = {"LOCAL_BASE_URL": mllm.address, "INSPECT_CACHE_DIR": str(tmp_path / "cache")}
    options = ("-T", f"data={SAMPLE}", "-T", "arm=always", "--limit", "2", "--epochs", "2", "--display", "none")
    command = [sys.executable, "-m", "inspect_ai", "eval", "cow_service/causalspatial", *options, "--model", MODEL]
    known = {**environment(), **given}
    done = subprocess.run(command, cwd=tmp_path, env=known, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    assert mllm.asked.total() == 4 or len(mllm.asked) < 4
    from inspect_ai.log import list_eval_logs, read_eval_log

    (info,) = list_eval_logs(str(tmp_path / "logs"))
    log = read_eval_log(info)
    assert log.status == "success"
    assert log.samples is not None
    assert [len(sample.messages[0].content) for sample in log.samples] == [5] * 4, "image, three frames, question"
    assert log.results is not None
    assert {score.name for score in log.results.scores} == {"right", "abstained", "unreadable"}
