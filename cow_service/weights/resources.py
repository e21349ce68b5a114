"""Finds the prompts, manifests and an example that ship with the package, in a checkout and an installed wheel alike.

In a checkout they are folders beside the package; a wheel carries them inside it, under `_shipped`.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib.resources import files
from importlib.resources.abc import Traversable
from pathlib import Path


@dataclass(frozen=True)
class Resources:
    """The files of one kind."""

    folder: str
    suffix: str
    kind: str  # for messages

    def names(self) -> tuple[str, ...]:
        """File names without suffix, sorted."""
        return tuple(self._files())

    def read(self, name: str) -> str:
        """The text of one. Raises `LookupError`, naming those that exist."""
        return self.file(name).read_text(encoding="utf-8")

    def file(self, name: str) -> Traversable:
        """One as it lies in the package. Raises `LookupError`, naming those that exist."""
        # Looked up among the names that exist, never joined to a path: a name cannot lead out of the folder.
        found = self._files()
        if name not in found:
            raise LookupError(f"No {self.kind} is named {name!r}; there are: {', '.join(found) or 'none'}.")
        return found[name]

    def _files(self) -> dict[str, Traversable]:
        # The wheel's own copy comes first: what lies beside an installed package is site-packages, not ours.
        shipped = files("cow_service").joinpath("_shipped")
        root: Traversable = shipped if shipped.is_dir() else Path(__file__).resolve().parents[2]
        folder = root.joinpath(self.folder)
        found = [file for file in folder.iterdir() if file.is_file()] if folder.is_dir() else []
        names = {file.name.removesuffix(self.suffix): file for file in found if file.name.endswith(self.suffix)}
        return dict(sorted(names.items()))


PROMPTS = Resources("prompts", ".md", "prompt")
MANIFESTS = Resources("models", ".yaml", "model manifest")
FAMILIES = Resources("models/families", ".yaml", "family of MLLMs")
EXAMPLES = {  # each has one, `image`
    name: Resources(f"examples/{name}", ".jpg", "picture")
    for name in ("ball-and-mug", "falling-ball", "bottle-passes-cylinder", "thrown-ball")
}
