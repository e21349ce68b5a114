"""What random requests are given, so that some of them get past the checks; `schemathesis run` loads it as hooks."""

from __future__ import annotations

import base64

import schemathesis
from drawn import ball, block, floor, png_bytes
from schemathesis import GenerationMode

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
    "webhook": None,
}


@schemathesis.hook
def before_call(context, case, kwargs) -> None:
    """Every second valid request is one that can be done, and half of those as jobs."""
    # Addresses past 64 KB are refused by the HTTP server itself, in plain text.
    case.path_parameters = {name: str(value)[:2000] for name, value in (case.path_parameters or {}).items()}
    is_valid = case.meta is None or case.meta.generation.mode is GenerationMode.POSITIVE
    if not is_valid or case.path not in ("/simulate", "/answer") or not isinstance(case.body, dict):
        return
    if case.media_type == "application/json" and "question" in case.body:
        case.body = {**case.body, **GIVEN, "num_frames": 5}
        case.headers = {**(case.headers or {}), "Prefer": "respond-async"}
