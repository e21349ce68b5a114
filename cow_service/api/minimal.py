"""Results without the long lists of their trajectories, for callers who say `Prefer: return=minimal` (RFC 7240).

Stored jobs keep the whole: the lists are left out of the response alone.
"""

from __future__ import annotations

import json
from typing import Any

LEFT_OUT = ("states", "scale", "rotation", "band", "futures", "tracks", "tracks_visible")  # of `Path`, all per frame
SEPARATORS = (",", ":")


def minimal_result(result: str) -> str:
    """A `Simulation` or an `Answer`, as JSON, without the lists. CPU work: not for the event loop."""
    return _written(_without_lists(json.loads(result)))


def minimal_job(job: str) -> str:
    """A `Job`, as JSON, the same with its result."""
    read: dict[str, Any] = json.loads(job)
    if read.get("result") is not None:
        _without_lists(read["result"])
    return _written(read)


def _without_lists(result: dict[str, Any]) -> dict[str, Any]:
    simulation = result.get("simulation", result)  # that of an answer, which may be null
    trajectory = None if simulation is None else simulation["trajectory"]
    while trajectory is not None:
        for path in trajectory["paths"]:
            for name in LEFT_OUT:
                path.pop(name, None)
        trajectory = trajectory.get("factual")
    return result


def _written(value: dict[str, Any]) -> str:
    return json.dumps(value, separators=SEPARATORS, ensure_ascii=False)
