"""What the MLLM refuses while COW imagines, as callers of `/v1` hear it, and those of the other operations."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from typing import Any

import mllm_server as say
import openai
import pytest
from mllm_server import MllmServer
from openai import OpenAI
from servers import QUESTION, Served, data_url, picture, problem

from cow_service.client import Client
from cow_service.errors import MllmRefused

pytestmark = pytest.mark.slow
NAME, KEY = "cow/qwen3-vl-8b", "server-key-7f3a"
IMAGE = data_url(picture())
CHAT: dict[str, Any] = {"model": NAME, "messages": [{"role": "user", "content": [
    {"type": "image_url", "image_url": {"url": IMAGE}}, {"type": "text", "text": QUESTION}]}]}  # fmt: skip


@pytest.fixture(scope="module")
def mllm() -> Iterator[MllmServer]:
    with say.mllm_server() as server:
        yield server


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory, mllm: MllmServer) -> Iterator[Served]:
    own = {"COW_MLLM": "qwen3-vl-8b", "COW_MLLM_BASE_URL": mllm.address, "COW_MLLM_API_KEY": KEY}
    with Served(tmp_path_factory.mktemp("refusals"), **own) as one:
        yield one
        assert "Traceback" not in one.log()
        assert KEY not in one.log()


def refusing(status: int, message: str = "no", **headers: str) -> say.Reply:
    named = {name.replace("_", "-"): value for name, value in headers.items()}
    return lambda handler: handler.send(status, {"error": {"message": message, "type": "x", "code": 7}}, named)


def post(served: Served, path: str = "/v1/chat/completions", body: Any = CHAT, **headers: str) -> Any:
    return served.http.post(path, json=body, headers={"Cache-Control": "no-cache", **headers})


@pytest.mark.parametrize("status", [400, 413, 422])
def test_what_the_mllm_does_not_take_stays_what_it_said(served: Served, mllm: MllmServer, status: int) -> None:
    mllm.say(refusing(status, f"the image is too small for the patches of {KEY}"))
    response = post(served, Prefer="wait=0")  # it is asked once all the same
    said = response.json()["error"]
    assert (response.status_code, response.json()["status"], said["code"]) == (status, status, "mllm-refused")
    assert (said["message"], said["type"]) == ("the image is too small for the patches of ***", "invalid_request_error")
    assert "retry-after" not in response.headers
    *_, last = [block for block in post(served, body={**CHAT, "stream": True}).text.split("\n\n") if block.strip()]
    assert json.loads(last.removeprefix("data: "))["error"]["message"] == said["message"]
    assert len(mllm.asked) == 2  # neither was repeated
    with (
        OpenAI(base_url=f"{served.http.base_url}/v1", api_key="any", max_retries=0) as client,
        pytest.raises(openai.APIStatusError, match="too small") as caught,
    ):
        client.chat.completions.create(**CHAT)
    assert caught.value.status_code == status


@pytest.mark.parametrize("path", ["/simulate", "/answer"])
def test_other_operations_tell_that_it_is_final(served: Served, mllm: MllmServer, path: str) -> None:
    mllm.say(refusing(400, "the image is too small"))
    body = {"image": IMAGE, "question": QUESTION}
    told = problem(post(served, path, body), 422, "mllm-refused")
    refusal = {"status": 400, "message": "the image is too small", "retry_after": None}
    assert told["refusal"] == refusal
    assert told["usage"]["calls"] == 1
    assert "too small" not in told["detail"]
    job = served.ended(served.submit(body, path, **{"Cache-Control": "no-cache"})["id"])
    assert job["problem"]["refusal"] == refusal  # stored
    with Client(str(served.http.base_url)) as client, pytest.raises(MllmRefused) as caught:
        client.simulate(picture(), QUESTION)
    assert caught.value.refusal == refusal


@pytest.mark.parametrize("status", [401, 403, 404])
def test_what_is_wrong_with_the_servers_own_settings_is_not_the_callers(
    served: Served, mllm: MllmServer, status: int
) -> None:
    mllm.say(refusing(status, f"bad key {KEY}"))
    told = problem(post(served), 503, "mllm-unavailable")
    assert "COW_MLLM" in told["error"]["message"]
    assert "refusal" not in told
    assert KEY not in json.dumps(told)


def test_a_chat_gives_up_within_the_patience_of_its_caller(served: Served, mllm: MllmServer) -> None:
    mllm.say(refusing(429, "slow down", retry_after="1"))
    began = time.monotonic()
    response = post(served, Prefer="wait=3")
    assert 1 < time.monotonic() - began < 20
    assert (response.status_code, response.headers["retry-after"]) == (429, "1")
    assert (response.json()["error"]["message"], response.json()["error"]["type"]) == ("slow down", "rate_limit_error")
    assert 2 <= len(mllm.asked) <= 3
    asked = len(mllm.asked)
    response = post(served, Prefer="wait=0")  # while the pause lasts that the MLLM asked for
    assert (response.status_code, response.headers["retry-after"], len(mllm.asked)) == (429, "1", asked)


def test_a_pause_beyond_the_default_patience_is_not_waited_for(served: Served, mllm: MllmServer) -> None:
    mllm.say(refusing(429, "slow down", retry_after="90"))  # within COW_MLLM_BUDGET
    began = time.monotonic()
    response = post(served)
    assert time.monotonic() - began < 20
    assert (response.status_code, response.headers["retry-after"], len(mllm.asked)) == (429, "90", 1)
    mllm.say(refusing(429, "slow down", retry_after="500"))
    response = post(served, "/simulate", {"image": IMAGE, "question": QUESTION})
    assert problem(response, 503, "mllm-unavailable")["refusal"]["status"] == 429
    assert response.headers["retry-after"] == "500"
