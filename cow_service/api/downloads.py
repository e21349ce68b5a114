"""A job as one file to take along: all of it as a zip, or its video as an animated picture or a contact sheet."""

from __future__ import annotations

import json
import shutil
import zipfile
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from cow_service.errors import DownloadUnavailable, StorageUnavailable
from cow_service.jobs.engine import JobEngine
from cow_service.media.animations import animation
from cow_service.media.artifacts import ArtifactStore, extension_of
from cow_service.records import Answer, Job, Sha256, Simulation, artifacts_of, documents_of


@dataclass(frozen=True)
class Succeeded:
    """A job that has succeeded, and its result."""

    job: Job
    result: Simulation | Answer


class Downloads:
    """Makes files of jobs. Its methods block: not for an event loop."""

    def __init__(self, engine: JobEngine) -> None:
        self._engine = engine

    def zip(self, job_id: str, owner: str | None) -> tuple[Path, Callable[[], None]]:
        """A temporary file with all of a job, and what removes it.

        Raises `JobNotFound`, `DownloadUnavailable`, `ArtifactNotFound`, `StorageUnavailable`.
        """
        found, store = self._succeeded(job_id, owner), self._engine.service.artifacts
        request = self._engine.request_of(job_id, owner).request
        texts = documents_of(found.result) | {"request.json": json.dumps(request, indent=2, ensure_ascii=False) + "\n"}
        image = found.result.image.sha256
        image_file = f"image.{extension_of(store.get(image).media_type)}"
        with ExitStack() as stack:
            path = stack.enter_context(store.scratch())
            at = datetime.fromisoformat(found.job.created_at)
            _write_zip(path, texts, {image_file: image} | artifacts_of(found.result), store, at)
            return path, stack.pop_all().close

    def animation(self, job_id: str, owner: str | None, wanted: str) -> bytes:
        """The video of a job in a format of `animations.FORMATS`. Raises as `zip` does."""
        video = self._engine.service.artifacts.read(_video_of(self._succeeded(job_id, owner)))
        with self._engine.service.cpu.held():
            return animation(video, wanted)

    def _succeeded(self, job_id: str, owner: str | None) -> Succeeded:
        """The job with its result. Raises `JobNotFound`, and `DownloadUnavailable` where it has none."""
        found = self._engine.find(job_id, owner)
        if found.result is not None:
            model = Answer if found.job.kind == "answer" else Simulation
            return Succeeded(found.job, model.model_validate_json(found.result))
        if found.job.status in ("queued", "running"):
            detail = f"is {found.job.status}: ask again when it has succeeded; GET /jobs/{job_id}/events tells"
        else:
            why = "" if found.error is None else f" ({found.error.code})"
            detail = f"{_ENDS[found.job.status]}{why}: GET /jobs/{job_id}/request is what to send again"
        raise DownloadUnavailable(f"The job {job_id} {detail}.")


_ENDS = {"failed": "failed", "canceled": "was canceled"}


def _video_of(found: Succeeded) -> Sha256:
    """The digest of the video. Raises `DownloadUnavailable` where there is none."""
    result, again = found.result, f"Change GET /jobs/{found.job.id}/request and send it again"
    simulation = result.simulation if isinstance(result, Answer) else result
    if simulation is None:
        raise DownloadUnavailable(
            f"Nothing was imagined for the answer {found.job.id}, so nothing moves: its zip has all there is. {again}, "
            "with `imagine: always`, or with what `simulation_problem` says is missing."
        )
    if simulation.video is None:
        raise DownloadUnavailable(f"The job {found.job.id} has no video. {again}, with `video: true`.")
    return simulation.video.sha256


def _write_zip(
    path: Path, texts: Mapping[str, str], artifacts: Mapping[str, Sha256], store: ArtifactStore, at: datetime
) -> None:
    """Writes texts and artifacts as they are: pictures and videos do not compress."""
    try:
        with zipfile.ZipFile(path, "w", zipfile.ZIP_STORED) as archive:
            for name, text in texts.items():
                archive.writestr(_entry(name, at), text)
            for name, sha256 in artifacts.items():
                with (
                    store.local_file(sha256) as file,
                    file.open("rb") as source,
                    archive.open(_entry(name, at), "w") as target,
                ):
                    shutil.copyfileobj(source, target)
    except OSError as error:
        raise StorageUnavailable(f"The zip could not be written ({type(error).__name__}): is the disk full?") from error


def _entry(name: str, at: datetime) -> zipfile.ZipInfo:
    """By the time of the job, so that the same job is the same bytes whenever it is asked for."""
    return zipfile.ZipInfo(name, at.timetuple()[:6])
