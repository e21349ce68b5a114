"""Waiting for the outcome of a job ends, whatever becomes of the job."""

from __future__ import annotations

from concurrent.futures import Future
from types import SimpleNamespace
from typing import Any

import pytest
from dbos import error as dbos_error
from dbos._dbos import _get_dbos_instance
from engines import running_engine

from cow_service.jobs.dispatch import result_of


@pytest.mark.timeout(30)
@pytest.mark.parametrize("started_here", [True, False])
def test_a_job_that_was_canceled_and_deleted_is_not_waited_for(started_here: bool) -> None:
    """Its follower would wait without end, and with it the server that stops."""
    running_engine()
    canceled: Future[str] = Future()
    canceled.set_exception(dbos_error.DBOSWorkflowCancelledError("canceled"))
    handle: Any = SimpleNamespace(dbos=_get_dbos_instance(), get_workflow_id=lambda: "deleted-meanwhile")
    if started_here:
        handle.future = canceled
    with pytest.raises(dbos_error.DBOSNonExistentWorkflowError):
        result_of(handle)


def test_what_a_job_came_to_is_its_result() -> None:
    done: Future[str] = Future()
    done.set_result("result")
    handle: Any = SimpleNamespace(future=done)
    assert result_of(handle) == "result"
