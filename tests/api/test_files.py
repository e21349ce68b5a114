"""Files that the server sends: downloads of a job, artifacts of an object store, and the page for people."""

from __future__ import annotations

import gzip
import io
import zipfile
from pathlib import Path

import httpx
import pytest
from asgi import app_of, ask
from servers import BODY, problem

pytestmark = pytest.mark.slow
ABSENT = "00000000-0000-0000-0000-000000000000"
# By format: the end of the file's name, the media type, and the first bytes from a place on.
FORMATS = {
    "zip": (".zip", "application/zip", 0, b"PK\3\4"),
    "film": ("-film.mp4", "video/mp4", 4, b"ftyp"),
    "card": (".jpg", "image/jpeg", 0, b"\xff\xd8\xff"),
    "page": (".html", "text/html; charset=utf-8", 0, b"<!doctype html>"),
    "gif": (".gif", "image/gif", 0, b"GIF89a"),
    "webp": (".webp", "image/webp", 8, b"WEBP"),
    "sheet": ("-sheet.png", "image/png", 0, b"\x89PNG"),
}


def test_a_job_in_every_format(http: httpx.Client) -> None:
    job = http.post("/simulate", json={**BODY, "video": True, "live": True}).json()["id"]
    for name, (ending, media_type, place, begin) in FORMATS.items():
        response = http.get(f"/jobs/{job}/download", params={"format": name})
        assert response.status_code == 200, response.text
        assert response.headers["content-disposition"] == f'attachment; filename="cow-{job}{ending}"'
        assert response.headers["content-type"] == media_type
        assert response.content[place:].lower().startswith(begin.lower())
    whole = http.get(f"/jobs/{job}/download")
    with zipfile.ZipFile(io.BytesIO(whole.content)) as archive:
        assert {"image.png", "overlay.jpg", "video.mp4", "simulation.json", "request.json"} <= set(archive.namelist())
    part = http.get(f"/jobs/{job}/download", headers={"Range": "bytes=2-5"})
    assert (part.status_code, part.content) == (206, whole.content[2:6])
    assert http.get(f"/jobs/{job}/download").content == whole.content  # by the time of the job


def test_what_a_job_has_no_file_of(http: httpx.Client) -> None:
    still = http.post("/simulate", json=BODY).json()["id"]
    answer = http.post("/answer", json={**BODY, "imagine": "never"}).json()["id"]
    key = {"Idempotency-Key": "of-files"}
    body = {**BODY, "grounding": None, "question": "If the pink car turns?"}
    failed = http.post("/simulate", json=body, headers={"Prefer": "respond-async", **key}).json()["id"]
    problem(http.post("/simulate", json=body, headers=key), 422, "cannot-ground")  # it has ended
    for job, name in ((still, "film"), (still, "gif"), (still, "page"), (answer, "card"), (failed, "zip")):
        problem(http.get(f"/jobs/{job}/download", params={"format": name}), 409, "download-unavailable")
    assert http.get(f"/jobs/{answer}/download").status_code == 200
    problem(http.get(f"/jobs/{ABSENT}/download"), 404, "job-not-found")
    problem(http.get(f"/jobs/{still}/download", params={"format": "tar"}), 422, "invalid-request")


@pytest.mark.parametrize("redirects", [True, False])
def test_artifacts_of_an_object_store(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, redirects: bool) -> None:
    app = app_of(tmp_path, artifacts_redirect=redirects)
    store = app.state.engine.service.artifacts
    url = f"/artifacts/{store.put(b'a picture', 'image/png').sha256}"
    monkeypatch.setattr(store, "signed_url", lambda sha256, seconds: f"https://store.example/{sha256}?{seconds:g}")
    found, head, page = ask(app, ("GET", url), ("HEAD", url), ("GET", "/"))
    assert (head.status_code, head.headers["content-length"]) == (200, "9")
    assert ("https://store.example" in page.headers["content-security-policy"]) is redirects
    if redirects:
        assert (found.status_code, found.headers["cache-control"]) == (307, "private, max-age=600")
        assert found.headers["location"] == f"https://store.example{url.removeprefix('/artifacts')}?900"
    else:
        assert (found.status_code, found.content) == (200, b"a picture")


def test_the_page_and_its_files(http: httpx.Client) -> None:
    page = http.get("/", headers={"Accept-Encoding": "br, gzip;q=0"})
    assert "content-encoding" not in page.headers
    assert '<link rel="modulepreload" href="web/' in page.text
    policy = page.headers["content-security-policy"]
    assert policy.startswith("default-src 'none'; script-src 'self' 'wasm-unsafe-eval'; style-src 'self'; ")
    assert page.headers["x-frame-options"] == "DENY"
    tag = {"If-None-Match": page.headers["etag"]}
    assert [http.get("/", headers=headers).status_code for headers in (tag, {"If-None-Match": "x"})] == [304, 200]
    with http.stream("GET", "/", headers={"Accept-Encoding": "gzip"}) as packed:
        assert gzip.decompress(b"".join(packed.iter_raw())) == page.content
    for path, media_type in {
        "/docs": "text/html; charset=utf-8",
        "/docs/swagger-ui.css": "text/css; charset=utf-8",
        "/web/vendor/rapier.wasm": "application/wasm",
        "/web/examples/ball-and-mug-small.jpg": "image/jpeg",
    }.items():
        response = http.get(path)
        assert (response.status_code, response.headers["content-type"]) == (200, media_type), path
        assert "connect-src" in response.headers.get("content-security-policy", "connect-src")
    for path in ("/web/index.html", "/web/nothing.js", "/docs/index.html"):
        problem(http.get(path), 404, "not-found")
