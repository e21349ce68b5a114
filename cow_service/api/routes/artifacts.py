"""`GET /artifacts/{sha256}`."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Path
from fastapi.responses import FileResponse, Response
from starlette import responses as starlette
from starlette.requests import Request

from cow_service import errors
from cow_service.api.problems import documented
from cow_service.api.submission import owner_of
from cow_service.jobs.engine import JobEngine

CACHE_CONTROL = "max-age=31536000, immutable"  # bytes never change under their digest


class ArtifactResponse(FileResponse):
    """A file or the ranges of it that a request asks for (RFC 9110, section 14)."""

    max_ranges = 8  # more in one request are no way to read a video: the whole file is sent instead

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
            **documented(errors.ArtifactNotFound, errors.RangeNotSatisfiable, errors.StorageUnavailable),
        },
    )
    def artifact(
        sha256: Annotated[str, Path(description="64 lower-case hexadecimal digits.")], request: Request
    ) -> Response:
        """Images, frames and videos that the service keeps. The ETag is the digest."""
        owner = owner_of(request)
        engine.may_read(sha256, owner)
        stored = engine.service.artifacts.get(sha256)
        etag = f'"{sha256}"'
        headers = {
            "ETag": etag,
            "Cache-Control": f"{'public' if owner is None else 'private'}, {CACHE_CONTROL}",
            "X-Content-Type-Options": "nosniff",
        }
        known = [tag.strip().removeprefix("W/") for tag in request.headers.get("if-none-match", "").split(",")]
        if etag in known or "*" in known:
            return Response(status_code=304, headers=headers)
        return ArtifactResponse(stored.path, media_type=stored.artifact.media_type, headers=headers)

    return router
