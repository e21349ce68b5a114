"""The rules of the house: who may import whom, what stays light, how long a file may be."""

from __future__ import annotations

import ast
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "cow_service"
MAX_LINES = 400

HEAVY = ("torch", "transformers", "diffusers", "accelerate")


@cache
def modules() -> dict[str, Path]:
    names = {}
    for path in PACKAGE.rglob("*.py"):
        parts = path.relative_to(PACKAGE).with_suffix("").parts
        names[".".join(parts[:-1] if parts[-1] == "__init__" and len(parts) > 1 else parts)] = path
    return names


@cache
def imports(path: Path) -> set[str]:
    """Names inside the package that a file imports, lazily or for types only included."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path.name} imports relatively, which this test does not follow"
            if node.module == "cow_service" or (node.module or "").startswith("cow_service."):
                room = (node.module or "").removeprefix("cow_service").lstrip(".")
                names = {f"{room}.{alias.name}".lstrip(".") for alias in node.names}
                found |= {name for name in names if name in modules()} or ({room} if room else set())
        if isinstance(node, ast.Import):
            names = {alias.name for alias in node.names}
            found |= {name.removeprefix("cow_service.") for name in names if name.startswith("cow_service.")}
    return found


def test_no_circles() -> None:
    graph = {name: {i for i in imports(path) if i in modules()} for name, path in modules().items()}
    done: set[str] = set()

    def visit(name: str, way: tuple[str, ...]) -> None:
        assert name not in way, f"circle: {' -> '.join((*way, name))}"
        if name not in done:
            for other in graph[name]:
                visit(other, (*way, name))
            done.add(name)

    for name in graph:
        visit(name, ())


def test_stages_and_pipeline_know_no_implementation() -> None:
    for name, path in modules().items():
        if name.startswith("stages.") or name == "pipeline":
            backends = {i for i in imports(path) if i.startswith(("readers.", "generators."))}
            assert backends <= {
                "readers.base",
                "readers.question.wording",
                "readers.question.choices",
                "generators.base",
            }, name


@pytest.mark.parametrize("name", sorted(modules()))
def test_files_stay_small(name: str) -> None:
    assert len(modules()[name].read_text().splitlines()) <= MAX_LINES


@pytest.mark.parametrize(
    "statement",
    [
        "import cow_service",
        "import cow_service.cli.main",
        "from cow_service.api.app import create_app; from cow_service.service import Service; "
        "from cow_service.jobs.engine import JobEngine; from cow_service.settings import Settings; "
        "s = Service(Settings(data_dir='x')); create_app(JobEngine(s)); s.models()",
    ],
)
def test_nothing_heavy_is_imported(statement: str) -> None:
    assert imported_by(statement, HEAVY) == []


def test_the_sdk_is_light() -> None:
    suspects = ("fastapi", "uvicorn", "cv2", "numpy", "PIL", "av", "dbos", "sqlalchemy", *HEAVY)
    assert imported_by("import cow_service.client", suspects) == []


def test_all_of_the_sdk_is_where_it_says() -> None:
    from cow_service import client

    assert {name for name in client.__all__ if getattr(client, name) is None} == set()
    assert set(client.__all__) <= set(dir(client))
    assert imported_by("from cow_service.client import Client", ("fastapi", "cv2", "PIL", *HEAVY)) == []
    with pytest.raises(AttributeError, match="no attribute 'Klient'"):
        client.Klient  # noqa: B018


def test_help_imports_no_server_and_no_vision() -> None:
    assert imported_by("import cow_service.cli.main", ("fastapi", "uvicorn", "cv2", "numpy", "av")) == []


def imported_by(statement: str, suspects: tuple[str, ...]) -> list[str]:
    code = f"import sys; {statement}; print(*[m for m in {suspects} if m in sys.modules])"
    result = subprocess.run([sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, check=True)
    return result.stdout.split()
