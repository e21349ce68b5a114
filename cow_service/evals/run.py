"""Carries out an evaluation: checks everything, asks what has not been asked, and reads what came of it."""

from __future__ import annotations

import hashlib
import os
from collections import Counter
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import rich

from cow_service.errors import CowError, InvalidRequest, StorageUnavailable
from cow_service.evals.arms import Arm, check_arms
from cow_service.evals.items import Item
from cow_service.evals.layout import CACHE, LOGS, PICTURES
from cow_service.evals.loaders import digest_of, load
from cow_service.evals.observations import Ask, RunInfo
from cow_service.evals.pictures import Pictures
from cow_service.evals.runs import Run, read_info, read_run, write_run
from cow_service.evals.versions import versions

# Providers that Inspect and the server in this process both know, and where both look for the key.
KEYS = {"openai": "OPENAI_API_KEY", "anthropic": "ANTHROPIC_API_KEY", "google": "GOOGLE_API_KEY"}
MAX_RETRIES = 6  # of a call of the multimodal LLM, about three minutes: then the question has failed
EMBEDDED = "cow/embedded"  # who answers where no multimodal LLM is named
_SAME = ("data_digest", "mllm", "ask", "seed", "settings")  # what a run that goes on has in common with its begin


@dataclass(frozen=True)
class Plan:
    """What the caller wants."""

    data: str
    out: Path
    mllm: str | None = None  # as Inspect names models; None: the service's own reader answers
    ask: Ask = "prompt"
    arms: Sequence[str] = ("never", "always")
    repeats: int = 1
    subsets: Sequence[str] = ()
    limit: int | None = None
    seed: int = 0
    reader: str | None = None
    generator: str | None = None
    url: str | None = None
    base_url: str | None = None  # of the multimodal LLM
    temperature: float | None = None
    max_tokens: int | None = None
    concurrency: int = 8
    skip_faulty: bool = False
    retry_failed: bool = False
    log_images: bool = True


def evaluate(plan: Plan) -> Run:
    """Asks everything that the folder has no reply to yet; returns all of it.

    All is checked before the first question is asked. Raises `InvalidRequest` for data, arms and settings that cannot
    be asked, and the `CowError` for which no server can be used.
    """
    found, items = _items(plan)
    arms = check_arms(plan.arms, plan.ask, items)
    info = _info(plan, items, tuple(found.faults), tuple(found.notes), arms)
    info = _merged(read_info(plan.out), info, again=plan.retry_failed)
    _prepare_inspect(plan.out)
    write_run(plan.out, info, items)
    _ask(plan, info, items)
    return read_run(plan.out)


def _items(plan: Plan) -> tuple[Any, list[Item]]:
    try:
        pictures = Pictures(plan.out / PICTURES)
        found = load(plan.data, pictures, subsets=plan.subsets, skip_faulty=plan.skip_faulty)
    except OSError as error:
        raise StorageUnavailable(f"'{plan.out}' cannot be written: {error.strerror or error}.") from error
    return found, found.items[: plan.limit]


def _info(
    plan: Plan, items: Sequence[Item], faults: tuple[str, ...], notes: tuple[str, ...], arms: Sequence[Arm]
) -> RunInfo:
    from cow_service.evals.tasks import MAX_TOKENS, request_options  # noqa: PLC0415 - Inspect takes a second to import

    counts = Counter(f"{item.task} {item.level}" for item in items)
    settings: dict[str, Any] = {"requests": request_options(plan.reader, plan.generator)}
    if plan.mllm is not None:
        settings["generation"] = {"temperature": plan.temperature, "max_tokens": plan.max_tokens or MAX_TOKENS}
    return RunInfo(
        data=plan.data,
        data_digest=digest_of(items),
        counts=dict(sorted(counts.items())),
        faults=faults,
        notes=notes,
        mllm=plan.mllm or EMBEDDED,
        ask=plan.ask,
        arms=tuple(arm.name for arm in arms),
        repeats=plan.repeats,
        seed=plan.seed,
        settings=settings,
        versions=versions(),
        created_at=datetime.now(UTC).isoformat(timespec="seconds"),
    )


def _merged(before: RunInfo | None, wanted: RunInfo, *, again: bool) -> RunInfo:
    """A run that goes on, with more arms or repeats perhaps. Raises `InvalidRequest` where the rest is not the same."""
    if before is None:
        return wanted
    for name in _SAME:
        was, is_now = getattr(before, name), getattr(wanted, name)
        if was != is_now:
            raise InvalidRequest(
                f"The folder holds a run with another {name.replace('_', ' ')} ({was}, not {is_now}): give --out "
                "another folder, or the same arguments as before."
            )
    arms = (*before.arms, *(arm for arm in wanted.arms if arm not in before.arms))
    # Under the key of an earlier round a failed job would only be found again.
    rounds = before.rounds + again
    repeats = max(before.repeats, wanted.repeats)
    merged = {"arms": arms, "repeats": repeats, "versions": wanted.versions, "rounds": rounds}
    return before.model_copy(update=merged)


def _prepare_inspect(out: Path) -> None:
    """Replies are kept in the folder: a reply that has come is never asked for again."""
    os.environ["INSPECT_CACHE_DIR"] = str((out / CACHE).resolve())


def _ask(plan: Plan, info: RunInfo, items: Sequence[Item]) -> None:
    """Asks what there is no reply to yet. Raises the `CowError` for which that cannot begin."""
    from inspect_ai import Epochs, eval_set  # noqa: PLC0415
    from inspect_ai.model import get_model  # noqa: PLC0415

    from cow_service.evals.logs import forget_failures, read_observations  # noqa: PLC0415
    from cow_service.evals.progress import Count, Progress, shown  # noqa: PLC0415
    from cow_service.evals.session import session  # noqa: PLC0415
    from cow_service.evals.tasks import causalspatial, prepared  # noqa: PLC0415

    logs = plan.out / LOGS
    logs.mkdir(exist_ok=True)
    model = _model(plan, get_model)
    if plan.retry_failed:
        forget_failures(logs)
    progress = Progress({arm: Count(len(items) * info.repeats) for arm in info.arms})
    progress.add_earlier([each for each in read_observations(logs) if not (plan.retry_failed and each.failure)])
    if not progress.left:
        return
    key = hashlib.sha256(f"{info.created_at} {info.data_digest} {info.mllm} {info.rounds}".encode()).hexdigest()
    with session(plan.out, plan.url, info.settings["requests"], key, **_server_settings(plan)) as shared:
        _check_server(shared.url)
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


def _model(plan: Plan, get_model: Any) -> Any:
    """The model of Inspect that answers. Raises `InvalidRequest` where its provider cannot be used."""
    if plan.ask == "answer":
        return get_model("none/none")
    try:
        return get_model(plan.mllm, base_url=plan.base_url)
    except Exception as error:
        # Inspect's providers raise what they like: a missing package, key or name.
        raise InvalidRequest(f"--mllm {plan.mllm} cannot be used: {error}") from error


def _server_settings(plan: Plan) -> dict[str, Any]:
    """Settings of the server in this process: its readers ask the same multimodal LLM, where that can be."""
    if plan.url is not None or plan.ask == "prompt" or plan.mllm is None:
        return {}
    provider, _, name = plan.mllm.partition("/")
    if provider not in KEYS:
        raise InvalidRequest(
            f"The server in this process cannot ask '{plan.mllm}': start `cow serve` with COW_MLLM, and give its --url."
        )
    key = os.environ.get("COW_MLLM_API_KEY") or os.environ.get(KEYS[provider])
    named = {"mllm": f"{provider}:{name}", "mllm_base_url": plan.base_url, "mllm_api_key": key}
    return {**named, "reader": plan.reader or "mllm"}


def _check_server(url: str) -> None:
    """Raises the `CowError` for which the server cannot be asked."""
    from cow_service.client import Client  # noqa: PLC0415

    try:
        with Client(url, retries=0) as client:
            client.models()
    except CowError as error:
        error.detail = f"The server at {url} cannot be asked. {error.detail}"
        raise
