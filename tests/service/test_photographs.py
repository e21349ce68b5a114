"""The command that the README of our photograph gives."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest
from conftest import ROOT
from typer.testing import CliRunner

from cow_service.cli.main import app
from cow_service.records import Simulation

pytestmark = pytest.mark.slow


def test_the_command_of_the_photograph_answers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """And there is no answer without its boxes."""
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
