"""A test of the tests: changes the product at random, one change at a time, and sees whether a test fails.

    python tests/mutate.py                  # 80 changes drawn by seed 1
    python tests/mutate.py --package jobs   # those in one package
    python tests/mutate.py --only 12        # the twelfth again, with the end of the tests' output

A change turns a comparison, adds one to a number or turns a boolean, or deletes a line. After each, the tests of the
changed package run (`tests/PACKAGE`), first those that import the changed module, until one fails. It counts as caught
if the same test fails again. Text, logging and annotations are left alone. Changes are drawn by a digest of the line,
so an edit elsewhere does not exchange them.
"""

from __future__ import annotations

import argparse
import ast
import hashlib
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PRODUCT = ROOT / "cow_service"
TIME_LIMIT = 900  # seconds for the tests of a package; a change that makes them hang is caught
KINDS = ("comparison", "constant", "line")
TURNED: dict[type[ast.cmpop], type[ast.cmpop]] = {
    ast.Lt: ast.GtE, ast.GtE: ast.Lt, ast.Gt: ast.LtE, ast.LtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
    ast.In: ast.NotIn, ast.NotIn: ast.In, ast.Is: ast.IsNot, ast.IsNot: ast.Is,
}  # fmt: skip
DELETED = (ast.Expr, ast.Assign, ast.AugAssign, ast.Return, ast.Raise, ast.Continue, ast.Break)
LOGGING = re.compile(r"^_?log(ger)?\.")
# Where the tests of a package are, if not in the folder of its name alone.
FOLDERS = {
    "adaptive": ("readers",),
    "api": ("api", "jobs"),
    "cli": ("cli", "evals", "service", "workers"),
    "concurrency": ("service",),
    "errors": ("api", "client"),
    "media": ("media", "jobs"),
    "net": ("service",),
    "perception": ("perception", "readers"),
    "physics": ("physics", "stages", "perception"),
    "pipeline": ("service", "jobs"),
    "records": ("narration", "stages", "client"),
    "registry": ("service", "readers"),
    "requests": ("api", "stages"),
    "server": ("api", "project"),
    "service": ("service", "stages"),
    "settings": ("api", "service", "project"),
    "stages": ("stages", "readers", "service"),
}


@dataclass(frozen=True)
class Change:
    """One change of a file: the bytes from `start` to `end` become `text`."""

    path: Path
    line: int
    kind: str
    start: int
    end: int
    text: str

    @property
    def package(self) -> str:
        """The package of `cow_service`, or the module beside them."""
        return self.path.relative_to(PRODUCT).parts[0].removesuffix(".py")

    def __str__(self) -> str:
        old = self.path.read_bytes()[self.start : self.end].decode()
        return f"{self.path.relative_to(ROOT)}:{self.line} {old!r} -> {self.text!r}"


def changes_of(path: Path) -> Iterator[Change]:
    """Every change that can be made in a file."""
    source = path.read_bytes()
    starts = [0]
    for text in source.splitlines(keepends=True):
        starts.append(starts[-1] + len(text))

    def change(node: ast.expr | ast.stmt, kind: str, text: str) -> Change:
        start = starts[node.lineno - 1] + node.col_offset
        end = starts[(node.end_lineno or 0) - 1] + (node.end_col_offset or 0)
        return Change(path, node.lineno, kind, start, end, text)

    def visit(node: ast.AST, in_function: bool) -> Iterator[Change]:
        match node:
            case ast.JoinedStr() | ast.arg():
                return
            case ast.Compare(ops=[op]):
                turned = ast.Compare(node.left, [TURNED[type(op)]()], node.comparators)
                yield change(node, "comparison", f"({ast.unparse(turned)})")
            case ast.Constant(value=bool(value)):
                yield change(node, "constant", repr(not value))
            case ast.Constant(value=int(value) | float(value)):
                yield change(node, "constant", repr(value + 1))
            case ast.stmt() if in_function and isinstance(node, DELETED) and node.end_lineno == node.lineno:
                words = ast.unparse(node)
                is_text = isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
                if not is_text and not LOGGING.match(words):
                    yield change(node, "line", "pass")
        inside = in_function or isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
        for name, value in ast.iter_fields(node):
            if name in ("annotation", "returns"):
                continue
            for child in value if isinstance(value, list) else [value]:
                if isinstance(child, ast.AST):
                    yield from visit(child, inside)

    yield from visit(ast.parse(source), in_function=False)


def draw(seed: int, count: int) -> list[Change]:
    """As many changes of each kind, the same for the same seed."""
    generated = {PRODUCT / "client" / name for name in ("options.py", "sync_client.py", "sync_results.py")}
    drawn: list[tuple[str, Change]] = []
    for path in sorted(set(PRODUCT.rglob("*.py")) - generated):
        lines, seen = path.read_text().splitlines(), dict[str, int]()
        for change in changes_of(path):
            place = f"{seed} {path.relative_to(ROOT)} {change.kind} {lines[change.line - 1].strip()}"
            seen[place] = seen.get(place, 0) + 1
            drawn.append((hashlib.sha256(f"{place} {seen[place]}".encode()).hexdigest(), change))
    drawn.sort(key=lambda one: one[0])
    of_kind = {kind: [change for _, change in drawn if change.kind == kind] for kind in KINDS}
    return [of_kind[KINDS[i % len(KINDS)]][i // len(KINDS)] for i in range(count)]


def tests_of(change: Change, tests: Path) -> list[list[str]]:
    """The test files of the changed package: those that import the changed module, then the others."""
    module = ".".join(change.path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
    parent, _, name = module.rpartition(".")
    imported = re.compile(rf"{re.escape(module)}\b|from {re.escape(parent)} import [^\n]*\b{name}\b")
    folders = FOLDERS.get(change.package, (change.package,))
    files = [path for folder in folders for path in sorted((tests / folder).glob("test_*.py"))]
    assert files, f"No tests of {change.package}: name their folder in FOLDERS."
    near = [str(path) for path in files if imported.search(path.read_text())]
    return [near, [str(path) for path in files if str(path) not in near]]


def run_tests(copy: Path, arguments: list[str]) -> tuple[int | None, str]:
    """The exit code of pytest, or none where it hangs, and what it printed."""
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-m", "not soak", "-p", "no:cacheprovider", *arguments]
    environment = os.environ | {"PYTHONPATH": str(copy), "OMP_NUM_THREADS": "1"}
    with subprocess.Popen(
        command, cwd=copy, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        start_new_session=True,
    ) as process:  # fmt: skip
        try:
            output, _ = process.communicate(timeout=TIME_LIMIT)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            return None, "the tests hang"
    return process.returncode, output


def caught_by(change: Change, copy: Path) -> tuple[str | None, str]:
    """The test that fails because of a change, if one does; and the last output."""
    path = copy / change.path.relative_to(ROOT)
    source = path.read_bytes()
    output = ""

    def write(content: bytes) -> None:
        path.write_bytes(content)
        for compiled in path.parent.glob(f"__pycache__/{path.stem}.*"):  # is valid for another file of the same second
            compiled.unlink()

    write(source[: change.start] + change.text.encode() + source[change.end :])
    by_chance: list[str] = []
    try:
        for files in filter(None, tests_of(change, copy / "tests")):
            code, output = run_tests(copy, files)
            while code not in (0, 5):  # 5: none of these files has a test that runs here
                if code is None:
                    return f"(not done after {TIME_LIMIT} s)", output
                failed = re.search(r"^(?:FAILED|ERROR) (\S.*?)(?: - .*)?$", output, re.M)
                if failed is None or run_tests(copy, [failed[1]])[0] != 0:
                    return (failed[1] if failed else "(pytest)"), output
                by_chance += ["--deselect", failed[1]]
                code, output = run_tests(copy, [*files, *by_chance])
    finally:
        write(source)
    return None, f"{output}\n{by_chance}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--count", type=int, default=80)
    parser.add_argument("--package", help="only the changes in this package")
    parser.add_argument("--only", type=int, metavar="N", help="only the N-th change")
    parser.add_argument("--part", default="0/1", metavar="K/N", help="the K-th of N parts, to run several at once")
    given = parser.parse_args()
    part, parts = map(int, given.part.split("/"))
    changes = list(enumerate(draw(given.seed, given.count), 1))
    if given.only is not None and not 1 <= given.only <= given.count:
        parser.error(f"there is no change {given.only} of {given.count}")
    chosen = [
        (number, change)
        for number, change in changes
        if number % parts == part and (given.only in (None, number)) and (given.package in (None, change.package))
    ]
    missed = 0
    with tempfile.TemporaryDirectory(prefix="cow-mutated-") as folder:
        copy = Path(folder) / "repository"
        made = {".git", ".venv", ".tools", "site", "dist", "demo"}  # by commands, in the root alone
        shutil.copytree(ROOT, copy, ignore=lambda folder, names: made & {*names} if Path(folder) == ROOT else ())
        for command in (["git", "init", "--quiet"], ["git", "add", "--all"]):  # which some tests ask what belongs to it
            subprocess.run(command, cwd=copy, check=True)
        for number, change in chosen:
            test, output = caught_by(change, copy)
            missed += test is None
            print(f"{number:3} {'caught' if test else 'MISSED'} {change}  {test or ''}", flush=True)
            if given.only:
                print(output[-6000:])
    print(f"{len(chosen) - missed} of {len(chosen)} changes caught")


if __name__ == "__main__":
    main()
