"""Results and jobs of `AsyncClient`: what they say, and their pictures, which are downloaded from the server.

`sync_results.py` is made from this file when the package is installed or built.
"""

from __future__ import annotations

from collections.abc import AsyncIterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Generic, Self, TypeVar

import httpx
from pydantic import PrivateAttr

from cow_service.client import protocol
from cow_service.client.async_io import AsyncIO, iterate, picture_bytes, run
from cow_service.client.connection import Connection, Files
from cow_service.client.display import AnswerView, SimulationView, answer_html, picture_of, simulation_html, stacked
from cow_service.client.progress import ProgressLike, reporting
from cow_service.records import AcceptedRequest, Job

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray
    from PIL import Image


def connect(endpoint: protocol.Endpoint, retries: int, http: httpx.AsyncClient | None) -> Connection:
    """The connection of a client."""
    kinds = {"simulate": AsyncSimulation, "answer": AsyncAnswer}
    return Connection(endpoint, retries, AsyncIO(http), kinds, AsyncJobHandle)


class AsyncSimulation(SimulationView):
    """A simulation, and its pictures, each downloaded when it is first asked for.

    >>> question = "If the yellow ball moves to the left, will it hit the blue mug?"
    >>> simulation = await client.simulate("image.jpg", question)
    >>> [frame.index for frame in simulation.frames]
    [5, 10, 15, 20]
    >>> (await simulation.numpy_frames()).shape
    (4, 295, 512, 3)
    """

    _files: Files = PrivateAttr(default_factory=Files)

    @property
    def files(self) -> Files:
        """Its artifacts."""
        return self._files

    async def pil_frames(self) -> list[Image.Image]:
        """The frames chosen for reasoning as PIL images, RGB, in order of time."""
        return [picture_of(await run(self._files.fetch(frame.sha256))) for frame in self.frames]

    async def numpy_frames(self) -> NDArray[np.uint8]:
        """The same frames as one array (frames, height, width, 3), RGB, uint8."""
        return stacked(await self.pil_frames())

    async def pil_overlay(self) -> Image.Image:
        """The input with box, point, arrow and path drawn on it, RGB."""
        return picture_of(await run(self._files.fetch(self.overlay.sha256)))

    async def video_bytes(self) -> bytes:
        """The clip as mp4 (H.264). Raises `ValueError` if the request said `video=False`."""
        if self.video is None:
            raise ValueError("This simulation has no video: ask for one with video=True.")
        return await run(self._files.fetch(self.video.sha256))

    async def load(self) -> Self:
        """Downloads overlay, frames and video now."""
        await run(self._files.load(self))
        return self

    async def save(self, folder: str | Path) -> Path:
        """Writes frame_*.png, overlay.jpg, video.mp4 and simulation.json into a folder, which is made if missing."""
        return await run(self._files.save(folder, self))

    def _repr_html_(self) -> str:
        return simulation_html(self, partial(picture_bytes, self._files))


class AsyncAnswer(AnswerView):
    """An answer; its `simulation` has the pictures that it was reasoned on.

    >>> question = "If the yellow ball moves to the left, will it hit the blue mug? (A) Yes (B) No"
    >>> answer = await client.answer("image.jpg", question)
    >>> answer.answer, answer.option
    ('B', 'No')
    >>> answer.simulation.trajectory.outcome.probability
    0.0
    """

    simulation: AsyncSimulation | None  # pyright: ignore[reportIncompatibleVariableOverride] - frozen: never assigned

    @property
    def files(self) -> Files:
        """The artifacts of its simulation."""
        return Files() if self.simulation is None else self.simulation.files

    async def load(self) -> Self:
        """Downloads overlay, frames and video now."""
        await run(self.files.load(self))
        return self

    async def save(self, folder: str | Path) -> Path:
        """Writes answer.json, and what `Simulation.save` writes, into a folder, which is made if missing."""
        return await run(self.files.save(folder, self))

    def _repr_html_(self) -> str:
        return answer_html(self, partial(picture_bytes, self.files))


R_co = TypeVar("R_co", bound=AsyncSimulation | AsyncAnswer, covariant=True)


class AsyncJobHandle(Generic[R_co]):
    """A job on the server, which goes on whether or not anybody holds this. `job` is its last known state."""

    def __init__(self, connection: Connection, job: Job) -> None:
        self._connection = connection
        self.job = job

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self.job.id}: {self.job.kind}, {self.job.status}>"

    @property
    def id(self) -> str:
        """The job's id, by which `Client.job` finds it again."""
        return self.job.id

    async def refresh(self) -> Job:
        """Gets the state of the job. Raises `JobNotFound` if it was deleted."""
        self.job = await run(self._connection.refresh(self.id))
        return self.job

    async def request(self) -> AcceptedRequest:
        """Gets the request that became the job: `client.submit(**request.request, kind=request.kind)` sends it again.

        Raises `JobNotFound` if the job was deleted.
        """
        return await run(self._connection.get(AcceptedRequest, f"{protocol.job_path(self.id)}/request"))

    async def wait(
        self, timeout: float | None = None, *, progress: ProgressLike = False, minimal: bool = False
    ) -> R_co:
        """The job's result, once it has ended; `minimal` as for `Client.simulate`.

        Raises what it failed with (`errors.py`), `Canceled`, and `WaitTimeout` after `timeout` seconds.
        """
        until = protocol.deadline(timeout)
        with reporting(progress) as report:

            def on_update(job: Job) -> None:
                self.job = job
                if report is not None:
                    report(job)

            return await run(self._connection.poll(self.id, timeout, until, on_update, minimal))

    async def cancel(self) -> Job:
        """Cancels the job; work on it stops at the next step. One that has ended stays as it is."""
        self.job = await run(self._connection.cancel(self.id))
        return self.job

    async def delete(self) -> None:
        """Cancels the job and removes it, with artifacts that no other job holds."""
        await run(self._connection.exchange("DELETE", protocol.job_path(self.id)))

    def events(self, after: int = 0) -> AsyncIterator[protocol.Event]:
        """What happens to the job until its end, through broken connections.

        `after` leaves out events up to that number.
        """
        return iterate(self._connection.events(self, after))
