"""`GET /docs` on a real server: it loads nothing from elsewhere, and holds no script that its policy would stop."""

from __future__ import annotations

import re

import httpx
import pytest

pytestmark = pytest.mark.slow
FILES = ("docs/swagger-ui.css", "docs/docs.css", "docs/swagger-ui-bundle.js", "docs/start.js")


def test_the_page_loads_what_the_server_has_and_needs_no_exception_in_its_policy(http: httpx.Client) -> None:
    page = http.get("/docs")
    loaded = re.findall(r'(?:src|href)="([^"]+)"', page.text)
    assert sorted(loaded) == sorted([*FILES, "data:,", "openapi.json"])
    assert {http.get(f"/{name}").status_code for name in FILES} == {200}
    assert "SwaggerUIBundle" in http.get("/docs/swagger-ui-bundle.js").text
    policy = page.headers["content-security-policy"]
    assert "default-src 'none'" in policy
    assert not re.search("unsafe|http", policy)
    assert not re.search(r"<script[^>]*>[^<]|<style|\sstyle=|\son\w+=", page.text)
