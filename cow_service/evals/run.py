"""Carries out an evaluation; and its task, solver and scorer for Inspect.

`inspect eval cow_service/causalspatial -T data=FOLDER -T arm=always` runs one arm without `cow eval`.
"""

import atexit
import os
import secrets
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, redirect_stdout
from dataclasses import replace
from pathlib import Path
from typing import Any

import rich.text
from inspect_ai import Epochs, Task, dataset, eval_set, scorer, solver, task, util
from inspect_ai.model import GenerateConfig, Model, ModelOutput, get_model

from cow_service.adaptive import FIRST
from cow_service.client import Client
from cow_service.errors import CowError, InvalidRequest, StorageUnavailable
from cow_service.evals import asking, request, runs
from cow_service.evals.design import Order, arm_of, check_arms
from cow_service.evals.items import Ask, Item, Observation, Pictures, question_text
from cow_service.evals.loaders import CAUSALSPATIAL, load
from cow_service.evals.plan import RunInfo, describe, planned
from cow_service.evals.report.summary import Price, summarize
from cow_service.evals.session import active_session, session
from cow_service.evals.statistics import upper_variance
from cow_service.readers.prompts import load_prompt

MAX_RETRIES = 6  # of a call of the multimodal LLM, about three minutes: then the question has failed


@task
def causalspatial(
    data: str = CAUSALSPATIAL,
    arm: str = "always",
    subsets: str | list[str] = "",
    ask: Ask = "prompt",
    repeats: int = 1,
    seed: int = 0,
    order: Order = "shuffled",
    limit: int | None = None,
    reader: str | None = None,
    generator: str | None = None,
    url: str | None = None,
) -> Task:
    """What-if questions on images, in one arm: data sets in any form that `load` reads.

    `subsets` are separated by commas. Without `url` a server runs in the process. Raises `InvalidRequest`.
    """
    shared = active_session()
    if shared is None:  # the session of the first task of the process is that of all
        stack = ExitStack()
        atexit.register(stack.close)
        options, key = request.request_options(reader, generator), secrets.token_hex(8)
        folder = Path(tempfile.mkdtemp(prefix="cow-eval-"))  # of pictures and a server; left to the system to clean
        shared = stack.enter_context(session(folder, url, options, key, key))
    items = shared.items  # loaded and checked before, whatever `data` says
    if items is None:
        named = subsets.split(",") if isinstance(subsets, str) else subsets
        items = load(data, shared.pictures, subsets=[part.strip() for part in named if part.strip()]).items[:limit]
    check_arms([arm], ask, items)
    shared.lenders = items
    samples = [
        dataset.Sample(
            id=item.id,
            input=question_text(item),
            target=item.answer,
            choices=[option.text for option in item.options],
            metadata={runs.ITEM: item.model_dump(mode="json")},
        )
        for item in items
    ]
    return Task(
        dataset=dataset.MemoryDataset(samples, name=arm),
        solver=look_and_ask(arm, ask, seed, order),
        scorer=chosen_option(),
        epochs=Epochs(repeats, "mean"),
        config=GenerateConfig(max_tokens=request.MAX_TOKENS),
        name=arm,
        version=load_prompt("eval-question").version,
    )


@solver.solver
def look_and_ask(arm: str, ask: Ask, seed: int, order: Order = "shuffled") -> solver.Solver:
    """Asks one question in one arm, with its options in the order of the repeat."""

    async def solve(state: solver.TaskState, generate: solver.Generate) -> solver.TaskState:
        item = Item.model_validate(state.metadata[runs.ITEM])
        case = asking.Case(item, arm_of(arm), state.epoch, asking.order_of(item, order, seed, state.epoch))
        shared = active_session()
        if shared is None:
            raise RuntimeError("The solver runs in tasks of `causalspatial` alone.")
        client, imagination = shared.clients()
        if ask == "answer":
            asker = asking.AnswerAsker(client, imagination.places, shared.pictures, shared.options, shared.key)
        else:
            asker = asking.PromptAsker(get_model(), imagination, shared.pictures, shared.reply_key)
        asked = await asker(case)
        seen = asking.observation_of(case, asked)
        state.store.set(runs.OBSERVATION, seen.model_dump(mode="json"))
        state.messages = asking.conversation(case, asked, shared.pictures)
        state.output = ModelOutput.from_content(str(state.model), asked.replies[-1].text)
        state.completed = True
        return state

    return solve


@scorer.scorer(
    metrics={"right": [scorer.mean(), scorer.std()], "abstained": [scorer.mean()], "unreadable": [scorer.mean()]}
)
def chosen_option() -> scorer.Scorer:
    """Whether the reply chooses the right option, abstains, or cannot be read."""

    async def score(state: solver.TaskState, target: scorer.Target) -> scorer.Score:
        seen = Observation.model_validate(state.store.get(runs.OBSERVATION))
        return scorer.Score(
            value={"right": int(seen.right), "abstained": int(seen.abstained), "unreadable": int(seen.unreadable)},
            answer=seen.read,
            explanation=seen.reply,
            metadata={runs.OBSERVATION: seen.model_dump(mode="json")},
        )

    return score


def prepare(wanted: request.EvalRequest, folder: Path, tell: Callable[[str], None]) -> tuple[RunInfo, list[Item]]:
    """What is to be asked, checked, as the record of a run; its pictures are kept in the folder.

    `tell` receives findings about the data. Raises as `evaluate` does.
    """
    request.check_request(wanted)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StorageUnavailable(f"'{folder}' cannot be written: {error.strerror or error}.") from error
    found = load(wanted.data, Pictures(folder / runs.PICTURES), subsets=wanted.subsets, skip_faulty=wanted.skip_faulty)
    items = found.items[: wanted.limit]
    arms = check_arms(wanted.arms, wanted.ask, items)
    for told in (*found.notes, *found.faults):
        tell(told)
    return request.info_of(wanted, found, items, arms), items


def write_plan(
    wanted: request.EvalRequest, file: Path, effect: float, pilot: Path | None, prices: Mapping[str, Price]
) -> str:
    """Writes the plan of a run to detect a gain of `effect` (a share of questions); returns its text.

    A pilot run tells how much scenes differ, and what a reply costs. Raises as `evaluate` does.
    """
    with tempfile.TemporaryDirectory() as folder:
        info, _ = prepare(wanted, Path(folder), lambda told: None)
    fixed, costs = planned(info, effect), {}
    if pilot is not None:
        before = runs.read_run(pilot)
        findings = summarize([before], prices)
        known = [each.gain for each in findings.contrasts if (each.name, each.task) == (fixed.primary, None)]
        if not known or before.info.repeats != info.repeats or max(each.sd for each in known) == 0:
            raise InvalidRequest(
                f"The pilot '{pilot}' does not say how much scenes differ: it needs the arm {fixed.primary} and a "
                f"placebo, --repeats {info.repeats}, and replies that differ."
            )
        scenes = min(each.scenes for each in known)
        variance = upper_variance(max(each.sd for each in known), scenes)
        fixed = planned(info, effect, variance, f"{before.info.design_digest}, {scenes} scenes")
        costs = {each.arm: each.cost for each in findings.arms}
    try:
        file.write_text(fixed.model_dump_json(indent=2) + "\n", encoding="utf-8")
    except OSError as error:
        raise StorageUnavailable(f"'{file}' cannot be written: {error.strerror or error}.") from error
    return describe(fixed, costs)


def evaluate(wanted: request.EvalRequest, tell: Callable[[str], None]) -> runs.EvalRun:
    """Asks everything that the folder has no reply to yet; returns all of it.

    All is checked before the first question is asked; `tell` receives findings about the data. Raises
    `InvalidRequest` for data, arms and settings that cannot be asked, `StorageUnavailable` for a folder that cannot be
    written, and the `CowError` for which no server can be used.
    """
    begun, items = prepare(wanted, wanted.out, tell)
    settings = request.server_settings(wanted)
    try:
        model = get_model("none/none") if wanted.ask == "answer" else get_model(wanted.mllm, base_url=wanted.base_url)
    except Exception as error:
        # Inspect's providers raise what they like: a missing package, key or name.
        told = rich.text.Text.from_markup(str(error)).plain
        raise InvalidRequest(f"--mllm {wanted.mllm} cannot be used: {told}") from error
    # Inspect keeps replies in the folder: a reply that has come is never asked for again.
    os.environ["INSPECT_CACHE_DIR"] = str((wanted.out / runs.CACHE).resolve())
    logs = wanted.out / runs.LOGS
    info = request.merged(runs.read_info(wanted.out), begun)
    if wanted.retry_failed and logs.is_dir() and runs.forget_failures(logs) > 0:
        # With the key of an earlier round, the failed job would be returned again.
        info = info.model_copy(update={"rounds": info.rounds + 1})
    _ask(wanted, info, items, model, settings)
    done = runs.read_run(wanted.out)
    # Only the replies tell which version of a model has replied.
    replied = info.model_copy(
        update={"replied_as": tuple(sorted({each.model for each in done.observations if each.model is not None}))}
    )
    runs.write_run(wanted.out, replied, items)
    return replace(done, info=replied)


def _ask(
    wanted: request.EvalRequest, info: RunInfo, items: Sequence[Item], model: Model, settings: dict[str, Any]
) -> None:
    """Asks what there is no reply to yet. Raises the `CowError` for which that cannot begin: the folder stays free."""
    logs = wanted.out / runs.LOGS
    logs.mkdir(exist_ok=True)
    replied = [each for each in runs.read_observations(logs) if not (wanted.retry_failed and each.failure)]
    if len(replied) == len(items) * info.repeats * len(info.arms):
        runs.write_run(wanted.out, info, items)
        return
    keys = f"{info.token} {info.rounds}", info.token
    options = request.request_options(wanted.reader, wanted.generator)
    with session(wanted.out, wanted.url, options, *keys, **settings) as shared:
        _check_server(shared.url, wanted)
        runs.write_run(wanted.out, info, items)
        shared.items, shared.concurrency = items, wanted.concurrency
        asked: dict[str, Any] = {"data": info.data_digest, "ask": info.ask, "seed": info.seed, "order": info.order}
        most = wanted.concurrency
        connections = util.AdaptiveConcurrency(min=1, start=min(FIRST, most), max=most)
        with redirect_stdout(sys.stderr):  # Inspect shows its progress there: the report alone is output
            _, ended = eval_set(
                tasks=[causalspatial(arm=arm, **asked) for arm in info.arms],
                epochs=Epochs(info.repeats, "mean"),
                log_dir=str(logs),
                model=model,
                retry_attempts=0,
                retry_immediate=False,
                fail_on_error=False,
                max_samples=most,
                adaptive_connections=connections,
                max_tasks=len(info.arms),
                max_tokens=wanted.max_tokens,
                max_retries=MAX_RETRIES,
                display="rich" if sys.stderr.isatty() else "plain",
                log_images=wanted.log_images,
                log_dir_allow_dirty=True,
                ctl_server=False,
                temperature=wanted.temperature,
            )
    if len(ended) < len(info.arms):  # Inspect takes an interrupt for an end
        raise KeyboardInterrupt


def _check_server(url: str, wanted: request.EvalRequest) -> None:
    """Raises the `CowError` for which the server cannot be asked, or not so."""
    try:
        with Client(url, retries=0) as client:
            models = client.models()
    except CowError as error:
        error.detail = f"The server at {url} cannot be asked. {error.detail}"
        raise
    named = {"reader": (wanted.reader, models.readers), "generator": (wanted.generator, models.generators)}
    for option, (name, known) in named.items():
        backend = next((each for each in known if each.name == name), None)
        if name is not None and backend is None:
            raise InvalidRequest(f"--{option} {name}: the server has only {', '.join(each.name for each in known)}.")
        if backend is not None and backend.missing:
            raise InvalidRequest(f"--{option} {name} is not ready: the server lacks {', '.join(backend.missing)}.")
