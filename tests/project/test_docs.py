"""Every command and every program in README.md and docs/, run as it stands there, in a copy of the checkout.

What stands in for the world outside: a hub with toy weights (HF_ENDPOINT), `docker` (nothing here can run it: what it
is told is checked), and wheels that need not be downloaded again. Port 8000 becomes one that is free.
"""

from __future__ import annotations

import os
import re
import shutil
import signal
import socket
import stat
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx
import pytest
import yaml
from conftest import EXAMPLES, ROOT, SCALE
from hub import Blob
from hub import running as hub_running
from waiting import TIME_LIMIT, eventually

# Those whose commands take longest: they are run by `make soak`.
LONG_PAGES = tuple(
    f"docs/{name}.md" for name in ("agents", "benchmark", "extending", "mllm", "photographs", "sdk", "video")
)  # the command of photographs.md is run by service/test_photographs.py, too
PAGES = ("README.md", *sorted(f"docs/{path.name}" for path in (ROOT / "docs").glob("*.md")))
# Their commands need an MLLM: readers/test_server_pages.py sets a stand-in up as they say.
SERVER_PAGES = tuple(sorted(f"docs/servers/{path.name}" for path in (ROOT / "docs" / "servers").glob("*.md")))
LANGUAGES = {"sh", "python", "toml", "yaml", "json", "text"}
BLOCK = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
SERVE = re.compile(r"(^|\s)(cow serve|make serve|cow mcp --transport)\b")
NEEDS_A_GPU = "COW_GENERATOR=ati"
RUN = ("python", "sh")  # the languages of blocks that do something
HARNESS = "inspect_ai"  # its commands are run by `make soak`
DOCKER = """#!/bin/sh
echo "$@" >> "$DOCKER_ASKED"
"""
PIP = """#!/bin/sh
# Downloads, and installs from them, are not done; the project is installed already.
case " $* " in
  *" download "*|*" --no-index "*|*" -e ."*) ;;
  *) exec python -m pip "$@" ;;
esac
"""


@dataclass(frozen=True)
class Block:
    """A fenced block of a page."""

    page: str
    language: str
    text: str


def blocks(page: str, until: str | None = None) -> list[Block]:
    text = (ROOT / page).read_text()
    return [Block(page, *found) for found in BLOCK.findall(text if until is None else text[: text.index(until)])]


@dataclass
class Checkout:
    """A copy of the project in which readers would work, and how commands are run in it."""

    folder: Path
    environment: dict[str, str]
    port: int
    server: ExitStack = field(default_factory=ExitStack)  # of the programs and commands that start none themselves
    is_serving: bool = False
    is_refused: bool = False  # what needs a GPU was

    def serve(self) -> None:
        """Sees to it that `cow serve` runs."""
        if not self.is_serving:
            self.server.enter_context(self.serving("cow serve"))
            self.is_serving = True

    def stop(self) -> None:
        self.server.close()
        self.is_serving = False

    def adapted(self, text: str) -> str:
        return text.replace("127.0.0.1:8000", f"127.0.0.1:{self.port}")

    def run(self, script: str) -> subprocess.CompletedProcess[str]:
        shell = ["bash", "-euo", "pipefail", "-c", self.adapted(script)]
        pipes: dict[str, Any] = {"capture_output": True, "text": True, "stdin": subprocess.DEVNULL}
        return subprocess.run(shell, cwd=self.folder, env=self.environment, check=False, **pipes)

    @contextmanager
    def serving(self, command: str) -> Iterator[None]:
        """A command that serves, until the block is over; then it must end in peace."""
        shell = ["bash", "-c", f"exec env {command}"]
        with subprocess.Popen(shell, cwd=self.folder, env=self.environment, start_new_session=True) as process:

            def is_ready() -> bool:
                assert process.poll() is None, f"{command} ended with {process.returncode}"
                return self.answers(command)

            try:
                eventually(is_ready)
                yield
            finally:
                os.killpg(process.pid, signal.SIGTERM)
                process.wait(TIME_LIMIT)

    def answers(self, command: str) -> bool:
        if port := re.search(r"--port (\d+)", command):
            with socket.socket() as probe:
                return probe.connect_ex(("127.0.0.1", int(port[1]))) == 0
        try:
            return httpx.get(f"http://127.0.0.1:{self.port}/readyz", timeout=TIME_LIMIT).status_code == 200
        except httpx.HTTPError:
            return False


def copied(folder: Path) -> None:
    """What a clone would have, changes that are not committed included; and what Python has compiled of it."""
    listed = subprocess.run(
        ["git", "ls-files", "-co", "--exclude-standard", "-z"], cwd=ROOT, capture_output=True, text=True, check=True
    )
    compiled = (path.relative_to(ROOT) for path in (ROOT / "cow_service").rglob("*.pyc"))
    for name in (*filter(None, listed.stdout.split("\0")), *compiled):
        if (ROOT / name).is_file():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, folder / name)


def toy_weights() -> dict[str, dict[str, Blob]]:
    """A few bytes for every file that `cow models pull ati` would bring."""
    manifest = yaml.safe_load((ROOT / "models" / "ati.yaml").read_text())

    def file_of(pattern: str) -> str:
        return pattern.replace("/*", "/config.json").replace("*.safetensors*", "-00001.safetensors").replace("*", "x")

    sources = manifest["sources"].values()
    return {one["repository"]: {file_of(pattern): Blob(b"{}") for pattern in one["files"]} for one in sources}


@pytest.fixture(scope="module")
def checkout(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Checkout]:
    folder = tmp_path_factory.mktemp("checkout") / "cow"
    copied(folder)
    aside = folder.parent
    standins = aside / "bin"
    standins.mkdir()
    for name, text in (("docker", DOCKER), ("pip", PIP)):
        (standins / name).write_text(text)
        (standins / name).chmod((standins / name).stat().st_mode | stat.S_IXUSR)
    shutil.copy(EXAMPLES / "falling-ball" / "image.jpg", folder / "photo.jpg")
    venv = folder / ".venv" / "bin"
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    environment = {name: value for name, value in os.environ.items() if not name.startswith(("COW_", "PYTHON"))}
    environment |= {
        "PATH": f"{standins}:{venv}:{environment['PATH']}",
        "VIRTUAL_ENV": str(folder / ".venv"),
        "COW_DATA_DIR": str(aside / "data"),
        "COW_PORT": str(port),
        "COW_BASE_URL": f"http://127.0.0.1:{port}",
        "DOCKER_ASKED": str(aside / "docker-asked"),
        # Servers compute in their own process, from the first question on: workers take longer to start than all else.
        "COW_WORKERS": "false",
        "COW_WARMUP": "false",
        # All packages are here already: pip only sets up the project, with the build backend of the tests.
        "PIP_NO_DEPS": "1",
        "PIP_NO_BUILD_ISOLATION": "0",  # 0 is what turns the isolation off
    }
    with ExitStack() as stack:
        hub = stack.enter_context(hub_running())
        for repository, files in toy_weights().items():
            hub.commit(repository, files)
        environment["HF_ENDPOINT"] = hub.address
        checkout = Checkout(folder, environment, port)
        # The packages that the tests run with, pip among them: test_wheel.py installs those of the project anew.
        subprocess.run([sys.executable, "-m", "venv", "--without-pip", folder / ".venv"], check=True)
        (packages,) = (folder / ".venv" / "lib").glob("python*/site-packages")
        here = [path for path in sys.path if path.endswith("site-packages")]
        (packages / "already-here.pth").write_text("\n".join(here) + "\n")
        # As `make demo` does it. A page's commands must work wherever a reader begins, so no page rests on another's.
        installed = checkout.run("make .venv/.base")
        assert installed.returncode == 0, installed.stderr
        yield checkout
        checkout.stop()


def test_every_block_has_a_language_that_is_known() -> None:
    assert len(PAGES) == 24
    found = {block.language for page in PAGES + SERVER_PAGES for block in blocks(page)}
    assert found <= LANGUAGES
    # What stands outside of a block would not be run.
    outside = "".join(BLOCK.sub("", (ROOT / page).read_text()) for page in PAGES)
    assert not re.search(r"^ {4}(cow|curl|pip|make|docker|python3?) ", outside, re.MULTILINE)


def test_links_lead_somewhere() -> None:
    def anchors(path: Path) -> set[str]:
        headings = re.findall(r"^#+ (.+)$", path.read_text(), re.MULTILINE)
        return {re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in headings}

    for page in PAGES + SERVER_PAGES:
        path = ROOT / page
        for target in re.findall(r"\]\(([^)\s]+)\)", path.read_text()):
            if not target.startswith("http"):
                name, _, anchor = target.partition("#")
                led = (path.parent / name).resolve() if name else path
                assert led.exists(), f"{page}: {target}"
                assert not anchor or anchor in anchors(led), f"{page}: {target}"


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize(
    "page",
    [
        pytest.param(page, marks=pytest.mark.soak) if page in LONG_PAGES else page
        for page in PAGES
        if any(block.language in RUN for block in blocks(page))
    ],
)
def test_commands_and_programs_run_as_they_stand_there(checkout: Checkout, page: str) -> None:
    ran = 0
    # On every change, the README's first minute.
    until = "## Run it for real" if page == "README.md" and SCALE == 1 else None
    for number, block in enumerate(blocks(page, until)):
        head = block.text.partition("\n")[0]
        if block.language in ("toml", "yaml", "python") and re.fullmatch(r"# \S*\.\S*", head):
            path = checkout.folder / head[2:]
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(block.text)
        elif block.language == "python":
            program = checkout.folder / f"block{number}.py"
            program.write_text(checkout.adapted(block.text))
            checkout.serve()
            succeeded(checkout.run(f"python -W error::DeprecationWarning {program.name}"), block.text)
            ran += 1
        elif block.language == "sh" and (HARNESS not in block.text or SCALE > 1):
            run_commands(checkout, block.text)
            ran += 1
    assert ran


def run_commands(checkout: Checkout, text: str) -> None:
    """The commands of a block, in order; one that serves goes on behind those that follow it."""
    with ExitStack() as running:
        serves = False
        for part in parts(text):
            if NEEDS_A_GPU in part:
                if checkout.is_refused:
                    continue  # as on another page
                checkout.is_refused = True
                checkout.stop()
                refused = checkout.run(part)  # here, a GPU and the real weights are what is missing
                assert refused.returncode != 0
                assert re.search("checkpoint-invalid|generator-unavailable|weights-unavailable", refused.stderr)
            elif SERVE.search(part):
                checkout.stop()
                running.close()
                running.enter_context(checkout.serving(part))
                serves = True
            else:
                if not serves and ("127.0.0.1:8000" in part or "cow batch" in part):
                    checkout.serve()
                succeeded(checkout.run(part), part)


def parts(text: str) -> list[str]:
    """The lines of a block, those between two that serve together; without comments behind them."""
    found = [""]
    for line in text.splitlines():
        command = line.partition("  #")[0].rstrip()
        if SERVE.search(command):
            found += [command, ""]
        else:
            found[-1] += command + "\n"
    return [part for part in found if part.strip()]


def succeeded(result: subprocess.CompletedProcess[str], what: str) -> None:
    assert result.returncode == 0, f"{what}\n{result.stdout[-3000:]}\n{result.stderr[-3000:]}"
    assert '"type":"urn:cow:problem' not in result.stdout.replace(" ", ""), f"{what}\n{result.stdout}"


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_what_docker_and_pip_are_told_exists(checkout: Checkout) -> None:
    """Docker's stand-in records its arguments."""
    run_commands(checkout, "\n".join(one.text for one in blocks("docs/production.md") if "docker " in one.text))
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    shown = [block.text for page in PAGES for block in blocks(page) if block.language == "sh"]
    named = {name for found in re.findall(r"\.\[([\w,]+)\]", "\n".join(shown)) for name in found.split(",")}
    assert {"wan", "providers"} <= named <= set(extras)
    asked = Path(checkout.environment["DOCKER_ASKED"]).read_text().splitlines()
    compose = yaml.safe_load((ROOT / "docker" / "compose.yaml").read_text())
    for line in asked:
        words = line.split()
        assert words[:3] == ["compose", "-f", "docker/compose.yaml"]
        profiles = {profile for service in compose["services"].values() for profile in service.get("profiles", ())}
        for name in words[3:]:
            known = {"up", "--build", "--profile", "down", *compose["services"], *profiles}
            assert name in known, line
