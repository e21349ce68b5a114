"""Shows examples in docstrings as code, whatever section they stand in."""

import re
from typing import Any

import griffe


class Examples(griffe.Extension):
    """Puts each block of `>>>` into a fence."""

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        """Called for every object that is read."""
        if obj.docstring is not None:
            fenced = re.sub(r"^(>>> (?:.+\n?)+)", r"```pycon\n\1\n```\n", obj.docstring.value, flags=re.MULTILINE)
            obj.docstring.value = fenced
