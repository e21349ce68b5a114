"""Files that are written under a temporary name: a process that is killed leaves them behind."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import contextmanager, suppress
from pathlib import Path
from uuid import uuid4

SUFFIX = ".part"


@contextmanager
def temporary_beside(target: Path) -> Generator[Path]:
    """A name for a file that does not exist yet, on the target's own disk so that it can be renamed to it."""
    target.parent.mkdir(parents=True, exist_ok=True)
    temporary = target.parent / f".{uuid4().hex}{SUFFIX}"
    try:
        yield temporary
    finally:
        temporary.unlink(missing_ok=True)


def remove_temporary_files(folder: Path, untouched_since: float) -> None:
    """Removes those in a folder and below that were not written to after that time (seconds since 1970)."""
    for path in folder.rglob(f".*{SUFFIX}"):
        with suppress(FileNotFoundError):  # its process has just ended its work
            if path.stat().st_mtime <= untouched_since:
                path.unlink()
