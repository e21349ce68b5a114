"""What the names of objects say: the shape of one, and which things a phrase for several means."""

from __future__ import annotations

from collections.abc import Sequence

from cow_service.readers.embedded.english.nouns import container_form, is_cube, is_vehicle, kind_of, may_name, shape_of
from cow_service.readers.options import plain
from cow_service.records import ObjectPrior


def read_name(name: str) -> ObjectPrior:
    """What a noun says of a thing's shape."""
    opening = container_form(name)
    return ObjectPrior(
        shape=shape_of(name),
        elongated=is_vehicle(name),
        equal_sided=is_cube(name),
        opening=None if opening == "unknown" else opening,
    )


def names_meant(words: str, names: Sequence[str]) -> tuple[str, ...]:
    """Those of a kind such as "both mugs", where there are as many as is said; else the words themselves."""
    kind = kind_of(words)
    if kind is None or any(plain(name) == plain(words) for name in names):
        return (words,)
    found = tuple(name for name in names if may_name(kind.phrase, name))
    return found if found and kind.count in (None, len(found)) else (words,)
