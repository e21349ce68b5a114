"""Questions in many wordings: which are read right, refused or not sure; none is wrong without a word."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator

import pytest
from conftest import SCALE
from wordings import Verdict, items, verdicts

from cow_service.service import Service
from cow_service.settings import Settings

pytestmark = [pytest.mark.slow, pytest.mark.scaled]
EVERY = max(1, 10 // SCALE)  # a tenth of them; all in `make soak`
RIGHT = 0.8  # share of all that is right, or refused or left open where it must be: 228 of 280; 230 before the camera
# was drawn as widely as pictures are, and things were doubted that look like others


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> Iterator[list[Verdict]]:
    with Service(Settings(data_dir=tmp_path_factory.mktemp("data"), reader="embedded")) as service:
        yield list(verdicts(service, part=slice(0, None, EVERY)))


def test_nothing_is_wrong_without_a_word(found: list[Verdict]) -> None:
    assert not [each for each in found if each.kind == "wrong"]


def test_what_must_be_refused_is_refused(found: list[Verdict]) -> None:
    refused = {each["question"] for each in items() if each["expect"]["refuse"]}
    assert {each.kind for each in found if each.question in refused} <= {"refused", "not-sure", "right"}


def test_how_many_are_right(found: list[Verdict]) -> None:
    refused = {each["question"] for each in items() if each["expect"]["refuse"]}
    right = Counter(each.kind == "right" or (each.kind != "wrong" and each.question in refused) for each in found)
    assert right[True] >= RIGHT * len(found), sorted((each.kind, each.question) for each in found)
