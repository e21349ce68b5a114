"""`cow eval` as it is run: a real process, a real server in it, and an MLLM on loopback whose accuracy is known.

The processes are forked from one that has made the imports, which take most of a small run's time; that of Inspect's
own command begins from nothing.
"""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import pytest
from conftest import EXAMPLES, ROOT, SCALE
from forked import Template, template
from truth_mllm import TruthMllm, truth_mllm
from waiting import eventually

from cow_service.evals.items import Item, Pictures
from cow_service.evals.loaders import load
from cow_service.evals.report.summary import ArmSummary, Findings, summarize
from cow_service.evals.runs import EvalRun, read_run
from cow_service.media.images import decode

pytestmark = [pytest.mark.slow, pytest.mark.timeout(420)]
SAMPLE = ROOT / "cow-scenes" / "sample"
KILLS = 1 if SCALE == 1 else 3
ALL_ARMS = (
    *("never", "always", "auto", "gate", "always:vote-2", "never:vote-2", "placebo-still"),
    *("placebo-direction", "placebo-item", "encounters", "frames-only", "oracle", "oracle:error-2"),
)
PICTURES_SHOWN = {"never": 1, "always": 4, "encounters": 1, "frames-only": 3, "oracle": 4}
PICTURES_SHOWN |= {"placebo-still": 4, "placebo-item": 4, "oracle:error-2": 4}
REPEATS = 1 if SCALE == 1 else 2
MODEL = "openai-api/local/fake"
READ_WITHIN = 1.5  # seconds after a reply was sent: the first one loads what reads it
# What a run imports, Inspect's own parts among it.
IMPORTED = (
    *("cow_service.evals.run", "cow_service.evals.report.figures", "cow_service.server", "cow_service.workers.pool"),
    *("inspect_ai.model._providers.openai_compatible", "inspect_ai.model._providers.anthropic", "acp", "json_repair"),
)


@pytest.fixture(scope="module")
def items(tmp_path_factory: pytest.TempPathFactory) -> list[Item]:
    return load(str(SAMPLE), Pictures(tmp_path_factory.mktemp("pictures"))).items


@pytest.fixture
def mllm(items: list[Item]) -> Iterator[TruthMllm]:
    with truth_mllm(items) as one:
        yield one


@pytest.fixture(scope="module")
def imported(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Template]:
    with template(tmp_path_factory.mktemp("imported"), IMPORTED, environment()) as one:
        yield one


def arguments_of(data: Path, out: Path, *arguments: str, mllm: TruthMllm | None = None) -> list[str]:
    own = ["--mllm", MODEL, "--base-url", mllm.address] if mllm else []
    return ["eval", str(data), "--out", str(out), *own, *arguments]


def environment() -> dict[str, str]:
    kept = {name: value for name, value in os.environ.items() if not name.startswith(("COW_", "INSPECT_"))}
    # One worker in the server: a second one takes longer to start than it would have to do.
    return {**kept, "LOCAL_API_KEY": "none", "COW_CONCURRENCY": "1"}


def evaluated(
    imported: Template, out: Path, *arguments: str, mllm: TruthMllm, code: int = 0, **settings: str
) -> subprocess.CompletedProcess[str]:
    asked = arguments_of(SAMPLE, out, *arguments, mllm=mllm)
    return checked(imported.begin(asked, out.parent, environment() | settings).done(), code)


def checked(done: subprocess.CompletedProcess[str], code: int = 0) -> subprocess.CompletedProcess[str]:
    assert done.returncode == code, done.stdout[-2000:] + done.stderr[-4000:]
    assert "Traceback" not in done.stderr
    return done


# What is asked with and what the refusal says.
REFUSED = {
    ("--arm", "sometimes"): "There is no arm 'sometimes'",
    ("--arm", "placebo-item", "--limit", "1"): "shows frames of another scene, and there is only one",
    ("--arm", "content=none,frames=initial"): "none shows no frames: leave frames out",
    ("--arm", "always:vote-99"): "votes: Input should be less than or equal to 16",
    ("--plan", "nothing.json"): "The plan 'nothing.json' cannot be read",
    ("--subset", "physic"): "There is no subset 'physic'",
    ("--ask", "answer", "--arm", "placebo-still"): "/answer has no arm 'placebo-still'",
    ("--url", "http://127.0.0.1:9"): "The server at http://127.0.0.1:9 cannot be asked",
    ("--reader", "embeded"): "--reader embeded: the server has only",
    ("--ask", "answer", "--temperature", "1"): "are for --ask prompt",
    ("--prices", "nothing.yaml"): "The prices 'nothing.yaml' cannot be read",
    ("--mllm", "nobody/nothing"): "--mllm nobody/nothing cannot be used",
}


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
    with truth_mllm(items, without=0.3, with_frames=1.0) as mllm:
        asked = ("--arm", ",".join(ALL_ARMS), "--repeats", str(REPEATS))
        told = evaluated(imported, out, *asked, mllm=mllm, COW_CONCURRENCY="2")
        run = read_run(out)
        found = summarize([run])
        yield Done(run, {each.arm: each for each in found.arms}, found, mllm, out, told.stdout)


def test_every_question_is_asked_in_every_arm_and_repeat(done: Done, items: list[Item]) -> None:
    asked = Counter((each.arm, each.item, each.repeat) for each in done.run.observations)
    assert set(asked.values()) == {1}
    assert set(asked) == {
        (arm, item.id, repeat) for arm in ALL_ARMS for item in items for repeat in range(1, REPEATS + 1)
    }
    assert [each.failure for each in done.run.observations if each.failure] == []


def test_all_arms_see_the_options_in_the_same_order(done: Done) -> None:
    orders: dict[tuple[str, int], set[tuple[str, ...]]] = {}
    for each in done.run.observations:
        orders.setdefault((each.item, each.repeat), set()).add(each.options)
    assert {len(shown) for shown in orders.values()} == {1}
    assert len({next(iter(shown)) for shown in orders.values()}) > 3


@pytest.mark.parametrize("arm", PICTURES_SHOWN)
def test_an_arm_shows_what_it_is_named_for(done: Done, arm: str) -> None:
    for each in done.run.of_arm(arm):
        if each.refusal is None:
            shown = len(each.frames) + (arm != "frames-only")
            assert shown == PICTURES_SHOWN[arm]
    still = {len(set(each.frames)) for each in done.run.of_arm("placebo-still") if each.refusal is None}
    assert still == {1}
    own = {each.item: set(each.frames) for each in done.run.of_arm("always")}
    others = {each.item: set(each.frames) for each in done.run.of_arm("placebo-item")}
    assert any(others.values())
    assert not any(own[item] & frames for item, frames in others.items()), "frames of another item"
    pictures = Pictures(done.out / "pictures")
    sizes = {
        arm: {
            each.item: decode(pictures.read(each.frames[0])).pixels.shape
            for each in done.run.of_arm(arm)
            if each.frames
        }
        for arm in ("always", "placebo-still", "placebo-direction", "placebo-item", "oracle")
    }
    for arm, shapes in sizes.items():
        assert all(sizes["always"].get(item, shape) == shape for item, shape in shapes.items()), arm
    right, wrong = (
        {each.item: each.frames for each in done.run.of_arm(f"{name}")} for name in ("always", "placebo-direction")
    )
    assert [item for item in right if right[item] == wrong[item] != ()] == []


def test_what_frames_are_worth_is_what_the_mllm_makes_of_them(done: Done) -> None:
    """It is always right where it sees frames, and no better for a placebo than without."""
    looked = [each for each in done.run.of_arm("always") if each.refusal is None]
    assert looked
    assert all(each.right for each in looked)
    assert all(each.right for each in done.run.of_arm("oracle"))
    assert done.arms["placebo-still"].rates.tpr.mean < 0.8 > done.arms["never"].rates.tpr.mean
    gained = done.arms["always"].gain
    assert gained is not None
    assert gained.low > 0
    assert gained.helped > 5 * REPEATS > gained.hurt


def test_the_gate_asks_thrice_before_and_imagines_where_answers_differ(done: Done) -> None:
    for each in done.run.of_arm("auto"):
        assert each.calls in (3, 4)
        assert (each.calls == 4) == (bool(each.frames) or each.refusal is not None)
    assert {each.calls for each in done.run.of_arm("always:vote-2")} == {2}
    assert {each.imaginations for each in done.run.of_arm("always:vote-2") if each.refusal is None} == {2}
    assert {each.calls for each in done.run.of_arm("never:vote-2")} == {2}
    assert {each.calls for each in done.run.of_arm("gate")} == {3, 4}, "as many calls as auto, and nothing shown"
    assert not any(each.frames for each in done.run.of_arm("gate"))


def test_true_frames_are_drawn_along_the_true_path_or_off_it(done: Done) -> None:
    errors: dict[str, dict[str, float | None]] = {
        arm: {each.item: each.path_error for each in done.run.of_arm(arm)}
        for arm in ("always", "oracle:error-2", "oracle")
    }
    assert set(errors["oracle"].values()) == {0.0}
    for item, own in errors["always"].items():
        off = errors["oracle:error-2"][item]
        assert own is not None or off is None, "where nothing was simulated, no error is known"
        # The simulation's own is measured at the moments of the truth, the other at those of the clip.
        assert own is None or off is None or off == pytest.approx(2 * own, rel=0.2, abs=0.002)
    simulations = [each for each in done.run.of_arm("always") if each.probability is not None]
    assert any(each.event_shown for each in simulations)
    assert not any(each.event_shown is False for each in simulations), "the default frames go on to the moment"
    assert done.findings.doses
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
    assert len(both) > 20
    assert all(path.samefile(same) for path, same in both)
    logs = sum(path.stat().st_size for path in (done.out / "logs").glob("*.eval"))
    assert logs < 2_000_000, "no pictures in the logs"


def test_a_plan_is_asked_and_followed(tmp_path: Path, items: list[Item], mllm: TruthMllm, imported: Template) -> None:
    plan = tmp_path / "plan.json"
    own = ["--mllm", MODEL, "--base-url", mllm.address]
    fixed = [
        "eval",
        "plan",
        str(SAMPLE),
        *own,
        "--arm",
        "never,always,placebo-still",
        "--limit",
        "3",
        "--out",
        str(plan),
    ]
    told = checked(imported.begin(fixed, tmp_path, environment()).done()).stdout
    assert "does always gain over placebo-still?" in told
    assert "2,726 scenes show a gain of 2.4 points" in told
    assert not mllm.asked
    planned = ["eval", "--plan", str(plan), "--out", str(tmp_path / "run")]
    done = checked(imported.begin(planned, tmp_path, environment()).done())
    assert "as planned" in done.stdout
    assert len(read_run(tmp_path / "run").observations) == 9
    refused = checked(imported.begin([*planned, "--seed", "4"], tmp_path, environment()).done(), 1)
    assert "The plan already sets --seed: leave that option out." in refused.stderr
    more = ["eval", str(SAMPLE), *own, "--arm", "encounters", "--limit", "3", "--out", str(tmp_path / "run")]
    departed = checked(imported.begin(more, tmp_path, environment()).done()).stdout
    assert "as planned (explored besides: encounters)" in departed
    assert "(explored)" in departed


def test_each_reply_was_one_request_and_counts_its_tokens(done: Done) -> None:
    assert sum(each.calls for each in done.run.observations) == sum(done.mllm.asked.values())
    cost = done.arms["never"].cost
    assert (cost.input_tokens, cost.output_tokens) == (400 * cost.replies, 20 * cost.replies)


def test_the_report_has_tables_plots_pictures_and_a_manifest(done: Done) -> None:
    report = done.out / "report"
    names = {path.relative_to(report).as_posix() for path in report.rglob("*") if path.is_file()}
    kinds = ("primary", "levels", "arms", "gains", "why", "doses", "cost")
    tables = {f"tables/{name}.{form}" for name in kinds for form in ("md", "csv", "tex")}
    assert {"index.html", "report.md", "manifest.json", "tables/replies.csv", *tables} <= names
    manifest = json.loads((report / "manifest.json").read_text())
    assert manifest["runs"][0]["versions"]["prompts/eval-question"].startswith("1 (sha256 ")
    assert set(manifest["files"]) == names - {"manifest.json"}
    assert "| always" in done.told
    assert "GPT-5 (paper)" not in (report / "report.md").read_text(), "these are other data"


def test_a_finished_run_asks_nothing_more_and_says_the_same(done: Done, imported: Template) -> None:
    before = sum(done.mllm.asked.values())
    again = evaluated(imported, done.out, "--arm", "never", "--repeats", "1", mllm=done.mllm)
    assert sum(done.mllm.asked.values()) == before
    assert again.stdout == done.told
    other = evaluated(imported, done.out, "--arm", "never", "--seed", "7", mllm=done.mllm, code=1)
    assert "other options: --seed 0, not 7." in other.stderr


@pytest.mark.scaled
def test_killed_or_interrupted_no_reply_is_asked_for_twice(
    tmp_path: Path, items: list[Item], imported: Template
) -> None:
    """Killed, then interrupted, which ends in peace, then gone on with: as if nothing had happened."""
    draws = random.Random(18)
    # Few at a time: much is left to ask when a run is struck.
    limits = ("--limit", "8" if SCALE > 1 else "4", "--concurrency", "2")
    arguments = ("--arm", "never,always", "--repeats", "3", *limits)
    with truth_mllm(items) as whole:
        evaluated(imported, tmp_path / "whole", *arguments, mllm=whole)
    ends: list[tuple[float, float]] = []  # when a run was struck, and when it was gone
    with truth_mllm(items, seconds=0.15) as mllm:

        def all_sent() -> None:
            eventually(lambda: len(mllm.done) == sum(mllm.asked.values()))

        def struck(by: signal.Signals, replies: int) -> subprocess.CompletedProcess[str]:
            """A run that gets a signal after a number of further replies."""
            all_sent()  # also what the run before was lost with
            wanted = len(mllm.done) + replies
            asked = arguments_of(SAMPLE, tmp_path / "struck", *arguments, mllm=mllm)
            process = imported.begin(asked, tmp_path, environment())
            deadline = time.monotonic() + 60
            while len(mllm.done) < wanted and time.monotonic() < deadline:
                time.sleep(0.01)
            begun = time.monotonic()
            process.send_signal(by)
            done = process.done()
            ends.append((begun, time.monotonic()))
            assert len(mllm.done) >= wanted
            return done

        for _ in range(KILLS):
            assert struck(signal.SIGKILL, draws.randint(6, 10)).returncode == -signal.SIGKILL
        mllm.seconds = 0.6  # the signal comes long before the last reply
        told = struck(signal.SIGINT, 3)
        assert told.returncode == 130
        assert "Interrupted. Run the same command again to resume." in told.stderr
        assert "Traceback" not in told.stderr
        mllm.seconds = 0.0
        evaluated(imported, tmp_path / "struck", *arguments, mllm=mllm)
        all_sent()
        assert mllm.asked.keys() == whole.asked.keys()
        # Replies under way at an end were lost; what came a moment before it may not have been read any more.
        lost = Counter(
            key
            for key, begun, sent in mllm.done
            if any(begun < gone and struck_at < sent + READ_WITHIN for struck_at, gone in ends)
        )
        twice = mllm.asked - lost - whole.asked
        assert not twice, [(ends, [each for each in mllm.done if each[0] == key]) for key in twice]
    assert {each.failure for each in read_run(tmp_path / "struck").observations} == {None}
    for name in ("levels", "arms", "gains"):
        tables = [(tmp_path / run / "report" / "tables" / f"{name}.md").read_text() for run in ("whole", "struck")]
        assert tables[0] == tables[1]


def test_failures_are_kept_with_their_reason_and_retried_on_request(
    tmp_path: Path, items: list[Item], mllm: TruthMllm, imported: Template
) -> None:
    mllm.refuses = items[0].question[0][:40]
    asked, limited = items[:6], ("--arm", "never", "--limit", "6")
    refused = [item.id for item in asked if mllm.refuses in item.question[0]]
    first = evaluated(imported, tmp_path / "run", *limited, mllm=mllm, code=3)
    assert f"{len(refused)} questions failed" in first.stderr or f"{len(refused)} question failed" in first.stderr
    failed = {each.item: each.failure for each in read_run(tmp_path / "run").observations if each.failure}
    assert set(failed) == set(refused)
    assert "The model is away." in str(failed[refused[0]])
    mllm.refuses = ""
    evaluated(imported, tmp_path / "run", *limited, mllm=mllm, code=3)
    assert sum(mllm.asked.values()) == len(asked) - len(refused), "failures are not asked again by themselves"
    evaluated(imported, tmp_path / "run", *limited, "--retry-failed", mllm=mllm)
    assert sum(mllm.asked.values()) == len(asked)
    assert [each.failure for each in read_run(tmp_path / "run").observations if each.failure] == []


@pytest.mark.parametrize(("asked", "message"), [*REFUSED.items(), (("--ask", "prompt"), "name it with --mllm")])
def test_what_cannot_be_asked_is_refused_before_the_first_call(
    tmp_path: Path, mllm: TruthMllm, imported: Template, asked: tuple[str, ...], message: str
) -> None:
    own = [] if "--mllm" in asked or asked == ("--ask", "prompt") else ["--mllm", MODEL, "--base-url", mllm.address]
    out = tmp_path / "run"
    done = imported.begin(arguments_of(EXAMPLES, out, *own, *asked), tmp_path, environment()).done()
    assert message in checked(done, 1).stderr
    assert not mllm.asked
    assert not (out / "run.json").exists(), "the folder stays free"


def test_without_an_mllm_the_embedded_reader_answers(tmp_path: Path, imported: Template) -> None:
    scenes = Path(shutil.copytree(EXAMPLES, tmp_path / "scenes"))
    asked = scenes / "car-forward" / "meta.json"
    asked.write_text(asked.read_text().replace(" moves forward", " moves"))
    done = checked(imported.begin(arguments_of(scenes, tmp_path / "run"), tmp_path, environment()).done())
    run = read_run(tmp_path / "run")
    known = {(each.arm, each.item): each for each in run.observations}
    assert all(known["never", item].abstained for item in run.items), "it sees nothing in the image alone"
    assert known["always", "collision_108"].right
    assert {each.refusal for each in run.of_arm("always")} == {None, "cannot-read-direction"}
    assert "| always" in done.stdout


def test_inspect_finds_the_task() -> None:
    (entry,) = entry_points(group="inspect_ai", name="cow_service")
    assert len(entry.load().causalspatial(data=str(SAMPLE), arm="always").dataset) == 12


@pytest.mark.soak  # it begins from nothing, which takes as long as everything else here
def test_inspects_own_command_runs_the_task(tmp_path: Path, mllm: TruthMllm, items: list[Item]) -> None:
    given: dict[str, Any] = {"LOCAL_BASE_URL": mllm.address, "INSPECT_CACHE_DIR": str(tmp_path / "cache")}
    options = ("-T", f"data={SAMPLE}", "-T", "arm=always", "--limit", "2", "--epochs", "2", "--display", "none")
    done = subprocess.run(
        [sys.executable, "-m", "inspect_ai", "eval", "cow_service/causalspatial", *options, "--model", MODEL],
        cwd=tmp_path, env={**environment(), **given}, capture_output=True, text=True, check=False, timeout=120,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    assert sum(mllm.asked.values()) == 4 or len(mllm.asked) < 4
    from inspect_ai.log import list_eval_logs, read_eval_log

    (info,) = list_eval_logs(str(tmp_path / "logs"))
    log = read_eval_log(info)
    assert log.status == "success"
    assert log.samples is not None
    assert [len(sample.messages[0].content) for sample in log.samples] == [5] * 4, "image, three frames, question"
    assert log.results is not None
    assert {score.name for score in log.results.scores} == {"right", "abstained", "unreadable"}


@pytest.mark.soak
@pytest.mark.timeout(1800)
def test_the_true_gain_lies_in_the_interval_of_whole_runs(
    tmp_path: Path, items: list[Item], imported: Template
) -> None:
    """Through the whole service, twenty seeded runs; the same with drawn rows is in test_evals_statistics.py."""
    runs, without, looking = 20, 0.4, 0.85
    covered = nothing = 0
    for seed in range(runs):
        with truth_mllm(items, without=without, with_frames=looking, counted=True, seed=seed) as mllm:
            out = tmp_path / f"run{seed}"
            evaluated(imported, out, "--arm", "never,always,placebo-still", "--repeats", "5", mllm=mllm)
        run = read_run(out)
        arms = {each.arm: each for each in summarize([run]).arms}
        always, placebo = arms["always"].gain, arms["placebo-still"].gain
        assert always is not None
        assert placebo is not None
        seeing = sum(each.refusal is None for each in run.of_arm("always")) / len(run.of_arm("always"))
        covered += always.low <= seeing * (looking - without) <= always.high
        nothing += placebo.low <= 0 <= placebo.high
    assert covered >= 18
    assert nothing >= 18
