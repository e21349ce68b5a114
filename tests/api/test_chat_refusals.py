"""What the MLLM refuses while COW imagines, as callers of `/v1` hear it, and those of the other operations."""

from __future__ import annotations

import gzip
import json
from typing import Any

import pytest
from chats import KEY, NAME, what_if
from random_mllm import Instead, RandomMllm, failing
from servers import QUESTION, Served, data_url, picture, problem

from cow_service.client import Client
from cow_service.errors import MllmRefused

pytest_plugins = ("chat_server",)
pytestmark = pytest.mark.slow
SIMULATE = {"image": data_url(picture()), "question": QUESTION}
CHAT: dict[str, Any] = {"model": NAME, "messages": what_if(words=QUESTION)}
ALWAYS = 9  # times: more than anything asks


def refusing(status: int, message: str = "no", **headers: str) -> Instead:
    return failing(status, {"error": {"message": message, "type": "x", "code": 7}}, **headers)


def post(served: Served, path: str = "/v1/chat/completions", body: Any = CHAT, **headers: str) -> Any:
    return served.http.post(path, json=body, headers={"Cache-Control": "no-cache", **headers})


@pytest.fixture(scope="module", autouse=True)
def proven(served: Served) -> None:
    """The server has replied before, so that a refusal without a reason is about the call."""
    post(served)


def test_what_the_mllm_does_not_take_is_told_with_its_status_alone(served: Served, mllm: RandomMllm) -> None:
    status = 413
    mllm.next_replies = [refusing(status, f"the image is too small for the patches of {KEY}")] * ALWAYS
    response = post(served, Prefer="wait=0")  # it is asked once all the same
    said = response.json()["error"]
    assert (response.status_code, response.json()["status"], said["code"]) == (status, status, "mllm-refused")
    assert said["type"] == "invalid_request_error"
    assert "413" in said["message"]
    assert "patches" not in said["message"], "what a provider says may name its account: it stays in the log"
    assert "retry-after" not in response.headers
    *_, last = [block for block in post(served, body={**CHAT, "stream": True}).text.split("\n\n") if block.strip()]
    assert json.loads(last.removeprefix("data: "))["error"]["message"] == said["message"]
    assert len(mllm.received) == 2 * (1 + 2)  # each was asked again with smaller pictures, and no more


@pytest.mark.parametrize("path", ["/simulate", "/answer"])
def test_other_operations_tell_that_it_is_final(served: Served, mllm: RandomMllm, path: str) -> None:
    mllm.next_replies = [refusing(400, "the image is too small")] * ALWAYS
    told = problem(post(served, path, SIMULATE), 422, "mllm-refused")
    refusal = told["refusal"]
    assert (refusal["status"], refusal["retry_after"]) == (400, None)
    assert "too small" not in refusal["message"]
    assert told["usage"]["calls"] == 1
    job = served.ended(served.submit(SIMULATE, path, **{"Cache-Control": "no-cache"})["id"])
    assert job["problem"]["refusal"] == refusal  # stored
    with Client(str(served.http.base_url)) as client, pytest.raises(MllmRefused) as caught:
        client.simulate(picture(), QUESTION)
    assert caught.value.refusal == refusal


def test_a_reply_that_unpacks_to_too_much_is_none_for_readers_either(served: Served, mllm: RandomMllm) -> None:
    bomb = gzip.compress(bytes(300_000_000))
    mllm.next_replies = [failing(200, bomb, content_encoding="gzip"), refusing(400)]
    problem(post(served, "/simulate", SIMULATE), 422, "mllm-refused")
    assert [one.headers["accept-encoding"] for one in mllm.received] == ["identity"] * 2, "it was asked again"


def test_a_chat_asks_again_within_the_patience_of_its_caller(served: Served, mllm: RandomMllm) -> None:
    mllm.next_replies = [refusing(429, retry_after="1"), refusing(400, "too small")]
    assert "400" in post(served).json()["error"]["message"]
    assert len(mllm.received) == 2
    mllm.next_replies = [refusing(429, "slow down", retry_after="90")]  # more than 60 s, within COW_MLLM_BUDGET
    response = post(served)
    assert (response.status_code, response.headers["retry-after"], len(mllm.received)) == (429, "90", 3)
    assert response.json()["error"]["type"] == "rate_limit_error"
    mllm.next_replies = [refusing(429, retry_after="5")]
    assert post(served, Prefer="wait=2").headers["retry-after"] == "5"
    mllm.next_replies = [refusing(429, retry_after="500")]
    response = post(served, "/simulate", SIMULATE)
    assert problem(response, 503, "mllm-unavailable")["refusal"]["status"] == 429
    assert response.headers["retry-after"] == "500"
