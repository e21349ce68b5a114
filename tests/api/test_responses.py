"""`POST /v1/responses`: chats in another form, without state."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest
from chats import COW, EMBEDDED, HELLO, NAME, image, post
from random_mllm import RandomMllm, cut
from servers import QUESTION, Served, data_url, picture, problem

if TYPE_CHECKING:
    from types import ModuleType

    from openai import OpenAI

pytest_plugins = ("chat_server",)
pytestmark = pytest.mark.slow
SEEN = {"type": "input_image", "image_url": data_url(picture(1)), "detail": "high"}


def asking(words: str = QUESTION) -> list[dict[str, Any]]:
    return [{"role": "user", "content": [SEEN, {"type": "input_text", "text": words}]}]


def test_responses_of_text_and_of_an_image(client: OpenAI, mllm: RandomMllm) -> None:
    reply = client.responses.create(model=NAME, input="hello", instructions="Be terse.", max_output_tokens=9)
    assert reply.output_text.startswith("It rolls on.")
    assert (reply.status, reply.usage.input_tokens, reply.usage.output_tokens) == ("completed", 21, 5)
    assert reply.usage.input_tokens_details.cached_tokens == 4
    assert (reply.instructions, reply.max_output_tokens, reply.cow["imagined"]) == ("Be terse.", 9, False)
    system = {"role": "system", "content": "Be terse."}
    sent = mllm.last()
    assert sent.pop("model") != NAME
    assert sent == {"messages": [system, *HELLO], "max_completion_tokens": 9}
    items = [
        {"role": "user", "content": "before"},
        {"type": "message", "role": "assistant", "content": [{"type": "output_text", "text": "said"}]},
        {"type": "reasoning", "id": "rs_1", "summary": []},
        *asking(),
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
    thought, said = {"type": "reasoning", "id": "rs_1", "summary": []}, {"role": "assistant", "content": "I submit."}
    client.responses.create(model=NAME, input=[*HELLO, thought, said, call.model_dump(), back])
    asked, called, output = mllm.last()["messages"]  # a message and its calls are one turn
    assert (asked, called["content"]) == (HELLO[0], "I submit.")
    assert called["tool_calls"][0]["function"] == {"name": "submit", "arguments": '{"letter": "A"}'}
    assert output == {"role": "tool", "tool_call_id": "call_1", "content": "right"}
    events = list(client.responses.create(input="hello", stream=True, **given))
    assert events[-1].response.output[0].name == "submit"


def test_a_streamed_response(openai: ModuleType, client: OpenAI, mllm: RandomMllm) -> None:
    extra = {"cow": COW, "enable_thinking": True}
    with client.responses.stream(model=NAME, input=asking(), extra_body=extra) as stream:
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
    given: dict[str, Any] = {"model": EMBEDDED, "input": asking(QUESTION + " (A) Yes (B) No (C) Not sure")}
    reply = client.responses.create(extra_body={"cow": COW}, **given)
    events = list(client.responses.create(stream=True, extra_body={"cow": COW}, **given))
    assert reply.output_text == events[-1].response.output_text != ""
    assert reply.cow["simulation"]["id"]


@pytest.mark.parametrize(
    ("given", "param"),
    [
        ({"previous_response_id": "resp_1"}, "previous_response_id"),
        ({"store": True}, "store"),
        ({"background": True}, "background"),
        ({"truncation": "auto"}, "truncation"),
        ({"include": ["file_search_call.results"]}, "include"),
        ({"tools": [{"type": "web_search"}]}, "tools[0].type"),
        ({"tool_choice": {"type": "file_search"}}, "tool_choice.type"),
        ({"input": [{"type": "item_reference", "id": "x"}]}, "input[0].type"),
        ({"input": [{"role": "user", "content": [image()]}]}, "input[0].content[0].type"),
        ({"input": [{"role": "user", "content": [{"type": "input_image", "file_id": "f"}]}]},
         "input[0].content[0].file_id"),
        ({"input": 3}, "input"),
        ({"text": 3}, "text"),
    ],
)  # fmt: skip
def test_what_needs_state_is_refused_by_name(served: Served, given: dict[str, Any], param: str) -> None:
    response = post(served, {"model": NAME, "input": "hello", **given}, "responses")
    assert problem(response, 422, "invalid-request")["error"]["param"] == param
