"""Carries out an evaluation; and its task, solver and scorer for Inspect.

`inspect eval cow_service/causalspatial -T data=FOLDER -T arm=always` runs one arm without `cow eval`.
"""

from __future__ import annotations

import atexit
import os
import secrets
from collections.abc import Callable, Generator, Sequence
from contextlib import ExitStack, contextmanager
from typing import Any

import rich
from inspect_ai import Epochs, Task, eval_set, task
from inspect_ai.dataset import MemoryDataset, Sample
from inspect_ai.model import GenerateConfig, ModelOutput, get_model
from inspect_ai.scorer import Score, Scorer, Target, mean, scorer, std
from inspect_ai.solver import Generate, Solver, TaskState, solver

from cow_service.client import Client
from cow_service.errors import CowError, InvalidRequest, StorageUnavailable
from cow_service.evals.askers import AnswerAsker, PromptAsker, conversation
from cow_service.evals.asking import Asker, Case, observation_of, order_of
from cow_service.evals.imagination import Arm, check_arms
from cow_service.evals.items import Ask, Item, Observation, Pictures, RunInfo, question_text
from cow_service.evals.loaders import CAUSALSPATIAL, load
from cow_service.evals.plan import MAX_TOKENS, Plan, check_plan, info_of, merged, request_options, server_settings
from cow_service.evals.runs import (
    CACHE,
    ITEM,
    LOGS,
    OBSERVATION,
    PICTURES,
    EvalRun,
    forget_failures,
    read_info,
    read_observations,
    read_run,
    write_run,
)
from cow_service.evals.session import Progress, active_session, own_folder, session
from cow_service.readers.prompts import load_prompt


@task
def causalspatial(
    data: str = CAUSALSPATIAL,
    arm: str = "always",
    subsets: str | list[str] = "",
    ask: Ask = "prompt",
    repeats: int = 1,
    seed: int = 0,
    limit: int | None = None,
    reader: str | None = None,
    generator: str | None = None,
    url: str | None = None,
) -> Task:
    """What-if questions on images, in one arm: data sets in any form that `load` reads.

    `subsets` are separated by commas. Without `url` a server runs in the process. Raises `InvalidRequest`.
    """
    shared = active_session()
    if shared is not None and shared.items is not None:  # loaded and checked before, whatever `data` says
        items = shared.items
    else:
        items = _loaded(data, subsets, limit, url, reader, generator)
    (one,) = check_arms([arm], ask, items)
    return arm_task(items, one, ask, repeats, seed)


def _loaded(
    data: str, subsets: str | list[str], limit: int | None, url: str | None, reader: str | None, generator: str | None
) -> Sequence[Item]:
    """The items of a data set, with the session of the first task of the process."""
    shared = active_session()
    if shared is None:
        stack = ExitStack()
        atexit.register(stack.close)
        options = request_options(reader, generator)
        shared = stack.enter_context(session(own_folder(), url, options, *[secrets.token_hex(8)] * 2))
    named = subsets.split(",") if isinstance(subsets, str) else subsets
    return load(data, shared.pictures, subsets=[part.strip() for part in named if part.strip()]).items[:limit]


def arm_task(items: Sequence[Item], arm: Arm, ask: Ask, repeats: int, seed: int) -> Task:
    """The task that asks all items in one arm."""
    samples = [
        Sample(
            id=item.id,
            input=question_text(item),
            target=item.answer,
            choices=[option.text for option in item.options],
            metadata={ITEM: item.model_dump(mode="json")},
        )
        for item in items
    ]
    return Task(
        dataset=MemoryDataset(samples, name=arm.name),
        solver=look_and_ask(arm.name, ask, seed),
        scorer=chosen_option(),
        epochs=Epochs(repeats, "mean"),
        config=GenerateConfig(max_tokens=MAX_TOKENS),
        name=f"{arm.name}",
        version=load_prompt("eval-question").version,
    )


@solver
def look_and_ask(arm: str, ask: Ask, seed: int) -> Solver:
    """Asks one question in one arm, with its options in the order of the repeat."""

    async def solve(state: TaskState, generate: Generate) -> TaskState:
        item = Item.model_validate(state.metadata[ITEM])
        (one,) = check_arms([arm], ask, [item])
        case = Case(item, one, state.epoch, order_of(item, seed, state.epoch))
        shared = active_session()
        if shared is None:
            raise RuntimeError("The solver runs in tasks of `causalspatial` alone.")
        client, imagination = shared.clients()
        asker: Asker = PromptAsker(get_model(), imagination, shared.pictures, shared.reply_key)
        if ask == "answer":
            asker = AnswerAsker(client, shared.pictures, shared.options, shared.key)
        try:
            asked = await asker(case)
        except Exception:
            shared.count(arm, None)
            raise
        seen = observation_of(case, asked)
        shared.count(arm, seen)
        state.store.set(OBSERVATION, seen.model_dump(mode="json"))
        state.messages = conversation(case, asked, seen.overlay, shared.pictures)
        state.output = ModelOutput.from_content(str(state.model), asked.replies[-1].text)
        state.completed = True
        return state

    return solve


@scorer(metrics={"right": [mean(), std()], "abstained": [mean()], "unreadable": [mean()]})
def chosen_option() -> Scorer:
    """Whether the reply chooses the right option, abstains, or cannot be read."""

    async def score(state: TaskState, target: Target) -> Score:
        seen = Observation.model_validate(state.store.get(OBSERVATION))
        return Score(
            value={"right": int(seen.right), "abstained": int(seen.abstained), "unreadable": int(seen.unreadable)},
            answer=seen.read,
            explanation=seen.reply,
            metadata={OBSERVATION: seen.model_dump(mode="json")},
        )

    return score


MAX_RETRIES = 6  # of a call of the multimodal LLM, about three minutes: then the question has failed


def evaluate(plan: Plan, tell: Callable[[str], None]) -> EvalRun:
    """Asks everything that the folder has no reply to yet; returns all of it.

    All is checked before the first question is asked; `tell` is told what was found in the data. Raises
    `InvalidRequest` for data, arms and settings that cannot be asked, `StorageUnavailable` for a folder that cannot be
    written, and the `CowError` for which no server can be used.
    """
    check_plan(plan)
    try:
        pictures = Pictures(plan.out / PICTURES)
    except OSError as error:
        raise StorageUnavailable(f"'{plan.out}' cannot be written: {error.strerror or error}.") from error
    found = load(plan.data, pictures, subsets=plan.subsets, skip_faulty=plan.skip_faulty)
    items = found.items[: plan.limit]
    arms = check_arms(plan.arms, plan.ask, items)
    for told in (*found.notes, *found.faults):
        tell(told)
    settings, model = server_settings(plan), _model(plan)
    wanted = info_of(plan, items, found, arms)
    # Inspect keeps replies in the folder: a reply that has come is never asked for again.
    os.environ["INSPECT_CACHE_DIR"] = str((plan.out / CACHE).resolve())
    logs = plan.out / LOGS
    again = plan.retry_failed and logs.is_dir() and forget_failures(logs) > 0
    info = merged(read_info(plan.out), wanted, again=again)
    write_run(plan.out, info, items)
    _ask(plan, info, items, model, settings)
    return read_run(plan.out)


def _ask(plan: Plan, info: RunInfo, items: Sequence[Item], model: Any, settings: dict[str, Any]) -> None:
    """Asks what there is no reply to yet. Raises the `CowError` for which that cannot begin."""
    logs = plan.out / LOGS
    logs.mkdir(exist_ok=True)
    progress = Progress(info.arms, len(items) * info.repeats)
    progress.add_earlier(each for each in read_observations(logs) if not (plan.retry_failed and each.failure))
    if not progress.left:
        return
    keys = f"{info.token} {info.rounds}", info.token
    with session(plan.out, plan.url, info.settings["requests"], *keys, **settings) as shared:
        _check_server(shared.url, plan)
        shared.items, shared.progress = items, progress
        with progress.shown(), _quiet_inspect():
            _, ended = eval_set(
                tasks=[
                    causalspatial(data=info.data_digest, arm=arm, ask=plan.ask, seed=plan.seed) for arm in info.arms
                ],
                epochs=Epochs(info.repeats, "mean"),
                log_dir=str(logs),
                model=model,
                retry_attempts=0,
                retry_immediate=False,
                fail_on_error=False,
                max_samples=plan.concurrency,
                max_connections=plan.concurrency,
                max_tasks=len(info.arms),
                max_tokens=plan.max_tokens,
                max_retries=MAX_RETRIES,
                display="none",
                log_images=plan.log_images,
                log_dir_allow_dirty=True,
                ctl_server=False,
                score_display=False,
                temperature=plan.temperature,
            )
    if len(ended) < len(info.arms):  # Inspect takes an interrupt for an end
        raise KeyboardInterrupt


@contextmanager
def _quiet_inspect() -> Generator[None]:
    """Meanwhile Inspect says nothing of its own on standard output."""
    console = rich.get_console()
    before, console.quiet = console.quiet, True
    try:
        yield
    finally:
        console.quiet = before


def _model(plan: Plan) -> Any:
    """The model of Inspect that answers. Raises `InvalidRequest` where its provider cannot be used."""
    if plan.ask == "answer":
        return get_model("none/none")
    try:
        return get_model(plan.mllm, base_url=plan.base_url)
    except Exception as error:
        # Inspect's providers raise what they like: a missing package, key or name.
        raise InvalidRequest(f"--mllm {plan.mllm} cannot be used: {error}") from error


def _check_server(url: str, plan: Plan) -> None:
    """Raises the `CowError` for which the server cannot be asked, or not so."""
    try:
        with Client(url, retries=0) as client:
            models = client.models()
    except CowError as error:
        error.detail = f"The server at {url} cannot be asked. {error.detail}"
        raise
    wanted = ("reader", plan.reader, models.readers), ("generator", plan.generator, models.generators)
    for option, name, known in wanted:
        backend = next((each for each in known if each.name == name), None)
        if name is not None and backend is None:
            raise InvalidRequest(f"--{option} {name}: the server has only {', '.join(each.name for each in known)}.")
        if backend is not None and backend.missing:
            raise InvalidRequest(f"--{option} {name} is not ready: the server lacks {', '.join(backend.missing)}.")
