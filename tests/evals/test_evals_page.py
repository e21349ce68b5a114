"""The page of a report in a real browser, opened as a file: what it shows, finds, remembers and never runs."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from asked_runs import HOSTILE, picture, run
from browser import NARROW, SIZES, WIDE, Windows, assert_fits, expect, faults_for_some

if TYPE_CHECKING:
    from playwright.sync_api import Page

    from cow_service.evals.runs import EvalRun

pytestmark = pytest.mark.slow

ARMS = ("never", "always", "placebo-still")
ODD = "trajectory-3"  # is refused, fails and replies with markup


@pytest.fixture(scope="module")
def asked(tmp_path_factory: pytest.TempPathFactory) -> EvalRun:
    """Six questions, each asked twice in three arms."""
    folder = tmp_path_factory.mktemp("a run & more")
    found = run(folder, 6, ARMS)
    frames = (picture(folder, 77, "overlay"),)
    changed = {
        ("collision-0", "never"): {"read": "B", "reply": "The answer is B."},
        ("collision-0", "always"): {"read": "A", "reply": "A.", "probability": 0.83, "overlay": frames[0]},
        (ODD, "never"): {"read": None, "reply": HOSTILE},
        (ODD, "always"): {"refusal": "object-<b>not</b>-found", "frames": (), "imaginations": 0},
        (ODD, "placebo-still"): {"read": None, "reply": None, "failure": "No answer within <i>120 s</i>."},
    }
    same = {"failure": None, "refusal": None}
    observations = tuple(
        each.model_copy(update={**same, "reply": each.reply or "A", **changed.get((each.item, each.arm), {})})
        for each in found.observations
    )
    return replace(found, observations=observations)


@pytest.fixture(scope="module")
def report(asked: EvalRun) -> Path:
    from cow_service.evals.report.page import write_page
    from cow_service.evals.report.summary import summarize
    from cow_service.evals.report.write import write_plots

    folder, summaries = asked.folder / "report", summarize([asked])
    return write_page(folder, [asked], summaries, write_plots(folder, summaries), [("By hand", "Said <b>plainly</b>.")])


def shown(page: Page) -> list[str]:
    return page.locator(".card h3").all_text_contents()


def chosen(page: Page, **values: str) -> list[str]:
    for name, value in values.items():
        page.locator(f"[name={name}]").select_option(value)
    return shown(page)


def test_filters_narrow_what_is_shown_and_a_link_shows_it_again(report: Path, windows: Windows) -> None:
    page = windows.open(report.as_uri())
    assert len(shown(page)) == 6
    assert chosen(page, task="collision") == ["collision-0", "collision-2", "collision-4"]
    assert "collision-0" in chosen(page, arm="always", against="never", outcome="helped")
    address = page.url
    found = shown(page)
    assert chosen(page, outcome="hurt") == [name for name in shown(page) if name != "collision-0"]
    again = windows.open(address)
    assert shown(again) == found
    assert again.locator("[name=outcome]").input_value() == "helped"
    assert again.locator("[name=task]").input_value() == "collision"
    expect(again.locator("#count")).to_have_text(f"{len(found)} of 6 questions")
    again.get_by_role("button", name="Clear").click()
    assert len(shown(again)) == 6
    assert chosen(again, outcome="refused") == [ODD]
    assert chosen(again, arm="placebo-still", outcome="failed") == [ODD]
    assert ODD in chosen(again, arm="never", outcome="unreadable")


def test_the_search_reads_questions_and_where_asked_replies(report: Path, windows: Windows) -> None:
    page = windows.open(report.as_uri())
    page.get_by_label("Search").fill("ball number 3")
    expect(page.locator(".card")).to_have_count(1)
    page.get_by_label("Search").fill("onerror")
    expect(page.locator(".card")).to_have_count(0)
    page.get_by_label("in the replies, too").check()
    expect(page.locator(".card")).to_have_count(1)
    assert "q=onerror" in page.url
    page.locator(".card h3 a").click()
    expect(page.locator("#count")).to_have_text(f"1 of 6 questions, only {ODD}")
    page.go_back()
    expect(page.get_by_label("Search")).to_have_value("onerror")


def test_the_table_links_to_the_questions_it_counts_and_pictures_load(report: Path, windows: Windows) -> None:
    page = windows.open(report.as_uri())
    row = page.get_by_role("row", name=re.compile("^always")).first
    row.get_by_role("link").nth(2).click()
    assert "collision-0" in shown(page)
    assert page.locator("[name=outcome]").input_value() == "helped-any"
    expect(page.locator("#items-heading")).to_be_focused()
    page = windows.open(f"{report.as_uri()}#item=collision-0")
    expect(page.locator(".card img")).to_have_count(1 + 4 + 1)
    page.wait_for_function("[...document.images].every((each) => each.complete && each.naturalWidth > 0)")
    assert page.locator(".plot img[alt]").count() == 4
    expect(page.locator(".card")).to_contain_text("Told probability: 83%; it happens.")


def test_what_others_wrote_is_text(report: Path, windows: Windows) -> None:
    page = windows.open(f"{report.as_uri()}#item={ODD}")
    for details in page.locator(".card details").all():
        details.locator("summary").click()
    assert page.locator(".reply pre").first.text_content() == HOSTILE
    expect(page.locator(".card")).to_contain_text("Simulation refused: object-<b>not</b>-found")
    expect(page.locator(".card")).to_contain_text("No reply: No answer within <i>120 s</i>.")
    expect(page.locator(".mark.unreadable").nth(1)).to_contain_text("unreadable")
    assert page.locator("#cards :is(b, i, script, img[src=x])").count() == 0
    assert page.title().startswith("COW evaluation")
    expect(page.get_by_text("Said <b>plainly</b>.")).to_be_visible()


def page_of(folder: Path, *runs: EvalRun) -> str:
    """The address of a report of runs, without plots."""
    from cow_service.evals.report.page import write_page
    from cow_service.evals.report.summary import summarize

    return write_page(folder, runs, summarize(runs)).as_uri()


def test_reports_elsewhere_of_two_runs_and_without_pictures(asked: EvalRun, tmp_path: Path, windows: Windows) -> None:
    page = windows.open(f"{page_of(tmp_path / 'else where', asked)}#item=collision-0")
    page.wait_for_function("document.images.length === 6 && [...document.images].every((each) => each.naturalWidth)")
    other = replace(asked, info=asked.info.model_copy(update={"mllm": "other/model"}))
    page.goto(page_of(tmp_path / "two", asked, other))
    expect(page.locator(".card")).to_have_count(6)
    expect(page.locator(".card").first.locator(".arm")).to_have_count(6)
    page.goto(page_of(tmp_path / "lost", replace(asked, folder=tmp_path / "lost")))
    expect(page.locator(".card")).to_have_count(6)
    expect(page.get_by_text("the file is missing").first).to_be_visible()


def test_over_an_arm_that_always_abstains_no_table_has_a_p(asked: EvalRun, tmp_path: Path) -> None:
    from cow_service.evals.report.page import write_page
    from cow_service.evals.report.summary import summarize
    from cow_service.evals.report.tables import contrasts

    silent = [
        each.model_copy(update={"read": each.abstain}) if each.arm == "never" else each for each in asked.observations
    ]
    run = replace(asked, observations=tuple(each for each in silent if each.arm in ("never", "always")))
    findings = summarize([run])
    page = write_page(tmp_path, [run], findings).read_text(encoding="utf-8")
    assert page.count("<td>abstains</td>") == 2 + 2 * len(findings.arms[1].gains)
    assert [cells[-2:] for cells in contrasts(findings).rows] == [("abstains", "")] * len(findings.contrasts)


def test_nothing_serious(report: Path, windows: Windows) -> None:
    # The script of axe is put into the page, which its policy forbids.
    page = windows.open(report.as_uri(), bypass_csp=True)
    assert_fits(page)
    page.locator("details").evaluate_all("all => all.forEach((details) => { details.open = true; })")
    expect(page.locator(".reply").first).to_be_attached()
    page.add_style_tag(content=".card { content-visibility: visible !important; }")  # else axe leaves out what is below
    for scheme, width in (("light", WIDE), ("dark", NARROW)):
        page.emulate_media(color_scheme=scheme)
        page.set_viewport_size(SIZES[width])
        assert_fits(page)
        assert faults_for_some(page) == [], scheme
