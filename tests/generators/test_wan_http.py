"""The video generators over HTTP, and the track files on the command line, as a caller meets them."""

from __future__ import annotations

import asyncio
import base64
import json
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
import torch
from command_line import cow_from_nothing as cow
from conftest import example
from engines import app_for

from cow_service.generators.wan.generator import WanGenerator
from cow_service.media.images import decode_own
from cow_service.records import Simulation
from cow_service.service import Service
from cow_service.settings import Settings

pytestmark = pytest.mark.slow

BALL = example("ball-and-mug")


def body(**rest: object) -> dict[str, Any]:
    encoded = "data:image/jpeg;base64," + base64.b64encode(BALL.image).decode()
    return {"image": encoded, "question": BALL.meta["question"], "generator": "tiny-ati", "num_frames": 17, **rest}


def test_frames_and_mp4(http: httpx.Client) -> None:
    answer = http.post("/simulate", json=body())
    assert answer.status_code == 200, answer.text
    found = Simulation.model_validate_json(answer.text)
    assert found.generator.name == "tiny-ati"
    assert found.video is not None
    assert http.get(found.video.url).content[4:8] == b"ftyp"
    # A toy says so: in a field, in words, and on a dark plate at the corner of each frame.
    assert found.generator.is_toy
    assert any("'tiny-ati' has random weights" in warning for warning in found.warnings)
    for frame in found.frames:
        assert decode_own(http.get(frame.url).content)[4:8, :3].max() <= 20


def test_a_length_that_it_cannot_make(http: httpx.Client) -> None:
    answer = http.post("/simulate", json=body(num_frames=90))
    assert answer.status_code == 422
    said = "this generator makes no clip of 90 frames at 16 per second; take 81 (5 s)"
    assert answer.json()["errors"] == [{"pointer": "/num_frames", "detail": said}]


def test_what_this_machine_cannot_do(http: httpx.Client) -> None:
    answer = http.post("/simulate", json=body(generator="ati"))
    assert answer.status_code == 503
    assert answer.json()["type"] == "urn:cow:problem:generator-unavailable"
    assert "needs a GPU" in answer.json()["detail"]
    assert "This machine can run: portable (COW_PROFILE)." in answer.json()["detail"]
    backends = {backend["name"]: backend for backend in http.get("/models").json()["generators"]}
    assert backends["ati"]["ready"] is False
    assert backends["ati"]["pull"] == "cow models pull ati"
    assert backends["tiny-ati"]["ready"] is True


def test_a_caller_who_goes_away_ends_the_work(tmp_path: Path) -> None:
    service = Service(Settings(data_dir=tmp_path))
    generator = service.generators.get("tiny-ati")
    assert isinstance(generator, WanGenerator)
    passes: list[int] = []
    sent = json.dumps(body(video=False, generator_options={"steps": 100})).encode()

    app = app_for(service)

    async def call() -> None:
        loop, gone = asyncio.get_running_loop(), asyncio.Event()

        def after(module: torch.nn.Module, args: object, output: object) -> None:
            passes.append(1)
            loop.call_soon_threadsafe(gone.set)

        generator.pipeline.transformer.register_forward_hook(after)
        messages = [{"type": "http.request", "body": sent, "more_body": False}]

        async def receive() -> dict[str, Any]:
            if messages:
                return messages.pop()
            await gone.wait()
            return {"type": "http.disconnect"}

        async def send(message: dict[str, Any]) -> None:
            """There is no listener."""

        scope = {
            "type": "http", "asgi": {"version": "3.0"}, "http_version": "1.1", "method": "POST", "path": "/simulate",
            "raw_path": b"/simulate", "query_string": b"", "root_path": "", "scheme": "http", "server": ("test", 80),
            "headers": [(b"content-type", b"application/json")],
        }  # fmt: skip
        await app(scope, receive, send)

    asyncio.run(call())
    assert 1 <= len(passes) < 100  # of 200


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("simulated")
    (folder / "image.jpg").write_bytes(BALL.image)
    done = cow(
        folder, "simulate", "image.jpg", BALL.meta["question"], "--law", "ballistic", "--no-video", "--out", "out"
    )
    assert done.returncode == 0, done.stderr
    return folder


def test_the_tracks_of_a_simulation_as_files(simulated: Path) -> None:
    for suffix in ("pth", "npy"):
        exported = cow(simulated, "tracks", "out/simulation.json", "--out", f"tracks.{suffix}")
        assert exported.returncode == 0, exported.stderr
        assert "5 tracks of moving objects, 6 of still ones and 8 of the background over 81 frames" in exported.stdout
    simulation = Simulation.model_validate_json((simulated / "out" / "simulation.json").read_bytes())
    path, anchors = simulation.trajectory.path, simulation.trajectory.anchors
    points = np.load(simulated / "tracks.npy")[0]
    np.testing.assert_allclose(points[:, :5], np.transpose(path.tracks, (1, 0, 2)), atol=0.01)
    still = [point for each in simulation.trajectory.still_tracks for point in each.points]
    np.testing.assert_allclose(points[:, 5:], np.broadcast_to([*still, *anchors], (81, 14, 2)), atol=0.01)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("image.jpg", "--out", "a.npz"), "image.jpg is not a simulation"),
        (("out/simulation.json", "--out", "a.csv"), "suffix '.csv'"),
        (("out/simulation.json", "--out", "absent/a.npz"), "Cannot write to"),
    ],
)
def test_what_cannot_be_done_is_said(simulated: Path, arguments: tuple[str, ...], said: str) -> None:
    done = cow(simulated, "tracks", *arguments)
    assert done.returncode == 1
    assert said in done.stderr
    assert "Traceback" not in done.stderr


def test_a_trajectory_of_many_tracks_keeps_each_ones_visibility(simulated: Path) -> None:
    frames, count = 81, 400
    points = np.arange(frames)[:, None, None] * [1.0, 0.5] + np.linspace(50, 200, count)[None, :, None]
    visible = np.random.default_rng(0).random((frames, count)) < 0.9
    visible[0] = visible[-1] = True
    given = {
        "points": points.mean(axis=1).tolist(),
        "fps": 16,
        "tracks": points.transpose(1, 0, 2).tolist(),
        "tracks_visible": visible.T.tolist(),
    }
    (simulated / "many.json").write_text(json.dumps(given))
    told = ("--object", "yellow ball", "--trajectory", "many.json", "--num-frames", "41")
    done = cow(simulated, "simulate", "image.jpg", "?", *told, "--no-video", "--out", "many-out")
    assert done.returncode == 0, done.stderr
    found = Simulation.model_validate_json((simulated / "many-out" / "simulation.json").read_bytes())
    assert (visible[:41] == np.array(found.trajectory.path.tracks_visible).T).all()
    assert found.motion.sentence.startswith("The yellow ball")
    assert any("lasts 5.00 s and the clip 2.50 s: the end of the path is not shown" in told for told in found.warnings)


def test_a_trajectory_that_is_not_json(simulated: Path) -> None:
    done = cow(simulated, "simulate", "image.jpg", "?", "--trajectory", "image.jpg")
    assert done.returncode == 1
    assert "image.jpg is not JSON" in done.stderr
