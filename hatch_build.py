"""What a build makes: the blocking classes of the SDK, from the async ones, and the description for a package index."""

from __future__ import annotations

import os
import re
import tempfile
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface
from hatchling.metadata.plugin.interface import MetadataHookInterface

CLIENT = Path(__file__).parent / "cow_service" / "client"
TWINS = {"async_client.py": "sync_client.py", "async_results.py": "sync_results.py"}
NAMES = {
    "AsyncAnswer": "Answer",
    "AsyncClient": "Client",
    "AsyncIO": "BlockingIO",
    "AsyncJobHandle": "JobHandle",
    "AsyncSimulation": "Simulation",
    "async_client": "sync_client",
    "async_io": "sync_io",
    "async_results": "sync_results",
}


class CustomBuildHook(BuildHookInterface[Any]):
    """Hatchling's name for the hook of this file; it runs for wheels, for editable installs, too."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Write the twins, and have them packed though git ignores them."""
        write_twins()
        build_data["artifacts"] += [f"cow_service/client/{twin}" for twin in TWINS.values()]


class DescriptionHook(MetadataHookInterface):
    """Makes the README the project's description, without relative links and pictures: an index cannot resolve them."""

    def update(self, metadata: dict[str, Any]) -> None:
        """Set `readme`."""
        text = (Path(self.root) / "README.md").read_text(encoding="utf-8")
        text = re.sub(r"!\[[^]]*]\((?!https?:)[^)]*\)\n*", "", text)
        text = re.sub(r"\[([^]]*)]\((?!https?:)[^)]*\)", r"\1", text)
        metadata["readme"] = {"content-type": "text/markdown", "text": text}


def write_twins() -> None:
    """Write both blocking modules beside the async ones, where they are not as they should be.

    In one step: another process may import them.
    """
    for source, twin in TWINS.items():
        path, text = CLIENT / twin, twin_of(CLIENT / source)
        if not path.exists() or path.read_text() != text:
            draft = path.with_suffix(f".{os.getpid()}")
            draft.write_text(text)
            draft.replace(path)


def twin_of(source: Path) -> str:
    """The text of a module's twin: names and keywords by unasync, then the words of docstrings."""
    import unasync  # noqa: PLC0415  (not needed for a source distribution)

    with tempfile.TemporaryDirectory() as folder:
        draft = Path(folder) / "async" / source.name
        draft.parent.mkdir()
        draft.write_text(source.read_text())
        unasync.unasync_files([str(draft)], [unasync.Rule("/async/", "/sync/", NAMES)])
        made = (Path(folder) / "sync" / source.name).read_text()
    made = re.sub(r"`.*` is made from this file when", f"Made from `{source.name}` when", made)
    return re.sub(r"\bAsync(?=[A-Z])", "", re.sub(r"\b(async|await) ", "", made))


if __name__ == "__main__":
    write_twins()
