"""What calls return: the server's own records, with the pictures that they name, downloaded when first asked for.

`Simulation` and `Answer` are those of `Client`; `AsyncSimulation` and `AsyncAnswer` those of `AsyncClient`, the same
but for `await`. What either does is written once, as steps.
"""

# The classes of this file share their private members.
# pyright: reportPrivateUsage=false

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Self, TypeVar

from pydantic import PrivateAttr

from cow_service import records
from cow_service.client.display import (
    answer_html,
    describe_answer,
    filmstrip_png,
    one_line,
    picture_of,
    simulation_html,
    stacked,
)
from cow_service.client.steps import Steps, finished
from cow_service.client.wording import encounters_words
from cow_service.errors import CowError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray
    from PIL import Image

    from cow_service.client.operations import Operations

T = TypeVar("T")


class Files:
    """The artifacts of one result, by their digests: downloaded once, then held.

    They are no part of what a result says: results that say the same are equal.
    """

    def __init__(self, connection: Operations | None = None) -> None:
        self.connection = connection
        self.held: dict[str, bytes] = {}
        self.download_failed = False

    def fetch(self, sha256: str) -> Steps[bytes]:
        """The bytes, which are downloaded the first time."""
        if sha256 not in self.held:
            if self.connection is None:
                raise ValueError(
                    f"This result comes from a file or another process: get {sha256} by `Client.artifact`."
                )
            self.held[sha256] = yield from self.connection.artifact(sha256)
        return self.held[sha256]

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Files)

    __hash__ = object.__hash__

    def __deepcopy__(self, _: dict[int, Any]) -> Self:
        return self  # bytes by their digests are the same for every copy

    def __reduce__(self) -> tuple[Any, ...]:
        # A connection does not go into another process; what it has downloaded does.
        return type(self), (), {"held": self.held}


class _Simulation(records.Simulation):
    """What both kinds of simulation have in common."""

    _files: Files = PrivateAttr(default_factory=Files)

    def __repr__(self) -> str:
        said = one_line(f"{self.grounding.object} {encounters_words(self.trajectory)}")
        return f"<{type(self).__name__} {self.id}: {said}; {len(self.frames)} frames>"

    __str__ = __repr__

    def bind(self, connection: Operations) -> None:
        """Sets where its pictures are downloaded from."""
        self._files = Files(connection)

    def _repr_html_(self) -> str:
        return simulation_html(self, self._picture)

    def _repr_png_(self) -> bytes | None:
        return filmstrip_png(self, self._picture)

    def _picture(self, sha256: str) -> bytes | None:
        """The bytes of a picture or the video for a notebook; None where they are not available."""
        return self._files.held.get(sha256)

    def _pil(self, sha256: str) -> Steps[Image.Image]:
        return picture_of((yield from self._files.fetch(sha256)))

    def _pil_frames(self) -> Steps[list[Image.Image]]:
        pictures: list[Image.Image] = []
        for frame in self.frames:
            pictures.append((yield from self._pil(frame.sha256)))
        return pictures

    def _numpy_frames(self) -> Steps[NDArray[np.uint8]]:
        return stacked((yield from self._pil_frames()))

    def _video_bytes(self) -> Steps[bytes]:
        if self.video is None:
            raise ValueError("This simulation has no video: ask for one with video=True.")
        return (yield from self._files.fetch(self.video.sha256))

    def _load(self) -> Steps[Self]:
        for sha256 in self.pictures.values():
            yield from self._files.fetch(sha256)
        if self.video is not None:
            yield from self._files.fetch(self.video.sha256)
        return self

    def save_steps(self, folder: str | Path) -> Steps[Path]:
        """The steps of `save`."""
        return (yield from _saved(folder, self, self._files))


class _Answer(records.Answer):
    """What both kinds of answer have in common."""

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self.id}: {one_line(describe_answer(self))}>"

    __str__ = __repr__

    def bind(self, connection: Operations) -> None:
        """Sets where its pictures are downloaded from."""
        if (simulation := _simulation_of(self)) is not None:
            simulation.bind(connection)

    def _repr_html_(self) -> str:
        simulation = _simulation_of(self)
        return answer_html(self, (lambda _: None) if simulation is None else simulation._picture)

    def _repr_png_(self) -> bytes | None:
        simulation = _simulation_of(self)
        return None if simulation is None else simulation._repr_png_()

    def _load(self) -> Steps[Self]:
        if (simulation := _simulation_of(self)) is not None:
            yield from simulation._load()
        return self

    def save_steps(self, folder: str | Path) -> Steps[Path]:
        """The steps of `save`."""
        simulation = _simulation_of(self)
        return (yield from _saved(folder, self, Files() if simulation is None else simulation._files))


class Simulation(_Simulation):
    """A simulation, as `Client` returns it.

    >>> simulation = client.simulate("image.jpg", "If the yellow ball moves to the left, will it hit the blue mug?")
    >>> [frame.index for frame in simulation.frames]
    [1, 3, 5]
    >>> simulation.numpy_frames().shape
    (3, 295, 512, 3)
    """

    def pil_frames(self) -> list[Image.Image]:
        """The frames chosen for reasoning as PIL images, RGB, in order of time."""
        return _run(self, self._pil_frames())

    def numpy_frames(self) -> NDArray[np.uint8]:
        """The same frames as one array (frames, height, width, 3), RGB, uint8."""
        return _run(self, self._numpy_frames())

    def pil_overlay(self) -> Image.Image:
        """The input with box, point, arrow and path drawn on it, RGB."""
        return _run(self, self._pil(self.overlay.sha256))

    def video_bytes(self) -> bytes:
        """The clip as mp4 (H.264). Raises `ValueError` where the request said `video=False`."""
        return _run(self, self._video_bytes())

    def load(self) -> Self:
        """Downloads overlay, frames and video now."""
        return _run(self, self._load())

    def save(self, folder: str | Path) -> Path:
        """Writes frame_*.png, overlay.jpg, video.mp4 and simulation.json into a folder, which is made if missing."""
        return _run(self, self.save_steps(folder))

    def _picture(self, sha256: str) -> bytes | None:
        """Downloads what is missing; nothing after a download has failed, so that a notebook does not hang."""
        if not self._files.download_failed:
            try:
                return _run(self, self._files.fetch(sha256))
            except (CowError, ValueError):
                self._files.download_failed = True
        return super()._picture(sha256)


class AsyncSimulation(_Simulation):
    """A simulation, as `AsyncClient` returns it. A notebook shows what `await simulation.load()` has downloaded."""

    async def pil_frames(self) -> list[Image.Image]:
        """The frames chosen for reasoning as PIL images, RGB, in order of time."""
        return await _async_run(self, self._pil_frames())

    async def numpy_frames(self) -> NDArray[np.uint8]:
        """The same frames as one array (frames, height, width, 3), RGB, uint8."""
        return await _async_run(self, self._numpy_frames())

    async def pil_overlay(self) -> Image.Image:
        """The input with box, point, arrow and path drawn on it, RGB."""
        return await _async_run(self, self._pil(self.overlay.sha256))

    async def video_bytes(self) -> bytes:
        """The clip as mp4 (H.264). Raises `ValueError` where the request said `video=False`."""
        return await _async_run(self, self._video_bytes())

    async def load(self) -> Self:
        """Downloads overlay, frames and video now."""
        return await _async_run(self, self._load())

    async def save(self, folder: str | Path) -> Path:
        """Writes frame_*.png, overlay.jpg, video.mp4 and simulation.json into a folder, which is made if missing."""
        return await _async_run(self, self.save_steps(folder))


class Answer(_Answer):
    """An answer, as `Client` returns it; its `simulation` has the pictures that it was reasoned on.

    >>> question = "If the yellow ball moves to the left, will it hit the blue mug? (A) Yes (B) No"
    >>> answer = client.answer("image.jpg", question)
    >>> answer.answer, answer.option
    ('B', 'No')
    >>> answer.simulation.trajectory.outcome.probability
    0.0
    """

    simulation: Simulation | None  # pyright: ignore[reportIncompatibleVariableOverride] - frozen: nobody assigns it

    def load(self) -> Self:
        """Downloads overlay, frames and video now."""
        return _run(self.simulation, self._load())

    def save(self, folder: str | Path) -> Path:
        """Writes answer.json, and what `Simulation.save` writes, into a folder, which is made if missing."""
        return _run(self.simulation, self.save_steps(folder))


class AsyncAnswer(_Answer):
    """An answer, as `AsyncClient` returns it."""

    simulation: AsyncSimulation | None  # pyright: ignore[reportIncompatibleVariableOverride] - frozen, too

    async def load(self) -> Self:
        """Downloads overlay, frames and video now."""
        return await _async_run(self.simulation, self._load())

    async def save(self, folder: str | Path) -> Path:
        """Writes answer.json, and what `AsyncSimulation.save` writes, into a folder, which is made if missing."""
        return await _async_run(self.simulation, self.save_steps(folder))


def _simulation_of(answer: _Answer) -> _Simulation | None:
    return answer.simulation if isinstance(answer.simulation, _Simulation) else None


def _run(simulation: Simulation | None, steps: Steps[T]) -> T:
    connection = None if simulation is None else simulation._files.connection
    return finished(steps) if connection is None else connection.run(steps)


async def _async_run(simulation: AsyncSimulation | None, steps: Steps[T]) -> T:
    connection = None if simulation is None else simulation._files.connection
    return finished(steps) if connection is None else await connection.run(steps)


def _saved(folder: str | Path, result: records.Simulation | records.Answer, files: Files) -> Steps[Path]:
    """Writes a result and its artifacts into a folder, which is made if missing."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    for name, sha256 in records.artifacts_of(result).items():
        (folder / name).write_bytes((yield from files.fetch(sha256)))
    for name, text in records.documents_of(result).items():
        (folder / name).write_text(text, encoding="utf-8")
    return folder
