"""What `--remove` and `--place` say, as fields of a request."""

from __future__ import annotations

import re
from collections.abc import Sequence

from cow_service.errors import InvalidRequest
from cow_service.narration import PREPOSITIONS, RELATION_WORDS

_WORDS = "|".join(sorted(RELATION_WORDS, key=len, reverse=True))  # "in front of" before "in"
_PLACED = re.compile(rf"\s*(?P<object>.+?)\s+(?P<relation>{_WORDS})\s+(?P<targets>.+?)\s*", re.IGNORECASE)


def intervention_fields(removed: Sequence[str], placed: Sequence[str]) -> list[dict[str, object]]:
    """The `interventions` of a request. Raises `InvalidRequest` for a text that names no two things."""
    return [*({"kind": "remove", "object": name} for name in removed), *map(_placement, placed)]


def _placement(text: str) -> dict[str, object]:
    found = _PLACED.fullmatch(text)
    if found is None:
        raise InvalidRequest(
            f"--place takes a thing, a relation ({', '.join(PREPOSITIONS)}) and what it is put to, such as "
            f"'apple into bowl' or 'cube between mug and vase'; got '{text}'."
        )
    relation = RELATION_WORDS[found["relation"].lower()]
    targets = re.split(r"\s+and\s+", found["targets"]) if relation == "between" else [found["targets"]]
    return {"kind": "place", "object": found["object"], "relation": relation, "targets": targets}
