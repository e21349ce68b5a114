"""Opens the job database of the settings."""

from pathlib import Path

import sqlalchemy as sa

from cow_service.jobs.database import Database
from cow_service.jobs.sqlite import Sqlite
from cow_service.settings import Settings


def open_database(settings: Settings) -> Database:
    """The database; nothing is connected yet."""
    if settings.database_url is None:
        return Sqlite(settings.data_dir / "jobs.sqlite3")
    url = sa.make_url(settings.database_url.get_secret_value())
    if url.get_backend_name() == "sqlite":
        return Sqlite(Path(url.database or ""))
    from cow_service.jobs.postgres import Postgres  # noqa: PLC0415 # its driver takes long to import

    return Postgres(url.set(drivername="postgresql+psycopg"))
