"""`GET /artifacts/{sha256}` and `GET /jobs/{id}/download`: files."""

import json
import shutil
import zipfile
from collections.abc import Callable
from contextlib import ExitStack
from datetime import datetime
from http import HTTPStatus
from pathlib import Path as FilePath
from typing import Annotated, Any, Literal

from anyio import CapacityLimiter, to_thread
from fastapi import APIRouter, Path, Query
from fastapi.responses import FileResponse, RedirectResponse, Response
from starlette.concurrency import run_in_threadpool
from starlette.datastructures import Headers
from starlette.requests import Request
from starlette.responses import MalformedRangeHeader
from starlette.types import Message, Receive, Scope, Send

from cow_service import errors
from cow_service.api.problems import documented
from cow_service.api.routes.jobs import GONE, JobId
from cow_service.api.routes.page import is_known
from cow_service.api.submission import Engine, Owner
from cow_service.errors import DownloadUnavailable, StorageUnavailable
from cow_service.jobs.engine import JobEngine
from cow_service.media.artifacts import extension_of
from cow_service.media.share import WITH_WORDS, Told, make_apart, page
from cow_service.narration.words import direction_words
from cow_service.records import Answer, Job, Simulation, artifacts_of, documents_of

CACHE_CONTROL = "max-age=31536000, immutable"  # bytes never change under their digest
# A signed URL works for so long, and a caller may take it again for less: a video is read in pieces.
SIGNED_SECONDS, REDIRECT_SECONDS = 900, 600


class ArtifactResponse(FileResponse):
    """A file or the ranges of it that a request asks for (RFC 9110, section 14)."""

    max_ranges = 8  # more in one request are no way to read a video: the whole file is sent instead

    def __init__(self, path: FilePath, release: Callable[[], None], **options: Any) -> None:
        super().__init__(path, **options)
        self._release = release

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Sends the file and releases it, also where the caller leaves.

        Starlette answers a wrong `Range` in plain text. Here one that lies outside is a problem, and a malformed one is
        ignored, as the RFC has it.
        """

        async def checked(message: Message) -> None:
            status = message.get("status")
            if status == HTTPStatus.BAD_REQUEST:
                raise MalformedRangeHeader
            if status == HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE:
                size = self.headers["content-length"]
                detail = f"The file has {size} bytes; '{Headers(scope=scope)['range'][:80]}' lies outside."
                raise errors.RangeNotSatisfiable(detail, headers={"Content-Range": f"bytes */{size}"})
            await send(message)

        try:
            try:
                await super().__call__(scope, receive, checked)
            except MalformedRangeHeader:
                others = [(name, value) for name, value in scope["headers"] if name != b"range"]
                await super().__call__({**scope, "headers": others}, receive, send)
        finally:
            await run_in_threadpool(self._release)


BINARY: dict[str, Any] = {"schema": {"type": "string", "format": "binary"}}
router = APIRouter()


DownloadFormat = Literal["zip", "film", "card", "page", "gif", "webp", "sheet"]
# By format: what comes behind the job's id in the name of the file, and its media type.
FILES: dict[DownloadFormat, tuple[str, str]] = {
    "zip": (".zip", "application/zip"),
    "film": ("-film.mp4", "video/mp4"),
    "card": (".jpg", "image/jpeg"),
    "page": (".html", "text/html; charset=utf-8"),
    "gif": (".gif", "image/gif"),
    "webp": (".webp", "image/webp"),
    "sheet": ("-sheet.png", "image/png"),
}
FORMAT = Query(
    description="`zip`: result, request, image, frames, overlay and video; `film`: an mp4 of some 0.1 to 3 MB with the "
    "question, other futures and the verdict; `card`: one moment of it as a JPEG, 1200 x 630 px; `page`: HTML whose "
    "worlds are computed in the browser, without a network, where the request said `live: true`; `gif`, `webp`: the "
    "video as an animated picture; `sheet`: twelve of its frames as a PNG."
)
MAX_CONCURRENT_DOWNLOADS = 4  # made at the same time; pictures are encoded by `COW_CONCURRENCY` of them


@router.get(
    "/jobs/{id}/download",
    tags=["jobs"],
    summary="A job as a file",
    response_class=Response,
    responses={
        200: {"description": "The file, as an attachment.", "content": {kind: BINARY for _, kind in FILES.values()}},
        206: {"description": "The ranges of a zip that were asked for.", "content": {"*/*": BINARY}},
        **documented(*GONE, errors.DownloadUnavailable, errors.ArtifactNotFound, errors.RangeNotSatisfiable),
    },
)
async def download(
    request: Request, engine: Engine, owner: Owner, id: JobId, format: Annotated[DownloadFormat, FORMAT] = "zip"
) -> Response:
    """All of a job that has succeeded, or its video in forms that go where no video does."""
    ending, media_type = FILES[format]
    headers = {"Content-Disposition": f'attachment; filename="cow-{id}{ending}"', "X-Content-Type-Options": "nosniff"}
    limiter: CapacityLimiter = request.app.state.downloads
    if format == "zip":
        path, release = await to_thread.run_sync(make_zip, engine, id, owner, limiter=limiter)
        return ArtifactResponse(path, release, media_type=media_type, headers=headers)
    data = await to_thread.run_sync(make_file, engine, id, owner, format, limiter=limiter)
    return Response(data, media_type=media_type, headers=headers)


def make_zip(engine: JobEngine, job_id: str, owner: str | None) -> tuple[FilePath, Callable[[], None]]:
    """A temporary file with all of a job, and what removes it. Blocks: not for an event loop.

    Raises `JobNotFound`, `DownloadUnavailable`, `ArtifactNotFound`, `StorageUnavailable`.
    """
    job, result = _find_succeeded(engine, job_id, owner)
    store, request = engine.service.artifacts, engine.request_of(job_id, owner).request
    texts = documents_of(result) | {"request.json": json.dumps(request, indent=2, ensure_ascii=False) + "\n"}
    image = result.image.sha256
    artifacts = {f"image.{extension_of(store.get(image).media_type)}": image} | artifacts_of(result)
    # By the time of the job, so that the same job is the same bytes whenever it is asked for.
    at = datetime.fromisoformat(job.created_at).timetuple()[:6]
    with ExitStack() as stack:
        path = stack.enter_context(store.scratch())
        try:
            with zipfile.ZipFile(path, "w", zipfile.ZIP_STORED) as archive:  # pictures and videos do not compress
                for name, text in texts.items():
                    archive.writestr(zipfile.ZipInfo(name, at), text)
                for name, sha256 in artifacts.items():
                    with (
                        store.local_file(sha256) as file,
                        file.open("rb") as source,
                        archive.open(zipfile.ZipInfo(name, at), "w") as target,
                    ):
                        shutil.copyfileobj(source, target)
        except OSError as error:
            detail = f"The zip could not be written ({type(error).__name__}): is the disk full?"
            raise StorageUnavailable(detail) from error
        return path, stack.pop_all().close


def _told(result: Simulation | Answer, simulation: Simulation) -> Told:
    """The question to show with a result. If the request gave the motion, the question alone would mislead."""
    motion = simulation.motion
    given = direction_words(motion.direction, motion.depth) if motion.source == "request" else ""
    return Told.of(result, simulation, given)


def make_file(engine: JobEngine, job_id: str, owner: str | None, wanted: str) -> bytes:
    """What a format other than `zip` makes of a job. Blocks, and raises as `make_zip` does."""
    job, result = _find_succeeded(engine, job_id, owner)
    again = f"Take GET /jobs/{job.id}/request and send it again"
    simulation = result.simulation if isinstance(result, Answer) else result
    if simulation is None:
        raise DownloadUnavailable(
            f"The answer {job.id} has no simulation, so nothing moves: its zip has everything. {again}, "
            "with `imagine: always`, or fix what `simulation_problem` says."
        )
    if wanted == "page":
        return make_page(engine, result, simulation, again)
    if simulation.video is None:
        raise DownloadUnavailable(f"The job {job.id} has no video. {again}, with `video: true`.")
    video = engine.service.artifacts.read(simulation.video.sha256)
    with engine.service.cpu.held():
        return make_apart(wanted, video, _told(result, simulation) if wanted in WITH_WORDS else None)


def make_page(engine: JobEngine, result: Simulation | Answer, simulation: Simulation, again: str) -> bytes:
    """The page that runs a result's worlds. Raises `DownloadUnavailable` if it has none."""
    live, read = simulation.trajectory.live, engine.service.artifacts.read
    if live is None:
        raise DownloadUnavailable(
            f"The job has no live simulation. {again}, with `live: true`; objects that are put somewhere, or do not "
            "move along a direction, have none."
        )
    # The clip is without what was taken away.
    shown = (simulation.trajectory.factual and simulation.video) or simulation.image
    with engine.service.cpu.held():
        picture = make_apart("still", read(shown.sha256))
    return page(picture, read(live.sha256).decode(), simulation, _told(result, simulation))


def _find_succeeded(engine: JobEngine, job_id: str, owner: str | None) -> tuple[Job, Simulation | Answer]:
    """The job with its result. Raises `JobNotFound`, and `DownloadUnavailable` if it has none."""
    found = engine.find(job_id, owner)
    if found.result is not None:
        model = Answer if found.job.kind == "answer" else Simulation
        return found.job, model.model_validate_json(found.result)
    if found.job.status in ("queued", "running"):
        detail = f"is {found.job.status}: ask again when it has succeeded; GET /jobs/{job_id}/events reports that"
    else:
        end = "was canceled" if found.job.status == "canceled" else "failed"
        why = "" if found.error is None else f" ({found.error.code})"
        detail = f"{end}{why}: GET /jobs/{job_id}/request is what to send again"
    raise DownloadUnavailable(f"The job {job_id} {detail}.")


@router.head("/artifacts/{sha256}", include_in_schema=False)
@router.get(
    "/artifacts/{sha256}",
    tags=["artifacts"],
    summary="Bytes by their SHA-256",
    response_class=Response,
    responses={
        200: {"description": "The bytes.", "content": {"*/*": BINARY}},
        206: {"description": "The ranges asked for.", "content": {"*/*": BINARY}},
        304: {"description": "The caller already has them."},
        307: {
            "description": "Where the bytes are: a signed URL of an object store (`COW_ARTIFACTS`), which works "
            "for 15 minutes, needs no key and answers `Range` itself."
        },
        **documented(errors.ArtifactNotFound, errors.RangeNotSatisfiable, errors.StorageUnavailable),
    },
)
def artifact(
    sha256: Annotated[str, Path(description="64 lower-case hexadecimal digits.")],
    request: Request,
    engine: Engine,
    owner: Owner,
) -> Response:
    """Images, frames and videos that the service keeps. The ETag is the digest."""
    engine.may_read(sha256, owner)
    store = engine.service.artifacts
    stored = store.get(sha256)
    headers = {
        "ETag": f'"{sha256}"',
        "Cache-Control": f"{'public' if owner is None else 'private'}, {CACHE_CONTROL}",
        "X-Content-Type-Options": "nosniff",
    }
    if is_known(request, headers["ETag"]):
        return Response(status_code=304, headers=headers)
    redirects = engine.service.settings.artifacts_redirect
    if redirects and (url := store.signed_url(sha256, SIGNED_SECONDS)) is not None:
        if request.method == "HEAD":  # the URL is signed for GET alone
            sizes = {"Content-Length": str(stored.size), "Accept-Ranges": "bytes"}
            return Response(media_type=stored.media_type, headers=headers | sizes)
        return RedirectResponse(url, headers={"Cache-Control": f"private, max-age={REDIRECT_SECONDS}"})
    with ExitStack() as stack:
        path = stack.enter_context(store.local_file(sha256))
        release = stack.pop_all().close
    return ArtifactResponse(path, release, media_type=stored.media_type, headers=headers)
