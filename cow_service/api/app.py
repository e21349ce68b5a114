"""The HTTP application: routes, problems and limits around one service."""

from __future__ import annotations

from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from typing import Any

from anyio import CapacityLimiter, to_thread
from fastapi import FastAPI
from fastapi.openapi.utils import get_openapi

from cow_service import __version__
from cow_service.api.answer import answer_routes
from cow_service.api.artifacts import artifact_routes
from cow_service.api.health import health_routes
from cow_service.api.limits import BodyLimit
from cow_service.api.problems import Problem, install_problem_handlers
from cow_service.api.simulate import simulate_routes
from cow_service.requests import AnswerRequest, SimulateRequest
from cow_service.service import Service

SUMMARY = "Lets a multimodal LLM look before it answers: one image and one what-if question in, imagined frames out."
DROPPED = ("HTTPValidationError", "ValidationError")  # the framework's error shapes, which no operation returns


def create_app(service: Service) -> FastAPI:
    """The application for a service. It holds no state of its own."""

    @asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncGenerator[None]:
        yield
        await to_thread.run_sync(service.close)

    app = FastAPI(
        title="COW",
        version=__version__,
        summary=SUMMARY,
        docs_url=None,
        redoc_url=None,
        redirect_slashes=False,
        lifespan=lifespan,
    )
    app.add_middleware(BodyLimit, megabytes=service.settings.max_body_mb)
    install_problem_handlers(app)
    # More threads than may compute: those that wait for a multimodal LLM only wait.
    limiter = CapacityLimiter(service.settings.concurrency + service.settings.mllm_concurrency)
    working = (simulate_routes(service, limiter), answer_routes(service, limiter))
    for router in (*working, artifact_routes(service), health_routes(service)):
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
        for name in DROPPED:
            schemas.pop(name, None)
        document["components"]["schemas"] = dict(sorted(schemas.items()))
        app.openapi_schema = document
    return app.openapi_schema
