"""Has DBOS run on the job database."""

from __future__ import annotations

from dbos import DBOS, DBOSConfig
from dbos import error as dbos_error
from sqlalchemy.exc import SQLAlchemyError

from cow_service.errors import StorageUnavailable
from cow_service.jobs import workflows
from cow_service.jobs.database import Database
from cow_service.jobs.migration import USE_LISTEN_NOTIFY
from cow_service.jobs.queues import WEBHOOKS
from cow_service.jobs.retries import let_callers_not_wait
from cow_service.jobs.running_limit import bound_running_jobs
from cow_service.jobs.serializer import JsonSerializer
from cow_service.jobs.workflow_table import create_indexes
from cow_service.settings import Settings


def launch(database: Database, settings: Settings, artifacts: str, executor_id: str) -> None:
    """Makes the tables, or looks whether they are there, and starts DBOS. `artifacts` is where they are kept.

    DBOS looks after the queue of the webhooks; `QueuePolls` has ours. Raises `StorageUnavailable`.
    """
    if settings.migrate:
        database.create_tables()
    else:
        database.check_tables()
    database.claim(artifacts)
    config = DBOSConfig(
        name="cow",
        system_database_url=database.url,
        system_database_engine=database.engine,
        application_version=workflows.VERSION,
        executor_id=executor_id,
        serializer=JsonSerializer(),
        use_listen_notify=USE_LISTEN_NOTIFY,
        run_migrations=settings.migrate,
        log_level="WARNING",
    )
    try:
        DBOS(config=config)
        DBOS.listen_queues([WEBHOOKS])
        DBOS.launch()
    except (SQLAlchemyError, dbos_error.DBOSException) as error:
        DBOS.destroy()
        remedy = "see COW_DATABASE_URL" if settings.migrate else "run `cow migrate` first, and see COW_DATABASE_URL"
        raise StorageUnavailable(f"The job database cannot be used ({type(error).__name__}): {remedy}.") from error
    if settings.migrate:
        create_indexes(database.engine)
    let_callers_not_wait()
    if settings.running_limit_per_key is not None:
        bound_running_jobs(settings.running_limit_per_key)
