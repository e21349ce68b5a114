"""The files that a result is saved as, by the SDK and by `GET /jobs/{id}/download`."""

from __future__ import annotations

from cow_service.records.base import Record, Sha256
from cow_service.records.results import Answer, Simulation

VIDEO_FILE = "video.mp4"


def artifacts_of(result: Simulation | Answer) -> dict[str, Sha256]:
    """The digests of frames, overlay and video by the names of files; none of an answer without a simulation."""
    simulation = result.simulation if isinstance(result, Answer) else result
    if simulation is None:
        return {}
    return simulation.pictures | ({} if simulation.video is None else {VIDEO_FILE: simulation.video.sha256})


def documents_of(result: Simulation | Answer) -> dict[str, str]:
    """The result as JSON by the names of files; beside an answer its simulation."""
    if isinstance(result, Simulation):
        return {"simulation.json": _text(result)}
    simulation = {} if result.simulation is None else documents_of(result.simulation)
    return simulation | {"answer.json": _text(result)}


def _text(record: Record) -> str:
    return record.model_dump_json(indent=2) + "\n"
