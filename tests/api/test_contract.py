"""openapi.yaml is what the app serves, every code is documented, and errors have one shape."""

from __future__ import annotations

import json
import re

import pytest
import yaml
from asgi import app_of, get
from conftest import ROOT
from fastapi import FastAPI

from cow_service import errors
from cow_service.errors import FieldError
from cow_service.records import Problem

# Of other operations than /simulate, or of none.
OTHERS = {
    *("model-not-found", "not-found", "method-not-allowed", "range-not-satisfiable", "job-not-found"),
    *("download-unavailable", "not-ready", "internal-error"),
}


@pytest.fixture(scope="module")
def app(tmp_path_factory: pytest.TempPathFactory) -> FastAPI:
    return app_of(tmp_path_factory.mktemp("contract"))


def test_openapi_yaml_is_what_the_app_serves(app: FastAPI) -> None:
    document = get(app, "/openapi.json").json()
    assert yaml.load((ROOT / "openapi.yaml").read_text(), yaml.CSafeLoader) == document, "run `make openapi`"
    assert not re.search(r'"(ge|le|gt|lt)":', json.dumps(document)), "limits that no client knows"
    names = set(re.findall(r"#/components/schemas/(\w+)", str(document)))
    assert names <= set(document["components"]["schemas"])
    jobs = {"/jobs", "/jobs/{id}", *(f"/jobs/{{id}}/{part}" for part in ("request", "download", "events", "cancel"))}
    others = {"/artifacts/{sha256}", "/models", "/workers", "/livez", "/readyz", "/metrics"}
    chat = {"/v1/chat/completions", "/v1/responses", "/v1/models", "/v1/models/{model}"}
    assert set(document["paths"]) == {"/simulate", "/answer", "/look"} | chat | jobs | others


def test_every_code_of_simulate_is_in_the_contract(app: FastAPI) -> None:
    responses = app.openapi()["paths"]["/simulate"]["post"]["responses"]
    told = {int(status): set(re.findall("`([a-z-]+)`", one["description"])) for status, one in responses.items()}
    for kind in errors.kinds().values():
        assert (kind.code in told.get(kind.status, ())) is (kind.code not in OTHERS), kind


def test_one_error_shape() -> None:
    fields = tuple(FieldError(f"/{number}", "7") for number in range(errors.MAX_FIELDS + 1))
    told = Problem(**errors.InvalidRequest("x" * (errors.MAX_DETAIL + 1), errors=fields).as_problem()).model_dump()
    assert told == {
        "type": "urn:cow:problem:invalid-request",
        "title": "The request is not valid.",
        "status": 422,
        "detail": "x" * 2000 + "... (2001 characters)",
        "errors": [{"pointer": f"/{number}", "detail": "7"} for number in range(50)],
    }
    assert errors.pointer_part("a/b~" + "c" * 76) == "a~1b~0" + "c" * 76
    assert errors.pointer_part("c" * 81) == "c" * 80 + "... (81 characters)"
