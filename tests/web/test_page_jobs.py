"""The page in a real browser: jobs from links and from the list, canceled ones, a server that is away or has keys."""

from __future__ import annotations

import json
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from browser import NARROW, Windows, arrow_tip, ask, assert_fits, drop, expect, result, said
from drawn import clutter, png_bytes
from servers import BODY, QUESTION, Served, data_url, picture, slow
from waiting import eventually

from cow_service.api.middleware.access import hash_of, new_key

if TYPE_CHECKING:
    from playwright.sync_api import Page

pytestmark = pytest.mark.slow

UNREAD = "If the unicorn moves to the right, will it hit the blue cube?"
UNREADABLE = data_url(png_bytes(clutter(200, 150)))
LEFT = {"direction": [-1, 0]}


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    with Served(tmp_path_factory.mktemp("page-jobs")) as one:
        yield one


def address(served: Served, path: str = "/") -> str:
    return f"{str(served.http.base_url).rstrip('/')}{path}"


def asked(served: Served, path: str = "/answer", **fields: Any) -> dict[str, Any]:
    """A question's job that has ended."""
    return served.ended(served.submit(BODY | fields, path=path)["id"])


def test_a_link_to_a_job_opens_the_same_view_and_one_to_no_job_says_so(served: Served, windows: Windows) -> None:
    job = asked(served, motion=LEFT, objects=[{"object": "blue cube", "bbox": [170, 60, 205, 98]}])
    page = windows.open(address(served, f"/?job={job['id']}"), NARROW)
    for _ in range(2):
        assert result(page) == job["id"]
        assert said(page) == job["result"]["answer"] == "No"
        assert page.locator("#question").input_value() == QUESTION
        page.get_by_text("Correct what was read").click()
        expect(page.get_by_label("Name of object 1")).to_have_value("blue cube")
        assert arrow_tip(page)[0] < 60
        assert_fits(page)
        page.reload()
    page = windows.open(address(served, "/?job=00000000-0000-0000-0000-000000000000"), NARROW, requests_fail=True)
    expect(page.locator(".notice.problem")).to_contain_text("It was deleted, or belongs to another key.")
    expect(page.get_by_role("button", name="Choose a picture")).to_be_visible()
    assert_fits(page)


def test_a_request_that_changes_nothing_is_asked_again_as_it_was(served: Served, windows: Windows) -> None:
    job = asked(served, interventions=[])
    page = windows.open(address(served, f"/?job={job['id']}"))
    assert result(page) == job["id"]
    with page.expect_request(lambda request: request.method == "POST" and request.url.endswith("/answer")) as sent:
        ask(page, QUESTION)
    assert sent.value.post_data_json["interventions"] == []


def test_cancel_ends_the_job(served: Served, windows: Windows) -> None:
    job = served.submit(slow(60))
    page = windows.open(address(served, f"/?job={job['id']}"))
    expect(page.locator("[data-stage=generation][data-state=now]")).to_be_visible()
    page.get_by_role("button", name="Cancel").click()
    expect(page.locator(".stages")).to_have_count(0)
    assert served.ended(job["id"])["status"] == "canceled"
    assert page.locator(".notice").count() == 0
    expect(page.get_by_role("button", name="Imagine")).to_be_enabled()


def test_the_list_of_jobs(served: Served, windows: Windows) -> None:
    good, bad = (
        asked(served),
        asked(served, "/simulate", image=UNREADABLE, question=UNREAD, grounding=None, motion=None),
    )
    page = windows.open(address(served))
    page.get_by_role("link", name="Jobs").click()
    rows = page.locator(".job")
    expect(rows.filter(has_text="unicorn").locator(".warning")).to_contain_text("Draw a box around the moving object")
    expect_pictures(page, ".job .thumb img")

    page.get_by_label("Status").select_option("failed")
    expect(rows.filter(has=page.locator(".badge.succeeded"))).to_have_count(0)
    expect(rows.filter(has=page.locator(".badge.failed"))).not_to_have_count(0)
    page.get_by_role("button", name=f"Delete: {UNREAD}").click()
    page.get_by_role("button", name=f"Really delete: {UNREAD}").click()
    expect(rows.filter(has_text="unicorn")).to_have_count(0)
    assert served.http.get(f"/jobs/{bad['id']}").status_code == 404

    page.get_by_label("Status").select_option("succeeded")
    page.locator(f".job a[href$='{good['id']}']").click()
    assert result(page) == good["id"]
    page.go_back()
    expect(page.get_by_role("heading", name="Jobs")).to_be_visible()


def expect_pictures(page: Page, selector: str) -> None:
    """Waits until there are two pictures or more, and all are decoded; with a key each is fetched for itself."""
    widths_of = "all => all.map((img) => img.naturalWidth)"
    eventually(lambda: len(found := page.locator(selector).evaluate_all(widths_of)) >= 2 and all(found))


def test_a_server_that_is_killed_and_comes_back(tmp_path: Path, windows: Windows) -> None:
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        port = one.getsockname()[1]
    with Served(tmp_path, COW_PORT=str(port)) as served:
        done, job = asked(served, frames={"count": 4}), served.submit(slow(60))
        page = windows.open(address(served, f"/?job={job['id']}"), requests_fail=True)
        generating = page.locator("[data-stage=generation][data-state=now]")
        expect(generating).to_be_visible()
        served.kill()
        expect(page.locator(".notice.away")).to_be_visible()
        assert page.locator(".result").count() == 0
        served.start()
        expect(page.locator(".notice.away")).to_have_count(0)
        expect(generating).to_be_visible()
        served.http.delete(f"/jobs/{job['id']}")
        expect(page.locator(".stages")).to_have_count(0)  # it goes on with what the new process says
        page.goto(address(served, f"/?job={done['id']}"))  # what had ended before the restart is there, pictures too
        assert (result(page), said(page)) == (done["id"], done["result"]["answer"] or "Not sure")
        expect_pictures(page, ".filmstrip img")


def test_a_server_with_keys(tmp_path: Path, windows: Windows) -> None:
    key = new_key()
    with Served(tmp_path, COW_API_KEYS=json.dumps({"alice": hash_of(key)})) as served:
        page = windows.open(address(served), requests_fail=True)
        dialog = page.get_by_role("dialog")
        expect(dialog).to_be_visible()
        page.get_by_role("textbox", name="API key").fill("cow_wrong")
        page.keyboard.press("Enter")
        expect(dialog.locator(".warning")).to_be_visible()
        page.get_by_role("textbox", name="API key").fill(key)
        page.keyboard.press("Enter")
        expect(dialog).to_have_count(0)

        drop(page, picture())
        ask(page, QUESTION)
        result(page)
        assert said(page) == "Yes"
        expect_pictures(page, ".filmstrip img")
        film = page.locator(".scene video")
        assert eventually(lambda: film.evaluate("film => film.videoWidth")) == 240
        assert key not in page.content()
        kept = "storage => Object.values(storage)"
        assert page.evaluate_handle("sessionStorage").evaluate(kept) == [key]
        assert page.evaluate_handle("localStorage").evaluate(kept) == []
        assert page.context.cookies() == []
        assert key not in page.url

        other = page.context.new_page()  # another tab has no key
        other.goto(page.url)
        expect(other.get_by_role("dialog")).to_be_visible()
