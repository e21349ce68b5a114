"""Who waits while the database is away: jobs do, callers do not.

DBOS tries again whatever lost its connection, for as long as it takes. A caller is told instead.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import wraps
from typing import ParamSpec, TypeVar

from dbos import _dbos as dbos_instances  # pyright: ignore[reportPrivateUsage]
from dbos import error as dbos_error

from cow_service.errors import ShuttingDown

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
    """`work` raises where the database is away, also in the middle. What it starts in other threads waits.

    Raises `ShuttingDown` where DBOS ended meanwhile: requests that poll for jobs go on until connections close.
    """

    @wraps(work)
    def answering(*args: Given.args, **kwargs: Given.kwargs) -> Value:
        before = getattr(_thread, "answers_a_caller", False)
        _thread.answers_a_caller = True
        try:
            return work(*args, **kwargs)
        except dbos_error.DBOSException as error:
            if dbos_instances._dbos_global_instance is not None:  # pyright: ignore[reportPrivateUsage]
                raise
            raise ShuttingDown("The server is stopping. Ask again in a while: its jobs go on then.") from error
        finally:
            _thread.answers_a_caller = before

    return answering
