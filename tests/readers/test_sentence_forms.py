"""The sentence forms: those that the documentation lists, and those of the CausalSpatial benchmark with other nouns."""

from __future__ import annotations

import json
import re

import pytest
from conftest import DATA, ROOT
from drawn import ball, block, floor, jpeg
from refusals import refused

from cow_service.perception.observation import look
from cow_service.readers.base import ReaderInput
from cow_service.readers.embedded.english.questions import parse, rewordings
from cow_service.readers.embedded.reader import EmbeddedReader
from cow_service.records import Asked, InterventionRequest, ObjectRequest, Reading


def rows(table: str) -> list[tuple[str, ...]]:
    lines = (row for row in table.strip().splitlines() if not row.startswith("#"))
    return [tuple(part.strip() for part in row.split("|")) for row in lines]


def documented() -> list[tuple[str, str]]:
    text = (ROOT / "docs" / "questions.md").read_text(encoding="utf-8")
    return re.findall(r"^\| (.+?) \| `(\{.*\})` \|$", text, re.MULTILINE)


def test_the_documentation_lists_what_is_read() -> None:
    assert len(documented()) > 30
    for question, told in documented():
        read = parse(question)
        assert read.unread == (), question
        assert read.asked is not None, question
        assert read.asked.model_dump(mode="json", exclude_defaults=True) == json.loads(told), question


GIVEN = (
    "toy truck with a blue cab", "black vase with cream dots", "stack of books", "Rubik's cube", "orange", "black mug",
)  # fmt: skip
BENCHMARK, NAMED = (DATA / "benchmark_questions.txt").read_text(encoding="utf-8").split("\n\n")


@pytest.mark.parametrize(("question", "mover", "way", "changes", "asked"), rows(BENCHMARK))
def test_the_benchmark_asks(question: str, mover: str, way: str, changes: str, asked: str) -> None:
    check(question, (), mover, way, changes, asked)


@pytest.mark.parametrize(("question", "mover", "way", "changes", "asked"), rows(NAMED))
def test_given_names_are_names_whatever_their_words(
    question: str, mover: str, way: str, changes: str, asked: str
) -> None:
    check(question, GIVEN, mover, way, changes, asked)


def check(question: str, names: tuple[str, ...], mover: str, way: str, changes: str, asked: str) -> None:
    read = parse(question, names)
    assert (read.mover.text if read.mover else "-") == mover
    motion = read.motion
    ways = {(-1.0, 0.0): "left", (1.0, 0.0): "right"}
    towards = f"towards {motion.towards.text}" if motion.towards else ""
    said = {True: "along", False: "against"}.get(motion.along_arrow) or {True: "forward", False: "backward"}.get(
        motion.forward
    )
    kind = motion.kind if motion.kind in {"fall", "place"} else ""
    assert (said or towards or kind or ways.get(motion.direction or (0.0, 0.0), "")) == way
    assert ", ".join(f"{each.kind} {each.object.text}" for each in read.changes) == changes
    if asked == "-":
        assert read.asked is None
        assert read.unread
        return
    found = read.asked
    assert found is not None
    words = [] if found.form == "whether" else [found.form]
    words += [found.relation, f"{found.subject} > {found.target}" if found.subject else found.target or ""]
    words += [f"({', '.join(found.among)})" if found.among else "", "not" if found.negated else ""]
    assert " ".join(word for word in words if word) == asked


def test_the_other_one_is_what_is_left_of_two() -> None:
    for names, target in (((), "other one"), (("red ball", "lamp"), "lamp"), (("red ball", "lamp", "cup"), None)):
        asked = parse("If the red ball moves to the right, will it hit the other one?", names).asked
        assert (asked and asked.target) == target


def test_what_is_not_read_is_refused_with_questions_that_are() -> None:
    scene = look(jpeg(block(ball(floor(), (150, 200), 40, (200, 30, 30)), (430, 150, 520, 250), (50, 80, 200))))
    question = "If the red ball waddles left, will the blue cube be thwarted?"
    assert parse(question).asked is None
    assert any("thwarted" in words for words in parse(question).unread)
    with refused("cannot-ground") as caught:
        EmbeddedReader().read(ReaderInput(scene.image, "Can the red ball thwart the blue cube?", scene))
    assert "'can the red ball thwart the blue cube'" in caught.value.detail.lower()
    for like in rewordings(parse("Can the red ball thwart the blue cube?")):
        assert parse(like).asked is not None
        assert like in caught.value.detail


def test_what_is_given_is_not_parsed_for() -> None:
    scene = look(jpeg(block(ball(floor(), (150, 200), 40, (200, 30, 30)), (430, 150, 520, 250), (50, 80, 200))))
    gizmo = ObjectRequest(object="gizmo", bbox=(110, 160, 190, 240), shape="sphere")
    question = "The gizmo, does it flummox?"
    change = InterventionRequest(kind="remove", object="blue cube")
    said = Reading(objects=(gizmo,), asked=Asked(relation="touches"), interventions=(change,))
    result = EmbeddedReader().read(ReaderInput(scene.image, question, scene, given=said, motion_wanted=False))
    mover = result.reading.grounding
    assert mover is not None
    assert (mover.object, mover.bbox, mover.prior) == ("gizmo", gizmo.bbox, gizmo.prior)
    assert (result.warnings, mover.is_doubtful) == ((), False)
    with refused("cannot-ground"):
        EmbeddedReader().read(ReaderInput(scene.image, question, scene, given=Reading(objects=(gizmo,))))
