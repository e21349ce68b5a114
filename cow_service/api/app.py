"""The HTTP application: routes, problems and limits around one service."""

from __future__ import annotations

from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from typing import Any

from anyio import to_thread
from fastapi import FastAPI
from fastapi.openapi.utils import get_openapi

from cow_service import __version__
from cow_service.api.middleware.body_limit import BodyLimit
from cow_service.api.middleware.order import LayeredApp, document_layers, install_layers
from cow_service.api.openai.errors import ChatProblems
from cow_service.api.openai.routes import chat_routes, document_chat
from cow_service.api.problems import install_problem_handlers
from cow_service.api.routes.answer import answer_routes
from cow_service.api.routes.artifacts import artifact_routes
from cow_service.api.routes.events import event_routes
from cow_service.api.routes.health import health_routes
from cow_service.api.routes.jobs import job_routes
from cow_service.api.routes.metrics import metrics_routes
from cow_service.api.routes.simulate import simulate_routes
from cow_service.api.submission import Submitting
from cow_service.jobs.engine import Engine
from cow_service.jobs.readiness import Readiness
from cow_service.observability import tracing
from cow_service.records import Problem
from cow_service.requests import AnswerRequest, SimulateRequest

SUMMARY = "Lets a multimodal LLM look before it answers: one image and one what-if question in, imagined frames out."
DROPPED = ("HTTPValidationError", "ValidationError")  # the framework's error shapes, which no operation returns


def create_app(engine: Engine, readiness: Readiness | None = None, *, closing: bool = True) -> FastAPI:
    """The application for an engine that runs, or that the app starts when it begins. It holds no state of its own.

    When the app ends, so do engine and service; not with `closing` false, where others go on with them.
    """
    service = engine.service
    readiness = readiness or Readiness(service)

    @asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncGenerator[None]:
        if not engine.runs:
            await to_thread.run_sync(engine.start)
        yield
        if closing:
            await to_thread.run_sync(engine.close)
            await to_thread.run_sync(service.close)
            await to_thread.run_sync(tracing.stop)

    app = LayeredApp(
        title="COW",
        version=__version__,
        summary=SUMMARY,
        docs_url=None,
        redoc_url=None,
        redirect_slashes=False,
        lifespan=lifespan,
    )
    app.add_middleware(BodyLimit, megabytes=service.settings.max_body_mb, seconds=service.settings.body_timeout)
    install_problem_handlers(app)
    install_layers(app, service.settings, service.metrics)
    layers = app.surround
    # Around the layers, too: they refuse requests themselves.
    app.surround = lambda stack: ChatProblems(stack if layers is None else layers(stack))
    submitting = Submitting(engine)
    for router in (
        simulate_routes(submitting),
        answer_routes(submitting),
        chat_routes(submitting),
        job_routes(engine),
        event_routes(engine),
        artifact_routes(engine),
        health_routes(engine, readiness),
        metrics_routes(service.metrics),
    ):
        app.include_router(router)
    app.openapi = lambda: _openapi(app)
    return app


def _openapi(app: FastAPI) -> dict[str, Any]:
    """The contract: the framework's document, with the bodies and errors that are read and written by hand."""
    if app.openapi_schema is None:
        document = get_openapi(title=app.title, version=app.version, summary=app.summary, routes=app.routes)
        schemas = document.setdefault("components", {}).setdefault("schemas", {})
        for model in (Problem, SimulateRequest, AnswerRequest):
            schema = model.model_json_schema(ref_template="#/components/schemas/{model}")
            schemas.update(schema.pop("$defs", {}))
            schemas[model.__name__] = schema
        for operations in document["paths"].values():
            for operation in operations.values():
                if "HTTPValidationError" in str(operation["responses"].get("422")):
                    del operation["responses"]["422"]
        document_layers(document)
        document_chat(document)
        for name in DROPPED:
            schemas.pop(name, None)
        document["components"]["schemas"] = dict(sorted(schemas.items()))
        app.openapi_schema = document
    return app.openapi_schema
