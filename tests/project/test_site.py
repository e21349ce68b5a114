"""The site that `make site` builds: it needs no network, its links lead somewhere, its reference is whole, scenes play.

The gallery has one scene of each kind here, and all of them in `make soak`.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Iterator
from html import unescape
from html.parser import HTMLParser
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import pytest
import yaml
from browser import Windows, expect
from conftest import ROOT, SCALE, made_once
from typer import Context
from typer.main import get_command

from cow_service import errors
from cow_service.cli.main import app
from cow_service.settings import Settings

pytestmark = [pytest.mark.slow, pytest.mark.timeout(300)]
LOADS = {("script", "src"), ("img", "src"), ("iframe", "src"), ("video", "src"), ("video", "poster"), ("link", "href")}


class Links(HTMLParser):
    """What a page loads, where it leads, and its anchors."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.loads, self.leads, self.anchors = set[str](), set[str](), {""}
        self.feed(path.read_text())

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        for name, value in attrs:
            if name in ("id", "name") and value:
                self.anchors.add(value)
            elif (tag, name) in LOADS and value and dict(attrs).get("rel") not in ("canonical", "prev", "next"):
                self.loads.add(value)
            elif ((tag, name) == ("a", "href") or name == "data-world") and value:
                self.leads.add(value)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    def build(folder: Path) -> None:
        environment = os.environ | {"NO_MKDOCS_2_WARNING": "1", "COW_GALLERY": "1" if SCALE == 1 else "6"}
        command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(folder / "site")]
        built = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
        assert built.returncode == 0, built.stdout + built.stderr

    return made_once(tmp_path_factory, "site", build) / "site"


@pytest.fixture(scope="module")
def pages(site: Path) -> dict[Path, Links]:
    return {path: Links(path) for path in sorted(site.rglob("*.html"))}


def text_of(page: Path) -> str:
    return unescape(re.sub(r"<[^>]+>", "", page.read_text()))


def test_nothing_is_loaded_from_elsewhere_and_links_lead_somewhere(site: Path, pages: dict[Path, Links]) -> None:
    for path, links in pages.items():
        stands_everywhere = path.name == "404.html"
        for target in links.loads:
            assert not re.match(r"(\w+:)?//", target), f"{path.name}: {target}"
            assert stands_everywhere or target.startswith("data:") or (path.parent / target).exists(), target
        for target in () if stands_everywhere else links.leads:
            if not re.match(r"[a-z]+:", target):
                name, _, anchor = target.partition("#")
                led = (path.parent / unquote(name)).resolve() if name else path
                assert led.is_file(), f"{path.name}: {target}"
                assert not anchor or unquote(anchor) in pages[led].anchors, f"{path.name}: {target}"
    for path in site.rglob("*.css"):
        assert not re.search(r"url\(['\"]?(https?:)?//|@import", path.read_text()), path
    for path in (ROOT / "docs").rglob("*.md"):
        page = (site / path.relative_to(ROOT / "docs")).with_suffix(".html").read_text()
        assert not re.search(r"<p>[^<]*\n([-*]|\d+\.) ", page), f"{path.name}: a list needs an empty line"


def test_the_reference_has_every_endpoint_record_setting_error_and_call(site: Path, pages: dict[Path, Links]) -> None:
    api = yaml.safe_load((ROOT / "openapi.yaml").read_text())
    text = text_of(site / "http.html")
    for path, methods in api["paths"].items():
        for method, call in methods.items():
            assert f"{method.upper()} {path}" in text
            assert all(parameter["name"] in text for parameter in call.get("parameters", ()))
    anchors = {name: pages[site / f"{name}.html"].anchors for name in ("records", "settings", "errors", "sdk")}
    assert {name.lower() for name in api["components"]["schemas"]} <= anchors["records"]
    assert {f"cow_{name}" for name in Settings.model_fields} <= anchors["settings"]
    assert set(errors.kinds()) <= anchors["errors"]
    assert {f"cow_service.client.sync_client.Client.{name}" for name in ("simulate", "answer", "map")} <= anchors["sdk"]
    text = " ".join(text_of(site / "settings.html").split())
    for name, field in Settings.model_fields.items():
        assert f"COW_{name.upper()}" in text
        assert " ".join((field.description or "?").replace("`", "").split()) in text
    assert ">>>" not in re.sub(r"<pre.*?</pre>", "", (site / "sdk.html").read_text(), flags=re.DOTALL)


def commands(command: Any, name: str) -> Iterator[tuple[str, Any]]:
    for word, below in getattr(command, "commands", {}).items():
        if not below.hidden:
            yield f"{name} {word}", below
            yield from commands(below, f"{name} {word}")


def test_the_reference_has_every_command_and_option(site: Path) -> None:
    found = re.split(r'<h2 id="(cow-[\w-]+)">', (site / "cli.html").read_text())
    sections = dict(zip(found[1::2], found[2::2], strict=True))
    for name, command in commands(get_command(app), "cow"):
        if name.replace(" ", "-") not in sections:
            assert command.commands, name  # it only has others below it
            continue
        for parameter in command.get_params(Context(command))[:-1]:  # without --help
            for option in parameter.opts:
                assert option.startswith("-") is False or option in sections[name.replace(" ", "-")], (name, option)


def test_search_finds_without_a_network(site: Path, windows: Windows) -> None:
    page = windows.open((site / "index.html").as_uri(), offline=True)
    page.get_by_role("textbox", name="Search").fill("COW_MLLM_BUDGET")
    page.locator(".md-search-result__item a[href*='/settings.html']").first.click()
    page.wait_for_url("**/settings.html**")


def test_scenes_play_and_answer_a_drag_without_a_network(site: Path, windows: Windows) -> None:
    page = windows.open((site / "gallery.html").as_uri(), offline=True, reduced_motion="no-preference")
    scenes = page.locator(".scene")
    assert scenes.count() == (6 if SCALE == 1 else 20)
    for number in range(scenes.count()):
        scene = scenes.nth(number)
        scene.scroll_into_view_if_needed()
        if not scene.get_attribute("data-world"):
            film = scene.locator("video")
            page.wait_for_function("film => film.currentTime > 0", arg=film.element_handle())
            continue
        world = scene.frame_locator("iframe")
        path, tip = world.locator("path.path").first, world.get_by_role("button")
        expect(path).to_have_attribute("d", re.compile("M.*L"))
        before, box = path.get_attribute("d"), tip.bounding_box()
        assert box is not None
        x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
        page.mouse.move(x, y)
        page.mouse.down()
        page.mouse.move(x - 15, y + 40, steps=3)
        page.mouse.up()
        expect(path).not_to_have_attribute("d", before or "")
    assert page.locator("iframe").count() < max(scenes.count(), 6), "those out of sight are ended"
