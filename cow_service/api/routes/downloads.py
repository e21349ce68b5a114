"""`GET /jobs/{id}/download`."""

from __future__ import annotations

from functools import partial
from typing import Annotated, Any, Literal

from anyio import CapacityLimiter, to_thread
from fastapi import APIRouter, Query, Request, Response

from cow_service import errors
from cow_service.api.downloads import Downloads
from cow_service.api.problems import documented
from cow_service.api.routes.artifacts import ArtifactResponse
from cow_service.api.routes.jobs import GONE, JobId
from cow_service.api.submission import owner_of
from cow_service.jobs.engine import JobEngine

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
