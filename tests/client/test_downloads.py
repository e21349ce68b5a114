"""`GET /jobs/{id}/download`, asked of a real server: a job as a zip, as animated pictures and as a contact sheet."""

from __future__ import annotations

import io
import json
import re
import zipfile
from pathlib import Path
from typing import Any

import pytest
from PIL import Image
from sdk import served
from servers import BODY, IMAGE, Served, problem, slow
from waiting import eventually

from cow_service.api.routes.artifacts import FILES
from cow_service.client import Client
from cow_service.media.share import Told, card
from cow_service.media.video import frames_of

__all__ = ["served"]  # a fixture
pytestmark = pytest.mark.slow

ANSWERED: dict[str, Any] = {
    **BODY,
    "objects": [{"object": "blue cube", "bbox": [170, 60, 205, 98]}],
    "interventions": [{"kind": "remove", "object": "blue cube"}],
    "num_frames": 20,
    "video": True,
}


@pytest.fixture(scope="module")
def answered(served: Served) -> str:
    """The id of an answer with all that there can be."""
    job = served.ended(served.submit(ANSWERED, "/answer")["id"])
    assert job["status"] == "succeeded", job
    return job["id"]


def test_a_zip_holds_what_the_sdk_saves_and_what_was_asked(served: Served, answered: str, tmp_path: Path) -> None:
    response = served.http.get(f"/jobs/{answered}/download")
    assert response.status_code == 200, response.text
    assert response.headers["content-type"] == "application/zip"
    assert response.headers["content-disposition"] == f'attachment; filename="cow-{answered}.zip"'
    assert served.http.get(f"/jobs/{answered}/download?format=zip").content == response.content
    with zipfile.ZipFile(io.BytesIO(response.content)) as archive:
        assert {entry.compress_type for entry in archive.infolist()} == {zipfile.ZIP_STORED}
        held = {name: archive.read(name) for name in archive.namelist()}
    assert held.pop("image.png") == IMAGE
    request = json.loads(held.pop("request.json"))
    assert request == served.http.get(f"/jobs/{answered}/request").json()["request"]
    with Client(str(served.http.base_url)) as client:
        folder = client.job(answered).wait(60).save(tmp_path / "saved")
    assert held == {path.name: path.read_bytes() for path in folder.iterdir()}
    assert {"answer.json", "simulation.json", "overlay.jpg", "video.mp4"} <= set(held)
    of_each = [sorted(name[-7:] for name in held if name.startswith(kind)) for kind in ("frame_", "factual_")]
    assert of_each[0] == of_each[1] != [], "the same frames of both worlds"
    # Nothing is left of it on the server.
    eventually(lambda: not list(served.data.rglob(".*.part")))


def test_the_video_as_pictures(served: Served, answered: str) -> None:
    whole, sheet = (240, 160), (4 * 240 + 3 * 4, 3 * 160 + 2 * 4)
    names = {"gif": ".gif", "webp": ".webp", "sheet": "-sheet.png"}
    told = {"gif": ("GIF", 20, whole), "webp": ("WEBP", 20, whole), "sheet": ("PNG", 1, sheet)}
    for wanted, name in names.items():
        response = served.http.get(f"/jobs/{answered}/download", params={"format": wanted})
        assert response.status_code == 200, response.text
        assert response.headers["content-disposition"] == f'attachment; filename="cow-{answered}{name}"'
        with Image.open(io.BytesIO(response.content)) as picture:
            assert response.headers["content-type"] == Image.MIME[str(picture.format)]
            assert (picture.format, getattr(picture, "n_frames", 1), picture.size) == told[wanted]


def test_where_there_is_no_such_file_the_problem_says_so(served: Served) -> None:
    def unavailable(job_id: str, wanted: str) -> None:
        response = served.http.get(f"/jobs/{job_id}/download", params={"format": wanted})
        problem(response, 409, "download-unavailable")

    running = served.submit(slow(30))["id"]
    unavailable(running, "zip")
    served.http.post(f"/jobs/{running}/cancel")
    unavailable(running, "gif")
    question = {"grounding": None, "motion": None, "question": "If the pink car turns, what happens?"}
    unavailable(served.ended(served.submit({**BODY, **question})["id"])["id"], "zip")
    gone = served.ended(served.submit({**BODY, "seed": 7, "fps": 9})["id"])
    unavailable(gone["id"], "sheet")
    seen = served.ended(served.submit({**BODY, "imagine": "never"}, "/answer")["id"])["id"]
    unavailable(seen, "webp")
    with zipfile.ZipFile(io.BytesIO(served.http.get(f"/jobs/{seen}/download").content)) as archive:
        assert set(archive.namelist()) == {"answer.json", "request.json", "image.png"}
    (path,) = served.data.rglob(f"{gone['result']['overlay']['sha256']}.jpg")
    path.unlink()  # no broken zip
    problem(served.http.get(f"/jobs/{gone['id']}/download"), 404, "artifact-not-found")
    problem(served.http.get("/jobs/x/download"), 404, "job-not-found")
    problem(served.http.get(f"/jobs/{seen}/download?format=mp4"), 422, "invalid-request")


def test_a_film_tells_question_and_verdict_and_a_card_is_one_moment_of_it(served: Served, answered: str) -> None:
    clip, fps = frames_of(served.http.get(f"/jobs/{answered}/download?format=gif").content)
    film = served.http.get(f"/jobs/{answered}/download?format=film")
    assert film.headers["content-type"] == "video/mp4"
    assert len(film.content) < 3 * 1024**2
    frames, rate = frames_of(film.content)
    height, width = frames[0].shape[:2]
    assert height / width > 1.2 * clip[0].shape[0] / clip[0].shape[1], "words above and below"
    assert len(frames) / rate > len(clip) / fps + 1, "it begins with the futures and ends with the verdict"
    words = slice(-height // 8, None)
    assert (frames[-1][words] > 128).mean() > 2 * (frames[0][words] > 128).mean(), "the verdict comes last"
    jpeg = served.http.get(f"/jobs/{answered}/download?format=card").content
    with zipfile.ZipFile(io.BytesIO(served.http.get(f"/jobs/{answered}/download").content)) as archive:
        video = archive.read("video.mp4")
    for question in ("如果球向右移动，" * 12, "x" * 400):  # in any letters, and however long
        told = Told(question, "Not sure", 0, "", None, (), ((0.1, 0.1), (0.2, 0.2)), 1.0, 0)
        for picture in (jpeg, card(video, told)):
            with Image.open(io.BytesIO(picture)) as opened:
                assert (opened.format, opened.size) == ("JPEG", (1200, 630))


def test_a_page_has_live_worlds(served: Served, answered: str) -> None:
    problem(served.http.get(f"/jobs/{answered}/download?format=page"), 409, "download-unavailable")
    named = {"object": "mug </SCRIPT><Script>alert(1)<!-- \u2028", "bbox": [170, 60, 205, 98]}
    asked = {"live": True, "ensemble": 1, "question": "Will </script> <b>it</b> hit?", "objects": [named]}
    job = served.ended(served.submit(BODY | asked)["id"])
    page = served.http.get(f"/jobs/{job['id']}/download?format=page")
    assert page.headers["content-disposition"] == f'attachment; filename="cow-{job["id"]}.html"'
    assert "Will &lt;/script&gt; &lt;b&gt;it&lt;/b&gt; hit? (Asked of another direction: to the right.)" in page.text
    text = page.text.lower()
    assert text.count("</script") == text.count("<script ") == page.text.count("<script "), "no text ends its script"
    (world,) = re.findall(r'id="world">(.*?)</script>', page.text)
    assert json.loads(world)["bodies"][1]["name"] == named["object"]


def test_lists_tell_answers_and_what_was_given(served: Served, answered: str) -> None:
    job = next(each for each in served.http.get("/jobs").json()["jobs"] if each["id"] == answered)
    found = served.http.get(f"/jobs/{answered}").json()
    assert job["answer"] == (found["result"]["option"] or found["result"]["answer"] or "Not sure") == found["answer"]
    assert job["given"] == ["grounding", "motion", "objects", "interventions"]


WITHOUT_DECODERS = """
import av, cv2
from PIL import ImageFile
from cow_service.cli.main import app

def refuse(*_, **__):
    raise AssertionError("a decoder runs in the server")

cv2.imdecode = cv2.imread = av.open = ImageFile.ImageFile.load = refuse
app(["serve"])
"""


def test_no_decoder_runs_in_the_server(tmp_path: Path) -> None:
    own = {"COW_WORKERS": "true", "COW_CONCURRENCY": "1", "COW_WARMUP": "false"}
    with Served(tmp_path, code=WITHOUT_DECODERS, **own) as served:
        job = served.ended(served.submit({**BODY, "live": True, "video": True})["id"])
        for wanted in FILES:
            response = served.http.get(f"/jobs/{job['id']}/download", params={"format": wanted})
            assert response.status_code == 200, (wanted, served.log())
