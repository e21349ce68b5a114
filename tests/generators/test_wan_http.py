"""The video generators over HTTP, and the track files on the command line, as a caller meets them."""

from __future__ import annotations

import base64
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import example
from engines import app_for
from fastapi.testclient import TestClient
from servers import problem
from typer.testing import CliRunner

from cow_service.cli.main import app
from cow_service.media.images import decode_own
from cow_service.records import Simulation
from cow_service.service import Service
from cow_service.settings import Settings

pytestmark = pytest.mark.slow

BALL = example("ball-and-mug")


@pytest.fixture(scope="module")
def http(tmp_path_factory: pytest.TempPathFactory) -> TestClient:
    """In this process, which has the models' libraries already; the tests of workers have a server of its own."""
    return TestClient(app_for(Service(Settings(data_dir=tmp_path_factory.mktemp("data"), device="cpu"))))


def body(**rest: object) -> dict[str, Any]:
    encoded = "data:image/jpeg;base64," + base64.b64encode(BALL.image).decode()
    return {"image": encoded, "question": BALL.meta["question"], "generator": "tiny-ati", "num_frames": 9, **rest}


def test_frames_and_mp4_that_say_they_are_a_toys(http: TestClient) -> None:
    answer = http.post("/simulate", json=body())
    assert answer.status_code == 200, answer.text
    found = Simulation.model_validate_json(answer.text)
    assert found.video is not None
    assert (found.video.num_frames, found.video.width, found.video.height) == (9, 112, 64)
    assert http.get(found.video.url).content[4:8] == b"ftyp"
    # A toy says so: in a field, in words, and on a dark plate at the corner of each frame.
    assert (found.generator.name, found.generator.is_toy) == ("tiny-ati", True)
    assert any("tiny-ati" in warning for warning in found.warnings)
    for frame in found.frames:
        assert decode_own(http.get(frame.url).content)[4:8, :3].max() <= 20


def test_what_it_cannot_make_is_refused(http: TestClient) -> None:
    told = problem(http.post("/simulate", json=body(num_frames=90)), 422, "invalid-request")
    (error,) = told["errors"]
    assert error["pointer"] == "/num_frames"
    assert "81" in error["detail"]
    told = problem(http.post("/simulate", json=body(generator_options={"steps": 0})), 422, "invalid-request")
    assert [error["pointer"] for error in told["errors"]] == ["/generator_options/steps"]
    told = problem(http.post("/simulate", json=body(generator="ati")), 503, "generator-unavailable")
    assert "portable" in told["detail"], "the profile that this machine can run"
    backends = {backend["name"]: backend for backend in http.get("/models").json()["generators"]}
    assert (backends["ati"]["ready"], backends["ati"]["pull"]) == (False, "cow models pull ati")
    assert backends["tiny-ati"]["ready"] is True


@pytest.fixture
def cow(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """`cow` in this process and an empty folder with a picture: its exit code and what it said."""
    (tmp_path / "image.jpg").write_bytes(BALL.image)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COW_DATA_DIR", str(tmp_path / "data"))

    def run(*arguments: str) -> tuple[int, str]:
        result = CliRunner().invoke(app, arguments)
        assert result.exception is None or isinstance(result.exception, SystemExit)
        return result.exit_code, result.output

    return run


def simulation(file: str) -> Simulation:
    return Simulation.model_validate_json(Path(file).read_bytes())


def test_the_tracks_of_a_simulation_as_files(cow: Any) -> None:
    done = cow("simulate", "image.jpg", BALL.meta["question"], "--law", "ballistic", "--no-video", "--out", "out")
    assert done[0] == 0, done
    for suffix in ("pth", "npy"):
        code, told = cow("tracks", "out/simulation.json", "--out", f"tracks.{suffix}")
        assert code == 0, told
        assert "5 tracks of moving objects, 6 of still ones and 8 of the background over 81 frames" in told
    trajectory = simulation("out/simulation.json").trajectory
    points = np.load("tracks.npy")[0]
    np.testing.assert_allclose(points[:, :5], np.transpose(trajectory.path.tracks, (1, 0, 2)), atol=0.01)
    still = [point for each in trajectory.still_tracks for point in each.points]
    anchors = trajectory.anchors
    np.testing.assert_allclose(points[:, 5:], np.broadcast_to([*still, *anchors], (81, 14, 2)), atol=0.01)
    for arguments, named in (
        (("image.jpg", "--out", "a.npz"), "image.jpg"),
        (("out/simulation.json", "--out", "a.csv"), ".csv"),
        (("out/simulation.json", "--out", "absent/a.npz"), "absent"),
    ):
        code, told = cow("tracks", *arguments)
        assert code == 1
        assert named in told
