"""`GET /docs` on a real server: it loads nothing from elsewhere, and holds no script that its policy would stop."""

from __future__ import annotations

import re

import httpx
import pytest
from conftest import Server

FILES = ("docs/swagger-ui.css", "docs/docs.css", "docs/swagger-ui-bundle.js", "docs/start.js")


@pytest.fixture(scope="module")
def page(server: Server) -> httpx.Response:
    return httpx.get(f"{server.address}/docs")


def test_the_page_loads_what_the_server_has(server: Server, page: httpx.Response) -> None:
    assert page.headers["content-type"].startswith("text/html")
    loaded = re.findall(r'(?:src|href)="([^"]+)"', page.text)
    assert sorted(loaded) == sorted([*FILES, "data:,", "openapi.json"])
    for name in FILES:
        response = httpx.get(f"{server.address}/{name}")
        assert response.status_code == 200
        assert response.headers["content-type"].startswith("text/css" if name.endswith("css") else "text/javascript")
    assert "SwaggerUIBundle" in httpx.get(f"{server.address}/docs/swagger-ui-bundle.js").text


def test_nothing_of_it_needs_an_exception_in_its_policy(page: httpx.Response) -> None:
    policy = page.headers["content-security-policy"]
    assert "default-src 'none'" in policy
    assert "unsafe" not in policy
    assert "http" not in policy
    assert not re.search(r"<script[^>]*>[^<]|<style|\sstyle=|\son\w+=", page.text)


def test_files_are_sent_once(server: Server, page: httpx.Response) -> None:
    for path in ("/docs", "/docs/start.js"):
        first = httpx.get(server.address + path)
        assert first.headers["x-content-type-options"] == "nosniff"
        again = httpx.get(server.address + path, headers={"If-None-Match": first.headers["etag"]})
        assert (again.status_code, again.content) == (304, b"")
        assert httpx.head(server.address + path).headers["content-length"] == first.headers["content-length"]


@pytest.mark.parametrize("path", ["/docs/", "/docs/index.html", "/docs/redoc.standalone.js", "/docs/..%2fpage.py"])
def test_there_is_nothing_else(server: Server, path: str) -> None:
    response = httpx.get(server.address + path)
    assert response.status_code == 404
    assert response.json()["type"] == "urn:cow:problem:not-found"
    assert httpx.post(f"{server.address}/docs").status_code == 405
