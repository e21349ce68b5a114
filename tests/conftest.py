"""Shared fixtures: examples with known truth, a service on an empty data folder, a real server process."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import httpx
import numpy as np
import pytest
from hypothesis import settings
from numpy.typing import NDArray

from cow_service.service import Service
from cow_service.settings import Settings

settings.register_profile("cow", deadline=None, derandomize=True)
settings.load_profile("cow")

ROOT = Path(__file__).resolve().parents[1]
EXAMPLES = ROOT / "examples"
SHARED_SCENES = ROOT.parent / "shared" / "scenes"


@dataclass(frozen=True)
class Example:
    """A scene with known truth: image, the same without the drawn arrow, object ids, and what really happens."""

    folder: Path

    @property
    def meta(self) -> dict[str, Any]:
        return _meta(self.folder)

    @property
    def image(self) -> bytes:
        return (self.folder / "image.jpg").read_bytes()

    def pixels(self, name: str) -> NDArray[np.uint8]:
        return np.ascontiguousarray(cv2.imread(str(self.folder / name))[..., ::-1])

    def mask(self, name: str) -> NDArray[np.bool_]:
        ids = cv2.imread(str(self.folder / "ids.png"), cv2.IMREAD_UNCHANGED)
        return ids == self.meta["id_of"][name]


@cache
def _meta(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "meta.json").read_text())


def example(name: str) -> Example:
    return Example(EXAMPLES / name)


def all_scenes() -> list[Path]:
    """Our own examples, and the larger shared set where it is at hand."""
    folders = sorted(path.parent for path in EXAMPLES.glob("*/meta.json"))
    return folders + sorted(path.parent for path in SHARED_SCENES.glob("*/meta.json"))


@pytest.fixture
def service(tmp_path: Path) -> Service:
    return Service(Settings(data_dir=tmp_path / "data"))


@dataclass(frozen=True)
class Server:
    process: subprocess.Popen[str]
    address: str
    data: Path


@pytest.fixture(scope="session")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """A real `cow serve` in its own process."""
    data = tmp_path_factory.mktemp("server")
    environment = os.environ | {"COW_DATA_DIR": str(data), "COW_MAX_BODY_MB": "3"}
    command = [sys.executable, "-m", "cow_service.cli.main", "serve", "--port", "0"]
    log = (data / "log").open("w")
    with subprocess.Popen(command, env=environment, stdout=log, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        lines = iter(process.stderr.readline, "")
        address = next(line.split("running on ")[1].split()[0] for line in lines if "running on" in line)
        yield Server(process, address, data)
        process.terminate()
        process.stderr.read()
    log.close()


@pytest.fixture
def http(server: Server) -> Iterator[httpx.Client]:
    with httpx.Client(base_url=server.address, timeout=60) as client:
        yield client
