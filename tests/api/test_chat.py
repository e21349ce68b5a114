"""`/v1` with models that have no MLLM behind them: the `openai` client and payloads of harnesses, on a real server."""

from __future__ import annotations

import asyncio
import base64
import json
import socket
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import httpx
import mllm_server as say
import openai
import pytest
from conftest import example
from mllm_server import MllmServer
from openai import AsyncOpenAI, OpenAI
from servers import BODY, QUESTION, Served, data_url, picture, problem, slow
from waiting import TIME_LIMIT, eventually

from cow_service.api.middleware.access import hash_of, new_key
from cow_service.api.openai.records import Answerer, answerers
from cow_service.records import Answer
from cow_service.service import Service
from cow_service.settings import Settings

pytestmark = pytest.mark.slow
MLLM = "cow/qwen3-vl-8b"
WITHOUT = ":no-imagination"
SCENE = example("ball-and-mug")
SCENE_URL = "data:image/jpeg;base64," + base64.b64encode(SCENE.image).decode()
# What the reader would have to find, and a clip that takes no time.
QUICK = {name: BODY[name] for name in ("grounding", "motion", "num_frames", "frames")}
OPEN = "What does the red ball hit?"


def text(words: str) -> dict[str, Any]:
    return {"type": "text", "text": words}


def image(url: str, **others: Any) -> dict[str, Any]:
    return {"type": "image_url", "image_url": {"url": url, **others}}


def user(*parts: dict[str, Any]) -> dict[str, Any]:
    return {"role": "user", "content": list(parts)}


def asked(words: str = QUESTION + " (A) Yes (B) No", shift: int = 0) -> list[Any]:
    return [user(image(data_url(picture(shift))), text(words))]


def vlmevalkit(model: str) -> dict[str, Any]:
    content = [image(SCENE_URL, detail="low"), text(SCENE.meta["question"])]
    return {"model": model, "messages": [user(*content)], "max_tokens": 2048, "n": 1, "temperature": 0}


def vlmevalkit_choices(model: str) -> dict[str, Any]:
    """As it asks multiple-choice questions of its own data sets."""
    asks = SCENE.meta["question"].partition(" Answer by")[0]
    end = "Please select the correct answer from the options above. \n"
    words = f"Question: {asks}\nOptions:\nA. Yes\nB. No\nC. Not sure\n{end}"
    return {**vlmevalkit(model), "messages": [user(image(SCENE_URL, detail="high"), text(words))]}


def lmms_eval(model: str) -> dict[str, Any]:
    content = [text(SCENE.meta["question"]), image(SCENE_URL)]
    return {"model": model, "messages": [user(*content)], "max_completion_tokens": 1024, "temperature": 0}


def lmms_eval_of_thinkers(model: str) -> dict[str, Any]:
    """As it asks models with `o3` or `gpt-5` in their names."""
    told = lmms_eval(model) | {"reasoning_effort": "medium", "response_format": {"type": "text"}}
    return {name: value for name, value in told.items() if name != "temperature"}


@pytest.fixture(scope="module")
def mllm() -> Iterator[MllmServer]:
    with say.mllm_server() as server:
        yield server


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory, mllm: MllmServer) -> Iterator[Served]:
    own = {"COW_MLLM": "qwen3-vl-8b", "COW_MLLM_BASE_URL": mllm.address, "COW_MAX_BODY_MB": "3"}
    with Served(tmp_path_factory.mktemp("chat"), **own) as one:
        yield one
        assert "Traceback" not in one.log()


def base_of(served: Served) -> str:
    return f"{served.http.base_url}/v1"


@pytest.fixture(scope="module")
def client(served: Served) -> Iterator[OpenAI]:
    with OpenAI(base_url=base_of(served), api_key="any", max_retries=0, timeout=60) as one:
        yield one


@pytest.fixture
def chat(client: OpenAI) -> Any:
    return client.chat.completions.create


def refused(call: Any, kind: type[openai.APIStatusError], code: str) -> openai.APIStatusError:
    """The error that a call ends with; its body is a whole problem, too."""
    with pytest.raises(kind) as caught:
        call()
    error = caught.value
    assert error.code == code
    told = problem(error.response, error.status_code, code)
    assert set(told) == {"type", "title", "status", "detail", "errors", "error"}
    assert told["error"]["message"] == told["detail"]
    assert error.request_id
    return error


# --- models ---


def test_every_reader_is_a_model_with_and_without_imagination(client: OpenAI) -> None:
    models = [model.id for model in client.models.list()]
    assert [models[0], models[1], *models[-2:]] == [MLLM, MLLM + WITHOUT, "cow/embedded", "cow/embedded" + WITHOUT]
    for name in models:
        found = client.models.retrieve(name)
        assert (found.id, found.object, found.owned_by) == (name, "model", "cow")
        assert found.created > 1_700_000_000
    refused(lambda: client.models.retrieve("cow/nobody"), openai.NotFoundError, "model-not-found")


def test_an_unknown_model_is_told_what_there_is(chat: Any) -> None:
    for name in ("gpt-4o", "embedded", MLLM + ":no"):
        error = refused(lambda name=name: chat(model=name, messages=asked()), openai.NotFoundError, "model-not-found")
        assert error.param == "model"
        assert f"{MLLM}, {MLLM}{WITHOUT}" in error.message


def test_names_of_mllms_may_hold_colons(tmp_path: Path) -> None:
    def names(**settings: Any) -> list[tuple[str, str]]:
        with Service(Settings(data_dir=tmp_path, **settings)) as service:
            return [(name, one.reader) for name, one in answerers(service).items() if one == Answerer(one.reader)]

    assert names() == [("cow/embedded", "embedded")]
    assert names(mllm="openai:gpt-5") == [("cow/openai:gpt-5", "mllm"), ("cow/embedded", "embedded")]
    assert names(mllm="tiny-qwen3-vl", reader="local")[0] == ("cow/tiny-qwen3-vl", "local")
    assert names(mllm="generic", reader="embedded") == [("cow/embedded", "embedded"), ("cow/generic", "mllm")]


# --- answers ---


@pytest.mark.parametrize("payload", [vlmevalkit, vlmevalkit_choices, lmms_eval, lmms_eval_of_thinkers])
def test_what_harnesses_send_is_answered_with_a_letter(chat: Any, payload: Any) -> None:
    told = chat(**payload("cow/embedded"))
    assert (told.choices[0].message.content, told.choices[0].finish_reason) == (SCENE.meta["answer"], "stop")
    answer = Answer.model_validate(told.cow)
    assert answer.simulation is not None
    assert answer.warnings == ()
    assert (told.id, told.object, told.model) == (f"chatcmpl-{answer.id}", "chat.completion", "cow/embedded")
    bare = chat(**payload("cow/embedded" + WITHOUT))
    assert bare.choices[0].message.content == SCENE.meta["not_sure"]
    assert bare.cow["simulation"] is None


@pytest.mark.parametrize(
    ("form", "said"),
    [
        (
            "\nThe entire content of your response should be of the format 'ANSWER: $LETTER' (without quotes).",
            "ANSWER: A",
        ),
        (" Write your response into this json template: {'Answer': '<Your answer>'}", '{"Answer": "A"}'),
    ],
)
def test_the_embedded_reader_replies_in_the_form_that_is_asked_for(chat: Any, form: str, said: str) -> None:
    messages = [user(image(SCENE_URL), text(SCENE.meta["question"] + form))]
    assert chat(model="cow/embedded", messages=messages).choices[0].message.content == said


def test_it_is_the_same_as_answer_says(served: Served, chat: Any) -> None:
    told = chat(model="cow/embedded", messages=vlmevalkit("")["messages"], seed=4, extra_body={"cow": {"votes": 2}})
    job = served.http.get(f"/jobs/{told.cow['id']}").json()
    assert job["kind"] == "answer"
    assert job["result"] == told.cow
    assert told.cow["simulation"]["generator"]["seed"] == 4
    assert sum(told.cow["votes"].values()) == 2


@pytest.mark.parametrize("imagine", [True, False])
def test_an_mllm_with_and_without_imagination(mllm: MllmServer, chat: Any, imagine: bool) -> None:
    """More of this in test_chat_mllm.py."""

    def reply(handler: Any) -> None:
        frames = len(mllm.images(-1)) > 1
        handler.send(200, say.completion("It rolls there: A" if frames else "no idea"))

    mllm.say(reply)
    extra = {"cow": {**QUICK, "grounding": {"bbox": [40, 60, 80, 100], "object": "red ball"}}} if imagine else {}
    told = chat(model=MLLM if imagine else MLLM + WITHOUT, messages=asked(), extra_body=extra)
    assert told.choices[0].message.content == ("It rolls there: A" if imagine else "no idea")
    assert told.cow["imagined"] is imagine
    assert (told.usage.prompt_tokens, told.usage.completion_tokens, told.usage.total_tokens) == (100, 10, 110)
    assert told.id == "x"


def test_open_questions_and_those_that_are_not_sure(chat: Any) -> None:
    told = chat(model="cow/embedded" + WITHOUT, messages=asked(OPEN, 2), max_tokens=1, top_p=None)
    assert told.choices[0].message.content == "Not sure"
    assert told.cow["answer"] is None
    assert told.cow["warnings"][0] == "The answer is longer than 1 tokens: answers are not cut."


def test_earlier_turns_are_not_read_and_that_is_said(chat: Any) -> None:
    content = vlmevalkit("")["messages"][0]["content"]
    first = chat(model="cow/embedded", messages=[user(*content)])
    turns = [
        {"role": "system", "content": "You are terse."},
        user(content[0], text("What is here?")),
        first.choices[0].message.model_dump(),
        user(content[0], text("If the yellow ball moves to the left,"), text("will it hit the blue mug?")),
    ]
    told = chat(model="cow/embedded", messages=turns, temperature=0.3, stop=["\n"], user="me", store=False)
    assert told.cow["question"] == "If the yellow ball moves to the left,\nwill it hit the blue mug?"
    unread, unused, *_ = told.cow["warnings"]
    assert "0 (system), 1 (user), 2 (assistant)" in unread
    assert unused.startswith("Not used: `stop`, `temperature`.")


def test_the_same_key_is_the_same_job(served: Served, chat: Any) -> None:
    key = {"Idempotency-Key": "chat-1"}
    told = [chat(model="cow/embedded", messages=asked(), extra_headers=key).id for _ in range(2)]
    assert told[0] == told[1]
    again = {**BODY, "question": asked()[0]["content"][1]["text"]}
    response = served.http.post("/answer", json=again, headers=key)
    problem(response, 422, "idempotency-key-reused")
    assert "error" not in response.json()
    other = {"model": "cow/embedded", "messages": asked(), "seed": 2, "extra_headers": key}
    refused(lambda: chat(**other), openai.UnprocessableEntityError, "idempotency-key-reused")


def test_what_was_found_before_is_found_again(chat: Any) -> None:
    given = {"model": "cow/embedded", "messages": asked(shift=3)}
    chat(**given)
    assert "answering" in chat(**given).cow["reused"]
    assert chat(**given, extra_headers={"Cache-Control": "no-cache"}).cow["reused"] == []


def test_a_caller_may_take_the_job_instead(served: Served) -> None:
    body = {"model": "cow/embedded", "messages": asked(shift=4)}
    job = served.submit(body, "/v1/chat/completions")
    assert served.ended(job["id"])["status"] == "succeeded"


def test_it_may_be_asked_from_an_event_loop(served: Served) -> None:
    async def ask() -> list[str]:
        async with AsyncOpenAI(base_url=base_of(served), api_key="any", max_retries=0) as client:
            create = client.chat.completions.create
            told = await create(**vlmevalkit("cow/embedded"))
            chunks = [chunk async for chunk in await create(**vlmevalkit("cow/embedded"), stream=True)]
            with pytest.raises(openai.NotFoundError):
                await create(model="nobody", messages=asked())
        said = "".join(chunk.choices[0].delta.content or "" for chunk in chunks)
        return [told.choices[0].message.content or "", said]

    assert asyncio.run(ask()) == ["A", "A"]


# --- refusals ---


@pytest.mark.parametrize(
    ("given", "param", "told"),
    [
        ({"seed": -1}, "seed", "greater than or equal to 0"),
        ({"extra_body": {"cow": {"votes": 99}}}, "cow.votes", "/cow/votes"),
        ({"extra_body": {"cow": {"vote": 1}}}, "cow.vote", "no such field"),
        ({"extra_body": {"cow": {"reader": "mllm"}}}, "cow.reader", "`model`"),
        ({"extra_body": {"cow": {"imagine": "never"}}}, "cow.imagine", "`model`"),
        ({"extra_body": {"cow": {"seed": 1}}, "seed": 1}, "cow.seed", "once"),
        ({"extra_body": {"cow": {"generator": "nobody"}}}, "cow.generator", "cutout"),
        ({"extra_body": {"cow": {"num_frames": 4, "frames": {"indices": [9]}}}}, "cow.frames.indices[0]", "0 to 3"),
        ({"extra_body": {"cow": {"grounding": {"point": [999, 1]}}}}, "cow.grounding.point", "outside"),
        ({"messages": []}, "messages", "image"),
        ({"messages": [{"role": "user", "content": QUESTION}]}, "messages[0].content", "add a part"),
        ({"messages": [user(image(data_url(picture())))]}, "messages[0].content", "question"),
        ({"messages": [*asked(), user(image(data_url(picture(9))), text("?"))]}, "messages[0].content[0].image_url.url",
         "got 2"),
        ({"messages": [{"role": "system", "content": [image(SCENE_URL)]}]}, "messages[0].content[0]", "`user`"),
        ({"messages": [user(image("file:///etc/passwd"), text("?"))]}, "messages[0].content[0].image_url.url", "data"),
        ({"messages": [user(image("data:image/png;base64,!!"), text("?"))]}, "messages[0].content[0].image_url.url",
         "base64"),
        ({"messages": [user(image(SCENE_URL), text("x" * 4001))]}, "messages[0].content", "4000"),
        ({"messages": [user(image(SCENE_URL), {"type": "input_audio", "input_audio": {}})]},
         "messages[0].content[1].type", "text"),
        ({"messages": [{"role": "tool", "content": "1", "tool_call_id": "x"}]}, "messages[0].content", "user"),
        ({"messages": [{"role": "user"}]}, "messages[0].content", "add a part"),
    ],
)  # fmt: skip
def test_what_cannot_be_done_is_refused_by_name(chat: Any, given: dict[str, Any], param: str, told: str) -> None:
    body = {"model": "cow/embedded", "messages": asked(), **given}
    error = refused(lambda: chat(**body), openai.UnprocessableEntityError, "invalid-request")
    assert (error.param, error.type) == (param, "invalid_request_error")
    assert told in error.message


ASKING: dict[str, Any] = {
    "n": 2, "tools": [{"type": "function", "function": {"name": "f"}}], "tool_choice": "required",
    "functions": [{"name": "f"}], "logprobs": True, "top_logprobs": 3, "response_format": {"type": "json_object"},
    "modalities": ["text", "audio"], "temperature": "hot", "stop": 7, "best_of": 3, "enable_thinking": True,
}  # fmt: skip
SILENT: dict[str, Any] = {
    "n": 1, "tools": [], "tool_choice": "auto", "logprobs": False, "response_format": {"type": "text"},
    "temperature": 1, "stop": [], "user": "me", "max_tokens": "many", "audio": None, "enable_thinking": False,
}  # fmt: skip


def test_fields_that_the_embedded_reader_cannot_use_are_named_and_not_refused(chat: Any) -> None:
    told = chat(model="cow/embedded", messages=asked(), extra_body={"cow": QUICK, **ASKING})
    (unused,) = (warning for warning in told.cow["warnings"] if warning.startswith("Not used"))
    names = [f"`{name}`" for name in ASKING]
    assert unused.startswith(f"Not used: {', '.join(names[:10])} and 2 more.")
    assert len(told.choices) == 1
    told = chat(model="cow/embedded", messages=asked(), extra_body={"cow": QUICK, **SILENT})
    assert not any(warning.startswith("Not used") for warning in told.cow["warnings"])


def test_images_that_cannot_be_used(chat: Any) -> None:
    def with_image(url: str) -> dict[str, Any]:
        return {"model": "cow/embedded", "messages": [user(image(url), text("?"))]}

    gif = "data:image/gif;base64," + base64.b64encode(b"GIF89a.......").decode()
    refused(lambda: chat(**with_image(gif)), openai.APIStatusError, "image-type-unsupported")
    for_url = "https://example.org/a.png"
    refused(lambda: chat(**with_image(for_url)), openai.UnprocessableEntityError, "image-url-not-allowed")


def test_bodies_that_cannot_be_read(served: Served) -> None:
    def post(content: bytes, media_type: str = "application/json") -> httpx.Response:
        return served.http.post("/v1/chat/completions", content=content, headers={"content-type": media_type})

    for response, status, code in (
        (post(b"{"), 400, "malformed-body"),
        (post(b"{}", "text/plain"), 415, "body-type-unsupported"),
        (post(b"--x", "multipart/form-data; boundary=x"), 415, "body-type-unsupported"),
        (post(b" " * 3_100_000), 413, "body-too-large"),
        (served.http.get("/v1/chat/completions"), 405, "method-not-allowed"),
        (served.http.get("/v1/nothing"), 404, "not-found"),
        (served.http.get("/v1/models", headers={"Origin": "http://evil.example"}), 403, "origin-not-allowed"),
    ):
        told = problem(response, status, code)["error"]
        assert (told["code"], told["param"]) == (code, None)
        assert response.headers["content-length"] == str(len(response.content))
    assert "error" not in problem(served.http.get("/nothing"), 404, "not-found")


# --- streams ---


def slowly(seed: int, seconds: float = 30) -> dict[str, Any]:
    asks = slow(seconds, seed=seed)
    cow = {name: value for name, value in asks.items() if name not in ("image", "question")}
    return {"model": "cow/embedded", "messages": asked(), "extra_body": {"cow": cow}}


def chunks_of(chat: Any, **given: Any) -> list[Any]:
    with chat(stream=True, **given) as stream:
        return list(stream)


def test_a_stream_tells_its_progress_and_then_the_answer(chat: Any) -> None:
    given = slowly(11, seconds=1.2) | {"stream_options": {"include_usage": True}}
    started = time.monotonic()
    first, *progress, reasoning, content, last, usage = chunks_of(chat, **given)
    took = time.monotonic() - started
    assert (first.choices[0].delta.role, first.choices[0].delta.content) == ("assistant", "")
    job = first.cow["job"]
    assert set(first.cow) == {"job", "status", "stage", "progress"}
    assert first.cow["status"] in ("queued", "running")
    done = [first.cow["progress"], *(chunk.cow["progress"] for chunk in progress)]
    assert done == sorted(done)
    assert 3 <= len(set(done)) <= 3 + took / 0.25  # not more than a few a second
    assert all(chunk.choices[0].delta.content is None for chunk in progress)
    assert "generation" in {chunk.cow["stage"] for chunk in progress}
    answer = Answer.model_validate(last.cow)
    assert reasoning.choices[0].delta.reasoning_content == answer.reasoning != ""
    assert content.choices[0].delta.content == (answer.answer or "Not sure")
    assert last.choices[0].finish_reason == "stop"
    assert answer.id == job
    assert (usage.choices, usage.usage.total_tokens) == ([], 0)
    whole = [first, *progress, reasoning, content, last, usage]
    assert {chunk.id for chunk in whole} == {f"chatcmpl-{job}"}
    assert {chunk.object for chunk in whole} == {"chat.completion.chunk"}
    assert len({chunk.created for chunk in whole}) == 1


def test_a_stream_on_the_wire(served: Served) -> None:
    body = {"model": "cow/embedded", "messages": [*asked(), {"role": "assistant", "content": "so"}], "stream": True}
    response = served.http.post("/v1/chat/completions", json=body)
    assert response.headers["content-type"].startswith("text/event-stream")
    *events, end = [block.removeprefix("data: ") for block in response.text.split("\n\n") if block.strip()]
    assert end == "[DONE]"
    told = [json.loads(event) for event in events]
    assert not any(event["usage"] for event in told)
    assert "1 (assistant)" in told[-1]["cow"]["warnings"][0]


def test_errors_before_a_stream_are_answers(chat: Any) -> None:
    given = {"model": "nobody", "messages": asked()}
    refused(lambda: chunks_of(chat, **given), openai.NotFoundError, "model-not-found")


def test_a_job_that_fails_ends_its_stream_with_the_problem(chat: Any) -> None:
    extra = {"cow": {"grounding": {"point": [999, 1]}}}
    heard: list[Any] = []
    with pytest.raises(openai.APIError, match="outside") as caught:
        heard.extend(chat(model="cow/embedded", messages=asked(), stream=True, extra_body=extra))
    assert (caught.value.code, caught.value.param) == ("invalid-request", "cow.grounding.point")


@pytest.mark.parametrize(("key", "status"), [(None, "canceled"), ("chat-left", "running")])
def test_a_caller_who_leaves_a_stream(served: Served, chat: Any, key: str | None, status: str) -> None:
    headers = {} if key is None else {"Idempotency-Key": key}
    with chat(stream=True, extra_headers=headers, **slowly(21)) as stream:
        job = next(iter(stream)).cow["job"]
        served.rendering(job)
    if status == "canceled":
        served.until(job, "canceled")
        return
    with pytest.raises(AssertionError):
        eventually(lambda: served.job(job)["status"] != "running")
    with ThreadPoolExecutor(1) as pool:  # a returning caller gets the rest
        again = pool.submit(lambda: chunks_of(chat, extra_headers=headers, **slowly(21)))
        served.http.post(f"/jobs/{job}/cancel")
        with pytest.raises(openai.APIError) as caught:
            again.result()
    assert caught.value.code == "canceled"


def test_a_caller_who_leaves_a_plain_call(served: Served) -> None:
    asks = slowly(22)
    body = json.dumps({"model": asks["model"], "messages": asks["messages"], **asks["extra_body"]}).encode()
    told = {"Host": "cow", "Content-Type": "application/json", "Content-Length": str(len(body))}
    head = "\r\n".join(["POST /v1/chat/completions HTTP/1.1", *(f"{name}: {value}" for name, value in told.items())])
    with socket.create_connection(served.host_and_port) as raw:
        raw.sendall(f"{head}\r\n\r\n".encode() + body)
        job = eventually(
            lambda: served.http.get("/jobs", params={"status": "running", "limit": 1}).json()["jobs"] or None
        )[0]["id"]
        served.rendering(job)
    served.until(job, "canceled")


# --- keys, and a server that stops ---


def test_keys_and_rates(tmp_path: Path) -> None:
    key = new_key()
    with Served(tmp_path, COW_API_KEYS=json.dumps({"alice": hash_of(key)}), COW_RATE_LIMIT="3") as one:
        with OpenAI(base_url=base_of(one), api_key="wrong", max_retries=0) as stranger:
            error = refused(lambda: list(stranger.models.list()), openai.AuthenticationError, "unauthorized")
            assert error.type == "authentication_error"
        with OpenAI(base_url=base_of(one), api_key=key, max_retries=0) as alice:
            told = alice.chat.completions.create(model="cow/embedded", messages=asked())
            mine = one.http.get(f"/jobs/{told.cow['id']}", headers={"Authorization": f"Bearer {key}"})
            assert mine.status_code == 200
            list(alice.models.list())
            error = refused(lambda: list(alice.models.list()), openai.RateLimitError, "rate-limited")
            assert (error.type, int(error.response.headers["retry-after"]) > 0) == ("rate_limit_error", True)


def test_a_server_that_stops_says_so_in_the_stream(tmp_path: Path) -> None:
    with (
        Served(tmp_path, COW_SHUTDOWN_GRACE="0.5") as one,
        OpenAI(base_url=base_of(one), api_key="any", max_retries=0) as client,
        client.chat.completions.create(stream=True, **slowly(23)) as stream,
    ):
        one.rendering(next(iter(stream)).cow["job"])
        one.ask_to_stop()
        with pytest.raises(openai.APIError) as caught:
            list(stream)
        assert caught.value.code == "shutting-down"
        assert one.process is not None
        one.process.wait(TIME_LIMIT)
        assert "Traceback" not in one.log()
