"""`examples/tour.ipynb`: its cells, run in their order, and what a notebook shows of each."""

from __future__ import annotations

import ast
import json
import socket
from pathlib import Path
from typing import Any

import pytest
from conftest import EXAMPLES

pytestmark = pytest.mark.slow

TOUR: dict[str, Any] = json.loads((EXAMPLES / "tour.ipynb").read_text())
CODE = [cell for cell in TOUR["cells"] if cell["cell_type"] == "code"]


def shown(source: str, namespace: dict[str, Any]) -> Any:
    """Runs a cell; returns the value of its last line, if that is an expression."""
    cell = ast.parse(source)
    last = ast.Expression(cell.body.pop().value) if isinstance(cell.body[-1], ast.Expr) else None  # type: ignore[attr-defined]
    exec(compile(cell, "cell", "exec"), namespace)
    return None if last is None else eval(compile(last, "cell", "eval"), namespace)


def test_it_is_committed_without_outputs() -> None:
    assert (TOUR["nbformat"], TOUR["nbformat_minor"]) == (4, 5)
    assert all(cell["outputs"] == [] and cell["execution_count"] is None for cell in CODE)
    assert len({cell["id"] for cell in TOUR["cells"]}) == len(TOUR["cells"])


def test_every_cell_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    monkeypatch.chdir(EXAMPLES)
    monkeypatch.setenv("COW_BASE_URL", f"http://127.0.0.1:{port}")  # where none is: the notebook starts one
    monkeypatch.setenv("COW_WORKERS", "false")  # of the server that it starts: processes take long to start
    monkeypatch.setenv("COW_DATA_DIR", str(tmp_path / "own"))
    monkeypatch.delenv("COW_API_KEY", raising=False)
    namespace: dict[str, Any] = {"__name__": "__main__"}
    pages: dict[str, str] = {}
    try:
        for cell in CODE:
            value = shown("".join(cell["source"]), namespace)
            if cell["id"] == "models":
                assert "cow models pull ati" in repr(value)
            if hasattr(value, "_repr_html_"):
                pages[cell["id"]] = value._repr_html_()
    finally:
        if (server := namespace.get("server")) is not None:
            server.kill()
            server.wait()
    assert set(pages) == {"simulate", "correct", "answer", "told"}
    for name in ("simulate", "correct", "answer"):
        assert "data:image/png;base64," in pages[name]
    assert "<video" in pages["simulate"]
    assert namespace["corrected"].motion.source == "request"
    assert (namespace["answer"].option, namespace["without"].option) == ("Yes", None)
    told = capsys.readouterr().out
    for line in (
        "mug -> Yes",
        "throw -> Yes",
        "car -> not sure\n  nothing was imagined: ",
        "again: grounding, motion",
    ):
        assert line in told
