"""`GET /livez`, `GET /readyz` and `GET /models`."""

from __future__ import annotations

from typing import Literal

from fastapi import APIRouter
from pydantic import BaseModel

from cow_service import errors
from cow_service.api.problems import documented
from cow_service.records import Models
from cow_service.service import Service


class Health(BaseModel):
    """A probe's answer."""

    status: Literal["ok"] = "ok"


def health_routes(service: Service) -> APIRouter:
    """Probes and the list of backends, bound to a service."""
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
        responses=documented(errors.StorageUnavailable, errors.ReaderUnavailable, errors.GeneratorUnavailable),
    )
    def readyz() -> Health:
        """Checks that the data folder can be written and that the default reader and generator load."""
        service.check()
        return Health()

    @router.get("/models", operation_id="models", tags=["models"], summary="Readers and generators")
    def models() -> Models:
        """What each is, what it needs, and whether it is ready."""
        return service.models()

    return router
