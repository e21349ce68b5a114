"""What the service says of itself and of its jobs."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field

from cow_service.records.base import Record, Sha256
from cow_service.records.results import Answer, Problem, Simulation


class BackendInfo(Record):
    """A reader or generator: what it is, what it needs, whether it is ready."""

    name: str
    default: bool = Field(description="Used where a request names none.")
    ready: bool | None = Field(description="Null where nothing is known of it before it is used.")
    needs: tuple[str, ...] = Field(default=(), description="Python modules that it uses.")
    summary: str
    licence: str | None = None
    weights: str | None = Field(default=None, description="Repository of its weights; null where it has none.")
    missing: tuple[str, ...] = Field(
        default=(), description="Python modules that are not installed, and settings (COW_...) that are not set."
    )
    install: str | None = Field(default=None, description="The command that installs them.")
    pull: str | None = Field(
        default=None, description="The command that downloads its weights, where they are not here."
    )
    defaults: dict[str, bool | int | float | str] = Field(default_factory=dict)


class Models(Record):
    """What `GET /models` returns."""

    readers: tuple[BackendInfo, ...]
    generators: tuple[BackendInfo, ...]
    mllms: tuple[str, ...] = Field(default=(), description="Manifests of multimodal LLMs: what `COW_MLLM` may name.")


JobKind = Literal["simulate", "answer"]
JobStatus = Literal["queued", "running", "succeeded", "failed", "canceled"]
TERMINAL: tuple[JobStatus, ...] = ("succeeded", "failed", "canceled")


class Job(Record):
    """A request that was accepted. Once its status is succeeded, failed or canceled it never changes again."""

    id: str
    kind: JobKind
    status: JobStatus
    stage: str | None = Field(default=None, description="The stage that it is in, or was in when it ended.")
    progress: float = Field(ge=0, le=1, description="Share of the work that is done, all stages together.")
    question: str | None = Field(
        default=None,
        description="The request's; in lists at most 200 characters of it, the last of them `…` where it is longer. "
        "Null for jobs of earlier versions.",
    )
    image: Sha256 | None = Field(
        default=None, description="The artifact that the request's image is kept as; null for jobs of earlier versions."
    )
    created_at: str = Field(description="RFC 3339, UTC.")
    finished_at: str | None = Field(default=None, description="RFC 3339, UTC.")
    position: int | None = Field(
        default=None,
        ge=0,
        description="Jobs that are taken before it, while it is queued and asked for by its id; null otherwise.",
    )
    expected_wait: float | None = Field(
        default=None, ge=0, description="Seconds until it is taken, at the pace of the last minutes; null if not known."
    )
    generator: str = Field(description="Who makes its frames.")
    result: Simulation | Answer | None = Field(default=None, description="Of a succeeded job, but not in lists.")
    problem: Problem | None = Field(default=None, description="Of a failed job.")


class AcceptedRequest(Record):
    """The request that became a job."""

    kind: JobKind = Field(description="`simulate`: of `POST /simulate`; `answer`: of `POST /answer`.")
    request: dict[str, Any] = Field(
        description="The body, which can be sent again as it stands: image and masks as artifacts, without fields that "
        "have their default, and without the webhook."
    )


class JobPage(Record):
    """Some jobs, newest first."""

    jobs: tuple[Job, ...]
    next: str | None = Field(default=None, description="`cursor` of the page after this one; null on the last.")
