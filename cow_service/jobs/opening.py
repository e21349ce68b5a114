"""Opens the job database of the settings."""

from pathlib import Path

import sqlalchemy as sa
from sqlalchemy.exc import SQLAlchemyError

from cow_service.jobs.database import Database
from cow_service.jobs.sqlite import Sqlite
from cow_service.settings import Settings, SettingsError


def open_database(settings: Settings, *, read_only: bool = False) -> Database:
    """The database; nothing is connected yet. `read_only`: a file must exist, and is not changed.

    Raises `SettingsError` without repeating the URL: it may hold a password.
    """
    given = None if settings.database_url is None else settings.database_url.get_secret_value()
    if given is None:
        file = settings.data_dir / "jobs.sqlite3"
        return Sqlite(f"sqlite:///{file}", file, read_only=read_only)
    try:
        url = sa.make_url(given)
        kind = url.get_backend_name()
    except (SQLAlchemyError, ValueError) as error:  # of a port, for example
        raise SettingsError("Bad settings: COW_DATABASE_URL is not a database URL.") from error
    if kind == "sqlite" and url.database:
        return Sqlite(given, Path(url.database), read_only=read_only)
    if kind in ("postgresql", "postgres"):
        from cow_service.jobs.postgres import Postgres  # noqa: PLC0415 # its driver takes long to import

        return Postgres(url.set(drivername="postgresql+psycopg").render_as_string(hide_password=False))
    raise SettingsError("Bad settings: COW_DATABASE_URL must be sqlite:///FILE or postgresql://USER@HOST/DATABASE.")
