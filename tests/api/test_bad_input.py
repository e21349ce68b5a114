"""Whatever is sent, the answer is a problem that says what was wrong and what to do, at once and without much memory.

One row each, against a real server. What is not HTTP at all is answered by the HTTP server itself, in plain text.
"""

from __future__ import annotations

import base64
import io
import json
import os
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import bad_images as bad
import httpx
import numpy as np
import pytest
from conftest import Server
from drawn import ball, block, floor, png_bytes
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image

from cow_service.requests import AnswerRequest

pytestmark = pytest.mark.slow

PIXELS = block(ball(floor(320, 200), (75, 100), 20, (210, 20, 20)), (215, 80, 255, 125), (50, 80, 200))
PICTURE = Image.fromarray(PIXELS)
PNG = png_bytes(PIXELS)
JPEG = bad.saved(PICTURE, "JPEG")
PROGRESSIVE = bad.saved(Image.new("RGB", (1024, 1024)), "JPEG", progressive=True)
EXIF = b"\xff\xe1\0\x10Exif\0\0" + bytes(8)
PROFILE = bad.chunk(b"iCCP", b"k\0\0" + bad.zeros(200 * bad.MEBI))
QUESTION = "If the red ball moves to the right, will it hit the blue cube?"
GROWTH = 50  # MB that a refused request may cost
LIMIT = 3_000_000  # bytes of a body, as the server of conftest.py is set
HEX = "0123456789abcdef" * 4


def data_url(data: bytes, media_type: str = "image/png") -> str:
    return f"data:{media_type};base64,{base64.b64encode(data).decode()}"


BODY: dict[str, Any] = {"image": data_url(PNG), "question": QUESTION, "num_frames": 5, "video": False}


def told(response: httpx.Response, status: int, code: str, says: str = "") -> dict[str, Any]:
    """The problem that a response must be."""
    assert response.status_code == status, response.text[:2000]
    assert response.headers["content-type"] == "application/problem+json"
    problem = response.json()
    assert set(problem) == {"type", "title", "status", "detail", "errors"}
    assert problem["type"] == "urn:cow:problem:" + code, problem
    assert problem["status"] == status
    assert says.lower() in problem["detail"].lower(), problem["detail"]
    assert problem["detail"].rstrip().endswith((".", "}")), problem["detail"]
    for leaked in ("Traceback", 'File "', ".py", "/work", "/tmp", "/home", "site-packages", "0x7f"):
        assert leaked not in response.text
    assert len(response.content) < 20_000
    return problem


def post(http: httpx.Client, body: bytes | str, media_type: str = "application/json") -> httpx.Response:
    return http.post("/simulate", content=body, headers={"content-type": media_type})


def send_file(http: httpx.Client, data: bytes, **rest: Any) -> httpx.Response:
    form = {"question": QUESTION, "request": json.dumps({"num_frames": 5, "video": False, **rest})}
    return http.post("/simulate", data=form, files={"image": ("a.png", data, "image/png")})


def fetched(http: httpx.Client, url: str) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(http.get(url).content)).convert("RGB"), int)


@contextmanager
def another_server(folder: Path, **environment: str) -> Iterator[Server]:
    """A server with settings of its own."""
    command = [sys.executable, "-m", "cow_service.cli.main", "serve", "--port", "0"]
    told_to = os.environ | {"COW_DATA_DIR": str(folder)} | environment
    with subprocess.Popen(
        command, env=told_to, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stderr is not None
        lines = iter(process.stderr.readline, "")
        yield Server(process, next(line.split(" on ")[1].split()[0] for line in lines if "running on" in line), folder)
        process.terminate()
        process.stderr.read()


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
    with httpx.Client(base_url=server.address, timeout=60) as client:
        yield client


@pytest.fixture(autouse=True)
def still_well(server: Server, http: httpx.Client) -> Iterator[None]:
    yield
    assert server.process.poll() is None
    assert http.get("/livez").status_code == 200


# Images


@pytest.mark.parametrize(
    ("data", "status", "code", "says"),
    [
        pytest.param(b"", 422, "image-unreadable", "empty", id="no bytes"),
        pytest.param(bytes(range(256)) * 40, 415, "image-type-unsupported", "PNG, JPEG or WebP", id="random bytes"),
        pytest.param(b'<svg xmlns="http://www.w3.org/2000/svg"/>', 415, "image-type-unsupported", "SVG", id="SVG"),
        pytest.param(bad.saved(PICTURE, "GIF"), 415, "image-type-unsupported", "GIF", id="GIF"),
        pytest.param(bad.saved(PICTURE, "TIFF"), 415, "image-type-unsupported", "TIFF", id="TIFF"),
        pytest.param(bad.saved(PICTURE, "BMP"), 415, "image-type-unsupported", "BMP", id="BMP"),
        pytest.param(b"%PDF-1.7\n%\xe2\xe3", 415, "image-type-unsupported", "PDF", id="PDF"),
        pytest.param(b"8BPS\0\1" + bytes(20), 415, "image-type-unsupported", "Photoshop", id="PSD"),
        pytest.param(b"\0\0\0\x18ftypheic" + bytes(9), 415, "image-type-unsupported", "HEIC", id="HEIC"),
        pytest.param(PNG[: len(PNG) // 2], 422, "image-unreadable", "incomplete", id="truncated PNG"),
        pytest.param(bad.saved(PICTURE, "JPEG")[:3000], 422, "image-unreadable", "3000 bytes", id="truncated JPEG"),
        pytest.param(bad.saved(PICTURE.crop((0, 0, 1, 1))), 422, "image-unreadable", "1 x 1 px", id="1x1"),
        pytest.param(bad.bomb(1, 65535), 422, "image-unreadable", "1 x 65535 px", id="1x65535"),
        pytest.param(bad.bomb(65535, 1), 422, "image-unreadable", "at least 8 px", id="65535x1"),
    ],
)
def test_images_that_are_none(http: httpx.Client, data: bytes, status: int, code: str, says: str) -> None:
    told(send_file(http, data), status, code, says)
    if data:
        told(http.post("/simulate", json={**BODY, "image": data_url(data)}), status, code, says)


@pytest.mark.parametrize(
    ("data", "status", "says"),
    [
        pytest.param(bad.bomb(9000, 9000), 413, "81.00 megapixels", id="81 megapixels"),
        pytest.param(bad.bomb(20_000, 20_000), 413, "20000 x 20000", id="400 megapixels"),
        pytest.param(bad.with_chunks(PNG, bad.texts(300, bad.MEBI)), 200, "", id="300 texts of 1 MiB"),
        pytest.param(bad.with_chunks(PNG, bad.texts(1, 300 * bad.MEBI)), 200, "", id="a text of 300 MiB"),
        pytest.param(bad.with_chunks(PNG, bad.wide_texts(60)), 200, "", id="60 wide texts of 4 MiB"),
        pytest.param(bad.with_chunks(PNG, [bad.chunk(b"tEXt", b"k\0" + b"a" * 1_500_000)]), 200, "", id="plain text"),
        pytest.param(bad.with_chunks(PNG, [PROFILE]), 200, "", id="a profile of 200 MiB"),
        pytest.param(bad.with_chunks(PNG, [bad.chunk(b"prVt", b"")] * 150_000), 422, "chunks", id="150,000 chunks"),
        pytest.param(bad.with_segments(JPEG, EXIF * 9), 200, "", id="9 EXIF segments"),
        pytest.param(bad.with_segments(JPEG, EXIF * 110_000), 422, "segments", id="110,000 EXIF segments"),
        pytest.param(bad.with_segments(JPEG, bad.exif_bomb() * 10), 200, "", id="an EXIF directory of 24 MB, 10 times"),
        pytest.param(bad.scans(PROGRESSIVE, 5000), 422, "scans", id="5,000 scans"),
    ],
)
def test_bombs_cost_little(server: Server, http: httpx.Client, data: bytes, status: int, says: str) -> None:
    code = {413: "image-too-large", 422: "image-unreadable"}.get(status, "")
    assert len(data) < LIMIT * 0.7
    assert http.post("/simulate", json=BODY).status_code == 200  # what it costs anyway is paid
    for send in (lambda: send_file(http, data), lambda: http.post("/simulate", json={**BODY, "image": data_url(data)})):
        with little_memory(server):
            began = time.monotonic()
            response = send()
            assert time.monotonic() - began < 10
        if status == 200:
            assert response.status_code == 200, response.text
        else:
            told(response, status, code, says)


def alpha_palette() -> bytes:
    image = Image.new("P", (64, 48), 1)
    image.putpalette([0, 0, 0, 20, 60, 200, 0, 200, 0])
    image.paste(2, (32, 0, 64, 48))
    return bad.saved(image, transparency=bytes([255, 255, 0]))


@pytest.mark.parametrize(
    ("data", "left", "right"),
    [
        pytest.param(
            bad.saved(Image.new("CMYK", (64, 48), (0, 255, 255, 0)), "JPEG", quality=95),
            (255, 0, 0),
            (255, 0, 0),
            id="CMYK JPEG",
        ),
        pytest.param(
            bad.png16(np.full((48, 64, 3), (257 * 200, 257 * 30, 257 * 90), np.uint16), 2),
            (200, 30, 90),
            (200, 30, 90),
            id="16-bit PNG",
        ),
        pytest.param(bad.png16(np.full((48, 64), 257 * 77, np.uint16), 0), (77,) * 3, (77,) * 3, id="16-bit grey"),
        pytest.param(alpha_palette(), (20, 60, 200), (255, 255, 255), id="palette with alpha"),
        pytest.param(bad.saved(Image.new("LA", (64, 48), (90, 255))), (90,) * 3, (90,) * 3, id="grey with alpha"),
        pytest.param(bad.saved(Image.new("LA", (64, 48), (90, 0))), (255,) * 3, (255,) * 3, id="clear grey"),
        pytest.param(
            bad.saved(Image.new("RGB", (64, 48), "teal"), "JPEG"), (0, 128, 128), (0, 128, 128), id="JPEG as PNG"
        ),
        pytest.param(
            bad.saved(Image.new("RGB", (64, 48), "teal"), "WEBP"), (0, 128, 128), (0, 128, 128), id="WebP as PNG"
        ),
    ],
)
def test_odd_images_keep_their_colours(http: httpx.Client, data: bytes, left: tuple, right: tuple) -> None:
    rest = {"grounding": {"bbox": [28, 20, 36, 28]}, "motion": {"kind": "static"}, "frames": {"max_side": None}}
    response = send_file(http, data, **rest)
    assert response.status_code == 200, response.text
    frame = fetched(http, response.json()["frames"][0]["url"])
    assert frame.shape == (48, 64, 3)
    assert np.abs(frame[6, 6] - left).max() <= 4
    assert np.abs(frame[6, 58] - right).max() <= 4


def test_every_orientation_is_the_same_picture(http: httpx.Client) -> None:
    boxes = []
    for orientation in bad.STORED:
        response = send_file(http, bad.turned(PICTURE, orientation))
        assert response.status_code == 200, response.text
        assert response.json()["image"]["width"] == 320
        boxes.append(response.json()["grounding"]["bbox"])
    assert np.ptp(boxes, axis=0).max() <= 2, boxes
    assert np.abs(np.array(boxes[0]) - [55, 80, 95, 120]).max() <= 3


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


@pytest.mark.parametrize(
    ("image", "status", "code", "says"),
    [
        pytest.param("data:image/png;base64,!!!!", 422, "invalid-request", "base64", id="no base64"),
        pytest.param("data:image/png;base64,iVBORw0KGgo", 422, "invalid-request", "base64", id="padding"),
        pytest.param("data:image/png,raw", 422, "invalid-request", "base64", id="not base64"),
        pytest.param("data:image/png;base64,", 422, "image-unreadable", "empty", id="empty data"),
        pytest.param(data_url(b"<html>", "image/png"), 415, "image-type-unsupported", "HTML", id="HTML as PNG"),
        pytest.param(data_url(PNG, "text/html"), 415, "image-type-unsupported", "text/html", id="PNG as HTML"),
        pytest.param("file:///etc/passwd", 422, "", "data URL", id="file"),
        pytest.param("ftp://example.org/a.png", 422, "", "", id="ftp"),
        pytest.param("gopher://example.org/", 422, "", "", id="gopher"),
        pytest.param("javascript:alert(1)", 422, "", "", id="javascript"),
        pytest.param({"url": "file:///etc/passwd"}, 422, "", "", id="file as url"),
        pytest.param({"url": "gopher://localhost:6379/_FLUSHALL"}, 422, "", "", id="gopher as url"),
        pytest.param({"url": "javascript:alert(1)"}, 422, "", "", id="javascript as url"),
        pytest.param({"artifact": "../../etc/passwd"}, 422, "invalid-request", "pattern", id="path as artifact"),
        pytest.param({"artifact": HEX.upper()}, 422, "invalid-request", "pattern", id="uppercase artifact"),
        pytest.param({"artifact": HEX + "0"}, 422, "invalid-request", "pattern", id="65 digits"),
        pytest.param({"artifact": HEX + "\n"}, 422, "invalid-request", "pattern", id="newline"),
        pytest.param({"artifact": HEX, "url": "x"}, 422, "invalid-request", "", id="artifact and url"),
        pytest.param("", 422, "invalid-request", "data URL", id="empty string"),
        pytest.param(None, 422, "invalid-request", "", id="null"),
        pytest.param([1], 422, "invalid-request", "", id="array"),
    ],
)
def test_references_that_lead_to_no_image(http: httpx.Client, image: Any, status: int, code: str, says: str) -> None:
    response = http.post("/simulate", json={**BODY, "image": image})
    code = code or response.json()["type"].removeprefix("urn:cow:problem:")
    assert code in ("invalid-request", "image-url-not-allowed", "image-type-unsupported", "image-unreadable")
    told(response, status, code, says)
    assert "root:" not in response.text


def test_base64_in_lines_is_taken(http: httpx.Client) -> None:
    lines = base64.encodebytes(PNG).decode()
    for text in (lines, lines.replace("\n", "\r\n"), " " + lines.replace("\n", "\t ")):
        response = http.post("/simulate", json={**BODY, "image": "data:image/png;base64," + text})
        assert response.status_code == 200, response.text


# Fields


@pytest.mark.parametrize(
    ("given", "says"),
    [
        pytest.param({"question": "a" * 1_000_000}, "1000000 characters", id="question of 1 MB"),
        pytest.param({"question": "red\0ball"}, "NUL (U+0000) at position 3", id="question with NUL"),
        pytest.param({"question": ""}, 'is empty, got "". Ask, for example:', id="empty question"),
        pytest.param({"question": " \t\n\u00a0"}, "empty", id="blank question"),
        pytest.param({"question": "\u200b\u200c\u200d\u2060\ufeff"}, "5 blank or invisible", id="zero-width question"),
        pytest.param({"question": None}, "/question", id="null question"),
        pytest.param({"question": ["a"]}, "/question", id="question array"),
        pytest.param({"options": ["Yes", ""]}, "/options/1", id="empty option"),
        pytest.param({"options": ["Yes", "\u200b"]}, "/options/1", id="invisible option"),
        pytest.param({"options": ["Yes", " yes "]}, "different", id="doubled option"),
        pytest.param({"options": ["Yes"]}, "two or more", id="one option"),
        pytest.param({"options": [f"option {i}" for i in range(27)]}, "26", id="27 options"),
        pytest.param({"options": ["a\0", "b"]}, "NUL", id="option with NUL"),
        pytest.param({"options": "Yes"}, "/options", id="options string"),
        pytest.param({"grounding": {"bbox": [60, 60, 20, 90]}}, "[60.0, 60.0, 20.0, 90.0]", id="reversed bbox"),
        pytest.param({"grounding": {"bbox": [60, 60, 60, 90]}}, "at least 2 px", id="bbox without area"),
        pytest.param({"grounding": {"bbox": [900, 60, 990, 90]}}, "320 x 200", id="bbox outside"),
        pytest.param({"grounding": {"bbox": [1, 2, 3]}}, "/grounding/bbox/3", id="bbox of three"),
        pytest.param({"grounding": {"bbox": ["NaN", 0, 9, 9]}}, '"NaN"', id="bbox with the string NaN"),
        pytest.param({"grounding": {"bbox": [0, 0, "Infinity", 9]}}, '"Infinity"', id="bbox with the string Infinity"),
        pytest.param({"grounding": {"point": [-1, 5]}}, "outside", id="point outside"),
        pytest.param({"grounding": {"point": [75, 100], "object": "\0"}}, "NUL", id="object with NUL"),
        pytest.param({"grounding": {"point": [75, 100], "object": " "}}, "empty", id="blank object"),
        pytest.param({"grounding": {"point": [75, 100], "colour": 1}}, "/grounding/colour", id="nested unknown field"),
        pytest.param({"grounding": []}, "/grounding", id="grounding array"),
        pytest.param({"motion": {"direction": [0, 0]}}, "must not have zero length", id="zero direction"),
        pytest.param({"motion": {"direction": [1, 2, 3]}}, "/motion/direction", id="direction of three"),
        pytest.param({"motion": {"direction": [1, True]}}, "true", id="direction with true"),
        pytest.param({"motion": {"direction": [1, 0], "speed": -1}}, "-1", id="negative speed"),
        pytest.param({"motion": {"direction": [1, 0], "depth": "deep"}}, '"deep"', id="depth in words"),
        pytest.param({"trajectory": {"points": [[1, 1]]}}, "at least 2", id="a path of one point"),
        pytest.param({"trajectory": {"points": [[1, "x"]] * 4000}}, "/trajectory/points/0/1", id="a path of strings"),
        pytest.param({"trajectory": {"points": [[1, 1], [1e9, 1]]}}, "or equal to 1000000", id="a path to far away"),
        pytest.param({"num_frames": 0}, "greater than or equal to 2, got 0", id="0 frames"),
        pytest.param({"num_frames": 1}, "got 1", id="1 frame"),
        pytest.param({"num_frames": 100_000}, "481, got 100000", id="100,000 frames"),
        pytest.param({"num_frames": 10**300}, "301 characters", id="10^300 frames"),
        pytest.param({"num_frames": 81.5}, "got 81.5", id="81.5 frames"),
        pytest.param({"num_frames": "81"}, 'without quotes, got "81"', id="81 in quotes"),
        pytest.param({"num_frames": True}, "got true", id="true frames"),
        pytest.param({"fps": 0}, "got 0", id="0 fps"),
        pytest.param({"fps": -1}, "got -1", id="-1 fps"),
        pytest.param({"fps": "NaN"}, '"NaN"', id="NaN fps in quotes"),
        pytest.param({"seed": -1}, "got -1", id="negative seed"),
        pytest.param({"seed": 2**32}, "4294967295, got 4294967296", id="seed of 33 bits"),
        pytest.param({"seed": 1.5}, "got 1.5", id="seed of 1.5"),
        pytest.param({"seed": True}, "got true", id="true seed"),
        pytest.param({"video": 1}, "/video", id="video 1"),
        pytest.param({"video": "yes"}, '"yes"', id="video yes"),
        pytest.param({"reader": "nobody"}, "There are: embedded", id="unknown reader"),
        pytest.param({"reader": "n" * 100_000}, "100000 characters", id="endless reader"),
        pytest.param({"generator": "nobody"}, "There are:", id="unknown generator"),
        pytest.param({"generator": "../cutout"}, "There are:", id="generator with a path"),
        pytest.param({"frames": {"count": 65}}, "64, got 65", id="65 frames to return"),
        pytest.param({"frames": {"indices": [9]}}, "0 to 4", id="a frame that the clip lacks"),
        pytest.param({"frames": {"policy": "best"}}, '"best"', id="unknown policy"),
        pytest.param({"frames": {"max_side": 1}}, "16, got 1", id="frames of 1 px"),
        pytest.param({"generator_options": {"clean_cuse": True}}, "clean_cues", id="unknown option of the generator"),
        pytest.param({"generator_options": {"a": {"b": ["x\0"]}}}, "NUL", id="generator option with NUL"),
        pytest.param({"generator_options": {"a": [[[[[[[[[1]]]]]]]]]}}, "nested", id="deep generator option"),
        pytest.param({"generator_options": 7}, "/generator_options", id="generator options 7"),
        pytest.param({"sede": 1}, "/sede", id="unknown field"),
        pytest.param({"x" * 100_000: 1}, "100000 characters", id="endless unknown field"),
        pytest.param({f"field{i}": 1 for i in range(900)}, "/field0", id="900 unknown fields"),
    ],
)
def test_fields_out_of_range(http: httpx.Client, given: dict[str, Any], says: str) -> None:
    problem = told(http.post("/simulate", json=BODY | given), 422, "invalid-request", says)
    field = next(iter(given))[:80]
    assert any(error["pointer"].startswith(f"/{field}") for error in problem["errors"]), problem["errors"]
    assert len(problem["errors"]) <= 50


def test_lengths_that_the_default_generator_makes(http: httpx.Client) -> None:
    for num_frames in (80, 81.0):
        response = http.post("/simulate", json={**BODY, "num_frames": num_frames})
        assert response.status_code == 200, response.text


@pytest.mark.slow
def test_lengths_that_a_video_model_cannot_make(tmp_path: Path) -> None:
    pytest.importorskip("diffusers")
    with another_server(tmp_path) as server:
        body = {**BODY, "generator": "tiny-ati", "num_frames": 90}
        response = httpx.post(server.address + "/simulate", json=body, timeout=100)
        told(response, 422, "invalid-request", "no clip of 90 frames at 16 per second; take 81 (5 s)")


values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(max_size=20),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=4),
    max_leaves=6,
)


@settings(max_examples=150, suppress_health_check=list(HealthCheck))
@given(
    field=st.sampled_from(sorted(AnswerRequest.model_fields)),
    value=values,
    path=st.sampled_from(["simulate", "answer"]),
)
def test_random_values_are_refused_or_taken(http: httpx.Client, field: str, value: Any, path: str) -> None:
    response = http.post(f"/{path}", content=json.dumps(BODY | {field: value}), headers=JSON)
    assert response.status_code in (200, 404, 413, 415, 422), response.text
    if response.status_code != 200:
        told(response, response.status_code, response.json()["type"].removeprefix("urn:cow:problem:"))


# Bodies

JSON = {"content-type": "application/json"}
TEXT = json.dumps(BODY)
SMALL = json.dumps({"image": "x", "question": "?"})


@pytest.mark.parametrize(
    ("body", "says"),
    [
        pytest.param(b"", "send one JSON object", id="empty"),
        pytest.param(os.urandom(500), "", id="random bytes"),
        pytest.param("null", "got null", id="null"),
        pytest.param("[]", "got an array", id="array"),
        pytest.param('"text"', "got a string", id="string"),
        pytest.param("7", "got a number", id="number"),
        pytest.param(TEXT[:-1], "line 1", id="cut short"),
        pytest.param(TEXT + "x", "extra data", id="trailing garbage"),
        pytest.param(TEXT + TEXT, "extra data", id="two objects"),
        pytest.param(TEXT.encode("utf-16"), "encode the JSON as UTF-8", id="UTF-16"),
        pytest.param(TEXT.encode("utf-16-le"), "encode the JSON as UTF-8", id="UTF-16 without a mark"),
        pytest.param(TEXT.encode("utf-32"), "encode the JSON as UTF-8", id="UTF-32"),
        pytest.param(b'{"question": "caf\xe9"}', "not UTF-8", id="Latin-1"),
        pytest.param("[" * 100_000, "nested too deep", id="100,000 arrays"),
        pytest.param('{"a":' * 100_000 + "1" + "}" * 100_000, "nested too deep", id="100,000 objects"),
        pytest.param('{"seed": 1, "seed": 2}', '"seed" stands twice', id="doubled key"),
        pytest.param('{"motion": {"kind": "fall", "kind": "static"}}', '"kind" stands twice', id="doubled nested key"),
        pytest.param('{"s\\u0065ed": 1, "seed": 2}', '"seed" stands twice', id="doubled escaped key"),
        pytest.param('{"fps": NaN}', "NaN is no JSON number", id="NaN"),
        pytest.param('{"fps": Infinity}', "Infinity is no JSON number", id="Infinity"),
        pytest.param('{"grounding": {"bbox": [0, 0, -Infinity, 1]}}', "-Infinity is no JSON", id="-Infinity"),
        pytest.param('{"seed": ' + "9" * 5000 + "}", "thousands of digits", id="5,000 digits"),
        pytest.param('{"question": "a\\ud800b"}', "half of a surrogate pair", id="lone surrogate"),
        pytest.param('{"question": "\\udc00\\ud800"}', "half of a surrogate pair", id="swapped surrogates"),
        pytest.param('{"\\ud800": 1}', "half of a surrogate pair", id="lone surrogate as key"),
        pytest.param("{" + ",".join(f'"k{i}":0' for i in range(200_000)) + "}", "200000 keys", id="200,000 keys"),
        pytest.param('{"a": [' + "0," * 1_400_000 + "0]}", "values in `a`", id="1.4 million numbers"),
        pytest.param('{"options": [' + "0," * 1_400_000 + "0]}", "values in `options`", id="1.4 million errors"),
        pytest.param('{"objects": [' + "{}," * 200_000 + "{}]}", "200002 times the sign {", id="200,000 objects"),
        pytest.param("{'question': 1}", "double quotes", id="Python"),
        pytest.param('{"question": "a\nb"}', "control character", id="a raw newline"),
    ],
)
def test_what_is_no_json_object(server: Server, http: httpx.Client, body: bytes | str, says: str) -> None:
    response = post(http, body)
    if says.startswith("values in"):  # well-formed, but nothing reads it
        told(response, 422, "invalid-request", says)
    else:
        told(response, 400, "malformed-body", says)


def test_the_same_holds_of_the_rest_in_a_form(http: httpx.Client) -> None:
    for rest, says in (('{"seed": 1, "seed": 2}', "twice"), ('{"\\ud800": 1}', "surrogate"), ("[]", "an array")):
        files = {"image": ("a.png", PNG, "image/png")}
        response = http.post("/simulate", data={"question": QUESTION, "request": rest}, files=files)
        told(response, 400, "malformed-body", says)


def test_numbers_past_every_float_are_refused(http: httpx.Client) -> None:
    rest = TEXT.replace(', "num_frames": 5', "")[:-1]
    for field in (
        '"motion": {"direction": [1e400, 0]}',
        '"grounding": {"point": [-1e400, 0]}',
        '"fps": 1e400',
        '"seed": 1e400',
        '"generator_options": {"a": 1e400}',
    ):
        told(post(http, f"{rest}, {field}}}"), 422, "invalid-request", "finite")


@pytest.mark.parametrize(
    ("body", "media_type"),
    [
        pytest.param(b"\xef\xbb\xbf" + TEXT.encode(), "application/json", id="byte order mark"),
        pytest.param(TEXT, 'Application/JSON; Charset="UTF-8"; Foo=bar;', id="odd parameters"),
        pytest.param(TEXT, "application/vnd.cow+json", id="+json"),
        pytest.param(
            TEXT.replace("the red ball", "the red \\ud83d\\ude00 ball"), "application/json", id="a whole pair"
        ),
        pytest.param("\n\t " + TEXT + " \r\n", "application/json", id="blanks around it"),
    ],
)
def test_odd_bodies_that_are_taken(http: httpx.Client, body: bytes | str, media_type: str) -> None:
    assert post(http, body, media_type).status_code == 200


@pytest.mark.parametrize(
    ("media_type", "says"),
    [
        ("", "'none'"),
        ("text/plain", "text/plain"),
        ("application/x-www-form-urlencoded", "multipart/form-data"),
        ("application/json/x", "application/json/x"),
        ("multipart/mixed; boundary=x", "multipart/mixed"),
        ("x" * 30_000, "x" * 80 + "'"),
        ("multipart/form-data; boundary=x; charset=punycode", "'punycode'"),
        ("multipart/form-data; boundary=x; charset=unicode_escape", "send UTF-8"),
    ],
)
def test_media_types_that_nobody_reads(http: httpx.Client, media_type: str, says: str) -> None:
    told(post(http, TEXT, media_type), 415, "body-type-unsupported", says)


def part(name: str | None, value: bytes, *, file: str | None = None, header: bytes = b"") -> bytes:
    shown = b"form-data" + (b'; name="%s"' % name.encode() if name is not None else b"")
    shown += b'; filename="%s"' % file.encode() if file is not None else b""
    return b"--x\r\nContent-Disposition: " + shown + b"\r\n" + header + b"\r\n" + value + b"\r\n"


FILE = part("image", PNG, file="a.png")
ASKED = part("question", QUESTION.encode())


END = b"--x--\r\n"
LONG_HEADER = b"X: " + b"a" * 1_000_000 + b"\r\n"
FORMS: dict[str, tuple[bytes, int, str]] = {
    "empty": (b"", 400, "multipart"),
    "no parts": (END, 422, "/image"),
    "no end": (FILE + ASKED, 400, "ends before its last boundary"),
    "a part cut off": (FILE + ASKED + part("request", b'{"seed": 7}')[:-8], 400, "ends before its last boundary"),
    "1001 fields": (b"".join(part(f"f{i}", b"") for i in range(1001)) + END, 400, "Too many fields"),
    "1001 files": (part("image", b"", file="a") * 1001 + END, 400, "Too many files"),
    "no name": (part(None, b"a") + END, 400, '"name"'),
    "a part header of 1 MB": (part("image", PNG, file="a", header=LONG_HEADER) + END, 400, "multipart"),
    "10,000 part headers": (part("image", PNG, file="a", header=b"X: y\r\n" * 10_000) + END, 400, "multipart"),
    "two images": (FILE + FILE + ASKED + END, 422, "`image` appears more than once in the form"),
    "two questions": (FILE + ASKED + ASKED + END, 422, "`question` appears more than once in the form"),
    "an endless name": (FILE + ASKED + part("s" * 3000, b"") + END, 422, "(3000 characters)"),
    "image as a field": (part("image", PNG) + ASKED + END, 422, "file part"),
    "question as a file": (FILE + part("question", b"?", file="q") + END, 422, "plain field"),
    "question of 1 MB": (FILE + part("question", b"a" * 1_000_000) + END, 422, "1000000 characters"),
    "question with NUL": (FILE + part("question", b"a\0b") + END, 422, "NUL"),
    "invisible question": (FILE + part("question", "\u200b".encode()) + END, 422, "empty"),
}


@pytest.mark.parametrize("name", FORMS)
def test_forms_that_cannot_be_read(http: httpx.Client, name: str) -> None:
    body, status, says = FORMS[name]
    code = {400: "malformed-body", 422: "invalid-request"}[status]
    told(post(http, body, "multipart/form-data; boundary=x"), status, code, says)


def test_the_boundary_of_a_form(http: httpx.Client) -> None:
    whole = FILE + ASKED + part("request", b'{"num_frames": 5, "video": false}') + b"--x--"
    assert post(http, whole, 'Multipart/Form-Data; Boundary="x"; odd=1').status_code == 200
    told(post(http, whole, "multipart/form-data"), 400, "malformed-body", "boundary")
    told(post(http, whole, "multipart/form-data; boundary="), 400, "malformed-body", "multipart")
    told(post(http, whole, "multipart/form-data; boundary=y"), 400, "malformed-body", "multipart")
    told(post(http, whole, "multipart/form-data; boundary=" + "y" * 5000), 400, "malformed-body", "multipart")


def chunks(body: bytes) -> Iterator[bytes]:
    yield from (body[at : at + 65536] for at in range(0, len(body), 65536))


@pytest.mark.parametrize("form", [False, True], ids=["JSON", "multipart"])
@pytest.mark.parametrize("announced", [True, False], ids=["announced", "chunked"])
def test_the_limit_of_a_body(server: Server, http: httpx.Client, form: bool, announced: bool) -> None:
    head, tail = (ASKED + part("image", b"", file="a")[:-2], b"\r\n--x--") if form else (SMALL.encode(), b"")
    media_type = "multipart/form-data; boundary=x" if form else "application/json"
    exact = head + b" " * (LIMIT - len(head) - len(tail)) + tail
    for body, refused in ((exact, False), (head + b" " * (LIMIT + 1 - len(head) - len(tail)) + tail, True)):
        content = body if announced else chunks(body)
        with little_memory(server):
            response = http.post("/simulate", content=content, headers={"content-type": media_type})
        if refused:
            told(response, 413, "body-too-large", "3 MB")
        else:
            assert len(body) == LIMIT
            assert response.status_code in (415, 422), response.text


def test_a_data_url_past_the_limit(server: Server, http: httpx.Client) -> None:
    huge = json.dumps({**BODY, "image": "data:image/png;base64," + "A" * 40_000_000}).encode()
    for content in (huge, chunks(huge)):
        with little_memory(server):
            response = http.post("/simulate", content=content, headers=JSON)
        told(response, 413, "body-too-large", "3 MB")


# Addresses


@pytest.mark.parametrize(
    ("path", "code", "says"),
    [
        ("/artifacts/../../etc/passwd", "not-found", "GET /openapi.json"),
        ("/artifacts/..%2f..%2fetc%2fpasswd", "not-found", ""),
        ("/artifacts//etc/passwd", "not-found", ""),
        ("/artifacts/%2fetc%2fpasswd", "not-found", ""),
        ("/artifacts/..", "artifact-not-found", "'..'"),
        ("/artifacts/%2e%2e", "artifact-not-found", "64 lower-case"),
        ("/artifacts/..%5c..%5cetc", "artifact-not-found", "64 lower-case"),
        ("/artifacts/%00", "artifact-not-found", "64 lower-case"),
        ("/artifacts/" + HEX + "%00", "artifact-not-found", "64 lower-case"),
        ("/artifacts/" + HEX + "%0a", "artifact-not-found", "64 lower-case"),
        ("/artifacts/" + HEX.upper(), "artifact-not-found", "64 lower-case"),
        ("/artifacts/" + HEX + "0", "artifact-not-found", "64 lower-case"),
        ("/artifacts/" + HEX[:-1], "artifact-not-found", "64 lower-case"),
        ("/artifacts/%ff%fe", "artifact-not-found", "64 lower-case"),
        ("/artifacts/" + "%D9%A3" * 64, "artifact-not-found", "64 lower-case"),
        ("/artifacts/" + HEX, "artifact-not-found", HEX),
        ("/" + "a" * 50_000, "not-found", "50001 characters"),
    ],
)
def test_addresses_with_nothing_there(server: Server, path: str, code: str, says: str) -> None:
    # Sent as written: clients tidy dots away.
    told(talk(server, request(method="GET", path=path)), 404, code, says)


# The connection


def connect(server: Server) -> socket.socket:
    host, port = server.address.removeprefix("http://").split(":")
    return socket.create_connection((host, int(port)), timeout=20)


def received(connection: socket.socket, *already: bytes) -> bytes:
    """All that comes until the server closes the connection, after what came ``already``."""
    pieces = [piece for piece in already if piece]
    try:
        while piece := connection.recv(65536):
            pieces.append(piece)
    except ConnectionResetError:  # it closed while there was more to read
        assert pieces
    return b"".join(pieces)


def parsed(data: bytes) -> httpx.Response:
    """The first response of what came."""
    head, _, body = data.partition(b"\r\n\r\n")
    status, *lines = head.decode("latin-1").split("\r\n")
    headers = dict(line.lower().split(": ", 1) for line in lines)
    return httpx.Response(int(status.split()[1]), headers=headers, content=body[: int(headers["content-length"])])


def talk(server: Server, sent: bytes) -> httpx.Response:
    with connect(server) as connection:
        connection.sendall(sent)
        return parsed(received(connection))


def request(*headers: str, method: str = "POST", path: str = "/simulate", version: str = "1.1") -> bytes:
    lines = (f"{method} {path} HTTP/{version}", "Host: x", "Content-Type: application/json", *headers)
    return "\r\n".join((*lines, "Connection: close", "", "")).encode()


@pytest.mark.parametrize(
    ("sent", "status", "code"),
    [
        pytest.param(request("Content-Length: 20") + TEXT.encode(), 400, "malformed-body", id="length too short"),
        pytest.param(
            request("Content-Length: 5", "Transfer-Encoding: chunked") + b"2\r\n{}\r\n0\r\n\r\n",
            400,
            "malformed-body",
            id="two lengths",
        ),
        pytest.param(
            request(f"Content-Length: {len(SMALL)}", version="1.0") + SMALL.encode(),
            422,
            "invalid-request",
            id="HTTP/1.0",
        ),
        pytest.param(
            request("X-HTTP-Method-Override: POST", method="GET"), 405, "method-not-allowed", id="GET overridden"
        ),
        pytest.param(
            request("X-HTTP-Method-Override: DELETE", f"Content-Length: {len(SMALL)}") + SMALL.encode(),
            422,
            "invalid-request",
            id="POST overridden",
        ),
        pytest.param(request(method="BREW"), 405, "method-not-allowed", id="BREW"),
        pytest.param(
            request("Expect: 100-continue", f"Content-Length: {LIMIT + 1}"),
            413,
            "body-too-large",
            id="expected too much",
        ),
    ],
)
def test_odd_requests(server: Server, sent: bytes, status: int, code: str) -> None:
    told(talk(server, sent), status, code)


@pytest.mark.parametrize(
    "sent",
    [
        pytest.param(request(path="/" + "a" * 100_000), id="a path of 100 KB"),
        pytest.param(request("X-Long: " + "a" * 100_000), id="a header of 100 KB"),
        pytest.param(request("Content-Length: -1"), id="negative length"),
        pytest.param(request("Content-Length: 5", "Content-Length: 6") + b"{}", id="two lengths that differ"),
        pytest.param(request("Transfer-Encoding: gzip"), id="unknown transfer encoding"),
        pytest.param(b"GET / HTTP/1.1\r\nHost: x\r\nBad Header: y\r\n\r\n", id="a blank in a header's name"),
        pytest.param(b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03" + bytes(500), id="TLS"),
        pytest.param(os.urandom(2000) + b"\r\n\r\n", id="noise"),
    ],
)
def test_what_is_no_http_is_refused_before_the_app(server: Server, sent: bytes) -> None:
    with connect(server) as connection:
        connection.sendall(sent)
        # A long line that comes in one piece gets through to the app.
        assert received(connection).split()[1] in (b"400", b"404", b"415", b"431", b"501")


def test_a_caller_may_ask_whether_to_go_on(server: Server) -> None:
    with connect(server) as connection:
        connection.sendall(request("Expect: 100-continue", f"Content-Length: {len(SMALL)}"))
        assert connection.recv(1000).startswith(b"HTTP/1.1 100 ")
        connection.sendall(SMALL.encode())
        assert parsed(received(connection)).status_code == 422


@pytest.fixture(scope="module")
def hasty(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """A server that waits a second for a body."""
    with another_server(tmp_path_factory.mktemp("hasty"), COW_BODY_TIMEOUT="1") as server:
        yield server


@pytest.mark.parametrize(
    ("headers", "pieces", "seen"),
    [
        pytest.param(("Content-Length: 999",), [b"x"] * 30, "", id="a byte at a time"),
        pytest.param(("Transfer-Encoding: chunked",), [b"1\r\nx\r\n"] * 30, "", id="a byte at a time, chunked"),
        pytest.param(
            (f"Content-Length: {len(SMALL) + 9}",), [SMALL.encode()], f"{len(SMALL)} bytes", id="length too long"
        ),
        pytest.param(("Content-Length: 9",), [], "0 bytes", id="no body"),
    ],
)
def test_bodies_that_do_not_arrive(hasty: Server, headers: tuple[str, ...], pieces: list[bytes], seen: str) -> None:
    with connect(hasty) as connection:
        connection.settimeout(0.1)
        connection.sendall(request(*headers).replace(b"Connection: close\r\n", b""))
        began, answer = time.monotonic(), b""
        for piece in [*pieces, *[b""] * 30]:
            connection.sendall(piece)
            with suppress(TimeoutError):
                answer = connection.recv(65536)
                break
        waited = time.monotonic() - began
        connection.settimeout(20)
        response = parsed(received(connection, answer))
    told(response, 408, "body-too-slow", seen)
    assert "COW_BODY_TIMEOUT" in response.text
    assert response.headers["connection"] == "close"
    assert 0.9 < waited < 4


def test_a_body_that_is_in_may_be_worked_on_for_longer(hasty: Server) -> None:
    body = {**BODY, "num_frames": 481, "video": True}
    assert httpx.post(hasty.address + "/simulate", json=body, timeout=60).status_code == 200
