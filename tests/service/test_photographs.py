"""Questions about pictures full of edges, with boxes given: what nothing in the picture decides is not sure."""

from __future__ import annotations

import base64
import re
import shlex
from pathlib import Path
from typing import Any

import pytest
from conftest import ROOT
from drawn import clutter, png_bytes
from typer.testing import CliRunner

from cow_service.cli.main import app
from cow_service.records import Outcome, Simulation
from cow_service.requests import SimulateRequest
from cow_service.service import Service
from cow_service.settings import Settings

pytestmark = pytest.mark.slow

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


def test_the_command_of_the_photograph_answers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """That of its README, and there is no answer without its boxes."""
    page = (ROOT / "examples" / "photographs" / "README.md").read_text()
    block = re.search(r"```sh\ncow (.*?)```", page, re.DOTALL)
    assert block is not None
    command, out = shlex.split(block[1].replace("\\\n", " ")), ["--no-video", "--out", str(tmp_path / "out")]
    monkeypatch.chdir(ROOT)
    environment = {"COW_DATA_DIR": str(tmp_path / "data"), "COW_READER": "embedded"}
    result = CliRunner().invoke(app, [*command, *out], env=environment)
    assert result.exit_code == 0, result.output
    outcome = Simulation.model_validate_json((tmp_path / "out" / "simulation.json").read_text()).trajectory.outcome
    assert outcome is not None
    assert outcome.sure
    assert outcome.probability == pytest.approx(0.91, abs=0.05)
    result = CliRunner().invoke(app, [*command[:3], *out], env=environment)
    assert result.exit_code == 1
    assert "cannot-ground" in result.output
