"""Commands on our pictures: the one that the README of our photograph gives, and an answer that imagines if it must."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest
from conftest import EXAMPLES, ROOT
from mllm_server import mllm_server
from typer.testing import CliRunner

from cow_service.cli.main import app
from cow_service.records import Answer, Simulation

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


def test_an_answer_imagines_only_where_the_image_alone_does_not_tell(tmp_path: Path) -> None:
    asked = [str(EXAMPLES / "ball-and-mug" / "image.jpg"), "Does the ball hit the mug? (A) Yes (B) No"]
    command = ["answer", *asked, "--imagine", "auto", "--imagine-votes", "2", "--imagine-threshold", "0.6", "--json"]
    with mllm_server() as mllm:
        mllm.say('{"answer": "A"}')
        own = {"COW_DATA_DIR": str(tmp_path), "COW_READER": "mllm"}
        told = CliRunner().invoke(
            app, command, env=own | {"COW_MLLM": "qwen3-vl-8b", "COW_MLLM_BASE_URL": mllm.address}
        )
    assert told.exit_code == 0, told.output
    answer = Answer.model_validate_json(told.stdout)
    assert (answer.answer, answer.simulation) == ("A", None)
    assert answer.gate is not None
    assert (answer.gate.threshold, answer.gate.votes, answer.gate.imagined) == (0.6, {"A": 2}, False)
