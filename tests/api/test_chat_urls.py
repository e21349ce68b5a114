"""What of a chat goes to the MLLM's server: no URL that leads inside, no field that is not listed. What comes back."""

from __future__ import annotations

import asyncio
import gzip
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import mllm_server as say
import pytest
from chats import HELLO, text, user
from engines import app_for
from fastapi import FastAPI
from mllm_server import MllmServer
from refusals import refused
from servers import data_url, picture, problem

from cow_service.api.openai.forwarding import Forwarder
from cow_service.net import MAX_REPLY_BYTES, Egress, ImageUrls
from cow_service.readers.chat import ChatTurn, Upstream
from cow_service.service import Service
from cow_service.settings import Settings

pytestmark = pytest.mark.slow
NAME = "cow/qwen3-vl-8b:no-imagination"
# As URL parsers and resolvers read them, these lead to a private address, or are not HTTP.
INSIDE = (
    "http://169.254.169.254/latest/meta-data/", "http://127.0.0.1:5432/", "http://localhost/x", "http://10.0.0.1/x",
    "http://[::1]/x", "http://[::ffff:10.0.0.1]/x", "http://[64:ff9b::a00:1]/x", "http://2130706433/x",
    "http://0x7f000001/x", "http://0177.0.0.1/x", "http://127.1/x", "http://images.test@127.0.0.1/x",
    "file:///etc/passwd", "/etc/passwd.png", " http://127.0.0.1/x",
)  # fmt: skip
URL = "http://images.test/1.png"


@pytest.fixture(scope="module")
def mllm() -> Iterator[MllmServer]:
    with say.mllm_server() as server:
        yield server


@pytest.fixture
def app(tmp_path: Path, mllm: MllmServer) -> Callable[..., FastAPI]:
    mllm.say("ANSWER: A")

    def make(fetch: Callable[[str], bytes] | None = None, **own: Any) -> FastAPI:
        """An app that resolves names as told here, and fetches pictures by `fetch`."""
        settings = Settings(data_dir=tmp_path, mllm="qwen3-vl-8b", mllm_base_url=mllm.address, **own)
        service = Service(settings)
        if settings.allow_image_urls:
            names = {"localhost": ["127.0.0.1"], "images.test": ["1.1.1.1"]}
            egress = Egress(settings.allow_image_urls, resolve=lambda host, _: names[host])
            service.image_urls = ImageUrls(settings, egress)
            if fetch is not None:
                egress.fetch = lambda url, most_bytes: fetch(url)
        return app_for(service)

    return make


def post(app: FastAPI, *, path: str = "chat/completions", **body: Any) -> httpx.Response:
    async def run() -> httpx.Response:
        async with httpx.AsyncClient(transport=httpx.ASGITransport(app), base_url="http://cow:8000") as http:
            response = await http.post(f"/v1/{path}", json={"model": NAME, **body})
        await app.state.completer.close()  # its connections are those of this event loop
        return response

    return asyncio.run(run())


def part(kind: str, url: Any) -> dict[str, Any]:
    return {"type": kind, kind: url}


@pytest.mark.parametrize("allow", [(), ("*",)])
def test_no_url_that_leads_inside_is_sent_on(
    app: Callable[..., FastAPI], mllm: MllmServer, allow: tuple[str, ...]
) -> None:
    one = app(allow_image_urls=allow)
    for url in INSIDE:
        ways = [part(kind, {"url": url}) for kind in ("image_url", "video_url", "audio_url", "source")]
        ways += [part("image_url", url), part("image", url), part("video", [url])]
        for way in ways:
            response = post(one, messages=[{"role": "system", "content": "x"}, user(text("?"), way)])
            told = problem(response, 422, "image-url-not-allowed")
            assert url[:60] in told["detail"]
            assert told["error"]["param"].startswith("messages[1].content[1].")
    in_place_of_data = {"input_audio": {"data": INSIDE[0], "format": "wav"}, "file": {"file_data": INSIDE[0]}}
    for kind, held in in_place_of_data.items():
        problem(post(one, messages=[user(part(kind, held))]), 422, "image-url-not-allowed")
    predicted = {"type": "content", "content": [part("image_url", INSIDE[0])]}
    problem(post(one, messages=HELLO, prediction=predicted), 422, "image-url-not-allowed")
    response = post(one, path="responses", input=[user({"type": "input_image", "image_url": INSIDE[0]})])
    problem(response, 422, "image-url-not-allowed")
    deep: Any = [URL]
    for _ in range(30):
        deep = [deep]
    problem(post(one, messages=[{"role": "user", "content": deep}]), 422, "invalid-request")
    assert mllm.asked == []


def test_pictures_by_url_are_fetched_once_and_sent_as_data(app: Callable[..., FastAPI], mllm: MllmServer) -> None:
    pictures, fetched = [picture()], list[str]()

    def fetch(url: str) -> bytes:
        fetched.append(url)
        return pictures[0]

    one = app(fetch, allow_image_urls=("images.test",))
    cited = {"role": "assistant", "content": "A", "annotations": [{"url_citation": {"url": "http://other.test"}}]}
    video = part("video_url", {"url": "https://images.test/a.mp4"})
    by_url = part("image_url", {"url": URL, "detail": "low"})
    response = post(one, messages=[cited, user(by_url, by_url, video, text(URL))])
    assert response.status_code == 200, response.text
    by_data = part("image_url", {"url": data_url(pictures[0]), "detail": "low"})
    assert mllm.asked[-1]["messages"][1]["content"] == [by_data, by_data, video, text(URL)]
    assert fetched == [URL]
    problem(post(one, messages=[user(part("video_url", "http://other.test/a"))]), 422, "image-url-not-allowed")
    many = [part("image_url", f"{URL}?{number}") for number in range(17)]
    problem(post(one, messages=[user(*many)]), 422, "invalid-request")
    pictures[0] = b"GIF89a......."
    problem(post(one, messages=[user(by_url)]), 415, "image-type-unsupported")
    assert len(mllm.asked) == 1


def test_only_fields_of_openai_and_listed_ones_are_sent_on(app: Callable[..., FastAPI], mllm: MllmServer) -> None:
    one = app(chat_fields="top_k, min_p")
    own: dict[str, Any] = {"temperature": 0.5, "n": 1, "stop": ["x"], "top_k": 20, "min_p": 0.1}
    assert post(one, messages=HELLO, **own, chat_template=None).status_code == 200
    assert own.items() <= mllm.asked[-1].items()
    for name in ("chat_template", "mm_processor_kwargs", "media_io_kwargs", "guided_regex", "Temperature"):
        told = problem(post(one, messages=HELLO, **{name: "x"}), 422, "invalid-request")
        assert told["error"]["param"] == name
        assert "COW_CHAT_FIELDS" in told["detail"]
    assert len(mllm.asked) == 1


def encoded(encoding: str, body: bytes) -> say.Reply:
    def reply(handler: Any) -> None:
        handler.send(200, body, content_encoding=encoding)

    return reply


@pytest.mark.parametrize(
    ("encoding", "body"),
    [
        ("gzip", gzip.compress(bytes(300_000_000))),
        ("gzip", b"none"),
        ("br", b"none"),
        ("identity", b" " * (MAX_REPLY_BYTES + 1)),
    ],
    ids=["bomb", "broken", "unknown", "long"],
)
def test_a_reply_that_unpacks_to_too_much_is_given_up(mllm: MllmServer, encoding: str, body: bytes) -> None:
    async def chat() -> ChatTurn:
        forwarder = Forwarder(Settings())
        try:
            async with forwarder.send(Upstream(mllm.address, "m"), {"messages": HELLO}) as reply:
                assert isinstance(reply, ChatTurn)
                return reply
        finally:
            await forwarder.close()

    mllm.say(encoded(encoding, body), encoded("gzip", gzip.compress(json.dumps(say.completion("A")).encode())))
    with refused("mllm-bad-reply"):
        asyncio.run(chat())
    assert asyncio.run(chat()).body == say.completion("A")  # of a server that compresses although it was told not to


def test_a_stream_may_be_longer_than_a_reply_but_no_event_of_it(app: Callable[..., FastAPI], mllm: MllmServer) -> None:
    chunk = b'data: {"choices": [], "x": "%s"}\n\n' % (b"y" * 1_000_000)
    mllm.say(say.raw(chunk * 20 + b"data: [DONE]\n\n", "text/event-stream"))
    assert post(app(), messages=HELLO, stream=True).text.endswith("data: [DONE]\n\n")
    mllm.say(say.raw(b"data: " + bytes(MAX_REPLY_BYTES), "text/event-stream"))
    assert "mllm-bad-reply" in post(app(), messages=HELLO, stream=True).text


@pytest.mark.parametrize(
    ("name", "error"),
    [
        ("message", {"error": {"message": "organization org-77 at 10.0.0.7", "code": "rate_limit"}}),
        ("message", {"object": "error", "message": "org-77 at 10.0.0.7", "type": "org-77", "code": "rate_limit"}),
        ("error", {"message": "org-77 at 10.0.0.7", "param": "10.0.0.7", "code": "rate_limit"}),
    ],
)
def test_an_error_inside_a_stream_keeps_its_words_to_itself(
    app: Callable[..., FastAPI], mllm: MllmServer, name: str, error: dict[str, Any]
) -> None:
    stream = f"event: {name}\ndata: {json.dumps(error)}\n\ndata: [DONE]\n\n".encode()
    mllm.say(say.raw(stream, "text/event-stream"))
    said = post(app(), messages=HELLO, stream=True).text
    assert "org-77" not in said
    assert "rate_limit" in said
