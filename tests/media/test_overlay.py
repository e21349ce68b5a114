"""What is drawn over the image: where it belongs, inside the image, and labels that keep clear of each other."""

from __future__ import annotations

import threading

import cv2
import numpy as np
import pytest
from drawn import floor
from hypothesis import given, settings
from hypothesis import strategies as st

from cow_service.media.overlay import (
    ARROW,
    DARK,
    ENCOUNTERS,
    LIGHT,
    OUTLINE,
    PATH,
    PLACED,
    PUSHED,
    REMOVED,
    Label,
    Replaced,
    draw_labels,
    draw_overlay,
    named_strip,
)
from cow_service.records import Grounding, Motion, Trajectory


def path(points, body: int = 0, spread: float = 0.0) -> dict:
    band = [(x - spread, y - spread, x + spread, y + spread) for x, y in points] if spread else []
    return {
        "body": body, "states": [(0, 0, 1, 0, 0, 0)] * len(points), "points": points, "visible": [True] * len(points),
        "scale": [1] * len(points), "tracks": [], "band": band,
    }  # fmt: skip


def drawn(image, paths, mask=None, times=1, direction=None, **rest) -> np.ndarray:
    """The overlay of an image whose places are `times` as far apart; the ball is at (80, 80) of the smallest."""
    box = (60 * times, 60 * times, 100 * times, 100 * times)
    grounding = Grounding(object="ball", point=(80 * times, 80 * times), bbox=box, source="request")
    motion = Motion.model_validate(
        {"kind": "static", "direction": direction, "cue": "request", "speed": 0, "sentence": "", "source": "request",
         "metres_per_pixel": {"value": 0.01, "source": "default"}}
    )  # fmt: skip
    lists = {name: rest.pop(name) for name in ("removed", "placed", "max_side") if name in rest}
    trajectory = Trajectory.model_validate({"fps": 16, "paths": paths, "anchors": []} | rest)
    return draw_overlay(image, grounding, motion, trajectory, mask, **lists)


def with_everything(image, times: int, max_side: int | None = None) -> np.ndarray:
    """Whatever can be drawn, `times` as large."""
    ys, xs = np.mgrid[: image.shape[0] // times, : image.shape[1] // times]

    def disc(x: float, y: float, radius: float) -> np.ndarray:
        return (np.hypot(xs - x, ys - y) < radius).repeat(times, axis=0).repeat(times, axis=1)

    def moved(*places: float) -> tuple[float, ...]:
        return tuple(times * each for each in places)

    one, other = ([moved(80 + 20 * i, y) for i in range(18)] for y in (80, 200))
    seen = path(one, spread=20 * times)
    seen["visible"] = [not 10 < i < 14 for i in range(18)]
    contacts = [{"a": 0, "b": None, "time": 0.2, "point": moved(300, 320), "impulse": 1},
                {"a": 0, "b": 1, "time": 0.3, "point": moved(400, 320), "impulse": 1}]  # fmt: skip
    box, cup = moved(500, 40, 560, 100), moved(500, 240, 560, 300)
    encounters = [{"object": "box", "bbox": box, "kind": "touches", "first_frame": 24, "probability": 0.93},
                  {"object": "cup", "bbox": cup, "kind": "occludes", "first_frame": 3, "time": 0.25}]  # fmt: skip
    put = Replaced(
        "can", "next to the cup", moved(80, 280, 120, 320), disc(100, 300, 20), moved(180, 280, 220, 320),
        disc(200, 300, 20),
    )  # fmt: skip
    return drawn(
        image, [seen, path(other, 1)], disc(80, 80, 15), times, (0.6, 0.8), contacts=contacts, encounters=encounters,
        removed=[("vase", moved(300, 130, 340, 170), disc(320, 150, 20))], placed=[put], max_side=max_side,
    )  # fmt: skip


SHOWN = {  # by colour: left, top, right and bottom (px) of its pixels, and how many have exactly that colour
    OUTLINE: (64, 48, 95, 95, 237),
    PATH: (237, 77, 402, 82, 44),
    ARROW: (83, 83, 137, 151, 258),
    PUSHED: (237, 197, 402, 202, 44),
    REMOVED: (300, 116, 355, 170, 321),
    PLACED: (80, 263, 301, 320, 678),
    LIGHT: (77, 77, 401, 325, 46),
    DARK: (60, 38, 639, 322, 10365),
    ENCOUNTERS["touches"]: (393, 109, 552, 325, 71),
    ENCOUNTERS["occludes"]: (496, 309, 625, 316, 16),
}


def test_everything_is_drawn_where_it_belongs_in_its_colour() -> None:
    image = np.full((400, 640, 3), 120, np.uint8)
    canvas = with_everything(image, 1)
    for colour, expected in SHOWN.items():
        ys, xs = np.nonzero((canvas == np.array(colour)).all(axis=2))
        assert (xs.min(), ys.min(), xs.max(), ys.max(), len(xs)) == pytest.approx(expected, rel=0.02, abs=1), colour
    assert canvas[68, 190].tolist() == pytest.approx([84, 152, 160], abs=2), "within the band, off the line"
    assert (canvas[110, 190] == image[110, 190]).all()


def test_of_a_large_picture_it_is_drawn_at_the_size_that_is_sent() -> None:
    large = np.repeat(np.repeat(floor(), 3, 0), 3, 1)
    canvas, expected = with_everything(large, 3, max_side=640), with_everything(floor(), 1)
    assert canvas.shape == expected.shape
    assert (np.abs(canvas.astype(int) - expected).max(axis=2) > 40).mean() < 0.001


def test_one_thread_writes_for_all(monkeypatch: pytest.MonkeyPatch) -> None:
    writers: set[int] = set()
    measure = cv2.getTextSize
    monkeypatch.setattr(cv2, "getTextSize", lambda *given: (writers.add(threading.get_ident()), measure(*given))[1])
    threads = [threading.Thread(target=drawn, args=(floor(), [path([(80, 80), (100, 80)])])) for _ in range(3)]
    for each in threads:
        each.start()
        each.join()
    assert len(writers) == 1


def test_a_wide_band_leaves_the_picture_to_be_seen() -> None:
    image = floor()
    across = [(200 + 20.0 * i, 200.0) for i in range(9)]
    change = np.abs(drawn(image, [path(across, spread=150)]).astype(int) - image).max(axis=2)
    assert 0 < change[100, 280] < 25  # inside, off the line
    assert change[48:54, 280].max() > 60  # at its edge
    assert change[20, 280] == 0
    narrow = np.abs(drawn(image, [path(across, spread=15)]).astype(int) - image).max(axis=2)
    assert narrow[190, 290] > 40


def test_a_box_is_drawn_where_no_outline_is_known() -> None:
    canvas = drawn(floor(), [path([(80, 80)] * 2)])
    for y, x in ((60, 80), (100, 80), (80, 60), (80, 100)):
        assert np.abs(canvas[y, x].astype(int) - OUTLINE).max() < 30


@settings(max_examples=25, deadline=None)
@given(
    st.sampled_from([(320, 180), (640, 400), (1500, 1000)]),
    st.lists(st.tuples(st.floats(-0.2, 1), st.floats(-0.2, 1), st.integers(1, 40)), max_size=5),
)
def test_labels_stay_inside_and_apart(size: tuple[int, int], given_labels) -> None:
    width, height = size
    labels = [
        Label("x" * letters, (x * width, y * height, x * width + 40, y * height + 30), (255, 255, 255), below=True)
        for x, y, letters in given_labels
    ]
    canvas = np.zeros((height, width, 3), np.uint8)
    plates = draw_labels(canvas, labels, max(1.0, max(size) / 640), (20, 20, 20))
    for i, (x0, y0, x1, y1) in enumerate(plates):
        assert 0 <= x0 < x1 <= width
        assert 0 <= y0 < y1 <= height
        assert all(x1 <= a or c <= x0 or y1 <= b or d <= y0 for a, b, c, d in plates[:i])


@pytest.mark.parametrize("side", [1, 20, 1600])
def test_any_size_can_be_drawn_on(side: int) -> None:
    image = np.full((side, side, 3), 120, np.uint8)
    encounters = [{"object": "cube", "bbox": (0, 0, 10, 10), "kind": "touches", "first_frame": 3, "probability": 0.93}]
    far = path([(80.0, 80.0), (1e7, -1e7)], spread=1e6)
    assert drawn(image, [far], encounters=encounters).shape == image.shape


def test_a_strip_of_frames_is_named_above_them() -> None:
    strip = named_strip([np.full((60, 90, 3), level, np.uint8) for level in (50, 100, 150, 200)], "before")
    assert strip.shape == (26 + 60 + 6 + 60, 90 + 6 + 90 + 6 + 90, 3)
    assert strip[26:, :, 0][[0, 59, 66, 125]][:, [0, 96, 192]].tolist() == [[50, 100, 150]] * 2 + [[200, 20, 20]] * 2
    assert strip[:26].max() > 200 > 60 > strip[:26, 100:].max()
