"""What is drawn over the image: where it belongs, inside the image, and labels that keep clear of each other."""

from __future__ import annotations

import threading

import cv2
import numpy as np
import pytest
from drawn import floor
from hypothesis import given, settings
from hypothesis import strategies as st

from cow_service.media.overlay import ENCOUNTERS, OUTLINE, PATH, PUSHED, Label, draw_labels, draw_overlay
from cow_service.records import Grounding, Motion, Trajectory

MOTION = Motion.model_validate(
    {"kind": "static", "direction": None, "cue": "request", "speed": 0, "sentence": "", "source": "request",
     "metres_per_pixel": {"value": 0.01, "source": "default"}}
)  # fmt: skip


def path(points, body: int = 0, spread: float = 0.0) -> dict:
    band = [(x - spread, y - spread, x + spread, y + spread) for x, y in points] if spread else []
    return {
        "body": body, "states": [(0, 0, 1, 0, 0, 0)] * len(points), "points": points, "visible": [True] * len(points),
        "scale": [1] * len(points), "tracks": [], "band": band,
    }  # fmt: skip


def drawn(image, paths, mask=None, times=1, max_side=None, **rest) -> np.ndarray:
    box = (60 * times, 60 * times, 100 * times, 100 * times)
    grounding = Grounding(object="ball", point=(80 * times, 80 * times), bbox=box, source="request")
    trajectory = Trajectory.model_validate({"fps": 16, "paths": paths, "anchors": []} | rest)
    return draw_overlay(image, grounding, MOTION, trajectory, mask, max_side=max_side)


def near(canvas, colour, x: float, y: float, reach: int = 4) -> bool:
    part = canvas[round(y) - reach : round(y) + reach, round(x) - reach : round(x) + reach].astype(int)
    return bool((np.abs(part - np.array(colour)).max(axis=2) < 30).any())


def test_every_path_its_band_and_the_contacts_are_drawn() -> None:
    image = floor()
    one, other = [(80 + 20.0 * i, 80.0) for i in range(9)], [(240 + 20.0 * i, 200.0) for i in range(9)]
    contacts = [{"a": 0, "b": None, "time": 0.2, "point": (300, 320), "impulse": 1},
                {"a": 0, "b": 1, "time": 0.3, "point": (400, 320), "impulse": 1}]  # fmt: skip
    canvas = drawn(image, [path(one, spread=20), path(other, 1)], contacts=contacts)
    assert near(canvas, PATH, 240, 80)
    assert near(canvas, PUSHED, 400, 200)
    change = canvas[68, 190].astype(int) - image[68, 190]  # within the band, off the line
    assert change[2] > 15
    assert change[0] < -15
    assert (canvas[110, 190] == image[110, 190]).all()
    assert near(canvas, (255, 255, 255), 300, 324)
    assert near(canvas, ENCOUNTERS["touches"], 400, 320, 8)
    assert not near(canvas, ENCOUNTERS["touches"], 300, 320, 8)


def test_of_a_large_picture_it_is_drawn_at_the_size_that_is_sent() -> None:
    ys, xs = np.mgrid[:1200, :1920]
    mask = np.hypot(xs - 240, ys - 240) < 45
    one = [(240 + 60.0 * i, 240.0) for i in range(9)]
    contacts = [{"a": 0, "b": None, "time": 0.2, "point": (900, 960), "impulse": 1}]
    large = np.repeat(np.repeat(floor(), 3, 0), 3, 1)
    canvas = drawn(large, [path(one, spread=60)], mask, times=3, max_side=640, contacts=contacts)
    small, contacts[0]["point"] = [(80 + 20.0 * i, 80.0) for i in range(9)], (300, 320)
    expected = drawn(floor(), [path(small, spread=20)], mask[1::3, 1::3], contacts=contacts)
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


def test_the_outline_takes_the_place_of_the_box() -> None:
    ys, xs = np.mgrid[:400, :640]
    mask = np.hypot(xs - 80, ys - 80) < 15
    inside = drawn(floor(), [path([(80, 80)] * 2)], mask)
    assert near(inside, OUTLINE, 80, 95)
    assert not near(inside, OUTLINE, 60, 90)
    assert near(drawn(floor(), [path([(80, 80)] * 2)]), OUTLINE, 60, 90)


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


@pytest.mark.parametrize("side", [1, 20, 320, 4000])
def test_any_size_can_be_drawn_on(side: int) -> None:
    image = np.full((side, side, 3), 120, np.uint8)
    encounters = [{"object": "cube", "bbox": (0, 0, 10, 10), "kind": "touches", "first_frame": 3, "probability": 0.93}]
    far = path([(80.0, 80.0), (1e7, -1e7)], spread=1e6)
    assert drawn(image, [far], encounters=encounters).shape == image.shape
