"""The HTTP application: routes, middleware and the OpenAPI document around one service."""

import logging
from collections.abc import AsyncGenerator, Callable
from contextlib import asynccontextmanager
from typing import Any

from anyio import CapacityLimiter, to_thread
from fastapi import FastAPI
from fastapi.openapi.utils import get_openapi
from starlette.middleware.cors import CORSMiddleware
from starlette.types import ASGIApp, Scope

from cow_service import __version__
from cow_service.api.middleware.access import PROBES, Callers, Guard, Origins, is_loopback, is_open
from cow_service.api.middleware.access_log import AccessLog
from cow_service.api.middleware.body_limit import BodyLimit
from cow_service.api.openai import routes as chats
from cow_service.api.openai.completer import Completer
from cow_service.api.problems import documented, install_problem_handlers
from cow_service.api.routes import artifacts, health, jobs, page, simulate
from cow_service.api.routes.artifacts import MAX_CONCURRENT_DOWNLOADS
from cow_service.api.submission import Submitter
from cow_service.errors import CowError, OriginNotAllowed, RateLimited, Unauthorized
from cow_service.jobs.engine import JobEngine
from cow_service.jobs.readiness import Readiness
from cow_service.observability import tracing
from cow_service.observability.metrics import Metrics
from cow_service.records import Problem
from cow_service.requests import AnswerRequest, LookRequest, SimulateRequest
from cow_service.settings import Settings

SUMMARY = "Lets a multimodal LLM look before it answers: send an image and a what-if question, get imagined frames."
FRAMEWORK_SCHEMAS = ("HTTPValidationError", "ValidationError")  # of errors that no operation returns
# What web pages of COW_CORS_ORIGINS may send and read.
CORS_METHODS = ("GET", "HEAD", "POST", "DELETE")
REQUEST_HEADERS = (
    "Authorization",
    "Content-Type",
    "Idempotency-Key",
    "Prefer",
    "Cache-Control",
    "Last-Event-ID",
    "X-Request-Id",
    "traceparent",
)
RESPONSE_HEADERS = ("X-Request-Id", "Location", "Retry-After", "traceparent")

log = logging.getLogger("cow_service")


def create_app(
    engine: JobEngine, readiness: Readiness | None = None, *, starting: bool = True, closing: bool = True
) -> FastAPI:
    """The application of an engine, which it starts if it is not running yet.

    Without `starting` others start it, and until then all requests but those of probes and pages are refused. When the
    app ends, it closes engine and service, unless `closing` is false because others use them.
    """
    service = engine.service
    submitter = Submitter(engine)
    completer = Completer(submitter)

    @asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncGenerator[None]:
        if starting and not engine.is_running:
            await to_thread.run_sync(engine.start)
        yield
        await completer.close()
        if closing:
            if engine.is_running:
                await to_thread.run_sync(engine.close)
            await to_thread.run_sync(service.close)
            await to_thread.run_sync(tracing.stop)

    app = LayeredApp(
        title="COW",
        version=__version__,
        summary=SUMMARY,
        docs_url=None,  # the framework's page loads its script from elsewhere; ours is in `routes/page.py`
        redoc_url=None,
        redirect_slashes=False,
        generate_unique_id_function=lambda route: route.name,  # the ids of operations
        lifespan=lifespan,
    )
    app.state.engine, app.state.readiness = engine, readiness or Readiness(service)
    app.state.submitter, app.state.completer = submitter, completer
    # Else a few GIFs would take the threads of all operations.
    app.state.downloads = CapacityLimiter(MAX_CONCURRENT_DOWNLOADS)
    install_problem_handlers(app)

    def refuse_until_started(scope: Scope) -> CowError | None:
        return None if engine.is_running or is_open(scope["path"]) else engine.not_started()

    if not starting:
        app.add_middleware(Guard, refuse=refuse_until_started)
    install_layers(app, service.settings, service.metrics)
    for module in (simulate, chats, jobs, artifacts, health, page):
        app.include_router(module.router)
    app.openapi = lambda: contract(app)
    return app


class LayeredApp(FastAPI):
    """FastAPI with outer layers, which also see the responses of its handler of unforeseen errors."""

    surround: Callable[[ASGIApp], ASGIApp]

    def build_middleware_stack(self) -> ASGIApp:
        """The framework's layers, and ours around them."""
        return self.surround(super().build_middleware_stack())


def install_layers(app: LayeredApp, settings: Settings, metrics: Metrics) -> None:
    """Puts the middleware around the routes of an app, the innermost first."""
    limits = {"megabytes": settings.max_body_mb, "seconds": settings.body_timeout}
    app.add_middleware(BodyLimit, **limits, megabytes_at_once=settings.max_bodies_mb)
    app.add_middleware(Guard, refuse=Callers(settings).refuse)

    def surround(stack: ASGIApp) -> ASGIApp:
        if settings.cors_origins:
            stack = CORSMiddleware(
                stack,
                allow_origins=settings.cors_origins,
                allow_methods=CORS_METHODS,
                allow_headers=REQUEST_HEADERS,
                expose_headers=RESPONSE_HEADERS,
            )
        origins = Origins(settings.cors_origins, only_local=not settings.api_keys and is_loopback(settings.host))
        stack = Guard(stack, origins.refuse)
        return AccessLog(stack, metrics, paths=lambda: app.openapi()["paths"])

    app.surround = surround


def warn_if_open(settings: Settings) -> None:
    """Logs a warning where anybody who reaches the server can use it."""
    if not settings.api_keys and not is_loopback(settings.host):
        log.warning("COW_API_KEYS is not set: anyone who can reach %s can use this server.", settings.host)


def contract(app: FastAPI) -> dict[str, Any]:
    """The OpenAPI document of an app, made once: with request bodies, problems and what the middleware answers."""
    if app.openapi_schema is None:
        document = get_openapi(title=app.title, version=app.version, summary=app.summary, routes=app.routes)
        schemas = document.setdefault("components", {}).setdefault("schemas", {})
        for model in (Problem, SimulateRequest, AnswerRequest, LookRequest):
            schema = model.model_json_schema(ref_template="#/components/schemas/{model}")
            schemas.update(schema.pop("$defs", {}))
            schemas[model.__name__] = schema
        scheme = {"type": "http", "scheme": "bearer", "description": "Required if the server has COW_API_KEYS."}
        document["components"]["securitySchemes"] = {"key": scheme}
        for path, operations in document["paths"].items():
            refusals = (OriginNotAllowed,) if path in PROBES else (Unauthorized, OriginNotAllowed, RateLimited)
            for operation in operations.values():
                responses = operation["responses"]
                if "application/json" in responses.get("422", {}).get("content", {}):
                    del responses["422"]  # the framework's own; ours are problems
                operation["security"] = [] if path in PROBES else [{"key": []}, {}]
                for status, response in documented(*refusals).items():
                    known = responses.setdefault(str(status), response)
                    if known is not response:
                        known["description"] += ", " + response["description"]
                operation["responses"] = dict(sorted(responses.items()))
        chats.document_chat(document)
        for name in FRAMEWORK_SCHEMAS:
            schemas.pop(name, None)
        document["components"]["schemas"] = dict(sorted(schemas.items()))
        app.openapi_schema = document
    return app.openapi_schema
