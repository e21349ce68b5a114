"""From a request to its job, and from the job to the response: at once, after a while, or when it has ended."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass
from http import HTTPStatus
from typing import TypeVar

from anyio import CapacityLimiter, to_thread
from fastapi import Request, Response

from cow_service.api.body import Body, check, receive
from cow_service.api.preferences import Preferences, preferences_of
from cow_service.errors import Canceled, CowError, JobNotFound
from cow_service.jobs.engine import Engine, new_job_id
from cow_service.jobs.live import Waiting
from cow_service.jobs.orders import Order
from cow_service.jobs.reports import Found
from cow_service.media.images import DecodedImage
from cow_service.observability import context
from cow_service.records import TERMINAL, JobKind
from cow_service.requests import ImageArtifact, SimulateRequest
from cow_service.stages.run import now

LOOK = 3.0  # seconds between looks at the database: another process may have run the job
AT_ONCE = 4  # bodies that are decoded at the same time
RETRY_AFTER = {"Retry-After": "1"}

Made = TypeVar("Made")


def owner_of(request: Request) -> str | None:
    """Whose key the request came with; None where the server has no keys."""
    owner: str | None = request.scope.get("state", {}).get("owner")
    return owner


Checked = tuple[SimulateRequest, DecodedImage | None]  # a request, and its image where that is kept and decoded


@dataclass(frozen=True)
class Asked:
    """Who asks for which job, and how they want to be answered."""

    kind: JobKind
    owner: str | None
    prefer: Preferences
    job_id: str

    @property
    def comes_back(self) -> bool:
        """Whether a header says that somebody may ask for the job."""
        return self.prefer != Preferences(fresh=self.prefer.fresh)


@dataclass
class Submitting:
    """Takes requests to the engine, and what they come to back. Bodies are decoded in threads."""

    engine: Engine

    def __post_init__(self) -> None:
        self._limiter = CapacityLimiter(AT_ONCE)

    async def run(self, request: Request, kind: JobKind, model: type[Body]) -> Response:
        """The job's result, or the job itself where the caller does not want to wait so long.

        Raises what is wrong with the request, and what the job fails with.
        """
        asked = self.asked(request, kind)
        posted = await receive(request)
        result = await self.result(request, asked, lambda: check(posted, model, self.engine.service))
        return await self.accepted(asked) if result is None else json_response(result)

    def asked(self, request: Request, kind: JobKind) -> Asked:
        """What the request's headers say. Raises `QueueFull` and `ShuttingDown` where no job can be taken."""
        prefer, owner = preferences_of(request.headers), owner_of(request)
        if prefer.key is None:
            self.engine.check_room()  # before the body: whoever is refused is told at once
        return Asked(kind, owner, prefer, new_job_id(owner, prefer.key))

    async def apart(self, work: Callable[[], Made]) -> Made:
        """Does work on a body in a thread, a few at the same time."""
        return await to_thread.run_sync(work, limiter=self._limiter)

    async def take(self, asked: Asked, read: Callable[[], Checked]) -> bool:
        """Makes a job of the request that `read` gives, in a thread; says whether the job is new."""
        return await self.apart(lambda: self._submit(asked, *read()))

    async def result(self, request: Request, asked: Asked, read: Callable[[], Checked]) -> str | None:
        """What the request comes to, as JSON; None where the caller wants the job instead."""
        with self.engine.live.waiting(asked.job_id) as waiting:
            is_new = await self.take(asked, read)
            if asked.prefer.respond_async and not asked.prefer.wait:
                return None
            async with _left(request) as left:
                return await self.outcome(asked, waiting, is_new, left, asked.prefer.wait)

    async def accepted(self, asked: Asked) -> Response:
        """The job, for a caller who does not wait for its end."""

        def settled() -> Found:
            self.engine.database.settle()  # nobody is told of a job that a loss of power could take back
            return self.engine.find(asked.job_id, asked.owner)

        found = await to_thread.run_sync(settled)
        headers = {"Location": f"/jobs/{asked.job_id}", "Preference-Applied": asked.prefer.applied, **RETRY_AFTER}
        return json_response(found.as_json(), HTTPStatus.ACCEPTED, headers)

    async def outcome(
        self, asked: Asked, waiting: Waiting, is_new: bool, left: asyncio.Event, wait: float | None = None
    ) -> str | None:
        """What the job comes to once it has ended; None once `wait` seconds are over. Raises what it fails with.

        A job that is not new, or was not waited for from its beginning, may have ended: then `is_new` is false.
        """
        loop = asyncio.get_running_loop()
        until = None if wait is None else loop.time() + wait
        gone = asyncio.ensure_future(left.wait())
        look = not is_new
        try:
            while not waiting.settled.done():
                if look:
                    found = await to_thread.run_sync(self.engine.find, asked.job_id, asked.owner)
                    if found.job.status in TERMINAL:
                        break
                look = True
                rest = LOOK if until is None else min(LOOK, until - loop.time())
                if rest <= 0:
                    return None
                await asyncio.wait({waiting.settled, gone}, timeout=rest, return_when=asyncio.FIRST_COMPLETED)
                if gone.done() and not waiting.settled.done():
                    await self.leave(asked, is_new)
                    raise Canceled("The caller went away before the work was done.")
        finally:
            gone.cancel()
        if waiting.settled.done():
            outcome = waiting.settled.result()
            if isinstance(outcome, CowError):
                raise outcome
            if outcome is not None:
                return outcome
        return await to_thread.run_sync(self._ended, asked)

    async def leave(self, asked: Asked, is_new: bool) -> None:
        """The caller has gone: ends a job that nobody else can know of."""
        if is_new and not asked.comes_back:
            await to_thread.run_sync(self.engine.cancel, asked.job_id, asked.owner)

    def _submit(self, asked: Asked, body: SimulateRequest, image: DecodedImage | None) -> bool:
        service = self.engine.service
        if isinstance(body.image, ImageArtifact):
            self.engine.may_read(body.image.artifact, asked.owner if image is None else None)
        reader, generator = service.precheck(body)
        if body.webhook is not None:
            self.engine.webhooks.check(body.webhook)
        sha256 = None
        if image is None:
            sha256, image = service.image_of(body.image)
        kept = ImageArtifact(artifact=sha256 or image.info.sha256)
        asks = body.model_copy(update={"image": kept, "webhook": None})
        trace = context.trace.get()
        order = Order(
            kind=asked.kind,
            request=asks.model_dump(mode="json", exclude_defaults=True),
            reader=reader,
            generator=generator,
            created_at=now(),
            fresh=asked.prefer.fresh,
            webhook=body.webhook,
            request_id=context.request_id.get(),
            traceparent=None if trace is None else trace.traceparent,
        )
        return self.engine.submit(order, generator, asked.owner, asked.prefer.key, image, asked.job_id)

    def _ended(self, asked: Asked) -> str:
        """The result of a job whose end only the database tells."""
        try:
            found = self.engine.find(asked.job_id, asked.owner)
        except JobNotFound as error:
            raise Canceled("The job was deleted before it was done.") from error
        if found.error is not None:
            raise found.error
        if found.result is None:
            raise Canceled("The job was canceled before it was done.")
        return found.result


def json_response(body: str, status: int = HTTPStatus.OK, headers: dict[str, str] | None = None) -> Response:
    """A record as it is kept: the framework would check its thousands of numbers once more."""
    return Response(body, status, headers, media_type="application/json")


@asynccontextmanager
async def _left(request: Request) -> AsyncGenerator[asyncio.Event]:
    """Tells when the caller has closed the connection."""
    left = asyncio.Event()

    async def watch() -> None:
        while (await request.receive())["type"] != "http.disconnect":
            pass  # an empty rest of the body
        left.set()

    task = asyncio.create_task(watch())
    try:
        yield left
    finally:
        task.cancel()
