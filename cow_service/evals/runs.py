"""A folder of results: what was asked, of which items, and what came of it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from pydantic import ValidationError

from cow_service.errors import InvalidRequest
from cow_service.evals.items import Item
from cow_service.evals.layout import ITEMS, LOGS, RUN
from cow_service.evals.observations import Observation, RunInfo


@dataclass(frozen=True)
class Run:
    """A run with all that came of it. Its pictures are files of `pictures`, named by digest."""

    folder: Path
    info: RunInfo
    items: dict[str, Item]
    observations: tuple[Observation, ...]

    def of_arm(self, arm: str) -> list[Observation]:
        """The observations of one arm."""
        return [each for each in self.observations if each.arm == arm]


def write_run(folder: Path, info: RunInfo, items: Iterable[Item]) -> None:
    """Writes what is asked, before anything is."""
    lines = "".join(item.model_dump_json() + "\n" for item in items)
    for name, text in ((ITEMS, lines), (RUN, info.model_dump_json(indent=2) + "\n")):
        partial = folder / f".{name}.partial"
        partial.write_text(text, encoding="utf-8")
        partial.replace(folder / name)


def read_info(folder: Path) -> RunInfo | None:
    """What a folder was asked; None where no run was begun in it. Raises `InvalidRequest` for one that is damaged."""
    path = folder / RUN
    try:
        return RunInfo.model_validate_json(path.read_bytes()) if path.is_file() else None
    except (ValidationError, OSError) as error:
        raise _unreadable(folder, RUN, error) from error


def read_run(folder: Path) -> Run:
    """A run and what came of it so far. Raises `InvalidRequest` for a folder that holds none."""
    info = read_info(folder)
    if info is None:
        raise InvalidRequest(f"'{folder}' holds no {RUN}: name the folder that `cow eval --out` wrote.")
    try:
        lines = (folder / ITEMS).read_bytes().splitlines()
        items = {item.id: item for item in map(Item.model_validate_json, lines)}
    except (ValidationError, OSError) as error:
        raise _unreadable(folder, ITEMS, error) from error
    from cow_service.evals.logs import read_observations  # noqa: PLC0415 - Inspect takes a second to import

    return Run(folder, info, items, tuple(read_observations(folder / LOGS)))


def _unreadable(folder: Path, name: str, error: Exception) -> InvalidRequest:
    reason = str(error).splitlines()[0]
    return InvalidRequest(f"'{folder}' holds no whole run: {name} cannot be read ({reason}). Run `cow eval` again.")
