"""Applications that are asked in this process, without a server: those whose requests come to no job."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import httpx
from fastapi import FastAPI
from waiting import TIME_LIMIT

from cow_service.api.app import create_app
from cow_service.jobs.engine import JobEngine
from cow_service.service import Service
from cow_service.settings import Settings

_contract: list[dict[str, Any]] = []  # that of the first app: it is the same for all, and takes long to make


def app_of(folder: Path, **settings: Any) -> FastAPI:
    """An app whose engine does not run."""
    app = create_app(JobEngine(Service(Settings(data_dir=folder / "data", **settings))))
    if not _contract:
        _contract.append(app.openapi())
    app.openapi_schema = _contract[0]
    return app


def ask(app: FastAPI, *requests: tuple[Any, ...], client: str = "192.0.2.1") -> list[httpx.Response]:
    """The responses to a few requests: method, path, headers, content. An unhandled error is answered, not raised."""

    async def run() -> list[httpx.Response]:
        transport = httpx.ASGITransport(app, raise_app_exceptions=False, client=(client, 1))
        async with httpx.AsyncClient(transport=transport, base_url="http://cow:8000", timeout=TIME_LIMIT) as http:
            return [
                await http.request(
                    method, path, headers=rest[0] if rest else None, content=rest[1] if rest[1:] else None
                )
                for method, path, *rest in requests
            ]

    return asyncio.run(run())


def get(app: FastAPI, path: str) -> httpx.Response:
    """The response to one request."""
    return ask(app, ("GET", path))[0]
