"""`GET /livez`, `GET /readyz`, `GET /models`, `GET /workers` and `GET /metrics`."""

from typing import Annotated, Literal

from fastapi import APIRouter
from fastapi.responses import PlainTextResponse, Response
from pydantic import BaseModel

from cow_service import errors
from cow_service.api.problems import documented
from cow_service.api.submission import Engine, Owner, from_app
from cow_service.jobs.readiness import Readiness
from cow_service.observability.metrics import MEDIA_TYPE
from cow_service.records import Models, Workers


class Health(BaseModel):
    """A probe's answer."""

    status: Literal["ok"] = "ok"


router = APIRouter()


@router.get("/livez", tags=["health"], summary="The process answers")
async def livez() -> Health:
    """For restarts: says nothing about whether work can be done."""
    return Health()


@router.get(
    "/readyz",
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
def readyz(engine: Engine, readiness: Annotated[Readiness, from_app("readiness")]) -> Health:
    """Checks that the database answers, that the data folder can be written and has room, that the default
    reader and generator are loaded, by a worker where the server computes nothing, and that no job waits for a
    workflow version that no process has.
    """
    readiness.check()
    engine.check()
    return Health()


@router.get("/models", tags=["models"], summary="Readers and generators")
def models(engine: Engine) -> Models:
    """What each backend is, what it needs, and whether it is ready."""
    return engine.service.models()


@router.get(
    "/workers",
    tags=["health"],
    summary="Processes, their workers, and the queues",
    responses=documented(errors.StorageUnavailable),
)
def workers(engine: Engine, owner: Owner) -> Workers:
    """Every process on the job database, what its workers compute, how full the queues are, and jobs that no
    process takes. A second old at most; processes tell of themselves every two seconds. Where the server has keys,
    only the keys in `COW_ADMIN_KEYS` see hosts, process ids and ids of jobs.
    """
    return engine.processes.overview(for_admin=engine.service.settings.is_admin(owner))


@router.get("/metrics", tags=["health"], summary="Counters for Prometheus", response_class=PlainTextResponse)
def metrics(engine: Engine) -> Response:
    """Requests, stages, jobs, queues, workers, memory of the process and of GPUs, in Prometheus' text format."""
    return Response(engine.service.metrics.exposition(), headers={"Content-Type": MEDIA_TYPE})
