"""Questions, names, reasons and files on the page are text, whatever they contain; and the code to take along works."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import httpx
import pytest
from browser import NARROW, Windows, ask, assert_fits, drag_in_picture, drop, expect, result
from conftest import Server
from drawn import clutter, png_bytes
from servers import ASYNC, BODY, QUESTION, TERMINAL, picture
from tables import rows
from waiting import eventually

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

pytestmark = pytest.mark.slow

MARKUP = '<img src=x onerror="document.title=1"><script>document.title=2</script>'
TEXTS = rows(
    core={
        "markup": MARKUP,
        "right to left": "إذا تحركت الكرة الحمراء إلى اليمين، هل ستصطدم بالمكعب الأزرق؟ (hit?)",
    },
    rest=["W" * 4000, "which " * 600, "👩‍👩‍👧‍👦🐄🏳️‍🌈 → ⚽️ 💥?"],
)
HARD_TO_QUOTE = """It's the "red ball": \\n $HOME `date` {x} %s; ü"""


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
    made = httpx.post(f"{server.address}/answer", json=request, headers=ASYNC).json()
    eventually(lambda: httpx.get(f"{server.address}/jobs/{made['id']}").json()["status"] in TERMINAL)
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
    expect(page.locator(".notice.problem")).to_contain_text("Looked for")
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


def newest(server: Server) -> dict[str, object]:
    """The request of the newest job."""
    job_id = httpx.get(f"{server.address}/jobs", params={"limit": 1}).json()["jobs"][0]["id"]
    return httpx.get(f"{server.address}/jobs/{job_id}/request").json()["request"]


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
        assert json.loads(run.stdout)["answer"]
