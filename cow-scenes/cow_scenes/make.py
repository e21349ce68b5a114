"""Makes a set, or resumes an interrupted one."""

import json
import shutil
from collections.abc import Iterator
from pathlib import Path

from .card import write_card
from .errors import ItemsFailedError, UsageError
from .layout import TEMPORARY, truth_folder
from .plan import ItemKey
from .pool import Failed, Made, make_all
from .settings import Settings
from .shards import write_shards

RECORD = ".arguments.json"


def open_folder(out: Path, settings: Settings) -> None:
    """Take a new folder, or one that was begun with the same arguments; only the count may have grown."""
    record = out / RECORD
    if out.exists() and any(out.iterdir()) and not record.exists():
        raise UsageError(f"{out} is not empty and no set was begun in it; give a new folder")
    out.mkdir(parents=True, exist_ok=True)
    ours = json.loads(json.dumps(settings.record()))
    if record.exists():
        theirs = json.loads(record.read_text())
        grown = theirs["arguments"]["count"] <= ours["arguments"]["count"]
        ours_same = {**ours, "arguments": {**ours["arguments"], "count": 0}}
        if not grown or ours_same != {**theirs, "arguments": {**theirs["arguments"], "count": 0}}:
            raise UsageError(f"{out} was begun with other arguments or versions ({record}); give a new folder")
    partial = out / f"{RECORD}.part"
    partial.write_text(json.dumps(ours, indent=1) + "\n")
    partial.replace(record)
    for left in out.glob(f"truth/*/{TEMPORARY}*"):
        shutil.rmtree(left)


def missing(out: Path, settings: Settings) -> tuple[ItemKey, ...]:
    """The items that are not there yet."""
    return tuple(key for key in settings.plan() if not truth_folder(out, key).exists())


def make_set(out: Path, settings: Settings, processes: int) -> Iterator[Made | Failed]:
    """Check the arguments and the folder at once; what is returned makes the set as it is read.

    Raises:
        UsageError: if the folder belongs to something else.
        ItemsFailedError: at the end, naming the items that failed twice; no shards are written then.
    """
    if processes < 1:
        raise UsageError(f"--processes is {processes}; give 1 or more")
    if settings.family == "other":
        # Its libraries are an extra, and a missing one would fail every item.
        from .other import require_libraries  # noqa: PLC0415

        require_libraries()
    open_folder(out, settings)
    return make_missing(out, settings, processes)


def make_missing(out: Path, settings: Settings, processes: int) -> Iterator[Made | Failed]:
    """Make what is missing, yield each item's end, then write shards, card and manifest."""
    failed = []
    todo = missing(out, settings)
    for event in make_all(todo, out, settings, processes) if todo else ():
        if isinstance(event, Failed):
            failed.append(f"{event.key.id} ({event.reason})")
        yield event
    if failed:
        raise ItemsFailedError(f"not made: {'; '.join(failed)}; run the same command again, or take another seed")
    write_shards(out, settings)
    write_card(out, settings)
