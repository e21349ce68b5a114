"""What the caller wants to be asked, checked before anything is, and as the record of the run."""

import hashlib
import os
import platform
import secrets
import subprocess
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from cow_service import __version__
from cow_service.client import CONCURRENCY
from cow_service.errors import InvalidRequest
from cow_service.evals.design import PRESETS, Arm, Order
from cow_service.evals.items import Ask, Item
from cow_service.evals.loaders import Collected, digest_of
from cow_service.evals.plan import AnalysisPlan, RunInfo, differences
from cow_service.readers.prompts import load_prompt
from cow_service.settings import load_settings

PACKAGES = ("inspect-ai", "numpy", "opencv-python-headless", "rapier3d", "scipy", "torch", "diffusers", "openai")
PROMPTS = ("eval-question", "identify", "locate", "scale", "answer-from-image", "answer-with-frames")
# Providers that Inspect and the server in this process both know, and where both look for the key.
KEYS = {"openai": "OPENAI_API_KEY", "anthropic": "ANTHROPIC_API_KEY", "google": "GOOGLE_API_KEY"}
MAX_TOKENS = 8192  # of a reply, as in the paper
# Options that decide what is asked, beside arms, repeats and subsets.
DECIDING = (
    "data", "mllm", "mllm_revision", "base_url", "ask", "order", "seed", "limit", "skip_faulty", "reader", "generator",
)  # fmt: skip


@dataclass(frozen=True)
class EvalRequest:
    """What the caller wants. `options` lists the options that decide what is asked."""

    data: str
    out: Path
    mllm: str | None = None  # as Inspect names models; None: the service's own reader answers
    mllm_revision: str | None = None  # of its weights, for the record
    ask: Ask = "prompt"
    arms: Sequence[str] = PRESETS["default"].arms
    repeats: int = 1
    order: Order = "shuffled"
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
    log_images: bool = False
    plan: AnalysisPlan | None = None

    @property
    def options(self) -> dict[str, Any]:
        """What decides the replies, by the names of the options, without arms and repeats."""
        prompted = {"temperature": self.temperature, "max_tokens": self.max_tokens or MAX_TOKENS}
        named = {name: getattr(self, name) for name in DECIDING}
        return {**named, "subset": list(self.subsets), **(prompted if self.ask == "prompt" else {})}


def check_request(wanted: EvalRequest) -> None:
    """Raises `InvalidRequest` for options that contradict each other."""
    if wanted.ask == "prompt" and wanted.mllm is None:
        raise InvalidRequest("--ask prompt asks a multimodal LLM: name it with --mllm, such as openai/gpt-5.")
    if wanted.ask == "answer" and wanted.mllm is not None and wanted.url is not None:
        raise InvalidRequest("The server at --url uses its own multimodal LLM: leave --mllm out.")
    if wanted.ask == "answer" and (wanted.temperature is not None or wanted.max_tokens is not None):
        raise InvalidRequest("--temperature and --max-tokens are for --ask prompt: /answer has its own.")


def request_options(reader: str | None, generator: str | None) -> dict[str, Any]:
    """The fields of requests for simulations, without those of an arm."""
    named = {"reader": reader, "generator": generator}
    return {name: value for name, value in named.items() if value is not None}


def server_settings(wanted: EvalRequest) -> dict[str, Any]:
    """Settings of the server in this process: where it answers, its reader asks the multimodal LLM.

    Raises `InvalidRequest` for one that it cannot ask.
    """
    if wanted.url is not None or wanted.ask == "prompt" or wanted.mllm is None:
        return {}
    provider, _, name = wanted.mllm.partition("/")
    if provider not in KEYS:
        raise InvalidRequest(
            f"The server in this process cannot ask '{wanted.mllm}': start `cow serve` with COW_MLLM, and give its "
            "--url."
        )
    key = os.environ.get("COW_MLLM_API_KEY") or os.environ.get(KEYS[provider])
    named = {"mllm": f"{provider}:{name}", "mllm_base_url": wanted.base_url, "mllm_api_key": key}
    return {**named, "reader": wanted.reader or "mllm"}


def info_of(wanted: EvalRequest, found: Collected, items: Sequence[Item], arms: Sequence[Arm]) -> RunInfo:
    """The record of a run that begins."""
    counts = Counter(f"{item.task} {item.level}" for item in items)
    mllm = wanted.mllm
    if mllm is None and wanted.url is not None:  # the service answers by itself
        mllm = f"cow at {wanted.url}" + ("" if wanted.reader is None else f", reader {wanted.reader}")
    elif mllm is None:
        own = load_settings()
        reader = wanted.reader or own.reader
        mllm = f"cow/{own.mllm}" if reader == "mllm" and own.mllm else f"cow/{reader}"
    return RunInfo(
        data=wanted.data,
        data_digest=digest_of(items),
        scenes=len({item.scene for item in items}),
        counts=dict(sorted(counts.items())),
        faults=tuple(found.faults),
        notes=tuple(found.notes),
        mllm=mllm,
        ask=wanted.ask,
        arms={arm.name: arm.model_dump() for arm in arms},
        repeats=wanted.repeats,
        order=wanted.order,
        seed=wanted.seed,
        options=wanted.options,
        versions=versions(),
        token=secrets.token_hex(16),
        created_at=datetime.now(UTC).isoformat(timespec="seconds"),
        plan=wanted.plan,
    )


def merged(before: RunInfo | None, wanted: RunInfo) -> RunInfo:
    """A resumed run, possibly with more arms or repeats. Raises `InvalidRequest` if anything else has changed."""
    if before is None:
        return wanted
    changed = differences(before, wanted)
    if wanted.plan is not None and wanted.plan != before.plan:
        changed.append("--plan, which fixes an analysis before the first reply")
    if changed:
        raise InvalidRequest(
            f"The folder holds a run with other options: {'; '.join(changed)}. Give --out another folder, or the same "
            "options as before."
        )
    newer = [f"{name} {version}" for name, version in wanted.versions.items() if before.versions.get(name) != version]
    notes = (f"Continued with {', '.join(newer)}.",) if newer else ()
    changes = {"arms": before.arms | wanted.arms, "repeats": max(before.repeats, wanted.repeats)}
    return before.model_copy(update={**changes, "notes": tuple(dict.fromkeys((*before.notes, *notes)))})


def versions() -> dict[str, str]:
    """Versions of this service and its commit, of Python, of the installed packages, and of the prompts."""
    found = {"cow-service": __version__, "commit": _commit(), "python": platform.python_version()}
    for name in PACKAGES:
        with suppress(PackageNotFoundError):
            found[name] = version(name)
    for name in PROMPTS:
        prompt = load_prompt(name)
        digest = hashlib.sha256(prompt.body.encode()).hexdigest()
        found[f"prompts/{name}"] = f"{prompt.version} (sha256 {digest})"
    return found


def _commit() -> str:
    """Of the checkout that this package is imported from; `unknown` where it is installed without one."""
    git = ("git", "-C", str(Path(__file__).parent))
    try:
        for command in (("ls-files", "--error-unmatch", Path(__file__).name), ("rev-parse", "HEAD")):
            done = subprocess.run([*git, *command], capture_output=True, text=True, check=True, timeout=10)
        changed = subprocess.run([*git, "status", "--porcelain", "."], capture_output=True, check=True, timeout=10)
    except (OSError, subprocess.SubprocessError):
        return "unknown"
    return done.stdout.strip() + (" with changes" if changed.stdout.strip() else "")
