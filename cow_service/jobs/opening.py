"""Opens the job database of the settings."""

from pathlib import Path

import sqlalchemy as sa

from cow_service.jobs.database import Database
from cow_service.jobs.sqlite import Sqlite
from cow_service.settings import Settings


def open_database(settings: Settings, *, read_only: bool = False) -> Database:
    """The database; nothing is connected yet. `read_only`: a file must exist, and is not changed."""
    if settings.database_url is None:
        return Sqlite(settings.data_dir / "jobs.sqlite3", read_only=read_only)
    url = sa.make_url(settings.database_url.get_secret_value())
    if url.get_backend_name() == "sqlite":
        return Sqlite(Path(url.database or ""), read_only=read_only)
    from cow_service.jobs.postgres import Postgres  # noqa: PLC0415 # its driver takes long to import

    return Postgres(url.set(drivername="postgresql+psycopg"))
