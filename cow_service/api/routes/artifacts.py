"""`GET /artifacts/{sha256}`."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path as FilePath
from typing import Annotated, Any

from fastapi import APIRouter, Path
from fastapi.responses import FileResponse, RedirectResponse, Response
from starlette import responses as starlette
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.types import Receive, Scope, Send

from cow_service import errors
from cow_service.api.problems import documented
from cow_service.api.submission import owner_of
from cow_service.jobs.engine import JobEngine

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
