"""`GET /docs` on a real server: it loads nothing from elsewhere, and holds no script that its policy would stop."""

from __future__ import annotations

import re

import httpx
import pytest
from servers import problem

pytestmark = pytest.mark.slow
FILES = ("docs/swagger-ui.css", "docs/docs.css", "docs/swagger-ui-bundle.js", "docs/start.js")


def test_the_page_loads_what_the_server_has_and_needs_no_exception_in_its_policy(http: httpx.Client) -> None:
    page = http.get("/docs")
    assert page.headers["content-type"].startswith("text/html")
    loaded = re.findall(r'(?:src|href)="([^"]+)"', page.text)
    assert sorted(loaded) == sorted([*FILES, "data:,", "openapi.json"])
    for name in FILES:
        response = http.get(f"/{name}")
        assert response.status_code == 200
        assert response.headers["content-type"].startswith("text/css" if name.endswith("css") else "text/javascript")
    assert "SwaggerUIBundle" in http.get("/docs/swagger-ui-bundle.js").text
    policy = page.headers["content-security-policy"]
    assert "default-src 'none'" in policy
    assert not re.search("unsafe|http", policy)
    assert not re.search(r"<script[^>]*>[^<]|<style|\sstyle=|\son\w+=", page.text)


@pytest.mark.parametrize("path", ["/docs", "/docs/start.js"])
def test_files_are_sent_once(http: httpx.Client, path: str) -> None:
    first = http.get(path)
    assert first.headers["x-content-type-options"] == "nosniff"
    again = http.get(path, headers={"If-None-Match": first.headers["etag"]})
    assert (again.status_code, again.content) == (304, b"")
    assert http.head(path).headers["content-length"] == first.headers["content-length"]


def test_there_is_nothing_else(http: httpx.Client) -> None:
    for path in ("/docs/", "/docs/index.html", "/docs/redoc.standalone.js", "/docs/..%2fpage.py"):
        problem(http.get(path), 404, "not-found")
    problem(http.post("/docs"), 405, "method-not-allowed")
