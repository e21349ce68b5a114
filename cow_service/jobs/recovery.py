"""Returns the workflows of processes that have ended to the queues."""

from __future__ import annotations

from collections.abc import Iterable

from dbos import DBOS
from dbos import _dbos as dbos_instances  # pyright: ignore[reportPrivateUsage]

from cow_service.jobs import state, workflows
from cow_service.jobs.queues import PREFIX


def recover(executors: Iterable[str]) -> list[str]:
    """Returns the pending workflows of executors to their queues; returns their ids.

    What DBOS itself does at its start, but for the queue of those that were started without: its own one is read by
    every process, also by those that compute nothing. The public `resume_workflow` would also revive a job that was
    canceled meanwhile, and would reset the count of starts that ends a job which kills its process.
    """
    database = dbos_instances._get_dbos_instance()._sys_db  # pyright: ignore[reportPrivateUsage]
    ended = list(executors)
    if not ended:
        return []
    recovered = [one for one in state.pending_of(ended) if one.app_version == workflows.VERSION]
    for queue in {PREFIX + state.queue_of(one) for one in recovered}:
        DBOS.register_queue(queue, on_conflict="always_update")
    for one in recovered:
        database.reenqueue_for_recovery(one.workflow_id, ended, PREFIX + state.queue_of(one))
    return [one.workflow_id for one in recovered]
