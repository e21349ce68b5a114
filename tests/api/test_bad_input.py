"""Whatever is sent, the answer is a problem of the right code and pointer, at once and without much memory.

Against a real server. What the problems say, and bodies that are no JSON object, stand in test_error_table.py.
"""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator, Iterator
from contextlib import closing, contextmanager
from http.client import HTTPConnection
from pathlib import Path
from typing import Any

import bad_images as bad
import httpx
import pytest
from asgi import app_of, ask
from conftest import Server
from drawn import ball, block, floor, png_bytes
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image
from refusals import refused
from servers import QUESTION, data_url, problem
from starlette.types import Message, Receive, Scope, Send
from tables import rows
from waiting import TIME_LIMIT

from cow_service.api.middleware.body_limit import BodyLimit
from cow_service.requests import AnswerRequest

pytestmark = pytest.mark.slow

PIXELS = block(ball(floor(320, 200), (75, 100), 20, (210, 20, 20)), (215, 80, 255, 125), (50, 80, 200))
PICTURE = Image.fromarray(PIXELS)
PNG = png_bytes(PIXELS)
JPEG = bad.saved(PICTURE, "JPEG")
PROGRESSIVE = bad.saved(Image.new("RGB", (1024, 1024)), "JPEG", progressive=True)
EXIF = b"\xff\xe1\0\x10Exif\0\0" + bytes(8)
PROFILE = bad.chunk(b"iCCP", b"k\0\0" + bad.zeros(200 * bad.MEBI))
GROWTH = 50  # MB that a refused request may cost
LIMIT = 3_000_000  # bytes of a body, as the server of conftest.py is set
HEX = "0123456789abcdef" * 4
JSON = {"content-type": "application/json"}
BODY: dict[str, Any] = {"image": data_url(PNG), "question": QUESTION, "num_frames": 5, "video": False}
TEXT = json.dumps(BODY)
SMALL = json.dumps({"image": "x", "question": "?"})


def told(response: httpx.Response, status: int, code: str, *pointers: str) -> None:
    """The problem that a response must be."""
    found = problem(response, status, code)
    assert set(found) == {"type", "title", "status", "detail", "errors"}
    assert tuple(error["pointer"] for error in found["errors"]) == pointers
    assert len(response.content) < 20_000
    for leaked in ("Traceback", 'File "', "/work", "/tmp", "/home", "site-packages", "root:"):
        assert leaked not in response.text


def post(http: httpx.Client, body: Any, media_type: str = "application/json") -> httpx.Response:
    return http.post("/simulate", content=body, headers={"content-type": media_type})


def simulate(http: httpx.Client, **fields: Any) -> httpx.Response:
    return http.post("/simulate", json=BODY | fields)


def send_file(http: httpx.Client, data: bytes, **rest: Any) -> httpx.Response:
    form = {"question": QUESTION, "request": json.dumps({"num_frames": 5, "video": False, **rest})}
    return http.post("/simulate", data=form, files={"image": ("a.png", data, "image/png")})


@contextmanager
def little_memory(server: Server) -> Iterator[None]:
    """The server's memory must not have grown by `GROWTH` at any moment in between."""

    def now(name: str) -> float:
        lines = Path(f"/proc/{server.process.pid}/status").read_text().splitlines()
        return next(int(line.split()[1]) / 1000 for line in lines if line.startswith(name))

    if not Path("/proc/self/clear_refs").exists():
        pytest.skip("memory is read from Linux's /proc")
    Path(f"/proc/{server.process.pid}/clear_refs").write_text("5")  # resets the peak
    before = now("VmRSS")
    yield
    assert now("VmHWM") - before < GROWTH, f"{before} MB became {now('VmHWM')} MB"


@pytest.fixture(scope="module")
def http(server: Server) -> Iterator[httpx.Client]:
    """One client for all rows: making one takes longer than most rows."""
    with httpx.Client(base_url=server.address, timeout=TIME_LIMIT) as client:
        yield client


@pytest.fixture(autouse=True)
def still_well(server: Server, http: httpx.Client) -> Iterator[None]:
    yield
    assert server.process.poll() is None
    assert http.get("/livez").status_code == 200


# Images


@pytest.mark.parametrize(
    ("data", "status"),
    rows(
        core={
            "81 megapixels": (bad.bomb(9000, 9000), 413),
            "zTXt: 300 texts of 1 MiB": (bad.with_chunks(PNG, bad.texts(300, bad.MEBI)), 200),
            "iTXt: 60 wide texts of 4 MiB": (bad.with_chunks(PNG, bad.wide_texts(60)), 200),
            "iCCP: a profile of 200 MiB": (bad.with_chunks(PNG, [PROFILE]), 200),
            "150,000 chunks": (bad.with_chunks(PNG, [bad.chunk(b"prVt", b"")] * 150_000), 422),
            "110,000 EXIF segments": (bad.with_segments(JPEG, EXIF * 110_000), 422),
            "an EXIF directory of 24 MB, 10 times": (bad.with_segments(JPEG, bad.exif_bomb() * 10), 200),
            "5,000 scans": (bad.scans(PROGRESSIVE, 5000), 422),
        },
    ),
)
def test_bombs_cost_little(server: Server, http: httpx.Client, data: bytes, status: int) -> None:
    assert len(data) < LIMIT * 0.7
    assert simulate(http).status_code == 200  # what it costs anyway is paid
    for send in (lambda: send_file(http, data), lambda: simulate(http, image=data_url(data))):
        with little_memory(server):
            response = send()
        if status == 200:
            assert response.status_code == 200, response.text
        else:
            told(response, status, "image-too-large" if status == 413 else "image-unreadable")


def test_what_the_service_makes_holds_nothing_of_the_photographer(http: httpx.Client) -> None:
    secret = "48N51-held-by-Nemo"
    photo = bad.located(PICTURE, secret)
    assert photo.count(secret.encode()) >= 3
    response = send_file(http, photo, video=True)
    assert response.status_code == 200, response.text
    assert secret not in response.text
    simulation = response.json()
    made = {simulation["overlay"]["url"], simulation["video"]["url"], simulation["grounding"]["mask"]["url"]}
    made |= {frame["url"] for frame in simulation["frames"]}
    for url in made:
        data = http.get(url).content
        for mark in (secret.encode(), b"Exif", b"eXIf", b"tEXt", b"zTXt", b"iTXt", b"GPS", b"xmp", b"2024:01:01"):
            assert mark not in data, url
    # The input is kept as it was sent, under its own digest: anyone who knows that may have it.
    assert http.get("/artifacts/" + simulation["image"]["sha256"]).content == photo


# Fields


ONE = {"point": [75, 100]}
# What is declared of a field (its least and most, its values) stands in openapi.yaml: here is what code looks at.
FIELDS: list[tuple[dict[str, Any], str]] = [
    ({"image": "data:image/png,raw"}, "/image"),
    ({"image": None}, "/image"),
    ({"question": ""}, "/question"),
    ({"options": ["Yes", ""]}, "/options/1"),
    ({"options": ["Yes"]}, "/options"),
    ({"grounding": {"point": [-1, 5]}}, "/grounding/point"),
    ({"grounding": {"bbox": [60, 60, 61.5, 90]}}, "/grounding/bbox"),
    ({"grounding": {"bbox": [900, 60, 990, 90]}}, "/grounding/bbox"),
    ({"grounding": {"bbox": ["NaN", 0, 9, 9]}}, "/grounding/bbox/0"),
    ({"grounding": ONE | {"object": "\0"}}, "/grounding/object"),
    ({"grounding": ONE | {"colour": 1}}, "/grounding/colour"),
    ({"motion": {"direction": [1, True]}}, "/motion/direction/1"),
    ({"motion": {"kind": "fall", "direction": [1, 0]}}, "/motion"),
    ({"motion": {"kind": "fall", "metres_per_pixel": 1e-300}}, "/motion/metres_per_pixel"),
    ({"num_frames": 10**300}, "/num_frames"),
    ({"num_frames": True}, "/num_frames"),
    ({"video": 1}, "/video"),
    ({"generator": "../cutout"}, "/generator"),
    ({"generator_options": {"a": {"b": ["x\0"]}}}, "/generator_options"),
    ({"generator_options": {"a": [[[[[[[[[1]]]]]]]]]}}, "/generator_options"),
    ({"x" * 100_000: 1}, "/" + "x" * 80 + "... (100000 characters)"),
]


@pytest.mark.parametrize(("given", "pointer"), FIELDS, ids=lambda value: value[:40] if isinstance(value, str) else "")
def test_fields_out_of_range(http: httpx.Client, given: dict[str, Any], pointer: str) -> None:
    told(simulate(http, **given), 422, "invalid-request", pointer)


values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(max_size=20),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=4),
    max_leaves=6,
)


@settings(max_examples=60, suppress_health_check=list(HealthCheck))
@given(
    field=st.sampled_from(sorted(AnswerRequest.model_fields)),
    value=values,
    path=st.sampled_from(["simulate", "answer"]),
)
def test_random_values_are_refused_or_taken(http: httpx.Client, field: str, value: Any, path: str) -> None:
    response = http.post(f"/{path}", content=json.dumps(BODY | {field: value}), headers=JSON)
    assert response.status_code in (200, 404, 413, 415, 422), response.text
    if response.status_code != 200:
        code = response.json()["type"].removeprefix("urn:cow:problem:")
        told(response, response.status_code, code, *(error["pointer"] for error in response.json()["errors"]))


# Bodies


def test_the_same_holds_of_the_rest_in_a_form(http: httpx.Client) -> None:
    def form(rest: str, **data: str) -> httpx.Response:
        return http.post("/simulate", data={"request": rest, **data}, files={"image": ("a.png", PNG, "image/png")})

    told(form('{"seed": 1, "seed": 2}', question=QUESTION), 400, "malformed-body")
    told(form("{}", question=QUESTION, seed="3"), 422, "invalid-request", "/seed")
    told(form('{"question": "other"}', question=QUESTION), 422, "invalid-request", "/question")
    told(form('{"image": "x"}', question=QUESTION), 422, "invalid-request", "/image")
    assert form(json.dumps({"question": QUESTION, "num_frames": 5, "video": False})).status_code == 200


def test_numbers_past_every_float_are_refused(http: httpx.Client) -> None:
    rest = TEXT.replace(', "num_frames": 5', "")[:-1]
    for field, pointer in (
        ('"motion": {"direction": [1e400, 0]}', "/motion/direction/0"),
        ('"fps": 1e400', "/fps"),
        ('"seed": 1e400', "/seed"),
        ('"generator_options": {"a": 1e400}', "/generator_options"),
    ):
        told(post(http, f"{rest}, {field}}}"), 422, "invalid-request", pointer)


def test_odd_bodies_that_are_taken(http: httpx.Client) -> None:
    assert post(http, b"\xef\xbb\xbf" + TEXT.encode()).status_code == 200  # a byte order mark
    assert post(http, TEXT, 'Application/JSON; Charset="UTF-8"; Foo=bar;').status_code == 200
    assert post(http, TEXT, "application/vnd.cow+json").status_code == 200
    assert post(http, TEXT.replace("red ball", "red \\ud83d\\ude00 ball")).status_code == 200


def test_media_types_that_nobody_reads(http: httpx.Client) -> None:
    form = "multipart/form-data; boundary=x; charset="
    for media_type in (
        "",
        "application/json/x",
        "x" * 30_000,
        form + "punycode",
    ):
        told(post(http, TEXT, media_type), 415, "body-type-unsupported")


def part(name: str | None, value: bytes, *, file: str | None = None, header: bytes = b"") -> bytes:
    shown = b"form-data" + (b'; name="%s"' % name.encode() if name is not None else b"")
    shown += b'; filename="%s"' % file.encode() if file is not None else b""
    return b"--x\r\nContent-Disposition: " + shown + b"\r\n" + header + b"\r\n" + value + b"\r\n"


FILE = part("image", PNG, file="a.png")
ASKED = part("question", QUESTION.encode())
END = b"--x--\r\n"
# Malformed, or where there is a pointer, invalid.
FORMS: dict[str, tuple[bytes, tuple[str, ...]]] = {
    "empty": (b"", ()),
    "no parts": (END, ("/image", "/question")),
    "no end": (FILE + ASKED, ()),
    "a part cut off": (FILE + ASKED + part("request", b'{"seed": 7}')[:-8], ()),
    "9 fields": (FILE + b"".join(part(f"f{i}", b"") for i in range(9)) + END, ()),
    "no name": (part(None, b"a") + END, ()),
    "two images": (FILE + FILE + ASKED + END, ("/image",)),
    "two questions": (FILE + ASKED + ASKED + END, ("/question",)),
    "an endless name": (FILE + ASKED + part("s" * 3000, b"") + END, ("/" + "s" * 80 + "... (3000 characters)",)),
    "image as a field": (part("image", PNG) + ASKED + END, ("/image",)),
    "question as a file": (FILE + part("question", b"?", file="q") + END, ("/question",)),
    "question with NUL": (FILE + part("question", b"a\0b") + END, ("/question",)),
}


@pytest.mark.parametrize("name", FORMS)
def test_forms_that_cannot_be_read(http: httpx.Client, name: str) -> None:
    body, pointers = FORMS[name]
    status, code = (422, "invalid-request") if pointers else (400, "malformed-body")
    told(post(http, body, "multipart/form-data; boundary=x"), status, code, *pointers)


def chunks(body: bytes) -> Iterator[bytes]:
    yield from (body[at : at + 65536] for at in range(0, len(body), 65536))


@pytest.mark.parametrize("announced", [True, False], ids=["announced", "chunked"])
def test_the_limit_of_a_body(server: Server, http: httpx.Client, announced: bool) -> None:
    exact = SMALL.encode().ljust(LIMIT)
    for body, status, code in ((exact, 422, "invalid-request"), (exact + b" ", 413, "body-too-large")):
        with little_memory(server):
            response = post(http, body if announced else chunks(body))
        problem(response, status, code)


def test_a_body_whose_end_does_not_arrive(tmp_path: Path) -> None:
    async def body() -> AsyncIterator[bytes]:
        yield SMALL.encode()
        await asyncio.Event().wait()

    (response,) = ask(app_of(tmp_path, body_timeout=0.2), ("POST", "/look", JSON, body()))
    told(response, 408, "body-too-slow")
    assert response.headers["connection"] == "close"


def test_slow_bytes_give_a_body_no_new_time_and_one_that_is_in_may_be_worked_on_for_longer() -> None:
    async def trickle() -> Message:
        await asyncio.sleep(0.02)
        return {"type": "http.request", "body": b"x", "more_body": True}

    received: list[Message] = [{"type": "http.request", "body": b"{}", "more_body": False}]

    async def whole() -> Message:
        return received.pop() if received else await asyncio.Event().wait()  # type: ignore[return-value]

    async def reads_all(scope: Scope, receive: Receive, send: Send) -> None:
        while (await receive())["more_body"]:
            pass
        with pytest.raises(TimeoutError):  # of this block, not of the limit
            await asyncio.wait_for(receive(), 0.3)

    async def send(message: Message) -> None:
        raise AssertionError(message)

    async def limited(receive: Receive) -> None:
        limit = BodyLimit(reads_all, megabytes=1, seconds=0.1, megabytes_at_once=1)
        await limit({"type": "http", "headers": []}, receive, send)

    with refused("body-too-slow"):
        asyncio.run(limited(trickle))
    asyncio.run(limited(whole))


# What clients do not send as it is written here


def sent(server: Server, method: str, path: str, **headers: str) -> httpx.Response:
    with closing(HTTPConnection(server.address.removeprefix("http://"), timeout=TIME_LIMIT)) as connection:
        connection.request(method, path, headers=headers)
        got = connection.getresponse()
        return httpx.Response(got.status, headers=dict(got.headers), content=got.read())


def test_addresses_with_nothing_there(server: Server) -> None:
    outside = ("/../../etc/passwd", "/..%2f..%2fetc%2fpasswd", "//etc/passwd", "/%2fetc%2fpasswd")
    unnamed = ("/..", "/%2e%2e", "/..%5c..%5cetc", "/%00", f"/{HEX}%0a", "/%ff%fe", f"/{HEX}")
    addresses = {f"/artifacts{path}": "not-found" for path in outside}
    addresses |= {f"/artifacts{path}": "artifact-not-found" for path in unnamed}
    for path, code in addresses.items():
        told(sent(server, "GET", path), 404, code)


def test_a_body_that_is_announced_too_large_is_refused_before_it_is_sent(server: Server) -> None:
    headers = {"Expect": "100-continue", "Content-Type": "application/json", "Content-Length": str(LIMIT + 1)}
    told(sent(server, "POST", "/simulate", **headers), 413, "body-too-large")
