"""`GET /artifacts/{sha256}`."""

from __future__ import annotations

import json
import shutil
import zipfile
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from datetime import datetime
from functools import partial
from pathlib import Path as FilePath
from typing import Annotated, Any, Literal

from anyio import CapacityLimiter, to_thread
from fastapi import APIRouter, Path, Query
from fastapi.responses import FileResponse, RedirectResponse, Response
from starlette import responses as starlette
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.types import Receive, Scope, Send

from cow_service import errors
from cow_service.api.problems import documented
from cow_service.api.routes.jobs import GONE, JobId
from cow_service.api.submission import owner_of
from cow_service.errors import DownloadUnavailable, StorageUnavailable
from cow_service.jobs.engine import JobEngine
from cow_service.media.animations import animation
from cow_service.media.artifacts import ArtifactStore, extension_of
from cow_service.records import Answer, Job, Sha256, Simulation, artifacts_of, documents_of

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
        """Sends the file and releases it, also where the caller leaves."""
        try:
            await super().__call__(scope, receive, send)
        finally:
            await run_in_threadpool(self._release)

    @classmethod
    def check_range(cls, request: Request, size: int) -> None:
        """Raises `RangeNotSatisfiable` where another server is to answer, which would say it in its own words."""
        if wanted := request.headers.get("range"):
            cls._parse_range_header(wanted, size)

    @classmethod
    def _parse_range_header(cls, http_range: str, file_size: int) -> list[tuple[int, int]]:
        """Starlette answers both errors in plain text; the RFC has a malformed header ignored."""
        try:
            return super()._parse_range_header(http_range, file_size)
        except starlette.MalformedRangeHeader:
            return []
        except starlette.RangeNotSatisfiable as error:
            raise errors.RangeNotSatisfiable(
                f"The artifact has {file_size} bytes; '{http_range[:80]}' lies outside.",
                headers={"Content-Range": f"bytes */{file_size}"},
            ) from error


def artifact_routes(engine: JobEngine) -> APIRouter:
    """The operation, bound to an engine, which knows the owners of artifacts."""
    router = APIRouter()

    @router.head("/artifacts/{sha256}", include_in_schema=False)
    @router.get(
        "/artifacts/{sha256}",
        operation_id="artifact",
        tags=["artifacts"],
        summary="Bytes by their SHA-256",
        response_class=Response,
        responses={
            200: {"description": "The bytes.", "content": {"*/*": {"schema": {"type": "string", "format": "binary"}}}},
            206: {
                "description": "The ranges asked for.",
                "content": {"*/*": {"schema": {"type": "string", "format": "binary"}}},
            },
            304: {"description": "The caller has them."},
            307: {
                "description": "Where the bytes are: a signed URL of an object store (`COW_ARTIFACTS`), which works "
                "for 15 minutes, needs no key and answers `Range` itself."
            },
            **documented(errors.ArtifactNotFound, errors.RangeNotSatisfiable, errors.StorageUnavailable),
        },
    )
    def artifact(
        sha256: Annotated[str, Path(description="64 lower-case hexadecimal digits.")], request: Request
    ) -> Response:
        """Images, frames and videos that the service keeps. The ETag is the digest."""
        owner = owner_of(request)
        engine.may_read(sha256, owner)
        store, redirects = engine.service.artifacts, engine.service.settings.artifacts_redirect
        stored = store.get(sha256)
        etag = f'"{sha256}"'
        headers = {
            "ETag": etag,
            "Cache-Control": f"{'public' if owner is None else 'private'}, {CACHE_CONTROL}",
            "X-Content-Type-Options": "nosniff",
        }
        known = [tag.strip().removeprefix("W/") for tag in request.headers.get("if-none-match", "").split(",")]
        if etag in known or "*" in known:
            return Response(status_code=304, headers=headers)
        if redirects and (url := store.signed_url(sha256, SIGNED_SECONDS)) is not None:
            if request.method == "HEAD":  # the URL is signed for GET alone
                sizes = {"Content-Length": str(stored.size), "Accept-Ranges": "bytes"}
                return Response(media_type=stored.media_type, headers=headers | sizes)
            ArtifactResponse.check_range(request, stored.size)
            return RedirectResponse(url, headers={"Cache-Control": f"private, max-age={REDIRECT_SECONDS}"})
        with ExitStack() as stack:
            path = stack.enter_context(store.local_file(sha256))
            release = stack.pop_all().close
        return ArtifactResponse(path, release, media_type=stored.media_type, headers=headers)

    return router


@dataclass(frozen=True)
class Succeeded:
    """A job that has succeeded, and its result."""

    job: Job
    result: Simulation | Answer


class Downloads:
    """Makes files of jobs. Its methods block: not for an event loop."""

    def __init__(self, engine: JobEngine) -> None:
        self._engine = engine

    def zip(self, job_id: str, owner: str | None) -> tuple[FilePath, Callable[[], None]]:
        """A temporary file with all of a job, and what removes it.

        Raises `JobNotFound`, `DownloadUnavailable`, `ArtifactNotFound`, `StorageUnavailable`.
        """
        found, store = self._succeeded(job_id, owner), self._engine.service.artifacts
        request = self._engine.request_of(job_id, owner).request
        texts = documents_of(found.result) | {"request.json": json.dumps(request, indent=2, ensure_ascii=False) + "\n"}
        image = found.result.image.sha256
        image_file = f"image.{extension_of(store.get(image).media_type)}"
        with ExitStack() as stack:
            path = stack.enter_context(store.scratch())
            at = datetime.fromisoformat(found.job.created_at)
            _write_zip(path, texts, {image_file: image} | artifacts_of(found.result), store, at)
            return path, stack.pop_all().close

    def animation(self, job_id: str, owner: str | None, wanted: str) -> bytes:
        """The video of a job in a format of `animations.FORMATS`. Raises as `zip` does."""
        video = self._engine.service.artifacts.read(_video_of(self._succeeded(job_id, owner)))
        with self._engine.service.cpu.held():
            return animation(video, wanted)

    def _succeeded(self, job_id: str, owner: str | None) -> Succeeded:
        """The job with its result. Raises `JobNotFound`, and `DownloadUnavailable` where it has none."""
        found = self._engine.find(job_id, owner)
        if found.result is not None:
            model = Answer if found.job.kind == "answer" else Simulation
            return Succeeded(found.job, model.model_validate_json(found.result))
        if found.job.status in ("queued", "running"):
            detail = f"is {found.job.status}: ask again when it has succeeded; GET /jobs/{job_id}/events tells"
        else:
            why = "" if found.error is None else f" ({found.error.code})"
            detail = f"{_ENDS[found.job.status]}{why}: GET /jobs/{job_id}/request is what to send again"
        raise DownloadUnavailable(f"The job {job_id} {detail}.")


_ENDS = {"failed": "failed", "canceled": "was canceled"}


def _video_of(found: Succeeded) -> Sha256:
    """The digest of the video. Raises `DownloadUnavailable` where there is none."""
    result, again = found.result, f"Change GET /jobs/{found.job.id}/request and send it again"
    simulation = result.simulation if isinstance(result, Answer) else result
    if simulation is None:
        raise DownloadUnavailable(
            f"Nothing was imagined for the answer {found.job.id}, so nothing moves: its zip has all there is. {again}, "
            "with `imagine: always`, or with what `simulation_problem` says is missing."
        )
    if simulation.video is None:
        raise DownloadUnavailable(f"The job {found.job.id} has no video. {again}, with `video: true`.")
    return simulation.video.sha256


def _write_zip(
    path: FilePath, texts: Mapping[str, str], artifacts: Mapping[str, Sha256], store: ArtifactStore, at: datetime
) -> None:
    """Writes texts and artifacts as they are: pictures and videos do not compress."""
    try:
        with zipfile.ZipFile(path, "w", zipfile.ZIP_STORED) as archive:
            for name, text in texts.items():
                archive.writestr(_entry(name, at), text)
            for name, sha256 in artifacts.items():
                with (
                    store.local_file(sha256) as file,
                    file.open("rb") as source,
                    archive.open(_entry(name, at), "w") as target,
                ):
                    shutil.copyfileobj(source, target)
    except OSError as error:
        raise StorageUnavailable(f"The zip could not be written ({type(error).__name__}): is the disk full?") from error


def _entry(name: str, at: datetime) -> zipfile.ZipInfo:
    """By the time of the job, so that the same job is the same bytes whenever it is asked for."""
    return zipfile.ZipInfo(name, at.timetuple()[:6])


DownloadFormat = Literal["zip", "gif", "webp", "sheet"]
MAX_CONCURRENT_DOWNLOADS = 4  # made at the same time; pictures are encoded by `COW_CONCURRENCY` of them
# By format: what comes behind the job's id in the name of the file, and its media type.
FILES: dict[DownloadFormat, tuple[str, str]] = {
    "zip": (".zip", "application/zip"),
    "gif": (".gif", "image/gif"),
    "webp": (".webp", "image/webp"),
    "sheet": ("-sheet.png", "image/png"),
}
BINARY: dict[str, Any] = {"schema": {"type": "string", "format": "binary"}}


def download_routes(engine: JobEngine) -> APIRouter:
    """The operation, bound to an engine."""
    router = APIRouter(tags=["jobs"])
    downloads = Downloads(engine)
    limiter = CapacityLimiter(MAX_CONCURRENT_DOWNLOADS)  # else a few GIFs would take the threads of all operations

    @router.get(
        "/jobs/{id}/download",
        operation_id="download",
        summary="A job as a file",
        response_class=Response,
        responses={
            200: {
                "description": "The file, as an attachment.",
                "content": {kind: BINARY for _, kind in FILES.values()},
            },
            206: {"description": "The ranges of a zip that were asked for.", "content": {"*/*": BINARY}},
            **documented(*GONE, errors.DownloadUnavailable, errors.ArtifactNotFound, errors.RangeNotSatisfiable),
        },
    )
    async def download(
        request: Request,
        id: JobId,
        format: Annotated[
            DownloadFormat,
            Query(
                description="`zip`: result, request, image, frames, overlay and video; `gif`, `webp`: the video as an "
                "animated picture; `sheet`: twelve of its frames as a PNG."
            ),
        ] = "zip",
    ) -> Response:
        """All of a job that has succeeded, or its video in forms that go where no video does."""
        ending, media_type = FILES[format]
        headers = {
            "Content-Disposition": f'attachment; filename="cow-{id}{ending}"',
            "X-Content-Type-Options": "nosniff",
        }
        if format == "zip":
            path, release = await to_thread.run_sync(downloads.zip, id, owner_of(request), limiter=limiter)
            return ArtifactResponse(path, release, media_type=media_type, headers=headers)
        make = partial(downloads.animation, id, owner_of(request), format)
        return Response(await to_thread.run_sync(make, limiter=limiter), media_type=media_type, headers=headers)

    return router
