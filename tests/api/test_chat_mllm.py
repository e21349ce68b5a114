"""Chats with an MLLM behind the model: what it is sent is what the caller sent, plus frames; its reply comes back."""

from __future__ import annotations

import asyncio
import base64
import copy
import json
import re
import socket
import threading
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

import pytest
from chats import COW, HELLO, KEY, NAME, WITHOUT, chunks_of, content_of, image, post, saying, text, told, user, what_if
from conftest import DATA
from random_mllm import USAGE, RandomMllm, cut, failing, silent
from refusals import refused
from servers import QUESTION, Served, problem
from waiting import TIME_LIMIT, eventually, eventually_async

from cow_service.api.openai.forwarding import Forwarder
from cow_service.api.openai.records import ChatImagination
from cow_service.readers.chat import ChatTurn, Upstream
from cow_service.readers.mllm.known import MllmNotes
from cow_service.records import ServerCapabilities
from cow_service.settings import Settings

if TYPE_CHECKING:
    from types import ModuleType

    from openai import OpenAI

pytest_plugins = ("chat_server",)
pytestmark = pytest.mark.slow
SERVED_NAME = "Qwen/Qwen3-VL-8B-Instruct"
TABLE = json.loads((DATA / "chat_fields.json").read_text())
ANSWER = re.compile(r"It rolls on\.\n\nANSWER: [AB]")


# --- what goes on ---


def test_a_plain_pass_through_is_the_callers_body(served: Served, mllm: RandomMllm) -> None:
    raw = (
        '{ "temperature" : 1.0,\t"cow": {"num_frames": 4}, "messages":[{"content":"h\\u00e9 \\ud83d\\ude00 / \\/",'
        '"role":"user"}],\n "model"  :"%s", "seed":18446744073709551617, "top_p":1E-1 , "x":{"cow":1,"model":"a"}  }  '
    )
    cow = told(post(served, (raw % WITHOUT).encode(), Authorization="Bearer callers-key-99", Cookie="c=1"))["cow"]
    said = ("no-imagination", False, "none", 1)
    assert (cow["reason"], cow["imagined"], cow["content"], len(cow["warnings"])) == said
    wanted = json.loads((raw % SERVED_NAME).replace(',\t"cow": {"num_frames": 4}', ""))
    (received,) = mllm.received
    assert repr(json.loads(received.body)) == repr(wanted)  # also the order of its members, and 1.0 is not 1
    assert received.headers["authorization"] == f"Bearer {KEY}"
    assert "callers-key-99" not in str(received.headers)
    assert "cookie" not in received.headers
    assert received.headers["accept-encoding"] == "identity"
    assert received.path == "/v1/chat/completions"


def test_a_reply_comes_back_as_it_is(served: Served, mllm: RandomMllm) -> None:
    ours = {"id": "mine", "choices": [], "usage": None, "odd": [1.50, "é", "\ud83d"], "cow": "of another COW"}
    mllm.next_replies = [failing(200, json.dumps(ours, indent=3).encode())]
    reply = told(post(served, {"model": WITHOUT, "messages": HELLO}))
    assert {**reply, "cow": 0} == {**ours, "cow": 0}
    assert ChatImagination.model_validate(reply["cow"]).warnings == ()


@pytest.mark.parametrize("row", TABLE, ids=[row["name"] for row in TABLE])
def test_no_field_is_refused_or_changed(served: Served, mllm: RandomMllm, row: dict[str, Any]) -> None:
    body = {"model": NAME, "messages": HELLO, **row["fields"]}
    reply = told(post(served, body))
    assert mllm.last() == {**body, "model": SERVED_NAME}
    assert reply["usage"] == USAGE
    assert len(reply["choices"]) == (row["fields"].get("n") or 1)


def test_frames_are_added_behind_the_last_user_message_and_nothing_else(served: Served, mllm: RandomMllm) -> None:
    turns = [
        {"role": "system", "content": "You are terse.", "name": "me"},
        {"role": "user", "content": "Is a ball round?"},
        {"role": "assistant", "content": "ANSWER: A"},
        *what_if(1, detail="low"),
        {"role": "assistant", "content": None, "tool_calls": []},
    ]
    body = {"model": NAME, "messages": turns, "temperature": 0.25, "unknown": {"kept": 1.0}, "cow": COW}
    sent = copy.deepcopy(body)
    first = told(post(served, body))["cow"]
    received = mllm.last()
    *own, note, frame = received["messages"][3]["content"]
    assert own == turns[3]["content"]
    received["messages"][3]["content"] = own
    assert received == {**{name: value for name, value in sent.items() if name != "cow"}, "model": SERVED_NAME}
    assert note["type"] == "text"
    assert frame["image_url"]["detail"] == "low"
    shown = base64.b64decode(frame["image_url"]["url"].partition(",")[2])
    assert [shown] == [served.http.get(one["url"]).content for one in first["frames"]]
    assert (first["imagined"], first["reason"], set(first["prompts"])) == (True, None, {"imagined-frames"})
    job = served.job(first["simulation"])
    assert (job["kind"], job["status"], job["result"]["id"]) == ("simulate", "succeeded", first["simulation"])
    assert job["result"]["video"] is None
    assert "generation" in told(post(served, body))["cow"]["reused"]
    assert told(post(served, body, **{"Cache-Control": "no-cache"}))["cow"]["reused"] == []


@pytest.mark.parametrize("stream", [False, True])
def test_a_server_is_sent_what_it_is_known_to_take(stream: bool, served: Served, mllm: RandomMllm) -> None:
    notes = MllmNotes(served.data, mllm.address, SERVED_NAME)
    before = notes.takes or ServerCapabilities()
    known: dict[str, Any] = {"token_field": "max_completion_tokens", "temperature": False, "seed": False}
    notes.keep(ServerCapabilities(**known, system_role=False, images=2))
    turns = [{"role": "developer", "content": "You are terse."}, *what_if(1)]
    options = {**COW, "frames": {"count": 3}}
    body = {"model": NAME, "messages": turns, "cow": options, "temperature": 0, "seed": 3, "max_tokens": 90, "top_p": 1}
    try:
        response = post(served, {**body, "stream": stream})
        found = chunks_of(response) if stream else [told(response)]
    finally:
        notes.keep(before)
    received = mllm.last()
    assert received.keys() - {"stream"} == {"model", "messages", "max_completion_tokens", "top_p"}
    assert [each["role"] for each in received["messages"]] == ["user", "user"]
    assert [part["type"] for part in received["messages"][1]["content"]].count("image_url") == 2, "its own and a sheet"
    shown = next(each["cow"] for each in found if "frames" in each.get("cow", {}))
    assert len(shown["frames"]) == 3
    for left_out in ("`temperature`", "`seed`", "messages of the user", "frames were sent on one sheet"):
        assert any(left_out in warning for warning in shown["warnings"])


def test_an_earlier_image_and_a_text_alone(served: Served, mllm: RandomMllm) -> None:
    turns = [
        user(image(shift=2), text("What is here?")),
        {"role": "assistant", "content": "A ball."},
        {"role": "user", "content": QUESTION},
    ]
    assert told(post(served, {"model": NAME, "messages": turns, "cow": COW}))["cow"]["imagined"]
    content = mllm.last()["messages"][2]["content"]
    assert [part["type"] for part in content] == ["text", "text", "image_url"]
    assert content[0] == text(QUESTION)


VIDEO = {"type": "video_url", "video_url": {"url": "data:video/mp4;base64,AAAA"}}


@pytest.mark.parametrize(
    ("messages", "reason"),
    [
        (HELLO, "no-image"),
        ([user(image(), image(shift=1), text(QUESTION))], "several-images"),
        ([*what_if(1), {"role": "assistant", "content": "A"}, *what_if(2)], "several-images"),
        ([user(VIDEO, text("What happens?"))], "other-parts"),
        ([user(image())], "no-question"),
        (what_if(words="x" * 4001), "invalid-request"),
        ([user(image("data:image/gif;base64,R0lGODlh"), text("?"))], "image-type-unsupported"),
        ([{"role": "tool", "content": "1", "tool_call_id": "x"}], "no-image"),
        ([1, None, {"role": 3, "content": {"a": 1}}], "no-image"),
    ],
)
def test_what_cannot_be_imagined_goes_on_untouched(
    served: Served, mllm: RandomMllm, messages: Any, reason: str
) -> None:
    cow = told(post(served, {"model": NAME, "messages": messages, "cow": {"seed": 1}}))["cow"]
    assert (cow["imagined"], cow["reason"], cow["simulation"], cow["warnings"]) == (False, reason, None, [])
    assert cow["detail"]
    assert mllm.last() == {"model": SERVED_NAME, "messages": messages}


def test_nothing_that_moves_is_found(served: Served, mllm: RandomMllm) -> None:
    mllm.next_replies = [saying('{"reasoning": "", "object": null}')]
    messages = what_if(5, "Describe the image.")
    cow = told(post(served, {"model": NAME, "messages": messages}))["cow"]
    assert (cow["imagined"], cow["reason"]) == (False, "object-not-found")
    assert cow["usage"] == cow["usage_total"] == {"calls": 1, "input_tokens": 21, "output_tokens": 5}
    assert mllm.last()["messages"] == messages


def test_repeats_are_calls_of_their_own(served: Served, mllm: RandomMllm) -> None:
    body = {"model": NAME, "messages": what_if(3), "temperature": 1, "cow": COW}
    mllm.next_replies = [saying("ANSWER: A"), saying("ANSWER: B")]
    with ThreadPoolExecutor(2) as pool:
        replies = [told(one) for one in pool.map(lambda _: post(served, body), range(2))]
    assert {reply["choices"][0]["message"]["content"] for reply in replies} == {"ANSWER: A", "ANSWER: B"}
    first, second = mllm.received  # no reply was served twice
    assert first.body == second.body


# --- what comes back ---


def test_a_stream_is_the_mllms_own_behind_progress_and_cow(served: Served, client: OpenAI, mllm: RandomMllm) -> None:
    body = {"model": NAME, "messages": what_if(7), "stream_options": {"include_usage": True}, "n": 2, "stream": True}
    chunks = chunks_of(post(served, body | {"cow": {**COW, "num_frames": 6}}))
    *progress, final = (chunk for chunk in chunks if chunk.get("cow"))
    assert progress
    assert all({"job", "status", "stage", "progress"} == set(chunk["cow"]) for chunk in progress)
    assert final["cow"]["imagined"]
    own = [chunk for chunk in chunks if not chunk.get("cow")]
    assert {chunk["id"] for chunk in own} == {final["id"]}
    assert all(ANSWER.fullmatch(content_of(own, index)) for index in (0, 1))
    assert (own[-1]["choices"], own[-1]["usage"]) == ([], USAGE)
    response = post(served, {"model": NAME, "messages": HELLO, "stream": True})
    first, second, *_ = [block for block in response.text.split("\n\n") if block.strip()]
    assert json.loads(first.removeprefix("data: "))["cow"]["reason"] == "no-image"
    assert '"role": "assistant", "content": ""' in second  # with the blanks that its server writes
    with client.chat.completions.stream(model=NAME, messages=HELLO) as stream:  # puts the pieces together
        message = stream.get_final_completion().choices[0].message
    assert (message.role, message.content[:12]) == ("assistant", "It rolls on.")


SLOW_DOWN = {"error": {"message": "slow down", "code": "rate"}}


def test_streams_that_break_off(served: Served, openai: ModuleType, client: OpenAI, mllm: RandomMllm) -> None:
    create = client.chat.completions.create
    mllm.next_replies = [cut]
    with pytest.raises(openai.APIError) as caught:
        list(create(model=NAME, messages=HELLO, stream=True))
    assert caught.value.code == "mllm-unavailable"
    mllm.next_replies = [failing(429, SLOW_DOWN, retry_after="0")]
    with pytest.raises(openai.RateLimitError) as before:  # nothing was sent yet
        list(create(model=NAME, messages=HELLO, stream=True))
    assert before.value.response.headers["retry-after"] == "0"
    mllm.next_replies = [failing(429, SLOW_DOWN, retry_after="0")]
    with pytest.raises(openai.APIError) as caught:  # progress was
        list(create(model=NAME, messages=what_if(1), stream=True, extra_body={"cow": COW}))
    assert ("status 429" in caught.value.message, caught.value.code) == (True, "rate")
    mllm.next_replies = [saying("x")]  # it does not stream
    assert content_of(chunks_of(post(served, {"model": NAME, "messages": HELLO, "stream": True}))) == "x"


# --- errors ---


@pytest.mark.parametrize(
    ("status", "body", "content_type", "code"),
    [
        (400, {"error": {"message": "organization org-77", "type": "bad", "param": "messages", "code": "x"}},
         "application/json", "x"),
        (400, {"object": "error", "message": "see http://10.0.0.7:8000", "type": "BadRequestError", "code": 400},
         "application/json", 400),
        (422, {"detail": [{"loc": ["n"], "msg": "no"}]}, "application/json", "422"),
        (404, b"not here, at 10.0.0.7", "text/plain", "404"),
        (500, b"<html>secrets of a proxy</html>", "text/html", "500"),
        (403, {"error": {"message": f"the key {KEY} may not", "code": None, "type": "see http://10.0.0.7"}},
         "application/json", "403"),
    ],
)  # fmt: skip
def test_what_the_mllm_refuses_comes_back_with_its_status_and_code_alone(
    served: Served, mllm: RandomMllm, status: int, body: Any, content_type: str, code: Any
) -> None:
    mllm.next_replies = [failing(status, body, content_type, x_ratelimit_limit_requests="9", set_cookie="a=b")]
    response = post(served, {"model": NAME, "messages": HELLO})
    assert response.status_code == status
    assert response.headers["content-type"] == "application/json"
    said = response.json()["error"]
    assert said["message"].startswith(f"The server of the multimodal LLM answered with status {status} (COW_LOG_LEVEL=")
    assert said["code"] == code
    assert not re.search(f"{KEY}|org-77|10.0.0.7|proxy", response.text)
    assert response.headers["x-ratelimit-limit-requests"] == "9"
    assert "set-cookie" not in response.headers
    assert len(mllm.received) == 1  # no retries


def test_what_is_no_reply(served: Served, mllm: RandomMllm) -> None:
    for reply, status, code in (
        (failing(401, {"error": {"message": f"bad key {KEY}"}}), 503, "mllm-unavailable"),
        (failing(307, b"", location="http://elsewhere.example/"), 503, "mllm-unavailable"),
        (failing(200, b"[1]"), 502, "mllm-bad-reply"),
        (lambda handler: handler.connection.shutdown(socket.SHUT_RDWR), 503, "mllm-unavailable"),
    ):
        mllm.next_replies = [reply]
        response = post(served, {"model": NAME, "messages": HELLO})
        assert problem(response, status, code)["error"]["code"] == code
        assert KEY not in response.text


def test_a_caller_who_leaves_ends_the_call(served: Served, mllm: RandomMllm) -> None:
    mllm.left.clear()
    mllm.next_replies = [silent]
    body = json.dumps({"model": NAME, "messages": HELLO}).encode()
    head = f"POST /v1/chat/completions HTTP/1.1\r\nHost: x\r\nContent-Length: {len(body)}\r\n"
    with socket.create_connection(served.host_and_port) as raw:
        raw.sendall(f"{head}Content-Type: application/json\r\n\r\n".encode() + body)
        eventually(lambda: mllm.received)
    assert mllm.left.wait(TIME_LIMIT)  # before COW_MLLM_TIMEOUT, 60 s


@pytest.mark.parametrize(
    ("given", "param"),
    [
        ({"cow": {"votes": 3}}, "cow.votes"),
        ({"cow": {"question": "?"}}, "cow.question"),
        ({"cow": {"vote": 1}}, "cow.vote"),
        ({"cow": {**COW, "grounding": {"point": [999, 1]}}}, "cow.grounding.point"),  # known once it is decoded
        ({"cow": 1}, "cow"),
        ({"model": None}, "model"),
    ],
)
def test_what_cow_itself_is_told_must_be_right(
    served: Served, mllm: RandomMllm, given: dict[str, Any], param: str
) -> None:
    response = post(served, {"model": NAME, "messages": what_if(), **given})
    assert problem(response, 422, "invalid-request")["error"]["param"] == param
    assert mllm.received == []


def test_headers_that_speak_of_jobs(served: Served) -> None:
    body = {"model": NAME, "messages": HELLO}
    problem(post(served, body, **{"Idempotency-Key": "k"}), 422, "invalid-request")
    response = post(served, body, Prefer="respond-async")  # a preference may be passed over, and this one is
    assert response.status_code == 200
    assert "preference-applied" not in response.headers


def test_chats_wait_for_a_place_and_for_a_reply_as_long_as_the_settings_say(mllm: RandomMllm) -> None:
    upstream = Upstream(mllm.address, "m")
    release = threading.Event()

    def held(handler: Any) -> None:
        assert release.wait(TIME_LIMIT)
        handler.send(200, handler.mllm.completion(handler.asked))

    async def ask(forwarder: Forwarder) -> ChatTurn:
        async with forwarder.send(upstream, {"messages": HELLO}) as reply:
            assert isinstance(reply, ChatTurn)
            return reply

    async def received() -> bool:
        return bool(mllm.received)

    async def callers() -> None:
        forwarder = Forwarder(Settings(mllm_concurrency=1, mllm_budget=0.3))
        mllm.next_replies = [held]
        first = asyncio.create_task(ask(forwarder))
        await eventually_async(received)
        with refused("mllm-unavailable") as caught:
            await ask(forwarder)
        assert "COW_MLLM_CONCURRENCY" in caught.value.detail
        release.set()
        assert (await first).succeeded
        await forwarder.close()
        mllm.next_replies = [silent]
        impatient = Forwarder(Settings(mllm_timeout=0.2))
        with refused("mllm-unavailable") as caught:
            await ask(impatient)
        assert "COW_MLLM_TIMEOUT" in caught.value.detail
        await impatient.close()

    asyncio.run(callers())
