"""What readers and generators share when they build a model from its weights."""

from __future__ import annotations

from collections.abc import Sequence
from threading import Lock

# Seeds, and what libraries patch while they initialise, are global to the process: two models built at once, be they of
# a reader and of a generator, would mix up their weights.
BUILD_LOCK = Lock()


def listed(names: Sequence[str], most: int = 8) -> str:
    """The first `most` names, and how many more there are; for error messages."""
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more
