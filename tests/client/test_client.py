"""The SDK and a real server: every kind of image and option, results and their pictures, handles, notebooks, types."""

from __future__ import annotations

import asyncio
import base64
import doctest
import hashlib
import html
import importlib
import io
import json
import os
import pickle
import pkgutil
import re
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from copy import deepcopy
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, get_type_hints

import httpx
import numpy as np
import pytest
from conftest import EXAMPLES, ROOT
from drawn import ball, block, floor
from floors import TrueCamera
from PIL import Image
from refusals import refused
from sdk import DIGEST, JOB, SIMULATION, address, client, connect, served
from servers import BODY, IMAGE, QUESTION, Served, data_url, slow
from tables import rows
from waiting import TIME_LIMIT, eventually

import cow_service.client
from cow_service import records
from cow_service.client import Client, Event, Simulation
from cow_service.client.display import simulation_html
from cow_service.client.options import AnswerOptions, SimulateOptions
from cow_service.client.request import image_input, job_request, request_fields
from cow_service.records import Job
from cow_service.requests import (
    AnswerRequest,
    FramesRequest,
    GroundingRequest,
    ImageArtifact,
    ImageUrl,
    ObjectRequest,
    SimulateRequest,
)

__all__ = ["address", "client", "connect", "served"]  # fixtures
pytestmark = pytest.mark.slow

PHOTO = EXAMPLES / "ball-and-mug" / "image.jpg"
ASKED = "If the yellow ball moves to the left, will it hit the blue mug? (A) Yes (B) No"
GIVEN: dict[str, Any] = {"grounding": {"point": [60, 80]}, "motion": {"direction": [1, 0]}}
SMALL: dict[str, Any] = {**GIVEN, "num_frames": 5, "video": False, "frames": {"count": 1}}
PIXELS = block(ball(floor(240, 160), (60, 80), 18, (210, 20, 20)), (170, 60, 205, 98), (50, 80, 200))


def slowly(seconds: float, seed: int = 0) -> dict[str, Any]:
    """Options of a request that takes so long."""
    return {name: value for name, value in slow(seconds, seed).items() if name not in ("image", "question")}


# --- images ---


def test_images_in_every_form(tmp_path: Path) -> None:
    path = tmp_path / "a photo.png"
    path.write_bytes(IMAGE)
    for image in (str(path), path, IMAGE, bytearray(IMAGE), memoryview(IMAGE)):
        assert image_input(image) == IMAGE
    named = {"artifact": DIGEST}
    simulation = records.Simulation.model_validate(SIMULATION)
    for image in (named, ImageArtifact(**named), simulation.image, simulation.overlay, simulation.frames[0]):
        assert image_input(image) == named
    assert image_input(data_url(IMAGE)) == data_url(IMAGE)
    address = "HTTP://example.org/a.png"
    assert image_input(address) == image_input(ImageUrl(url=address)) == {"url": address}
    alpha = np.dstack([PIXELS, np.full(PIXELS.shape[:2], 255, np.uint8)])
    for array in (PIXELS, PIXELS[..., 0], alpha, np.ascontiguousarray(PIXELS[..., ::-1])[..., ::-1]):
        sent = image_input(array)
        assert isinstance(sent, bytes)
        assert np.array_equal(np.asarray(Image.open(io.BytesIO(sent))), array)


@pytest.mark.parametrize(
    ("mode", "made_as", "sent_as"),
    rows(
        {
            "as it is, with a palette": ("P", "P", "P"),
            "as it is, with alpha": ("RGBA", "RGBA", "RGBA"),
            "16 bits, the other bytes first": ("I;16B", "I", "I;16"),
            "alpha beside a palette": ("PA", "P", "RGBA"),
            "grey that alpha has been applied to": ("La", "LA", "LA"),
            "of printers": ("CMYK", "CMYK", "RGB"),
        },
        [("1", "1", "1"), ("I;16L", "I", "I;16"), ("RGBa", "RGBA", "RGBA"), ("HSV", "HSV", "RGB")],
    ),
)
def test_pixels_of_pil_images_are_kept(mode: str, made_as: str, sent_as: str) -> None:
    deep = Image.fromarray(PIXELS[..., 0].astype(np.uint16) * 257)
    given = (deep if mode.startswith("I;16") else Image.fromarray(PIXELS)).convert(made_as).convert(mode)
    with Image.open(io.BytesIO(bytes(image_input(given)))) as came:
        assert (came.format, came.size, came.mode) == ("PNG", given.size, sent_as)
        kept, pixels = ("I", given) if sent_as == "I;16" else ("RGBA", given.convert(sent_as))
        assert np.array_equal(np.asarray(came.convert(kept)), np.asarray(pixels.convert(kept)))


def test_pil_images_stand_upright_and_hold_nothing_else() -> None:
    exif = Image.Exif()
    exif[0x0112] = 6  # turned by a quarter
    exif[0x010F] = "a secret"
    buffer = io.BytesIO()
    Image.fromarray(PIXELS).rotate(90, expand=True).save(buffer, "JPEG", exif=exif, icc_profile=b"profile" * 30)
    opened = Image.open(buffer)
    sent = image_input(opened)
    assert isinstance(sent, bytes)
    assert Image.open(io.BytesIO(sent)).size == (240, 160)
    assert not [part for part in (b"secret", b"eXIf", b"iCCP", b"profile") if part in sent]
    assert opened.size == (160, 240)  # the caller's own stays as it was


WRONG: list[Any] = [
    *(PIXELS.astype(np.float32), np.zeros((4, 4, 2), np.uint8), np.zeros((1, 4, 4, 3), np.uint8)),
    *(np.zeros((0, 4, 3), np.uint8), Image.new("RGB", (0, 4)), Image.new("I", (4, 4)), Image.new("F", (4, 4))),
    *(io.BytesIO(IMAGE), None, records.Video(url="/x", sha256=DIGEST, fps=1, num_frames=1, width=1, height=1)),
]


def test_what_is_no_image_is_refused_by_its_name(client: Client, tmp_path: Path) -> None:
    for image in WRONG:
        with refused("invalid-request", "/image"):
            image_input(image)
    with pytest.raises(FileNotFoundError, match=r"missing\.png"):
        client.simulate(str(tmp_path / "missing.png"), QUESTION)
    with pytest.raises(IsADirectoryError):
        client.answer(tmp_path, QUESTION)
    for data, code in (
        (IMAGE[:500], "image-unreadable"),
        (os.urandom(3_100_000), "body-too-large"),
        ("https://example.org/a.png", "image-url-not-allowed"),
    ):
        with refused(code):
            client.simulate(data, QUESTION)


# --- options ---


def test_options_are_the_fields_of_the_requests() -> None:
    for options, request in ((SimulateOptions, SimulateRequest), (AnswerOptions, AnswerRequest)):
        assert set(options.__annotations__) | set(SimulateOptions.__annotations__) == {"law"} | set(
            request.model_fields
        ) - {"image", "question"}
        assert not options.__required_keys__
        assert get_type_hints(Event)


def decoded(url: str) -> np.ndarray[Any, Any]:
    kind, _, data = url.partition(",")
    assert kind == "data:image/png;base64"
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(data))))


def test_fields_with_pictures_and_the_law_become_json() -> None:
    mask = np.zeros((6, 8), bool)
    mask[2:4, 3:5] = True
    named = ObjectRequest(object="cube", bbox=(1, 2, 5, 6))
    fields = request_fields(
        {"law": "contact", "grounding": {"mask": mask}, "objects": [{"object": "a", "mask": mask}, named], "seed": None}
    )
    assert fields.keys() == {"motion", "grounding", "objects"}
    assert fields["motion"] == {"law": "contact"}
    assert np.array_equal(decoded(fields["grounding"]["mask"]), mask * np.uint8(255))
    assert fields["objects"][0]["object"] == "a"
    assert np.array_equal(decoded(fields["objects"][0]["mask"]), mask * np.uint8(255))
    assert fields["objects"][1] is named
    assert request_fields({"law": "contact", "motion": {"law": "contact", "kind": "fall"}}) == {
        "motion": {"law": "contact", "kind": "fall"}
    }
    with refused("invalid-request", "/motion/law"):
        request_fields({"law": "contact", "motion": {"law": "ballistic"}})


def test_depth_maps_are_arrays() -> None:
    metres = np.array([[1.5, 2.0, -1.0], [np.nan, np.inf, 1000.0]])
    depth = request_fields({"depth": {"map": metres, "focal": 240}})["depth"]
    assert (depth["focal"], depth["scale"]) == (240, 2 / 65535)
    assert np.array_equal(decoded(depth["map"]), np.array([[49151, 65535, 0], [0, 0, 0]]))
    units = np.array([[1, 2], [3, 65535]], np.uint16)
    depth = request_fields({"depth": {"map": units, "scale": 1e-3}})["depth"]
    assert depth["scale"] == 1e-3
    assert np.array_equal(decoded(depth["map"]), units)
    assert request_fields({"depth": {"map": np.zeros((2, 2))}})["depth"]["scale"] == 1e-3 / 65535
    for wrong, pointer in (
        ({"map": metres, "scale": 1.0}, "/depth/scale"),
        ({"map": units.astype(np.int16)}, "/depth/map"),
        ({"map": units[..., None]}, "/depth/map"),
    ):
        with refused("invalid-request", pointer):
            request_fields({"depth": wrong})


def test_options_of_every_kind_and_questions_arrive_as_they_are(client: Client, tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    path.write_bytes(IMAGE)
    question = 'If the "red" bäll\r\nmoves → 🎱; name="x"\n--boundary--\n what\'s hit?\t'
    given = {
        "grounding": {"bbox": np.array([42, 62, 78.5, 98]), "object": "red ball"},
        "motion": {"direction": (np.float32(1), np.float64(0.5)), "speed": np.float32(40)},
        **{"num_frames": np.int64(5), "fps": np.float32(8), "video": False, "options": None},
        "frames": FramesRequest(count=2),
    }
    for image in (path, data_url(IMAGE)):  # a form, and JSON
        simulation = client.simulate(image, question, **given)
        assert simulation.question == question
        assert simulation.image.sha256 == hashlib.sha256(IMAGE).hexdigest()
        assert simulation.grounding.bbox == (42, 62, 78.5, 98)
        assert simulation.motion.direction == pytest.approx((0.894, 0.447), abs=1e-3)
        assert (simulation.motion.speed, simulation.trajectory.fps) == (40, 8)
        assert (len(simulation.trajectory.path.points), len(simulation.frames)) == (5, 2)
        with refused("invalid-request", "/motion/direction", "/num_frames", "/frame", "/votes"):
            client.simulate(image, question, num_frames=1, frame={}, motion={"direction": [0, 0]}, votes=2)
    points = np.stack([np.linspace(60, 90, 4), np.full(4, 80.0)], axis=1)
    own = SMALL | {"grounding": GroundingRequest(point=(60, 80)), "trajectory": {"points": points}}
    assert client.simulate(path, question, **own).trajectory.path.points[0] == (60, 80)


def test_what_no_request_can_hold_is_refused() -> None:
    for key in ("", "two words", "ä", "line\n", "x" * 256):  # no header holds it
        with refused("invalid-request", ""):
            job_request("simulate", IMAGE, QUESTION, {}, key, False)
    for image in (IMAGE, data_url(IMAGE)):
        with pytest.raises(TypeError, match="object"):
            job_request("simulate", image, QUESTION, {"generator_options": {"x": object()}}, None, False)
        for question, options in (("half \ud83c", {}), (QUESTION, {"options": ["Yes", "\udf00"]})):
            with refused("invalid-request", ""):
                job_request("simulate", image, question, options, None, False)


def test_objects_law_and_depth_are_understood_by_the_server(client: Client) -> None:
    mask = np.zeros((160, 240), bool)
    mask[60:98, 170:205] = True
    cube = {"object": "blue cube", "mask": mask}
    metres = TrueCamera(focal=240, size=(240, 160)).depth([(42, 62, 78, 98), (170, 60, 205, 98)])
    given = SMALL | {"objects": [cube], "law": "ballistic", "ensemble": 0}
    simulation = client.submit(PIXELS, QUESTION, **given).wait()
    assert simulation.motion.law == "ballistic"
    (other,) = simulation.grounding.others
    assert (other.object, other.bbox, other.source) == ("blue cube", (170, 60, 205, 98), "request")
    (frame,) = simulation.frames
    again = client.simulate(frame, QUESTION, depth={"map": metres, "focal": 240}, **SMALL)
    assert again.image.sha256 == frame.sha256
    assert again.trajectory.depth.valid == pytest.approx(np.isfinite(metres).mean(), abs=0.01)


# --- results ---


def test_pictures_are_downloaded_once_and_when_asked_for(address: str) -> None:
    seen: list[str] = []
    hooks = {"request": [lambda request: seen.append(f"{request.method} {request.url.path}")]}
    with httpx.Client(event_hooks=hooks, timeout=TIME_LIMIT) as http:
        client = Client(address, http_client=http)
        simulation = client.simulate(PHOTO, ASKED, num_frames=9)
        assert seen == ["POST /simulate"]
        frames = simulation.pil_frames()
        assert [(frame.mode, frame.size) for frame in frames] == [("RGB", (512, 295))] * 4
        assert seen[1:] == [f"GET /artifacts/{frame.sha256}" for frame in simulation.frames]
        array = simulation.numpy_frames()
        assert (array.shape, str(array.dtype)) == ((4, 295, 512, 3), "uint8")
        assert np.array_equal(array[1], np.asarray(frames[1]))
        assert simulation.pil_overlay().size == (simulation.image.width, simulation.image.height)
        assert simulation.video_bytes()[4:8] == b"ftyp"
        before = len(seen)
        simulation.load()
        simulation.pil_frames()
        assert len(seen) == before == 1 + 4 + 1 + 1
        client.simulate(simulation.image, ASKED, num_frames=9).load()
        assert len(seen) == before + 1 + 4 + 1 + 1


def test_results_can_be_copied_compared_and_sent_to_other_processes(client: Client, tmp_path: Path) -> None:
    box = {"object": "thing", "bbox": (20, 20, 60, 60)}
    removed = {"objects": [box], "interventions": [{"kind": "remove", "object": "thing"}]}
    simulation = client.simulate(IMAGE, QUESTION, **removed, **SMALL).load()
    assert client.job(simulation.id).wait() == simulation
    for copy in (deepcopy(simulation), simulation.model_copy(deep=True), pickle.loads(pickle.dumps(simulation))):
        assert copy == simulation
        assert copy.pil_frames()[0].size == simulation.pil_frames()[0].size
        assert copy._repr_html_() == simulation._repr_html_()
    simulation.save(tmp_path)  # with the scene as it is beside what becomes of it
    kept = {path.name for path in tmp_path.glob("factual_*.png")}
    assert kept == {f"factual_{frame.index:03d}.png" for frame in simulation.factual_frames} != set()
    with pytest.raises(ValueError, match="video=True"):
        simulation.video_bytes()
    again = Simulation.model_validate_json((tmp_path / "simulation.json").read_text())
    assert again.model_dump() == simulation.model_dump()
    with pytest.raises(ValueError, match="artifact"):
        again.pil_frames()


def test_reprs_are_short(client: Client) -> None:
    handle = client.submit(IMAGE, QUESTION, **SMALL)
    simulation = handle.wait()
    assert repr(handle) == f"<JobHandle {handle.id}: simulate, succeeded>"
    assert re.fullmatch(rf"<Simulation {handle.id}: object hits blue object after [^;]+; 1 frames>", repr(simulation))
    answer = records.Answer.model_construct(**{**JOB, "answer": "word\n" * 999, "option": None})
    shown = repr(cow_service.client.Answer.model_construct(**dict(answer)))
    assert len(shown) == len("<Answer j-1: >") + 120
    assert "\n" not in shown


def test_notebooks_show_pictures_and_need_no_network(client: Client, monkeypatch: pytest.MonkeyPatch) -> None:
    answer = client.answer(PHOTO, ASKED, baseline=True, votes=3, video=True).load()
    page = answer._repr_html_()
    assert "B (No)" in page
    assert (page.count("data:image/png;base64,"), page.count("data:image/jpeg;base64,")) == (4, 1)
    coded = re.findall(r'<video controls loop muted playsinline [^>]*src="data:video/mp4;base64,([^"]+)"', page)
    assert [base64.b64decode(one) for one in coded] == [answer.simulation.video_bytes()]
    versions = answer.simulation.trajectory.ensemble
    assert f"band: where 80% of {versions} simulated versions have it" in page
    assert not re.search(
        r'(?:src|href)="(?!data:(?:image/png|image/jpeg|video/mp4);base64)|url\(|<script|@import|/artifacts/', page
    )
    video = len(answer.simulation.video_bytes())
    for most, shown in ((video, True), (video - 1, False)):
        monkeypatch.setattr("cow_service.client.display.MAX_VIDEO_BYTES", most)
        assert ("<video" in answer._repr_html_()) == shown
    assert "band" not in client.simulate(IMAGE, QUESTION, ensemble=0, **SMALL)._repr_html_()


def test_models_are_a_table(client: Client) -> None:
    models = client.models()
    lines = str(models).splitlines()
    assert lines == repr(models).splitlines()
    assert len(lines) == len(models.readers) + len(models.generators)
    assert "generator  cutout (default)    yes" in lines
    assert "generator  ati                 needs its weights; cow models pull ati" in lines


def test_what_callers_and_models_write_is_no_markup() -> None:
    evil = "<script>alert(1)</script><img src=x onerror=\"alert('&')\">"
    met = {**SIMULATION["trajectory"]["encounters"][0], "object": evil}
    simulation = Simulation.model_validate(
        {
            **SIMULATION,
            **{"question": evil, "warnings": [evil]},
            "motion": {**SIMULATION["motion"], "sentence": evil},
            "grounding": {**SIMULATION["grounding"], "object": evil},
            "trajectory": {**SIMULATION["trajectory"], "encounters": [met]},
            "overlay": {**SIMULATION["overlay"], "url": evil, "media_type": evil},
            "frames": [{**SIMULATION["frames"][0], "url": evil}],
        }
    )
    verdict = {"answer": evil, "option": evil, "not_sure": False, "reasoning": evil, "votes": {evil: 2}}
    told = {"id": "a", "created_at": "now", "question": evil, "options": [], "warnings": [evil, "own"]}
    empty = {"image": SIMULATION["image"], "reader": SIMULATION["reader"], "usage": {}, "timings": {}}
    made = {**verdict, **told, **empty, "simulation": simulation.model_dump(), "baseline": verdict}
    answer = cow_service.client.Answer.model_validate(made)
    for page in (simulation_html(simulation, lambda _: None), simulation._repr_html_(), answer._repr_html_()):
        assert "<script" not in page
        assert "<img" not in page
        assert html.escape(evil) in page
    assert answer._repr_html_().count("Note: ") == 2, "a warning of the simulation is told once"
    assert "votes: " in answer._repr_html_()


def test_a_server_that_has_gone_is_not_asked_for_every_picture() -> None:
    seen: list[str] = []

    def answer(request: httpx.Request) -> httpx.Response:
        seen.append(request.url.path)
        if request.url.path == "/simulate":
            return httpx.Response(200, json=SIMULATION)
        raise httpx.ConnectError("gone")

    with httpx.Client(transport=httpx.MockTransport(answer)) as http:
        simulation = Client("http://cow", http_client=http, retries=0).simulate(IMAGE, QUESTION)
        assert simulation._repr_html_().count("not downloaded") == 2
    assert len(seen) == 2


def test_the_blocking_client_works_where_an_event_loop_runs(client: Client) -> None:
    """As in a notebook: its coroutines never wait for that loop."""

    async def cell() -> None:
        (result,) = client.map([(IMAGE, QUESTION)], kind="simulate", **SMALL)
        assert [event.name for event in client.job(result.result.id).events()][-1] == "succeeded"

    asyncio.run(cell())


# --- jobs ---


def test_a_handle_is_waited_for_and_found_again(client: Client) -> None:
    handle = client.submit(IMAGE, QUESTION, fresh=True, **SMALL)
    assert handle.request().request["question"] == QUESTION
    assert handle.wait(timeout=TIME_LIMIT).id == handle.id
    again = client.job(handle.id)
    assert again.job.status == "succeeded"
    assert len(again.wait(timeout=0).pil_frames()) == 1


def test_a_job_that_is_canceled_and_deleted(client: Client) -> None:
    handle = client.submit(IMAGE, QUESTION, **slowly(60, seed=77))
    eventually(lambda: handle.refresh().status == "running")
    with refused("wait-timeout"):
        handle.wait(timeout=0.2)
    assert handle.cancel().status == "canceled"
    assert handle.cancel().status == handle.job.status == "canceled"
    with refused("canceled") as caught:
        handle.wait()
    assert handle.id in caught.value.detail
    handle.delete()
    with refused("job-not-found"):
        handle.refresh()


def test_events_are_told_to_the_end(client: Client) -> None:
    handle = client.submit(IMAGE, QUESTION, **slowly(0.8, seed=3), fresh=True)
    events = list(handle.events())
    assert [one.number for one in events if one.name != "progress"] == [1, 2, 3, 4, 100]
    assert {one.number for one in events if one.name == "progress"} <= {None}
    assert events[-1].name == "succeeded" == handle.job.status
    assert all(one.job.id == handle.id and one.job.result is None for one in events)


def test_jobs_are_found_by_what_they_are_and_come_page_by_page(client: Client, monkeypatch: pytest.MonkeyPatch) -> None:
    own = [client.submit(IMAGE, QUESTION, kind="answer", **SMALL) for _ in range(5)]
    for handle in own:
        handle.wait()
    ids = [handle.id for handle in own]
    assert set(ids) <= {handle.id for handle in client.jobs(status="succeeded")}
    assert not set(ids) & {handle.id for handle in client.jobs(status=["failed", "canceled"])}
    assert not list(client.jobs(created_after=datetime.now(UTC) + timedelta(minutes=5)))
    assert not list(client.jobs(created_before=datetime(2020, 1, 1)))
    since = datetime.fromisoformat(own[1].job.created_at)
    assert [handle.id for handle in client.jobs(kind="answer", created_after=since)] == ids[:0:-1]
    with refused("invalid-request"):
        list(client.jobs(status="runing"))
    monkeypatch.setattr("cow_service.client.protocol.JOBS_PER_PAGE", 2)
    assert [handle.id for handle in client.jobs(kind="answer")][:5] == ids[::-1]


LISTS = ("states", "scale", "rotation", "turns", "band", "futures", "tracks", "tracks_visible")


def test_minimal_results_lack_the_long_lists_alone_and_the_job_keeps_them(
    served: Served, client: Client, tmp_path: Path
) -> None:
    cube = {"object": "blue cube", "bbox": [170, 60, 205, 98]}
    body = {**BODY, "objects": [cube], "interventions": [{"kind": "remove", "object": "blue cube"}]}
    sent = served.http.post("/answer", json=body, headers={"Prefer": "return=minimal"})
    assert sent.headers["preference-applied"] == "return=minimal"
    told, asked = sent.json(), {"Prefer": "return=minimal, wait=1"}
    kept, lean = (served.http.get(f"/jobs/{told['id']}", headers=headers).json() for headers in ({}, asked))
    assert lean == kept | {"result": told}
    trajectory = kept["result"]["simulation"]["trajectory"]
    assert trajectory["paths"][0]["states"]
    for one in (trajectory, trajectory["factual"]):
        one.pop("still_tracks", None)
        for path in one["paths"]:
            for name in LISTS:
                path.pop(name, None)
    assert told == kept["result"]
    records.Answer.model_validate(told)
    (outcome,) = client.map([(IMAGE, QUESTION)], kind="simulate", out=tmp_path, minimal=True, **SMALL)
    for result in (
        outcome.result,
        client.simulate(IMAGE, QUESTION, minimal=True, **SMALL),
        client.simulate(IMAGE, QUESTION, minimal=True, progress=lambda job: None, **SMALL),
        client.submit(IMAGE, QUESTION, **SMALL).wait(minimal=True),
    ):
        assert (result.trajectory.path.states, result.trajectory.path.tracks) == ((), ())
        assert result.trajectory.path.points


# --- progress ---


def test_progress_is_told_to_a_function_and_shown_also_in_many_threads(
    client: Client, capsys: pytest.CaptureFixture[str]
) -> None:
    heard: list[Job] = []
    client.simulate(IMAGE, QUESTION, progress=heard.append, fresh=True, **slowly(0.6, seed=11))
    assert heard[-1].status == "succeeded"
    assert [job.progress for job in heard] == sorted(job.progress for job in heard)
    assert len({job.progress for job in heard}) > 2
    with ThreadPoolExecutor(3) as pool:
        done = [pool.submit(client.simulate, IMAGE, QUESTION, progress=True, **SMALL, seed=n) for n in range(3)]
        assert len({one.result().id for one in done}) == 3
    shown = capsys.readouterr()
    assert "100%" in shown.out + shown.err
    assert "succeeded" in shown.out + shown.err


# --- environments, types ---


def test_examples_in_the_docs_are_true(client: Client, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.copy(PHOTO, tmp_path / "image.jpg")
    monkeypatch.chdir(tmp_path)
    names = [f"cow_service.client.{found.name}" for found in pkgutil.iter_modules(cow_service.client.__path__)]
    names = [name for name in names if ".async_" not in name]  # what is awaited there is called here
    own = {"client": client, "base_url": client.base_url, "asyncio": asyncio}
    found = {name: doctest.testmod(importlib.import_module(name), extraglobs=own) for name in names}
    assert not {name: each for name, each in found.items() if each.failed}
    modules = {"sync_client", "sync_results", "display"}
    assert {name.rpartition(".")[2] for name, each in found.items() if each.attempted} >= modules


USE = """
from typing import assert_type

from cow_service.client import Answer, AsyncClient, AsyncSimulation, Client, JobHandle, Simulation

client = Client(timeout=5, retries=2)
assert_type(client.simulate("a.png", "What?", frames={"count": 5}, motion={"direction": [1, 0]}), Simulation)
assert_type(client.answer(b"", "What?", votes=3, imagine="never").simulation, Simulation | None)
assert_type(client.submit("a.png", "What?", kind="answer", votes=3), JobHandle[Answer])
assert_type([result.result for result in client.map([], kind="simulate")], list[Simulation | None])


async def ask() -> None:
    assert_type(await AsyncClient().simulate("a.png", "What?"), AsyncSimulation)


print(ask)
client.simulate("a.png", "What?", votes=3)  # pyright: ignore[reportCallIssue]
client.answer(3, "What?", imagine="sometimes")  # pyright: ignore[reportArgumentType]
"""


@pytest.mark.soak
def test_types_are_told(tmp_path: Path) -> None:
    (tmp_path / "use.py").write_text(USE)
    settings = {"typeCheckingMode": "strict", "pythonVersion": "3.11", "extraPaths": [str(ROOT)], "include": ["use.py"]}
    (tmp_path / "pyrightconfig.json").write_text(json.dumps(settings | {"reportUnnecessaryTypeIgnoreComment": True}))
    command = [sys.executable, "-m", "pyright", "--pythonpath", sys.executable, "-p", str(tmp_path)]
    checked = subprocess.run(command, capture_output=True, text=True, check=False, cwd=tmp_path)
    assert checked.returncode == 0, checked.stdout


LIGHT = """
import os, sys

KNOWN = "httpx httpx_sse httpcore h11 anyio idna certifi sniffio cow_service pydantic pydantic_core"
KNOWN += " typing_extensions annotated_types typing_inspection"
for folder in sys.path:
    if folder.endswith("site-packages"):
        sys.modules.update(dict.fromkeys({name.partition(".")[0] for name in os.listdir(folder)} - {*KNOWN.split()}))
from cow_service.client import Client, errors

with Client(os.environ["ADDRESS"]) as client:
    answer = client.answer("image.jpg", os.environ["QUESTION"])
    print(answer.option)
    answer.save("out")
    assert "data:image/png" in answer._repr_html_()
    (outcome,) = client.map([("image.jpg", os.environ["QUESTION"])])
    assert outcome.result.option == answer.option
    try:
        answer.simulation.pil_frames()
    except ImportError as error:
        print(error)
"""


def test_the_sdk_needs_three_packages(address: str, tmp_path: Path) -> None:
    shutil.copy(PHOTO, tmp_path / "image.jpg")
    own = {"ADDRESS": address, "QUESTION": ASKED, "PATH": "/usr/bin:/bin", "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-c", LIGHT]
    ran = subprocess.run(command, capture_output=True, text=True, check=False, cwd=tmp_path, env=own)
    assert ran.returncode == 0, ran.stderr
    first, second = ran.stdout.splitlines()
    assert first == "No"
    assert "PIL" in second
    assert len([*(tmp_path / "out").glob("frame_*.png")]) == 4
