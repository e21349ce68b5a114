"""CausalSpatial as it is published: five subsets of Parquet shards, with their flaws handled and counted.

The ids of rows are made of subset, shard and row: 192 rows of `physics` share one id. The option that abstains is found
by its text, not by the column `not_sure`: in 54 rows of `occlusion` that names an option that says something.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Literal

from cow_service.evals.items import REAL, Item
from cow_service.evals.loaders.collecting import Collected, collect
from cow_service.evals.loaders.parquet import parquet_rows
from cow_service.evals.loaders.rows import FileFault, Row, RowFault
from cow_service.evals.loaders.scenes import oracle_frames
from cow_service.evals.pictures import Pictures

Subset = Literal["collision", "physics", "compatibility", "occlusion", "realworld"]
SUBSETS: tuple[Subset, ...] = ("collision", "physics", "compatibility", "occlusion", "realworld")
TRUTH = "truth"  # of sets that are made with it
_LEVEL = re.compile(r"_Level_(\d+)")


def subset_shards(folder: Path, subsets: Sequence[str]) -> dict[str, list[Path]]:
    """The Parquet files of each subset that the folder has."""
    found = {subset: sorted((folder / subset).glob("**/*.parquet")) for subset in subsets}
    return {subset: paths for subset, paths in found.items() if paths}


def load_causalspatial(folder: Path, subsets: Sequence[str], pictures: Pictures) -> Collected:
    """The items of a folder in the layout of the published data, or of sets made like it."""
    abstaining: dict[str, str] = {}
    found = collect(_rows(folder, subsets, abstaining), pictures, repeated_rows=True)
    found.notes[:0] = [*_shared_ids(found.items), *_without_abstain(found.items, abstaining)]
    return found


def _rows(folder: Path, subsets: Sequence[str], abstaining: dict[str, str]) -> Iterator[Row | RowFault]:
    """A row each; `abstaining` gets what the column `not_sure` says of it, by its id."""
    for subset, shards in subset_shards(folder, subsets).items():
        for shard, path in enumerate(shards):
            name = path.relative_to(folder).as_posix()
            try:
                for number, fields in enumerate(parquet_rows(path)):
                    row = _row(folder, subset, f"{subset}/{shard}/{number}", f"{name}, row {number}", fields)
                    if isinstance(row, Row) and fields.get("not_sure"):
                        abstaining[row.id] = str(fields["not_sure"]).strip("() .").upper()[:1]
                    yield row
            except FileFault as fault:
                yield FileFault(f"{subset}/{fault}")


def _row(folder: Path, subset: str, unique: str, place: str, fields: dict[str, Any]) -> Row | RowFault:
    """A row. One that lacks what the others have is a fault."""
    missing = [name for name in ("id", "question", "answer", "image") if fields.get(name) in (None, "")]
    if missing:
        return RowFault(f"{place}: has no {' and no '.join(f'`{name}`' for name in missing)}")
    source = str(fields["id"])
    level = _LEVEL.search(source)
    real = subset == "realworld"
    if level is None and not real:
        return RowFault(f"{place}: the id {source[:60]!r} names no level: it should be like Collision_Level_1_0")
    image: Any = fields["image"]
    return Row(
        place=place,
        id=unique,
        source_id=source,
        image=image.get("bytes") if isinstance(image, dict) else image if isinstance(image, bytes) else None,
        question=str(fields["question"]),
        answer=str(fields["answer"]),
        options=fields.get("options") or None,
        task=str(fields.get("type") or subset) if real else subset,
        level=REAL if real or level is None else f"L{level[1]}",
        oracle=oracle_frames(folder / TRUTH / subset / source) if (folder / TRUTH).is_dir() else (),
    )


def _shared_ids(items: Sequence[Item]) -> list[str]:
    """Which ids several rows of a subset have."""
    counts = Counter((item.id.partition("/")[0], item.source_id) for item in items)
    shared: Counter[str] = Counter()
    for (subset, _), count in counts.items():
        shared[subset] += count if count > 1 else 0
    return [
        f"{subset}: {count} rows share their id with others; items are told apart by subset, shard and row."
        for subset, count in shared.items()
        if count
    ]


def _without_abstain(items: Sequence[Item], abstaining: dict[str, str]) -> list[str]:
    """Which rows have no option that abstains, though the column `not_sure` names one; and where that is the truth."""
    wrong = [item for item in items if item.id in abstaining and abstaining[item.id] != item.abstain]
    notes: list[str] = []
    for subset in dict.fromkeys(item.id.partition("/")[0] for item in wrong):
        of_subset = [item for item in wrong if item.id.startswith(f"{subset}/")]
        none = [item for item in of_subset if item.abstain is None]
        right = sum(abstaining[item.id] == item.answer for item in none)
        if none:
            notes.append(
                f"{subset}: {len(none)} rows have no option that abstains, though `not_sure` names one; in {right} of "
                "them that option is the right answer. It counts as an answer like any other."
            )
        if len(none) < len(of_subset):
            notes.append(
                f"{subset}: in {len(of_subset) - len(none)} rows another option abstains than `not_sure` says."
            )
    return notes
