"""Models whose names have suffixes: controls that any harness can run, on a real server with an MLLM on loopback."""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import example
from numpy.typing import NDArray
from openai import OpenAI
from random_mllm import USAGE, RandomMllm, failing, random_mllm
from servers import BODY, QUESTION, Served, data_url, picture, problem

from cow_service.api.openai.records import answerers, find_answerer
from cow_service.errors import ModelNotFound
from cow_service.media.images import decode, encode_png, fit_within
from cow_service.readers.mllm.contents import QUESTIONS, other_item
from cow_service.service import Service
from cow_service.settings import Settings

pytestmark = pytest.mark.slow
NAME = "cow/qwen3-vl-8b"
CHOICES = f"{QUESTION} (A) Yes (B) No"
COW = {name: BODY[name] for name in ("grounding", "motion")} | {"num_frames": 41}
TWO = {"frames": {"count": 2, "max_side": 128}}


@pytest.fixture(scope="module")
def mllm() -> Iterator[RandomMllm]:
    with random_mllm() as one:
        yield one


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory, mllm: RandomMllm) -> Iterator[Served]:
    own = {"COW_MLLM": "qwen3-vl-8b", "COW_MLLM_BASE_URL": mllm.address}
    with Served(tmp_path_factory.mktemp("controls"), **own) as one:
        yield one
        assert "Traceback" not in one.log()


def chat(model: str, words: str = CHOICES, image: bytes | None = None, **others: Any) -> dict[str, Any]:
    url = data_url(picture() if image is None else image)
    content = [{"type": "image_url", "image_url": {"url": url}}, {"type": "text", "text": words}]
    return {"model": model, "messages": [{"role": "user", "content": content}], **others}


def ask(served: Served, model: str, **others: Any) -> dict[str, Any]:
    response = served.http.post("/v1/chat/completions", json=chat(model, **others))
    assert response.status_code == 200, response.text
    return response.json()


def shown(mllm: RandomMllm) -> tuple[str, list[NDArray[np.uint8]]]:
    """The note and the pictures behind the caller's own content, as the MLLM was sent them."""
    *_, note = (part["text"] for part in mllm.last()["messages"][0]["content"] if part["type"] == "text")
    urls = [part["image_url"]["url"] for part in mllm.last()["messages"][0]["content"] if part["type"] == "image_url"]
    return note, [decode(base64.b64decode(url.partition(",")[2])).pixels for url in urls[1:]]


def distance(a: NDArray[np.uint8], b: NDArray[np.uint8]) -> float:
    return float(np.abs(a.astype(float) - b).mean())


# --- names ---


def test_the_models_that_are_listed(served: Served) -> None:
    listed = [model["id"] for model in served.http.get("/v1/models").json()["data"]]
    suffixes = ("", ":no-imagination", ":still", ":wrong-direction", ":other-item", ":text", ":initial", ":events",
                ":vote-3", ":no-imagination:vote-3")  # fmt: skip
    assert listed == [*(NAME + suffix for suffix in suffixes), "cow/embedded", "cow/embedded:no-imagination"]
    assert served.http.get(f"/v1/models/{NAME}:vote-9:still:initial").status_code == 200


@pytest.mark.parametrize(
    "suffixes",
    [":stil", ":still:text", ":vote-1", ":vote-10", ":vote-3:vote-4", ":initial:events", ":no-imagination:still",
     ":no-imagination:initial", ":", ":still:"],
)  # fmt: skip
def test_suffixes_that_make_no_name(served: Served, suffixes: str) -> None:
    response = served.http.post("/v1/chat/completions", json=chat(NAME + suffixes))
    assert f"{NAME}:other-item" in problem(response, 404, "model-not-found")["detail"]


def test_names_of_mllms_may_hold_colons(tmp_path: Path) -> None:
    service = Service(Settings(data_dir=tmp_path, mllm="openai:ft:x:still"))
    found = find_answerer(service, "cow/openai:ft:x:still:vote-3:still")
    assert (found.reader, found.content, found.votes) == ("mllm", "still", 3)
    assert find_answerer(service, "cow/openai:ft:x:still").content == "simulated"
    assert "cow/openai:ft:x:still:still" in answerers(service)
    for name in ("cow/openai:ft:x", "cow/embedded:still", "cow/embedded:vote-3"):
        with pytest.raises(ModelNotFound):
            find_answerer(service, name)


# --- what is shown ---


@pytest.mark.parametrize("world", [{}, {"interventions": [{"kind": "remove", "object": "blue cube"}]}])
def test_placebos_are_as_many_pictures_of_the_same_size_under_the_same_note(
    served: Served, mllm: RandomMllm, world: dict[str, Any]
) -> None:
    cube = {"objects": [{"object": "blue cube", "bbox": [170, 60, 205, 98]}]}
    cow = {**COW, **TWO, **cube, **world}
    real = ask(served, NAME, cow=cow)["cow"]
    note, frames = shown(mllm)
    assert (real["content"], real["votes"], len(frames)) == ("simulated", None, 2)
    for content in ("still", "wrong-direction", "other-item"):
        told = ask(served, f"{NAME}:{content}", cow=cow)["cow"]
        assert (told["content"], told["imagined"]) == (content, True)
        assert told["simulation"] not in (None, real["simulation"])
        placebo_note, placebos = shown(mllm)
        assert placebo_note == note
        assert [each.shape for each in placebos] == [each.shape for each in frames]
        assert distance(placebos[-1], frames[-1]) > 0.5
        if content == "still" and not world:
            assert [distance(each, fit_within(decode(picture()).pixels, 128)) for each in placebos] == [0, 0]
        elif content == "wrong-direction":
            shape = served.http.get(told["frames"][-1]["url"]).content
            assert world or np.array_equal(decode(shape).pixels, placebos[-1])
            assert [frame["index"] for frame in told["frames"]] == [frame["index"] for frame in real["frames"]]


def test_another_item_is_always_the_same_and_never_the_callers_own(served: Served, mllm: RandomMllm) -> None:
    drawn = [(ask(served, f"{NAME}:other-item", cow=COW | TWO), shown(mllm)[1])[1] for _ in range(2)]
    assert np.array_equal(drawn[0], drawn[1])
    for name in QUESTIONS:
        own = decode(example(name).image).pixels
        again = decode(encode_png(fit_within(own, 300))).pixels  # as a harness would send it
        assert other_item(again)[0] != example(name).image


def test_facts_in_place_of_frames(served: Served, mllm: RandomMllm) -> None:
    cow = ask(served, f"{NAME}:text", cow=COW | TWO)["cow"]
    note, frames = shown(mllm)
    assert (frames, cow["frames"], cow["prompts"], cow["content"]) == ([], [], {"imagined-facts": 1}, "text")
    assert re.search(r"- .*the blue object after about .*\n- \d+ of \d+ simulated versions agree", note)
    assert "images" not in note


@pytest.mark.parametrize("content", ["still", "wrong-direction", "other-item", "text"])
def test_where_nothing_is_imagined_no_placebo_is_shown(served: Served, mllm: RandomMllm, content: str) -> None:
    cow = {**COW, "grounding": None, "reader": "embedded"}
    told = ask(served, f"{NAME}:{content}", words="If the giraffe jumps, will it land?", cow=cow)["cow"]
    assert (told["imagined"], told["reason"], told["content"]) == (False, "cannot-ground", content)
    assert len(mllm.last()["messages"][0]["content"]) == 2


def test_what_goes_nowhere_has_no_wrong_direction(served: Served, mllm: RandomMllm) -> None:
    still = {**COW, "motion": {"kind": "static"}}
    for stream in (False, True):
        response = served.http.post(
            "/v1/chat/completions", json=chat(f"{NAME}:wrong-direction", cow=still, stream=stream)
        )
        assert '"reason":"cannot-read-direction"' in response.text
        assert "no wrong one" in response.text
        assert len(mllm.last()["messages"][0]["content"]) == 2
    fall = {**COW, **TWO, "motion": {"kind": "fall"}}
    assert ask(served, f"{NAME}:wrong-direction", cow=fall)["cow"]["imagined"]


def test_the_frames_that_a_name_asks_for(served: Served, mllm: RandomMllm) -> None:
    cow = ask(served, f"{NAME}:initial", cow=COW)["cow"]
    assert [frame["index"] for frame in cow["frames"]] == [1, 3, 5]
    cow = ask(served, f"{NAME}:still:events", cow=COW)["cow"]
    assert (len(shown(mllm)[1]), cow["content"]) == (3, "still")
    for given, param in (({"frames": {"count": 1}}, "cow.frames"), ({"trajectory": {}}, "cow.trajectory")):
        response = served.http.post("/v1/chat/completions", json=chat(f"{NAME}:wrong-direction:events", cow=given))
        assert problem(response, 422, "invalid-request")["error"]["param"] == param


def test_a_stream_of_a_placebo_tells_of_both_simulations(served: Served) -> None:
    response = served.http.post(
        "/v1/chat/completions", json=chat(f"{NAME}:wrong-direction", image=picture(3), cow=COW, stream=True)
    )
    *events, end = [block.removeprefix("data: ") for block in response.text.split("\n\n") if block.startswith("data")]
    told = [each for event in events if (each := json.loads(event).get("cow"))]
    assert len({each["job"] for each in told if "job" in each}) == 2
    assert (told[-1]["content"], told[-1]["imagined"], end) == ("wrong-direction", True, "[DONE]")


# --- votes ---


def saying(*texts: str) -> list[Any]:
    def whole(text: str) -> dict[str, Any]:
        message = {"role": "assistant", "content": text}
        choice = {"index": 0, "finish_reason": "stop", "message": message}
        return {
            "id": text,
            "object": "chat.completion",
            "created": 1,
            "model": "m",
            "choices": [choice],
            "usage": USAGE,
        }

    return [failing(200, whole(text)) for text in texts]


def test_the_most_frequent_answer_wins(served: Served, mllm: RandomMllm) -> None:
    asked = len(mllm.received)
    mllm.next_replies = saying("ANSWER: A", "It is (B).\n\nANSWER: B", "ANSWER: B")
    reply = ask(served, f"{NAME}:vote-3:initial", cow=COW, temperature=0, unknown=1)
    assert reply["choices"][0]["message"]["content"].endswith("ANSWER: B")
    assert reply["cow"]["votes"] == {"A": 1, "B": 2}
    assert reply["usage"]["prompt_tokens"] == 3 * USAGE["prompt_tokens"]
    assert reply["usage"]["prompt_tokens_details"]["cached_tokens"] == 12
    bodies = [each.fields for each in mllm.received[asked:]]
    assert len(bodies) == 3
    assert bodies[0] == bodies[1] == bodies[2]
    assert (bodies[0]["temperature"], bodies[0]["unknown"]) == (0, 1)
    assert len(bodies[0]["messages"][0]["content"]) == 6  # image, question, note, frames


def test_ties_votes_that_cannot_be_read_and_a_stream(served: Served, mllm: RandomMllm) -> None:
    mllm.next_replies = saying("I would rather not say what I see.", "ANSWER: B", "ANSWER: A")
    name = f"{NAME}:no-imagination:vote-3"
    with OpenAI(base_url=f"{served.http.base_url}/v1", api_key="any", max_retries=0) as client:
        options = {"include_usage": True}
        chunks = list(client.chat.completions.create(**chat(name), stream=True, stream_options=options))
    told = next(chunk.cow for chunk in chunks if getattr(chunk, "cow", None))
    said = "".join(choice.delta.content or "" for chunk in chunks for choice in chunk.choices)
    assert said in ("ANSWER: A", "ANSWER: B")
    assert (told["votes"], told["content"], told["reason"]) == ({"A": 1, "B": 1}, "none", "no-imagination")
    assert "1 of 3 votes" in told["warnings"][0]
    assert "tied between" in told["warnings"][1]
    assert chunks[-1].usage.total_tokens == 3 * USAGE["total_tokens"]
    assert not {"stream", "stream_options"} & set(mllm.last())


def test_what_cannot_be_voted_on_and_votes_that_fail(served: Served, mllm: RandomMllm) -> None:
    asked = len(mllm.received)
    for given, param in (({"words": "What does the ball hit?"}, "messages[0].content"), ({"n": 2}, "n")):
        response = served.http.post("/v1/chat/completions", json=chat(f"{NAME}:vote-3", **given, cow=COW))
        assert problem(response, 422, "invalid-request")["error"]["param"] == param
        assert "without :vote-3" in response.json()["detail"]
    assert len(mllm.received) == asked
    mllm.next_replies = [*saying("ANSWER: A"), failing(429, {"error": {"message": "slow down"}}, retry_after="7")]
    response = served.http.post("/v1/chat/completions", json=chat(f"{NAME}:no-imagination:vote-2"))
    assert (response.status_code, response.headers["retry-after"]) == (429, "7")
