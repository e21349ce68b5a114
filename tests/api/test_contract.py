"""openapi.yaml is what the app serves, every code is documented, and errors have one shape."""

from __future__ import annotations

import asyncio
import inspect
import re
from pathlib import Path

import httpx
import pytest
import yaml
from conftest import ROOT
from engines import app_for
from fastapi import FastAPI

from cow_service import errors
from cow_service.errors import CowError, FieldError
from cow_service.records import Problem
from cow_service.registry import Registry
from cow_service.service import Service
from cow_service.settings import Settings

CLASSES = [c for _, c in inspect.getmembers(errors, inspect.isclass) if issubclass(c, CowError) and c is not CowError]


def get(app: FastAPI, path: str) -> httpx.Response:
    """One request to the app itself; an unhandled error is answered, not raised."""

    async def ask() -> httpx.Response:
        transport = httpx.ASGITransport(app, raise_app_exceptions=False)
        async with httpx.AsyncClient(transport=transport, base_url="http://cow") as client:
            return await client.get(path)

    return asyncio.run(ask())


@pytest.fixture
def document(service: Service) -> dict:
    return app_for(service).openapi()


def test_openapi_yaml_is_what_the_app_serves(service: Service, document: dict) -> None:
    assert yaml.safe_load((ROOT / "openapi.yaml").read_text()) == document, "run `make openapi`"
    assert get(app_for(service), "/openapi.json").json() == document


def test_every_reference_leads_somewhere(document: dict) -> None:
    names = set(re.findall(r"#/components/schemas/(\w+)", str(document)))
    assert names <= set(document["components"]["schemas"])
    assert {"SimulateRequest", "Simulation", "Problem"} <= names


def test_every_error_has_its_own_code_and_is_documented() -> None:
    codes = [cls.code for cls in CLASSES]
    assert len(set(codes)) == len(codes)
    for cls in CLASSES:
        assert cls.code in (errors.__doc__ or "")
        assert 400 <= cls.status < 600


# Of other operations, or of none.
OTHERS = (
    "model-not-found",
    "not-found",
    "method-not-allowed",
    "internal-error",
    "range-not-satisfiable",
    "job-not-found",
    "download-unavailable",
    "not-ready",
)


def test_every_code_of_simulate_is_in_the_contract(document: dict) -> None:
    responses = document["paths"]["/simulate"]["post"]["responses"]
    told = " ".join(response["description"] for response in responses.values())
    for cls in CLASSES:
        if cls.code not in OTHERS:
            assert f"`{cls.code}`" in told
            assert str(cls.status) in responses


def test_one_error_shape() -> None:
    problem = Problem(**errors.InvalidRequest("x is 7; give 8.", errors=(FieldError("/x", "7"),)).as_problem())
    assert problem.model_dump() == {
        "type": "urn:cow:problem:invalid-request",
        "title": "The request is not valid.",
        "status": 422,
        "detail": "x is 7; give 8.",
        "errors": [{"pointer": "/x", "detail": "7"}],
    }


def test_an_unforeseen_error_is_a_problem_without_a_trace(service: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail() -> None:
        raise RuntimeError("secret /home/path")

    monkeypatch.setattr(service, "check", fail)
    response = get(app_for(service), "/readyz")
    assert response.status_code == 500
    assert response.headers["content-type"] == "application/problem+json"
    assert "secret" not in response.text


def test_an_unready_service_says_why(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    response = get(app_for(Service(Settings(data_dir=tmp_path / "file"))), "/readyz")
    assert response.status_code == 503
    assert response.json()["type"].endswith("storage-unavailable")
    assert response.headers["retry-after"]
    assert str(tmp_path) not in response.text


def test_a_backend_that_cannot_be_imported_is_unavailable() -> None:
    from importlib.metadata import EntryPoint

    registry: Registry = Registry("none", errors.GeneratorUnavailable, Settings())
    registry.__dict__["_points"] = {"far": EntryPoint("far", "no_such_package.far:create", "none")}
    with pytest.raises(errors.GeneratorUnavailable, match="no_such_package"):
        registry.get("far")
    with pytest.raises(KeyError):
        registry.get("near")
    assert registry.names() == ("far",)


def test_a_backend_that_failed_to_load_is_not_tried_at_every_request(monkeypatch: pytest.MonkeyPatch) -> None:
    from types import SimpleNamespace

    from cow_service import registry as plugins

    tries: list[Settings] = []

    def create(settings: Settings) -> object:
        tries.append(settings)
        if len(tries) == 1:
            raise errors.WeightsUnavailable("Pull them.")
        return object()

    registry: Registry = Registry("none", errors.GeneratorUnavailable, Settings())
    registry.__dict__["_points"] = {"slow": SimpleNamespace(load=lambda: create)}
    for _ in range(3):
        with pytest.raises(errors.WeightsUnavailable, match="Pull them"):
            registry.get("slow")
    assert len(tries) == 1
    monkeypatch.setattr(plugins, "RETRY_SECONDS", 0.0)
    assert registry.get("slow") is registry.get("slow")
    assert len(tries) == 2
