"""The wire: a real server in its own process, asked as callers ask."""

from __future__ import annotations

import hashlib
import json

import httpx
from drawn import ball, block, floor, png_bytes
from servers import QUESTION, data_url, problem

from cow_service.records import Simulation

IMAGE = png_bytes(block(ball(floor(), (150, 200), 40, (210, 20, 20)), (430, 160, 510, 250), (50, 80, 200)))
BODY = {"image": data_url(IMAGE), "question": QUESTION, "num_frames": 17}


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


def test_what_has_to_be_removed_is_asked_of_each_thing_or_of_one(http: httpx.Client) -> None:
    """A ball, a block and a cube in a row; nothing but `asked` says what is asked."""
    boxes = {"cube": (480, 196, 550, 274), "green block": (280, 200, 350, 272), "post": (300, 40, 350, 90)}
    image = floor()
    for box, colour in zip(boxes.values(), ((40, 60, 200), (40, 160, 60), (210, 190, 40)), strict=True):
        image = block(image, box, colour)
    asked = {"relation": "touches", "target": "green block"}
    body = {
        "image": data_url(png_bytes(ball(image, (105, 235), 25, (200, 30, 30)))),
        "grounding": {"object": "red ball", "bbox": (80, 210, 130, 260)},
        "objects": [{"object": name, "bbox": box, "shape": "box"} for name, box in boxes.items()],
        "motion": {"direction": (1, 0)},
        "camera": {"pitch": 28, "focal": 640},
        "objects_complete": True,
        "num_frames": 17,
    }
    which = {
        "question": "Which has to go, that there is no collision?",
        "asked": asked | {"form": "which-to-remove", "among": ["green block", "post"]},
        "options": ["only the post", "only the green block", "both", "neither", "Not sure"],
    }
    answer = http.post("/answer", json=body | which).json()
    outcome = answer["simulation"]["trajectory"]["outcome"]
    assert (answer["answer"], outcome["as_it_is"], outcome["object"]) == ("B", 1, "green block")
    assert outcome["candidates"] == [
        {"object": "green block", "probability": 1, "sure": True}, {"object": "post", "probability": 0, "sure": True},
    ]  # fmt: skip
    assert answer["reasoning"].startswith(
        "It hits the green block, removing the green block prevents that and removing the post does not prevent that. "
    )
    for target, removed, said in (
        ("cube", "post", "Yes"),
        ("green block", "post", "No"),
        ("cube", "green block", "No"),
    ):
        whether = {
            "question": f"Would there be no collision without the {removed}?",
            "interventions": [{"kind": "remove", "object": removed}],
            "asked": asked | {"target": target, "negated": True},
            "options": ["Yes", "No", "Not sure"],
        }
        answer = http.post("/answer", json=body | whether).json()
        does = "misses" if said == "Yes" else "hits"
        assert answer["option"] == said
        assert answer["reasoning"].startswith(f"{said}, it {does} the {target}")
        assert answer["simulation"]["narration"]["story"].startswith(f"Without the {removed}: The red ball rolls ")


def test_methods_that_an_address_does_not_have(http: httpx.Client) -> None:
    addresses = {"/simulate": "POST", "/jobs/x": "DELETE, GET", "/jobs": "GET", "/artifacts/x": "GET, HEAD"}
    for path, methods in addresses.items():
        response = http.patch(path)
        problem(response, 405, "method-not-allowed")
        assert response.headers["allow"] == methods
    problem(http.get("/livez/"), 404, "not-found")


def test_artifacts_are_cached_forever_and_served_in_parts(http: httpx.Client) -> None:
    sha256 = http.post("/simulate", json=BODY).json()["video"]["sha256"]
    url = f"/artifacts/{sha256}"
    whole = http.get(url)
    assert whole.headers["etag"] == f'"{sha256}"'
    assert whole.headers["cache-control"] == "public, max-age=31536000, immutable"
    assert whole.headers["accept-ranges"] == "bytes"
    for tag, status in ((f'"{sha256}"', 304), (f'W/"{sha256}", "x"', 304), ("*", 304), ('"other"', 200)):
        assert http.get(url, headers={"if-none-match": tag}).status_code == status
    part = http.get(url, headers={"range": "bytes=10-19"})
    assert (part.status_code, part.content) == (206, whole.content[10:20])
    outside = http.get(url, headers={"range": "bytes=999999999-"})
    problem(outside, 416, "range-not-satisfiable")
    assert outside.headers["content-range"] == f"bytes */{len(whole.content)}"
    for ignored in ("bytes=abc", "foo=0-1", "bytes=5-2", "bytes=" + ",".join(f"{2 * i}-{2 * i}" for i in range(9))):
        assert http.get(url, headers={"range": ignored}).content == whole.content
    assert http.get(url, headers={"range": "bytes=-5"}).content == whole.content[-5:]
    head = http.head(url)
    assert (head.status_code, head.content) == (200, b"")
    assert int(head.headers["content-length"]) == len(whole.content)
