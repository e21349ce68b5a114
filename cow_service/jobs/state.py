"""The state of jobs as callers see it, from the database and from what this process runs."""

from __future__ import annotations

import base64
import binascii
import json
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Any, cast, get_args

from dbos import DBOS, WorkflowStatus

from cow_service.errors import CowError, FieldError, InternalError, InvalidRequest
from cow_service.jobs.active import ActiveJobs, At, share_done
from cow_service.jobs.database import database_errors
from cow_service.jobs.queues import LIGHT
from cow_service.observability.logging import rfc3339
from cow_service.records import Answer, Job, JobKind, JobPage, JobStatus, Problem, Simulation
from cow_service.requests import Priority

KINDS: tuple[JobKind, ...] = get_args(JobKind)
# What DBOS keeps beside a workflow.
ATTRIBUTE_GENERATOR, ATTRIBUTE_CREATED_AT, ATTRIBUTE_QUEUE = "generator", "created_at", "queue"
ATTRIBUTE_TURN, ATTRIBUTE_PRIORITY = "turn", "priority"
ATTRIBUTE_QUESTION, ATTRIBUTE_IMAGE = "question", "image"
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
MAX_LISTED_QUESTION = 200  # characters of a question in lists
MIN_BATCH = 200  # jobs read at a time where filters may drop some of them
MAX_DELAY = timedelta(seconds=30)  # from the creation of a job to its row: as long as writers wait
EPOCH = datetime.fromtimestamp(0, UTC)
HALF_MILLISECOND = timedelta(microseconds=500)  # milliseconds as floating point come out a little too small


@dataclass(frozen=True)
class JobFilters:
    """Which jobs a caller wants to see. Times are RFC 3339."""

    status: tuple[JobStatus, ...] = ()
    kind: JobKind | None = None
    created_after: datetime | None = None
    created_before: datetime | None = None
    limit: int = 50
    cursor: str | None = None


@dataclass(frozen=True)
class JobState:
    """A job, the name of its owner's key, and its result as JSON where it was asked for."""

    job: Job
    owner: str | None
    result: str | None = None
    error: CowError | None = None
    ended: float | None = None  # seconds since 1970

    def as_json(self) -> str:
        """The job with its result, which is JSON already: parsing it only to write it again takes long."""
        if self.result is None:
            return self.job.model_dump_json()
        return f'{self.job.model_dump_json(exclude={"result"})[:-1]},"result":{self.result}}}'


def find(job_id: str, active: ActiveJobs, *, full: bool = True) -> JobState | None:
    """A job by its id; without its result and problem unless `full`."""
    at = active.at(job_id)  # before the database is asked: see `all_at`
    found = workflows_of_jobs(workflow_ids=[job_id], load_output=full)
    return _state(found[0], {} if at is None else {job_id: at}) if found else None


def page(owner: str | None, filters: JobFilters, active: ActiveJobs) -> JobPage:
    """Jobs of an owner, newest first; of everybody where there are no owners. Raises `InvalidRequest` for a cursor."""
    before, seen = _read_cursor(filters.cursor)
    after, latest = filters.created_after, filters.created_before
    if latest is not None and latest < datetime.now(UTC):
        before = min(before or latest + MAX_DELAY, latest + MAX_DELAY)
    jobs: list[Job] = []
    while True:
        most = max(filters.limit, MIN_BATCH) if after or latest or filters.status else filters.limit
        at = active.all_at()
        rest = [one for one in _listed(owner, filters, before, most + len(seen) + 1) if one.workflow_id not in seen]
        taken = 0
        for one in rest[:most]:
            taken += 1
            job = _state(one, at).job
            came = datetime.fromisoformat(job.created_at)
            fits = not filters.status or job.status in filters.status
            if fits and (after is None or after <= came) and (latest is None or came <= latest):
                jobs.append(_listed_job(job))
            if len(jobs) == filters.limit:
                break
        more = len(rest) > taken
        if not more or len(jobs) == filters.limit:
            break
        before, seen = _position(rest[:taken], seen, before)
    jobs = _with_problems(sorted(jobs, key=lambda job: job.created_at, reverse=True))
    return JobPage(jobs=tuple(jobs), next=_cursor(*_position(rest[:taken], seen, before)) if more else None)


def _with_problems(jobs: list[Job]) -> list[Job]:
    """The jobs with what the failed ones failed for: lists are read without outcomes, which can be long."""
    failed = [job.id for job in jobs if job.status == "failed"]
    if not failed:
        return jobs
    found = {one.workflow_id: _error(one) for one in workflows_of_jobs(workflow_ids=failed, load_output=True)}
    problems = {job_id: Problem(**error.as_problem()) for job_id, error in found.items() if error is not None}
    return [job.model_copy(update={"problem": problems.get(job.id, job.problem)}) for job in jobs]


def _listed(owner: str | None, filters: JobFilters, before: datetime | None, limit: int) -> list[WorkflowStatus]:
    """Jobs by the times of the database, which may be whole seconds."""
    after = filters.created_after
    wanted = [name for name, status in STATUS.items() if status in filters.status]
    if "queued" in filters.status:
        wanted = sorted({*wanted, "PENDING"})  # of those taken from the queue, some still wait
    found = workflows_of_jobs(
        name=[filters.kind] if filters.kind else list(KINDS),
        status=wanted or None,
        user=owner,
        start_time=None if after is None or after < EPOCH else after.replace(microsecond=0).isoformat(),
        end_time=None if before is None else (max(before, EPOCH) + HALF_MILLISECOND).isoformat(),
        sort_desc=True,
        limit=limit,
    )
    # Those of one time are in the order in which they came, but not where several statuses were looked up one by one.
    return sorted(found, key=lambda one: (one.created_at, _attribute(one, ATTRIBUTE_CREATED_AT)), reverse=True)


def _listed_job(job: Job) -> Job:
    if job.question is None or len(job.question) <= MAX_LISTED_QUESTION:
        return job
    return job.model_copy(update={"question": job.question[: MAX_LISTED_QUESTION - 1] + "…"})


def workflows_of_jobs(**filters: Any) -> list[WorkflowStatus]:
    """The workflows of jobs that match filters of `DBOS.list_workflows`; without results unless `load_output`."""
    defaults: dict[str, Any] = {"load_input": False, "load_output": False}
    # Of ids that are known the kinds are looked at here: SQLite would look at all jobs of a kind for their ids.
    if "workflow_ids" not in filters:
        defaults["name"] = list(KINDS)
    with database_errors():
        return [one for one in DBOS.list_workflows(**(defaults | filters)) if one.name in KINDS]


@dataclass(frozen=True)
class OpenJob:
    """A job that waits or runs."""

    generator: str
    owner: str | None = None
    turn: int = 0
    queue: str = LIGHT
    created_at: str = ""
    priority: Priority = "normal"


def open_jobs() -> dict[str, OpenJob]:
    """The jobs that wait or run anywhere, by their ids."""
    return {
        one.workflow_id: OpenJob(
            _attribute(one, ATTRIBUTE_GENERATOR),
            one.authenticated_user,
            _turn(one),
            queue_of(one),
            _attribute(one, ATTRIBUTE_CREATED_AT),
            cast(Priority, _attribute(one, ATTRIBUTE_PRIORITY) or "normal"),
        )
        for one in workflows_of_jobs(status=OPEN)
    }


def queue_of(status: WorkflowStatus) -> str:
    """The queue that a job belongs to, also where it was started without waiting in it."""
    return _attribute(status, ATTRIBUTE_QUEUE) or LIGHT


def pending_of(executors: list[str] | None = None) -> list[WorkflowStatus]:
    """The workflows that some processes, or all, have in hand, those of webhooks included."""
    with database_errors():
        return DBOS.list_workflows(status="PENDING", executor_id=executors, load_input=False, load_output=False)


def executors_at_work() -> set[str]:
    """The executor ids of the processes that have workflows in hand."""
    return {one.executor_id for one in pending_of() if one.executor_id is not None}


def ended_before(moment: datetime, limit: int) -> list[str]:
    """Some jobs that ended before a time."""
    found = workflows_of_jobs(status=ENDED, completed_before=moment.isoformat(), limit=limit)
    return [one.workflow_id for one in found]


def ended_of(jobs: list[str]) -> list[str]:
    """Those of some jobs that have ended."""
    return [one.workflow_id for one in workflows_of_jobs(workflow_ids=jobs, status=ENDED)]


def existing(jobs: list[str], owner: str | None = None) -> set[str]:
    """Those of some jobs that the database knows, of an owner where one is given."""
    return {one.workflow_id for one in workflows_of_jobs(workflow_ids=jobs, user=owner)}


def _turn(status: WorkflowStatus) -> int:
    """That of one in a queue is its priority number in DBOS less one: it may have moved back since it came."""
    return status.priority - 1 if status.priority else int(_attribute(status, ATTRIBUTE_TURN) or 0)


def _attribute(status: WorkflowStatus, name: str) -> str:
    return (status.attributes or {}).get(name, "")


def _state(status: WorkflowStatus, all_at: Mapping[str, At]) -> JobState:
    kind = cast(JobKind, status.name)
    shown = STATUS[status.status]
    at = all_at.get(status.workflow_id) if shown == "running" else None
    stage, progress = None, 1.0 if shown == "succeeded" else 0.0
    if at is not None:
        stage, done = at
        progress = share_done(kind, stage, done)
    if shown == "running" and status.executor_id == DBOS.executor_id and stage is None:
        shown = "queued"  # it was taken from the queue, but no thread works on it yet
    error = _error(status) if shown == "failed" else None
    created = _attribute(status, ATTRIBUTE_CREATED_AT) or _time(status.created_at)
    job = Job(
        id=status.workflow_id,
        kind=kind,
        status=shown,
        stage=stage,
        progress=progress,
        question=_attribute(status, ATTRIBUTE_QUESTION) or None,
        image=_attribute(status, ATTRIBUTE_IMAGE) or None,
        created_at=created,
        # Times in SQLite may be whole seconds, and before the job came.
        finished_at=None if status.completed_at is None else max(_time(status.completed_at), created),
        generator=_attribute(status, ATTRIBUTE_GENERATOR),
        problem=None if error is None else Problem(**error.as_problem()),
    )
    ended = None if status.completed_at is None else status.completed_at / 1000
    result = status.output if shown == "succeeded" else None
    return JobState(job, status.authenticated_user, result and _current(kind, result), error, ended)


def _current(kind: JobKind, result: str) -> str:
    """A stored result as it is written today: that of an older version had its only path in the trajectory itself.

    Others are not parsed: that takes long. Inside a text, quotes would stand behind backslashes.
    """
    if '"trajectory":{' not in result or '"trajectory":{"law":' in result:
        return result
    model = Answer if kind == "answer" else Simulation
    return model.model_validate_json(result).model_dump_json()


def _error(status: WorkflowStatus) -> CowError | None:
    if status.status == "MAX_RECOVERY_ATTEMPTS_EXCEEDED":
        return InternalError("The server ended while it worked on this job, again and again; it is not tried again.")
    error: Any = status.error
    return error if isinstance(error, CowError) else None


def _time(milliseconds: int | None) -> str:
    return rfc3339((milliseconds or 0) / 1000)


def _position(taken: list[WorkflowStatus], seen: set[str], before: datetime | None) -> tuple[datetime, set[str]]:
    """Where the next page begins: the time of the last job, and the jobs of that same time that were shown."""
    last = taken[-1].created_at or 0
    same = {one.workflow_id for one in taken if one.created_at == last}
    if before is not None and last == _milliseconds(before):
        same |= seen
    return EPOCH + timedelta(milliseconds=last), same


def _milliseconds(moment: datetime) -> int:
    return (moment - EPOCH) // timedelta(milliseconds=1)


def _cursor(before: datetime, seen: set[str]) -> str:
    text = json.dumps([_milliseconds(before), sorted(seen)], separators=(",", ":"))
    return base64.urlsafe_b64encode(text.encode()).decode().rstrip("=")


def _read_cursor(cursor: str | None) -> tuple[datetime | None, set[str]]:
    if cursor is None:
        return None, set()
    try:
        moment, seen = json.loads(base64.urlsafe_b64decode(cursor + "=" * (-len(cursor) % 4)))
        return EPOCH + timedelta(milliseconds=int(moment)), {str(one) for one in list(seen)}
    except (ValueError, TypeError, OverflowError, OSError, binascii.Error, RecursionError) as error:
        detail = "is none that this server gave out"
        raise InvalidRequest(f"`cursor` {detail}.", errors=(FieldError("/cursor", detail),)) from error
