"""Errors as records: RFC 9457 problems, for responses, jobs and webhooks alike."""

from __future__ import annotations

from cow_service.errors import CowError
from cow_service.records import Problem, ProblemField

TYPE_PREFIX = "urn:cow:problem:"  # a name, not an address: README.md explains every code


def problem_of(error: CowError) -> Problem:
    """The problem that a `CowError` is on the wire."""
    fields = [ProblemField(pointer=field.pointer, detail=field.detail) for field in error.errors]
    return Problem(
        type=TYPE_PREFIX + error.code, title=error.title, status=error.status, detail=error.detail, errors=fields
    )
