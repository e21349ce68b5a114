"""Servers that take less than everything: each is found out with few lost calls, once, and by the next process, too."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import mllm_server as say
import numpy as np
import pytest
from drawn import ball, floor
from hypothesis import given
from hypothesis import strategies as st
from mllm_server import MllmServer
from waiting import TIME_LIMIT

from cow_service.perception.observation import look
from cow_service.readers.base import ReaderInput
from cow_service.readers.options import read_choices
from cow_service.settings import Settings

REPLY = json.dumps({"reasoning": "It rolls there.", "answer": "A"})
OPTIONS = read_choices("", ["Yes", "No", "Not sure"])
LIMIT = 3  # calls that may be lost to learning


def refusing(is_refused: Callable[[dict[str, Any]], bool], code: int, message: str) -> say.Reply:
    """A server that refuses some calls, and replies to the others."""

    def reply(handler: Any) -> None:
        if is_refused(handler.body):
            handler.send(code, {"error": {"message": message, "type": "invalid_request_error", "code": None}})
        else:
            handler.send(200, say.completion(REPLY))

    return reply


def images(body: dict[str, Any]) -> int:
    return len(say.images_of(body))


def in_events(handler: Any) -> None:
    chunk = {"id": "x", "object": "chat.completion.chunk", "created": 0, "model": "m"}
    parts = [{"delta": {"content": REPLY}, "finish_reason": None}, {"delta": {}, "finish_reason": "stop"}]
    data = [json.dumps(chunk | {"choices": [{"index": 0} | part]}) for part in parts]
    body = "".join(f"data: {each}\n\n" for each in (*data, "[DONE]")).encode()
    handler.send(200, body, "text/event-stream")


def only_in_events(handler: Any) -> None:
    if handler.body.get("stream"):
        in_events(handler)
    else:
        handler.send(400, {"error": {"message": "This model only supports streaming. Set stream=true."}})


def message(**fields: Any) -> say.Reply:
    body = say.completion(None)
    body["choices"][0]["message"] = {"role": "assistant", "content": None} | fields
    return say.shaped(body)


SERVERS: dict[str, say.Reply] = {
    "no schema": refusing(
        lambda body: body.get("response_format", {}).get("type") == "json_schema",
        400,
        "'response_format.type' must be 'json_object' or 'text'",
    ),
    "no schema, unexplained": refusing(
        lambda body: body.get("response_format", {}).get("type") == "json_schema", 422, "bad request"
    ),
    "no format at all": refusing(lambda body: "response_format" in body, 400, "Unknown argument: response_format"),
    "no grammar": refusing(
        lambda body: body.get("response_format", {}).get("type") == "json_schema", 500, "Failed to parse grammar"
    ),
    "newer token field": refusing(
        lambda body: "max_tokens" in body, 400, "Unsupported parameter: 'max_tokens'. Use 'max_completion_tokens'."
    ),
    "no temperature": refusing(lambda body: "temperature" in body, 400, "'temperature' does not support 0"),
    "no seed": refusing(lambda body: "seed" in body, 400, "Unrecognized request argument supplied: seed"),
    "no system role": refusing(
        lambda body: any(each["role"] == "system" for each in body["messages"]), 400, "System role not supported"
    ),
    "one image": refusing(
        lambda body: images(body) > 1, 400, "At most 1 image(s) may be provided in one prompt."
    ),
    "small body": refusing(
        lambda body: sum(each.size for each in say.images_of(body)) > 3 * 320 * 240 * 3, 413, "Request too large"
    ),
    "streams anyway": in_events,
    "streams only": only_in_events,
    "in a tool call": message(tool_calls=[
        {"id": "c", "type": "function", "function": {"name": "reply", "arguments": REPLY}}
    ]),
    "in the reasoning": message(reasoning_content=f"I look. {REPLY}", content=""),
}  # fmt: skip


@pytest.fixture(scope="module")
def mllm() -> Iterator[MllmServer]:
    with say.mllm_server() as server:
        yield server


def asked_with_frames(mllm: MllmServer, data_dir: Path, images: int = 5) -> tuple[int, tuple[str, ...]]:
    """How many calls an answer with so many images took, which is A; and its notes."""
    from cow_service.readers.mllm.answer import answer_calls
    from cow_service.readers.mllm.client import MllmClient
    from cow_service.readers.mllm.coordinates import encode
    from cow_service.readers.mllm.models import configure

    settings = Settings(
        mllm="qwen3-vl-8b",
        mllm_base_url=mllm.address,
        mllm_timeout=TIME_LIMIT,
        mllm_budget=TIME_LIMIT,
        data_dir=data_dir,
    )
    model = configure(settings)
    pixels = np.ascontiguousarray(ball(floor(320, 240), (160, 120), 30, (200, 40, 40)))
    asked = ReaderInput(pixels, "Will it hit the mug?", look(pixels), seed=3)
    (call,) = answer_calls(asked.question, OPTIONS, (encode(pixels, model.family).jpeg,) * images, None, 1, 100)
    client, before = MllmClient(model, settings), len(mllm.asked)
    try:
        assert client.complete(call, asked).answer == "A"
    finally:
        client.close()
    return len(mllm.asked) - before, tuple(asked.calls.notes)


@pytest.mark.parametrize("kind", SERVERS)
def test_a_server_that_takes_less_is_found_out_once(kind: str, mllm: MllmServer, tmp_path: Path) -> None:
    mllm.say(SERVERS[kind])
    first, _ = asked_with_frames(mllm, tmp_path)
    assert first <= 1 + LIMIT
    again, notes = asked_with_frames(mllm, tmp_path)
    assert again == 1, "what was learned is on disk, for another process as well"
    assert bool(notes) is (kind in ("one image", "small body"))


def test_more_images_than_were_ever_taken_may_be_what_is_refused(mllm: MllmServer, tmp_path: Path) -> None:
    mllm.say(refusing(lambda body: images(body) > 1, 400, "bad request"))
    assert asked_with_frames(mllm, tmp_path, images=1)[0] == 1
    calls, notes = asked_with_frames(mllm, tmp_path)
    assert calls == 2
    assert notes
    assert asked_with_frames(mllm, tmp_path)[0] == 1
    mllm.say(refusing(lambda _: True, 400, "bad request"))
    with pytest.raises(Exception, match="status 400"):
        asked_with_frames(mllm, tmp_path, images=1)
    assert len(mllm.asked) == 1, "one image was taken before: it is the call that is at fault"


def test_frames_share_a_sheet_where_a_call_takes_fewer_images(mllm: MllmServer, tmp_path: Path) -> None:
    mllm.say(refusing(lambda body: images(body) > 2, 400, "at most 2 images are allowed"))
    asked_with_frames(mllm, tmp_path)
    first, sheet = mllm.images(-1)
    assert first.shape == (240, 320, 3), "places are told in the first image, which stays as it is"
    assert sheet.shape[1] >= 2 * 320
    assert "All images after the first are on one sheet" in mllm.text(-1)


@pytest.mark.parametrize("thought", [{"reasoning_content": "I look"}, {"content": "<think>I look"}])
def test_a_thought_that_leaves_no_room_is_given_more(thought: dict[str, str], mllm: MllmServer, tmp_path: Path) -> None:
    def reply(handler: Any) -> None:
        body = say.completion(REPLY)
        if handler.body["max_tokens"] <= mllm.asked[0]["max_tokens"]:
            body["choices"][0] |= {
                "message": {"role": "assistant", "content": None} | thought,
                "finish_reason": "length",
            }
        handler.send(200, body)

    mllm.say(reply)
    calls, _ = asked_with_frames(mllm, tmp_path)
    assert calls == 2


def test_what_was_learned_is_found_out_again_after_a_week(mllm: MllmServer, tmp_path: Path) -> None:
    mllm.say(SERVERS["no seed"])
    asked_with_frames(mllm, tmp_path)
    (kept,) = (tmp_path / "mllm").iterdir()
    for days, calls in ((6, 1), (8, 2)):
        then = time.time() - days * 24 * 3600
        os.utime(kept, (then, then))
        assert asked_with_frames(mllm, tmp_path)[0] == calls


def test_what_a_dead_server_refuses_teaches_nothing(mllm: MllmServer, tmp_path: Path) -> None:
    mllm.say(say.status(500), say.status(500), say.status(400), REPLY)
    asked_with_frames(mllm, tmp_path)
    mllm.say(say.status(404), REPLY)
    with pytest.raises(Exception, match="no model of that name"):
        asked_with_frames(mllm, tmp_path / "other")
    mllm.say(REPLY)
    asked_with_frames(mllm, tmp_path / "other")
    assert "json_schema" in json.dumps(mllm.asked[-1]["response_format"])


@given(
    words=st.lists(
        st.sampled_from([
            "max_completion_tokens", "temperature", "seed", "system role", "stream", "schema", "at most 1 image",
            "too large", "no",
        ]),
        max_size=3,
    ),
    status=st.sampled_from([400, 413, 422, 500, 501]),
    images=st.integers(0, 6),
)  # fmt: skip
def test_steps_end(words: list[str], status: int, images: int) -> None:
    from pydantic_ai.exceptions import ModelHTTPError

    from cow_service.readers.mllm.capabilities import ServerCapabilities, step_down

    takes, seen = ServerCapabilities(), list[ServerCapabilities]()
    error = ModelHTTPError(status, "m", {"message": " ".join(words)})
    while (lower := step_down(takes, error, images, is_proven=False)) is not None and lower not in seen:
        seen.append(lower)
        takes = lower
    assert len(seen) <= 12  # each step leaves something out


def test_a_picture_that_is_too_large_alone_is_not_sent_in_other_forms(mllm: MllmServer, tmp_path: Path) -> None:
    mllm.say(refusing(lambda _: True, 400, "This model's maximum context length is 400 tokens."))
    with pytest.raises(Exception, match="smaller image"):
        asked_with_frames(mllm, tmp_path)
    assert all("json_schema" in json.dumps(call["response_format"]) for call in mllm.asked)
