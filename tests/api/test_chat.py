"""`/v1` with models that have no MLLM behind them: the `openai` client and payloads of harnesses, on a real server."""

from __future__ import annotations

import base64
import json
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from chats import CHOICES, COW, EMBEDDED, HELLO, chunks_of, image, post, text, told, user, what_if
from conftest import example
from servers import BODY, Served, problem, slow
from waiting import TIME_LIMIT, eventually

from cow_service.records import Answer

if TYPE_CHECKING:
    from types import ModuleType

    from openai import OpenAI

pytest_plugins = ("chat_server",)
pytestmark = pytest.mark.slow
WITHOUT = f"{EMBEDDED}:no-imagination"
SCENE = example("ball-and-mug")
SCENE_URL = "data:image/jpeg;base64," + base64.b64encode(SCENE.image).decode()


def vlmevalkit(model: str) -> dict[str, Any]:
    content = [image(SCENE_URL, detail="low"), text(SCENE.meta["question"])]
    return {"model": model, "messages": [user(*content)], "max_tokens": 2048, "n": 1, "temperature": 0}


def vlmevalkit_choices(model: str) -> dict[str, Any]:
    """As it asks multiple-choice questions of its own data sets."""
    asks = SCENE.meta["question"].partition(" Answer by")[0]
    end = "Please select the correct answer from the options above. \n"
    words = f"Question: {asks}\nOptions:\nA. Yes\nB. No\nC. Not sure\n{end}"
    return {**vlmevalkit(model), "messages": [user(image(SCENE_URL, detail="high"), text(words))]}


@pytest.fixture
def chat(client: OpenAI) -> Any:
    return client.chat.completions.create


# --- answers ---


@pytest.mark.parametrize("payload", [vlmevalkit, vlmevalkit_choices])
def test_what_harnesses_send_is_answered_with_a_letter(chat: Any, payload: Any) -> None:
    reply = chat(**payload(EMBEDDED))
    assert (reply.choices[0].message.content, reply.choices[0].finish_reason) == (SCENE.meta["answer"], "stop")
    answer = Answer.model_validate(reply.cow)
    assert answer.simulation is not None
    assert answer.warnings == ()
    assert (reply.id, reply.object, reply.model) == (f"chatcmpl-{answer.id}", "chat.completion", EMBEDDED)
    bare = chat(**payload(WITHOUT))
    assert bare.choices[0].message.content == SCENE.meta["not_sure"]
    assert bare.cow["simulation"] is None


def test_it_is_the_same_as_answer_says(served: Served, chat: Any) -> None:
    reply = chat(model=EMBEDDED, messages=vlmevalkit("")["messages"], seed=4, extra_body={"cow": {"votes": 2}})
    job = served.job(reply.cow["id"])
    assert (job["kind"], job["result"]) == ("answer", reply.cow)
    assert reply.cow["simulation"]["generator"]["seed"] == 4
    assert sum(reply.cow["votes"].values()) == 2


def test_open_questions_and_those_that_are_not_sure(chat: Any) -> None:
    reply = chat(model=WITHOUT, messages=what_if(2, "What does the red ball hit?"), max_tokens=1, top_p=None)
    assert reply.choices[0].message.content == "Not sure"
    assert reply.cow["answer"] is None
    assert "1 tokens" in reply.cow["warnings"][0]  # answers are not cut
    reply = chat(model=WITHOUT, messages=what_if(2, "What does the red ball hit?"), max_tokens=3)
    assert len(reply.cow["warnings"]) < 2


def test_earlier_turns_are_not_read_and_that_is_said(chat: Any) -> None:
    content = vlmevalkit("")["messages"][0]["content"]
    turns = [
        {"role": "system", "content": "You are terse."},
        user(content[0], text("What is here?")),
        {"role": "assistant", "content": "A ball."},
        user(content[0], text("If the yellow ball moves to the left,"), text("will it hit the blue mug?")),
    ]
    reply = chat(model=EMBEDDED, messages=turns, temperature=0.3, stop=["\n"], user="me", store=False)
    assert reply.cow["question"] == "If the yellow ball moves to the left,\nwill it hit the blue mug?"
    unread, unused, *_ = reply.cow["warnings"]
    assert "0 (system), 1 (user), 2 (assistant)" in unread
    assert "`stop`, `temperature`" in unused


def test_the_same_key_is_the_same_job(served: Served, chat: Any) -> None:
    body = {"model": EMBEDDED, "messages": what_if()}
    key = {"Idempotency-Key": "chat-1"}
    first, second = (told(post(served, body, **key)) for _ in range(2))
    assert first == second
    response = served.http.post("/answer", json={**BODY, "question": CHOICES}, headers=key)
    assert "error" not in problem(response, 422, "idempotency-key-reused")
    error = problem(post(served, body | {"seed": 2}, **key), 422, "idempotency-key-reused")["error"]
    assert (error["type"], error["code"]) == ("invalid_request_error", "idempotency-key-reused")
    given = {"model": EMBEDDED, "messages": what_if()}
    assert "answering" in chat(**given).cow["reused"]
    assert chat(**given, extra_headers={"Cache-Control": "no-cache"}).cow["reused"] == []


# --- refusals ---


@pytest.mark.parametrize(
    ("given", "param"),
    [
        ({"model": "embedded"}, "model"),
        ({"seed": -1}, "seed"),
        ({"cow": {"vote": 1}}, "cow.vote"),
        ({"cow": {"reader": "mllm"}}, "cow.reader"),
        ({"cow": {"seed": 1}, "seed": 1}, "cow.seed"),
        ({"cow": {"generator": "nobody"}}, "cow.generator"),
        ({"cow": {"num_frames": 4, "frames": {"indices": [9]}}}, "cow.frames.indices[0]"),
        ({"cow": {"grounding": {"point": [999, 1]}}}, "cow.grounding.point"),
        ({"messages": []}, "messages"),
        ({"messages": HELLO}, "messages[0].content"),  # no image
        ({"messages": [user(image())]}, "messages[0].content"),  # no question
        ({"messages": [*what_if(), *what_if(9)]}, "messages[0].content[0].image_url.url"),
        ({"messages": [{"role": "system", "content": [image()]}]}, "messages[0].content[0]"),
        ({"messages": [user(image("file:///etc/passwd"), text("?"))]}, "messages[0].content[0].image_url.url"),
        ({"messages": [user(image("data:image/png;base64,!!"), text("?"))]}, "messages[0].content[0].image_url.url"),
        ({"messages": what_if(words="x" * 4001)}, "messages[0].content"),
        ({"messages": [user(image(), {"type": "input_audio", "input_audio": {}})]}, "messages[0].content[1].type"),
        ({"messages": [{"role": "user"}]}, "messages[0].content"),
    ],
)
def test_what_cannot_be_done_is_refused_by_name(served: Served, given: dict[str, Any], param: str) -> None:
    status, code = (404, "model-not-found") if "model" in given else (422, "invalid-request")
    refusal = problem(post(served, {"model": EMBEDDED, "messages": what_if(), **given}), status, code)
    error = refusal["error"]
    assert (error["code"], error["param"], error["type"]) == (code, param, "invalid_request_error")
    assert error["message"] == refusal["detail"]


def test_errors_are_raised_by_openais_client(openai: ModuleType, chat: Any) -> None:
    with pytest.raises(openai.NotFoundError) as before:  # before a stream
        chat(model="nobody", messages=what_if(), stream=True)
    assert before.value.request_id
    with pytest.raises(openai.APIError) as caught:  # in a stream
        list(
            chat(
                model=EMBEDDED, messages=what_if(), stream=True, extra_body={"cow": {"grounding": {"point": [999, 1]}}}
            )
        )
    assert (caught.value.code, caught.value.param) == ("invalid-request", "cow.grounding.point")


ASKING: dict[str, Any] = {
    "n": 2, "tools": [{"type": "function", "function": {"name": "f"}}], "tool_choice": "required",
    "functions": [{"name": "f"}], "logprobs": True, "top_logprobs": 3, "response_format": {"type": "json_object"},
    "modalities": ["text", "audio"], "temperature": "hot", "stop": 7, "best_of": 3, "enable_thinking": True,
}  # fmt: skip
SILENT: dict[str, Any] = {
    "n": 1, "tools": [], "tool_choice": "auto", "logprobs": False, "response_format": {"type": "text"},
    "temperature": 1, "stop": [], "user": "me", "max_tokens": "many", "audio": None, "enable_thinking": False,
}  # fmt: skip


def test_fields_that_the_embedded_reader_cannot_use_are_named_and_not_refused(served: Served) -> None:
    body = {"model": EMBEDDED, "messages": what_if(), "cow": COW}
    reply = told(post(served, body | ASKING))
    (unused,) = (warning for warning in reply["cow"]["warnings"] if "`logprobs`" in warning)
    names = [f"`{name}`" for name in ASKING]
    assert f"{', '.join(names[:10])} and 2 more" in unused
    assert len(reply["choices"]) == 1
    assert len(told(post(served, body | SILENT))["cow"]["warnings"]) == len(reply["cow"]["warnings"]) - 1


def test_every_refusal_below_v1_has_openais_form(served: Served) -> None:
    form = {"Content-Type": "multipart/form-data; boundary=x"}
    for response, status, code in (
        (post(served, b"{"), 400, "malformed-body"),
        (post(served, b"--x", **form), 415, "body-type-unsupported"),
        (post(served, b" " * 3_100_000), 413, "body-too-large"),
        (served.http.get("/v1/nothing"), 404, "not-found"),
    ):
        assert problem(response, status, code)["error"]["code"] == code
        assert response.headers["content-length"] == str(len(response.content))
    assert "error" not in problem(served.http.get("/nothing"), 404, "not-found")


# --- streams ---


def slowly(seed: int, seconds: float = 30) -> dict[str, Any]:
    asks = slow(seconds, seed=seed)
    cow = {name: value for name, value in asks.items() if name not in ("image", "question")}
    return {"model": EMBEDDED, "messages": what_if(), "cow": cow}


def streamed(chat: Any, body: dict[str, Any], **headers: str) -> Any:
    rest = {name: value for name, value in body.items() if name != "cow"}
    return chat(stream=True, extra_body={"cow": body["cow"]}, extra_headers=headers, **rest)


def test_a_stream_tells_its_progress_and_then_the_answer(served: Served) -> None:
    options = {"stream": True, "stream_options": {"include_usage": True}}
    response = post(served, slowly(11, seconds=1.2) | options)
    first, *progress, reasoning, content, last, usage = whole = chunks_of(response)
    assert first["choices"][0]["delta"] == {"role": "assistant", "content": ""}
    job = first["cow"]["job"]
    assert set(first["cow"]) == {"job", "status", "stage", "progress"}
    assert first["cow"]["status"] in ("queued", "running")
    done = [chunk["cow"]["progress"] for chunk in (first, *progress)]
    assert done == sorted(done)
    assert 3 <= len(set(done)) < 40  # fewer than there are steps
    assert all(chunk["choices"][0]["delta"] == {} for chunk in progress)
    assert "generation" in {chunk["cow"]["stage"] for chunk in progress}
    answer = Answer.model_validate(last["cow"])
    assert reasoning["choices"][0]["delta"] == {"reasoning_content": answer.reasoning}
    assert content["choices"][0]["delta"] == {"content": answer.answer or "Not sure"}
    assert (last["choices"][0]["finish_reason"], answer.id) == ("stop", job)
    assert (usage["choices"], usage["usage"]["total_tokens"]) == ([], 0)
    assert {(chunk["id"], chunk["object"], chunk["created"]) for chunk in whole} == {
        (f"chatcmpl-{job}", "chat.completion.chunk", first["created"])
    }
    body = {"model": EMBEDDED, "messages": [*what_if(), {"role": "assistant", "content": "so"}], "stream": True}
    *_, last = chunks = chunks_of(post(served, body))
    assert not any(chunk["usage"] for chunk in chunks)
    assert "1 (assistant)" in last["cow"]["warnings"][0]


@pytest.mark.parametrize(("key", "status"), [({}, "canceled"), ({"Idempotency-Key": "chat-left"}, "running")])
def test_a_caller_who_leaves_a_stream(
    served: Served, openai: ModuleType, chat: Any, key: dict[str, str], status: str
) -> None:
    left = f"left-{status}"
    with streamed(chat, slowly(21), **{"X-Request-Id": left}, **key) as stream:
        job = next(iter(stream)).cow["job"]
        served.rendering(job)
    eventually(lambda: f"request_id={left}" in served.log())  # the server has seen it
    served.until(job, status)
    if status == "canceled":
        return
    with ThreadPoolExecutor(1) as pool:  # a returning caller gets the rest
        again = pool.submit(lambda: list(streamed(chat, slowly(21), **key)))
        served.http.post(f"/jobs/{job}/cancel")
        with pytest.raises(openai.APIError) as caught:
            again.result()
    assert caught.value.code == "canceled"


def test_a_server_that_stops_says_so_in_the_stream(tmp_path: Path) -> None:
    with Served(tmp_path, COW_SHUTDOWN_GRACE="0.5") as one:
        with one.http.stream("POST", "/v1/chat/completions", json=slowly(23) | {"stream": True}) as response:
            lines = (line for line in response.iter_lines() if line.startswith("data:"))
            one.rendering(json.loads(next(lines)[5:])["cow"]["job"])
            one.ask_to_stop()
            *_, last = lines
        assert json.loads(last[5:])["error"]["code"] == "shutting-down"
        assert one.process is not None
        one.process.wait(TIME_LIMIT)
        assert "Traceback" not in one.log()
