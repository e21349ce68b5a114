"""Results to share, in figures: a film with its question, futures and verdict, and a still of it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from cow_service.media.images import decode
from cow_service.media.share import Told, card, film
from cow_service.media.video import frames_of, write_mp4

FUTURES = (((0.1, 0.1), (0.9, 0.5)), ((0.1, 0.1), (0.5, 0.6)))
TOLD = Told(
    "If the ball rolls to the right, will it hit the box at the far end of the table, or does it stop before that?",
    "Yes", 50, "All but 5 of 50 imagined futures agree.", 0.9, FUTURES, ((0.1, 0.2), (0.8, 0.3)), 0.5, 8,
)  # fmt: skip


@pytest.fixture
def clip(tmp_path: Path) -> bytes:
    frames = [np.full((200, 320, 3), 100 + 4 * i, np.uint8) for i in range(20)]
    write_mp4(frames, tmp_path / "clip.mp4", fps=10, width=320, height=200)
    return (tmp_path / "clip.mp4").read_bytes()


def figures(picture: np.ndarray) -> list[float]:
    """The means of six bands from the top to the bottom, and the mean of blue less red: lines are of that hue."""
    bands = [float(band.mean()) for band in np.array_split(picture, 6)]
    return [*bands, float((picture[..., 2].astype(int) - picture[..., 0]).mean())]


def test_a_film_begins_with_its_futures_and_ends_with_its_verdict(clip: bytes) -> None:
    frames, fps = frames_of(film(clip, TOLD))
    # Futures fade for 1.4 s, half a second and 0.6 s are shown after the first frame, the verdict stays for 2 s.
    assert (len(frames), fps, frames[0].shape) == (14 + 1 + 11 + 20, 10, (312, 320, 3))
    for number, expected in (
        (0, [42.9, 100.3, 100.8, 100.8, 84.6, 22.2, 1.6]),
        (7, [42.9, 100.2, 100.5, 100.5, 84.5, 22.2, 0.9]),
        (14, [42.9, 100.0, 100.0, 100.0, 84.4, 22.2, 0.0]),
        (24, [44.4, 138.0, 138.0, 138.0, 114.7, 22.2, 0.0]),
        (30, [44.7, 144.0, 144.0, 144.0, 119.8, 29.4, 0.2]),
    ):
        assert figures(frames[number]) == pytest.approx(expected, abs=0.25), number


def test_a_card_is_one_moment_with_path_and_futures(clip: bytes) -> None:
    picture = decode(card(clip, TOLD)).pixels
    assert picture.shape == (630, 1200, 3)
    assert figures(picture) == pytest.approx([33.4, 80.0, 80.8, 80.1, 69.4, 25.6, 1.6], abs=0.25)
