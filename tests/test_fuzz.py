"""Random requests made from the contract itself: whatever is sent, the answer is one that the contract names."""

from __future__ import annotations

import base64

import pytest
import schemathesis
from drawn import ball, block, floor, png_bytes
from engines import app_for
from hypothesis import HealthCheck, given, settings
from schemathesis import GenerationMode
from schemathesis.checks import not_a_server_error
from schemathesis.specs.openapi.checks import (
    content_type_conformance,
    response_schema_conformance,
    status_code_conformance,
)

from cow_service.service import Service
from cow_service.settings import Settings

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("default")]
PICTURE = png_bytes(block(ball(floor(200, 150), (60, 75), 20, (210, 20, 20)), (130, 60, 170, 100), (50, 80, 200)))
IMAGE = "data:image/png;base64," + base64.b64encode(PICTURE).decode()
# What random text cannot be: a picture, a place in it, and backends that exist.
GIVEN = {
    "image": IMAGE,
    "grounding": {"point": [60, 75]},
    "motion": {"direction": [1, 0]},
    "trajectory": None,
    "reader": "embedded",
    "generator": "cutout",
    "generator_options": {},
}
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
        ("GET", "/artifacts/{sha256}", GenerationMode.POSITIVE),
        ("GET", "/models", GenerationMode.POSITIVE),
        ("GET", "/livez", GenerationMode.POSITIVE),
        ("GET", "/readyz", GenerationMode.POSITIVE),
    ],
)
def test_every_answer_is_in_the_contract(contract, method: str, path: str, mode: GenerationMode) -> None:
    operation = contract[path][method]

    @given(case=operation.as_strategy(generation_mode=mode))
    @settings(max_examples=80, deadline=None, suppress_health_check=list(HealthCheck))
    def check(case) -> None:
        if mode is GenerationMode.POSITIVE and isinstance(case.body, dict) and case.media_type == "application/json":
            case.body = {**case.body, **GIVEN, "num_frames": case.body.get("num_frames", 9) % 20 + 2}
        reached.add(case.call_and_validate(checks=CHECKS).status_code)

    reached: set[int] = set()
    check()
    if (method, mode) == ("POST", GenerationMode.POSITIVE):
        assert 200 in reached, "no generated request got past the checks"


def test_the_contract_has_no_other_operations(contract) -> None:
    assert set(contract) == {"/simulate", "/answer", "/artifacts/{sha256}", "/models", "/livez", "/readyz"}
