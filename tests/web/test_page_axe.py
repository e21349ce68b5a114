"""axe-core finds nothing serious on the page, in each of its states, light and dark."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import pytest
from browser import NARROW, WIDE, Windows, ask, drop, expect, faults_for_some, result
from conftest import Server
from drawn import clutter, png_bytes
from servers import QUESTION, picture

if TYPE_CHECKING:
    from playwright.sync_api import Page

pytestmark = pytest.mark.slow


def start(page: Page) -> None:
    expect(page.get_by_role("button", name="yellow ball")).to_be_visible()


def answer(page: Page) -> None:
    drop(page, picture(7))
    expect(page.locator("#question")).to_have_value("")  # the question about the picture before is gone
    ask(page, QUESTION)
    result(page)
    page.locator("details").evaluate_all("all => all.forEach((details) => { details.open = true; })")


def problem(page: Page) -> None:
    drop(page, png_bytes(clutter(200, 150)))
    ask(page, "If the unicorn moves to the right, will it hit the blue cube?")
    expect(page.locator(".notice.problem")).to_be_visible()


def key_dialog(page: Page) -> None:
    refusal = {"type": "urn:cow:problem:unauthorized", "title": "A key is needed.", "status": 401, "detail": "None."}
    page.route("**/models", lambda route: route.fulfill(status=401, body=json.dumps(refusal)))
    page.reload()
    expect(page.get_by_role("dialog")).to_be_visible()


def jobs(page: Page) -> None:
    page.get_by_role("link", name="Jobs").click()
    expect(page.get_by_text("Reading the jobs…")).to_have_count(0)


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_nothing_serious(server: Server, windows: Windows, scheme: str) -> None:
    width = {"light": WIDE, "dark": NARROW}[scheme]
    page = windows.open(server.address, width, requests_fail=True, bypass_csp=True, color_scheme=scheme)
    for state in (start, problem, answer, jobs, key_dialog):
        state(page)
        assert faults_for_some(page) == [], state.__name__
