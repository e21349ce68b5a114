"""Callers with keys of their own on one server: each has its own jobs."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from copy import copy

import httpx
from servers import Served
from waiting import TIME_LIMIT

from cow_service.api.middleware.access import hash_of, new_key


def new_keys(*names: str) -> tuple[dict[str, str], dict[str, str]]:
    """The setting that knows these callers, and their keys."""
    keys = {name: new_key() for name in names}
    return {"COW_API_KEYS": json.dumps({name: hash_of(key) for name, key in keys.items()})}, keys


@contextmanager
def as_caller(served: Served, key: str) -> Iterator[Served]:
    """The server, asked with a key."""
    caller, headers = copy(served), {"Authorization": f"Bearer {key}"}
    with httpx.Client(base_url=served.http.base_url, timeout=TIME_LIMIT, headers=headers) as caller.http:
        yield caller
