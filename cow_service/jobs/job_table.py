"""The table of jobs: what callers see of a job, the queues in which jobs wait, and who has taken which job.

Every change of a job is one transaction. Methods raise `StorageUnavailable` where the database cannot be used.
"""

import base64
import binascii
import hashlib
import json
import logging
import time
import zlib
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from itertools import product
from typing import Any, Literal, cast, get_args
from urllib.parse import urlsplit
from uuid import uuid4

import sqlalchemy as sa
from pydantic import AwareDatetime, BaseModel, Field
from pydantic_core import to_json

from cow_service.errors import CowError, FieldError, InternalError, InvalidRequest, kinds, unforeseen
from cow_service.jobs.database import OPEN, Database, Notification
from cow_service.jobs.queues import moves, next_turn
from cow_service.jobs.schema import CALLS, JOBS, REFERENCES, STAGES, TRAJECTORIES, packed, unpacked
from cow_service.observability.logging import rfc3339
from cow_service.records import AcceptedRequest, Answer, Job, JobKind, JobPage, JobStatus, Problem, Record, Simulation
from cow_service.records.stages import At, Stage, share_done
from cow_service.requests import AnswerRequest, Priority, SimulateRequest
from cow_service.stages.keys import FORMAT, digest_of

VERSION = "3"  # of jobs; raised in a release whose requests may say what workers of the one before do not understand
READABLE = ("2", VERSION)  # versions of the jobs that are computed here; those of others wait for a process of theirs
MAX_DEATHS = 20  # of processes that had a job
RATE_SECONDS = 300.0  # over which ended jobs are counted
MIN_ENDS = 2  # in that time, from which on a rate is known
MAX_LISTED = 200  # characters of a question in lists, and of an answer
GIVEN = ("grounding", "motion", "trajectory", "objects", "interventions", "camera")  # what readers find, else
EARLIEST, LATEST = datetime(1970, 1, 1, tzinfo=UTC), datetime(9000, 1, 1, tzinfo=UTC)  # that a filter distinguishes
CLAIM_LOCK = 0x434F5702  # of PostgreSQL, held while jobs are taken that a limit across processes applies to

log = logging.getLogger("cow_service")


class JobSpec(Record):
    """What a job has to do. Its image and masks are artifacts: a spec has no bytes. Databases store the field names."""

    kind: JobKind
    request: dict[str, Any]
    reader: str = Field(description="As the server chose it, where the request names none.")
    generator: str = Field(description="As the server chose it, where the request names none.")
    created_at: str = Field(description="RFC 3339, UTC.")
    fresh: bool = Field(default=False, description="Take no results of other jobs.")
    webhook: str | None = Field(default=None, description="URL to call when the job has ended.")
    priority: Priority = Field(default="normal", description="Among the waiting jobs of its key.")
    turn: int = Field(default=0, ge=0, description="Its place among the jobs of all keys: the lower comes first.")
    until: float | None = Field(
        default=None,
        exclude_if=lambda until: until is None,  # earlier versions do not know it
        description="Unix time, s, after which a multimodal LLM that refuses is not asked again.",
    )
    prefers_language: bool = Field(default=False, exclude_if=lambda prefers: not prefers)  # its language is a header's
    request_id: str | None = None
    traceparent: str | None = None

    @property
    def digest(self) -> str:
        """Equal for requests that ask for the same."""
        asked = {name: value for name, value in self.request.items() if name != "language" or not self.prefers_language}
        return digest_of({"kind": self.kind, "request": asked, "fresh": self.fresh, "webhook": self.webhook})

    @property
    def image(self) -> str:
        """The digest of the image."""
        digest: str = self.request["image"]["artifact"]
        return digest

    @property
    def attached(self) -> list[str]:
        """The digests of the masks that the request gives, and of its depth map."""
        places = [self.request.get("grounding") or {}, *self.request.get("objects", ())]
        given = [place.get("mask") for place in places] + [(self.request.get("depth") or {}).get("map")]
        return [picture["artifact"] for picture in given if picture]

    def accepted(self) -> AcceptedRequest:
        """The request as its caller may send it again."""
        priority = {} if self.priority == "normal" else {"priority": self.priority}
        return AcceptedRequest(kind=self.kind, request=self.request | priority)

    def parsed(self) -> SimulateRequest | AnswerRequest:
        """The request as it was validated on arrival."""
        model = AnswerRequest if self.kind == "answer" else SimulateRequest
        return model.model_validate({**self.request, "reader": self.reader, "generator": self.generator})


@dataclass(frozen=True)
class TakenJob:
    """A job that this process has taken. `run` names the attempt: only the latest one can change the job."""

    id: str
    spec: JobSpec
    owner: str | None
    queue: str
    run: str


class JobFilters(BaseModel):
    """Which jobs a caller wants to see: the query of `GET /jobs`."""

    status: list[JobStatus] | None = Field(default=None, description="May be repeated.")
    kind: JobKind | None = None
    created_after: AwareDatetime | None = Field(default=None, description="RFC 3339; included.")
    created_before: AwareDatetime | None = Field(default=None, description="RFC 3339; included.")
    limit: int = Field(default=50, ge=1, le=500)
    cursor: str | None = Field(
        default=None, max_length=40_000, pattern=r"^[A-Za-z0-9_-]*$", description="`next` of the page before."
    )


@dataclass(frozen=True)
class JobState:
    """A job, the name of its owner's key, and its result as JSON values where it was asked for."""

    job: Job
    owner: str | None
    content: dict[str, Any] | None = None
    error: CowError | None = None
    ended: float | None = None  # Unix time, s

    @property
    def result(self) -> str | None:
        """The result as JSON."""
        return None if self.content is None else to_json(self.content).decode()

    def as_json(self) -> str:
        """The job with its result."""
        return to_json({**self.job.model_dump(mode="json"), "result": self.content}).decode()


@dataclass(frozen=True)
class OpenCount:
    """Open jobs that have all of this in common."""

    queue: str
    generator: str
    state: str  # "queued" or "running"
    workflow_version: str
    jobs: int
    oldest: str  # when the first of them was created

    @property
    def oldest_seconds(self) -> float:
        """Since the first of them was created."""
        return max(0.0, time.time() - datetime.fromisoformat(self.oldest).timestamp())


class JobTable:
    """The jobs of a database. Other processes are notified of what happens to them."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def count_open(self, owner: str | None) -> tuple[int, int]:
        """How many jobs are open: all, and those of an owner."""
        ((jobs, own),) = self._database.read(_OPEN_JOBS, {"owner": owner})
        return jobs, own

    def add(
        self,
        job_id: str,
        spec: JobSpec,
        owner: str | None,
        queue: str,
        step: int,
        check: Callable[[int, int], None] = lambda jobs, own: None,
    ) -> bool:
        """Adds a job and what it needs; False if there is one of that id.

        Its turn comes `step` after that of its owner's last job. `check` is given how many jobs are open, all and those
        of the owner; what it raises passes through, and nothing is added.
        """
        with self._database.transaction() as connection:
            given = {"owner": owner, "queue": queue}
            check(*connection.execute(_OPEN_JOBS, {"owner": owner}).one())
            first: Sequence[Any] = connection.execute(_FIRST_TURN, given).all()
            jobs: Sequence[Any] = connection.execute(_TURNS_OF_OWNER, given).all()
            turn = next_turn([*first, *jobs], owner, spec.priority, step)
            spec = spec.model_copy(update={"turn": turn})
            row = spec.model_dump(include={"kind", "created_at", "priority", "turn", "generator", "webhook"})
            row |= {"id": job_id, "owner": owner, "queue": queue, "status": "queued", "version": VERSION, "deaths": 0}
            row |= {"question": spec.request["question"], "image": spec.image, "spec": packed(spec.model_dump_json())}
            row["given"] = ",".join(name for name in GIVEN if name in spec.request) or None
            added = self._database.insert(JOBS).on_conflict_do_nothing().returning(JOBS.c.id)
            if connection.execute(added, row).one_or_none() is None:
                return False
            needed = [{"sha256": sha256, "job_id": job_id} for sha256 in {spec.image, *spec.attached}]
            connection.execute(self._database.insert(REFERENCES).on_conflict_do_nothing(), needed)
            if behind := [job.id for job in jobs if moves(job, owner, spec.priority, turn)]:
                waits = JOBS.c.id.in_(behind), JOBS.c.executor.is_(None)
                connection.execute(sa.update(JOBS).where(*waits).values(turn=JOBS.c.turn + step))
            self._database.notify(connection, Notification("queued", job_id))
        return True

    def waiting_queues(self) -> list[str]:
        """The queues in which jobs wait that can be computed here."""
        query = sa.select(JOBS.c.queue).distinct().where(*_WAITS)
        return [row.queue for row in self._database.read(query)]

    def take(self, queue: str, executor: str, number: int, limit_per_owner: int | None) -> list[TakenJob]:
        """Gives some waiting jobs of a queue to a process, in their turns.

        Jobs of one owner are taken only while fewer than `limit_per_owner` of theirs are taken, in any process.
        """
        wanted = sa.select(JOBS.c.id).where(JOBS.c.queue == queue, *_WAITS).order_by(*_ORDER).limit(number)
        if limit_per_owner is not None:
            wanted = wanted.where(JOBS.c.id.in_(_within_limit(queue, limit_per_owner)))
        chosen = wanted.with_for_update(skip_locked=True).cte()  # as a subquery, PostgreSQL might run it several times
        taken = (
            sa.update(JOBS)
            .where(JOBS.c.id.in_(sa.select(chosen.c.id)), JOBS.c.executor.is_(None))
            .values(executor=executor, run=uuid4().hex)
            .returning(JOBS.c.id, JOBS.c.owner, JOBS.c.turn, JOBS.c.created_at, JOBS.c.run, JOBS.c.spec)
        )
        with self._database.transaction() as connection:
            if limit_per_owner is not None:
                self._database.lock(connection, CLAIM_LOCK)
            rows = connection.execute(taken).all()
        found: list[TakenJob] = []
        for row in sorted(rows, key=lambda row: (row.turn, row.created_at, row.id)):
            try:  # a later version may have more fields
                spec = JobSpec.model_validate(unpacked(row.spec) | {"turn": row.turn}, extra="ignore")
            except (ValueError, zlib.error):  # what came with it must not wait for it
                log.exception("job %s cannot be read", row.id)
                self._end(row.id, "failed", row.run, error=json.dumps(error_as_json(unforeseen())))
            else:
                found.append(TakenJob(row.id, spec, row.owner, queue, row.run))
        return found

    def begin(self, job: TakenJob, stage: Stage, done: float) -> bool:
        """Marks a job as running. False if it is no longer this process's: it was canceled, for example."""
        with self._database.transaction() as connection:
            running = sa.update(JOBS).where(*_attempt(job.id, job.run)).values(status="running")
            is_mine = connection.execute(running).rowcount > 0
            if is_mine:
                self._database.notify(connection, Notification("progress", job.id, stage, done))
        return is_mine

    def tell_progress(self, jobs: Mapping[str, At]) -> None:
        """Notifies the other processes of how far jobs are."""
        with self._database.transaction() as connection:
            told = (Notification("progress", job_id, stage, done) for job_id, (stage, done) in jobs.items())
            self._database.notify(connection, *told)

    def release(self, job_id: str, run: str, why: str) -> bool:
        """Puts a job back into its queue. False if it is no longer this process's, or has ended.

        Where another process took it, as this one seemed to have ended, that was a mistake, and is not held against it.
        """
        others = JOBS.c.id == job_id, JOBS.c.run.is_distinct_from(run), JOBS.c.status.in_(OPEN), JOBS.c.deaths > 0
        with self._database.transaction() as connection:
            released = sa.update(JOBS).where(*_attempt(job_id, run)).values(_RELEASED)
            is_mine = connection.execute(released).rowcount > 0
            if is_mine:
                log.info("job %s goes back to its queue: %s", job_id, why)
                self._database.notify(connection, Notification("queued", job_id))
            else:
                connection.execute(sa.update(JOBS).where(*others).values(deaths=JOBS.c.deaths - 1))
        return is_mine

    def succeed(
        self, job: TakenJob, result: str, trajectory_key: str | None, stages: Collection[str], answer: str = ""
    ) -> bool:
        """Stores the result of a job, and its answer in words.

        False where the job is no longer this process's, and where one of its stages is not stored: PostgreSQL loses the
        latest ones in a crash, with what refers to their artifacts.
        """
        values = {"result": packed(result), "format": FORMAT, "trajectory_key": trajectory_key}
        values["answer"] = answer if len(answer) <= MAX_LISTED else answer[: MAX_LISTED - 1] + "…"
        stored = sa.select(sa.func.count()).where(STAGES.c.job_id == job.id, STAGES.c.stage.in_(stages))
        return self._end(job.id, "succeeded", job.run, stored.scalar_subquery() == len(stages), **values)

    def fail(self, job: TakenJob, error: CowError) -> bool:
        """Stores what a job failed with. False where the job is no longer this process's."""
        return self._end(job.id, "failed", job.run, error=json.dumps(error_as_json(error)))

    def cancel(self, job_id: str) -> bool:
        """Ends a job; False if it had ended."""
        return self._end(job_id, "canceled")

    def executors(self) -> set[str]:
        """The processes that have jobs."""
        query = sa.select(JOBS.c.executor).distinct().where(JOBS.c.executor.is_not(None), JOBS.c.status.in_(OPEN))
        return {row.executor for row in self._database.read(query)}

    def taken_by(self, executor: str) -> dict[str, str]:
        """The open jobs that a process has, and its attempts."""
        query = sa.select(JOBS.c.id, JOBS.c.run).where(JOBS.c.executor == executor, JOBS.c.status.in_(OPEN))
        return {row.id: row.run for row in self._database.read(query)}

    def recover(self, executors: Iterable[str]) -> list[str]:
        """Puts the jobs of processes that have ended back into their queues; returns their ids.

        One of which too many processes ended fails: it ends its process each time.
        """
        theirs = JOBS.c.executor.in_(list(executors)), JOBS.c.status.in_(OPEN)
        worn_out = sa.select(JOBS.c.id, JOBS.c.run).where(*theirs, JOBS.c.deaths >= MAX_DEATHS)
        detail = "The server ended repeatedly while it worked on this job, so the job is not tried again."
        error = json.dumps(error_as_json(InternalError(detail)))
        for row in self._database.read(worn_out):
            self._end(row.id, "failed", row.run, error=error)
        with self._database.transaction() as connection:
            released = sa.update(JOBS).where(*theirs).values(_RELEASED | {"deaths": JOBS.c.deaths + 1})
            rows = connection.execute(released.returning(JOBS.c.id, JOBS.c.deaths)).all()
            self._database.notify(connection, *(Notification("queued", row.id) for row in rows))
        for row in rows:
            log.info("job %s goes back to its queue: its process has ended (number %d)", row.id, row.deaths)
        return [row.id for row in rows]

    def find(self, job_id: str, at: At | None, *, full: bool = True) -> JobState | None:
        """A job by its id: with its result unless `full` is false, and with its place while it waits.

        `at`: how far it is, as it was known before this call.
        """
        query = sa.select(*_SHOWN, JOBS.c.queue, JOBS.c.turn)
        if full:
            stored = sa.and_(TRAJECTORIES.c.job_id == JOBS.c.id, TRAJECTORIES.c.key == JOBS.c.trajectory_key)
            query = query.add_columns(JOBS.c.result, JOBS.c.format, TRAJECTORIES.c.trajectory)
            query = query.select_from(JOBS.outerjoin(TRAJECTORIES, stored))
        rows = self._database.read(query.where(JOBS.c.id == job_id))
        if not rows:
            return None
        found = _state(rows[0], at)
        if found.job.status == "queued":
            return replace(found, job=found.job.model_copy(update=self._place_in_queue(rows[0])))
        if not full or found.job.status != "succeeded":
            return found
        content: dict[str, Any] = unpacked(rows[0].result)
        if rows[0].trajectory is not None:
            (content.get("simulation") or content)["trajectory"] = unpacked(rows[0].trajectory)  # null until now
        if rows[0].format < FORMAT:  # as this version writes it; results of later versions are returned unchanged
            model = Answer if found.job.kind == "answer" else Simulation
            content = model.model_validate(content).model_dump(mode="json")
        return replace(found, content=content)

    def page(self, owner: str | None, filters: JobFilters, all_at: Mapping[str, At]) -> JobPage:
        """Jobs of an owner, newest first; of everybody where there are no owners. Raises `InvalidRequest`."""
        query = sa.select(*_SHOWN).order_by(JOBS.c.created_at.desc(), JOBS.c.id.desc()).limit(filters.limit + 1)
        if owner is not None:
            query = query.where(JOBS.c.owner == owner)
        if filters.created_after is not None:
            query = query.where(JOBS.c.created_at >= _text(filters.created_after, round_up=True))
        if filters.created_before is not None:
            query = query.where(JOBS.c.created_at <= _text(filters.created_before))
        if filters.cursor is not None:
            last = sa.tuple_(*(sa.literal(part) for part in _read_cursor(filters.cursor)))
            query = query.where(sa.tuple_(JOBS.c.created_at, JOBS.c.id) < last)
        if filters.kind is not None or filters.status:
            # Reads one index range per kind and status, and from each no more than one page.
            kinds = [filters.kind] if filters.kind else get_args(JobKind)
            pairs = product(kinds, sorted({*(filters.status or get_args(JobStatus))}))
            ranges = (query.where(JOBS.c.kind == kind, JOBS.c.status == status) for kind, status in pairs)
            merged = sa.union_all(*(sa.select(one.subquery()) for one in ranges)).subquery()
            newest = merged.c.created_at.desc(), merged.c.id.desc()
            query = sa.select(merged).order_by(*newest).limit(filters.limit + 1)
        found = self._database.read(query)
        rows = found[: filters.limit]
        jobs: list[Job] = []
        for row in rows:
            job = _state(row, all_at.get(row.id)).job
            if job.question is not None and len(job.question) > MAX_LISTED:
                job = job.model_copy(update={"question": job.question[: MAX_LISTED - 1] + "…"})
            jobs.append(job)
        after = None
        if len(found) > len(rows):
            position = json.dumps([rows[-1].created_at, rows[-1].id]).encode()
            after = base64.urlsafe_b64encode(position).decode().rstrip("=")
        return JobPage(jobs=tuple(jobs), next=after)

    def spec(self, job_id: str) -> JobSpec | None:
        """What a job has to do."""
        rows = self._database.read(sa.select(JOBS.c.spec).where(JOBS.c.id == job_id))
        return JobSpec.model_validate(unpacked(rows[0].spec)) if rows else None

    def may_read(self, sha256: str, owner: str) -> bool:
        """Whether a job of an owner needs an artifact."""
        query = sa.select(JOBS.c.id).join(REFERENCES).where(REFERENCES.c.sha256 == sha256, JOBS.c.owner == owner)
        return bool(self._database.read(query.limit(1)))

    def ended_before(self, moment: float, limit: int) -> list[str]:
        """Some jobs that ended before a time (Unix time, s)."""
        return [row.id for row in self._database.read(sa.select(JOBS.c.id).where(JOBS.c.ended < moment).limit(limit))]

    def open_counts(self) -> list[OpenCount]:
        """How many jobs wait or run anywhere."""
        groups = JOBS.c.queue, JOBS.c.generator, JOBS.c.status, JOBS.c.version
        counts = sa.func.count(), sa.func.min(JOBS.c.created_at)
        rows = self._database.read(sa.select(*groups, *counts).where(JOBS.c.status.in_(OPEN)).group_by(*groups))
        return [OpenCount(*row) for row in rows]

    def ended_lately(self) -> dict[str, int]:
        """How many jobs of each queue ended, well or not, in the last `RATE_SECONDS`."""
        lately = JOBS.c.ended > time.time() - RATE_SECONDS, JOBS.c.status.in_(("succeeded", "failed"))
        counts = sa.select(JOBS.c.queue, sa.func.count()).where(*lately).group_by(JOBS.c.queue)
        return dict(self._database.read(counts))

    def delete(self, jobs: list[str]) -> set[str]:
        """Deletes jobs that have ended with all that belongs to them; returns the artifacts that no other job needs.

        One that is open is another of the same id, which somebody has submitted meanwhile.
        """
        ended = sa.select(JOBS.c.id).where(JOBS.c.id.in_(jobs), JOBS.c.status.not_in(OPEN))
        theirs = sa.select(REFERENCES.c.sha256).where(REFERENCES.c.job_id.in_(ended)).distinct()
        with self._database.transaction(durable=True) as connection:  # their artifacts are removed next
            artifacts = set(connection.execute(theirs).scalars())
            connection.execute(sa.delete(JOBS).where(JOBS.c.id.in_(jobs), JOBS.c.status.not_in(OPEN)))
        return artifacts - self._database.referenced(artifacts)

    def _end(
        self,
        job_id: str,
        status: JobStatus,
        run: str | None = None,
        condition: sa.ColumnElement[bool] | None = None,
        **values: Any,
    ) -> bool:
        """Ends an open job, and has its webhook called. Of an attempt: only if it is the latest."""
        this = [JOBS.c.id == job_id] if run is None else [JOBS.c.id == job_id, JOBS.c.run == run]
        where = [*this, JOBS.c.status.in_(OPEN), *([] if condition is None else [condition])]
        ended = sa.update(JOBS).where(*where).values(status=status, ended=time.time(), **values)
        with self._database.transaction(durable=True) as connection:
            row = connection.execute(ended.returning(JOBS.c.webhook)).one_or_none()
            if row is not None:
                told: Literal["canceled", "ended"] = "canceled" if status == "canceled" else "ended"
                self._database.notify(connection, Notification(told, job_id))
                if row.webhook is not None:
                    host = urlsplit(row.webhook).netloc.rpartition("@")[2].lower()
                    receiver = hashlib.sha256(host.encode()).hexdigest()
                    call = {"job_id": job_id, "url": row.webhook, "receiver": receiver, "attempts": 0}
                    connection.execute(sa.insert(CALLS).values(**call, due=self._database.now))
            elif run is not None:  # an earlier try whose commit was not heard of may have done it
                row = connection.execute(sa.select(JOBS.c.id).where(*this, JOBS.c.status == status)).one_or_none()
        return row is not None

    def _place_in_queue(self, row: sa.Row[Any]) -> dict[str, float | None]:
        """`position` and `expected_wait` of a queued job; how fast an idle queue would be, is not known."""
        now = time.time()
        own = sa.tuple_(sa.literal(row.turn), sa.literal(row.created_at))
        before = sa.select(sa.func.count()).where(
            JOBS.c.queue == row.queue, JOBS.c.status == "queued", sa.tuple_(JOBS.c.turn, JOBS.c.created_at) < own
        )
        works = sa.exists().where(JOBS.c.queue == row.queue, JOBS.c.executor.is_not(None), JOBS.c.status.in_(OPEN))
        ended = JOBS.c.queue == row.queue, JOBS.c.ended > now - RATE_SECONDS
        query = sa.select(before.scalar_subquery(), works, sa.func.count(), sa.func.min(JOBS.c.ended)).where(*ended)
        ((position, busy, ends, first),) = self._database.read(query)
        wait = (position + 1) * (now - first) / ends if ends >= MIN_ENDS and (position or busy) else None
        return {"position": position, "expected_wait": None if wait is None else round(wait, 1)}


_WAITS = JOBS.c.status == "queued", JOBS.c.executor.is_(None), JOBS.c.version.in_(READABLE)
_ORDER = JOBS.c.turn, JOBS.c.created_at, JOBS.c.id
_RELEASED = {"status": "queued", "executor": None, "run": None}
_OF_OWNER = JOBS.c.owner.is_not_distinct_from(sa.bindparam("owner", type_=sa.Text))
_OF_QUEUE = JOBS.c.queue == sa.bindparam("queue", type_=sa.Text)
_OPEN_JOBS = sa.select(sa.func.count(), sa.func.count(sa.case((_OF_OWNER, 1)))).where(JOBS.c.status.in_(OPEN))
_TURNS = sa.select(JOBS.c.id, JOBS.c.owner, JOBS.c.turn, JOBS.c.priority).where(_OF_QUEUE, JOBS.c.status.in_(OPEN))
_FIRST_TURN, _TURNS_OF_OWNER = _TURNS.order_by(JOBS.c.turn).limit(1), _TURNS.where(_OF_OWNER)
_NAMES = (
    "id", "kind", "owner", "status", "created_at", "ended",
    "generator", "question", "answer", "given", "image", "error",
)  # fmt: skip
_SHOWN = [JOBS.c[name] for name in _NAMES]


def _attempt(job_id: str, run: str) -> tuple[sa.ColumnElement[bool], ...]:
    """The job while this attempt is its latest, and it has not ended."""
    return JOBS.c.id == job_id, JOBS.c.run == run, JOBS.c.status.in_(OPEN)


def error_as_json(error: CowError) -> dict[str, Any]:
    """Its code, detail, remedy, fields, usage and refusal, as JSON values."""
    fields = [asdict(field) for field in error.errors]
    told = {"code": error.code, "detail": error.detail, "remedy": error.remedy}
    return told | {"errors": fields, "usage": error.usage, "refusal": error.refusal}


def error_from_json(kept: Mapping[str, Any]) -> CowError:
    """The same error; an internal one where a later version made it, and it is not known here."""
    kind = kinds().get(kept["code"], InternalError)
    error = kind(
        kept["detail"], remedy=kept.get("remedy", ""), errors=tuple(FieldError(**field) for field in kept["errors"])
    )
    error.usage, error.refusal = kept.get("usage"), kept.get("refusal")
    return error


def _within_limit(queue: str, limit: int) -> sa.Select[Any]:
    """The waiting jobs of a queue that their owners' limits still allow to run."""
    taken = (
        sa.select(JOBS.c.owner, sa.func.count().label("number"))
        .where(JOBS.c.executor.is_not(None), JOBS.c.status.in_(OPEN))
        .group_by(JOBS.c.owner)
        .subquery()
    )
    place = sa.func.row_number().over(partition_by=JOBS.c.owner, order_by=_ORDER)
    waiting = sa.select(JOBS.c.id, JOBS.c.owner, place.label("place")).where(JOBS.c.queue == queue, *_WAITS).subquery()
    number = waiting.c.place + sa.func.coalesce(taken.c.number, 0)
    return (
        sa.select(waiting.c.id)
        .outerjoin(taken, taken.c.owner == waiting.c.owner)
        .where(sa.or_(waiting.c.owner.is_(None), number <= limit))
    )


def _state(row: sa.Row[Any], at: At | None) -> JobState:
    kind, status = cast(JobKind, row.kind), cast(JobStatus, row.status)
    stage, progress = None, 1.0 if status == "succeeded" else 0.0
    if at is not None and status == "running":
        stage, done = at
        progress = share_done(kind, stage, done)
    error = None if row.error is None else error_from_json(json.loads(row.error))
    job = Job(
        id=row.id,
        kind=kind,
        status=status,
        stage=stage,
        progress=progress,
        question=row.question,
        answer=row.answer or None,
        given=tuple(row.given.split(",")) if row.given else (),
        image=row.image,
        created_at=row.created_at,
        finished_at=None if row.ended is None else max(rfc3339(row.ended), row.created_at),  # clocks may differ
        generator=row.generator,
        problem=None if error is None else Problem(**error.as_problem()),
    )
    return JobState(job, row.owner, error=error, ended=row.ended)


def _text(moment: datetime, *, round_up: bool = False) -> str:
    """A time as the table has it: to the millisecond."""
    whole = min(max(moment, EARLIEST), LATEST)
    rest = whole.microsecond % 1000
    return rfc3339(whole.timestamp() + ((1000 - rest) / 1e6 if round_up and rest else 0.0))


def _read_cursor(cursor: str) -> tuple[str, str]:
    try:
        created_at, job_id = json.loads(base64.urlsafe_b64decode(cursor + "=" * (-len(cursor) % 4)))
        datetime.fromisoformat(created_at)
        return created_at, str(job_id)
    except (ValueError, TypeError, binascii.Error, RecursionError) as error:
        detail = "was not issued by this server"
        raise InvalidRequest(f"`cursor` {detail}.", errors=(FieldError("/cursor", detail),)) from error
