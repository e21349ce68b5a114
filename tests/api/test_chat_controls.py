"""Models whose names have suffixes: controls that any harness can run, on a real server with an MLLM on loopback."""

from __future__ import annotations

import base64
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from chats import CHOICES, EMBEDDED, NAME, chunks_of, content_of, post, saying, told, what_if
from conftest import example
from numpy.typing import NDArray
from random_mllm import USAGE, RandomMllm, failing
from refusals import refused
from servers import BODY, Served, picture, problem

from cow_service.api.openai.records import Answerer, answerers, find_answerer
from cow_service.media.images import decode, encode_png, fit_within
from cow_service.readers.mllm.contents import QUESTIONS, other_item
from cow_service.service import Service
from cow_service.settings import Settings

if TYPE_CHECKING:
    from openai import OpenAI

pytest_plugins = ("chat_server",)
pytestmark = pytest.mark.slow
COW = {name: BODY[name] for name in ("grounding", "motion")} | {"num_frames": 41}
TWO = {"frames": {"count": 2, "max_side": 128}}


def chat(suffixes: str, words: str = CHOICES, shift: int = 0, **others: Any) -> dict[str, Any]:
    return {"model": NAME + suffixes, "messages": what_if(shift, words), **others}


def ask(served: Served, suffixes: str, **others: Any) -> dict[str, Any]:
    return told(post(served, chat(suffixes, **others)))


def shown(mllm: RandomMllm) -> tuple[str, list[NDArray[np.uint8]]]:
    """The note and the pictures behind the caller's own content, as the MLLM was sent them."""
    *_, note = (part["text"] for part in mllm.last()["messages"][0]["content"] if part["type"] == "text")
    urls = [part["image_url"]["url"] for part in mllm.last()["messages"][0]["content"] if part["type"] == "image_url"]
    return note, [decode(base64.b64decode(url.partition(",")[2])).pixels for url in urls[1:]]


def distance(a: NDArray[np.uint8], b: NDArray[np.uint8]) -> float:
    return float(np.abs(a.astype(float) - b).mean())


# --- names ---


def test_the_models_that_are_listed(client: OpenAI) -> None:
    models = [model.id for model in client.models.list()]
    suffixes = ("", ":no-imagination", ":still", ":wrong-direction", ":other-item", ":text", ":initial", ":events",
                ":vote-3", ":no-imagination:vote-3")  # fmt: skip
    assert models == [*(NAME + suffix for suffix in suffixes), EMBEDDED, EMBEDDED + ":no-imagination"]
    for name in (models[0], models[-1], f"{NAME}:vote-9:still:initial"):
        found = client.models.retrieve(name)
        assert (found.id, found.object, found.owned_by) == (name, "model", "cow")
        assert found.created > 1_700_000_000


def test_names_of_mllms_may_hold_colons(tmp_path: Path) -> None:
    def names(**settings: Any) -> list[tuple[str, str]]:
        with Service(Settings(data_dir=tmp_path, **settings)) as service:
            return [(name, one.reader) for name, one in answerers(service).items() if one == Answerer(one.reader)]

    assert names() == [("cow/embedded", "embedded")]
    assert names(mllm="openai:gpt-5") == [("cow/openai:gpt-5", "mllm"), ("cow/embedded", "embedded")]
    assert names(mllm="tiny-qwen3-vl", reader="local")[0] == ("cow/tiny-qwen3-vl", "local")
    assert names(mllm="generic", reader="embedded") == [("cow/embedded", "embedded"), ("cow/generic", "mllm")]
    with Service(Settings(data_dir=tmp_path, mllm="openai:ft:x:still")) as service:
        found = find_answerer(service, "cow/openai:ft:x:still:vote-3:still")
        assert (found.reader, found.content, found.votes) == ("mllm", "still", 3)
        assert find_answerer(service, "cow/openai:ft:x:still").content == "simulated"
        assert "cow/openai:ft:x:still:still" in answerers(service)
        whole = "cow/openai:ft:x:still"
        ends = (":stil", ":still:text", ":vote-1", ":vote-10", ":vote-3:vote-4", ":initial:events", ":", ":still:")
        ends += (":no-imagination:initial",)
        for name in ("cow/openai:ft:x", "cow/embedded:still", "cow/embedded:vote-3", *(whole + end for end in ends)):
            with refused("model-not-found", "/model"):
                find_answerer(service, name)


# --- what is shown ---


@pytest.mark.parametrize("world", [{}, {"interventions": [{"kind": "remove", "object": "blue cube"}]}])
def test_placebos_are_as_many_pictures_of_the_same_size_under_the_same_note(
    served: Served, mllm: RandomMllm, world: dict[str, Any]
) -> None:
    cube = {"objects": [{"object": "blue cube", "bbox": [170, 60, 205, 98]}]}
    cow = {**COW, **TWO, **cube, **world}
    real = ask(served, "", cow=cow)["cow"]
    note, frames = shown(mllm)
    assert (real["content"], real["votes"], len(frames)) == ("simulated", None, 2)
    for content in ("still", "wrong-direction", "other-item"):
        reply = ask(served, f":{content}", cow=cow)["cow"]
        assert (reply["content"], reply["imagined"]) == (content, True)
        assert reply["simulation"] not in (None, real["simulation"])
        placebo_note, placebos = shown(mllm)
        assert placebo_note == note
        assert [each.shape for each in placebos] == [each.shape for each in frames]
        assert distance(placebos[-1], frames[-1]) > 0.5
        if content == "still" and not world:
            assert [distance(each, fit_within(decode(picture()).pixels, 128)) for each in placebos] == [0, 0]
        elif content == "wrong-direction":
            shape = served.http.get(reply["frames"][-1]["url"]).content
            assert world or np.array_equal(decode(shape).pixels, placebos[-1])
            assert [frame["index"] for frame in reply["frames"]] == [frame["index"] for frame in real["frames"]]


def test_another_item_is_always_the_same_and_never_the_callers_own(served: Served, mllm: RandomMllm) -> None:
    drawn = [(ask(served, ":other-item", cow=COW | TWO), shown(mllm)[1])[1] for _ in range(2)]
    assert np.array_equal(drawn[0], drawn[1])
    for name in QUESTIONS:
        own = decode(example(name).image).pixels
        again = decode(encode_png(fit_within(own, 300))).pixels  # as a harness would send it
        assert other_item(again)[0] != example(name).image


def test_facts_in_place_of_frames(served: Served, mllm: RandomMllm) -> None:
    cow = ask(served, ":text", cow=COW | TWO)["cow"]
    note, frames = shown(mllm)
    assert (frames, cow["frames"], set(cow["prompts"]), cow["content"]) == ([], [], {"imagined-facts"}, "text")
    assert re.search(r"- .*the blue object after about .*\n- \d+ of \d+ ", note)


@pytest.mark.parametrize("content", ["still", "wrong-direction", "other-item", "text"])
def test_where_nothing_is_imagined_no_placebo_is_shown(served: Served, mllm: RandomMllm, content: str) -> None:
    cow = {**COW, "grounding": None, "reader": "embedded"}
    reply = ask(served, f":{content}", words="If the giraffe jumps, will it land?", cow=cow)["cow"]
    assert (reply["imagined"], reply["reason"], reply["content"]) == (False, "cannot-ground", content)
    assert len(mllm.last()["messages"][0]["content"]) == 2


def test_what_goes_nowhere_has_no_wrong_direction(served: Served, mllm: RandomMllm) -> None:
    still = {**COW, "motion": {"kind": "static"}}
    for stream in (False, True):
        response = post(served, chat(":wrong-direction", cow=still, stream=stream))
        assert '"reason":"cannot-read-direction"' in response.text
        assert len(mllm.last()["messages"][0]["content"]) == 2
    assert ask(served, ":wrong-direction", cow={**COW, **TWO, "motion": {"kind": "fall"}})["cow"]["imagined"]


def test_the_frames_that_a_name_asks_for(served: Served, mllm: RandomMllm) -> None:
    cow = ask(served, ":initial", cow=COW)["cow"]
    assert [frame["index"] for frame in cow["frames"]] == [1, 3, 5]
    cow = ask(served, ":still:events", cow=COW)["cow"]
    assert (len(shown(mllm)[1]), cow["content"]) == (3, "still")
    for given, param in (({"frames": {"count": 1}}, "cow.frames"), ({"trajectory": {}}, "cow.trajectory")):
        response = post(served, chat(":wrong-direction:events", cow=given))
        assert problem(response, 422, "invalid-request")["error"]["param"] == param


def test_a_stream_of_a_placebo_tells_of_both_simulations(served: Served) -> None:
    chunks = chunks_of(post(served, chat(":wrong-direction", shift=3, cow=COW, stream=True)))
    cows = [chunk["cow"] for chunk in chunks if chunk.get("cow")]
    assert len({each["job"] for each in cows if "job" in each}) == 2
    assert (cows[-1]["content"], cows[-1]["imagined"]) == ("wrong-direction", True)


# --- votes ---


def test_the_most_frequent_answer_wins(served: Served, mllm: RandomMllm) -> None:
    mllm.next_replies = [saying(each) for each in ("ANSWER: A", "It is (B).\n\nANSWER: B", "ANSWER: B")]
    reply = ask(served, ":vote-3:initial", cow=COW, temperature=0, unknown=1)
    assert reply["choices"][0]["message"]["content"].endswith("ANSWER: B")
    assert reply["cow"]["votes"] == {"A": 1, "B": 2}
    assert reply["usage"]["prompt_tokens"] == 3 * USAGE["prompt_tokens"]
    assert reply["usage"]["prompt_tokens_details"]["cached_tokens"] == 12
    first, second, third = (each.fields for each in mllm.received)
    assert first == second == third
    assert (first["temperature"], first["unknown"]) == (0, 1)
    assert len(first["messages"][0]["content"]) == 6  # image, question, note, frames


def test_ties_votes_that_cannot_be_read_and_a_stream(served: Served, mllm: RandomMllm) -> None:
    mllm.next_replies = [saying(each) for each in ("I would rather not say what I see.", "ANSWER: B", "ANSWER: A")]
    body = chat(":no-imagination:vote-3", stream=True, stream_options={"include_usage": True})
    chunks = chunks_of(post(served, body))
    cow = next(chunk["cow"] for chunk in chunks if chunk.get("cow"))
    assert content_of(chunks) in ("ANSWER: A", "ANSWER: B")
    assert (cow["votes"], cow["content"], cow["reason"]) == ({"A": 1, "B": 1}, "none", "no-imagination")
    assert "1 of 3" in cow["warnings"][0]
    assert len(cow["warnings"]) == 2  # and that they are tied
    assert chunks[-1]["usage"]["total_tokens"] == 3 * USAGE["total_tokens"]
    assert not {"stream", "stream_options"} & set(mllm.last())


def test_what_cannot_be_voted_on_and_votes_that_fail(served: Served, mllm: RandomMllm) -> None:
    for given, param in (
        ({"words": "What does the ball hit?"}, "messages[0].content"),
        ({"n": 2}, "n"),
        ({"seed": 1}, "seed"),
    ):
        response = post(served, chat(":vote-3", **given, cow=COW))
        assert problem(response, 422, "invalid-request")["error"]["param"] == param
    response = post(served, {"model": f"{NAME}:vote-3", "messages": []})
    assert problem(response, 422, "invalid-request")["error"]["param"] == "messages"
    assert mllm.received == []
    slow_down = failing(429, {"error": {"message": "slow down"}}, retry_after="0")
    mllm.next_replies = [saying("ANSWER: A"), slow_down]
    response = post(served, chat(":no-imagination:vote-2"))
    assert (response.status_code, response.headers["retry-after"]) == (429, "0")
    mllm.next_replies = [saying("ANSWER: A")] * 2
    votes = told(post(served, {**chat(":no-imagination:vote-2"), "n": 1}))["cow"]["votes"]
    assert votes == {"A": 2}
