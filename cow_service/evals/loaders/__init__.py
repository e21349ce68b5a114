"""Reads data sets: CausalSpatial's layout, scenes with truth, JSON Lines, CSV, TSV and Parquet."""

import re
from collections.abc import Sequence
from pathlib import Path

from cow_service.errors import InvalidRequest
from cow_service.evals.items import Pictures
from cow_service.evals.loaders import formats
from cow_service.evals.loaders.rows import MAX_SHOWN, Collected, collect, digest_of

__all__ = ["CAUSALSPATIAL", "Collected", "digest_of", "load"]

CAUSALSPATIAL = "Mwxinnn/CausalSpatial"
_HUB_NAME = re.compile(r"[\w.-]+/[\w.-]+", re.ASCII)


def load(data: str, pictures: Pictures, *, subsets: Sequence[str] = (), skip_faulty: bool = False) -> Collected:
    """The items of a data set, each checked, and its pictures kept.

    `data` is a folder or a file, or the name of a data set of the Hugging Face hub. Rows that cannot be asked raise
    `InvalidRequest`, which names them; with `skip_faulty` they are left out, and so they are of data in CausalSpatial's
    layout, whose published rows cannot be mended here. A file that was cut off is refused always.
    """
    unknown = [subset for subset in subsets if subset not in formats.SUBSETS]
    if unknown:
        raise InvalidRequest(f"There is no subset '{unknown[0]}': CausalSpatial has {', '.join(formats.SUBSETS)}.")
    path = Path(data)
    if not path.exists() and _HUB_NAME.fullmatch(data):
        path = _download(data)
    shards = formats.subset_shards(path, subsets or formats.SUBSETS)
    if absent := [subset for subset in subsets if shards and subset not in shards]:
        raise InvalidRequest(f"'{data}' has no subset '{absent[0]}': a folder of that name with Parquet files.")
    if shards:
        found, skip_faulty = formats.load_causalspatial(path, tuple(shards), pictures), True
    elif path.is_file() and path.suffix.lower() in formats.READERS:
        found = collect(formats.table_rows(path, ignore_columns=skip_faulty), pictures)
    elif formats.scene_folders(path):
        found = collect(formats.scene_rows(path), pictures)
    else:
        what = "is not there" if not path.exists() else "holds none of these"
        raise InvalidRequest(
            f"'{data}' {what}: give a folder in CausalSpatial's layout (collision/*.parquet), a folder of scenes "
            f"(*/meta.json with image.jpg), a file ({', '.join(formats.READERS)}), or the name of a data set, such as "
            f"{CAUSALSPATIAL}."
        )
    check_faults(data, found, skip_faulty)
    return found


def check_faults(data: str, found: Collected, skip_faulty: bool) -> None:
    """Raises `InvalidRequest` for faults that are not skipped, and where no question is left."""
    count = len(found.faults)
    if count and not skip_faulty:
        more = f"\n... and {count - MAX_SHOWN} more" if count > MAX_SHOWN else ""
        raise InvalidRequest(
            f"{count} {'row' if count == 1 else 'rows'} cannot be asked; mend them, or leave them out with "
            "--skip-faulty:\n" + "\n".join(found.faults[:MAX_SHOWN]) + more
        )
    if not found.items:
        reasons = "\n".join(found.faults[:5])
        raise InvalidRequest(f"'{data}' holds no question that can be asked.{' ' if reasons else ''}{reasons}")


def _download(name: str) -> Path:
    """The folder of a data set, from the hub (HF_ENDPOINT) or the cache of its library (HF_HOME)."""
    from huggingface_hub import errors, snapshot_download  # noqa: PLC0415

    try:
        return Path(snapshot_download(name, repo_type="dataset", allow_patterns=["*.parquet", "**/*.parquet"]))
    except (errors.HfHubHTTPError, errors.LocalEntryNotFoundError, OSError, ValueError) as error:
        reason = (str(error).strip().splitlines() or [type(error).__name__])[0]
        raise InvalidRequest(
            f"The data set '{name}' is not a folder, and could not be downloaded from the hub: {reason}. "
            "Download it where the network reaches the hub, and name the folder."
        ) from error
