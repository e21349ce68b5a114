"""What a build makes: the blocking classes of the SDK from the async ones, the types of its keyword arguments from the
request models, and the description for a package index."""

from __future__ import annotations

import ast
import os
import re
import tempfile
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface
from hatchling.metadata.plugin.interface import MetadataHookInterface

PACKAGE = Path(__file__).parent / "cow_service"
CLIENT = PACKAGE / "client"
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
OPTIONS = "options.py"
MADE = (*TWINS.values(), OPTIONS)  # in the folder of the client
HEADER = '''"""Arguments of calls besides image and question. None is the same as leaving one of the request out.

The `mask` of an object may be whatever an image may be, and an array of booleans; the `map` of a `depth` may be that,
too, an array of 16-bit integers, or one of metres, nan where nothing is known.

Made from `records/reading.py`, `requests/simulation.py` and `client/batches.py` when the package is installed or built.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from os import PathLike
from typing import TYPE_CHECKING, Any, Literal, TypedDict

if TYPE_CHECKING:
    from cow_service import records, requests

Given = Mapping[str, Any]  # a record as a plain mapping, checked by the server
'''
OF_LAW = '''
    law: records.Law | None
    """Stands for `motion.law`."""'''
FOOTER = '''

class SimulateBatchOptions(SimulateOptions, BatchSettings, total=False):
    """Of a batch of simulations."""


class AnswerBatchOptions(AnswerOptions, BatchSettings, total=False):
    """Of a batch of answers."""
'''


class CustomBuildHook(BuildHookInterface[Any]):
    """Hatchling's name for the hook of this file; it runs for wheels, for editable installs, too."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Write the modules, and have them packed though git ignores them."""
        write_modules()
        build_data["artifacts"] += [f"cow_service/client/{name}" for name in MADE]


class DescriptionHook(MetadataHookInterface):
    """Makes the README the project's description, without relative links and pictures: an index cannot resolve them."""

    def update(self, metadata: dict[str, Any]) -> None:
        """Set `readme`."""
        text = (Path(self.root) / "README.md").read_text(encoding="utf-8")
        text = re.sub(r"!\[[^]]*]\((?!https?:)[^)]*\)\n*", "", text)
        text = re.sub(r"\[([^]]*)]\((?!https?:)[^)]*\)", r"\1", text)
        metadata["readme"] = {"content-type": "text/markdown", "text": text}


def write_modules() -> None:
    """Write the modules of the client that are made, where they are not as they should be.

    In one step: another process may import them.
    """
    texts = {twin: twin_of(CLIENT / source) for source, twin in TWINS.items()} | {OPTIONS: options_text()}
    for name, text in texts.items():
        path = CLIENT / name
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


class CallerType(ast.NodeTransformer):
    """Turns the type of a request field into what a caller may give for it."""

    def __init__(self, modules: list[ast.Module]) -> None:
        nodes = [node for module in modules for node in module.body]
        self.models = {node.name for node in nodes if isinstance(node, ast.ClassDef)}
        self.aliases = {ast.unparse(node.targets[0]): node.value for node in nodes if isinstance(node, ast.Assign)}

    def visit_Name(self, node: ast.Name) -> ast.expr:
        """A name of the module: what it stands for, or a record or a mapping."""
        if node.id in self.models:
            return ast.parse(f"requests.{node.id} | Given", mode="eval").body
        if node.id in self.aliases:
            return self.visit(self.aliases[node.id])
        known = {"Language": "records.Language", "Asked": "records.Asked | Given"}
        return ast.parse(known[node.id], mode="eval").body if node.id in known else node

    def visit_Subscript(self, node: ast.Subscript) -> ast.expr:
        """Limits are the server's, any sequence will do for a tuple, and any mapping for a dictionary."""
        kind, parts = ast.unparse(node.value), node.slice.elts if isinstance(node.slice, ast.Tuple) else [node.slice]
        if kind == "Annotated":
            return self.visit(parts[0])
        if kind == "tuple":
            return ast.parse(f"Sequence[{ast.unparse(self.visit(parts[0]))}]", mode="eval").body
        return ast.Name("Given") if kind == "dict" else node


def options_text() -> str:
    """The text of the module with the types of keyword arguments: the fields of requests, and those of batches."""
    said = (PACKAGE / "records" / name for name in ("values.py", "reading.py"))
    paths = (*said, PACKAGE / "requests" / "simulation.py", CLIENT / "batches.py")
    modules = [ast.parse(path.read_text()) for path in paths]
    classes = {node.name: node for module in modules for node in module.body if isinstance(node, ast.ClassDef)}
    caller = CallerType(modules[:3])

    def typed(name: str, base: str, source: str, more: str = "") -> str:
        text = f'\n\nclass {name}({base}, total=False):\n    """Fields of `{source}`."""\n{more}'
        above = [classes[name] for each in classes[source].bases if (name := ast.unparse(each)) == "Reading"]
        for node in (part for each in (*above, classes[source]) for part in each.body):
            if isinstance(node, ast.AnnAssign) and (field := ast.unparse(node.target)) not in ("image", "question"):
                told = [each.value for each in getattr(node.value, "keywords", ()) if each.arg == "description"]
                record = classes.get(ast.unparse(node.annotation).partition(" ")[0])
                help = ast.literal_eval(told[0]) if told else record and ast.get_docstring(record)
                kind = ast.unparse(caller.visit(node.annotation))
                text += f"\n    {field}: {kind}{'' if 'None' in kind or source == 'BatchOptions' else ' | None'}"
                text += f'\n    """{help}"""' if help else ""
        return f"{text}\n"

    text = HEADER + typed("SimulateOptions", "TypedDict", "SimulateRequest", OF_LAW)
    text += typed("AnswerOptions", "SimulateOptions", "AnswerRequest")
    return text + typed("BatchSettings", "TypedDict", "BatchOptions") + FOOTER


if __name__ == "__main__":
    write_modules()
