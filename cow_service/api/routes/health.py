"""`GET /livez`, `GET /readyz`, `GET /models`, `GET /workers` and `GET /metrics`."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from hashlib import sha256
from importlib.resources import files
from typing import Literal

from fastapi import APIRouter
from fastapi.responses import PlainTextResponse, Response
from pydantic import BaseModel
from starlette.requests import Request

from cow_service import errors
from cow_service.api.problems import documented
from cow_service.errors import NotFound
from cow_service.jobs.engine import JobEngine
from cow_service.jobs.readiness import Readiness
from cow_service.observability.metrics import MEDIA_TYPE
from cow_service.records import Models, Workers


class Health(BaseModel):
    """A probe's answer."""

    status: Literal["ok"] = "ok"


def health_routes(engine: JobEngine, readiness: Readiness) -> APIRouter:
    """Probes, backends and metrics, bound to an engine and what it needs."""
    router = APIRouter()

    @router.get("/livez", operation_id="livez", tags=["health"], summary="The process answers")
    async def livez() -> Health:
        """For restarts: says nothing about whether work can be done."""
        return Health()

    @router.get(
        "/readyz",
        operation_id="readyz",
        tags=["health"],
        summary="The default request can be served",
        responses=documented(
            errors.NotReady,
            errors.ShuttingDown,
            errors.StorageUnavailable,
            errors.ReaderUnavailable,
            errors.GeneratorUnavailable,
        ),
    )
    def readyz() -> Health:
        """Checks that the database answers, that the data folder can be written and has room, that the default
        reader and generator are loaded, by a worker where the server computes nothing, and that no job waits for a
        workflow version that no process has.
        """
        readiness.check()
        engine.check()
        return Health()

    @router.get("/models", operation_id="models", tags=["models"], summary="Readers and generators")
    def models() -> Models:
        """What each is, what it needs, and whether it is ready."""
        return engine.service.models()

    @router.get(
        "/workers",
        operation_id="workers",
        tags=["health"],
        summary="Processes, their workers, and the queues",
        responses=documented(errors.StorageUnavailable),
    )
    def workers() -> Workers:
        """Every process on the job database, what its workers compute, how full the queues are, and jobs that no
        process takes. A second old at most; processes tell of themselves every two seconds.
        """
        return engine.processes.overview.workers()

    @router.get(
        "/metrics",
        operation_id="metrics",
        tags=["health"],
        summary="Counters for Prometheus",
        response_class=PlainTextResponse,
    )
    def metrics() -> Response:
        """Requests, stages, jobs, queues, workers, memory of the process and of GPUs, in Prometheus' text format."""
        return Response(engine.service.metrics.exposition(), headers={"Content-Type": MEDIA_TYPE})

    return router


# Swagger UI draws its signs as `data:` pictures, and shows a picture that it got as `blob:`. It sets styles by script,
# which needs no `unsafe-inline`.
CONTENT_SECURITY_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:; connect-src 'self'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
HEADERS = {
    "Content-Security-Policy": CONTENT_SECURITY_POLICY,
    "Cache-Control": "no-cache",  # asked for again, and answered 304: another version of the server has other files
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}
PAGE = "index.html"
OWN = (("cow_service", "web/docs"), {PAGE: "text/html", "start.js": "text/javascript", "docs.css": "text/css"})
SWAGGER_UI = (("fastapi_offline", "static"), {"swagger-ui-bundle.js": "text/javascript", "swagger-ui.css": "text/css"})


@dataclass(frozen=True)
class PageFile:
    """A file as it is sent."""

    body: bytes
    media_type: str
    etag: str


@cache
def page_files() -> dict[str, PageFile]:
    """The page and what it loads, 1.7 MB, by name; read when first asked for."""
    found: dict[str, PageFile] = {}
    for (package, folder), media_types in (OWN, SWAGGER_UI):
        for name, media_type in media_types.items():
            body = files(package).joinpath(folder, name).read_bytes()
            found[name] = PageFile(body, media_type, f'"{sha256(body).hexdigest()}"')
    return found


def docs_routes() -> APIRouter:
    """The page and its files. They are no part of the contract."""
    router = APIRouter(include_in_schema=False)

    @router.api_route("/docs", methods=["GET", "HEAD"])
    def docs(request: Request) -> Response:
        return _sent(page_files()[PAGE], request)

    @router.api_route("/docs/{name}", methods=["GET", "HEAD"])
    def file(name: str, request: Request) -> Response:
        # Not the page: its addresses are relative to /docs.
        if name == PAGE or name not in page_files():
            raise NotFound("There is no such file here. The page is at /docs.")
        return _sent(page_files()[name], request)

    return router


def _sent(file: PageFile, request: Request) -> Response:
    headers = HEADERS | {"ETag": file.etag}
    known = [tag.strip().removeprefix("W/") for tag in request.headers.get("if-none-match", "").split(",")]
    if file.etag in known or "*" in known:
        return Response(status_code=304, headers=headers)
    return Response(file.body, media_type=file.media_type, headers=headers)
