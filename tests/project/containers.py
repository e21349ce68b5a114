"""The container files as values, and what their commands and environments mean to the real program."""

from __future__ import annotations

import os
import re
import shlex
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import typer
from conftest import ROOT

from cow_service.cli.main import app
from cow_service.jobs.engine import HANDOVER_SECONDS
from cow_service.server import CLOSE_SECONDS
from cow_service.settings import Settings, load_settings

DOCKER = ROOT / "docker"
IMAGES = {"cow:cpu": DOCKER / "cpu.Dockerfile", "cow:cuda": DOCKER / "cuda.Dockerfile"}


class Instruction(NamedTuple):
    stage: int  # 0 before the first FROM
    word: str
    text: str


def instructions(dockerfile: Path) -> list[Instruction]:
    lines = [line for line in dockerfile.read_text().splitlines() if not line.lstrip().startswith("#")]
    stage, found = 0, []
    for line in "\n".join(lines).replace("\\\n", " ").splitlines():
        if line.strip():
            word, _, text = line.strip().partition(" ")
            stage += word == "FROM"
            found.append(Instruction(stage, word, text.strip()))
    return found


def texts(dockerfile: Path, word: str) -> list[str]:
    """What follows a word in the last stage, the only one that becomes the image."""
    all_of_it = instructions(dockerfile)
    return [text for stage, found, text in all_of_it if found == word and stage == all_of_it[-1].stage]


def pairs(dockerfile: Path, word: str) -> dict[str, str]:
    return dict(pair.split("=", 1) for text in texts(dockerfile, word) for pair in shlex.split(text))


def check_cow(arguments: list[str]) -> None:
    """Has the real command line read a command, without running it. It raises for what it does not know."""
    command: Any = typer.main.get_command(app)
    while (known := getattr(command, "commands", None)) is not None:
        assert arguments, "a group of commands needs one of them"
        assert arguments[0] in known, arguments
        command, arguments = known[arguments[0]], arguments[1:]
    command.make_context(command.name, list(arguments))


def check_settings(monkeypatch: pytest.MonkeyPatch, given: dict[str, str]) -> Settings:
    """The settings that an environment makes. Each must be one, and have a value that it takes."""
    ours = {name: value for name, value in given.items() if name.startswith("COW_")}
    assert {name.removeprefix("COW_").lower() for name in ours} <= set(Settings.model_fields)
    for name in [name for name in os.environ if name.startswith("COW_")]:
        monkeypatch.delenv(name)
    for name, value in ours.items():
        monkeypatch.setenv(name, value)
    return load_settings()


def longest_stop(settings: Settings) -> float:
    """Seconds: open connections, then jobs, each with the grace and what is added to it."""
    return 2 * settings.shutdown_grace + CLOSE_SECONDS + HANDOVER_SECONDS


def seconds(duration: str) -> float:
    units = {"h": 3600, "m": 60, "s": 1, "ms": 0.001}
    return sum(float(number) * units[unit] for number, unit in re.findall(r"(\d+)(ms|h|m|s)", duration))
