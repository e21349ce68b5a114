"""Carries out an evaluation: checks everything, asks what has not been asked, and reads what came of it."""

from __future__ import annotations

import os
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import rich

from cow_service.errors import CowError, InvalidRequest, StorageUnavailable
from cow_service.evals.arms import check_arms
from cow_service.evals.items import Item
from cow_service.evals.layout import CACHE, LOGS, PICTURES
from cow_service.evals.loaders import load
from cow_service.evals.observations import RunInfo
from cow_service.evals.pictures import Pictures
from cow_service.evals.plan import Plan, check_plan, info_of, merged, server_settings
from cow_service.evals.runs import Run, read_info, read_run, write_run

MAX_RETRIES = 6  # of a call of the multimodal LLM, about three minutes: then the question has failed


def evaluate(plan: Plan, tell: Callable[[str], None]) -> Run:
    """Asks everything that the folder has no reply to yet; returns all of it.

    All is checked before the first question is asked; `tell` is told what was found in the data. Raises
    `InvalidRequest` for data, arms and settings that cannot be asked, `StorageUnavailable` for a folder that cannot be
    written, and the `CowError` for which no server can be used.
    """
    check_plan(plan)
    pictures = _pictures(plan.out)
    found = load(plan.data, pictures, subsets=plan.subsets, skip_faulty=plan.skip_faulty)
    items = found.items[: plan.limit]
    arms = check_arms(plan.arms, plan.ask, items)
    for told in (*found.notes, *found.faults):
        tell(told)
    settings, model = server_settings(plan), _model(plan)
    wanted = info_of(plan, items, found, arms)
    _prepare_inspect(plan.out)
    again = plan.retry_failed and _forget_failures(plan.out / LOGS) > 0
    info = merged(read_info(plan.out), wanted, again=again)
    write_run(plan.out, info, items)
    _ask(plan, info, items, model, settings)
    return read_run(plan.out)


def _pictures(out: Path) -> Pictures:
    try:
        return Pictures(out / PICTURES)
    except OSError as error:
        raise StorageUnavailable(f"'{out}' cannot be written: {error.strerror or error}.") from error


def _forget_failures(logs: Path) -> int:
    from cow_service.evals.logs import forget_failures  # noqa: PLC0415 - Inspect takes a second to import

    return forget_failures(logs) if logs.is_dir() else 0


def _prepare_inspect(out: Path) -> None:
    """Replies are kept in the folder: a reply that has come is never asked for again."""
    os.environ["INSPECT_CACHE_DIR"] = str((out / CACHE).resolve())


def _ask(plan: Plan, info: RunInfo, items: Sequence[Item], model: Any, settings: dict[str, Any]) -> None:
    """Asks what there is no reply to yet. Raises the `CowError` for which that cannot begin."""
    from inspect_ai import Epochs, eval_set  # noqa: PLC0415

    from cow_service.evals.logs import read_observations  # noqa: PLC0415
    from cow_service.evals.progress import Count, Progress, shown  # noqa: PLC0415
    from cow_service.evals.session import session  # noqa: PLC0415
    from cow_service.evals.tasks import causalspatial, prepared  # noqa: PLC0415

    logs = plan.out / LOGS
    logs.mkdir(exist_ok=True)
    progress = Progress({arm: Count(len(items) * info.repeats) for arm in info.arms})
    progress.add_earlier([each for each in read_observations(logs) if not (plan.retry_failed and each.failure)])
    if not progress.left:
        return
    keys = f"{info.token} {info.rounds}", info.token
    with session(plan.out, plan.url, info.settings["requests"], *keys, **settings) as shared:
        _check_server(shared.url, plan)
        with prepared(items), shown(progress), _quiet_inspect():
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
    from inspect_ai.model import get_model  # noqa: PLC0415

    if plan.ask == "answer":
        return get_model("none/none")
    try:
        return get_model(plan.mllm, base_url=plan.base_url)
    except Exception as error:
        # Inspect's providers raise what they like: a missing package, key or name.
        raise InvalidRequest(f"--mllm {plan.mllm} cannot be used: {error}") from error


def _check_server(url: str, plan: Plan) -> None:
    """Raises the `CowError` for which the server cannot be asked, or not so."""
    from cow_service.client import Client  # noqa: PLC0415

    try:
        with Client(url, retries=0) as client:
            models = client.models()
    except CowError as error:
        error.detail = f"The server at {url} cannot be asked. {error.detail}"
        raise
    for option, name, known in (
        ("reader", plan.reader, models.readers),
        ("generator", plan.generator, models.generators),
    ):
        backend = next((each for each in known if each.name == name), None)
        if name is not None and backend is None:
            raise InvalidRequest(f"--{option} {name}: the server has only {', '.join(each.name for each in known)}.")
        if backend is not None and backend.missing:
            raise InvalidRequest(f"--{option} {name} is not ready: the server lacks {', '.join(backend.missing)}.")
