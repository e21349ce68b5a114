"""Questions about pictures full of edges, with boxes given: what nothing in the picture decides is not sure."""

from __future__ import annotations

import base64
from pathlib import Path
from typing import Any

import pytest
from drawn import clutter, png_bytes

from cow_service.records import Outcome
from cow_service.requests import SimulateRequest
from cow_service.service import Service
from cow_service.settings import Settings

Boxes = dict[str, tuple[int, int, int, int]]
IMAGE = "data:image/png;base64," + base64.b64encode(png_bytes(clutter(640, 400))).decode()


def ask(folder: Path, question: str, boxes: Boxes) -> Outcome:
    things: list[dict[str, Any]] = [{"object": name, "bbox": box} for name, box in boxes.items()]
    body = {"image": IMAGE, "question": question, "grounding": things[0], "objects": things[1:], "video": False}
    with Service(Settings(data_dir=folder, reader="embedded")) as service:
        outcome = service.simulate(SimulateRequest.model_validate(body)).trajectory.outcome
    assert outcome is not None
    return outcome


@pytest.mark.parametrize("question", ["fall off the tray", "stay on the tray"])
def test_what_is_asked_to_fall_off_a_thing_stands_on_it(tmp_path: Path, question: str) -> None:
    boxes: Boxes = {"cup": (280, 120, 360, 290), "tray": (180, 180, 460, 300)}
    assert ask(tmp_path, f"If the cup slides to the left, will it {question}?", boxes).probability is not None


def test_what_stands_in_a_shelf_is_not_surely_beside_what_stands_before_it(tmp_path: Path) -> None:
    boxes: Boxes = {"bin": (420, 180, 500, 250), "bike": (100, 100, 380, 360), "shelf": (300, 20, 600, 290)}
    outcome = ask(tmp_path, "If the bin slides to the left, will it hit the bike?", boxes)
    assert outcome.probability is not None
    assert 0.2 < outcome.probability < 0.8
    assert "place" in outcome.depends_on
