"""Stage 4: the frames of the imagined future, chosen ones as pictures and all of them as video."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray

from cow_service.generators.base import Generator, Shot
from cow_service.media.artifacts import ArtifactStore
from cow_service.media.images import encode_png, fit_within
from cow_service.media.video import write_mp4
from cow_service.records import Clip, Frame, Trajectory, Video
from cow_service.requests import FramesRequest

Image = NDArray[np.uint8]


def choose_frames(wanted: FramesRequest, trajectory: Trajectory) -> tuple[int, ...]:
    """Ascending clip indices of the frames to return, by the policy or as listed in the request.

    `initial` is every second frame after the first (1, 3, 5, ...), as in the paper's evaluation code; `uniform` spreads
    over the whole clip, both ends included; `events` takes the first frame of each encounter, then the frames that lie
    farthest from those already taken while the object is visible.
    """
    last = len(trajectory.points) - 1
    if wanted.indices is not None:
        return tuple(sorted(set(wanted.indices)))
    count = min(wanted.count, last + 1)
    if wanted.policy == "initial":
        spread = [min(2 * i + 1, last) for i in range(count)]
        return tuple(sorted(set(spread))) if len(set(spread)) == count else tuple(range(last + 1))[:count]
    if wanted.policy == "uniform":
        return tuple(int(i) for i in np.linspace(0, last, count).round()) if count > 1 else (last,)
    return _at_events(trajectory, count)


def _at_events(trajectory: Trajectory, count: int) -> tuple[int, ...]:
    last = len(trajectory.points) - 1
    chosen = list(dict.fromkeys(encounter.first_frame for encounter in trajectory.encounters))[:count]
    seen = [i for i in range(1, last + 1) if trajectory.visible[i]] or list(range(1, last + 1))
    end = seen[-1]
    if not chosen:
        chosen = [end]
    for pool in (seen, list(range(last + 1))):
        while len(chosen) < count and (left := [i for i in pool if i not in chosen]):
            chosen.append(max(left, key=lambda i: min(abs(i - j) for j in (*chosen, 0))))
    return tuple(sorted(chosen))


def generate(
    shot: Shot,
    generator: Generator,
    wanted: FramesRequest,
    video: bool,
    artifacts: ArtifactStore,
    progress: Callable[[float], None],
) -> Clip:
    """Renders the clip once, keeping the chosen frames and, where wanted, the video. `progress` hears 0..1."""
    trajectory = shot.trajectory
    chosen = choose_frames(wanted, trajectory)
    width, height = generator.size(shot.scene.width, shot.scene.height)
    indices = tuple(range(len(trajectory.points))) if video else chosen
    frames: list[Frame] = []

    def rendered() -> Iterator[Image]:
        keep = set(chosen)
        for index, pixels in zip(indices, generator.render(shot, indices, progress), strict=True):
            if index in keep:
                frames.append(_keep(pixels, index, trajectory.fps, wanted.max_side, artifacts))
            yield pixels

    made = _keep_video(rendered(), trajectory.fps, (width, height), artifacts) if video else None
    if made is None:
        for _ in rendered():
            pass
    return Clip(
        fps=trajectory.fps,
        num_frames=len(trajectory.points),
        width=width,
        height=height,
        frames=tuple(frames),
        video=made,
    )


def _keep(pixels: Image, index: int, fps: float, max_side: int | None, artifacts: ArtifactStore) -> Frame:
    picture = fit_within(pixels, max_side)
    artifact = artifacts.put(encode_png(picture), "image/png")
    height, width = picture.shape[:2]
    return Frame(index=index, time=index / fps, url=artifact.url, sha256=artifact.sha256, width=width, height=height)


def _keep_video(frames: Iterator[Image], fps: float, size: tuple[int, int], artifacts: ArtifactStore) -> Video:
    with artifacts.scratch() as path:
        count = write_mp4(frames, path, fps=fps, width=size[0], height=size[1])
        artifact = artifacts.put_file(path, "video/mp4")
    even = (size[0] + size[0] % 2, size[1] + size[1] % 2)
    return Video(url=artifact.url, sha256=artifact.sha256, fps=fps, num_frames=count, width=even[0], height=even[1])
