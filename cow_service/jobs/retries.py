"""Who waits while the database is away: jobs do, callers do not.

DBOS tries again whatever lost its connection, for as long as it takes. A caller is told instead.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import wraps
from typing import ParamSpec, TypeVar

from dbos import _dbos as dbos_instances  # pyright: ignore[reportPrivateUsage]

Given = ParamSpec("Given")
Value = TypeVar("Value")

_thread = threading.local()


class _Retries:
    """Whether DBOS tries again, which depends on the thread that asks."""

    def __bool__(self) -> bool:
        return not getattr(_thread, "answers_a_caller", False)


def let_callers_not_wait() -> None:
    """Has DBOS heed `without_retries`. It runs already."""
    database = dbos_instances._get_dbos_instance()._sys_db  # pyright: ignore[reportPrivateUsage]
    database._retry_connection_errors = _Retries()  # pyright: ignore[reportPrivateUsage, reportAttributeAccessIssue]


def without_retries(work: Callable[Given, Value]) -> Callable[Given, Value]:
    """`work` raises where the database is away, also in the middle. What it starts in other threads waits."""

    @wraps(work)
    def answering(*args: Given.args, **kwargs: Given.kwargs) -> Value:
        before = getattr(_thread, "answers_a_caller", False)
        _thread.answers_a_caller = True
        try:
            return work(*args, **kwargs)
        finally:
            _thread.answers_a_caller = before

    return answering
