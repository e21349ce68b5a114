"""`GET /openapi.json`: the framework's document, with what the framework does not see."""

from __future__ import annotations

from typing import Any

from fastapi import FastAPI
from fastapi.openapi.utils import get_openapi

from cow_service.api.middleware.rate_limit import PROBES
from cow_service.api.openai.routes import document_chat
from cow_service.api.problems import documented
from cow_service.errors import OriginNotAllowed, RateLimited, Unauthorized
from cow_service.records import Problem
from cow_service.requests import AnswerRequest, SimulateRequest

DROPPED = ("HTTPValidationError", "ValidationError")  # the framework's error shapes, which no operation returns


def contract(app: FastAPI) -> dict[str, Any]:
    """The OpenAPI document of an app, made once: with request bodies, problems and what the middleware answers."""
    if app.openapi_schema is None:
        document = get_openapi(title=app.title, version=app.version, summary=app.summary, routes=app.routes)
        schemas = document.setdefault("components", {}).setdefault("schemas", {})
        for model in (Problem, SimulateRequest, AnswerRequest):
            schema = model.model_json_schema(ref_template="#/components/schemas/{model}")
            schemas.update(schema.pop("$defs", {}))
            schemas[model.__name__] = schema
        for operations in document["paths"].values():
            for operation in operations.values():
                if "application/json" in operation["responses"].get("422", {}).get("content", {}):
                    del operation["responses"]["422"]  # the framework's own; ours are problems
        _document_middleware(document)
        document_chat(document)
        for name in DROPPED:
            schemas.pop(name, None)
        document["components"]["schemas"] = dict(sorted(schemas.items()))
        app.openapi_schema = document
    return app.openapi_schema


def _document_middleware(document: dict[str, Any]) -> None:
    """Adds the API key, and what the middleware may answer, to each operation."""
    scheme = {"type": "http", "scheme": "bearer", "description": "Needed where the server has COW_API_KEYS."}
    document["components"]["securitySchemes"] = {"key": scheme}
    for path, operations in document["paths"].items():
        for operation in operations.values():
            probe = path in PROBES
            operation["security"] = [] if probe else [{"key": []}, {}]
            refusals = (OriginNotAllowed,) if probe else (Unauthorized, OriginNotAllowed, RateLimited)
            responses = operation["responses"]
            for status, response in documented(*refusals).items():
                known = responses.setdefault(str(status), response)
                if known is not response:
                    known["description"] += ", " + response["description"]
            operation["responses"] = dict(sorted(responses.items()))
