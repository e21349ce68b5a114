"""The wording of errors: each code with what provokes it, the fields that it points to, and what it says.

This is the only place for that. Other tests assert codes, pointers and fields (`refusals.py`, `servers.problem`).
"""

from __future__ import annotations

import asyncio
import json
import re
from collections.abc import AsyncIterator, Callable
from importlib.metadata import EntryPoint
from typing import Any

import bad_images
import httpx
import pytest
from asgi import app_of, ask
from chats import HELLO, WITHOUT, saying
from random_mllm import failing
from servers import BODY, IMAGE, QUESTION, picture, slow

from cow_service import errors, registry
from cow_service.api.app import create_app
from cow_service.api.body import read_object
from cow_service.errors import CowError
from cow_service.jobs.engine import JobEngine
from cow_service.registry import Registry
from cow_service.requests import ImageUrl
from cow_service.service import Service
from cow_service.settings import Settings
from cow_service.weights.repositories import LOCK_NAME, folder_of, read_lock

pytest_plugins = ("chat_server",)
pytestmark = pytest.mark.slow
ID = "00000000-0000-0000-0000-000000000000"
SHA = "0" * 64
KEYS = {"alice": f"sha256:{SHA}"}


# Where an error is provoked, by the name of a fixture: `http` is a server, `served` one with an MLLM, which is `mllm`.
Doors = Callable[[str], Any]
Provoke = Callable[[Doors], httpx.Response | None]


def service(doors: Doors, **settings: Any) -> Service:
    return Service(Settings(data_dir=doors("tmp_path") / "data", **settings))


def called(method: str, path: str, **options: Any) -> Provoke:
    return lambda doors: doors("http").request(method, path, **options)


def simulated(**fields: Any) -> Provoke:
    return called("POST", "/simulate", json=BODY | fields)


def sent(image: bytes) -> Provoke:
    """As a file of a form."""
    return called("POST", "/simulate", data={"question": BODY["question"]}, files={"image": ("a", image)})


def read(text: bytes | str) -> Provoke:
    def provoke(_: Doors) -> None:
        read_object(text, "The body")

    return provoke


def in_app(*request: Any, **settings: Any) -> Provoke:
    def provoke(doors: Doors) -> httpx.Response:
        return ask(app_of(doors("tmp_path"), **settings), *[request] * (1 + settings.get("rate_limit", 0)))[-1]

    return provoke


def chatted(reply: Any) -> Provoke:
    def provoke(doors: Doors) -> httpx.Response:
        doors("mllm").next_replies = [reply]
        return doors("served").http.post("/v1/chat/completions", json={"model": WITHOUT, "messages": HELLO})

    return provoke


def out_of_range(doors: Doors) -> httpx.Response:
    image = doors("http").post("/simulate", json=BODY).json()["image"]["sha256"]
    return doors("http").get(f"/artifacts/{image}", headers={"Range": "bytes=999999-"})


def reused_key(doors: Doors) -> httpx.Response:
    key = {"Idempotency-Key": "of-the-table"}
    assert doors("http").post("/simulate", json=BODY, headers=key).status_code == 200
    return doors("http").post("/simulate", json=BODY | {"seed": 1}, headers=key)


def film_of_a_still(doors: Doors) -> httpx.Response:
    job = doors("http").post("/simulate", json=BODY).json()["id"]
    return doors("http").get(f"/jobs/{job}/download?format=film")


def canceled(doors: Doors) -> httpx.Response:
    key = {"Idempotency-Key": "of-the-table"}
    job = doors("served").submit(slow(30), **key)["id"]
    doors("served").http.post(f"/jobs/{job}/cancel")
    return doors("served").http.post("/simulate", json=slow(30), headers=key)


def read_by_the_mllm(reply: Any, question: str) -> Provoke:
    def provoke(doors: Doors) -> httpx.Response:
        doors("mllm").next_replies = [reply] * 40  # in whichever form the call is sent
        body = {"image": BODY["image"], "question": question}
        response = doors("served").http.post("/simulate", json=body, headers={"Cache-Control": "no-cache"})
        doors("mllm").next_replies = []
        return response

    return provoke


def body_that_does_not_come(doors: Doors) -> httpx.Response:
    async def parts() -> AsyncIterator[bytes]:
        yield b"{"
        await asyncio.Event().wait()

    headers = {"Content-Type": "application/json"}
    return ask(app_of(doors("tmp_path"), body_timeout=0.1), ("POST", "/look", headers, parts()))[0]


def full_queue(doors: Doors) -> None:
    engine = JobEngine(service(doors))
    engine.jobs.count_open = lambda owner: (1000, 0)  # type: ignore[method-assign]
    engine.check_capacity(None)


def not_started(doors: Doors) -> httpx.Response:
    return ask(create_app(JobEngine(service(doors)), starting=False), ("GET", "/models"))[0]


def stopping(doors: Doors) -> None:
    engine = JobEngine(service(doors))
    engine.drain()
    engine.check_capacity(None)


def no_folder(doors: Doors) -> httpx.Response:
    (doors("tmp_path") / "data").write_text("a file")
    return ask(app_of(doors("tmp_path")), ("GET", "/readyz"))[0]


def broken(doors: Doors) -> httpx.Response:
    app = app_of(doors("tmp_path"))

    @app.get("/broken")
    async def fail() -> None:
        raise RuntimeError("secret")

    return ask(app, ("GET", "/broken"))[0]


def unreachable(doors: Doors) -> None:
    service(doors, allow_image_urls=("nosuch.invalid",)).fetch(ImageUrl(url="http://nosuch.invalid/a.png"))


def damaged_record(doors: Doors) -> None:
    lock = folder_of(doors("tmp_path"), "owner/weights") / LOCK_NAME
    lock.parent.mkdir(parents=True)
    lock.write_text("{")
    read_lock(doors("tmp_path"), "owner/weights")


def without_its_package(kind: type[CowError]) -> Provoke:
    def provoke(doors: Doors) -> None:
        far = EntryPoint("far", "no_such_package.far:create", "none")
        doors("monkeypatch").setattr(registry, "entry_points", lambda group: (far,))
        Registry("none", kind, Settings()).get("far")

    return provoke


# By code: what provokes the error, what it says, and the fields that it points to.
TABLE: dict[str, list[tuple[Any, ...]]] = {
    "invalid-request": [
        (simulated(sede=1), "/sede: there is no such field, got 1.", "/sede"),
        (simulated(num_frames="81"), '/num_frames: must be a number, without quotes, got "81".', "/num_frames"),
        (simulated(question="red\0ball"),
         "/question: contains the character NUL (U+0000) at position 3; leave it out.", "/question"),
        (simulated(question=" \u200b"),
         "/question: is empty: it holds only 2 blank or invisible characters. Ask, for example: 'If "
         "the red ball moves to the left, will it hit the vase?'.", "/question"),
        (simulated(options=["Yes", " yes "]),
         "/options: options must be two or more different texts, got ['Yes', ' yes '].", "/options"),
        (simulated(motion={"direction": [0, 0]}),
         "/motion/direction: [dx, dy] must not have zero length, got [0.0, 0.0].", "/motion/direction"),
        (simulated(grounding={"bbox": [60, 60, 20, 90]}),
         "/grounding/bbox: [x0, y0, x1, y1] must have x1 and y1 at least 2 px beyond x0 and "
         "y0, got [60.0, 60.0, 20.0, 90.0].", "/grounding/bbox"),
        (simulated(grounding={"point": [999, 1]}),
         "`grounding.point`: [999.0, 1.0] lies outside the upright image of 240 x 160 px. "
         "Give pixels of the object alone, x right and y down.", "/grounding/point"),
        (simulated(frames={"indices": [9]}),
         "`frames.indices` names frames that the clip does not have: it has 0 to 4.", "/frames/indices/0"),
        (simulated(reader="nobody"), "There is no reader 'nobody'. There are: embedded, local, mllm.", "/reader"),
        (simulated(generator="nobody"),
         "There is no generator 'nobody'. There are: ati, cutout, refine, refine-5b, tiny-ati, "
         "tiny-refine, tiny-wan-move, wan-move.", "/generator"),
        (simulated(generator_options={"clean_cuse": True}),
         "`generator_options` are not valid for this generator. It takes: "
         "clean_cues.", "/generator_options/clean_cuse"),
        (simulated(image="data:image/png;base64,!!"),
         "The base64 of `image` cannot be decoded (Only base64 data is allowed): encode the file's "
         "bytes in the standard alphabet.", "/image"),
        (called("GET", "/jobs?limit=0"),
         '/query/limit: Input should be greater than or equal to 1, got "0".', "/query/limit"),
    ],
    "malformed-body": [
        (read(b""), "The body is not JSON (expecting value, line 1 column 1): send one JSON object."),
        (read("[]"), "The body must be a JSON object, got an array: send {...}."),
        (read("{'question': 1}"),
         "The body is not JSON (expecting property name enclosed in double quotes, line 1 column 2): send one "
         "JSON object."),
        (read('{"a": "b"'.encode("utf-16")), "The body is not UTF-8 (byte 0 is 0xff): encode the JSON as UTF-8."),
        (read('{"a": "b"'.encode("utf-16-le")), "The body holds NUL bytes, as UTF-16 does: encode the JSON as UTF-8."),
        (read("[" * 100_000), "The body is JSON that is nested too deep: no field needs more than ten levels."),
        (read('{"s\\u0065ed": 1, "seed": 2}'), 'The key "seed" stands twice in one JSON object: give it once.'),
        (read('{"fps": -Infinity}'), "-Infinity is no JSON number: give a finite one, or leave the field out."),
        (read('{"seed": ' + "9" * 5000 + "}"),
         "The body holds a whole number of thousands of digits: no field takes one."),
        (read('{"question": "a\\ud800b"}'),
         'The body holds "\\ud800", half of a surrogate pair: send the whole character, or none.'),
        (read("{" + ",".join(f'"k{i}":0' for i in range(1001)) + "}"),
         "A JSON object has 1001 keys: none of a request has more than 1000."),
        (read("[" + "0," * 2_000_001 + "0]"),
         "The body holds 2000001 times the sign , and no request needs more than 2000000."),
        (read("[" + "{}," * 100_000 + "{}]"),
         "The body holds 100001 times the sign { and no request needs more than 100000."),
    ],
    "not-found": [
        (called("GET", "/nothing"), "Nothing is served at /nothing. GET /openapi.json lists the endpoints."),
        (called("GET", "/" + "a" * 50_000),
         "Nothing is served at "
         "/aaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaa... (50001 "
         "characters). GET /openapi.json lists the endpoints."),
    ],
    "method-not-allowed": [(called("PATCH", "/jobs"), "/jobs does not support PATCH.")],
    "unauthorized": [
        (in_app("GET", "/models", api_keys=KEYS),
         "The request has no key. Send the header `Authorization: Bearer <key>` with a key that the server's "
         "operator gave you."),
        (in_app("GET", "/models", {"Authorization": "Bearer cow_eve"}, api_keys=KEYS),
         "The request has a key that this server does not know. Send the header `Authorization: Bearer <key>` "
         "with a key that the server's operator gave you."),
    ],
    "origin-not-allowed": [
        (called("GET", "/livez", headers={"Origin": "https://evil.example"}),
         "Pages from 'https://evil.example' may not use this server. Its operator can add that origin to "
         "COW_CORS_ORIGINS."),
        (called("GET", "/livez", headers={"Host": "evil.example"}),
         "The server listens only on this machine, without keys, and not under the name 'evil.example'. Use "
         "localhost or 127.0.0.1; its operator can list https://<name> in COW_CORS_ORIGINS, or set COW_API_KEYS."),
    ],
    "rate-limited": [(in_app("GET", "/models", rate_limit=2),
         "The server allows 2 requests per minute with your address. Try again in 30 s.")],
    "artifact-not-found": [
        (called("GET", f"/artifacts/{SHA}"),
         "No artifact has the SHA-256 0000000000000000000000000000000000000000000000000000000000000000: send the "
         "image again, or run the simulation that made it."),
        (called("GET", "/artifacts/x"), "No artifact is named 'x': give its SHA-256, 64 lower-case hex digits."),
    ],
    "range-not-satisfiable": [(out_of_range, f"The file has {len(IMAGE)} bytes; 'bytes=999999-' lies outside.")],
    "body-too-large": [(called("POST", "/simulate", content=b" " * 3_000_001),
         "The body is larger than 3 MB. Send a smaller image, or raise COW_MAX_BODY_MB on the server.")],
    "body-too-slow": [(body_that_does_not_come,
         "Of the body 1 bytes came in 0.1 s, and not its end. Send it at once, or raise COW_BODY_TIMEOUT on the "
         "server.")],
    "body-type-unsupported": [(called("POST", "/simulate", content=b"{}"),
         "The body has the media type 'none'. Send application/json or multipart/form-data.")],
    "image-too-large": [(sent(bad_images.bomb(9000, 9000)),
         "The image is 9000 x 9000 px, 81.00 megapixels, over the limit of 25: scale it down and send it again.")],
    "image-unreadable": [
        (sent(b""), "The image is empty (0 bytes): send the bytes of a PNG, JPEG or WebP file."),
        (sent(picture()[:500]),
         "The PNG file of 500 bytes could not be decoded: it is damaged or incomplete. Send it whole."),
        (sent(bad_images.bomb(1, 65535)),
         "The image is 1 x 65535 px, too small to hold an object: send one with both sides at least 8 px."),
    ],
    "image-type-unsupported": [(sent(b"GIF89a......."), "The image is a GIF file: send it as PNG, JPEG or WebP.")],
    "image-url-not-allowed": [(simulated(image={"url": "http://example.org/a.png"}),
         "This server fetches nothing by URL: no host is in COW_ALLOW_IMAGE_URLS. Or send the data itself, as a data "
         "URL or as a file part.")],
    "image-url-unreachable": [(unreachable,
         "The host name 'nosuch.invalid' is unknown. Check its spelling. Or send the data itself, as a data URL "
         "or as a file part.")],
    "cannot-ground": [(simulated(grounding=None, question="If the pink car moves to the left?"),
         "What moves is not clear: 'pink car' was not found, or not for certain. Seen: blue at (188, 79), red at "
         "(60, 80). Say where it is with `grounding.point` [x, y] or `grounding.bbox` [x0, y0, x1, y1] in the "
         "request. Or click it on the page, or have a multimodal LLM read the image (COW_MLLM).")],
    "object-not-found": [(read_by_the_mllm(saying('{"reasoning": "", "object": null}'), "Describe the image."),
         "The multimodal LLM 'Qwen/Qwen3-VL-8B-Instruct' sees nothing in the image that the question could move. "
         "Say where it is with `grounding.point` [x, y] or `grounding.bbox` [x0, y0, x1, y1] in the request.")],
    "cannot-read-direction": [(simulated(motion=None, question="If the red ball moves forward?"),
         "The object is to move forward. Which way a thing faces is seen only of vehicles with wheels. Say it with "
         "`motion.direction` [dx, dy] in the request, in pixels, x right and y down.")],
    "reader-unavailable": [(without_its_package(errors.ReaderUnavailable),
         "'far' needs the Python package that provides 'no_such_package', which is not installed here. `cow "
         "doctor` shows the line that installs it.")],
    "perception-unavailable": [(without_its_package(errors.PerceptionUnavailable),
         "'far' needs the Python package that provides 'no_such_package', which is not installed here. `cow "
         "doctor` shows the line that installs it.")],
    "perception-missing": [(called("POST", "/look", json={"image": BODY["image"], "question": QUESTION}),
         "This server has no segmenter and no detector: give the things' boxes instead, or start it with "
         f"COW_PERCEPTION=cpu, gpu, or names of models, which need {errors.install_line('perception')}.")],
    "mllm-bad-reply": [(chatted(failing(200, b"<html>")),
         "The server of the multimodal LLM replied with something other than a JSON object.")],
    "mllm-refused": [(read_by_the_mllm(failing(400, {}), QUESTION),
         "The multimodal LLM 'Qwen/Qwen3-VL-8B-Instruct' rejected the call (locate): it answered with status "
         "400 (COW_LOG_LEVEL=debug logs its own words).")],
    "mllm-unavailable": [(chatted(failing(401, {})),
         "The server of the multimodal LLM answered with status 401: its address or this server's own key for it "
         "is wrong (COW_MLLM_BASE_URL, COW_MLLM_API_KEY).")],
    "generator-unavailable": [(without_its_package(errors.GeneratorUnavailable),
         "'far' needs the Python package that provides 'no_such_package', which is not installed here. `cow "
         "doctor` shows the line that installs it.")],
    "weights-unavailable": [(damaged_record,
         "The record of the weights of 'owner/weights', owner--weights/cow.lock.json, is damaged: delete it and "
         "pull them again.")],
    "model-not-found": [(called("GET", "/v1/models/nobody"),
         "There is no model 'nobody'. There are: cow/embedded, cow/embedded:no-imagination.", "/model")],
    "job-not-found": [(called("GET", f"/jobs/{ID}"), "There is no job 'ID': it was deleted, or is not one of yours.")],
    "download-unavailable": [(film_of_a_still,
         "The job ID has no video. Take GET /jobs/ID/request and send it again, with `video: true`.")],
    "idempotency-key-reused": [(reused_key,
         "This Idempotency-Key was used for another request before. Give every request its own key.")],
    "webhook-not-allowed": [(simulated(webhook="https://example.org/"),
         "This server calls no webhooks: COW_WEBHOOK_SECRET is not set. Poll the job instead.")],
    "queue-full": [(full_queue, "1000 jobs wait or run, and COW_QUEUE_LIMIT is 1000. Send the request again later.")],
    "not-ready": [(not_started, "The server is starting. Ask again later.")],
    "shutting-down": [(stopping, "The server is stopping and takes no more jobs. Send the request again later.")],
    "canceled": [(canceled, "The job was canceled before it was finished.")],
    "storage-unavailable": [(no_folder,
         "The data folder cannot be used (File exists): give a folder that the server can read and write.")],
    "internal-error": [(broken, "An unexpected error happened in the server. Its log has the trace.")],
}  # fmt: skip

# Codes that nothing provokes here, and which folder of tests does.
ELSEWHERE = {
    "checkpoint-invalid": "generators: reading a checkpoint needs PyTorch",
    "generator-out-of-memory": "generators: a model is to run out of memory",
    "device-failed": "generators: a device is to fail while a model runs on it",
    "worker-ended": "workers: a process that computes is to be killed",
    "job-timeout": "workers: a process computes for too long",
}
HINT = " /openapi.json describes the request."  # of what pydantic finds
LEAKS = ("Traceback", 'File "', ".py", "/work", "/tmp", "/home", "site-packages", "0x7f", "secret")


@pytest.mark.parametrize(
    ("code", "provoke", "says", "pointers"),
    [pytest.param(code, provoke, says, tuple(pointers), id=f"{code} {number}")
     for code, found in TABLE.items() for number, (provoke, says, *pointers) in enumerate(found)],
)  # fmt: skip
def test_an_error_says_what_was_wrong_and_what_to_do(
    request: pytest.FixtureRequest, code: str, provoke: Provoke, says: str, pointers: tuple[str, ...]
) -> None:
    kind = errors.kinds()[code]
    try:
        response = provoke(request.getfixturevalue)
        assert response is not None, "nothing was refused"
        assert response.headers["content-type"] == "application/problem+json", response.text
        told, status = response.json(), response.status_code
    except CowError as error:
        told, status = error.as_problem(), error.status
    assert (told["type"], told["title"]) == (f"urn:cow:problem:{code}", kind.__doc__)
    assert status == told["status"] == kind.status
    assert tuple(field["pointer"] for field in told["errors"]) == pointers
    whole = f"{told['detail']} {told.get('remedy', '')}".rstrip()
    same = re.sub(r"[0-9a-f]{8}-[0-9a-f-]{27}", "ID", re.sub(r"in \d+ s\.", "in 30 s.", whole))
    hint = HINT if code == "invalid-request" and says.startswith("/") else ""
    assert same == says + hint
    assert whole.endswith(".")
    assert not any(leak in json.dumps(told) for leak in LEAKS)


def test_every_code_has_a_row_or_a_reason() -> None:
    codes = set(errors.kinds())
    assert TABLE.keys() | ELSEWHERE.keys() == codes
    assert not TABLE.keys() & ELSEWHERE.keys()
    listed = re.findall(r"── (\w+) +([a-z-]+) +(\d{3})", errors.__doc__ or "")
    assert {(kind.__name__, kind.code, str(kind.status)) for kind in errors.kinds().values()} == set(listed)
