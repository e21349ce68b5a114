"""The limits of the layout: files, helpers, imports, private parts of libraries, and what stays light.

import-linter holds the layers.
"""

from __future__ import annotations

import ast
import re
import subprocess
import sys
import tomllib
from collections import Counter
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest
from conftest import ROOT, TESTS

from hatch_build import MADE

PACKAGE = ROOT / "cow_service"
MAX_ROOT_FILES, MAX_ROOMS = 12, 32
# A file is one idea that a reader wants to see whole: 120 to 400 lines in most cases.
MAX_FILE_LINES, MAX_FILES, MAX_SHORT_FILES, SHORT = 600, 256, 20, 80
MAX_LINES = 51_746  # with the eye, beside which what it may replace still stands
MAX_HELPERS_USED_ONCE, MAX_IMPORT_LINES = 0.12, 0.065  # of all functions; of all lines. To be lowered.
MAX_PIPELINE_LINES, MAX_PIPELINE_FUNCTION_LINES, MAX_FUNCTION_LINES = 150, 40, 85

HEAVY = ("torch", "transformers", "diffusers", "accelerate")
OF_EXTRAS = (
    *("json_repair", "pydantic_ai", "tenacity", "openai", "mcp", "obstore", "inspect_ai", "pyarrow", "scipy", "ray"),
    "opentelemetry.sdk",
)


def lines(path: Path) -> int:
    return len(path.read_text().splitlines())


def test_the_root_and_the_rooms_are_few() -> None:
    root = sorted(path.name for path in PACKAGE.iterdir() if path.is_file())
    assert len(root) <= MAX_ROOT_FILES, root
    rooms = sorted(path.parent.relative_to(PACKAGE).as_posix() for path in PACKAGE.rglob("__init__.py"))
    assert len(rooms) <= MAX_ROOMS, rooms
    # A folder without __init__.py would escape import-linter and this count.
    assert {path.parent for path in PACKAGE.rglob("*.py")} == {path.parent for path in PACKAGE.rglob("__init__.py")}


def test_files_are_neither_long_nor_many() -> None:
    written = (path for path in PACKAGE.rglob("*.py") if path not in [PACKAGE / "client" / name for name in MADE])
    sizes = {str(path.relative_to(PACKAGE)): lines(path) for path in written}
    assert {name: size for name, size in sizes.items() if size > MAX_FILE_LINES} == {}
    assert len(sizes) <= MAX_FILES
    assert sum(sizes.values()) <= MAX_LINES
    short = [name for name, size in sizes.items() if size < SHORT and not name.endswith("__init__.py")]
    assert len(short) <= MAX_SHORT_FILES, short


@cache
def trees() -> dict[Path, ast.Module]:
    return {path: ast.parse(path.read_text()) for path in PACKAGE.rglob("*.py")}


def functions(tree: ast.AST) -> Iterator[ast.FunctionDef | ast.AsyncFunctionDef]:
    return (node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef))


def size_of(node: ast.stmt) -> int:
    return (node.end_lineno or 0) - node.lineno + 1


def test_functions_are_short_and_helpers_are_shared() -> None:
    """A helper that is used once belongs where it is used, unless its name says what its code does not."""
    once = count = 0
    for path, tree in trees().items():
        words = Counter(re.findall(r"\w+", path.read_text()))
        for function in functions(tree):
            assert size_of(function) <= MAX_FUNCTION_LINES, f"{path}: {function.name}"
            count += 1
            once += function.name.startswith("_") and not function.name.endswith("__") and words[function.name] == 2
    assert once / count <= MAX_HELPERS_USED_ONCE


def test_imports_are_few() -> None:
    imports = [node for tree in trees().values() for node in ast.walk(tree) if isinstance(node, IMPORTS)]
    assert sum(map(size_of, imports)) / sum(map(lines, trees())) <= MAX_IMPORT_LINES


IMPORTS = (ast.Import, ast.ImportFrom)
# Private parts of libraries that are used all the same, because there is no public way, and what they are used for.
UNAVOIDABLE = {
    "_C": "torch: how many compiled versions of a function are kept, so that the newest is not always tried first",
    "_dynamo": "torch: as `_C`, of which it is a part",
    "_set_lru_cache": "torch: as `_C`, of which it is a part",
    "_abort_process_group": "torch: ends the waits of all subgroups when a rank is lost",
    "_reset_stateful_cache": "diffusers: nothing of one clip stays in a cache for the next",
    "_keep_in_fp32_modules": "diffusers: the layers that a checkpoint must keep in float32",
}


def test_libraries_are_used_by_their_public_parts() -> None:
    """No name with a leading underscore is imported from a library, or read from what is not ours."""
    found: dict[str, str] = {}
    ours = {word for path in trees() for word in re.findall(r"\b(?:def|self\.|class) ?(_\w+)", path.read_text())}
    ours |= {word for path in trees() for word in re.findall(r"^ +(_\w+):", path.read_text(), re.M)}  # fields
    for path, tree in trees().items():
        for node in ast.walk(tree):
            names: list[str] = []
            if isinstance(node, ast.ImportFrom) and not (node.module or "").startswith(("cow_service", "__future__")):
                names = [*(node.module or "").split("."), *(alias.name for alias in node.names)]
            elif isinstance(node, ast.Import):
                names = [part for alias in node.names for part in alias.name.split(".")]
            elif isinstance(node, ast.Attribute) and node.attr not in ours:
                names = [node.attr]
            private = [name for name in names if re.match(r"_(?!_)", name) and name != "_exit"]  # os._exit is public
            found |= {name: f"{path.relative_to(PACKAGE)}:{node.lineno}" for name in private}
    assert {name: place for name, place in found.items() if name not in UNAVOIDABLE} == {}
    assert set(UNAVOIDABLE) <= set(found), "no longer used"


# Modules whose names differ from those of their packages, and what comes with a package that is declared.
PACKAGE_OF = {
    "PIL": "pillow",
    "cv2": "opencv-python-headless",
    "opentelemetry": "opentelemetry-api",
    "pydantic_ai": "pydantic-ai-slim",
    "pydantic_core": "pydantic",
    "python_multipart": "python-multipart",
    "yaml": "pyyaml",
}


def test_what_is_imported_is_declared() -> None:
    project = tomllib.loads((PACKAGE.parent / "pyproject.toml").read_text())["project"]
    groups = (project["dependencies"], *project["optional-dependencies"].values())
    declared = {re.split(r"[^\w.-]", each)[0].lower().replace("_", "-") for group in groups for each in group}
    imported: dict[str, str] = {}
    for path, tree in trees().items():
        for node in ast.walk(tree):
            modules = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            modules += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            imported |= {module.partition(".")[0]: str(path.relative_to(PACKAGE)) for module in modules}
    foreign = {name: path for name, path in imported.items() if name not in {*sys.stdlib_module_names, "cow_service"}}
    missing = {n: p for n, p in foreign.items() if PACKAGE_OF.get(n, n).lower().replace("_", "-") not in declared}
    assert missing == {}


def test_the_pipeline_is_read_at_a_glance() -> None:
    path = PACKAGE / "pipeline.py"
    sizes = {function.name: size_of(function) for function in functions(trees()[path])}
    assert {name: size for name, size in sizes.items() if size > MAX_PIPELINE_FUNCTION_LINES} == {}
    assert lines(path) <= MAX_PIPELINE_LINES


APP = (
    "from cow_service.api.app import create_app; from cow_service.service import Service; "
    "from cow_service.jobs.engine import JobEngine; from cow_service.settings import Settings; "
    "s = Service(Settings(data_dir='x')); create_app(JobEngine(s)); s.models()"
)
LIGHT = {  # what is imported, and what does not come along
    "cow_service": (*HEAVY, *OF_EXTRAS),
    "cow_service.cli.main": (*HEAVY, *OF_EXTRAS, "fastapi", "uvicorn", "cv2", "numpy", "av", "pydantic", "httpx"),
    "cow_service.client": (*HEAVY, "fastapi", "uvicorn", "cv2", "numpy", "PIL", "av", "dbos", "sqlalchemy"),
}


@pytest.mark.parametrize("module", LIGHT)
def test_a_module_imports_nothing_heavy(module: str) -> None:
    assert imported_by(f"import {module}", LIGHT[module]) == []


def test_the_list_of_commands_is_quick() -> None:
    """The options of `cow simulate` come from the request models."""
    help = "CliRunner().invoke(app, '--help')"
    shown = f"from typer.testing import CliRunner; from cow_service.cli.main import app; {help}"
    assert imported_by(shown, ("pydantic", "httpx", "rich")) == []


def test_a_server_imports_nothing_heavy_and_no_extra() -> None:
    assert imported_by(APP, (*HEAVY, *OF_EXTRAS)) == []


def test_all_of_the_sdk_is_where_it_says() -> None:
    from cow_service import client

    assert {name for name in client.__all__ if getattr(client, name) is None} == set()
    assert set(client.__all__) <= set(dir(client))
    assert imported_by("from cow_service.client import Client", ("fastapi", "cv2", "PIL", *HEAVY)) == []
    with pytest.raises(AttributeError):
        client.Klient  # noqa: B018


def imported_by(statement: str, suspects: tuple[str, ...]) -> list[str]:
    code = f"import sys; {statement}; print(*[m for m in {suspects} if m in sys.modules])"
    result = subprocess.run([sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, check=True)
    return result.stdout.split()


# --- the tests


# What takes seconds to import is imported by the fixtures and functions that use it.
HEAVY_IN_TESTS = (
    *("torch", "transformers", "diffusers", "accelerate", "safetensors.torch", "peft", "inspect_ai", "matplotlib"),
    *("playwright", "axe_playwright_python", "schemathesis", "moto", "openai", "mcp", "pydantic_ai", "scipy"),
    *("pyarrow", "dbos", "ray"),
)
COLLECT = """
import sys, pytest
code = pytest.main(["--collect-only", "-qq", "-p", "no:cacheprovider", "-p", "no:schemathesis"])
print("\\nloaded:", int(code), *[name for name in sys.argv[1:] if name in sys.modules])
"""
# Names with a leading underscore that are public all the same, or that there is no public way around.
DOORS = {
    "_exit": "os: ends a process at once",
    "_repr_html_": "what notebooks ask an object for",
    "_dynamo": "torch: counts what was compiled",
}
# Functions that may sleep: they stand in for what takes time, and no verdict hangs on how long it takes.
SLEEPERS = {
    "waiting.py eventually": "the one way to wait",
    "waiting.py eventually_async": "the one way to wait",
    "chaos.py run": "faults last for a while, and come after a while",
    "mllm_server.py reply": "a model that is slow",
    "api/test_bad_input.py trickle": "a caller whose bytes come slowly",
    "client/test_client_faults.py held": "a server from which a client that does not wait would leave",
    "service/test_concurrency.py work": "threads that hold something at the same time",
    "service/test_egress.py answer": "an answer that never ends",
    "service/test_egress.py sip": "a receiver that takes no bytes",
    "service/test_egress.py slowly": "a name server that is slow",
}


@cache
def trees_of_tests() -> dict[str, ast.Module]:
    """The tests and what helps them, by their place in the folder."""
    return {path.relative_to(TESTS).as_posix(): ast.parse(path.read_text()) for path in TESTS.rglob("*.py")}


def test_no_test_imports_another_test() -> None:
    for place, tree in trees_of_tests().items():
        named = [node.module or "" for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
        assert not [name for name in named if re.fullmatch(r"(\w+\.)*test_\w+", name)], place
    assert [place for place in trees_of_tests() if place.endswith("/conftest.py")] == [], "there is the one"


@pytest.mark.slow
def test_nothing_heavy_is_loaded_when_the_tests_are_collected() -> None:
    """Neither by a test file nor by a helper or a module of the product that it imports."""
    command = [sys.executable, "-c", COLLECT, *HEAVY_IN_TESTS]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.rpartition("\n\n")[2].split() == ["loaded:", "0"], done.stdout[-2000:]


def test_no_call_has_another_time_limit() -> None:
    """httpx gives up after 5 s where nothing is said."""
    for place, tree in trees_of_tests().items():
        calls = [node for node in ast.walk(tree) if isinstance(node, ast.Call)]
        brief = [
            one for one in calls if re.fullmatch(r"httpx\.(get|post|put|patch|delete|head)", ast.unparse(one.func))
        ]
        assert [one.lineno for one in brief if "timeout" not in {each.arg for each in one.keywords}] == [], place


def is_private(name: str) -> bool:
    return re.match(r"_(?!_)", name) is not None and name not in DOORS


def test_tests_use_what_is_public() -> None:
    """No name with a leading underscore of an object that is not their own, and none of the product's modules."""
    found: list[str] = []
    for place, tree in trees_of_tests().items():
        for node in ast.walk(tree):
            names: list[str] = []
            if isinstance(node, ast.Attribute) and ast.unparse(node.value) not in ("self", "cls", "super()"):
                names = [node.attr]
            elif isinstance(node, ast.ImportFrom) and (node.module or "").startswith("cow_service"):
                names = [*(node.module or "").split("."), *(alias.name for alias in node.names)]
            elif isinstance(node, ast.Call) and ast.unparse(node.func).rpartition(".")[2] in ("getattr", "setattr"):
                texts = [one.value for one in node.args if isinstance(one, ast.Constant) and isinstance(one.value, str)]
                names = [text.rpartition(".")[2] for text in texts]
            found += [f"{place}:{node.lineno}: {name}" for name in names if is_private(name)]
    assert found == []


def sleepers(tree: ast.Module) -> Iterator[str]:
    """The functions that sleep; to sleep for no time lets others run."""
    calls = [node for node in ast.walk(tree) if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute)]
    for call in (one for one in calls if one.func.attr in ("sleep", "wait_for_timeout")):  # type: ignore[attr-defined]
        around = [one for one in functions(tree) if one.lineno <= call.lineno <= (one.end_lineno or 0)]
        if not re.fullmatch(r"(?!time|asyncio|anyio).*\.sleep\(.*|.*\(0\)", ast.unparse(call)):
            yield around[-1].name if around else ""


def test_no_test_sleeps_and_then_looks() -> None:
    found = {f"{place} {name}" for place, tree in trees_of_tests().items() for name in sleepers(tree)}
    assert found == SLEEPERS.keys()
