"""The page in a real browser, with a server that sees: things under the pointer, chips, and the floor as a grid."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from browser import (
    NARROW,
    WIDE,
    Point,
    Windows,
    ask,
    assert_fits,
    drag_in_picture,
    drop,
    expect,
    faults_for_some,
    in_window,
    result,
    said,
)
from conftest import Server
from servers import QUESTION, SEEING, Served, picture

if TYPE_CHECKING:
    from playwright.sync_api import Page, Request, Route

pytestmark = pytest.mark.slow

BALL, CUBE, BARE = (63, 80), (187, 85), (20, 20)  # of a picture that is shifted by 3 px


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    with Served(tmp_path_factory.mktemp("page-look"), **SEEING) as one:
        yield one


def body_of(request: Request) -> dict[str, Any]:
    """The body of a request as JSON; empty for a form."""
    body = request.post_data if "json" in request.headers.get("content-type", "") else None
    return json.loads(body) if body else {}


class Seen:
    """A page with a picture, and what it asks the server for."""

    def __init__(self, address: str, windows: Windows, width: int = WIDE, **options: Any) -> None:
        self.page = windows.open(address, width, **options)
        self.requests: list[tuple[str, dict[str, Any]]] = []
        self.in_flight, self.most_in_flight = 0, 0  # looks at points
        self.page.on("request", self._note)
        self.page.on("requestfinished", self._note_end)
        drop(self.page, picture(3))
        expect(self.page.locator(".scene rect.body")).to_have_count(2)

    def _note(self, request: Request) -> None:
        if request.method == "POST":
            self.requests.append((request.url.rsplit("/", 1)[1], body_of(request)))
            self.in_flight += "point" in body_of(request)
            self.most_in_flight = max(self.most_in_flight, self.in_flight)

    def _note_end(self, request: Request) -> None:
        self.in_flight -= "point" in body_of(request)

    def asked(self, path: str, field: str) -> list[Any]:
        """What the requests to a path had in a field."""
        return [body[field] for at, body in self.requests if at == path and field in body]

    def at(self, point: Point) -> Point:
        """A point of the picture, in the window."""
        return in_window(self.page, point)[0]

    @property
    def request(self) -> dict[str, Any]:
        """The request on the screen, as the page would have others send it."""
        take = self.page.locator("details.take")
        if take.get_attribute("open") is None:
            take.locator("summary").click()
        take.get_by_role("button", name="JSON").click()
        return json.loads(take.locator("pre").text_content() or "")


@pytest.fixture
def seen(served: Served, windows: Windows) -> Seen:
    return Seen(str(served.http.base_url), windows)


def test_the_pointer_lights_what_is_under_it(seen: Seen) -> None:
    lit, looks = seen.page.locator("image.lit"), lambda: len(seen.asked("look", "point"))
    for step in range(12):
        seen.page.mouse.move(*seen.at((BALL[0] - 6 + step, BALL[1])))
    expect(lit).to_have_count(1)
    ball = lit.get_attribute("href") or ""
    assert (count := looks()) <= 2  # all further points lie in the mask that is lit
    seen.page.mouse.move(*seen.at((BALL[0], BALL[1] + 5)))
    seen.page.mouse.move(*seen.at(CUBE))
    expect(lit).not_to_have_attribute("href", ball)
    assert looks() == count + 1
    for step in range(40):  # on the bare floor nothing is lit, so all points are new
        seen.page.mouse.move(*seen.at((BARE[0] + step, BARE[1])))
    expect(lit).to_have_count(0)
    expect(seen.page.get_by_text("Nothing was found here: draw a box.")).to_be_visible()
    assert looks() > count + 1
    assert seen.most_in_flight == 1  # where the pointer was while another point was asked about is left out


def test_without_a_segmenter_the_small_network_sees(server: Server, windows: Windows) -> None:
    seen = Seen(server.address, windows)
    seen.page.mouse.move(*seen.at(BALL))
    expect(seen.page.locator("image.lit")).to_have_count(1)
    seen.page.mouse.move(*seen.at(BARE))
    expect(seen.page.get_by_text("Nothing was found here: draw a box.")).to_be_visible()
    seen.page.mouse.click(*seen.at(BALL))
    expect(seen.page.locator("rect.mover")).to_have_count(1)
    seen.page.locator("#question").fill(QUESTION)
    assert seen.request["grounding"]["mask"].startswith("data:image")


def test_clicks_take_what_is_there_or_a_box_is_drawn(seen: Seen) -> None:
    page = seen.page
    page.mouse.click(*seen.at(BARE))
    expect(page.get_by_role("button", name="What moves", exact=True)).to_have_attribute("aria-pressed", "true")
    expect(page.get_by_text("Nothing was found here: draw a box.")).to_be_visible()
    drag_in_picture(page, (10, 10), (40, 40))
    expect(page.locator("rect.mover")).to_have_attribute("width", "30")
    page.locator("#question").fill(QUESTION)
    assert seen.request["grounding"] == {"bbox": [10, 10, 40, 40]}

    page.mouse.click(*seen.at(CUBE))
    expect(page.get_by_text("Click again for another of the 2 objects")).to_be_visible()
    whole = seen.request["grounding"]["mask"]
    page.mouse.click(*seen.at(CUBE))
    expect(page.locator("rect.mover")).to_have_attribute("y", "69")
    assert seen.request["grounding"]["mask"] not in (None, whole)
    page.mouse.click(*seen.at(BALL))
    expect(page.locator("rect.mover")).to_have_attribute("x", "45")
    ask(page, QUESTION)
    result(page)
    (sent,) = seen.asked("answer", "grounding")
    assert sent["mask"].startswith("data:image/png;base64,")
    assert "bbox" not in sent  # a request takes one of them

    page.get_by_role("button", name="Another object", exact=True).click()
    page.mouse.click(*seen.at(CUBE))
    page.get_by_label("What is in the box?").fill("crate")
    page.keyboard.press("Enter")
    assert ("crate", "data:image") in [(each["object"], each["mask"][:10]) for each in seen.request["objects"]]


def test_what_the_question_names_is_shown_and_taken(seen: Seen) -> None:
    chips = seen.page.get_by_role("list", name="Objects found: choose the moving one").get_by_role("button")
    seen.page.locator("#question").press_sequentially(QUESTION, delay=5)
    expect(chips).to_have_text(["red ball", "blue cube"])
    assert seen.asked("look", "question") == [QUESTION]
    chips.first.focus()
    expect(seen.page.locator("image.lit")).to_have_count(1)
    chips.first.click()
    expect(chips.first).to_have_attribute("aria-pressed", "true")
    seen.page.get_by_role("button", name="Ask", exact=True).click()
    result(seen.page)
    assert said(seen.page) == "Yes"  # the cube that it asks about was given, too
    (sent,) = seen.asked("answer", "grounding")
    assert (sent["object"], sent["mask"][:10]) == ("red ball", "data:image")
    assert len(seen.asked("look", "question")) == 1

    seen.page.locator("#question").fill("If the red ball moves to the right, will it hit the ghost?")
    chips.filter(has_text="ghost").hover()
    expect(seen.page.locator("rect.lit.unsure")).to_have_count(1)


def test_a_server_that_forgets_the_picture_is_sent_it_again(served: Served, windows: Windows) -> None:
    seen = Seen(str(served.http.base_url), windows, requests_fail=True)
    page, forgets = seen.page, {"type": "urn:cow:problem:artifact-not-found", "title": "Gone.", "detail": "Gone."}
    page.mouse.move(*seen.at(BARE))
    expect(page.get_by_text("Nothing was found here: draw a box.")).to_be_visible()  # the picture is there
    uploads = len([body for path, body in seen.requests if path == "look" and not body])
    replies = iter([json.dumps(forgets)])

    def forget_once(route: Route) -> None:  # `times=1` can lose the request that comes while the route is removed
        reply = next(replies, None)
        route.continue_() if reply is None else route.fulfill(status=404, body=reply)

    page.route("**/look", forget_once)
    page.mouse.move(*seen.at(BALL))
    expect(page.locator("image.lit")).to_have_count(1)
    assert len([body for path, body in seen.requests if path == "look" and not body]) == uploads + 1


def floor_of(page: Page) -> tuple[float, str]:
    """The pitch that the floor shows, degrees, and its lines."""
    return float(page.get_by_role("slider", name="Floor").get_attribute("aria-valuenow") or "nan"), (
        page.locator(".floor .lines").get_attribute("d") or ""
    )


@pytest.fixture
def blind(tmp_path: Path) -> Iterator[Served]:
    with Served(tmp_path, COW_PERCEPTION="none") as one:
        yield one


def test_without_models_boxes_are_drawn_and_the_floor_is_dragged(blind: Served, windows: Windows) -> None:
    seen = Seen(str(blind.http.base_url), windows, bypass_csp=True)
    page = seen.page
    page.mouse.move(*seen.at(BALL))
    page.mouse.click(*seen.at(BALL))
    page.locator("#question").fill(QUESTION)
    page.get_by_role("button", name="What moves", exact=True).click()
    drag_in_picture(page, (45, 62), (81, 98))
    expect(page.locator("rect.mover")).to_have_attribute("width", "36")
    page.get_by_role("button", name="Ask", exact=True).click()
    first = result(page)  # by then the page has long seen that the typing is over
    assert [path for path, _ in seen.requests if path == "look"] == [], "no model: nobody looks"
    page.get_by_label("Floor", exact=True).check()
    pitch, lines = floor_of(page)
    drag_in_picture(page, (120, 140), (150, 120))
    second = result(page, before=first)
    assert (corrected := floor_of(page))[0] > pitch + 1
    assert corrected[1] != lines
    assert [each["pitch"] for each in seen.asked("answer", "camera")] == [corrected[0]]

    page.get_by_role("slider", name="Floor").focus()
    page.keyboard.press("Shift+ArrowDown")
    expect(page.locator(".floor text.name")).to_contain_text("°")
    third = result(page, before=second)
    assert floor_of(page)[0] < corrected[0] - 1
    assert faults_for_some(page) == []
    page.get_by_role("button", name="Reset the camera").click()
    result(page, before=third)
    assert floor_of(page)[0] == pitch
    assert "camera" not in seen.request


def test_what_is_seen_is_for_everybody(served: Served, windows: Windows) -> None:
    """A tap lights and takes; axe-core finds nothing serious where chips are shown and something is lit."""
    options = {"bypass_csp": True, "color_scheme": "dark", "has_touch": True}
    seen = Seen(str(served.http.base_url), windows, NARROW, **options)
    seen.page.touchscreen.tap(*seen.at(BALL))
    expect(seen.page.locator("rect.mover")).to_have_attribute("x", "45")
    assert len(seen.asked("look", "point")) == 1
    seen.page.locator("#question").fill(QUESTION)
    seen.page.locator(".chips button").first.focus()
    seen.page.touchscreen.tap(*seen.at(CUBE))
    expect(seen.page.get_by_text("Click again for another")).to_be_visible()
    assert faults_for_some(seen.page) == []
    assert_fits(seen.page)
