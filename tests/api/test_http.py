"""The wire: a real server in its own process, asked as callers ask."""

from __future__ import annotations

import base64
import hashlib
import json
import socket
import zlib

import httpx
import numpy as np
import pytest
from drawn import ball, block, floor, png_bytes

from cow_service.records import Models, Simulation

IMAGE = png_bytes(block(ball(floor(), (150, 200), 40, (210, 20, 20)), (430, 160, 510, 250), (50, 80, 200)))
DATA_URL = "data:image/png;base64," + base64.b64encode(IMAGE).decode()
QUESTION = "If the red ball moves to the right, will it hit the blue cube?"
BODY = {"image": DATA_URL, "question": QUESTION, "num_frames": 17}


def problem(response: httpx.Response, status: int, code: str) -> dict:
    assert response.status_code == status, response.text
    assert response.headers["content-type"] == "application/problem+json"
    body = response.json()
    assert set(body) - {"remedy"} == {"type", "title", "status", "detail", "errors"}
    assert body["type"] == "urn:cow:problem:" + code, body
    assert body["status"] == status
    assert body["title"]
    assert body["detail"]
    assert "Traceback" not in response.text
    assert "/tmp" not in response.text
    return body


def pointers(response: httpx.Response) -> set[str]:
    return {error["pointer"] for error in response.json()["errors"]}


def test_json_in_simulation_out(http: httpx.Client) -> None:
    response = http.post("/simulate", json=BODY)
    assert response.status_code == 200, response.text
    simulation = Simulation.model_validate(response.json())
    assert simulation.image.sha256 == hashlib.sha256(IMAGE).hexdigest()
    assert simulation.video is not None
    for sha256, media_type in (
        (simulation.image.sha256, "image/png"),
        (simulation.frames[0].sha256, "image/png"),
        (simulation.overlay.sha256, "image/jpeg"),
        (simulation.video.sha256, "video/mp4"),
    ):
        artifact = http.get(f"/artifacts/{sha256}")
        assert artifact.headers["content-type"] == media_type
        assert hashlib.sha256(artifact.content).hexdigest() == sha256


def test_multipart_is_the_same_request(http: httpx.Client) -> None:
    rest = {"num_frames": 17, "frames": {"policy": "uniform", "count": 2}}
    form = {"question": QUESTION, "request": json.dumps(rest)}
    response = http.post("/simulate", data=form, files={"image": ("a.png", IMAGE, "image/png")})
    assert response.status_code == 200, response.text
    simulation = Simulation.model_validate(response.json())
    assert [frame.index for frame in simulation.frames] == [0, 16]
    again = http.post("/simulate", json={"image": {"artifact": simulation.image.sha256}, "question": QUESTION, **rest})
    assert [f["sha256"] for f in again.json()["frames"]] == [f.sha256 for f in simulation.frames]


@pytest.mark.parametrize(
    ("body", "expected"),
    [
        ({}, {"/image", "/question"}),
        ({**BODY, "sede": 1}, {"/sede"}),
        ({**BODY, "num_frames": "many"}, {"/num_frames"}),
        ({**BODY, "motion": {"direction": [1]}}, {"/motion/direction/1"}),
        ({**BODY, "motion": {"direction": [0, 0]}}, {"/motion/direction"}),
        ({**BODY, "frames": {"count": 0, "policy": "best"}}, {"/frames/count", "/frames/policy"}),
        ({**BODY, "grounding": {"point": [9999, 1]}}, {"/grounding/point"}),
        ({**BODY, "reader": "nobody"}, {"/reader"}),
        ({**BODY, "motion": {"kind": "fall", "direction": [1, 0]}}, {"/motion"}),
        ({**BODY, "motion": {"kind": "fall", "metres_per_pixel": 1e-300}}, {"/motion/metres_per_pixel"}),
        ({**BODY, "image": "example.org"}, {"/image"}),
        ({**BODY, "image": 7}, {"/image"}),
        ({**BODY, "image": "data:image/png;base64,!!"}, {"/image"}),
    ],
)
def test_invalid_fields_are_pointed_at(http: httpx.Client, body: dict, expected: set[str]) -> None:
    response = http.post("/simulate", json=body)
    problem(response, 422, "invalid-request")
    assert expected <= pointers(response), response.json()


def raw(body: bytes | str, media_type: str = "application/json") -> dict:
    return {"content": body, "headers": {"content-type": media_type}}


@pytest.mark.parametrize("body", ["", "{", "[]", "7", b"\xff\xfe", "[" * 50_000, '{"question": "\\ud800"}'])
def test_what_is_no_json_object_is_malformed(http: httpx.Client, body) -> None:
    problem(http.post("/simulate", **raw(body)), 400, "malformed-body")


def test_other_media_types_and_bad_forms(http: httpx.Client) -> None:
    problem(http.post("/simulate", **raw("a=b", "application/x-www-form-urlencoded")), 415, "body-type-unsupported")
    problem(http.post("/simulate", content=b"{}"), 415, "body-type-unsupported")
    problem(http.post("/simulate", **raw(b"junk", "multipart/form-data; boundary=x")), 400, "malformed-body")
    problem(http.post("/simulate", **raw(b"junk", "multipart/form-data")), 400, "malformed-body")
    image = {"image": ("a.png", IMAGE, "image/png")}
    response = http.post("/simulate", data={"question": "?", "seed": "3"}, files=image)
    problem(response, 422, "invalid-request")
    assert pointers(response) == {"/seed"}
    problem(http.post("/simulate", data={"question": "?", "request": "{"}, files=image), 400, "malformed-body")
    again = {"question": "?", "request": json.dumps({"question": "other"})}
    response = http.post("/simulate", data=again, files=image)
    problem(response, 422, "invalid-request")
    assert pointers(response) == {"/question"}
    response = http.post("/simulate", data={"image": "a"}, files={"question": ("q", b"?")})
    problem(response, 422, "invalid-request")


def test_images_that_cannot_be_used(http: httpx.Client) -> None:
    def send(data: bytes) -> httpx.Response:
        return http.post("/simulate", data={"question": QUESTION}, files={"image": ("a", data, "image/png")})

    problem(send(b"GIF89a......."), 415, "image-type-unsupported")
    problem(send(IMAGE[:300]), 422, "image-unreadable")
    huge = bytearray(IMAGE)
    huge[16:24] = (100_000).to_bytes(4, "big") * 2
    huge[29:33] = zlib.crc32(huge[12:29]).to_bytes(4, "big")
    told = problem(send(bytes(huge)), 413, "image-too-large")
    assert "100000" in told["detail"].replace(",", "")
    for image in ({"url": "http://x"}, "http://x"):
        problem(http.post("/simulate", json={**BODY, "image": image}), 422, "image-url-not-allowed")
    problem(http.post("/simulate", json={**BODY, "image": {"artifact": "0" * 64}}), 404, "artifact-not-found")


def test_refusals_of_the_reader(http: httpx.Client) -> None:
    told = problem(
        http.post("/simulate", json={**BODY, "question": "If the pink car turns, what?"}), 422, "cannot-ground"
    )
    assert "pink car" in told["detail"]
    assert "grounding" not in told["detail"]
    assert "`grounding.point`" in told["remedy"]
    forward = {**BODY, "question": "If the red ball moves forward, will it hit the blue cube?"}
    problem(http.post("/simulate", json=forward), 422, "cannot-read-direction")


def test_bodies_past_the_limit_are_refused_announced_or_not(http: httpx.Client) -> None:
    problem(http.post("/simulate", json={**BODY, "question": "x" * 4_000_000}), 413, "body-too-large")

    def chunks():
        for _ in range(50):
            yield b" " * 100_000

    response = http.post("/simulate", content=chunks(), headers={"content-type": "application/json"})
    told = problem(response, 413, "body-too-large")
    assert "3 MB" in told["detail"]

    def parts():
        yield b'--x\r\nContent-Disposition: form-data; name="image"; filename="a"\r\n\r\n'
        yield from chunks()

    form = {"content-type": "multipart/form-data; boundary=x"}
    problem(http.post("/simulate", content=parts(), headers=form), 413, "body-too-large")


def test_addresses_and_methods_that_are_not_there(http: httpx.Client) -> None:
    problem(http.get("/nothing"), 404, "not-found")
    problem(http.get("/simulate"), 405, "method-not-allowed")
    assert http.get("/simulate").headers["allow"] == "POST"
    for path, methods in (("/jobs/x", "DELETE, GET"), ("/jobs", "GET"), ("/artifacts/x", "GET, HEAD")):
        assert problem(told := http.patch(path), 405, "method-not-allowed")
        assert told.headers["allow"] == methods
    problem(http.get("/artifacts/" + "0" * 64), 404, "artifact-not-found")
    problem(http.get("/artifacts/..%2f..%2fetc%2fpasswd"), 404, "not-found")
    problem(http.get("/artifacts/ABC"), 404, "artifact-not-found")
    problem(http.get("/livez/"), 404, "not-found")


def test_artifacts_are_cached_forever_and_served_in_parts(http: httpx.Client) -> None:
    sha256 = http.post("/simulate", json=BODY).json()["video"]["sha256"]
    url = f"/artifacts/{sha256}"
    whole = http.get(url)
    assert whole.headers["etag"] == f'"{sha256}"'
    assert "immutable" in whole.headers["cache-control"]
    assert whole.headers["accept-ranges"] == "bytes"
    assert http.get(url, headers={"if-none-match": f'"{sha256}"'}).status_code == 304
    assert http.get(url, headers={"if-none-match": '"other"'}).status_code == 200
    part = http.get(url, headers={"range": "bytes=10-19"})
    assert (part.status_code, part.content) == (206, whole.content[10:20])
    outside = http.get(url, headers={"range": "bytes=999999999-"})
    problem(outside, 416, "range-not-satisfiable")
    assert outside.headers["content-range"] == f"bytes */{len(whole.content)}"
    for ignored in ("bytes=abc", "foo=0-1", "bytes=5-2", "bytes=" + ",".join(f"{i}-{i}" for i in range(500))):
        assert http.get(url, headers={"range": ignored}).content == whole.content
    assert http.get(url, headers={"range": "bytes=-5"}).content == whole.content[-5:]
    head = http.head(url)
    assert (head.status_code, head.content) == (200, b"")
    assert int(head.headers["content-length"]) == len(whole.content)


def test_probes_and_models(http: httpx.Client) -> None:
    assert http.get("/livez").json() == {"status": "ok"}
    assert http.get("/readyz").json() == {"status": "ok"}
    models = Models.model_validate(http.get("/models").json())
    assert [(m.name, m.default) for m in models.readers] == [("embedded", True), ("local", False), ("mllm", False)]
    assert models.readers[0].ready
    assert {"qwen3-vl-8b", "gpt-5", "generic"} <= set(models.mllms)
    assert [(m.name, m.ready) for m in models.generators if m.default] == [("cutout", True)]
    assert next(m for m in models.generators if m.default).needs == ("cv2", "numpy", "av")


def test_a_caller_that_hangs_up_leaves_the_server_well(server, http: httpx.Client) -> None:
    host, port = server.address.removeprefix("http://").split(":")
    with socket.create_connection((host, int(port))) as raw_socket:
        raw_socket.sendall(
            b"POST /simulate HTTP/1.1\r\nHost: x\r\nContent-Type: application/json\r\nContent-Length: 999\r\n\r\n{"
        )
    assert http.get("/livez").status_code == 200


def test_requests_side_by_side_do_not_mix(http: httpx.Client) -> None:
    from concurrent.futures import ThreadPoolExecutor

    def ask(shift: int) -> float:
        image = png_bytes(ball(floor(320, 240), (60 + shift, 120), 25, (210, 20, 20)))
        url = "data:image/png;base64," + base64.b64encode(image).decode()
        body = {"image": url, "question": "If the red ball moves left, what happens?", "video": False}
        return http.post("/simulate", json=body).json()["grounding"]["point"][0]

    shifts = list(range(0, 200, 25))
    with ThreadPoolExecutor(8) as pool:
        found = list(pool.map(ask, shifts))
    assert np.allclose(found, [60 + shift for shift in shifts], atol=2)
