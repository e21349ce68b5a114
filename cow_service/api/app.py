"""The HTTP application: routes, problems and limits around one service."""

from __future__ import annotations

from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager

from anyio import to_thread
from fastapi import FastAPI

from cow_service import __version__
from cow_service.api.middleware.body_limit import BodyLimit
from cow_service.api.middleware.order import LayeredApp, install_layers
from cow_service.api.openai.completing import Completer
from cow_service.api.openai.errors import ChatProblems
from cow_service.api.openai.routes import chat_routes
from cow_service.api.openapi import contract
from cow_service.api.page import page_routes
from cow_service.api.problems import install_problem_handlers
from cow_service.api.routes.artifacts import artifact_routes
from cow_service.api.routes.docs import docs_routes
from cow_service.api.routes.downloads import download_routes
from cow_service.api.routes.health import health_routes
from cow_service.api.routes.jobs import job_routes
from cow_service.api.routes.simulate import simulate_routes
from cow_service.api.submission import Submitter
from cow_service.jobs.engine import JobEngine
from cow_service.jobs.readiness import Readiness
from cow_service.observability import tracing

SUMMARY = "Lets a multimodal LLM look before it answers: one image and one what-if question in, imagined frames out."


def create_app(engine: JobEngine, readiness: Readiness | None = None, *, closing: bool = True) -> FastAPI:
    """The application of an engine, which it starts if it is not running yet. The app itself holds no state.

    When the app ends, it closes engine and service, unless `closing` is false because others use them.
    """
    service = engine.service
    readiness = readiness or Readiness(service)
    submitter = Submitter(engine)
    completer = Completer(submitter)

    @asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncGenerator[None]:
        if not engine.is_running:
            await to_thread.run_sync(engine.start)
        yield
        await completer.close()
        if closing:
            await to_thread.run_sync(engine.close)
            await to_thread.run_sync(service.close)
            await to_thread.run_sync(tracing.stop)

    app = LayeredApp(
        title="COW",
        version=__version__,
        summary=SUMMARY,
        docs_url=None,  # the framework's page loads its script from elsewhere; ours is in `routes/docs.py`
        redoc_url=None,
        redirect_slashes=False,
        lifespan=lifespan,
    )
    limits = {"megabytes": service.settings.max_body_mb, "seconds": service.settings.body_timeout}
    app.add_middleware(BodyLimit, **limits, megabytes_at_once=service.settings.max_bodies_mb)
    install_problem_handlers(app)
    install_layers(app, service.settings, service.metrics)
    layers = app.surround
    # Outermost: the other layers refuse requests, too.
    app.surround = lambda stack: ChatProblems(stack if layers is None else layers(stack))
    for router in (
        simulate_routes(submitter),
        chat_routes(submitter, completer),
        job_routes(engine),
        download_routes(engine),
        artifact_routes(engine),
        health_routes(engine, readiness),
        page_routes(lambda: engine.service.artifacts, service.settings.artifacts_redirect),
        docs_routes(),
    ):
        app.include_router(router)
    app.openapi = lambda: contract(app)
    return app
