"""Shared fixtures: examples with known truth, a service on an empty data folder, a real server process, a wheel.

The tests run in several processes (pytest-xdist). Each has its own servers, data folders and temporary files; what is
expensive and the same for all is made by the first process that needs it (`made_once`).
"""

from __future__ import annotations

import json
import os

if "PYTEST_XDIST_WORKER" in os.environ:
    # One thread per process: those of torch and OpenCV would compete for the same cores. Must precede their import.
    os.environ.setdefault("OMP_NUM_THREADS", "1")

import re
import shutil
import signal
import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import date
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any
from zlib import crc32

import cv2
import httpx
import numpy as np
import pytest
from filelock import FileLock
from hypothesis import settings
from numpy.typing import NDArray
from waiting import TIME_LIMIT, eventually

from cow_service.service import Service
from cow_service.settings import Settings

if TYPE_CHECKING:  # other tests do not need a browser
    from browser import Windows
    from playwright.sync_api import Browser

# A shell lets what it runs in the background ignore interrupts, and its children do as well: tests interrupt some.
signal.signal(signal.SIGINT, signal.default_int_handler)
# How much the chaos, fuzz and property tests do: 1 in CI, 10 in `make soak`.
SCALE = int(os.environ.get("COW_TEST_SCALE", "1"))
settings.register_profile("cow", deadline=None, derandomize=True, database=None, max_examples=12 * SCALE)
settings.load_profile("cow")

TESTS = Path(__file__).resolve().parent
ROOT = TESTS.parent
DATA = TESTS / "data"
EXAMPLES = ROOT / "examples"
SHARED_SCENES = ROOT.parent / "shared" / "scenes"
# The longest files: begun last, they would keep one process alone at work.
FIRST = (
    "test_docs.py",
    "test_evals_run.py",
    "test_chaos.py",
    "test_jobs.py",
    "test_page.py",
    "test_ray.py",
    "test_slow_starts.py",
    "test_workers.py",
)
SLOWEST = 10  # files that are listed at the end


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


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--part", metavar="K/N", help="run the K-th of N parts of the chosen tests, the first being 0")


@pytest.hookimpl(tryfirst=True)  # before pytest deselects by markers
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    for item in items:
        if getattr(getattr(item, "obj", None), "is_hypothesis_test", False):
            item.add_marker(pytest.mark.scaled)
    if part := config.getoption("--part"):
        number, count = map(int, part.split("/"))
        kept = [item for item in items if crc32(item.nodeid.encode()) % count == number]
        config.hook.pytest_deselected(items=[item for item in items if item not in kept])
        items[:] = kept
        # In another order each day: what comes last may not be reached.
        items.sort(key=lambda item: crc32(f"{date.today()} {item.path.name}".encode()))
        return
    items.sort(key=lambda item: FIRST.index(item.path.name) if item.path.name in FIRST else len(FIRST))


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """The files that took longest."""
    seconds: Counter[str] = Counter()
    for report in (one for reports in terminalreporter.stats.values() for one in reports):
        if isinstance(report, pytest.TestReport):
            seconds[report.location[0]] += report.duration
    terminalreporter.section("slowest files")
    for name, spent in seconds.most_common(SLOWEST):
        terminalreporter.line(f"{spent:6.1f} s  {name}")


def made_once(factory: pytest.TempPathFactory, name: str, make: Callable[[Path], None]) -> Path:
    """A folder that the first process to ask for it fills by calling `make`; the others wait, and share it."""
    base = factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / name
    done = folder / ".done"
    with FileLock(f"{folder}.lock"):
        if not done.exists():
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir()
            make(folder)
            done.touch()
    return folder


@pytest.fixture(scope="session")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The project's wheel, built from this checkout."""

    def build(folder: Path) -> None:
        command = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(folder), str(ROOT)]
        subprocess.run(command, check=True, capture_output=True)

    (built,) = made_once(tmp_path_factory, "wheel", build).glob("*.whl")
    return built


def new_environment(folder: Path, *packages: str | Path) -> Path:
    """A virtual environment with nothing but these packages and what they need; returns its folder of programs."""
    # Installed by the pip of the tests and not compiled beforehand: a new pip and unused bytecode take half the time.
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", folder], check=True)
    pip = [sys.executable, "-m", "pip", "--python", str(folder / "bin" / "python"), "install", "--quiet"]
    subprocess.run([*pip, "--no-compile", "--disable-pip-version-check", *packages], check=True)
    return folder / "bin"


@pytest.fixture
def service(tmp_path: Path) -> Service:
    return Service(Settings(data_dir=tmp_path / "data"))


@dataclass(frozen=True)
class Server:
    process: subprocess.Popen[bytes]
    address: str
    data: Path


@pytest.fixture(scope="session")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """A real `cow serve` in its own process."""
    data = tmp_path_factory.mktemp("server")
    environment = {name: value for name, value in os.environ.items() if not name.startswith("COW_")}
    environment |= {"COW_DATA_DIR": str(data), "COW_MAX_BODY_MB": "3", "COW_WARMUP": "false"}
    command = [sys.executable, "-m", "cow_service.cli.main", "serve", "--port", "0"]
    log = data / "log"

    def address() -> str | None:
        assert process.poll() is None, log.read_text()
        found = re.search(r"running on (http://\S+)", log.read_text())
        return found and found[1]

    with log.open("w") as file, subprocess.Popen(command, env=environment, stdout=file, stderr=file) as process:
        yield Server(process, eventually(address), data)
        process.terminate()


@pytest.fixture
def http(server: Server) -> Iterator[httpx.Client]:
    with httpx.Client(base_url=server.address, timeout=TIME_LIMIT) as client:
        yield client


@pytest.fixture(scope="module")
def chromium() -> Iterator[Browser]:
    """A browser for the tests of one file: while it runs, playwright's event loop is that of the main thread."""
    from browser import launched

    with launched() as browser:
        yield browser


@pytest.fixture
def windows(chromium: Browser) -> Iterator[Windows]:
    """Opens pages; errors in them fail the test."""
    from browser import Windows

    with Windows(chromium) as opened:
        yield opened
