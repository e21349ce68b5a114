"""JSON of requests and responses: plain values out, records in."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any, TypeVar

import httpx
from pydantic import BaseModel, ValidationError

from cow_service.client.errors import BadResponse, error_of
from cow_service.records import Job

R = TypeVar("R", bound=BaseModel)


def to_json(value: Any) -> bytes:
    """JSON of plain values, records and arrays."""
    return json.dumps(value, default=plain, ensure_ascii=False, separators=(",", ":")).encode()


def plain(value: Any) -> Any:
    """What JSON can hold of a record, of a NumPy array or number, or of a time; tuples and lists stay."""
    if isinstance(value, BaseModel):
        return value.model_dump(mode="json", exclude_unset=True)
    if hasattr(value, "tolist"):
        return value.tolist()
    if hasattr(value, "isoformat"):
        return (value if value.tzinfo else value.astimezone()).isoformat()
    if isinstance(value, Mapping):
        return dict(value)
    if isinstance(value, list | tuple | str | int | float):
        return value
    raise TypeError(f"{type(value).__name__} cannot be sent; give plain values, records or arrays")


def read(model: type[R], body: Any) -> R:
    """A record from JSON. Fields that only a later version of the server knows are left out."""
    try:
        return model.model_validate(body, extra="ignore", strict=False)
    except ValidationError as error:
        wrong = error.errors()[0]
        place = ".".join(str(part) for part in wrong["loc"])
        raise BadResponse(
            f"The response is no {model.__name__} that this version reads ({place}: {wrong['msg']}): are server and "
            "SDK of the same version?"
        ) from error


def object_in(response: httpx.Response) -> dict[str, Any]:
    """The JSON object that a response holds."""
    try:
        body = response.json()
    except ValueError:
        body = None
    if not isinstance(body, dict):
        raise error_of(response)
    return body


def job_in(response: httpx.Response) -> Job:
    """The job that a response holds, without its result: that is read where its kind is known."""
    return read(Job, {**object_in(response), "result": None})
