"""Files that the server sends: parts of a download, and the page for people.

The formats of downloads: client/test_downloads.py. Artifacts of an object store: jobs/test_artifact_stores.py.
"""

from __future__ import annotations

import gzip
from pathlib import Path

import httpx
import pytest
from asgi import app_of, ask
from servers import BODY, problem

pytestmark = pytest.mark.slow


def test_a_part_of_a_download(http: httpx.Client) -> None:
    url = f"/jobs/{http.post('/simulate', json=BODY).json()['id']}/download"
    part = http.get(url, headers={"Range": "bytes=2-5"})
    assert (part.status_code, part.content) == (206, http.get(url).content[2:6])


@pytest.mark.parametrize("redirects", [True, False])
def test_artifacts_of_a_store(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, redirects: bool) -> None:
    app = app_of(tmp_path, artifacts_redirect=redirects)
    store = app.state.engine.service.artifacts
    monkeypatch.setattr(store, "signed_url", lambda *_: "https://store.example/x?900")
    found, page = ask(app, ("GET", f"/artifacts/{store.put(b'a picture', 'image/png').sha256}"), ("GET", "/"))
    assert (found.status_code, found.content) == ((307, b"") if redirects else (200, b"a picture"))
    assert ("https://store.example" in page.headers["content-security-policy"]) is redirects


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
