"""Jobs as callers see them, from what the database and this process know."""

from __future__ import annotations

import base64
import binascii
import json
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any, cast, get_args

from dbos import DBOS, WorkflowStatus

from cow_service.errors import CowError, FieldError, InternalError, InvalidRequest
from cow_service.jobs.database import database_errors
from cow_service.jobs.live import Live, share_done
from cow_service.problems import problem_of
from cow_service.records import Job, JobKind, JobPage, JobStatus

KINDS: tuple[JobKind, ...] = get_args(JobKind)
GENERATOR, CREATED = "generator", "created_at"  # attributes of a workflow
STATUS: dict[str, JobStatus] = {
    "ENQUEUED": "queued",
    "DELAYED": "queued",
    "PENDING": "running",
    "SUCCESS": "succeeded",
    "ERROR": "failed",
    "CANCELLED": "canceled",
    "MAX_RECOVERY_ATTEMPTS_EXCEEDED": "failed",
}
OPEN = ["ENQUEUED", "DELAYED", "PENDING"]
ENDED = [name for name in STATUS if name not in OPEN]


@dataclass(frozen=True)
class Filters:
    """Which jobs a caller wants to see. Times are RFC 3339."""

    status: tuple[JobStatus, ...] = ()
    kind: JobKind | None = None
    created_after: datetime | None = None
    created_before: datetime | None = None
    limit: int = 50
    cursor: str | None = None


@dataclass(frozen=True)
class Found:
    """A job, the key that it belongs to, and its result as JSON where it was asked for."""

    job: Job
    owner: str | None
    result: str | None = None
    error: CowError | None = None
    ended: float | None = None  # seconds since 1970

    def as_json(self) -> str:
        """The job with its result, which is put in as it stands: reading it only to write it again takes long."""
        text = self.job.model_dump_json()
        return text if self.result is None else text.replace('"result":null', f'"result":{self.result}', 1)


def find(job_id: str, live: Live, *, full: bool = True) -> Found | None:
    """A job by its id; without its result and problem unless `full`."""
    with database_errors():
        found = DBOS.list_workflows(workflow_ids=[job_id], load_input=False, load_output=full)
    return _found(found[0], live) if found and found[0].name in KINDS else None


def page(owner: str | None, filters: Filters, live: Live) -> JobPage:
    """Jobs of an owner, newest first; of everybody where there are no owners. Raises `InvalidRequest` for a cursor."""
    before, seen = _read_cursor(filters.cursor)
    if filters.created_before is not None:
        before = min(before or filters.created_before, filters.created_before)
    wanted = [name for name, status in STATUS.items() if status in filters.status]
    with database_errors():
        found = DBOS.list_workflows(
            name=[filters.kind] if filters.kind else list(KINDS),
            status=wanted or None,
            user=owner,
            start_time=None if filters.created_after is None else filters.created_after.isoformat(),
            end_time=None if before is None else before.isoformat(),
            sort_desc=True,
            limit=filters.limit + len(seen) + 1,
            load_input=False,
            load_output=False,
        )
    rest = [one for one in found if one.workflow_id not in seen]
    shown, more = rest[: filters.limit], len(rest) > filters.limit
    jobs = tuple(sorted((_found(one, live).job for one in shown), key=lambda job: job.created_at, reverse=True))
    return JobPage(jobs=jobs, next=_cursor(shown, seen, before) if more else None)


def open_jobs() -> dict[str, str]:
    """The jobs that wait or run anywhere, and the generator of each."""
    with database_errors():
        found = DBOS.list_workflows(name=list(KINDS), status=OPEN, load_input=False, load_output=False)
    return {one.workflow_id: (one.attributes or {}).get(GENERATOR, "") for one in found}


def ended_before(moment: datetime, limit: int) -> list[str]:
    """Some jobs that ended before a time."""
    with database_errors():
        found = DBOS.list_workflows(
            name=list(KINDS), status=ENDED, completed_before=moment.isoformat(), limit=limit,
            load_input=False, load_output=False,
        )  # fmt: skip
    return [one.workflow_id for one in found]


def existing(jobs: list[str]) -> set[str]:
    """Those of some jobs that the database knows."""
    with database_errors():
        found = DBOS.list_workflows(workflow_ids=jobs, load_input=False, load_output=False)
    return {one.workflow_id for one in found}


def finished_stages(job_id: str) -> list[str]:
    """The stages of a job that are steps and are done, in order."""
    with database_errors():
        steps = DBOS.list_workflow_steps(job_id)
    done = sorted(steps, key=lambda step: step["function_id"])
    return [step["function_name"] for step in done if "." not in step["function_name"] and step["error"] is None]


def _found(status: WorkflowStatus, live: Live) -> Found:
    kind = cast(JobKind, status.name)
    told = STATUS[status.status]
    running = live.look(status.workflow_id) if told == "running" else None
    stage, progress = None, 1.0 if told == "succeeded" else 0.0
    if running is not None:
        stage, progress = running.stage, share_done(kind, running.stage, running.done)
    if told == "running" and (running is None or running.stage is None):
        told = "queued"  # it was taken from the queue, but nobody works on it yet
    error = _error(status) if told == "failed" else None
    job = Job(
        id=status.workflow_id,
        kind=kind,
        status=told,
        stage=stage,
        progress=progress,
        created_at=(status.attributes or {}).get(CREATED) or _time(status.created_at),
        finished_at=None if status.completed_at is None else _time(status.completed_at),
        generator=(status.attributes or {}).get(GENERATOR, ""),
        problem=None if error is None else problem_of(error),
    )
    ended = None if status.completed_at is None else status.completed_at / 1000
    return Found(job, status.authenticated_user, status.output if told == "succeeded" else None, error, ended)


def _error(status: WorkflowStatus) -> CowError | None:
    if status.status == "MAX_RECOVERY_ATTEMPTS_EXCEEDED":
        return InternalError("The server ended while it worked on this job, again and again; it is not tried again.")
    error: Any = status.error
    return error if isinstance(error, CowError) else None


def _time(milliseconds: int | None) -> str:
    moment = datetime.fromtimestamp((milliseconds or 0) / 1000, UTC)
    return moment.isoformat(timespec="milliseconds").replace("+00:00", "Z")


def _cursor(shown: list[WorkflowStatus], seen: set[str], before: datetime | None) -> str:
    """Where the next page begins: the time of the last job, and the jobs of that very time that were shown."""
    last = shown[-1].created_at or 0
    same = {one.workflow_id for one in shown if one.created_at == last}
    if before is not None and last == round(before.timestamp() * 1000):
        same |= seen
    told = json.dumps([last, sorted(same)], separators=(",", ":"))
    return base64.urlsafe_b64encode(told.encode()).decode().rstrip("=")


def _read_cursor(cursor: str | None) -> tuple[datetime | None, set[str]]:
    if cursor is None:
        return None, set()
    try:
        moment, seen = json.loads(base64.urlsafe_b64decode(cursor + "=" * (-len(cursor) % 4)))
        return datetime.fromtimestamp(int(moment) / 1000, UTC), {str(one) for one in list(seen)}
    except (ValueError, TypeError, OverflowError, OSError, binascii.Error, RecursionError) as error:
        detail = "is none that this server gave out"
        raise InvalidRequest(f"`cursor` {detail}.", errors=(FieldError("/cursor", detail),)) from error
