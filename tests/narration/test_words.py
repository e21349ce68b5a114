"""Names, directions and places in English."""

from __future__ import annotations

import math
from typing import Any, get_args

import pytest
from told import grounded

from cow_service.narration.words import (
    PREPOSITIONS,
    RELATION_WORDS,
    bare_name,
    direction_words,
    phrases_of,
    place_words,
    same_name,
)
from cow_service.records import PlaceRelation


def test_directions_are_those_of_sixteen_sectors() -> None:
    around = [direction_words((math.cos(k * math.pi / 8), -math.sin(k * math.pi / 8)), 0.0) for k in range(16)]
    assert around[::2] == [
        *("to the right", "to the right and up", "up", "up and to the left"),
        *("to the left", "to the left and down", "down", "down and to the right"),
    ]
    assert around[1::2] == [
        *("to the right and slightly up", "up and slightly to the right"),
        *("up and slightly to the left", "to the left and slightly up"),
        *("to the left and slightly down", "down and slightly to the left"),
        *("down and slightly to the right", "to the right and slightly down"),
    ]


@pytest.mark.parametrize(
    ("direction", "depth", "words"),
    [
        ((9.0, 0.0), 0.3, "to the right"),
        ((9.0, 0.0), 0.31, "to the right and away from the camera"),
        ((9.0, 0.0), -0.94, "to the right and towards the camera"),
        ((9.0, 0.0), 0.95, "away from the camera"),
        (None, -1.0, "towards the camera"),
        (None, 0.3, ""),
        ((0.0, 0.0), 0.0, ""),
        ((math.nan, 1.0), 0.0, ""),
    ],
)
def test_a_direction_has_its_depth_where_that_matters(direction: Any, depth: float, words: str) -> None:
    assert direction_words(direction, depth) == words


def test_names_are_the_same_without_determiner_case_and_spaces() -> None:
    assert bare_name("The  red\nball") == "red ball"
    assert bare_name("Theatre") == "Theatre"
    assert bare_name("x" * 201) == "x" * 200
    assert same_name("the Red  ball", "a red-ball")
    assert not same_name("red ball", "ball")
    assert not same_name("?", "!")
    say = phrases_of("en")
    assert (say.name("A mug?"), say.name("."), say.name("m" * 60)) == ("the mug", "the object", "the " + "m" * 60)
    assert say.name("m" * 61) == "the " + "m" * 60 + "\u2026"
    assert (say.seconds(1.25), phrases_of("de").seconds(1.25)) == ("1.2", "1,2")


def test_places_have_a_preposition_and_are_read_in_other_words() -> None:
    between, left = grounded("ball", ("between", "it", "the bowl", "a cone"), ("left-of", "it", "bowl")).interventions
    assert place_words(between) == "between the bowl and the cone"
    assert place_words(left) == "to the left of the bowl"
    assert {RELATION_WORDS[words] for words in PREPOSITIONS.values()} == set(get_args(PlaceRelation))
    assert (RELATION_WORDS["inside"], RELATION_WORDS["on top of"]) == ("into", "onto")
