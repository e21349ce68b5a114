"""`GET /artifacts/{sha256}`."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Path
from fastapi.responses import FileResponse, Response
from starlette.requests import Request

from cow_service import errors
from cow_service.api.problems import documented
from cow_service.api.routes.ranges import is_honoured
from cow_service.api.submission import owner_of
from cow_service.jobs.engine import Engine

FOREVER = "public, max-age=31536000, immutable"


def artifact_routes(engine: Engine) -> APIRouter:
    """The operation, bound to an engine, which knows whose they are.

    Bytes never change under their digest, so caches may keep them.
    """
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
            "Cache-Control": FOREVER if owner is None else FOREVER.replace("public", "private"),
            "X-Content-Type-Options": "nosniff",
        }
        known = [tag.strip().removeprefix("W/") for tag in request.headers.get("if-none-match", "").split(",")]
        if etag in known or "*" in known:
            return Response(status_code=304, headers=headers)
        asked = request.headers.get("range")
        if asked is not None and not is_honoured(asked, stored.artifact.size):
            # The response reads the header itself: what is to be ignored must not reach it.
            request.scope["headers"] = [pair for pair in request.scope["headers"] if pair[0] != b"range"]
        return FileResponse(stored.path, media_type=stored.artifact.media_type, headers=headers)

    return router
