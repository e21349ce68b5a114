"""The world that moves while you drag: the page's physics against the server's, and what a drag shows."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator
from itertools import count, pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import httpx
import pytest
from browser import Windows, arrow_tip, ask, drag_in_picture, drop, expect, got, in_window, result, said
from conftest import EXAMPLES, Server
from live_worlds import LOAD, RUN, given_again
from servers import QUESTION, picture
from tables import rows
from waiting import TIME_LIMIT

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page, Route

pytestmark = pytest.mark.slow

SHIFTS = count(31)  # of the pictures: each is another one
WITHIN = 0.02  # of the picture's width: paths differ by less


def posted(server: Server, name: str, **request: Any) -> dict[str, Any]:
    """The result of an example's picture and question, without a film."""
    folder, body = EXAMPLES / name, {"video": False, "frames": {"count": 1}} | request
    files = {"image": ("image.jpg", (folder / "image.jpg").read_bytes())}
    fields = {"question": json.loads((folder / "meta.json").read_text())["question"], "request": json.dumps(body)}
    sent = httpx.post(f"{server.address}/simulate", files=files, data=fields, timeout=TIME_LIMIT)
    return sent.raise_for_status().json()


def simulated(server: Server, name: str, **corrected: Any) -> tuple[dict[str, Any], dict[str, Any]]:
    """The result of an example, and its worlds."""
    found = posted(server, name, **{"live": True} | corrected)
    live = found["trajectory"]["live"]
    return found, {} if live is None else got(server.address, live["url"])


def column(value: Any, count: int) -> list[float]:
    return value if isinstance(value, list) else [value] * count


@pytest.fixture(scope="module")
def engine(server: Server, chromium: Browser) -> Iterator[Page]:
    """A page with the physics loaded."""
    with Windows(chromium) as opened:
        page = opened.open(server.address)
        page.evaluate(LOAD)
        yield page


@pytest.mark.parametrize(("name", "turns"), [("ball-and-mug", (-2.2, 0.5)), ("thrown-ball", (0.5,))])
def test_the_page_computes_the_worlds_of_the_server(
    server: Server, engine: Page, name: str, turns: tuple[float, ...]
) -> None:
    """`turns`: radians by which the arrow is turned."""
    first, world = simulated(server, name)
    motion, names = first["motion"], [body["object"] for body in first["trajectory"]["bodies"]]
    (x, y), start = motion["direction"], first["grounding"]["point"]
    for turn in turns:
        direction = [x * math.cos(turn) - y * math.sin(turn), x * math.sin(turn) + y * math.cos(turn)]
        dragged, worlds = simulated(server, name, motion=given_again(motion, direction))
        found = engine.evaluate(RUN, {"world": world, "direction": direction})
        worlds_here = len(found["velocities"])
        there = [column(each, worlds_here) for each in worlds["bodies"][0]["velocity"]]
        for mine, theirs in zip(found["velocities"], zip(*there, strict=True), strict=True):
            assert mine == pytest.approx(theirs, abs=1e-4)
        trajectory = dragged["trajectory"]
        met = [(each["time"], each["object"]) for each in trajectory["encounters"] if each["kind"] == "touches"]
        assert (found["met"] is None) == (not met)
        if found["met"] is not None:
            assert names[found["met"]["body"]] == met[0][1]
            assert found["met"]["time"] == pytest.approx(met[0][0], abs=0.07)
        shift = [a - b for a, b in zip(start, found["points"][0], strict=False)]
        until = met[0][0] if met else math.inf  # then it is seen in another size: the shift is, too
        for frame, (point, told) in enumerate(zip(found["points"], trajectory["paths"][0]["points"], strict=False)):
            if frame / trajectory["fps"] < until:
                assert math.dist([a + b for a, b in zip(point, shift, strict=False)], told) < WITHIN * world["size"][0]
        shares = found["shares"]
        assert shares["count"] == worlds_here - 1
        assert shares["yes"] / shares["count"] == pytest.approx(trajectory["outcome"]["probability"], abs=0.08)


@pytest.mark.parametrize(
    "ends",
    rows(
        core={
            "it ends where it touches": {"until": "contact"},
            "it turns when its time is over": {"duration": 0.8, "steps": [{"direction": [0, 1]}]},
        },
    ),
)
def test_courses_end_in_the_page_as_they_do_on_the_server(server: Server, engine: Page, ends: dict[str, Any]) -> None:
    told, world = simulated(server, "ball-and-mug", motion={"direction": [0.97, 0.24], "kind": "linear"} | ends)
    found = engine.evaluate(RUN, {"world": world, "direction": told["motion"]["direction"]})
    theirs = told["trajectory"]["paths"][0]["points"]
    for frame in (len(theirs) // 2, len(theirs) - 1):
        mine = found["points"][min(frame, len(found["points"]) - 1)]
        moved = [mine[axis] - found["points"][0][axis] for axis in (0, 1)]
        assert moved == pytest.approx([theirs[frame][axis] - theirs[0][axis] for axis in (0, 1)], abs=20)
    share = told["trajectory"]["outcome"]["probability"]
    assert found["shares"]["yes"] / found["shares"]["count"] == pytest.approx(share, abs=0.08)


def test_what_follows_a_path_moves_nothing_that_it_passes_through(server: Server, engine: Page) -> None:
    told, world = simulated(server, "ball-and-mug")
    (x, y), mug = told["grounding"]["point"], told["trajectory"]["encounters"][0]
    x1, y1 = (mug["bbox"][0] + mug["bbox"][2]) / 2, mug["bbox"][3] - 10
    along = [[x + (x1 - x) * share / 40, y + (y1 - y) * share / 40] for share in range(81)]
    found = engine.evaluate(RUN, {"world": world, "along": along})
    assert (found["met"]["body"], found["moved"]) == (mug["body"], [0])
    given = {"grounding": {"object": "yellow ball", "bbox": told["grounding"]["bbox"]}, "live": False}
    followed, _ = simulated(server, "ball-and-mug", trajectory={"points": along, "fps": world["fps"]}, **given)
    touches = [each for each in followed["trajectory"]["encounters"] if each["kind"] == "touches"]
    assert [each["bbox"] for each in touches] == [mug["bbox"]]
    assert found["met"]["time"] == pytest.approx(touches[0]["time"], abs=0.2)


def test_worlds_are_told_only_where_they_are_asked_for_and_can_be_aimed(server: Server) -> None:
    bound = {"live": True, "motion": {"law": "ballistic"}}
    for name, request in (("falling-ball", {"live": True}), ("ball-and-mug", {}), ("ball-and-mug", bound)):
        assert posted(server, name, **request)["trajectory"]["live"] is None


def answered(server: Server, windows: Windows, **options: str) -> tuple[Page, str]:
    """A page that has answered a question about a picture that no other test asks about, and the job."""
    page = windows.open(server.address, **options)
    drop(page, picture(next(SHIFTS)))
    ask(page, QUESTION)
    return page, result(page)


def foretold(page: Page) -> str:
    """What the worlds of the page say, once all have."""
    words = page.locator(".foretold b")
    expect(words).to_contain_text("of 50 simulated versions")
    return words.inner_text()


def test_the_world_answers_while_the_arrow_is_dragged_and_then_the_film_plays(server: Server, windows: Windows) -> None:
    page, first = answered(server, windows, reduced_motion="no-preference")
    assert said(page) == "Yes"
    page.get_by_role("slider", name="Frame of the clip").fill("0")  # stops the film
    start, *way = in_window(page, arrow_tip(page), (150, 40), (91, 10), (91, 10))
    page.mouse.move(*start)
    page.mouse.down()
    for _, to in pairwise([start, *way]):
        page.mouse.move(*to, steps=4)
    assert foretold(page).startswith("No: ")
    assert page.locator(".foreseen .futures").get_attribute("d")
    assert page.locator(".world").count() == 0, "the path before is another future"
    page.mouse.up()
    result(page, before=first)
    assert said(page) == "No"
    expect(page.locator(".foretold")).to_have_count(0)
    expect(page.get_by_role("button", name="Pause")).to_be_visible()


def test_a_page_that_was_passed_on_computes_without_a_network(server: Server, windows: Windows, tmp_path: Path) -> None:
    found, _ = simulated(server, "ball-and-mug")
    job, *_ = got(server.address, "/jobs")["jobs"]
    assert got(server.address, f"/jobs/{job['id']}")["result"]["id"] == found["id"]
    file = tmp_path / "world.html"
    file.write_bytes(httpx.get(f"{server.address}/jobs/{job['id']}/download?format=page", timeout=TIME_LIMIT).content)
    page = windows.open(file.as_uri(), offline=True)
    told = page.get_by_role("status")
    expect(told).to_have_text("Yes: 50 of 50 simulated versions")
    tip = page.get_by_role("button").bounding_box()
    assert tip is not None
    x, y = tip["x"] + tip["width"] / 2, tip["y"] + tip["height"] / 2
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x - 40, y - 200, steps=5)
    expect(told).to_have_text("No: 50 of 50 simulated versions")
    page.mouse.up()


def test_examples_answer_at_once_what_the_start_page_says(server: Server, windows: Windows) -> None:
    page = windows.open(server.address)
    example = page.locator(".examples button").nth(3)
    answer = example.locator("b").inner_text()
    example.click()
    shown = result(page)
    assert said(page) == answer
    page.get_by_role("link", name="Jobs").click()
    row = page.locator(".job", has=page.locator(f"a[href$='{shown}']"))
    expect(row.locator(".answered")).to_have_text(answer)


def test_a_drag_is_broken_off_belongs_to_its_question_and_may_find_no_frames(server: Server, windows: Windows) -> None:
    page, first = answered(server, windows)
    tip = arrow_tip(page)
    start, end = in_window(page, tip, (93, 10))
    page.mouse.move(*start)
    page.mouse.down()
    page.mouse.move(*end, steps=4)
    expect(page.locator(".result.faded")).to_be_visible()
    page.keyboard.press("Escape")
    expect(page.locator(".foretold")).to_have_count(0)
    page.mouse.up()
    assert arrow_tip(page) == tip
    assert page.locator(".result").get_attribute("data-job") == first

    drag_in_picture(page, tip, (93, 10))
    dragged = result(page, before=first)
    expect(page.get_by_text("Asked with your corrections: its motion.")).to_be_visible()
    ask(page, QUESTION.replace("right", "left"))
    left = result(page, before=dragged)
    expect(page.get_by_text("Asked with your corrections")).to_have_count(0)
    expect(page.locator(".sentence")).to_contain_text("to the left")

    def without_simulation(route: Route) -> None:
        found = route.fetch()
        job = found.json()
        if job.get("result"):
            job["result"] |= {"simulation": None, "answer": None}
        route.fulfill(response=found, json=job)

    page.route(re.compile(r"/jobs/[\w-]+$"), without_simulation)
    drag_in_picture(page, arrow_tip(page), (94, 10))
    result(page, before=left)
    assert said(page) == "Not sure"
    expect(page.locator(".foretold")).to_have_count(0)  # a result without frames ends what is foreseen
