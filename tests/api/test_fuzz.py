"""Random requests made from the contract itself: whatever is sent, the answer is one that the contract names."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from conftest import ROOT, SCALE, TESTS
from engines import app_for
from hypothesis import HealthCheck, given, settings
from servers import SEEING, Served
from tables import rows

from cow_service.service import Service
from cow_service.settings import Settings

pytestmark = [pytest.mark.slow, pytest.mark.scaled, pytest.mark.filterwarnings("default")]
CHECKS = ("not_a_server_error", "status_code_conformance", "content_type_conformance", "response_schema_conformance")


@pytest.fixture(scope="module")
def contract(tmp_path_factory: pytest.TempPathFactory) -> Any:
    import schemathesis

    service = Service(Settings(data_dir=tmp_path_factory.mktemp("data")))
    return schemathesis.openapi.from_asgi("/openapi.json", app_for(service))


@pytest.mark.parametrize(
    ("method", "path", "mode"),
    rows(
        core={
            "what can be simulated": ("POST", "/simulate", "POSITIVE"),
            "what cannot be simulated": ("POST", "/simulate", "NEGATIVE"),
            "what can be asked in a chat": ("POST", "/v1/chat/completions", "POSITIVE"),
            "what cannot be a response": ("POST", "/v1/responses", "NEGATIVE"),
            "queries": ("GET", "/jobs", "NEGATIVE"),
            "ids": ("GET", "/jobs/{id}", "POSITIVE"),
        }  # all others: below
    ),
)
def test_every_answer_is_in_the_contract(contract: Any, method: str, path: str, mode: str) -> None:
    from fuzz_hooks import POSTED, doable
    from schemathesis import GenerationMode, checks
    from schemathesis.specs.openapi import checks as conformance

    checked = [getattr(checks, name, None) or getattr(conformance, name) for name in CHECKS]

    @given(case=contract[path][method].as_strategy(generation_mode=GenerationMode[mode]))
    @settings(max_examples=3 * SCALE, suppress_health_check=list(HealthCheck))
    def check(case: Any) -> None:
        if mode == "POSITIVE" and isinstance(case.body, dict) and case.media_type == "application/json":
            case.body = doable(path, case.body, case.body.get("num_frames", 9) % 20 + 2)
        reached.add(case.call_and_validate(checks=checked).status_code)

    reached: set[int] = set()
    check()
    if path in POSTED and mode == "POSITIVE":
        assert reached & {200, 202}, f"no generated request got past the checks: {reached}"


@pytest.mark.soak
@pytest.mark.timeout(600 * SCALE)
def test_a_real_server_keeps_the_contract(tmp_path: Path) -> None:
    """Examples, coverage of every constraint, fuzzing, and chains of calls along the links of `openapi.yaml`."""
    with Served(tmp_path, **SEEING, COW_MAX_BODY_MB="3") as server:
        command = [
            str(Path(sys.executable).with_name("schemathesis")), "run", str(ROOT / "openapi.yaml"),
            "--url", str(server.http.base_url), "--phases", "examples,coverage,fuzzing,stateful",
            "--max-examples", str(SCALE), "--seed", "1", "--suppress-health-check", "all",
            "--max-time", str(10 * SCALE), "--checks", ",".join(CHECKS), "--request-timeout", "120",
            "--no-color", "--no-shrink", "--generation-database", "none", "--continue-on-failure",
            "--report-dir", str(tmp_path / "fuzz"),
        ]  # fmt: skip
        hooks = os.environ | {"SCHEMATHESIS_HOOKS": "fuzz_hooks", "PYTHONPATH": str(TESTS)}
        told = subprocess.run(command, env=hooks, cwd=ROOT, capture_output=True, text=True, check=False)
        assert told.returncode == 0, told.stdout[-6000:] + told.stderr[-2000:]
        assert "Stateful" in told.stdout
