"""A real browser for the tests of the page: Debian's chromium, driven by playwright."""

from __future__ import annotations

import base64
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from http import HTTPStatus
from typing import TYPE_CHECKING, Any

import httpx
import pytest
from waiting import TIME_LIMIT

if TYPE_CHECKING:  # playwright takes long to import: only tests that open a page do
    from playwright.sync_api import Browser, BrowserContext, ConsoleMessage, Page, Response

REQUIRED = "COW_TEST_BROWSER"  # set where a missing browser is a fault and not a reason to skip
HOW_TO_GET_IT = "chromium is not installed: apt-get install --no-install-recommends chromium"
WIDE, NARROW = 1280, 390  # CSS px
SIZES = {WIDE: {"width": WIDE, "height": 900}, NARROW: {"width": NARROW, "height": 844}}
FAILED_REQUEST = "Failed to load resource"  # how chromium tells of a response that is an error, or of none
# The page gets violations of the policy as events; chromium's own messages for them vary.
TELL_VIOLATIONS = """addEventListener("securitypolicyviolation", (event) =>
    console.error(`Content-Security-Policy: ${event.violatedDirective} ${event.blockedURI} ${event.sample}`));"""

WAIT = int(1000 * TIME_LIMIT)  # ms
Point = tuple[float, float]


@contextmanager
def launched() -> Iterator[Browser]:
    """A chromium, ended afterwards. Skips the test where there is none, and fails in CI."""
    program = shutil.which("chromium")
    if program is None:
        if os.environ.get(REQUIRED) or os.environ.get("CI") == "true":
            pytest.fail(HOW_TO_GET_IT)
        pytest.skip(HOW_TO_GET_IT)
    from playwright.sync_api import expect, sync_playwright

    expect.set_options(timeout=WAIT)
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=program, args=["--no-sandbox"])
        yield browser
        browser.close()


def expect(seen: Any) -> Any:
    """Playwright's assertions on a page or an element, which wait until they hold."""
    from playwright.sync_api import expect

    return expect(seen)


def faults_for_some(page: Page) -> list[tuple[str, list[str]]]:
    """What axe-core finds serious or worse. Its script is put into the page: open that with `bypass_csp`."""
    from axe_playwright_python.sync_playwright import Axe

    violations = Axe().run(page).response["violations"]
    serious = [each for each in violations if each["impact"] in ("serious", "critical")]
    return [(each["id"], [node["html"][:200] for node in each["nodes"]]) for each in serious]


class Windows:
    """Pages, each with storage and cache of its own. Errors in them fail the test at the end of the `with` block."""

    def __init__(self, browser: Browser) -> None:
        self._browser = browser
        self._contexts: list[BrowserContext] = []
        self._faults: list[tuple[str, str]] = []  # words, and the address
        self._twice: set[str] = set()  # what the browser deleted again, after its connection had been closed

    def __enter__(self) -> Windows:
        return self

    def __exit__(self, failed: object, *_: object) -> None:
        for context in self._contexts:
            context.close()
        faults = [f"{words} ({url})" for words, url in self._faults if url not in self._twice]
        if failed is None and faults:
            pytest.fail("Errors in the browser:\n" + "\n".join(faults))

    def open(self, address: str, width: int = WIDE, requests_fail: bool = False, **options: Any) -> Page:
        """A page. `requests_fail`: the test has the server refuse something, which chromium logs as an error."""
        context = self._browser.new_context(**{"viewport": SIZES[width], "reduced_motion": "reduce"} | options)
        self._contexts.append(context)
        context.set_default_timeout(WAIT)
        context.add_init_script(TELL_VIOLATIONS)

        def logged(message: ConsoleMessage) -> None:
            if message.type == "error" and not (requests_fail and message.text.startswith(FAILED_REQUEST)):
                self._faults.append((message.text, message.location["url"]))

        def answered(response: Response) -> None:
            if response.request.method == "DELETE" and response.status == HTTPStatus.NOT_FOUND:
                self._twice.add(response.url)

        context.on("console", logged)
        context.on("weberror", lambda error: self._faults.append((str(error.error), "")))
        context.on("response", answered)
        page = context.new_page()
        page.goto(address)
        return page


def got(address: str, path: str) -> Any:
    """What a server answers, as JSON."""
    return httpx.get(f"{address}{path}", timeout=TIME_LIMIT).json()


def drop(page: Page, content: bytes, name: str = "picture.png", media_type: str = "image/png") -> None:
    """Drops a file on the page."""
    make = """([data, name, type]) => {
        const transfer = new DataTransfer();
        transfer.items.add(new File([Uint8Array.from(atob(data), (one) => one.charCodeAt(0))], name, { type }));
        return transfer;
    }"""
    transfer = page.evaluate_handle(make, [base64.b64encode(content).decode(), name, media_type])
    page.dispatch_event("main", "drop", {"dataTransfer": transfer})


def ask(page: Page, question: str) -> None:
    """Types a question and presses Enter."""
    field = page.locator("#question")
    field.fill(question)
    field.press("Enter")


def result(page: Page, before: str | None = None) -> str:
    """The id of the job whose result is shown, once it is another one than `before`."""
    shown = page.locator(".result[data-job]:not(.old)" + (f":not([data-job='{before}'])" if before else ""))
    expect(shown).to_be_visible()
    return shown.get_attribute("data-job") or ""


def said(page: Page) -> str:
    """The answer after looking."""
    return page.locator(".verdict.looked .said").inner_text()


def stage(page: Page, name: str) -> str:
    """What became of a stage: done, kept, now or next."""
    return page.locator(f"[data-stage={name}]").get_attribute("data-state") or ""


def in_window(page: Page, *points: Point) -> list[Point]:
    """Where points of the picture, px of it, are in the window, once it is scrolled to."""
    svg = page.locator(".scene svg")
    svg.scroll_into_view_if_needed()
    to_window = """(svg, points) => points
        .map(([x, y]) => new DOMPoint(x, y).matrixTransform(svg.getScreenCTM())).map(({ x, y }) => [x, y])"""
    return svg.evaluate(to_window, points)


def drag_in_picture(page: Page, start: Point, end: Point) -> None:
    """Drags by the mouse between two points of the picture, px of the picture."""
    from_window, to = in_window(page, start, end)
    page.mouse.move(*from_window)
    page.mouse.down()
    page.mouse.move(*to, steps=4)
    page.mouse.up()


def touch_in_picture(page: Page, *fingers: tuple[Point, Point]) -> None:
    """Drags by one finger or more, each between two points of the picture, px of the picture."""
    ends = [in_window(page, *each) for each in fingers]
    session = page.context.new_cdp_session(page)

    def send(kind: str, share: float) -> None:
        points = [
            {"x": start[0] + share * (end[0] - start[0]), "y": start[1] + share * (end[1] - start[1]), "id": number}
            for number, (start, end) in enumerate(ends)
        ]
        session.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": [] if kind == "touchEnd" else points})
        page.evaluate("() => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")

    send("touchStart", 0.0)
    for step in range(1, 7):
        send("touchMove", step / 6)
    send("touchEnd", 1.0)


def arrow_tip(page: Page) -> Point:
    """Where the handle of the arrow's tip is, px of the picture."""
    knob = page.locator(".handle.tip .knob")
    return float(knob.get_attribute("cx") or 0), float(knob.get_attribute("cy") or 0)


def path(page: Page) -> str:
    """The path of the moving object, as SVG."""
    return page.locator("path.path").first.get_attribute("d") or ""


def assert_fits(page: Page) -> None:
    """The page is no wider than its window."""
    assert page.evaluate("document.documentElement.scrollWidth - innerWidth") <= 0
