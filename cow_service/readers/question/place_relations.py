"""The relations in which things are put to others, and the words for them."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:  # the command line prints its help without records
    from cow_service.records import PlaceRelation

PREPOSITIONS: dict[PlaceRelation, str] = {
    "into": "into", "onto": "onto", "between": "between", "in-front-of": "in front of", "behind": "behind",
    "next-to": "next to", "left-of": "to the left of", "right-of": "to the right of",
}  # fmt: skip
_OTHER_WORDS: dict[str, PlaceRelation] = {
    "in": "into", "inside": "into", "on": "onto", "on top of": "onto", "beside": "next-to", "left of": "left-of",
    "right of": "right-of",
}  # fmt: skip
RELATION_WORDS: dict[str, PlaceRelation] = {
    **{name: name for name in PREPOSITIONS},
    **{words: relation for relation, words in PREPOSITIONS.items()},
    **_OTHER_WORDS,
}
