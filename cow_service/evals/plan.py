"""What is to be asked, checked before anything is, and as the record of the run."""

import hashlib
import os
import platform
import secrets
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from cow_service import __version__
from cow_service.client.options import CONCURRENCY
from cow_service.errors import InvalidRequest
from cow_service.evals.imagination import Arm
from cow_service.evals.items import Ask, Item, RunInfo
from cow_service.evals.loaders import Collected, digest_of
from cow_service.readers.prompts import load_prompt
from cow_service.settings import load_settings

PACKAGES = ("inspect-ai", "numpy", "opencv-python-headless", "rapier3d", "scipy", "torch", "diffusers", "openai")
PROMPTS = ("eval-question", "identify", "locate", "scale", "answer-from-image", "answer-with-frames")
# Providers that Inspect and the server in this process both know, and where both look for the key.
KEYS = {"openai": "OPENAI_API_KEY", "anthropic": "ANTHROPIC_API_KEY", "google": "GOOGLE_API_KEY"}
MAX_TOKENS = 8192  # of a reply, as in the paper
FRAMES = {"policy": "initial", "count": 3, "max_side": 512}  # frames 1, 3, 5, as in the paper
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
    concurrency: int = CONCURRENCY
    skip_faulty: bool = False
    retry_failed: bool = False
    log_images: bool = True


def check_plan(plan: Plan) -> None:
    """Raises `InvalidRequest` for options that contradict each other."""
    if plan.ask == "prompt" and plan.mllm is None:
        raise InvalidRequest("--ask prompt asks a multimodal LLM: name it with --mllm, such as openai/gpt-5.")
    if plan.ask == "answer" and plan.mllm is not None and plan.url is not None:
        raise InvalidRequest("The server at --url answers with its own multimodal LLM: leave --mllm out.")
    if plan.ask == "answer" and (plan.temperature is not None or plan.max_tokens is not None):
        raise InvalidRequest("--temperature and --max-tokens are for --ask prompt: /answer has its own.")


def request_options(reader: str | None, generator: str | None) -> dict[str, Any]:
    """The fields of requests for simulations."""
    named = {"reader": reader, "generator": generator}
    return {"frames": dict(FRAMES), **{name: value for name, value in named.items() if value is not None}}


def server_settings(plan: Plan) -> dict[str, Any]:
    """Settings of the server in this process: where it answers, its reader asks the multimodal LLM.

    Raises `InvalidRequest` for one that it cannot ask.
    """
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


def info_of(plan: Plan, items: Sequence[Item], found: Collected, arms: Sequence[Arm]) -> RunInfo:
    """The record of a run that begins."""
    counts = Counter(f"{item.task} {item.level}" for item in items)
    settings: dict[str, Any] = {"requests": request_options(plan.reader, plan.generator)}
    if plan.ask == "prompt":
        generation = {"temperature": plan.temperature, "max_tokens": plan.max_tokens or MAX_TOKENS}
        settings["generation"] = {**generation, "base_url": plan.base_url}
    mllm = plan.mllm
    if mllm is None and plan.url is not None:  # the service answers by itself
        mllm = f"cow at {plan.url}" + ("" if plan.reader is None else f", reader {plan.reader}")
    elif mllm is None:
        own = load_settings()
        reader = plan.reader or own.reader
        mllm = f"cow/{own.mllm}" if reader == "mllm" and own.mllm else f"cow/{reader}"
    return RunInfo(
        data=plan.data,
        data_digest=digest_of(items),
        counts=dict(sorted(counts.items())),
        faults=tuple(found.faults),
        notes=tuple(found.notes),
        mllm=mllm,
        ask=plan.ask,
        arms=tuple(arm.name for arm in arms),
        repeats=plan.repeats,
        seed=plan.seed,
        settings=settings,
        versions=versions(),
        token=secrets.token_hex(16),
        created_at=datetime.now(UTC).isoformat(timespec="seconds"),
    )


def merged(before: RunInfo | None, wanted: RunInfo, *, again: bool) -> RunInfo:
    """A run that goes on, with more arms or repeats perhaps. Raises `InvalidRequest` where the rest is not the same."""
    if before is None:
        return wanted
    same = [(name.replace("_", " "), getattr(before, name), getattr(wanted, name)) for name in _SAME]
    prompts = [name for name in wanted.versions if name.startswith("prompts/")]
    same += [(name, before.versions.get(name), wanted.versions[name]) for name in prompts]
    for name, was, is_now in same:
        if was != is_now:
            raise InvalidRequest(
                f"The folder holds a run with another {name} ({was}, not {is_now}): give --out another folder, or the "
                "same arguments as before."
            )
    arms = (*before.arms, *(arm for arm in wanted.arms if arm not in before.arms))
    newer = [f"{name} {version}" for name, version in wanted.versions.items() if before.versions.get(name) != version]
    notes = (f"Gone on with {', '.join(newer)}.",) if newer else ()
    changes = {
        "arms": arms,
        "repeats": max(before.repeats, wanted.repeats),
        "notes": tuple(dict.fromkeys((*before.notes, *notes))),
        # Under the key of an earlier round a failed job would only be found again.
        "rounds": before.rounds + again,
    }
    return before.model_copy(update=changes)


def versions() -> dict[str, str]:
    """Of this service, of Python, of the packages that are installed, and of the prompts."""
    found = {"cow-service": __version__, "python": platform.python_version()}
    for name in PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    for name in PROMPTS:
        prompt = load_prompt(name)
        digest = hashlib.sha256(prompt.body.encode()).hexdigest()
        found[f"prompts/{name}"] = f"{prompt.version} (sha256 {digest})"
    return found
