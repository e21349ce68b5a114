"""Chats with an MLLM behind the model: what it is sent is what the caller sent, plus frames; its reply comes back."""

from __future__ import annotations

import asyncio
import base64
import copy
import json
import math
import re
import socket
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import httpx
import openai
import pytest
from conftest import DATA, SCALE
from openai import AsyncOpenAI, OpenAI
from random_mllm import RATE, USAGE, RandomMllm, cut, failing, paused, random_mllm, silent
from servers import BODY, QUESTION, Served, data_url, picture, problem

from cow_service.api.openai.forwarding import Forwarder
from cow_service.api.openai.records import ChatImagination
from cow_service.errors import MllmUnavailable
from cow_service.readers.chat import ChatTurn, Upstream
from cow_service.settings import Settings

pytestmark = pytest.mark.slow
NAME, WITHOUT = "cow/qwen3-vl-8b", "cow/qwen3-vl-8b:no-imagination"
SERVED_NAME = "Qwen/Qwen3-VL-8B-Instruct"
KEY, CALLERS_KEY = "server-key-7f3a", "callers-key-99"
TABLE = json.loads((DATA / "chat_fields.json").read_text())
# What the reader would have to find, and a clip that takes no time.
COW = {name: BODY[name] for name in ("grounding", "motion", "num_frames", "frames")}
HELLO = [{"role": "user", "content": "hello"}]


def text(words: str) -> dict[str, Any]:
    return {"type": "text", "text": words}


def image(shift: int = 0, **others: Any) -> dict[str, Any]:
    return {"type": "image_url", "image_url": {"url": data_url(picture(shift)), **others}}


def what_if(shift: int = 0, words: str = QUESTION, **others: Any) -> list[dict[str, Any]]:
    return [{"role": "user", "content": [image(shift, **others), text(words)]}]


@pytest.fixture(scope="module")
def mllm() -> Iterator[RandomMllm]:
    with random_mllm() as one:
        yield one


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory, mllm: RandomMllm) -> Iterator[Served]:
    own = {"COW_MLLM": "qwen3-vl-8b", "COW_MLLM_BASE_URL": mllm.address, "COW_MLLM_API_KEY": KEY}
    with Served(tmp_path_factory.mktemp("chat"), COW_MLLM_TIMEOUT="2", COW_WEBHOOK_SECRET="", **own) as one:
        yield one
        assert "Traceback" not in one.log()
        assert KEY not in one.log()


@pytest.fixture(scope="module")
def client(served: Served) -> Iterator[OpenAI]:
    with OpenAI(base_url=f"{served.http.base_url}/v1", api_key=CALLERS_KEY, max_retries=0, timeout=60) as one:
        yield one


def post(served: Served, body: dict[str, Any] | bytes, path: str = "chat/completions", **headers: str) -> Any:
    content = body if isinstance(body, bytes) else json.dumps(body).encode()
    return served.http.post(f"/v1/{path}", content=content, headers={"Content-Type": "application/json", **headers})


def told(response: httpx.Response) -> dict[str, Any]:
    assert response.status_code == 200, response.text
    return response.json()


# --- what goes on ---


def test_a_plain_pass_through_is_the_callers_body(served: Served, mllm: RandomMllm) -> None:
    raw = (
        '{ "temperature" : 1.0,\t"cow": {"num_frames": 4}, "messages":[{"content":"h\\u00e9 \\ud83d\\ude00 / \\/",'
        '"role":"user"}],\n "model"  :"%s", "seed":18446744073709551617, "top_p":1E-1 , "x":{"cow":1,"model":"a"}  }  '
    )
    response = post(served, (raw % WITHOUT).encode(), Authorization=f"Bearer {CALLERS_KEY}", Cookie="c=1")
    assert told(response)["cow"]["reason"] == "no-imagination"
    assert "`cow` was not used" in response.json()["cow"]["warnings"][0]
    wanted = json.loads((raw % SERVED_NAME).replace(',\t"cow": {"num_frames": 4}', ""))
    received = mllm.received[-1]
    assert repr(json.loads(received.body)) == repr(wanted)  # also the order of its members, and 1.0 is not 1
    assert received.headers["authorization"] == f"Bearer {KEY}"
    assert CALLERS_KEY not in str(received.headers)
    assert "cookie" not in received.headers
    assert received.path == "/v1/chat/completions"


def test_a_reply_comes_back_as_it_is(served: Served, mllm: RandomMllm) -> None:
    ours = {"id": "mine", "choices": [], "usage": None, "odd": [1.50, "é", "\ud83d"], "cow": "of another COW"}
    raw = json.dumps(ours, indent=3).encode()
    mllm.next_replies = [failing(200, raw)]
    response = post(served, {"model": WITHOUT, "messages": HELLO})
    assert {**told(response), "cow": 0} == {**ours, "cow": 0}
    ChatImagination.model_validate(response.json()["cow"])


@pytest.mark.parametrize("row", TABLE, ids=[row["name"] for row in TABLE])
def test_no_field_is_refused_or_changed(served: Served, mllm: RandomMllm, row: dict[str, Any]) -> None:
    for model in (NAME, WITHOUT):
        body = {"model": model, "messages": HELLO, **row["fields"]}
        reply = told(post(served, body))
        assert mllm.last() == {**body, "model": SERVED_NAME}
        assert reply["usage"] == USAGE
        assert len(reply["choices"]) == (row["fields"].get("n") or 1)


def test_the_table_is_long_enough() -> None:
    assert len(TABLE) >= 60
    assert len({row["name"] for row in TABLE}) == len(TABLE)


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
    *before, (note, *frames) = received["messages"][3]["content"][:2], received["messages"][3]["content"][2:]
    assert before == [turns[3]["content"]]
    received["messages"][3]["content"] = turns[3]["content"]
    assert received == {**{name: value for name, value in sent.items() if name != "cow"}, "model": SERVED_NAME}
    assert "initial state" in note["text"]
    assert "simulation" in note["text"]
    assert [frame["image_url"]["detail"] for frame in frames] == ["low"]
    shown = [base64.b64decode(frame["image_url"]["url"].partition(",")[2]) for frame in frames]
    assert shown == [served.http.get(frame["url"]).content for frame in first["frames"]]
    assert (first["imagined"], first["reason"], first["prompts"]) == (True, None, {"imagined-frames": 1})
    job = served.job(first["simulation"])
    assert (job["kind"], job["status"], job["result"]["id"]) == ("simulate", "succeeded", first["simulation"])
    again = told(post(served, body))["cow"]
    assert "generation" in again["reused"]
    assert told(post(served, body, **{"Cache-Control": "no-cache"}))["cow"]["reused"] == []


def test_an_earlier_image_and_a_text_alone(served: Served, mllm: RandomMllm) -> None:
    turns = [
        {"role": "user", "content": [image(2), text("What is here?")]},
        {"role": "assistant", "content": "A ball."},
        {"role": "user", "content": QUESTION},
    ]
    assert told(post(served, {"model": NAME, "messages": turns, "cow": COW}))["cow"]["imagined"]
    content = mllm.last()["messages"][2]["content"]
    assert [part["type"] for part in content] == ["text", "text", "image_url"]
    assert content[0] == text(QUESTION)


def test_two_worlds_are_two_named_strips(served: Served, mllm: RandomMllm) -> None:
    cube = {"object": "blue cube", "bbox": [170, 60, 205, 98]}
    taken = {"objects": [cube], "interventions": [{"kind": "remove", "object": "blue cube"}]}
    cow = told(post(served, {"model": NAME, "messages": what_if(), "cow": {**COW, **taken}}))["cow"]
    _, _, note, *strips = mllm.last()["messages"][0]["content"]
    assert '"Without the blue cube"' in note["text"]
    assert (len(strips), len(cow["frames"])) == (2, 2)


VIDEO = {"type": "video_url", "video_url": {"url": "data:video/mp4;base64,AAAA"}}


@pytest.mark.parametrize(
    ("messages", "reason"),
    [
        (HELLO, "no-image"),
        ([{"role": "user", "content": [image(), image(1), text(QUESTION)]}], "several-images"),
        ([*what_if(1), {"role": "assistant", "content": "A"}, *what_if(2)], "several-images"),
        ([{"role": "user", "content": [VIDEO, text("What happens?")]}], "other-parts"),
        ([{"role": "user", "content": [image()]}], "no-question"),
        (what_if(words="x" * 4001), "invalid-request"),
        ([{"role": "user", "content": [{"type": "image_url", "image_url": {"url": "https://x.org/a.png"}}, text("?")]}],
         "image-url-not-allowed"),
        ([{"role": "user", "content": [{"type": "image_url", "image_url": {"url": "data:image/gif;base64,R0lGODlh"}},
                                       text("?")]}], "image-type-unsupported"),
        ([{"role": "tool", "content": "1", "tool_call_id": "x"}], "no-image"),
        ("nonsense", "no-image"),
        ([1, None, {"role": 3, "content": {"a": 1}}], "no-image"),
    ],
)  # fmt: skip
def test_what_cannot_be_imagined_goes_on_untouched(
    served: Served, mllm: RandomMllm, messages: Any, reason: str
) -> None:
    cow = told(post(served, {"model": NAME, "messages": messages, "cow": {"seed": 1}}))["cow"]
    assert (cow["imagined"], cow["reason"], cow["simulation"]) == (False, reason, None)
    assert cow["detail"]
    assert mllm.last() == {"model": SERVED_NAME, "messages": messages}


def test_nothing_that_moves_is_found(served: Served, mllm: RandomMllm) -> None:
    nothing = {"choices": [{"index": 0, "finish_reason": "stop", "message": {
        "role": "assistant", "content": '{"reasoning": "", "object": null}'}}],
        "id": "x", "object": "chat.completion", "created": 1, "model": "m", "usage": USAGE}  # fmt: skip
    mllm.next_replies = [failing(200, nothing)]
    messages = what_if(5, "Describe the image.")
    cow = told(post(served, {"model": NAME, "messages": messages}))["cow"]
    assert (cow["imagined"], cow["reason"]) == (False, "object-not-found")
    assert cow["usage"] == cow["usage_total"] == {"calls": 1, "input_tokens": 21, "output_tokens": 5}
    assert mllm.last()["messages"] == messages


# --- repeats ---


@pytest.mark.scaled
@pytest.mark.parametrize("model", [NAME, WITHOUT])
def test_repeats_have_the_mean_and_variance_of_the_mllm(served: Served, mllm: RandomMllm, model: str) -> None:
    mllm.received.clear()
    body = {"model": model, "messages": what_if(3), "temperature": 1} | ({"cow": COW} if model == NAME else {})
    count = 60 if SCALE == 1 else 200

    def ask(_: int) -> float:
        reply = told(post(served, body))
        assert reply["cow"]["imagined"] is (model == NAME)
        return float(reply["choices"][0]["message"]["content"].endswith("ANSWER: A"))

    with ThreadPoolExecutor(8) as pool:
        drawn = list(pool.map(ask, range(count)))
    mean = sum(drawn) / count
    variance = sum((each - mean) ** 2 for each in drawn) / (count - 1)
    wanted = RATE * (1 - RATE)
    assert abs(mean - RATE) < 3 * math.sqrt(wanted / count)
    fourth = wanted * (1 - 3 * wanted)  # the central moment of one draw
    assert abs(variance - wanted) < 3 * math.sqrt((fourth - wanted**2) / count)
    assert len(mllm.received) == count  # one call each: no reply was served twice
    assert len({received.body for received in mllm.received}) == 1


# --- what comes back ---


def test_all_that_an_mllm_says_comes_back(client: OpenAI, mllm: RandomMllm) -> None:
    tool = {"type": "function", "function": {"name": "submit", "parameters": {}}}
    create = client.chat.completions.create
    reply = create(model=NAME, messages=what_if(1), n=3, logprobs=True, top_logprobs=2, extra_body={"cow": COW})
    assert [choice.index for choice in reply.choices] == [0, 1, 2]
    assert reply.choices[0].logprobs.content[0].top_logprobs[1].token == "B"
    assert (reply.usage.prompt_tokens, reply.usage.prompt_tokens_details.cached_tokens) == (21, 4)
    assert (reply.model, reply.system_fingerprint) == (SERVED_NAME, "fp_1")
    thinking = {"chat_template_kwargs": {"enable_thinking": True}}
    reply = create(model=NAME, messages=HELLO, tools=[tool], tool_choice="required", extra_body=thinking)
    message = reply.choices[0].message
    assert (message.content, message.tool_calls[0].function.name) == (None, "submit")
    assert message.reasoning_content == "It looks at the ball."
    assert reply.choices[0].finish_reason == "tool_calls"


ASKED = 8
LETTER = re.compile(r"(?i)ANSWER\s*:\s*([A-Za-z\d ,]+)")


def test_inspects_stock_multiple_choice_as_it_goes_over_the_wire(client: OpenAI, mllm: RandomMllm) -> None:
    """Inspect's template of `multiple_choice()` and what its scorer reads, written from its documentation."""
    head = (
        "Answer the following multiple choice question. The entire content of your response should be of the following "
        "format: 'ANSWER: $LETTER' (without quotes) where LETTER is one of A,B.\n\n"
    )
    words = f"{head}{QUESTION}\n\nA) Yes\nB) No"
    mllm.draws.seed(3)
    deserved = ["A" if mllm.draws.random() < RATE else "B" for _ in range(ASKED)]
    mllm.draws.seed(3)
    read: list[str] = []
    for _ in range(ASKED):
        reply = client.chat.completions.create(
            model=NAME, messages=what_if(4, words, detail="auto"), max_tokens=2048, seed=7, extra_body={"cow": COW}
        )
        read.append(LETTER.search(reply.choices[0].message.content)[1].strip())
    assert read == deserved


def test_the_papers_own_request_and_score(client: OpenAI, mllm: RandomMllm) -> None:
    """Question, blank line and JSON template; the answer is what stands behind 'Answer' in it."""
    template = "{'Reasoning': '<your reasons>', 'Answer': '<Your answer>'}"
    words = f"{QUESTION} A. Yes. B. No. C. Not Sure.\n\nWrite your response into this json template: {template}"
    extra = {"enable_thinking": False, "cow": COW}
    mllm.draws.seed(5)
    deserved = ["A" if mllm.draws.random() < RATE else "B" for _ in range(ASKED)]
    mllm.draws.seed(5)
    replies = [
        client.chat.completions.create(model=NAME, messages=what_if(6, words), max_tokens=8192, extra_body=extra)
        for _ in range(ASKED)
    ]
    assert [re.search(r"'Answer': '(\w)'", each.choices[0].message.content)[1] for each in replies] == deserved
    assert mllm.last()["enable_thinking"] is False
    assert all(each.cow["imagined"] for each in replies)


# --- streams ---


def test_a_stream_is_the_mllms_own_behind_progress_and_cow(client: OpenAI, served: Served, mllm: RandomMllm) -> None:
    extra = {"cow": {**COW, "num_frames": 6}}
    given = {"model": NAME, "messages": what_if(7), "stream_options": {"include_usage": True}, "n": 2}
    chunks = list(client.chat.completions.create(stream=True, extra_body=extra, **given))
    told_of = [chunk for chunk in chunks if getattr(chunk, "cow", None) is not None]
    *progress, final = told_of
    assert progress
    assert all({"job", "status", "stage", "progress"} == set(chunk.cow) for chunk in progress)
    assert final.cow["imagined"]
    own = [chunk for chunk in chunks if chunk not in told_of]
    assert {chunk.id for chunk in own} == {final.id}
    for index in (0, 1):
        said = "".join(c.delta.content or "" for chunk in own for c in chunk.choices if c.index == index)
        assert re.fullmatch(r"It rolls on\.\n\nANSWER: [AB]", said)
    assert (own[-1].choices, own[-1].usage.total_tokens) == ([], 26)
    with client.chat.completions.stream(model=NAME, messages=HELLO) as stream:  # puts the pieces together
        message = stream.get_final_completion().choices[0].message
    assert (message.role, message.content[:12]) == ("assistant", "It rolls on.")


def test_a_stream_on_the_wire(served: Served, mllm: RandomMllm) -> None:
    response = post(served, {"model": NAME, "messages": HELLO, "stream": True})
    assert response.headers["content-type"].startswith("text/event-stream")
    first, *events = [block for block in response.text.split("\n\n") if block.strip()]
    assert json.loads(first.removeprefix("data: "))["cow"]["reason"] == "no-image"
    assert events[-1] == "data: [DONE]"
    assert '"role": "assistant", "content": ""' in events[0]  # with the blanks that its server writes


def test_streams_that_break_off(client: OpenAI, mllm: RandomMllm) -> None:
    mllm.next_replies = [cut]
    heard: list[Any] = []
    with pytest.raises(openai.APIError) as caught:
        heard.extend(client.chat.completions.create(model=NAME, messages=HELLO, stream=True))
    assert caught.value.code == "mllm-unavailable"
    mllm.next_replies = [failing(429, {"error": {"message": "slow down", "code": "rate"}}, retry_after="3")]
    with pytest.raises(openai.RateLimitError) as before:  # nothing was sent yet
        list(client.chat.completions.create(model=NAME, messages=HELLO, stream=True))
    assert before.value.response.headers["retry-after"] == "3"
    mllm.next_replies = [failing(429, {"error": {"message": "slow down", "code": "rate"}})]
    with pytest.raises(openai.APIError, match="slow down"):  # progress was
        list(client.chat.completions.create(model=NAME, messages=what_if(1), stream=True, extra_body={"cow": COW}))
    whole = {"choices": [{"index": 0, "message": {"role": "assistant", "content": "x"}, "finish_reason": "stop"}]}
    mllm.next_replies = [failing(200, {**whole, "id": "i", "created": 1, "model": "m"})]  # it does not stream
    chunks = list(client.chat.completions.create(model=NAME, messages=HELLO, stream=True))
    assert "".join(chunk.choices[0].delta.content or "" for chunk in chunks) == "x"


# --- errors ---


@pytest.mark.parametrize(
    ("status", "body", "content_type", "message", "code"),
    [
        (400, {"error": {"message": "too many images", "type": "bad", "param": "messages", "code": "x"}},
         "application/json", "too many images", "x"),
        (400, {"object": "error", "message": "no such template", "type": "BadRequestError", "code": 400},
         "application/json", "no such template", 400),
        (422, {"detail": [{"loc": ["n"], "msg": "no"}]}, "application/json", '[{"loc":["n"],"msg":"no"}]', "422"),
        (404, b"not here", "text/plain", "not here", "404"),
        (500, b"<html>secrets of a proxy</html>", "text/html",
         "The server of the multimodal LLM answered with status 500.", "500"),
        (403, {"error": {"message": f"the key {KEY} may not", "code": None}}, "application/json",
         "the key *** may not", None),
    ],
)  # fmt: skip
def test_what_the_mllm_refuses_comes_back_with_its_status(
    served: Served, mllm: RandomMllm, status: int, body: Any, content_type: str, message: str, code: Any
) -> None:
    asked = len(mllm.received)
    mllm.next_replies = [failing(status, body, content_type, x_ratelimit_limit_requests="9", set_cookie="a=b")]
    response = post(served, {"model": NAME, "messages": HELLO})
    assert response.status_code == status
    assert response.headers["content-type"] == "application/json"
    assert (response.json()["error"]["message"], response.json()["error"]["code"]) == (message, code)
    assert response.headers["x-ratelimit-limit-requests"] == "9"
    assert "set-cookie" not in response.headers
    assert len(mllm.received) == asked + 1  # no retries


def test_what_is_no_reply(served: Served, mllm: RandomMllm) -> None:
    for reply, status, code in (
        (failing(401, {"error": {"message": f"bad key {KEY}"}}), 503, "mllm-unavailable"),
        (failing(307, b"", location="http://elsewhere.example/"), 503, "mllm-unavailable"),
        (failing(200, b"<html>"), 502, "mllm-bad-reply"),
        (failing(200, b"[1]"), 502, "mllm-bad-reply"),
        (lambda handler: handler.connection.close(), 503, "mllm-unavailable"),
        (silent, 503, "mllm-unavailable"),  # COW_MLLM_TIMEOUT
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
    head += "Content-Type: application/json"
    asked = len(mllm.received)
    with socket.create_connection(served.host_and_port) as raw:
        raw.sendall(f"{head}\r\n\r\n".encode() + body)
        while len(mllm.received) == asked:
            pass
    assert mllm.left.wait(1.5)  # before COW_MLLM_TIMEOUT


@pytest.mark.parametrize(
    ("given", "param", "message"),
    [
        ({"cow": {"votes": 3}}, "cow.votes", "`n`"),
        ({"cow": {"baseline": True}}, "cow.baseline", ":no-imagination"),
        ({"cow": {"imagine": "never"}}, "cow.imagine", "`model`"),
        ({"cow": {"question": "?"}}, "cow.question", "`messages`"),
        ({"cow": {"num_frames": 0}}, "cow.num_frames", "greater"),
        ({"cow": {"vote": 1}}, "cow.vote", "no such field"),
        ({"cow": {**COW, "grounding": {"point": [999, 1]}}}, "cow.grounding.point", "outside"),
        ({"cow": {**COW, "generator": "nobody"}}, "cow.generator", "cutout"),
        ({"cow": 1}, "cow", "no object"),
        ({"model": None}, "model", "is missing"),
    ],
)
def test_what_cow_itself_is_told_must_be_right(
    served: Served, mllm: RandomMllm, given: dict[str, Any], param: str, message: str
) -> None:
    asked = len(mllm.received)
    response = post(served, {"model": NAME, "messages": what_if(), **given})
    error = problem(response, 422, "invalid-request")["error"]
    assert error["param"] == param
    assert message in error["message"]
    assert len(mllm.received) == asked


def test_headers_that_speak_of_jobs(served: Served) -> None:
    body = {"model": NAME, "messages": HELLO}
    error = problem(post(served, body, **{"Idempotency-Key": "k"}), 422, "invalid-request")
    assert "not a stored job" in error["detail"]
    response = post(served, body, Prefer="respond-async")  # a preference may be passed over, and this one is
    assert response.status_code == 200
    assert "preference-applied" not in response.headers


def test_many_at_a_time_wait_for_a_place(mllm: RandomMllm) -> None:
    forwarder = Forwarder(Settings(mllm_concurrency=1, mllm_budget=0.3))
    upstream = Upstream(mllm.address, "m")

    async def ask() -> Any:
        async with forwarder.send(upstream, {"messages": HELLO}) as reply:
            return reply

    async def ask_twice() -> list[Any]:
        mllm.next_replies = [paused(1)]
        found = await asyncio.gather(ask(), ask(), return_exceptions=True)
        await forwarder.close()
        return found

    refused, reply = sorted(asyncio.run(ask_twice()), key=lambda each: isinstance(each, ChatTurn))
    assert reply.succeeded
    assert isinstance(refused, MllmUnavailable)
    assert "COW_MLLM_CONCURRENCY" in refused.detail


# --- responses ---

SEEN = {"type": "input_image", "image_url": data_url(picture(1)), "detail": "high"}


def test_responses_of_text_and_of_an_image(client: OpenAI, mllm: RandomMllm) -> None:
    reply = client.responses.create(model=NAME, input="hello", instructions="Be terse.", max_output_tokens=9)
    assert reply.output_text.startswith("It rolls on.")
    assert (reply.status, reply.usage.input_tokens, reply.usage.input_tokens_details.cached_tokens) == (
        "completed",
        21,
        4,
    )
    assert (reply.instructions, reply.max_output_tokens, reply.cow["imagined"]) == ("Be terse.", 9, False)
    system = {"role": "system", "content": "Be terse."}
    assert mllm.last() == {"model": SERVED_NAME, "messages": [system, *HELLO], "max_completion_tokens": 9}
    parts = [SEEN, {"type": "input_text", "text": QUESTION}]
    items = [
        {"role": "user", "content": "before"},
        {"type": "message", "role": "assistant", "content": [{"type": "output_text", "text": "said"}]},
        {"type": "reasoning", "id": "rs_1", "summary": []},
        {"role": "user", "content": parts},
    ]
    schema = {"type": "json_schema", "name": "reply", "schema": {"type": "object"}, "strict": True}
    reply = client.responses.create(
        model=NAME, input=items, text={"format": schema}, store=False, extra_body={"cow": COW, "enable_thinking": True}
    )
    assert reply.cow["imagined"]
    assert [item.type for item in reply.output] == ["reasoning", "message"]
    sent = mllm.last()
    assert sent["response_format"]["json_schema"] == {name: schema[name] for name in ("name", "schema", "strict")}
    assert sent["enable_thinking"] is True
    assert [message["role"] for message in sent["messages"]] == ["user", "assistant", "user"]
    frames = [part["image_url"] for part in sent["messages"][2]["content"] if part["type"] == "image_url"]
    assert [frame["detail"] for frame in frames] == ["high", "high"]


def test_responses_with_functions(client: OpenAI, mllm: RandomMllm) -> None:
    tool = {"type": "function", "name": "submit", "parameters": {}, "strict": False}
    given = {"model": NAME, "tools": [tool], "tool_choice": "required"}
    reply = client.responses.create(input="hello", **given)
    (call,) = reply.output
    assert (call.type, call.name, call.arguments) == ("function_call", "submit", '{"letter": "A"}')
    back = {"type": "function_call_output", "call_id": call.call_id, "output": "right"}
    client.responses.create(model=NAME, input=[{"role": "user", "content": "hello"}, call.model_dump(), back])
    asked, called, output = mllm.last()["messages"]
    assert asked == HELLO[0]
    assert called["tool_calls"][0]["function"] == {"name": "submit", "arguments": '{"letter": "A"}'}
    assert output == {"role": "tool", "tool_call_id": "call_1", "content": "right"}
    events = list(client.responses.create(input="hello", stream=True, **given))
    assert events[-1].response.output[0].name == "submit"


def test_a_streamed_response(client: OpenAI, mllm: RandomMllm) -> None:
    parts = [SEEN, {"type": "input_text", "text": QUESTION}]
    extra = {"cow": COW, "enable_thinking": True}
    with client.responses.stream(model=NAME, input=[{"role": "user", "content": parts}], extra_body=extra) as stream:
        events = list(stream)
        final = stream.get_final_response()
    kinds = [event.type for event in events]
    assert kinds[:2] == ["response.created", "response.in_progress"]
    assert kinds[-1] == "response.completed"
    assert [event.sequence_number for event in events] == list(range(len(events)))
    said = "".join(event.delta for event in events if event.type == "response.output_text.delta")
    assert said == final.output_text
    assert [item.type for item in final.output] == ["reasoning", "message"]
    assert (final.usage.total_tokens, final.cow["imagined"]) == (26, True)
    mllm.next_replies = [cut]
    with pytest.raises(openai.APIError) as caught:
        list(client.responses.create(model=NAME, input="hello", stream=True))
    assert caught.value.code == "mllm-unavailable"


def test_a_response_of_a_model_without_an_mllm(client: OpenAI) -> None:
    parts = [SEEN, {"type": "input_text", "text": QUESTION + " (A) Yes (B) No (C) Not sure"}]
    given: dict[str, Any] = {"model": "cow/embedded", "input": [{"role": "user", "content": parts}]}
    reply = client.responses.create(extra_body={"cow": COW}, **given)
    events = list(client.responses.create(stream=True, extra_body={"cow": COW}, **given))
    assert reply.output_text == events[-1].response.output_text != ""
    assert reply.cow["simulation"]["id"]


@pytest.mark.parametrize(
    ("given", "param"),
    [
        ({"previous_response_id": "resp_1"}, "previous_response_id"),
        ({"conversation": "conv_1"}, "conversation"),
        ({"store": True}, "store"),
        ({"background": True}, "background"),
        ({"prompt": {"id": "p"}}, "prompt"),
        ({"truncation": "auto"}, "truncation"),
        ({"include": ["file_search_call.results"]}, "include"),
        ({"tools": [{"type": "web_search"}]}, "tools[0].type"),
        ({"input": [{"type": "item_reference", "id": "x"}]}, "input[0].type"),
        ({"input": [{"role": "user", "content": [{"type": "input_image", "file_id": "f"}]}]},
         "input[0].content[0].file_id"),
        ({"input": 3}, "input"),
    ],
)  # fmt: skip
def test_what_needs_state_is_refused_by_name(served: Served, given: dict[str, Any], param: str) -> None:
    response = post(served, {"model": NAME, "input": "hello", **given}, "responses")
    assert problem(response, 422, "invalid-request")["error"]["param"] == param


def test_errors_of_responses_are_those_of_chats(served: Served, mllm: RandomMllm) -> None:
    mllm.next_replies = [failing(429, {"error": {"message": "slow down"}}, retry_after="2")]
    response = post(served, {"model": NAME, "input": "hello"}, "responses")
    assert (response.status_code, response.headers["retry-after"]) == (429, "2")
    problem(post(served, {"model": "nobody", "input": "hello"}, "responses"), 404, "model-not-found")
    problem(
        post(served, {"model": NAME, "input": "x"}, "responses", **{"Idempotency-Key": "k"}), 422, "invalid-request"
    )


def test_it_may_be_asked_from_an_event_loop(served: Served) -> None:
    async def ask() -> list[str]:
        async with AsyncOpenAI(base_url=f"{served.http.base_url}/v1", api_key="any", max_retries=0) as client:
            create = client.chat.completions.create
            told_at_once = await create(model=NAME, messages=what_if(1), extra_body={"cow": COW})
            chunks = [chunk async for chunk in await create(model=NAME, messages=HELLO, stream=True)]
            response = await client.responses.create(model=NAME, input="hello")
            events = [event async for event in await client.responses.create(model=NAME, input="hello", stream=True)]
        said = "".join(chunk.choices[0].delta.content or "" for chunk in chunks)
        return [told_at_once.choices[0].message.content, said, response.output_text, events[-1].response.output_text]

    assert all(re.fullmatch(r"It rolls on\.\n\nANSWER: [AB]", said) for said in asyncio.run(ask()))
