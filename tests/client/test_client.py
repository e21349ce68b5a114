"""The SDK and a real server: every kind of image and option, results and their pictures, handles, notebooks, types."""

from __future__ import annotations

import asyncio
import base64
import doctest
import html
import importlib
import io
import json
import os
import pickle
import pkgutil
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
import zipfile
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from copy import deepcopy
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, get_type_hints

import numpy as np
import pytest
from conftest import EXAMPLES, ROOT, new_environment
from drawn import ball, block, floor
from floors import TrueCamera
from PIL import Image
from sdk import DIGEST, JOB, SIMULATION, Connect, connect
from servers import IMAGE, QUESTION, Served, data_url, slow
from waiting import eventually

import cow_service.client
from cow_service import records
from cow_service.client import AsyncClient, Client, CowError, Event, Simulation, errors
from cow_service.client.display import simulation_html
from cow_service.client.options import AnswerOptions, SimulateOptions
from cow_service.client.request import image_input
from cow_service.records import Job
from cow_service.requests import AnswerRequest, ImageArtifact, ImageUrl, ObjectRequest, SimulateRequest

pytestmark = pytest.mark.slow

__all__ = ["connect"]  # a fixture

PHOTO = EXAMPLES / "ball-and-mug" / "image.jpg"
ASKED = "If the yellow ball moves to the left, will it hit the blue mug? (A) Yes (B) No"
GIVEN: dict[str, Any] = {"grounding": {"point": [60, 80]}, "motion": {"direction": [1, 0]}}
SMALL: dict[str, Any] = {**GIVEN, "num_frames": 5, "video": False, "frames": {"count": 1}}


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    with Served(tmp_path_factory.mktemp("sdk"), COW_MAX_BODY_MB="3") as one:
        yield one


@pytest.fixture
def address(served: Served) -> str:
    return str(served.http.base_url).rstrip("/")


@pytest.fixture
def client(connect: Connect, address: str) -> Any:
    return connect(address)


def slowly(seconds: float, seed: int = 0) -> dict[str, Any]:
    """Options of a request that takes so long."""
    return {name: value for name, value in slow(seconds, seed).items() if name not in ("image", "question")}


# --- images ---

PIXELS = block(ball(floor(240, 160), (60, 80), 18, (210, 20, 20)), (170, 60, 205, 98), (50, 80, 200))


def picture(mode: str) -> Image.Image:
    plain = Image.fromarray(PIXELS)
    if mode.startswith("I;16"):
        deep = Image.fromarray(np.asarray(plain.convert("L")).astype(np.uint16) * 257)
        return deep if mode == "I;16" else deep.convert("I").convert(mode)
    if mode in ("PA", "La", "RGBa"):
        return plain.convert({"PA": "P", "La": "LA", "RGBa": "RGBA"}[mode]).convert(mode)
    return plain.convert(mode)


def _kinds_of_images(folder: Path) -> dict[str, Any]:
    (folder / "a photo.png").write_bytes(IMAGE)
    kept: dict[str, Any] = {
        "a path as text": str(folder / "a photo.png"),
        "a path": folder / "a photo.png",
        "bytes": IMAGE,
        "bytes that change": bytearray(IMAGE),
        "bytes of another": memoryview(IMAGE),
        "a data URL": data_url(IMAGE),
        "as in a request": {"artifact": _digest(IMAGE)},
        "an opened file": Image.open(folder / "a photo.png"),
        "an array": PIXELS,
        "a grey array": PIXELS[..., 0],
        "an array with alpha": np.dstack([PIXELS, np.full(PIXELS.shape[:2], 255, np.uint8)]),
        "a view of an array": np.ascontiguousarray(PIXELS[..., ::-1])[..., ::-1],
    }
    modes = ["1", "L", "LA", "La", "P", "PA", "RGB", "RGBA", "RGBa", "RGBX", "CMYK", "YCbCr", "HSV", "I;16", "I;16B"]
    return kept | {f"a PIL image of mode {mode}": picture(mode) for mode in modes}


def _digest(data: bytes) -> str:
    import hashlib

    return hashlib.sha256(data).hexdigest()


def test_images_of_every_kind(address: str, tmp_path: Path) -> None:
    with Client(address) as client:
        client.simulate(IMAGE, QUESTION, **SMALL)
        boxed = SMALL | {"grounding": {"bbox": [42, 62, 78, 98]}}  # in black and white no object stands out
        for name, image in _kinds_of_images(tmp_path).items():
            simulation = client.simulate(image, QUESTION, **boxed)
            assert (simulation.image.width, simulation.image.height) == (240, 160), name
            if "file" in name or "PIL" in name or "array" in name:
                assert client.artifact(simulation.image.sha256).startswith(b"\x89PNG"), name
            else:
                assert simulation.image.sha256 == _digest(IMAGE), name


@pytest.mark.parametrize("mode", ["L", "P", "RGB", "RGBA", "PA", "RGBa", "La", "CMYK", "I;16", "I;16B", "I;16L"])
def test_pixels_of_pil_images_are_kept(mode: str) -> None:
    given = picture(mode)
    sent = image_input(given)
    assert isinstance(sent, bytes)
    with Image.open(io.BytesIO(sent)) as came:
        assert came.format == "PNG"
        assert came.size == given.size
        if mode.startswith("I;16"):
            assert came.mode == "I;16"
            assert np.array_equal(np.asarray(came), np.asarray(given.convert("I")))
        else:
            wanted = {"PA": "RGBA", "RGBa": "RGBA", "La": "LA", "CMYK": "RGB"}.get(mode, mode)
            assert came.mode == wanted
            assert np.array_equal(np.asarray(came.convert("RGBA")), np.asarray(given.convert(wanted).convert("RGBA")))


def test_pil_images_stand_upright_and_hold_nothing_else(client: Any) -> None:
    exif = Image.Exif()
    exif[0x0112] = 6  # turned by a quarter
    exif[0x010F] = "a secret"
    buffer = io.BytesIO()
    Image.fromarray(PIXELS).rotate(90, expand=True).save(buffer, "JPEG", exif=exif, icc_profile=b"profile" * 30)
    opened = Image.open(buffer)
    simulation = client.simulate(opened, QUESTION, **SMALL)
    assert (simulation.image.width, simulation.image.height) == (240, 160)
    sent = client.artifact(simulation.image.sha256)
    assert not [part for part in (b"secret", b"eXIf", b"iCCP", b"profile") if part in sent]
    assert opened.size == (160, 240)  # the caller's own stays as it was


def test_images_that_the_server_has_already(client: Any) -> None:
    first = client.simulate(IMAGE, QUESTION, **SMALL)
    (frame,) = first.frames
    for image in (first.image, frame, first.overlay, ImageArtifact(artifact=frame.sha256)):
        again = client.simulate(image, QUESTION, **SMALL)
        assert again.image.sha256 == (image.artifact if isinstance(image, ImageArtifact) else image.sha256)


def test_urls_are_refused_unless_the_server_takes_them(client: Any) -> None:
    for image in ("https://example.org/a.png", "HTTP://example.org/a.png", ImageUrl(url="http://example.org/a.png")):
        with pytest.raises(errors.ImageUrlNotAllowed):
            client.simulate(image, QUESTION)


WRONG: list[tuple[Any, list[str]]] = [
    (PIXELS.astype(np.float32), ["(160, 240, 3)", "float32"]),
    (PIXELS.astype(bool), ["bool"]),
    (np.zeros((4, 4, 2), np.uint8), ["(4, 4, 2)", "uint8"]),
    (np.zeros((1, 4, 4, 3), np.uint8), ["(1, 4, 4, 3)"]),
    (np.zeros((0, 4, 3), np.uint8), ["(0, 4, 3)"]),
    (np.uint8(3), ["()"]),
    (Image.new("RGB", (0, 4)), ["(0, 4)"]),
    (Image.new("I", (4, 4)), ["mode I"]),
    (Image.new("F", (4, 4)), ["mode F"]),
    (io.BytesIO(IMAGE), ["BytesIO"]),
    (None, ["NoneType"]),
    ([[1]], ["list"]),
    (records.Video(url="/x", sha256=DIGEST, fps=1, num_frames=1, width=1, height=1), ["Video"]),
    (records.Simulation.model_validate(SIMULATION), ["Simulation"]),
]


@pytest.mark.parametrize(("image", "said"), WRONG)
def test_what_is_no_image_is_named(image: Any, said: list[str]) -> None:
    with pytest.raises(errors.InvalidRequest) as raised:
        image_input(image)
    assert all(part in raised.value.detail for part in said)
    assert [field.pointer for field in raised.value.errors] == ["/image"]


def test_files_that_cannot_be_read(client: Any, tmp_path: Path) -> None:
    for name in (str(tmp_path / "missing.png"), tmp_path / "missing.png"):
        with pytest.raises(FileNotFoundError, match=r"missing\.png"):
            client.simulate(name, QUESTION)
    with pytest.raises(IsADirectoryError):
        client.answer(tmp_path, QUESTION)


def test_bytes_that_are_no_image(client: Any) -> None:
    for data, error in ((b"", errors.ImageUnreadable), (b"GIF89a....", errors.ImageTypeUnsupported),
                        (IMAGE[:500], errors.ImageUnreadable)):  # fmt: skip
        with pytest.raises(error):
            client.simulate(data, QUESTION)
    with pytest.raises(errors.BodyTooLarge):
        client.simulate(os.urandom(3_100_000), QUESTION)


# --- options ---


def test_options_are_the_fields_of_the_requests() -> None:
    for options, request in ((SimulateOptions, SimulateRequest), (AnswerOptions, AnswerRequest)):
        assert set(options.__annotations__) | set(SimulateOptions.__annotations__) == {"law"} | set(
            request.model_fields
        ) - {"image", "question"}
        assert not options.__required_keys__
        assert get_type_hints(Event)


def test_objects_law_ensemble_and_camera_are_sent_right(client: Any) -> None:
    mask = np.zeros((160, 240), bool)
    mask[60:98, 170:205] = True
    boxed = {"object": "blue cube", "bbox": (170, 60, 205, 98), "role": "obstacle"}
    for law, motion in (("ballistic", None), ("contact", {"direction": (1, 0)}), (None, {"kind": "fall"})):
        given = SMALL | {"motion": motion, "law": law, "ensemble": 0, "camera": {"pitch": 25}, "seed": 7}
        for objects in ([boxed], [ObjectRequest.model_validate(boxed)], [{"object": "blue cube", "mask": mask}]):
            simulation = client.submit(IMAGE, QUESTION, objects=objects, **given).wait()
            assert simulation.motion.law == law or (law is None and simulation.motion.law == "contact")
            (cube,) = simulation.grounding.others
            assert (cube.object, cube.bbox, cube.source) == ("blue cube", (170, 60, 205, 98), "request")
            assert (cube.mask is None) == (objects[0] is boxed or isinstance(objects[0], ObjectRequest))
    with pytest.raises(errors.InvalidRequest, match=r"motion\.law"):
        client.simulate(IMAGE, QUESTION, law="contact", motion={"law": "ballistic"})
    with pytest.raises(errors.InvalidRequest) as caught:
        client.simulate(
            IMAGE, QUESTION, **SMALL | {"objects": [{"object": "cube", "mask": np.zeros((160, 240), bool)}]}
        )
    assert [field.pointer for field in caught.value.errors] == ["/objects/0/mask"]


@pytest.mark.parametrize("kind", ["metres", "units"])
def test_a_depth_map_is_an_array(client: Any, kind: str) -> None:
    metres = TrueCamera(focal=240, size=(240, 160)).depth([(42, 62, 78, 98), (170, 60, 205, 98)])
    given = (
        {"map": metres} if kind == "metres" else {"map": np.nan_to_num(1000 * metres).astype(np.uint16), "scale": 1e-3}
    )
    simulation = client.simulate(IMAGE, QUESTION, depth=given | {"focal": 240}, **SMALL)
    assert simulation.trajectory.camera.source == "depth"
    assert simulation.trajectory.camera.height == pytest.approx(1.5, rel=0.02)
    assert simulation.trajectory.depth.valid == pytest.approx(np.isfinite(metres).mean(), abs=0.01)


def test_batches_take_the_same_arguments(client: Any) -> None:
    mask = np.zeros((160, 240), np.uint8)
    mask[60:98, 170:205] = 255
    item = {"image": IMAGE, "question": QUESTION, "objects": [{"object": "cube", "mask": mask}], "law": "ballistic"}
    (outcome,) = list(client.map([item], kind="simulate", ensemble=0, **SMALL))
    assert outcome.error is None
    assert outcome.result.motion.law == "ballistic"
    assert [other.object for other in outcome.result.grounding.others] == ["cube"]


def test_options_of_every_kind_are_sent_right(client: Any, tmp_path: Path) -> None:
    from cow_service.requests import FramesRequest, GroundingRequest

    given = {
        "grounding": {"bbox": np.array([42, 62, 78.5, 98]), "object": "red ball"},
        "motion": {"direction": (np.float32(1), np.float64(0.5)), "speed": np.float32(40)},
        "num_frames": np.int64(5),
        "fps": np.float32(8),
        "seed": np.uint32(9),
        "video": False,
        "frames": FramesRequest(count=2),
        "options": None,
        "reader": None,
        "webhook": None,
        "generator_options": {"clean_cues": False},
    }
    path = tmp_path / "a.png"
    path.write_bytes(IMAGE)
    for image in (path, data_url(IMAGE)):  # a form, and JSON
        simulation = client.simulate(image, QUESTION, **given)
        assert simulation.grounding.bbox == (42, 62, 78.5, 98)
        assert simulation.motion.direction == pytest.approx((0.894, 0.447), abs=1e-3)
        assert (simulation.motion.speed, simulation.trajectory.fps) == (40, 8)
        assert len(simulation.trajectory.path.points) == 5
        assert (simulation.generator.seed, len(simulation.frames), simulation.video) == (9, 2, None)
        points = np.stack([np.linspace(60, 90, 4), np.full(4, 80.0)], axis=1)
        again = client.simulate(
            image, QUESTION, **SMALL | {"grounding": GroundingRequest(point=(60, 80)), "trajectory": {"points": points}}
        )
        assert again.trajectory.path.points[0] == (60, 80)


def test_questions_arrive_as_they_are(client: Any, tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    path.write_bytes(IMAGE)
    question = 'If the "red" bäll\r\nmoves → 🎱; name="x"\n--boundary--\n what\'s hit?\t'
    for image in (path, data_url(IMAGE)):
        assert client.simulate(image, question, **SMALL).question == question


def test_options_that_are_wrong_are_named(client: Any, tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    path.write_bytes(IMAGE)
    for image in (path, data_url(IMAGE)):
        with pytest.raises(errors.InvalidRequest) as raised:
            client.simulate(image, QUESTION, num_frames=1, frame={}, motion={"direction": [0, 0]}, votes=2)
        assert {field.pointer for field in raised.value.errors} == {
            "/num_frames",
            "/frame",
            "/motion/direction",
            "/votes",
        }
        assert raised.value.request_id
        with pytest.raises(TypeError, match="object"):
            client.simulate(image, QUESTION, generator_options={"x": object()})
        with pytest.raises(errors.InvalidRequest):
            client.simulate(image, QUESTION, fps=float("nan"))
        for half in ({"question": "half \ud83c"}, {"question": QUESTION, "options": ["Yes", "\udf00"]}):
            with pytest.raises(errors.InvalidRequest, match="surrogate"):
                client.simulate(image, **half)


# --- results ---


def test_pictures_are_downloaded_once_and_when_asked_for(connect: Connect, address: str) -> None:
    http, seen = connect.seen()
    client = connect(address, http_client=http)
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
    simulation.video_bytes()
    assert len(seen) == before == 1 + 4 + 1 + 1
    client.simulate(simulation.image, ASKED, num_frames=9).load()
    assert len(seen) == before + 1 + 4 + 1 + 1


def test_a_simulation_without_video_says_so(client: Any) -> None:
    with pytest.raises(ValueError, match="video=True"):
        client.simulate(IMAGE, QUESTION, **SMALL).video_bytes()


def test_what_is_saved_is_the_result(client: Any, tmp_path: Path) -> None:
    answer = client.answer(PHOTO, ASKED, video=True)
    folder = tmp_path / "new" / "folder"
    assert answer.save(str(folder)) == folder
    assert answer.save(folder) == folder
    kept = {path.name for path in folder.iterdir()}
    assert kept == {"answer.json", "simulation.json", "overlay.jpg", "video.mp4"} | {
        f"frame_{frame.index:03d}.png" for frame in answer.simulation.frames
    }
    assert records.Answer.model_validate_json((folder / "answer.json").read_text()).option == "No"
    again = Simulation.model_validate_json((folder / "simulation.json").read_text())
    assert again.model_dump() == answer.simulation.model_dump()
    with pytest.raises(ValueError, match="artifact"):
        again.pil_frames()
    assert again._repr_html_().count("not downloaded") == 6


def test_the_scene_as_it_is_is_saved_beside_what_becomes_of_it(client: Any, tmp_path: Path) -> None:
    box = {"object": "thing", "bbox": (20, 20, 60, 60)}
    told = client.simulate(
        IMAGE, QUESTION, objects=[box], interventions=[{"kind": "remove", "object": "thing"}], **SMALL
    )
    assert told.factual_frames
    told.save(tmp_path)
    kept = {path.name for path in tmp_path.glob("factual_*.png")}
    assert kept == {f"factual_{frame.index:03d}.png" for frame in told.factual_frames}


def test_results_can_be_copied_compared_and_sent_to_other_processes(address: str) -> None:
    with Client(address) as client:
        simulation = client.simulate(IMAGE, QUESTION, **SMALL).load()
        assert client.job(simulation.id).wait() == simulation
        for copy in (deepcopy(simulation), simulation.model_copy(deep=True), pickle.loads(pickle.dumps(simulation))):
            assert copy == simulation
            assert copy.pil_frames()[0].size == simulation.pil_frames()[0].size
    assert pickle.loads(pickle.dumps(simulation))._repr_html_() == simulation._repr_html_()


def test_reprs_are_short(client: Any) -> None:
    handle = client.submit(IMAGE, QUESTION, **SMALL)
    simulation = handle.wait()
    assert re.fullmatch(rf"<(Async)?JobHandle {handle.id}: simulate, succeeded>", repr(handle))
    assert re.fullmatch(
        rf"<(Async)?Simulation {handle.id}: object hits blue object after [^;]+; 1 frames>", repr(simulation)
    )
    long = Simulation.model_validate({**SIMULATION, "grounding": {**SIMULATION["grounding"], "object": "a b\n" * 500}})
    assert len(repr(long)) < 200
    assert "\n" not in repr(long)
    answer = records.Answer.model_construct(**{**JOB, "answer": "word " * 999, "option": None})
    assert len(repr(cow_service.client.Answer.model_construct(**dict(answer)))) < 200


def test_notebooks_show_pictures_and_need_no_network(client: Any) -> None:
    answer = client.answer(PHOTO, ASKED, baseline=True, votes=3, video=True).load()
    page = answer._repr_html_()
    assert "B (No)" in page
    assert (page.count("data:image/png;base64,"), page.count("data:image/jpeg;base64,")) == (4, 1)
    coded = re.findall(r'<video controls loop muted playsinline [^>]*src="data:video/mp4;base64,([^"]+)"', page)
    assert [base64.b64decode(one) for one in coded] == [answer.simulation.video_bytes()]
    worlds = answer.simulation.trajectory.ensemble
    assert f"band: where 80% of {worlds} simulated versions have it" in page
    assert not re.search(
        r'(?:src|href)="(?!data:(?:image/png|image/jpeg|video/mp4);base64)|url\(|<script|@import|/artifacts/', page
    )
    assert "band" not in client.simulate(IMAGE, QUESTION, ensemble=0, **SMALL)._repr_html_()


def test_a_video_that_is_too_large_for_a_notebook_is_named(client: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    simulation = client.simulate(PHOTO, ASKED, num_frames=9).load()
    monkeypatch.setattr("cow_service.client.display.MAX_VIDEO_BYTES", len(simulation.video_bytes()) - 1)
    page = simulation._repr_html_()
    assert "<video" not in page
    assert "save(folder) writes it" in page


def test_models_are_a_table(client: Any) -> None:
    models = client.models()
    lines = str(models).splitlines()
    assert lines == repr(models).splitlines()
    assert len(lines) == len(models.readers) + len(models.generators)
    assert "generator  cutout (default)    yes" in lines
    assert "generator  ati                 needs its weights; cow models pull ati" in lines


def test_names_in_the_table_of_models_stay_on_their_line() -> None:
    evil = "<img src=x onerror=alert(1)>\n"
    backend = {"name": evil, "default": True, "ready": False, "summary": evil, "licence": evil, "weights": evil}
    backend |= {"missing": [evil], "install": evil, "pull": evil}
    models = cow_service.client.Models.model_validate({"readers": [backend], "generators": [], "mllms": [evil]})
    assert len(str(models).splitlines()) == 1


def test_what_callers_and_models_write_is_no_markup() -> None:
    evil = "<script>alert(1)</script><img src=x onerror=\"alert('&')\">"
    simulation = Simulation.model_validate(
        {
            **SIMULATION,
            "question": evil,
            "warnings": [evil],
            "motion": {**SIMULATION["motion"], "sentence": evil},
            "grounding": {**SIMULATION["grounding"], "object": evil},
            "trajectory": {
                **SIMULATION["trajectory"],
                "encounters": [{**SIMULATION["trajectory"]["encounters"][0], "object": evil}],
            },
            "overlay": {**SIMULATION["overlay"], "url": evil, "media_type": evil},
            "frames": [{**SIMULATION["frames"][0], "url": evil}],
        }
    )
    verdict = {"answer": evil, "option": evil, "not_sure": False, "reasoning": evil, "votes": {evil: 2}}
    answer = cow_service.client.Answer.model_validate(
        {
            **verdict,
            "id": "a",
            "created_at": "now",
            "question": evil,
            "options": [],
            "image": SIMULATION["image"],
            "simulation": simulation.model_dump(),
            "baseline": verdict,
            "reader": SIMULATION["reader"],
            "usage": {},
            "timings": {},
            "warnings": [evil, "own"],
        }
    )
    for page in (simulation_html(simulation, lambda _: None), simulation._repr_html_(), answer._repr_html_()):
        assert "<script" not in page
        assert "<img" not in page
        assert html.escape(evil) in page


def test_a_notebook_shows_what_is_left_when_the_server_has_gone(
    tmp_path: Path, served: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    with Client(str(served.http.base_url), retries=0) as client:
        simulation = client.simulate(IMAGE, QUESTION, **SMALL)
        seen: list[str] = []
        monkeypatch.setattr(
            simulation._files,
            "fetch",
            lambda sha256: seen.append(sha256) or (_ for _ in ()).throw(CowError("gone")),
        )
        page = simulation._repr_html_()
    assert page.count("not downloaded") == 2
    assert len(seen) == 1  # a server that is gone is not asked for every picture


def test_the_blocking_client_works_where_an_event_loop_runs(address: str) -> None:
    """As in a notebook: its coroutines never wait for that loop."""

    async def cell() -> None:
        with Client(address) as client:
            handle = client.submit(IMAGE, QUESTION, **SMALL)
            assert next(iter(handle.events())).name == "queued"  # and the rest is left where it is
            assert [event.name for event in handle.events()][-1] == "succeeded"
            results = client.map([(IMAGE, QUESTION)], kind="simulate", **SMALL)
            assert [result.succeeded for result in results] == [True]

    asyncio.run(cell())


# --- handles ---


def test_a_handle_is_waited_for_and_found_again(client: Any, connect: Connect, address: str) -> None:
    handle = client.submit(IMAGE, QUESTION, **slowly(0.8, seed=int(connect.kind == "sync")))
    assert handle.job.status in ("queued", "running")
    began = time.monotonic()
    with pytest.raises(errors.WaitTimeout) as raised:
        handle.wait(timeout=0.3)
    assert time.monotonic() - began < 0.8
    assert (raised.value.job_id, raised.value.code) == (handle.id, "wait-timeout")
    assert handle.wait(timeout=60).id == handle.id
    again = connect(address).job(handle.id)
    assert again.job.status == "succeeded"
    assert len(again.wait(timeout=0).pil_frames()) == 40


def test_a_job_that_is_canceled_and_deleted(client: Any) -> None:
    handle = client.submit(IMAGE, QUESTION, **slowly(20, seed=77))
    eventually(lambda: handle.refresh().status == "running")
    assert handle.cancel().status == "canceled"
    assert handle.cancel().status == handle.job.status == "canceled"
    with pytest.raises(errors.Canceled, match=handle.id):
        handle.wait()
    handle.delete()
    for call in (handle.refresh, handle.delete, handle.cancel, handle.wait, lambda: list(handle.events())):
        with pytest.raises(errors.JobNotFound):
            call()


def test_what_a_job_failed_with(client: Any) -> None:
    handle = client.submit(IMAGE, "If the pink car turns, what happens?")
    with pytest.raises(errors.CannotGround) as raised:
        handle.wait()
    assert raised.value.request_id
    with pytest.raises(errors.CannotGround) as direct:
        client.simulate(IMAGE, "If the pink car turns, what happens?")
    assert raised.value.detail == direct.value.detail


def test_events_are_told_to_the_end(client: Any) -> None:
    handle = client.submit(IMAGE, QUESTION, **slowly(0.8, seed=3), fresh=True)
    events = list(handle.events())
    assert all(isinstance(one, Event) for one in events)
    assert [one.number for one in events if one.name != "progress"] == [1, 2, 3, 4, 100]
    assert {one.number for one in events if one.name == "progress"} <= {None}
    assert [one.name for one in events][-1] == "succeeded" == handle.job.status
    assert all(one.job.id == handle.id and one.job.result is None for one in events)
    assert [one.number for one in handle.events()] == [1, 2, 3, 4, 100]
    assert [one.number for one in handle.events(after=3)] == [4, 100]
    assert list(handle.events(after=100)) == []


def test_jobs_are_found_by_what_they_are(client: Any, served: Served) -> None:
    own = [client.submit(IMAGE, QUESTION, kind="answer", **SMALL) for _ in range(3)]
    for handle in own:
        handle.wait()
    ids = [handle.id for handle in own]
    assert [handle.id for handle in client.jobs(kind="answer")][:3] == ids[::-1]
    assert set(ids) <= {handle.id for handle in client.jobs(status="succeeded")}
    assert not set(ids) & {handle.id for handle in client.jobs(status=["failed", "canceled"])}
    assert not list(client.jobs(created_after=datetime.now(UTC) + timedelta(minutes=5)))
    assert not list(client.jobs(created_before=datetime(2020, 1, 1)))
    since = datetime.fromisoformat(own[1].job.created_at)
    assert [handle.id for handle in client.jobs(kind="answer", created_after=since)] == ids[:0:-1]
    with pytest.raises(errors.InvalidRequest):
        list(client.jobs(status="runing"))


def test_jobs_come_page_by_page(connect: Connect, address: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("cow_service.client.protocol.JOBS_PER_PAGE", 2)
    http, seen = connect.seen()
    client = connect(address, http_client=http)
    ids = [client.simulate(IMAGE, QUESTION, fresh=False, **SMALL).id for _ in range(5)]
    seen.clear()
    listed = client.jobs()
    assert [next(listed).id for _ in range(3)] == ids[:1:-1]
    assert seen == ["GET /jobs"] * 2
    everything = [handle.id for handle in client.jobs()]
    assert len(everything) == len(set(everything))
    assert set(ids) <= set(everything)


def test_one_key_is_one_job(client: Any, connect: Connect) -> None:
    key = f"k-{connect.kind}"
    first = client.submit(IMAGE, QUESTION, idempotency_key=key, **SMALL)
    assert client.submit(IMAGE, QUESTION, idempotency_key=key, **SMALL).id == first.id
    assert client.simulate(IMAGE, QUESTION, idempotency_key=key, **SMALL).id == first.id
    with pytest.raises(errors.IdempotencyKeyReused):
        client.submit(IMAGE, QUESTION + " Or not?", idempotency_key=key, **SMALL)
    assert client.simulate(IMAGE, QUESTION, **SMALL).reused
    assert not client.simulate(IMAGE, QUESTION, fresh=True, **SMALL).reused


def test_minimal_results_lack_the_long_lists_alone(client: Any, address: str, tmp_path: Path) -> None:
    whole = client.simulate(IMAGE, QUESTION, **SMALL)
    lean = [
        client.simulate(IMAGE, QUESTION, minimal=True, **SMALL),
        client.simulate(IMAGE, QUESTION, minimal=True, progress=lambda job: None, **SMALL),
        client.submit(IMAGE, QUESTION, **SMALL).wait(minimal=True),
    ]
    with Client(address) as plain:
        (outcome,) = plain.map([(IMAGE, QUESTION)], kind="simulate", out=tmp_path, minimal=True, **SMALL)
    assert whole.trajectory.path.states
    for told in (*lean, outcome.result):
        assert (told.trajectory.path.states, told.trajectory.path.tracks) == ((), ())
        assert (told.trajectory.path.points, told.frames) == (whole.trajectory.path.points, whole.frames)
    (line,) = (tmp_path / "results.jsonl").read_text().splitlines()
    assert json.loads(line)["result"]["trajectory"]["paths"][0]["tracks"] == []


# --- progress, and callers who leave ---


def test_progress_is_told_to_a_function(client: Any) -> None:
    heard: list[Job] = []
    client.simulate(IMAGE, QUESTION, progress=heard.append, fresh=True, **slowly(0.6, seed=11))
    assert heard[-1].status == "succeeded"
    assert [job.progress for job in heard] == sorted(job.progress for job in heard)
    assert len({job.progress for job in heard}) > 2


def test_progress_is_shown(address: str, capsys: pytest.CaptureFixture[str]) -> None:
    with Client(address) as client:
        client.simulate(IMAGE, QUESTION, progress=True, **SMALL)
        client.submit(IMAGE, QUESTION, **SMALL).wait(progress=True)
    shown = capsys.readouterr()
    assert "100%" in shown.out + shown.err
    assert "succeeded" in shown.out + shown.err


def test_progress_in_many_threads(address: str) -> None:
    with Client(address) as client, ThreadPoolExecutor(3) as pool:
        done = [pool.submit(client.simulate, IMAGE, QUESTION, progress=True, **slowly(0.3, seed=n)) for n in range(3)]
        assert len({one.result().id for one in done}) == 3


@pytest.mark.parametrize("progress", [False, True])
def test_an_interrupt_ends_the_job(served: Served, address: str, progress: bool) -> None:
    seed = 500 + progress

    def interrupt() -> None:
        eventually(lambda: seed in served.clips())
        signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)

    thread = threading.Thread(target=interrupt)
    with Client(address) as client:
        thread.start()
        with pytest.raises(KeyboardInterrupt):
            client.simulate(IMAGE, QUESTION, progress=progress, **slowly(20, seed))
        thread.join()
        assert next(client.jobs()).job.status == "canceled"


@pytest.mark.parametrize("progress", [False, True])
def test_a_task_that_is_canceled_ends_its_job(served: Served, address: str, progress: bool) -> None:
    seed = 502 + progress

    async def ask() -> str:
        async with AsyncClient(address) as client:
            task = asyncio.create_task(client.simulate(IMAGE, QUESTION, progress=progress, **slowly(20, seed)))
            await asyncio.to_thread(eventually, lambda: seed in served.clips())
            task.cancel()
            with pytest.raises(asyncio.CancelledError):
                await task
            with suppress(TimeoutError):
                await asyncio.wait_for(client.answer(IMAGE, QUESTION, **slowly(20, seed + 10)), 0.3)
            newest = [handle.job async for handle in client.jobs()][:2]
            return " ".join(f"{job.kind}:{job.status}" for job in newest)

    assert asyncio.run(ask()) == "answer:canceled simulate:canceled"


def test_a_handle_that_is_left_goes_on(served: Served, address: str) -> None:
    async def ask() -> str:
        async with AsyncClient(address) as client:
            handle = await client.submit(IMAGE, QUESTION, **slowly(0.5, seed=510))
            with suppress(TimeoutError):
                await asyncio.wait_for(handle.wait(), 0.2)
            return (await handle.wait()).id

    assert served.job(asyncio.run(ask()))["status"] == "succeeded"


# --- threads, environments, types ---


def test_threads_share_a_client(address: str) -> None:
    def ask(client: Client, number: int) -> tuple[int, str]:
        simulation = client.simulate(IMAGE, QUESTION, **{**SMALL, "seed": number % 4})
        assert simulation.load().numpy_frames().shape == (1, 160, 240, 3)
        handle = client.submit(IMAGE, QUESTION, **{**SMALL, "seed": number % 4})
        assert [event.name for event in handle.events()][-1] == "succeeded"
        return simulation.generator.seed, handle.wait().frames[0].sha256

    with Client(address) as client, ThreadPoolExecutor(8) as pool:
        seeds = Counter(seed for seed, _ in pool.map(lambda number: ask(client, number), range(16)))
    assert seeds == {0: 4, 1: 4, 2: 4, 3: 4}


@pytest.mark.slow
def test_keys_are_sent(tmp_path: Path) -> None:
    import hashlib

    key = "cow_" + "k" * 40
    hashed = "sha256:" + hashlib.sha256(key.encode()).hexdigest()
    with Served(tmp_path, COW_API_KEYS=json.dumps({"alice": hashed})) as served:
        address = str(served.http.base_url)
        with Client(address, api_key=key) as client:
            assert client.simulate(IMAGE, QUESTION, **SMALL).load()._repr_html_()
        with Client(address, api_key="cow_wrong", retries=0) as client, pytest.raises(errors.Unauthorized):
            client.models()


def test_examples_in_the_docs_are_true(address: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.copy(PHOTO, tmp_path / "image.jpg")
    monkeypatch.chdir(tmp_path)
    names = [f"cow_service.client.{found.name}" for found in pkgutil.iter_modules(cow_service.client.__path__)]
    names = [name for name in names if ".async_" not in name]  # what is awaited there is called here
    with Client(address) as client:
        own = {"client": client, "base_url": address, "asyncio": asyncio}
        found = {name: doctest.testmod(importlib.import_module(name), extraglobs=own) for name in names}
    assert not {name: each for name, each in found.items() if each.failed}
    modules = {"sync_client", "sync_results", "display"}
    assert {name.rpartition(".")[2] for name, each in found.items() if each.attempted} >= modules


USE = """
import asyncio
from collections.abc import AsyncIterator
from typing import assert_type

from PIL import Image

from cow_service.client import (
    Answer, AsyncAnswer, AsyncClient, AsyncSimulation, Client, CowError, Event, JobHandle, Models, Simulation, errors,
)
from cow_service.records import Job
from cow_service.requests import FramesRequest

client = Client(timeout=5, retries=2)
simulation = client.simulate("a.png", "What happens?", frames={"count": 5}, motion={"direction": [1, 0]})
assert_type(simulation, Simulation)
assert_type(simulation.pil_frames(), list[Image.Image])
assert_type(simulation.video_bytes(), bytes)
answer = client.answer(b"", "What?", votes=3, baseline=True, imagine="never", frames=FramesRequest(count=2))
assert_type(answer, Answer)
assert_type(answer.simulation, Simulation | None)
handle = client.submit("a.png", "What?", kind="answer", votes=3)
assert_type(handle, JobHandle[Answer])
assert_type(handle.wait(timeout=3, progress=True), Answer)
assert_type(client.submit("a.png", "What?").wait(), Simulation)
assert_type(client.job("x").wait(), Simulation | Answer)
assert_type(client.models(), Models)
for event in handle.events(after=2):
    assert_type(event, Event)
    assert_type(event.job, Job | None)
for one in client.jobs(status=["failed"], kind="answer"):
    assert_type(one, JobHandle[Simulation | Answer])
try:
    client.simulate("a.png", "What?", progress=lambda job: print(job.progress))
except errors.QueueFull as error:
    print(error.request_id, error.status, error.errors[0].pointer)
except CowError:
    raise


async def ask() -> None:
    async with AsyncClient() as client:
        assert_type(await client.simulate("a.png", "What?"), AsyncSimulation)
        handle = await client.submit("a.png", "What?", kind="answer")
        answer = await handle.wait()
        assert_type(answer, AsyncAnswer)
        assert_type(answer.simulation, AsyncSimulation | None)
        async for event in handle.events():
            assert_type(event, Event)
        jobs = client.jobs()
        assert_type([one.id async for one in jobs], list[str])


asyncio.run(ask())
client.simulate("a.png", "What?", votes=3)  # pyright: ignore[reportCallIssue]
client.submit("a.png", "What?", kind="answer", frame={})  # pyright: ignore[reportCallIssue]
client.answer(3, "What?")  # pyright: ignore[reportArgumentType]
client.answer("a.png", "What?", imagine="sometimes")  # pyright: ignore[reportArgumentType]
"""


@pytest.mark.slow
def test_types_are_told(tmp_path: Path) -> None:
    (tmp_path / "use.py").write_text(USE)
    settings = {"typeCheckingMode": "strict", "pythonVersion": "3.11", "extraPaths": [str(ROOT)], "include": ["use.py"]}
    settings |= {"reportUnnecessaryTypeIgnoreComment": True, "reportUnusedImport": False}
    (tmp_path / "pyrightconfig.json").write_text(json.dumps(settings))
    checked = subprocess.run(
        [sys.executable, "-m", "pyright", "--pythonpath", sys.executable, "-p", str(tmp_path)],
        capture_output=True,
        text=True,
        check=False,
        cwd=tmp_path,
    )
    assert checked.returncode == 0, checked.stdout


LIGHT = """
import os, sys
from cow_service.client import Client, errors
with Client(os.environ["ADDRESS"]) as client:
    answer = client.answer("image.jpg", os.environ["QUESTION"])
    print(answer.option, answer)
    answer.save("out")
    assert "data:image/png" in answer._repr_html_()
    try:
        client.simulate(b"", "What?")
    except errors.ImageUnreadable as error:
        print(error.code)
    (outcome,) = client.map([("image.jpg", os.environ["QUESTION"])])
    assert outcome.result.option == answer.option
    try:
        answer.simulation.pil_frames()
    except ImportError as error:
        print(error)
"""


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_the_sdk_needs_three_packages(wheel: Path, tmp_path: Path, address: str) -> None:
    python = new_environment(tmp_path / "venv", "httpx>=0.28", "httpx-sse>=0.4", "pydantic>=2.12") / "python"
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(next((tmp_path / "venv" / "lib").glob("python*/site-packages")))
    shutil.copy(PHOTO, tmp_path / "image.jpg")
    ran = subprocess.run(
        [python, "-W", "error", "-c", LIGHT],
        capture_output=True,
        text=True,
        check=False,
        cwd=tmp_path,
        env={"ADDRESS": address, "QUESTION": ASKED, "PATH": "/usr/bin:/bin"},
    )
    assert ran.returncode == 0, ran.stderr
    assert ran.stdout.splitlines()[0].startswith("No <Answer")
    assert "image-unreadable" in ran.stdout
    assert "PIL" in ran.stdout
    assert len([*(tmp_path / "out").glob("frame_*.png")]) == 4
