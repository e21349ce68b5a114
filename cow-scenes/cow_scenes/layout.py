"""Where a set's files are."""

from pathlib import Path

from .plan import ItemKey

TEMPORARY = ".making-"
"""How the folder of an unfinished item begins."""


def truth_folder(out: Path, key: ItemKey) -> Path:
    """Where an item's truth is."""
    return out / "truth" / key.subset / key.id
