"""Random requests made from the contract itself: whatever is sent, the answer is one that the contract names."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
import schemathesis
from conftest import ROOT, SCALE, TESTS
from engines import app_for
from fuzz_hooks import POSTED, doable
from hypothesis import HealthCheck, given, settings
from schemathesis import GenerationMode
from schemathesis.checks import not_a_server_error
from schemathesis.specs.openapi.checks import (
    content_type_conformance,
    response_schema_conformance,
    status_code_conformance,
)
from servers import SEEING, Served

from cow_service.service import Service
from cow_service.settings import Settings

pytestmark = [pytest.mark.slow, pytest.mark.scaled, pytest.mark.filterwarnings("default")]
CHECKS = [not_a_server_error, status_code_conformance, content_type_conformance, response_schema_conformance]


@pytest.fixture(scope="module")
def contract(tmp_path_factory: pytest.TempPathFactory):
    service = Service(Settings(data_dir=tmp_path_factory.mktemp("data")))
    return schemathesis.openapi.from_asgi("/openapi.json", app_for(service))


@pytest.mark.parametrize(
    ("method", "path", "mode"),
    [
        ("POST", "/simulate", GenerationMode.POSITIVE),
        ("POST", "/simulate", GenerationMode.NEGATIVE),
        ("POST", "/answer", GenerationMode.POSITIVE),
        ("POST", "/answer", GenerationMode.NEGATIVE),
        ("POST", "/look", GenerationMode.NEGATIVE),
        ("POST", "/v1/chat/completions", GenerationMode.POSITIVE),
        ("POST", "/v1/chat/completions", GenerationMode.NEGATIVE),
        ("POST", "/v1/responses", GenerationMode.POSITIVE),
        ("POST", "/v1/responses", GenerationMode.NEGATIVE),
        ("GET", "/v1/models", GenerationMode.POSITIVE),
        ("GET", "/v1/models/{model}", GenerationMode.POSITIVE),
        ("GET", "/artifacts/{sha256}", GenerationMode.POSITIVE),
        ("GET", "/jobs", GenerationMode.POSITIVE),
        ("GET", "/jobs", GenerationMode.NEGATIVE),
        ("GET", "/jobs/{id}", GenerationMode.POSITIVE),
        ("GET", "/jobs/{id}", GenerationMode.NEGATIVE),
        ("GET", "/jobs/{id}/request", GenerationMode.POSITIVE),
        ("GET", "/jobs/{id}/download", GenerationMode.POSITIVE),
        ("GET", "/jobs/{id}/events", GenerationMode.POSITIVE),
        ("POST", "/jobs/{id}/cancel", GenerationMode.POSITIVE),
        ("DELETE", "/jobs/{id}", GenerationMode.POSITIVE),
        ("GET", "/models", GenerationMode.POSITIVE),
        ("GET", "/workers", GenerationMode.POSITIVE),
        ("GET", "/metrics", GenerationMode.POSITIVE),
        ("GET", "/livez", GenerationMode.POSITIVE),
        ("GET", "/readyz", GenerationMode.POSITIVE),
    ],
)
def test_every_answer_is_in_the_contract(contract, method: str, path: str, mode: GenerationMode) -> None:
    operation = contract[path][method]

    @given(case=operation.as_strategy(generation_mode=mode))
    @settings(max_examples=3 * SCALE, deadline=None, suppress_health_check=list(HealthCheck))
    def check(case) -> None:
        if mode is GenerationMode.POSITIVE and isinstance(case.body, dict) and case.media_type == "application/json":
            case.body = doable(path, case.body, case.body.get("num_frames", 9) % 20 + 2)
        reached.add(case.call_and_validate(checks=CHECKS).status_code)

    reached: set[int] = set()
    check()
    if path in POSTED and mode is GenerationMode.POSITIVE:
        assert reached & {200, 202}, f"no generated request got past the checks: {reached}"


@pytest.mark.timeout(400 * SCALE)
def test_a_real_server_keeps_the_contract(tmp_path: Path) -> None:
    """Examples, coverage of every constraint, fuzzing, and chains of calls along the links of `openapi.yaml`."""
    with Served(tmp_path, **SEEING, COW_MAX_BODY_MB="3") as server:
        fuzz(str(server.http.base_url), tmp_path)


def fuzz(address: str, folder: Path) -> None:
    command = [
        str(Path(sys.executable).with_name("schemathesis")), "run", str(ROOT / "openapi.yaml"), "--url", address,
        "--phases", "examples,coverage,fuzzing,stateful", "--max-examples", str(SCALE), "--seed", "1",
        "--suppress-health-check", "all", "--max-time", str(10 * SCALE),
        "--checks", ",".join(check.__name__ for check in CHECKS), "--request-timeout", "60",
        "--no-color", "--no-shrink",
        "--generation-database", "none", "--continue-on-failure", "--report-dir", str(folder / "fuzz"),
    ]  # fmt: skip
    hooks = os.environ | {"SCHEMATHESIS_HOOKS": "fuzz_hooks", "PYTHONPATH": str(TESTS)}
    limit = 380 * SCALE
    told = subprocess.run(command, env=hooks, cwd=ROOT, capture_output=True, text=True, check=False, timeout=limit)
    assert told.returncode == 0, told.stdout[-6000:] + told.stderr[-2000:]
    assert "Stateful" in told.stdout


def test_the_contract_has_no_other_operations(contract) -> None:
    jobs = {"/jobs", "/jobs/{id}", *(f"/jobs/{{id}}/{part}" for part in ("request", "download", "events", "cancel"))}
    others = {"/artifacts/{sha256}", "/models", "/workers", "/livez", "/readyz", "/metrics"}
    chat = {"/v1/chat/completions", "/v1/responses", "/v1/models", "/v1/models/{model}"}
    assert set(contract) == {"/simulate", "/answer", "/look"} | chat | jobs | others
