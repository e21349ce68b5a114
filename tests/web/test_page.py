"""The page in a real browser: ask, see, correct by dragging and by keyboard; texts stay texts; code to take along."""

from __future__ import annotations

import io
import json
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import httpx
import pytest
from browser import (
    NARROW,
    SIZES,
    WIDE,
    Windows,
    arrow_tip,
    ask,
    assert_fits,
    drag_in_picture,
    drop,
    expect,
    faults_for_some,
    got,
    in_window,
    path,
    result,
    said,
    stage,
    touch_in_picture,
)
from conftest import Server
from drawn import clutter, png_bytes
from PIL import Image
from servers import ASYNC, BODY, QUESTION, TERMINAL, picture
from tables import rows
from waiting import TIME_LIMIT, eventually

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page, Request

pytestmark = pytest.mark.slow

FIRST_VIEW_BYTES = 150_000
FROM_MOTION_ON = ("motion", "trajectory", "generation", "answering")
MARKUP = '<img src=x onerror="document.title=1"><script>document.title=2</script>'
TEXTS = rows(
    core={
        "markup": MARKUP,
        "right to left": "إذا تحركت الكرة الحمراء إلى اليمين، هل ستصطدم بالمكعب الأزرق؟ (hit?)",
    },
    rest=["W" * 4000, "which " * 600, "👩‍👩‍👧‍👦🐄🏳️‍🌈 → ⚽️ 💥?"],
)
HARD_TO_QUOTE = """It's the "red ball": \\n $HOME `date` {x} %s; ü"""


def test_dragging_the_arrow_changes_path_and_answer(server: Server, windows: Windows) -> None:
    page = windows.open(server.address)
    drop(page, picture(1))
    ask(page, QUESTION)
    first, at_first = result(page), path(page)
    assert said(page) == "Yes"
    assert_fits(page)

    drag_in_picture(page, arrow_tip(page), (61, 10))
    dragged = result(page, before=first)
    assert said(page) == "No"
    assert path(page) != at_first
    assert stage(page, "grounding") == "kept"
    assert {name: stage(page, name) for name in FROM_MOTION_ON} == dict.fromkeys(FROM_MOTION_ON, "done")

    page.get_by_role("button", name="Undo").click()
    result(page, before=dragged)
    assert said(page) == "Yes"
    assert path(page) == at_first
    assert {stage(page, name) for name in FROM_MOTION_ON} == {"kept"}
    page.get_by_role("button", name="Redo").click()
    expect(page.locator(".verdict.looked .said")).to_have_text("No")


def test_everything_is_corrected_by_touch(server: Server, windows: Windows) -> None:
    page = windows.open(server.address, NARROW, has_touch=True, is_mobile=True)
    drop(page, picture(41))
    ask(page, QUESTION)
    first, at_first = result(page), path(page)
    assert said(page) == "Yes"
    knob = page.locator(".handle.waypoint .knob").last
    way = float(knob.get_attribute("cx") or 0), float(knob.get_attribute("cy") or 0)
    in_window(page, way)
    scrolled = page.evaluate("scrollY")
    touch_in_picture(page, (way, (way[0], way[1] + 40)))
    second = result(page, before=first)
    assert path(page) != at_first
    expect(page.get_by_text("You changed the path.")).to_be_attached()

    touch_in_picture(page, (arrow_tip(page), (101, 10)))
    third = result(page, before=second)
    assert said(page) == "No"
    assert page.evaluate("scrollY") == scrolled

    page.get_by_role("button", name="What moves", exact=True).tap()
    touch_in_picture(page, ((165, 55), (210, 102)))
    result(page, before=third)
    touch_in_picture(page, ((225, 150), (225, 60)))
    assert page.evaluate("scrollY") > scrolled, "beside handles the page scrolls"
    touch_in_picture(page, ((110, 140), (20, 140)), ((130, 140), (230, 140)))
    assert page.evaluate("visualViewport.scale") > 1.2, "two fingers zoom"


def test_a_question_is_built_of_what_was_found_and_suggested_where_none_is_understood(
    server: Server, windows: Windows
) -> None:
    page = windows.open(server.address)
    drop(page, picture(7))
    expect(page.get_by_role("list", name="Suggestions")).to_be_visible()
    page.get_by_text("Build a question").click()
    builder = page.locator(".builder")
    builder.get_by_label("If the").select_option("red object")
    builder.get_by_label("does what?").select_option("is thrown")
    builder.get_by_label("which way?").select_option("towards the blue object")
    builder.get_by_role("button", name="Take this question").click()
    asked = "If the red object is thrown towards the blue object, will it hit the blue object?"
    expect(page.locator("#question")).to_have_value(asked)

    ask(page, "Wird der rote Ball den Würfel treffen?")
    notice = page.locator(".notice.problem")
    expect(notice).to_contain_text("it reads English")
    expect(notice).not_to_contain_text("grounding")
    instead = page.get_by_role("list", name="Suggested questions").get_by_role("button")
    expect(instead.first).to_contain_text("If the ")
    instead.first.click()
    result(page)
    expect(notice).to_have_count(0)


@pytest.mark.parametrize(("kind", "side"), [("BMP", 240), ("PNG", 6100)])
def test_pictures_that_the_server_does_not_take_are_sent_as_jpeg(
    server: Server, windows: Windows, kind: str, side: int
) -> None:
    made, asked = io.BytesIO(), QUESTION.replace("cube", f"cube of {side} px")
    with Image.open(io.BytesIO(picture(43))) as opened:
        opened.resize((side, side * opened.height // opened.width)).save(made, kind, compress_level=1)
    page = windows.open(server.address)
    drop(page, made.getvalue(), f"picture.{kind.lower()}", f"image/{kind.lower()}")
    ask(page, asked)
    sent = eventually(lambda: request if (request := newest(server)).get("question") == asked else None)
    jpeg = httpx.get(f"{server.address}/artifacts/{sent['image']['artifact']}", timeout=TIME_LIMIT)
    assert jpeg.headers["content-type"] == "image/jpeg"
    with Image.open(io.BytesIO(jpeg.content)) as opened:
        assert opened.width == (side if kind == "BMP" else pytest.approx(12e6**0.5 * 1.5**0.5, abs=1))


def test_what_was_not_found_is_drawn(server: Server, windows: Windows) -> None:
    page = windows.open(server.address)
    drop(page, png_bytes(clutter(400, 300)), "photo.png")
    ask(page, "If the toy car moves, will it hit the wooden crate?")
    notice = page.locator(".notice.problem")
    expect(notice).to_contain_text("toy car")
    expect(notice).not_to_contain_text("grounding")
    assert page.locator(".mark").count() == 0

    notice.get_by_role("button", name="Draw its box").click()
    drag_in_picture(page, (40, 120), (90, 170))
    expect(notice).to_contain_text("direction")
    page.get_by_role("button", name="Another object", exact=True).click()
    drag_in_picture(page, (150, 90), (230, 175))
    page.get_by_label("What is in the box?").fill("wooden crate")
    page.keyboard.press("Enter")
    expect(page.get_by_label("What wooden crate is")).to_have_value("target")
    notice.get_by_role("button", name="Draw the direction").click()
    drag_in_picture(page, (65, 145), (165, 145))

    met = page.locator(".mark.touches")
    expect(met).to_have_attribute("title", re.compile("hits wooden crate"))
    expect(notice).to_have_count(0)
    assert said(page) == "Yes"


def test_the_film_plays_in_step_with_its_overlay(server: Server, windows: Windows) -> None:
    page = windows.open(server.address, reduced_motion="no-preference")
    # Slowly: it is still under way when it is stopped.
    page.evaluate("addEventListener('play', (event) => { event.target.playbackRate = 0.1; }, true)")
    drop(page, picture(3))
    ask(page, QUESTION)
    trajectory = got(server.address, f"/jobs/{result(page)}")["result"]["simulation"]["trajectory"]
    points, fps = trajectory["paths"][0]["points"], trajectory["fps"]

    def shown() -> tuple[int, int, list[float]]:
        """The frames of the film and of the slider, and where the overlay says that the object is."""
        time, frame, now = page.evaluate("""() => [document.querySelector(".scene video").currentTime,
            document.querySelector(".transport input").value,
            ["cx", "cy"].map((name) => document.querySelector("circle.now").getAttribute(name))]""")
        return int(time * fps + 0.01), int(frame), [float(each) for each in now]

    slider = page.get_by_label("Frame of the clip")
    expect(slider).not_to_have_value("0")  # it plays by itself
    page.get_by_role("button", name="Pause").click()
    expect(page.locator(".handle.tip")).to_be_visible()  # what can be corrected is shown while the film stands still
    film, frame, now = eventually(lambda: found if (found := shown())[0] == found[1] else None)
    assert 0 < film == frame < len(points) - 1
    assert now == pytest.approx(points[frame])

    page.locator(".mark.touches").first.click()
    first_touch = min(met["first_frame"] for met in trajectory["encounters"])
    expect(slider).to_have_value(str(first_touch))
    assert shown() == (first_touch, first_touch, pytest.approx(points[first_touch]))


def test_keyboard_alone(server: Server, windows: Windows) -> None:
    page = windows.open(server.address)
    page.get_by_role("button", name=re.compile("yellow ball")).wait_for()
    tab_to(page, ".examples button")
    page.keyboard.press("Enter")
    expect(page.locator("#question")).to_be_focused()
    page.keyboard.press("Enter")
    first = result(page)
    aimed = arrow_tip(page)
    tab_to(page, ".handle.tip")
    for _ in range(3):
        page.keyboard.press("Shift+ArrowUp")
    result(page, before=first)
    assert arrow_tip(page)[1] < aimed[1] - 20
    assert (stage(page, "grounding"), stage(page, "trajectory")) == ("kept", "done")


def tab_to(page: Page, selector: str) -> None:
    """Presses Tab until an element of these has the focus."""
    for _ in range(80):
        page.keyboard.press("Tab")
        if page.evaluate("selector => document.activeElement.matches(selector)", selector):
            return
    pytest.fail(f"The Tab key does not reach {selector}.")


def newest(server: Server) -> dict[str, Any]:
    """The request of the newest job."""
    for job in got(server.address, "/jobs?limit=1")["jobs"]:
        told = got(server.address, f"/jobs/{job['id']}/request")
        return told.get("request", {})  # of one that was just deleted there is none
    return {}


def test_the_first_view_is_light(server: Server, windows: Windows) -> None:
    page = windows.open("about:blank")
    requests: list[Request] = []
    page.on("requestfinished", lambda request: requests.append(request))  # noqa: PLW0108 (it takes no builtin)
    page.goto(server.address, wait_until="networkidle")
    sizes = [request.sizes() for request in requests]
    parts = ("requestHeadersSize", "requestBodySize", "responseHeadersSize", "responseBodySize")
    sent = {request.url: sum(size[part] for part in parts) for request, size in zip(requests, sizes, strict=True)}
    assert len([url for url in sent if url.startswith(server.address)]) > 10
    assert sum(sent.values()) <= FIRST_VIEW_BYTES, sent
    assert {url for url in sent if not url.startswith(server.address)} == set()


# --- in each of its states, light and dark


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


def test_axe_finds_nothing_serious(server: Server, windows: Windows) -> None:
    page = windows.open(server.address, requests_fail=True, bypass_csp=True)
    for state in (start, problem, answer, jobs, key_dialog):
        state(page)
        for scheme, width in (("light", WIDE), ("dark", NARROW)):
            page.emulate_media(color_scheme=scheme)
            page.set_viewport_size(SIZES[width])
            assert faults_for_some(page) == [], (state.__name__, scheme)


# --- questions, names, reasons and files are text, whatever they contain


def no_markup(page: Page, title: str) -> None:
    """Nothing of a text became an element, or ran."""
    assert page.locator("img[src=x]").count() == 0
    assert page.locator("#app script").count() == 0
    assert page.title() == title
    assert_fits(page)


@pytest.mark.parametrize("text", TEXTS)
def test_questions_and_names_are_text(server: Server, windows: Windows, text: str) -> None:
    name = text[:200].strip()
    request = BODY | {
        "question": text,
        "grounding": {"object": name, "bbox": [42, 62, 78, 98]},
        "objects": [{"object": f"{name[:190]} 2", "bbox": [170, 60, 205, 98], "role": "obstacle"}],
        "options": [text[:100], "No"],
    }
    made = httpx.post(f"{server.address}/answer", json=request, headers=ASYNC, timeout=TIME_LIMIT).json()
    eventually(lambda: got(server.address, f"/jobs/{made['id']}")["status"] in TERMINAL)
    page = windows.open(f"{server.address}/?job={made['id']}", NARROW)
    title = page.title()
    assert result(page) == made["id"]
    page.get_by_text("Correct what was read").click()
    field = page.locator("#question")
    assert field.input_value() == text
    assert field.evaluate("field => getComputedStyle(field).direction") == ("rtl" if "ذ" in text else "ltr")
    expect(page.get_by_label("Name of the moving object")).to_have_value(name)
    expect(page.locator("text.name.mover")).to_have_text(name if len(name) <= 36 else f"{name[:35]}…")
    no_markup(page, title)
    page.get_by_role("link", name="Jobs").click()
    expect(page.locator(f".job a[href$='{made['id']}']")).to_contain_text(text[:150].strip())
    no_markup(page, title)


def test_names_of_files_and_names_that_are_typed_are_text(server: Server, windows: Windows) -> None:
    page = windows.open(server.address, NARROW)
    title = page.title()
    drop(page, MARKUP.encode(), f"{MARKUP}.png")
    expect(page.locator(".notice.problem")).to_contain_text(f"“{MARKUP}.png” is no picture")
    no_markup(page, title)
    drop(page, png_bytes(clutter(200, 150)))
    ask(page, f"If the {MARKUP} moves to the right, will it hit the cube?")
    expect(page.locator(".notice.problem")).to_contain_text("What moves is not clear")
    no_markup(page, title)
    page.get_by_role("button", name="Another object", exact=True).click()
    drag_in_picture(page, (120, 40), (160, 90))
    page.get_by_label("What is in the box?").fill(MARKUP)
    page.keyboard.press("Enter")
    expect(page.locator("text.name.own")).to_have_text(f"{MARKUP[:35]}…")
    no_markup(page, title)


@pytest.fixture(scope="module")
def codes(server: Server, chromium: Browser) -> dict[str, str]:
    """The request of a page as curl, Python and JSON."""
    with Windows(chromium) as opened:
        page = opened.open(server.address)
        drop(page, picture(5), "it's a photo.png")
        ask(page, QUESTION)
        result(page)
        page.get_by_label("Law").select_option("ballistic")
        page.get_by_role("button", name="Ask").wait_for()
        page.locator("#question").fill(f"{QUESTION} {HARD_TO_QUOTE}")
        page.get_by_text("Take it along").click()
        texts = {}
        for name in ("curl", "Python", "JSON"):
            page.get_by_role("group", name="Form of the request").get_by_role("button", name=name).click()
            texts[name] = page.locator(".code pre").text_content() or ""
        return texts


@pytest.mark.parametrize("form", ["Python", "curl"])
def test_the_code_asks_the_same(server: Server, codes: dict[str, str], tmp_path: Path, form: str) -> None:
    (tmp_path / "it's a photo.png").write_bytes(picture(5))
    program = {"Python": [sys.executable, "-c"], "curl": ["bash", "-c"]}[form]
    if form == "curl" and shutil.which("curl") is None:
        pytest.skip("curl is not installed: apt-get install curl")
    run = subprocess.run([*program, codes[form]], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    asked, told = newest(server), json.loads(codes["JSON"])
    assert (told["question"], told["motion"]["law"]) == (f"{QUESTION} {HARD_TO_QUOTE}", "ballistic")
    assert told.pop("image") == asked["image"]
    assert {name: asked.get(name) for name in told} == told
    if form == "Python":
        assert (tmp_path / "out").is_dir()
    else:
        assert json.loads(run.stdout)["status"] == "succeeded"
