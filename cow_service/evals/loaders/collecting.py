"""Collects the items of a data set, the rows that cannot be asked, and what was found on the way."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass, field

from cow_service.errors import InvalidRequest
from cow_service.evals.items import Item, question_text
from cow_service.evals.loaders.rows import FileFault, Row, RowFault, item_of
from cow_service.evals.pictures import Pictures

MAX_SHOWN = 20


@dataclass
class Collected:
    """What a data set holds."""

    items: list[Item] = field(default_factory=list)
    faults: list[str] = field(default_factory=list)  # a row each, with its place: what is left out
    broken: list[str] = field(default_factory=list)  # files that cannot be read to their end
    notes: list[str] = field(default_factory=list)  # what was found and worked around


def collect(rows: Iterable[Row | RowFault], pictures: Pictures, *, repeated_rows: bool = False) -> Collected:
    """The items of rows. A row twice is a fault, and so is an id, unless `repeated_rows`: then rows are kept."""
    found = Collected()
    asked: dict[tuple[str, str], Item] = {}
    by_id: dict[str, Item] = {}
    for row in rows:
        if isinstance(row, FileFault):
            found.broken.append(str(row))
            continue
        if isinstance(row, RowFault):
            found.faults.append(str(row))
            continue
        try:
            item = item_of(row, pictures)
        except RowFault as fault:
            found.faults.append(f"{row.place}: {fault}")
            continue
        key = item.image, question_text(item)
        before = asked.get(key)
        if item.id in by_id:
            found.faults.append(f"{row.place}: the id {item.id!r} stands in {by_id[item.id].row} too")
        elif before is not None and not repeated_rows:
            other = "" if before.answer == item.answer else f" with another answer, ({before.answer})"
            found.faults.append(f"{row.place}: asks the same as {before.row}{other}")
        else:
            asked.setdefault(key, item)
            by_id[item.id] = item
            found.items.append(item)
    if repeated_rows and len(asked) < len(found.items):
        found.notes.append(f"{len(found.items) - len(asked)} rows ask the same of the same picture as another row.")
    return found


def refuse_broken(found: Collected) -> None:
    """Raises `InvalidRequest` that names every file that cannot be read to its end: rows are missing."""
    if found.broken:
        raise InvalidRequest("\n".join(found.broken[:MAX_SHOWN]) + ".")


def refuse_faults(found: Collected) -> None:
    """Raises `InvalidRequest` that names every row that cannot be asked, up to `MAX_SHOWN`."""
    if not found.faults:
        return
    more = f"\n... and {len(found.faults) - MAX_SHOWN} more" if len(found.faults) > MAX_SHOWN else ""
    raise InvalidRequest(
        f"{len(found.faults)} {'row' if len(found.faults) == 1 else 'rows'} cannot be asked; mend them, or leave them "
        "out with --skip-faulty:\n" + "\n".join(found.faults[:MAX_SHOWN]) + more
    )


def digest_of(items: Iterable[Item]) -> str:
    """Of all that is asked, pictures and truth included, wherever it came from."""
    parts = sorted(item.model_dump_json(exclude={"row"}) for item in items)
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()
