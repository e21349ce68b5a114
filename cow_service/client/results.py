"""What calls return: the server's own records, with the pictures that they name, downloaded when first asked for.

`Simulation` and `Answer` are those of `Client`; `AsyncSimulation` and `AsyncAnswer` those of `AsyncClient`, the same
but for `await`.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from pydantic import PrivateAttr

from cow_service import records
from cow_service.client.calls import read
from cow_service.client.shown import (
    answer_html,
    answered,
    brief,
    filmstrip_png,
    met,
    picture_of,
    simulation_html,
    stacked,
)
from cow_service.errors import CowError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray
    from PIL import Image


class _Held:
    """Bytes by their digests. They are no part of what a result says: results that say the same are equal."""

    def __init__(self) -> None:
        self._held: dict[str, bytes] = {}

    def shown(self, sha256: str) -> bytes | None:
        """The bytes, for a notebook; None where they are not here."""
        return self._held.get(sha256)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Held)

    __hash__ = object.__hash__

    def __deepcopy__(self, _: dict[int, Any]) -> Self:
        return self  # bytes by their digests are the same for every copy

    def __reduce__(self) -> tuple[Any, ...]:
        # A connection does not go into another process; what it has brought does.
        return type(self), (), {"_held": self._held}


def _nowhere(sha256: str) -> bytes:
    raise ValueError(f"This result comes from a file or another process: get {sha256} by `Client.artifact`.")


async def _async_nowhere(sha256: str) -> bytes:
    return _nowhere(sha256)


class Files(_Held):
    """Artifacts of one result: downloaded once, then held."""

    def __init__(self, download: Callable[[str], bytes] = _nowhere) -> None:
        super().__init__()
        self._given_up = False
        self._download = download

    def get(self, sha256: str) -> bytes:
        """The bytes; downloads them the first time."""
        if sha256 not in self._held:
            self._held[sha256] = self._download(sha256)
        return self._held[sha256]

    def shown(self, sha256: str) -> bytes | None:
        """The bytes, for a notebook, which shows what it can: nothing is downloaded after that has failed once."""
        if not self._given_up and sha256 not in self._held:
            try:
                self.get(sha256)
            except (CowError, ValueError):
                self._given_up = True
        return self._held.get(sha256)


class AsyncFiles(_Held):
    """The same, where downloads are awaited."""

    def __init__(self, download: Callable[[str], Awaitable[bytes]] = _async_nowhere) -> None:
        super().__init__()
        self._download = download

    async def get(self, sha256: str) -> bytes:
        """The bytes; downloads them the first time."""
        if sha256 not in self._held:
            self._held[sha256] = await self._download(sha256)
        return self._held[sha256]


class _Simulation(records.Simulation):
    """What both kinds of simulation have in common."""

    def __repr__(self) -> str:
        told = brief(f"{self.grounding.object} {met(self)}")
        return f"<{type(self).__name__} {self.id}: {told}; {len(self.frames)} frames>"

    __str__ = __repr__

    def shown(self, sha256: str) -> bytes | None:
        """The bytes of one of its pictures, for a notebook; None where they are not to be had."""
        raise NotImplementedError

    def _repr_html_(self) -> str:
        return simulation_html(self, self.shown)

    def _repr_png_(self) -> bytes | None:
        return filmstrip_png(self, self.shown)

    def _pictures(self) -> Iterator[tuple[str, str]]:
        """Names of files in a folder and their digests, but for the video."""
        yield from ((f"frame_{frame.index:03d}.png", frame.sha256) for frame in self.frames)
        yield "overlay.png", self.overlay.sha256

    def _video(self) -> str:
        if self.video is None:
            raise ValueError("This simulation has no video: ask for one with video=True.")
        return self.video.sha256

    def _write(self, folder: Path) -> Path:
        return _written(folder / "simulation.json", self)


class _Answer(records.Answer):
    """What both kinds of answer have in common."""

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self.id}: {brief(answered(self))}>"

    __str__ = __repr__

    def _repr_html_(self) -> str:
        simulation = self.simulation
        return answer_html(self, simulation.shown if isinstance(simulation, _Simulation) else lambda _: None)

    def _repr_png_(self) -> bytes | None:
        simulation = self.simulation
        return filmstrip_png(simulation, simulation.shown) if isinstance(simulation, _Simulation) else None


class Simulation(_Simulation):
    """A simulation, as `Client` returns it.

    >>> simulation = client.simulate("image.jpg", "If the yellow ball moves to the right, will it hit the blue mug?")
    >>> [frame.index for frame in simulation.frames]
    [1, 3, 5]
    >>> simulation.numpy_frames().shape
    (3, 295, 512, 3)
    """

    _files: Files = PrivateAttr(default_factory=Files)

    def bind(self, files: Files) -> None:
        """Tells where its pictures come from."""
        self._files = files

    def shown(self, sha256: str) -> bytes | None:
        """The bytes of one of its pictures, for a notebook; None where they are not to be had."""
        return self._files.shown(sha256)

    def pil_frames(self) -> list[Image.Image]:
        """The frames chosen for reasoning as PIL images, RGB, in order of time."""
        return [picture_of(self._files.get(frame.sha256)) for frame in self.frames]

    def numpy_frames(self) -> NDArray[np.uint8]:
        """The same frames as one array (frames, height, width, 3), RGB, uint8."""
        return stacked(self.pil_frames())

    def pil_overlay(self) -> Image.Image:
        """The input with box, point, arrow and path drawn on it, RGB."""
        return picture_of(self._files.get(self.overlay.sha256))

    def video_bytes(self) -> bytes:
        """The clip as mp4 (H.264). Raises `ValueError` where the request said `video=False`."""
        return self._files.get(self._video())

    def load(self) -> Self:
        """Downloads overlay and frames now."""
        for _, sha256 in self._pictures():
            self._files.get(sha256)
        return self

    def save(self, folder: str | Path) -> Path:
        """Writes frame_*.png, overlay.png, video.mp4 and simulation.json into a folder, which is made if missing."""
        folder = _made(folder)
        for name, sha256 in self._pictures():
            (folder / name).write_bytes(self._files.get(sha256))
        if self.video is not None:
            (folder / "video.mp4").write_bytes(self.video_bytes())
        self._write(folder)
        return folder


class AsyncSimulation(_Simulation):
    """A simulation, as `AsyncClient` returns it. A notebook shows what `await simulation.load()` has brought."""

    _files: AsyncFiles = PrivateAttr(default_factory=AsyncFiles)

    def bind(self, files: AsyncFiles) -> None:
        """Tells where its pictures come from."""
        self._files = files

    def shown(self, sha256: str) -> bytes | None:
        """The bytes of one of its pictures, for a notebook; None where they are not to be had."""
        return self._files.shown(sha256)

    async def pil_frames(self) -> list[Image.Image]:
        """The frames chosen for reasoning as PIL images, RGB, in order of time."""
        return [picture_of(await self._files.get(frame.sha256)) for frame in self.frames]

    async def numpy_frames(self) -> NDArray[np.uint8]:
        """The same frames as one array (frames, height, width, 3), RGB, uint8."""
        return stacked(await self.pil_frames())

    async def pil_overlay(self) -> Image.Image:
        """The input with box, point, arrow and path drawn on it, RGB."""
        return picture_of(await self._files.get(self.overlay.sha256))

    async def video_bytes(self) -> bytes:
        """The clip as mp4 (H.264). Raises `ValueError` where the request said `video=False`."""
        return await self._files.get(self._video())

    async def load(self) -> Self:
        """Downloads overlay and frames now."""
        for _, sha256 in self._pictures():
            await self._files.get(sha256)
        return self

    async def save(self, folder: str | Path) -> Path:
        """Writes frame_*.png, overlay.png, video.mp4 and simulation.json into a folder, which is made if missing."""
        folder = _made(folder)
        for name, sha256 in self._pictures():
            (folder / name).write_bytes(await self._files.get(sha256))
        if self.video is not None:
            (folder / "video.mp4").write_bytes(await self.video_bytes())
        self._write(folder)
        return folder


class Answer(_Answer):
    """An answer, as `Client` returns it; its `simulation` has the pictures that it was reasoned on.

    >>> question = "If the yellow ball moves to the right, will it hit the blue mug? (A) Yes (B) No"
    >>> answer = client.answer("image.jpg", question)
    >>> answer.answer, answer.option
    ('B', 'No')
    >>> [encounter.kind for encounter in answer.simulation.trajectory.encounters]
    ['occluded-by']
    """

    simulation: Simulation | None  # pyright: ignore[reportIncompatibleVariableOverride] - frozen: nobody assigns it

    def load(self) -> Self:
        """Downloads overlay and frames now."""
        if self.simulation is not None:
            self.simulation.load()
        return self

    def save(self, folder: str | Path) -> Path:
        """Writes answer.json, and what `Simulation.save` writes, into a folder, which is made if missing."""
        folder = _made(folder)
        if self.simulation is not None:
            self.simulation.save(folder)
        _written(folder / "answer.json", self)
        return folder


class AsyncAnswer(_Answer):
    """An answer, as `AsyncClient` returns it."""

    simulation: AsyncSimulation | None  # pyright: ignore[reportIncompatibleVariableOverride] - frozen, too

    async def load(self) -> Self:
        """Downloads overlay and frames now."""
        if self.simulation is not None:
            await self.simulation.load()
        return self

    async def save(self, folder: str | Path) -> Path:
        """Writes answer.json, and what `AsyncSimulation.save` writes, into a folder, which is made if missing."""
        folder = _made(folder)
        if self.simulation is not None:
            await self.simulation.save(folder)
        _written(folder / "answer.json", self)
        return folder


def result_from(kind: records.JobKind, body: Any, download: Callable[[str], bytes]) -> Simulation | Answer:
    """The result of a job from its JSON."""
    result = read(Simulation if kind == "simulate" else Answer, body)
    simulation = result.simulation if isinstance(result, Answer) else result
    if simulation is not None:
        simulation.bind(Files(download))
    return result


def async_result_from(
    kind: records.JobKind, body: Any, download: Callable[[str], Awaitable[bytes]]
) -> AsyncSimulation | AsyncAnswer:
    """The same for `AsyncClient`."""
    result = read(AsyncSimulation if kind == "simulate" else AsyncAnswer, body)
    simulation = result.simulation if isinstance(result, AsyncAnswer) else result
    if simulation is not None:
        simulation.bind(AsyncFiles(download))
    return result


def _made(folder: str | Path) -> Path:
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def _written(path: Path, record: records.Record) -> Path:
    path.write_text(record.model_dump_json(indent=2) + "\n", encoding="utf-8")
    return path
