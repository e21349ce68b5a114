"""Gives jobs to DBOS: to be run by this process at once, or from a queue by any process on the database."""

from __future__ import annotations

from collections.abc import Callable, Generator
from contextlib import contextmanager
from typing import Any

from dbos import DBOS, DBOSContextSetAuth, SetEnqueueOptions, SetWorkflowAttributes, SetWorkflowID, WorkflowHandle
from dbos import error as dbos_error

from cow_service.errors import StorageUnavailable
from cow_service.jobs import workflows
from cow_service.jobs.database import database_errors
from cow_service.jobs.queues import PREFIX
from cow_service.jobs.spec import JobSpec
from cow_service.jobs.state import (
    ATTRIBUTE_CREATED_AT,
    ATTRIBUTE_GENERATOR,
    ATTRIBUTE_IMAGE,
    ATTRIBUTE_PRIORITY,
    ATTRIBUTE_QUESTION,
    ATTRIBUTE_QUEUE,
    ATTRIBUTE_TURN,
)

POLL_SECONDS = 1.0


class Dispatch:
    """What it is given is in the database when its methods return. They raise `StorageUnavailable`."""

    def __init__(self) -> None:
        self._registered: set[str] = set()

    def start(self, job_id: str, spec: JobSpec, owner: str | None, queue: str) -> WorkflowHandle[str]:
        """Starts a job in this process."""
        with _accept_errors(), _attributes(job_id, spec, owner, queue):
            return DBOS.start_workflow(_workflow(spec), spec.model_dump())

    def enqueue(self, job_id: str, spec: JobSpec, owner: str | None, queue: str) -> None:
        """Puts a job into a queue."""
        name = PREFIX + queue
        with _accept_errors():
            if name not in self._registered:
                DBOS.register_queue(name, on_conflict="always_update")
                self._registered.add(name)
            with _attributes(job_id, spec, owner, queue), SetEnqueueOptions(priority=spec.turn + 1):
                DBOS.enqueue_workflow(name, _workflow(spec), spec.model_dump())


def result_of(handle: WorkflowHandle[str]) -> str:
    """Waits for the outcome of a job that was started in this process, or elsewhere before.

    DBOS' own waiting has no end for a job that was canceled and then deleted; here it ends with
    `DBOSNonExistentWorkflowError`. Raises what the job came to.
    """
    running: Any = handle
    if (future := getattr(running, "future", None)) is not None:
        try:
            return future.result()
        except (dbos_error.DBOSWorkflowCancelledError, dbos_error.DBOSAwaitedWorkflowCancelledError):
            pass  # it may have come to an end all the same: the database says
    return running.dbos._sys_db.await_workflow_result(handle.get_workflow_id(), POLL_SECONDS, fail_if_missing=True)


@contextmanager
def _attributes(job_id: str, spec: JobSpec, owner: str | None, queue: str) -> Generator[None]:
    """What DBOS keeps beside a workflow. Times in SQLite are whole seconds: that of the spec is exact."""
    kept = {
        ATTRIBUTE_GENERATOR: spec.generator,
        ATTRIBUTE_CREATED_AT: spec.created_at,
        ATTRIBUTE_TURN: str(spec.turn),
        ATTRIBUTE_QUEUE: queue,
        ATTRIBUTE_PRIORITY: spec.priority,
        ATTRIBUTE_QUESTION: spec.question,
        ATTRIBUTE_IMAGE: spec.image,
    }
    attributes = SetWorkflowAttributes(kept)
    with SetWorkflowID(job_id), DBOSContextSetAuth(owner, None), attributes:
        yield


@contextmanager
def _accept_errors() -> Generator[None]:
    """Translates what DBOS raises when it is given a job to `StorageUnavailable`."""
    try:
        with database_errors():
            yield
    except dbos_error.DBOSException as error:
        raise StorageUnavailable(f"The job database did not take the job ({type(error).__name__}).") from error


def _workflow(spec: JobSpec) -> Callable[[dict[str, Any]], str]:
    return workflows.answer if spec.kind == "answer" else workflows.simulate
