"""Bounds how many jobs of one key run at the same time: of the others, some wait although a place is free."""

from __future__ import annotations

import sqlalchemy as sa
from dbos import _dbos as dbos_instances  # pyright: ignore[reportPrivateUsage]

from cow_service.jobs.queues import PREFIX, WEBHOOKS
from cow_service.jobs.state import KINDS


def bound_running_jobs(limit: int) -> None:
    """Has this process take a job of a key only while fewer than `limit` of the key are at work, in any process.

    DBOS' own bound per partition of a queue would do without the turns of keys: it looks at partitions in random order.
    """
    database = dbos_instances._get_dbos_instance()._sys_db  # pyright: ignore[reportPrivateUsage]
    jobs = database.tables.workflow_status

    def gate(queue_name: str, partition_key: str | None) -> list[sa.ColumnElement[bool]]:
        if queue_name == WEBHOOKS or not queue_name.startswith(PREFIX):
            return []
        running = (
            sa.select(jobs.c.authenticated_user, sa.func.count().label("number"))
            .where(jobs.c.status == "PENDING", jobs.c.name.in_(KINDS))
            .group_by(jobs.c.authenticated_user)
            .subquery()
        )
        place = sa.func.row_number().over(
            partition_by=jobs.c.authenticated_user, order_by=(jobs.c.priority, jobs.c.created_at)
        )
        waiting = (
            sa.select(jobs.c.workflow_uuid, jobs.c.authenticated_user, place.label("place"))
            .where(jobs.c.status == "ENQUEUED", jobs.c.queue_name == queue_name)
            .subquery()
        )
        allowed = (
            sa.select(waiting.c.workflow_uuid)
            .outerjoin(running, running.c.authenticated_user == waiting.c.authenticated_user)
            .where(
                sa.or_(
                    waiting.c.authenticated_user.is_(None),
                    waiting.c.place + sa.func.coalesce(running.c.number, 0) <= limit,
                )
            )
        )
        return [jobs.c.workflow_uuid.in_(allowed)]

    database._claim_gate = gate  # pyright: ignore[reportPrivateUsage]
