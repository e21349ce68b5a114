"""Chats with MLLMs that do not speak OpenAI's protocol, and the editing of JSON texts; in this process."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import mllm_server as say
import pytest
from asgi import ask
from chats import COW, HELLO, chunks_of, content_of, image, text, user
from engines import app_for
from fastapi import FastAPI
from hypothesis import given
from hypothesis import strategies as st
from mllm_server import MllmServer
from refusals import refused
from servers import QUESTION, problem

from cow_service.api.body import read_object
from cow_service.api.openai.chats import as_json
from cow_service.readers.chat import Upstream
from cow_service.service import Service
from cow_service.settings import Settings
from cow_service.weights.manifests import load_families

pytestmark = pytest.mark.slow

NAME = "cow/anthropic:claude-x"


def reply(*content: dict[str, Any], stop: str = "end_turn") -> say.Reply:
    usage = {"input_tokens": 12, "output_tokens": 3}
    return say.shaped({"id": "msg_1", "type": "message", "role": "assistant", "model": "claude-x", "usage": usage,
                       "content": list(content), "stop_reason": stop, "stop_sequence": None})  # fmt: skip


SAID = {"type": "text", "text": "ANSWER: A"}


@pytest.fixture(scope="module")
def mllm() -> Iterator[MllmServer]:
    with say.mllm_server() as server:
        yield server


@pytest.fixture(scope="module")
def app(tmp_path_factory: pytest.TempPathFactory, mllm: MllmServer) -> FastAPI:
    own = {"mllm_base_url": mllm.address.removesuffix("/v1"), "mllm_api_key": "k"}
    settings = Settings(data_dir=tmp_path_factory.mktemp("provider"), mllm="anthropic:claude-x", **own)
    return app_for(Service(settings))


def post(app: FastAPI, body: dict[str, Any], path: str = "chat/completions") -> httpx.Response:
    headers = {"Content-Type": "application/json"}
    return ask(app, ("POST", f"/v1/{path}", headers, json.dumps(body)))[0]


def test_a_chat_through_another_protocol(app: FastAPI, mllm: MllmServer) -> None:
    mllm.say(reply({"type": "thinking", "thinking": "It rolls.", "signature": "s"}, SAID))
    messages = [
        {"role": "system", "content": "Be terse."},
        {"role": "user", "content": "hello"},
        {"role": "assistant", "content": "Hi."},
        user(image(), text(QUESTION)),
    ]
    body = {"model": NAME, "messages": messages, "cow": COW, "temperature": 0.5, "max_tokens": 99, "stop": "END",
            "n": 2, "logprobs": True, "enable_thinking": False, "top_p": None}  # fmt: skip
    told = post(app, body).json()
    choice = told["choices"][0]
    assert (choice["message"]["content"], choice["finish_reason"]) == ("ANSWER: A", "stop")
    assert choice["message"]["reasoning_content"] == "It rolls."
    assert told["usage"] == {"prompt_tokens": 12, "completion_tokens": 3, "total_tokens": 15}
    assert told["cow"]["imagined"]
    assert "`n`, `logprobs`, `enable_thinking`" in told["cow"]["warnings"][-1]  # those were not sent
    sent = mllm.asked[-1]
    assert (sent["temperature"], sent["max_tokens"], sent["stop_sequences"]) == (0.5, 99, ["END"])
    assert "Be terse." in json.dumps(sent["system"])
    assert [message["role"] for message in sent["messages"]] == ["user", "assistant", "user"]
    kinds = [part["type"] for part in sent["messages"][2]["content"]]
    assert kinds == ["image", "text", "text", "image"]


def test_tools_and_streams_through_another_protocol(app: FastAPI, mllm: MllmServer) -> None:
    tool = {"type": "function", "function": {"name": "submit", "parameters": {"type": "object", "properties": {}}}}
    mllm.say(reply({"type": "tool_use", "id": "t1", "name": "submit", "input": {"letter": "A"}}, stop="tool_use"))
    asked = {"model": NAME, "messages": HELLO, "tools": [tool]}
    message = post(app, asked).json()["choices"][0]["message"]
    assert json.loads(message["tool_calls"][0]["function"]["arguments"]) == {"letter": "A"}
    mllm.say(reply(SAID))
    result = {"role": "tool", "tool_call_id": "t1", "content": "right"}
    response = post(app, {**asked, "messages": [*asked["messages"], message, result], "stream": True})
    assert mllm.asked[-1]["messages"][2]["content"][0]["type"] == "tool_result"
    chunks = chunks_of(response)
    assert chunks[0]["cow"]["reason"] == "no-image"
    assert content_of(chunks) == "ANSWER: A"
    told = post(app, {"model": NAME, "input": "hello"}, "responses").json()
    assert told["output"][0]["content"][0]["text"] == "ANSWER: A"


def test_what_another_protocol_refuses_or_cannot_be_sent(app: FastAPI, mllm: MllmServer) -> None:
    mllm.say(say.status(429, retry_after="7"))
    response = post(app, {"model": NAME, "messages": HELLO})
    assert (response.status_code, response.headers["retry-after"]) == (429, "7")
    assert response.json()["error"]["code"] == "429"
    assert len(mllm.asked) == 1  # no retries
    for message, param in (
        (user({"type": "video_url", "video_url": {}}), "messages[0].content[0]"),
        ({"role": "narrator", "content": "x"}, "messages[0].role"),
        ("x", "messages[0]"),
    ):
        told = problem(post(app, {"model": NAME, "messages": [message]}), 422, "invalid-request")
        assert told["error"]["param"] == param
    assert len(mllm.asked) == 1


def test_where_chats_go_on_as_they_are(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from cow_service.readers.mllm.reader import create

    monkeypatch.setenv("OPENAI_API_KEY", "of-the-environment")

    def upstream(mllm: str, **settings: Any) -> Upstream | None:
        reader = create(Settings(data_dir=tmp_path, mllm=mllm, **settings))
        reader.close()
        return reader.upstream

    own = {"mllm_base_url": "http://127.0.0.1:9/v1/", "mllm_api_key": "k"}
    assert upstream("qwen3-vl-8b", **own) == Upstream("http://127.0.0.1:9/v1", "Qwen/Qwen3-VL-8B-Instruct", "k")
    assert upstream("openai:gpt-5") == Upstream("https://api.openai.com/v1", "gpt-5", "of-the-environment")
    assert upstream("openai:gpt-5", mllm_base_url="http://127.0.0.1:9/v1").key is None
    assert upstream("anthropic:claude-x", **own) is None
    assert upstream("google:gemini-2.5-pro", mllm_api_key="k") is None
    assert "of-the-environment" not in repr(upstream("openai:gpt-5"))


def test_what_a_model_in_the_process_does_not_take() -> None:
    from pydantic_ai.exceptions import UserError
    from pydantic_ai.models.test import TestModel

    from cow_service.readers.mllm.chat import prepare_chat
    from cow_service.readers.mllm.client import MllmClient
    from cow_service.readers.mllm.known import mllm_manifests
    from cow_service.readers.mllm.models import ConfiguredModel

    class Refusing(TestModel):
        """As a model in the process, which takes fewer settings, and no tools."""

        unsupported_settings = frozenset({"frequency_penalty"})

        async def request(self, *_: Any) -> Any:
            raise UserError("no tools here")

    asked = {"messages": HELLO, "frequency_penalty": 1, "temperature": 0}
    chat = prepare_chat(asked, Refusing())
    assert chat.settings == {"temperature": 0}
    assert "`frequency_penalty`" in chat.warnings[0]
    configured = ConfiguredModel(Refusing(), "toy", mllm_manifests()["generic"], load_families()["generic"])
    client = MllmClient(configured, Settings())
    with refused("invalid-request") as caught:
        asyncio.run(client.chat(asked))
    assert "no tools here" in caught.value.detail
    client.close()


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(),
    lambda each: st.lists(each, max_size=3) | st.dictionaries(st.text(max_size=3), each, max_size=3),
)


@given(st.dictionaries(st.text(max_size=3), JSON, max_size=6), st.sampled_from([None, 0, 2]))
def test_a_body_is_read_and_written_without_a_change(held: dict[str, Any], indent: int | None) -> None:
    written = as_json(read_object(json.dumps(held, indent=indent), "It"))
    assert repr(json.loads(written)) == repr(held)  # the order of its members, too, and 1.0 is not 1
