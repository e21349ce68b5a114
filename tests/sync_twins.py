"""Writes the blocking twins of the SDK's async modules: `make unasync`."""

from __future__ import annotations

import re
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).parents[1]
CLIENT = ROOT / "cow_service" / "client"
TWINS = {"async_client.py": "sync_client.py", "async_results.py": "sync_results.py"}
NAMES = {
    "AsyncAnswer": "Answer",
    "AsyncClient": "Client",
    "AsyncIO": "BlockingIO",
    "AsyncJobHandle": "JobHandle",
    "AsyncSimulation": "Simulation",
    "async_client": "sync_client",
    "async_io": "sync_io",
    "async_results": "sync_results",
}


def twin_of(source: Path) -> str:
    """The text of a module's twin: names and keywords by unasync, then the words of docstrings, then ruff."""
    import unasync

    with tempfile.TemporaryDirectory() as folder:
        draft = Path(folder) / "async" / source.name
        draft.parent.mkdir()
        draft.write_text(source.read_text())
        unasync.unasync_files([str(draft)], [unasync.Rule("/async/", "/sync/", NAMES)])
        made = (Path(folder) / "sync" / source.name).read_text()
    made = re.sub(r"Change `(.*)`: `make unasync` writes `.*` from it", r"Written by `make unasync` from `\1`", made)
    made = re.sub(r"\bAsync(?=[A-Z])", "", re.sub(r"\b(async|await) ", "", made))
    for command in (["check", "--fix", "--exit-zero"], ["format"]):
        ruff = [sys.executable, "-m", "ruff", *command, "--quiet", "--stdin-filename", CLIENT / TWINS[source.name], "-"]
        made = subprocess.run(ruff, input=made, capture_output=True, text=True, check=True, cwd=ROOT).stdout
    return made


if __name__ == "__main__":
    for source, twin in TWINS.items():
        (CLIENT / twin).write_text(twin_of(CLIENT / source))
