"""From a request to its job, and from the job to the response: at once, after some seconds, or when it has ended."""

import asyncio
import json
import re
import time
from collections import defaultdict
from collections.abc import Awaitable, Callable
from contextlib import nullcontext, suppress
from dataclasses import dataclass, replace
from functools import partial
from http import HTTPStatus
from typing import Annotated, Any, TypeVar, get_args

from anyio import CapacityLimiter, to_thread
from fastapi import Depends, Request, Response
from starlette.datastructures import Headers

from cow_service import errors
from cow_service.api.body import parse, receive
from cow_service.api.middleware.access import charge
from cow_service.api.middleware.body_limit import release_body
from cow_service.errors import CowError, FieldError, InvalidRequest
from cow_service.jobs.active import Waiter
from cow_service.jobs.engine import JobEngine, new_job_id
from cow_service.jobs.job_table import JobSpec, JobState
from cow_service.observability import logging as context
from cow_service.records import TERMINAL, JobKind, Language, Look
from cow_service.requests import ImageArtifact, LookRequest, SimulateRequest
from cow_service.service import is_url
from cow_service.stages.run import now

POLL_SECONDS = 3.0  # another process may have run the job
MAX_CONCURRENT_BODIES = 4  # read at the same time
MAX_CONCURRENT_LOOKS = 2  # they wait for the CPU with everything else
MAX_CONCURRENT_FETCHES = 64  # of images given by URL
RETRY_AFTER = {"Retry-After": "1"}

Made = TypeVar("Made")


def owner_of(request: Request) -> str | None:
    """Whose key the request came with; None if the server has no keys."""
    return request.scope.get("state", {}).get("owner")


def from_app(name: str) -> Any:
    """A dependency of operations: what `create_app` keeps in the app's state under this name."""

    async def get(request: Request) -> Any:  # not run in a thread, as plain functions are
        return getattr(request.app.state, name)

    return Depends(get)


async def _owner(request: Request) -> str | None:
    return owner_of(request)


# A tag such as de-AT, and its weight (RFC 9110, 12.4.2).
_LANGUAGE_RANGE = re.compile(r"(?:^|,)\s*([a-z]+)(?:-[a-z0-9-]*)?\s*(?:;\s*q\s*=\s*([01](?:\.\d{0,3})?)\s*)?(?=,|$)")
Engine = Annotated[JobEngine, from_app("engine")]
Owner = Annotated[str | None, Depends(_owner)]


def language_of(header: str) -> Language | None:
    """The language that an `Accept-Language` header prefers among those of narrations; None for English, which most
    browsers send unasked: the question's own language says more."""
    weights: dict[str, float] = {}
    for found in _LANGUAGE_RANGE.finditer(header.lower()):
        weights.setdefault(found[1], float(found[2] or 1))
    known: list[Language] = [each for each in get_args(Language) if weights.get(each, 0.0) > 0]
    best = max(known, key=lambda each: (weights[each], -[*weights].index(each)), default=None)
    return None if best == "en" else best


@dataclass(frozen=True)
class Preferences:
    """How a caller wants to be answered."""

    respond_async: bool = False
    wait: int | None = None  # seconds
    key: str | None = None  # the idempotency key
    fresh: bool = False  # no results of earlier requests
    minimal: bool = False  # results without their long lists

    @property
    def applied(self) -> str:
        """`Preference-Applied` of a response that is the job."""
        applied = ("respond-async",) if self.respond_async else ()
        return ", ".join(applied if self.wait is None else (*applied, f"wait={self.wait}"))


@dataclass
class Submission:
    """Who submits which job, and how they want to be answered. `replayed` is known once it was submitted.

    `image` is that of the request as its bytes were received, until it is kept.
    """

    kind: JobKind
    owner: str | None
    prefer: Preferences
    job_id: str
    image: bytes | None = None
    prefers_language: bool = False  # see `JobSpec.prefers_language`
    until: float | None = None  # see `JobSpec.until`
    replayed: bool = False  # the job was there before, under the same Idempotency-Key

    @property
    def headers(self) -> dict[str, str]:
        """Of the response to it, errors included."""
        return {"Idempotent-Replayed": "true"} if self.replayed else {}  # as Stripe names it


class FairThreads:
    """Does work of owners in a few threads, in the order in which it comes. One is left for others: no owner with a key
    has more than three quarters of them.
    """

    def __init__(self, threads: int) -> None:
        self._all = CapacityLimiter(threads)
        self._of = defaultdict[str, CapacityLimiter](lambda: CapacityLimiter(threads - threads // 4))

    async def run(self, owner: str | None, work: Callable[[], Made]) -> Made:
        """What the work returns or raises. The caller is charged for its CPU time."""
        used = 0.0

        def timed() -> Made:
            nonlocal used
            began = time.thread_time()
            try:
                return work()
            finally:
                used = time.thread_time() - began

        try:
            async with nullcontext() if owner is None else self._of[owner]:
                return await to_thread.run_sync(timed, limiter=self._all)
        finally:
            charge.get()("CPU seconds for reading bodies", used)


class Submitter:
    """Makes jobs of requests, and responses of their outcomes.

    Bodies are read in threads. Their images are decoded where jobs are computed: a decoder that crashes, or takes long,
    costs a worker process.
    """

    def __init__(self, engine: JobEngine) -> None:
        self.engine = engine
        self.in_thread = FairThreads(MAX_CONCURRENT_BODIES).run  # reads bodies of an owner
        self._fetches = FairThreads(MAX_CONCURRENT_FETCHES)
        self._looks = FairThreads(MAX_CONCURRENT_LOOKS)

    async def run(self, request: Request, kind: JobKind, model: type[SimulateRequest]) -> Response:
        """The job's result, or the job itself where the caller does not want to wait so long.

        Raises what is wrong with the request, and what the job fails with.
        """
        submission = self.submission(request, kind)
        raw = await receive(request)
        submission.image = raw.image
        body = await self.in_thread(submission.owner, partial(parse, raw, model))
        if body.language is None and (language := language_of(request.headers.get("accept-language", ""))):
            body = body.model_copy(update={"language": language})
            submission.prefers_language = True
        del raw
        if submission.image is None:
            release_body(request)
        try:
            result = await self.result(request, submission, body)
        except CowError as error:
            error.headers |= submission.headers
            raise
        if result is None:
            return await self.accepted(submission)
        if not submission.prefer.minimal:
            return json_response(result, headers=submission.headers)
        shorter = await to_thread.run_sync(minimize, result)
        return json_response(shorter, headers=MINIMAL_APPLIED | submission.headers)

    async def look(self, request: Request) -> Look:
        """What the models of this process see. Raises as `Service.look`."""
        service, owner, raw = self.engine.service, owner_of(request), await receive(request)
        asked = await self.in_thread(owner, partial(parse, raw, LookRequest))
        image = raw.image
        if is_url(asked.image):
            image = await self.fetch(owner, lambda: (data := service.fetch(asked.image), len(data)))

        def see() -> Look:
            try:
                return service.look(asked, owner, image)
            except errors.ArtifactNotFound:
                if not isinstance(asked.image, ImageArtifact):
                    raise
                self.engine.may_read(asked.image.artifact, owner)  # of a job, perhaps
                return service.look(asked, owner, service.fetch(asked.image))

        return await unless_disconnected(request, self._looks.run(owner, see))

    def submission(self, request: Request, kind: JobKind) -> Submission:
        """What the request's headers say. Raises `QueueFull` and `ShuttingDown` if no job can be taken."""
        prefer, owner = preferences_of(request.headers), owner_of(request)
        if prefer.key is None:
            self.engine.check_capacity(owner)  # before the body is read: a refusal comes at once
        return Submission(kind, owner, prefer, new_job_id(owner, prefer.key))

    async def fetch(self, owner: str | None, work: Callable[[], tuple[Made, int]]) -> Made:
        """What work that fetches images returns. The owner is charged for its second result, the bytes fetched."""
        made, size = await self._fetches.run(owner, work)
        charge.get()("MB of bodies", size / 1e6)
        return made

    async def submit(self, submission: Submission, body: SimulateRequest) -> str | None:
        """Makes a job of a request; returns its creation time, or None for one that exists.

        An image that is given by a URL is fetched apart from all other work: a server that is slow to send it holds up
        nobody else.
        """
        if is_url(body.image):
            await self.in_thread(submission.owner, partial(self._precheck, submission, body))
            fetch = self.engine.service.fetch
            submission.image = await self.fetch(submission.owner, lambda: (data := fetch(body.image), len(data)))
        created_at = await self.in_thread(submission.owner, partial(self._submit, submission, body))
        submission.replayed = created_at is None
        return created_at

    async def result(self, request: Request, submission: Submission, body: SimulateRequest) -> str | None:
        """The result of the request, as JSON; None if the caller wants the job instead."""
        received = submission.image is not None
        with self.engine.active.waiting(submission.job_id) as waiter:
            created_at = await self.submit(submission, body)
            if received:
                release_body(request)
            if submission.prefer.respond_async and not submission.prefer.wait:
                return None
            outcome = self.outcome(submission, waiter, created_at, submission.prefer.wait)
            try:
                return await unless_disconnected(request, outcome, partial(self.leave, submission, created_at))
            except errors.StorageUnavailable as error:  # the job itself waits until it is over
                error.headers |= {"Location": f"/jobs/{submission.job_id}"} | RETRY_AFTER
                raise

    async def accepted(self, submission: Submission) -> Response:
        """The job, for a caller who does not wait for its end."""

        def durable() -> JobState:
            self.engine.database.flush()  # no job is acknowledged that a loss of power could take back
            return self.engine.find(submission.job_id, submission.owner)

        found = await to_thread.run_sync(durable)
        headers = {"Location": f"/jobs/{submission.job_id}", "Preference-Applied": submission.prefer.applied}
        return json_response(found.as_json(), HTTPStatus.ACCEPTED, headers | RETRY_AFTER | submission.headers)

    async def outcome(
        self,
        submission: Submission,
        waiter: Waiter,
        created_at: str | None,
        wait: float | None = None,
        *,
        may_have_ended: bool = False,
    ) -> str | None:
        """The result of the job, once it has ended; None after `wait` seconds. Raises what it fails with.

        `created_at` is that of a job that this request submitted: another of the same id is not taken for it.
        `may_have_ended`: the waiter was made after the job, and may have missed its end.
        """
        until = None if wait is None else time.monotonic() + wait
        look = may_have_ended or created_at is None
        while True:
            if look and (result := await to_thread.run_sync(self._result, submission, created_at)) is not None:
                return result
            if waiter.refusal is not None:
                raise waiter.refusal
            rest = POLL_SECONDS if until is None else min(POLL_SECONDS, until - time.monotonic())
            if rest <= 0:
                return None
            with suppress(TimeoutError):
                await asyncio.wait_for(waiter.ended.wait(), rest)
            waiter.ended.clear()
            look = True

    async def leave(self, submission: Submission, created_at: str | None) -> None:
        """The caller has disconnected: cancels a new job, unless a header says that they may ask for it later."""
        if created_at is not None and replace(submission.prefer, fresh=False, minimal=False) == Preferences():
            await to_thread.run_sync(self.engine.cancel, submission.job_id, submission.owner)

    def _precheck(self, submission: Submission, body: SimulateRequest) -> tuple[str, str]:
        """Checks a request, except its image; raises what is wrong, and returns its reader and generator."""
        for picture in body.attached if submission.image is not None else (body.image, *body.attached):
            if isinstance(picture, ImageArtifact):
                self.engine.may_read(picture.artifact, submission.owner)
        backends = self.engine.service.precheck(body)
        if body.webhook is not None:
            self.engine.webhooks.check(body.webhook)
        return backends

    def _submit(self, submission: Submission, body: SimulateRequest) -> str | None:
        service = self.engine.service
        reader, generator = self._precheck(submission, body)
        if isinstance(body.image, ImageArtifact) and submission.image is None:
            service.check_image(service.fetch(body.image))
        asks, files = service.digested(body, submission.image)
        submission.image = None
        asks = asks.model_copy(update={"webhook": None, "priority": "normal"})
        spec = JobSpec(
            kind=submission.kind,
            request=asks.model_dump(mode="json", exclude_defaults=True),
            reader=reader,
            generator=generator,
            created_at=now(),
            fresh=submission.prefer.fresh,
            webhook=body.webhook,
            priority=body.priority,
            until=submission.until,
            prefers_language=submission.prefers_language,
            request_id=context.request_id.get(),
            traceparent=context.traceparent(),
        )
        keep = partial(service.keep, files)
        is_new = self.engine.submit(submission.job_id, spec, submission.owner, submission.prefer.key, keep)
        return spec.created_at if is_new else None

    def _result(self, submission: Submission, created_at: str | None) -> str | None:
        """The result of the job from the database; None if it has not ended. Raises what it failed with."""
        try:
            found = self.engine.find(submission.job_id, submission.owner)
        except errors.JobNotFound:
            found = None
        if found is None or created_at not in (None, found.job.created_at):
            raise errors.Canceled("The job was deleted before it was finished.")
        if found.job.status not in TERMINAL:
            self.engine.storage.check()
            return None
        if found.error is not None:
            raise found.error
        if found.result is None:
            raise errors.Canceled("The job was canceled before it was finished.")
        return found.result


JobSubmitter = Annotated[Submitter, from_app("submitter")]


def json_response(body: str, status: int = HTTPStatus.OK, headers: dict[str, str] | None = None) -> Response:
    """A record that is JSON already: the framework would validate its thousands of numbers once more."""
    return Response(body, status, headers, media_type="application/json")


async def do_nothing() -> None:
    """Does nothing."""


async def unless_disconnected(
    request: Request, work: Awaitable[Made], leave: Callable[[], Awaitable[None]] = do_nothing
) -> Made:
    """The result of the work. Where the caller goes away before, `leave` is called, the work is canceled, and
    `Canceled` is raised."""

    async def watch() -> None:
        while (await request.receive())["type"] != "http.disconnect":
            pass  # an empty rest of the body

    task, gone = asyncio.ensure_future(work), asyncio.ensure_future(watch())
    try:
        await asyncio.wait({task, gone}, return_when=asyncio.FIRST_COMPLETED)
        if task.done():
            return task.result()
        await leave()
        raise errors.Canceled("The caller disconnected before the work was finished.")
    finally:
        for each in (task, gone):
            each.cancel()
        await asyncio.gather(task, gone, return_exceptions=True)


MAX_WAIT_SECONDS = 600
_KEY = re.compile(r"[\x21-\x7e]{1,255}")
MINIMAL_APPLIED = {"Preference-Applied": "return=minimal"}


def preferences_of(headers: Headers) -> Preferences:
    """The preferences that a request's headers state; unknown ones are ignored, as RFC 7240 says.

    Raises `InvalidRequest` for an idempotency key that is none.
    """
    key = headers.get("idempotency-key")
    if key is not None and not _KEY.fullmatch(key):
        detail = "1 to 255 printable ASCII characters without spaces"
        raise InvalidRequest(f"The header `Idempotency-Key` takes {detail}.", errors=(FieldError("", detail),))
    stated: dict[str, str] = {}
    for item in ",".join(headers.getlist("prefer")).split(","):
        name, _, value = item.partition(";")[0].partition("=")
        stated.setdefault(name.strip().lower(), value.strip().strip('"'))  # the first of the same name counts
    wait = stated.get("wait", "")
    cached = {item.strip().lower() for item in headers.get("cache-control", "").split(",")}
    return Preferences(
        respond_async="respond-async" in stated,
        wait=min(int(wait), MAX_WAIT_SECONDS) if wait.isascii() and wait.isdigit() else None,
        key=key,
        fresh=bool(cached & {"no-cache", "no-store"}),
        minimal=stated.get("return", "").lower() == "minimal",
    )


# Of `Path`, all per frame.
LEFT_OUT = ("states", "scale", "rotation", "turns", "band", "futures", "tracks", "tracks_visible")


def minimize(text: str) -> str:
    """A `Job`, a `Simulation` or an `Answer`, as JSON, without the lists. CPU work: not for the event loop."""
    read: dict[str, Any] = json.loads(text)
    result = read.get("result", read) or {}
    simulation = result.get("simulation", result) or {}  # that of an answer, which may be null
    trajectory = simulation.get("trajectory")
    while trajectory is not None:
        trajectory.pop("still_tracks", None)
        for path in trajectory["paths"]:
            for name in LEFT_OUT:
                path.pop(name, None)
        trajectory = trajectory.get("factual")
    return json.dumps(read, separators=(",", ":"), ensure_ascii=False)
