"""Brings the tables of the job database to this version, ahead of the processes that use them."""

from __future__ import annotations

from dbos import _sys_db as dbos_database  # pyright: ignore[reportPrivateUsage]
from dbos import error as dbos_error

from cow_service.errors import StorageUnavailable
from cow_service.jobs.database import Database, database_errors
from cow_service.jobs.serializer import JsonSerializer
from cow_service.jobs.workflow_table import SCHEMA, create_indexes
from cow_service.settings import Settings

USE_LISTEN_NOTIFY = False  # DBOS asks its tables instead: what processes tell each other is ours


def migrate(settings: Settings) -> None:
    """Creates what is missing and updates what is older. Raises `StorageUnavailable`."""
    database = Database(settings)
    try:
        database.create_tables()
        with database_errors():
            dbos_database.SystemDatabase.create(
                system_database_url=database.url,
                engine_kwargs={},
                engine=database.engine,
                schema=SCHEMA,
                serializer=JsonSerializer(),
                executor_id=None,
                use_listen_notify=USE_LISTEN_NOTIFY,
            ).run_migrations()
        create_indexes(database.engine)
    except dbos_error.DBOSException as error:
        raise StorageUnavailable(
            f"The tables of the job database could not be updated ({type(error).__name__}): see COW_DATABASE_URL."
        ) from error
    finally:
        database.close()
