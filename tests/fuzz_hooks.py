"""What random requests are given, so that some of them get past the checks; `schemathesis run` loads it as hooks."""

from __future__ import annotations

import base64
from typing import Any

import schemathesis
from drawn import ball, block, floor, png_bytes
from schemathesis import GenerationMode

PICTURE = png_bytes(block(ball(floor(200, 150), (60, 75), 20, (210, 20, 20)), (130, 60, 170, 100), (50, 80, 200)))
IMAGE = "data:image/png;base64," + base64.b64encode(PICTURE).decode()
POSTED = ("/simulate", "/answer", "/v1/chat/completions")
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


# A chat says all that in its messages and its model.
CHAT: dict[str, Any] = {
    "model": "cow/embedded",
    "messages": [{"role": "user", "content": [{"type": "image_url", "image_url": {"url": IMAGE}}]}],
    "n": 1,
    "seed": 1,
}
ELSEWHERE = ("image", "reader")


def doable(path: str, body: dict[str, Any], num_frames: int) -> dict[str, Any]:
    """A random body of an operation, with what it takes to be done."""
    if path != "/v1/chat/completions":
        return {**body, **GIVEN, "num_frames": num_frames}
    own = {name: value for name, value in (body.get("cow") or {}).items() if name != "seed"}
    given = {name: value for name, value in GIVEN.items() if name not in ELSEWHERE}
    last = {"role": "user", "content": "If the red ball moves to the right, will it hit the blue cube?"}
    chat = {**CHAT, "messages": [*CHAT["messages"], last]}
    return {**body, **chat, "cow": {**own, **given, "num_frames": num_frames}}


@schemathesis.hook
def before_call(context, case, kwargs) -> None:
    """Every second valid request is one that can be done, and half of those as jobs."""
    # Addresses past 64 KB are refused by the HTTP server itself, in plain text.
    case.path_parameters = {name: str(value)[:2000] for name, value in (case.path_parameters or {}).items()}
    is_valid = case.meta is None or case.meta.generation.mode is GenerationMode.POSITIVE
    if not is_valid or case.path not in POSTED or not isinstance(case.body, dict):
        return
    if case.media_type == "application/json" and ("question" in case.body or "messages" in case.body):
        case.body = doable(case.path, case.body, 5)
        case.headers = {**(case.headers or {}), "Prefer": "respond-async"}
