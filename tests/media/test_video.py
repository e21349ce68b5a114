"""Video: what was written is decoded again, as a browser would."""

from __future__ import annotations

import io
import struct
import weakref
from concurrent.futures import ThreadPoolExecutor
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest
from av.video.reformatter import ColorRange, Colorspace, VideoReformatter
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image, ImageSequence
from refusals import refused

from cow_service.media.video import YuvFrames, animation, frames_of, write_mp4


def scene(index: int, width: int = 96, height: int = 64) -> np.ndarray:
    pixels = np.zeros((height, width, 3), np.uint8)
    pixels[..., 0] = np.linspace(20, 230, width, dtype=np.uint8)
    pixels[..., 1] = np.linspace(30, 200, height, dtype=np.uint8)[:, None]
    pixels[..., 2] = 90
    left = 2 * index
    pixels[20:36, left : left + 16] = [240, 200, 20]
    return pixels


def read_mp4(path: Path) -> list[np.ndarray]:
    reformatter = VideoReformatter()
    with av.open(str(path)) as container:
        return [
            reformatter.reformat(
                frame, format="rgb24", src_colorspace=Colorspace.ITU709, dst_color_range=ColorRange.JPEG
            ).to_ndarray()
            for frame in container.decode(video=0)
        ]


def boxes(data: bytes) -> list[bytes]:
    names, at = [], 0
    while at < len(data):
        size, name = struct.unpack_from(">I4s", data, at)
        names.append(name)
        at += size
    return names


@pytest.fixture
def path(tmp_path) -> Path:
    return tmp_path / "clip.part"


def test_what_is_written_is_what_is_shown_in_a_stream_that_browsers_play(path):
    written = [scene(i)[:, ::-1] for i in range(20)]  # views that are not contiguous
    assert write_mp4(iter(written), path, fps=16, width=96, height=64) == 20
    shown = read_mp4(path)
    assert len(shown) == 20
    assert max(np.abs(a.astype(int) - b).mean() for a, b in zip(written, shown, strict=True)) < 3
    with av.open(str(path)) as container:
        assert "mp4" in container.format.name
        stream = container.streams.video[0]
        context = stream.codec_context
        assert (context.name, context.profile, context.pix_fmt) == ("h264", "High", "yuv420p")
        assert (stream.width, stream.height, stream.frames) == (96, 64, 20)
        bt709 = 1  # ITU-T H.273
        assert (context.colorspace, context.color_primaries, context.color_trc) == (bt709, bt709, bt709)
        assert context.color_range == ColorRange.MPEG
    names = boxes(path.read_bytes())
    assert names.index(b"moov") < names.index(b"mdat")


@pytest.mark.parametrize(
    ("fps", "rate"),
    [(16, Fraction(16)), (7.5, Fraction(15, 2)), (29.97, Fraction(2997, 100)), (30000 / 1001, Fraction(30000, 1001))],
)
def test_every_frame_stands_at_its_exact_time(path, fps, rate):
    write_mp4((scene(i) for i in range(40)), path, fps=fps, width=96, height=64)
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        times = [frame.pts * frame.time_base for frame in container.decode(stream)]
        assert times == [i / rate for i in range(40)]
        assert stream.average_rate == rate
        assert stream.duration * stream.time_base == 40 / rate


@pytest.mark.parametrize("size", [(97, 64), (96, 65), (1, 1)])  # px
def test_odd_sides_are_padded_with_their_last_row_or_column(path, size):
    width, height = size
    frame = scene(3, width, height) if width > 1 else np.full((1, 1, 3), 120, np.uint8)
    assert write_mp4([frame] * 4, path, fps=16, width=width, height=height) == 4
    shown = read_mp4(path)
    padded = np.pad(frame, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
    assert shown[0].shape == padded.shape
    assert np.abs(shown[0].astype(int) - padded).mean() < 6


def test_frames_are_taken_one_at_a_time(path):
    made: list[weakref.ref] = []

    def frames():
        for i in range(30):
            frame = scene(i).copy()
            made.append(weakref.ref(frame))
            yield frame
            del frame
            assert sum(one() is not None for one in made) <= 1

    assert write_mp4(frames(), path, fps=16, width=96, height=64) == 30


@pytest.mark.parametrize(
    "frames",
    [
        [],
        [scene(0), scene(1, 94)],
        [scene(0), scene(1)[..., :2]],
        [scene(0), scene(1).astype(np.float32)],
    ],
    ids=["none", "another width", "two channels", "floats"],
)
def test_frames_that_make_no_video_leave_no_file(path, frames):
    with pytest.raises(ValueError, match="Frame 1 is" if frames else "no frames"):
        write_mp4(frames, path, fps=16, width=96, height=64)
    assert not path.exists()


@pytest.mark.parametrize("after", [0, 60])
def test_what_the_frames_raise_passes_through(path, after):
    class Stop(Exception):
        pass

    def frames():
        yield from (scene(i % 40) for i in range(after))
        raise Stop

    with pytest.raises(Stop):
        write_mp4(frames(), path, fps=16, width=96, height=64)
    assert not path.exists()


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_full_disk(path):
    # By a link, since what is left after an error is removed.
    path.symlink_to("/dev/full")
    noise = np.random.default_rng(0).integers(0, 256, (50, 128, 128, 3), np.uint8)
    with refused("storage-unavailable") as caught:
        write_mp4(noise, path, fps=16, width=128, height=128)
    assert "/" not in caught.value.detail
    assert Path("/dev/full").exists()
    assert not path.is_symlink()


def test_an_encoder_that_fails_names_no_path(tmp_path):
    wide = np.zeros((2, 40_000, 3), np.uint8)  # the encoder refuses this size
    for folder, frame in ((tmp_path / "absent", scene(0)), (tmp_path, wide)):
        with refused("internal-error") as caught:
            write_mp4([frame], folder / "clip.mp4", fps=16, width=frame.shape[1], height=frame.shape[0])
        assert str(tmp_path) not in caught.value.detail
        assert not (folder / "clip.mp4").exists()


def test_the_same_frames_give_the_same_bytes(tmp_path: Path) -> None:
    """Busy frames, encoded many times while memory is in use otherwise: an artifact is named by its bytes."""
    random = np.random.default_rng(0)
    frames = [random.integers(0, 60, (96, 160, 3), np.uint8) + np.uint8(4 * i) for i in range(17)]
    held, digests = [], set()
    for _ in range(20):
        held = [*held[-20:], random.integers(0, 255, random.integers(1, 200_000), np.uint8)]
        write_mp4(frames, tmp_path / "a.mp4", fps=16, width=160, height=96)
        digests.add((tmp_path / "a.mp4").read_bytes())
    assert len(digests) == 1


def parts(length: int) -> st.SearchStrategy[slice]:
    """Slices of something so long; some are empty."""
    return st.tuples(st.integers(0, length), st.integers(0, length)).map(lambda ends: slice(min(ends), max(ends)))


@given(st.lists(st.tuples(parts(12), parts(20)), max_size=6), st.integers(0, 2**32 - 1))
def test_what_has_changed_is_converted_as_the_whole_frame_would_be(changes, seed) -> None:
    generator = np.random.default_rng(seed)
    frame = generator.integers(0, 256, (12, 20, 3), np.uint8)
    frames = YuvFrames(12, 20)
    frames.converted(frame)
    for rows, columns in changes:
        frame = frame.copy()
        frame[rows, columns] = generator.integers(0, 256, 3)
        np.testing.assert_array_equal(frames.converted(frame), YuvFrames(12, 20).converted(frame))


@pytest.mark.parametrize(
    ("format", "size", "every", "times"),
    [("gif", (480, 120), 2, [80] * 7), ("webp", (480, 120), 1, [40] * 13), ("sheet", (1292, 248), None, None)],
)
def test_pictures_that_are_made_of_a_clip(path, format: str, size: tuple[int, int], every, times) -> None:
    levels = np.arange(10, 200, 15)
    write_mp4([np.full((160, 640, 3), level, np.uint8) for level in levels], path, fps=25, width=640, height=160)
    picture = Image.open(io.BytesIO(animation(path.read_bytes(), format)))
    assert picture.size == size
    if times is None:
        sheet = np.asarray(picture).astype(int)[..., 0]
        assert np.abs(sheet[40::84, 160::324].ravel() - np.delete(levels, 6)).max() < 4
        assert (sheet[80:84] == 255).all()
        return
    assert picture.info["loop"] == 0
    shown = ImageSequence.Iterator(picture)
    frames = [(frame.convert("L").getpixel((9, 9)), frame.info["duration"]) for frame in shown]
    assert [time for _, time in frames] == times
    assert np.abs(np.array([grey for grey, _ in frames]) - levels[::every]).max() < 20


def test_clips_are_decoded_in_many_threads_at_once(path: Path) -> None:
    """Each thread has its own frames, of clips of different sizes."""
    clips: list[bytes] = []
    for width in (64, 96, 128):
        write_mp4([scene(i, width) for i in range(12)], path, fps=16, width=width, height=64)
        clips.append(path.read_bytes())
    alone = [np.stack(frames_of(clip)[0]) for clip in clips]
    with ThreadPoolExecutor(6) as pool:
        together = list(pool.map(lambda clip: np.stack(frames_of(clip)[0]), clips * 8))
    assert all(np.array_equal(found, alone[i % 3]) for i, found in enumerate(together))
