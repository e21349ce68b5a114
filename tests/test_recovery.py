"""What the recovery of jobs relies on in DBOS, besides its public interface."""

from __future__ import annotations

import uuid
from collections.abc import Iterator
from types import SimpleNamespace

import pytest
import sqlalchemy as sa
from dbos import DBOS
from engines import running_engine

from cow_service.jobs import workflows
from cow_service.jobs.recovery import recover

REMEDY = """
jobs/recovery.py relies on SystemDatabase.reenqueue_for_recovery, which is private. If it is gone or acts otherwise:
look for a public function that returns PENDING workflows of named executors to a queue without reviving canceled ones,
and without resetting recovery_attempts; else do so with one UPDATE of workflow_status (status ENQUEUED, owner_xid and
started_at_epoch_ms NULL, queue_name the one that it had or else the light one, where status is PENDING and executor_id
is one of them).
"""


@pytest.fixture
def rows() -> Iterator[SimpleNamespace]:
    """Workflows of an executor that has ended: one that is pending, one that is canceled, in a version nobody runs."""
    engine = running_engine().database.engine
    table = sa.Table("workflow_status", sa.MetaData(), autoload_with=engine)
    executor = f"dead-{uuid.uuid4().hex}"
    ids = {status: str(uuid.uuid4()) for status in ("PENDING", "CANCELLED")}
    with engine.begin() as connection:
        for status, job in ids.items():
            connection.execute(
                sa.insert(table).values(
                    workflow_uuid=job,
                    status=status,
                    name="nobody runs this",
                    executor_id=executor,
                    application_version=workflows.VERSION,
                    recovery_attempts=3,
                    queue_name=f"nobody-reads-{executor}",
                )
            )

    def row(status: str) -> sa.Row[tuple[object, ...]]:
        with engine.connect() as connection:
            return connection.execute(sa.select(table).where(table.c.workflow_uuid == ids[status])).one()

    yield SimpleNamespace(executor=executor, row=row)
    with engine.begin() as connection:
        connection.execute(sa.delete(table).where(table.c.workflow_uuid.in_(ids.values())))


def test_the_private_function_of_dbos_does_what_recovery_needs(rows: SimpleNamespace) -> None:
    recovered = recover([rows.executor])
    pending, canceled = rows.row("PENDING"), rows.row("CANCELLED")
    assert recovered == [pending.workflow_uuid], REMEDY
    assert (pending.status, pending.recovery_attempts) == ("ENQUEUED", 3), REMEDY
    assert pending.queue_name == f"nobody-reads-{rows.executor}", REMEDY
    assert canceled.status == "CANCELLED", REMEDY
    assert recover([rows.executor]) == recover([]) == [], "they are no longer that executor's"


def test_its_public_neighbour_would_revive_what_was_canceled(rows: SimpleNamespace) -> None:
    """The reason for the private one: when this fails, the public function will do."""
    for status in ("PENDING", "CANCELLED"):
        DBOS.resume_workflow(rows.row(status).workflow_uuid, queue_name=rows.row(status).queue_name)
    assert rows.row("CANCELLED").status == "ENQUEUED"
    assert rows.row("PENDING").recovery_attempts == 0
