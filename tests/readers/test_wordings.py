"""Questions in many wordings: which are read right, refused or not sure; none is wrong without a word."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator

import pytest
from tables import rows
from wordings import is_reading, items, verdict

from cow_service.readers.embedded.english.questions import parse
from cow_service.service import Service
from cow_service.settings import Settings


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    with Service(Settings(data_dir=tmp_path_factory.mktemp("data"), reader="embedded")) as service:
        yield service


def test_the_words_alone_are_read_as_they_are_meant() -> None:
    """By the parser, without pictures: of 280 wordings 243 should be read by somebody; many are in no form of ours."""
    told = Counter[str]()
    for question, item in items().items():
        parsed, expect = parse(question), item["expect"]
        asked = parsed.asked
        if asked is None or expect["asked"] is None:
            told["left open" if asked is None else "read"] += 1
            continue
        mover = "" if parsed.mover is None else parsed.mover.text
        changes = [(change.kind, change.object.text) for change in parsed.changes]
        told["right" if mover and is_reading(mover, changes, asked, expect) else "otherwise"] += 1
    assert told["right"] >= 152
    assert told["otherwise"] <= 10, "the floor as a place where it lands, and things that only the picture tells"


CORE = {
    "removal": "Suppose the blue mug were gone. Would the yellow ball, rolling against the arrow, touch the white one?",
    "put": "Put the white mug next to the blue mug, then roll the ball against the arrow. What does it hit first?",
    "several things": "If the yellow ball moves along the arrow, does it avoid both mugs?",
    "when": "When will the red bottle start to cover the white cylinder if it moves at 50 px/s along the blue arrow?",
    "hidden": "If the blue cube slides right, will part of it be hidden behind the white cube at some point?",
    "count": "How many objects does the ball run into on its way to the right-hand edge of the picture?",
    "vehicle": "car backs up - touches anything?",
    "several legs": "The car moves 40 pixels to the left and then 200 pixels up. Where does it end up?",
}
REFUSED = {
    "not there": "If the blue bus drives forward, does it hit the green mug?",
    "taken away and moved": "If the yellow ball is taken away and then rolls to the right, does it hit the blue mug?",
    "contradictory": "If the black ball falls upwards, does it land on the orange cylinder?",
    "no what-if question": "What colour is the bottle?",
}


@pytest.mark.slow
@pytest.mark.parametrize(("question", "told"), rows(
    {kind: (question, "right") for kind, question in CORE.items()}
    | {kind: (question, "refused") for kind, question in REFUSED.items()}
))  # fmt: skip
def test_each_kind_of_question_is_answered_right_or_refused(question: str, told: str, service: Service) -> None:
    assert verdict(service, items()[question]) == told


@pytest.mark.soak
def test_no_wording_is_wrong_without_a_word(service: Service) -> None:
    told = {question: verdict(service, item) for question, item in items().items()}
    must_refuse = {question for question, item in items().items() if item["expect"]["refuse"]}
    assert "wrong" not in told.values()
    right = sum(kind == "right" or question in must_refuse for question, kind in told.items())
    assert right >= 0.5 * len(told), sorted((kind, question) for question, kind in told.items())
