"""`cow` as a person would run it: in a process of its own, with a data folder of its own."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from waiting import TIME_LIMIT


def settings_in(tmp_path: Path, **environment: str) -> dict[str, str]:
    plain = {"COW_DATA_DIR": str(tmp_path / "data"), "COLUMNS": "100", "NO_COLOR": "1", "TERM": "dumb"}
    return os.environ | plain | environment


def cow_from_nothing(tmp_path: Path, *arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "cow_service.cli.main", *arguments],
        env=settings_in(tmp_path, **environment),
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
        timeout=TIME_LIMIT,
    )
