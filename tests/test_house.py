"""The limits of the layout: files at the root, rooms, lines, and what stays light. import-linter holds the layers."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "cow_service"
MAX_ROOT_FILES, MAX_ROOMS = 12, 30
MAX_LINES, MAX_PIPELINE_LINES, MAX_PIPELINE_FUNCTION_LINES = 500, 150, 40

HEAVY = ("torch", "transformers", "diffusers", "accelerate")


def lines(path: Path) -> int:
    return len(path.read_text().splitlines())


def test_the_root_and_the_rooms_are_few() -> None:
    root = sorted(path.name for path in PACKAGE.iterdir() if path.is_file())
    assert len(root) <= MAX_ROOT_FILES, root
    rooms = sorted(path.parent.relative_to(PACKAGE).as_posix() for path in PACKAGE.rglob("__init__.py"))
    assert len(rooms) <= MAX_ROOMS, rooms
    # A folder without __init__.py would escape import-linter and this count.
    assert {path.parent for path in PACKAGE.rglob("*.py")} == {path.parent for path in PACKAGE.rglob("__init__.py")}


def test_files_stay_small() -> None:
    long = {str(path.relative_to(PACKAGE)): lines(path) for path in PACKAGE.rglob("*.py") if lines(path) > MAX_LINES}
    assert long == {}


def test_the_pipeline_is_read_at_a_glance() -> None:
    path = PACKAGE / "pipeline.py"
    nodes = ast.walk(ast.parse(path.read_text()))
    functions = [node for node in nodes if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)]
    sizes = {node.name: (node.end_lineno or 0) - node.lineno + 1 for node in functions}
    assert {name: size for name, size in sizes.items() if size > MAX_PIPELINE_FUNCTION_LINES} == {}
    assert lines(path) <= MAX_PIPELINE_LINES


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


def test_libraries_are_used_by_their_public_parts() -> None:
    """A name that begins with an underscore may be gone in the next minor release."""

    def private(node: ast.AST) -> bool:
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            names = [f"{node.module}.{alias.name}" for alias in node.names]
        else:
            return False
        theirs = [name for name in names if name.split(".")[0] not in ("cow_service", "__future__")]
        return any(re.match("_(?!_)", part) for name in theirs for part in name.split("."))

    found = [
        f"{path.relative_to(PACKAGE)}:{node.lineno}"
        for path in sorted(PACKAGE.rglob("*.py"))
        for node in ast.walk(ast.parse(path.read_text()))
        if private(node)
    ]
    assert found == []
