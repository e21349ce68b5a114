"""Which classical finder changes an answer: scenes with known truth, asked with one finder switched off at a time.

    python benchmarks/ablation.py DIR ... [--given DIR ...] [--variants NAME ...] [--together NAME ...] [--json FILE]

Each DIR holds one folder per scene with image.jpg and meta.json, as `examples/` does. Scenes of a plain DIR are asked
by image and question alone; those of `--given` also with every box and the direction, where alone hardly one would be
answered. Right, wrong and unsure answers and refusals are counted per folder. A finder whose removal costs more than
one right answer of 120, or adds a wrong one, earns its lines.

The first round, with all finders, notes in which scenes each returns something else than what stands in for it. Only
those are asked again: in the others every number would be the same.
"""

from __future__ import annotations

import argparse
import importlib
import json
import pickle
import sys
import tempfile
import types
from collections import Counter
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack, contextmanager
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

from cow_service.errors import CowError
from cow_service.requests import AnswerRequest
from cow_service.service import Service
from cow_service.settings import Settings

Patch = tuple[str, object]  # what is replaced, as "module:name" below `cow_service`, and by what


def nothing(*_: object, **__: object) -> None:
    """In place of a finder that may find nothing."""


def none(*_: object, **__: object) -> tuple[()]:
    """In place of a finder of several things."""
    return ()


def first(value: Any, *_: object, **__: object) -> Any:
    """In place of what adds to its first argument."""
    return value


def second(_: object, value: Any, *__: object) -> Any:
    """In place of what adds to its second argument."""
    return value


def certainly(*_: object, **__: object) -> bool:
    """In place of a test that everything passes."""
    return True


def never(*_: object, **__: object) -> bool:
    """In place of a test that nothing passes."""
    return False


def no_lines(*_: object) -> Any:
    """No edges [0, 4]."""
    return np.zeros((0, 4))


def whole(_: object, component: object) -> list[object]:
    """A component in one part."""
    return [component]


def surely(*_: object) -> float:
    """Full confidence."""
    return 1.0


def undecided(*_: object) -> float:
    """A likelihood ratio that tells nothing."""
    return 0.0


def seen_whole(found: Sequence[object]) -> list[bool]:
    """None of some things is hidden."""
    return [False] * len(found)


def empty(view: Any, *_: object) -> Any:
    """An empty mask [h, w]."""
    return np.zeros(view.edges.shape, bool)


VARIANTS: dict[str, tuple[Patch, ...]] = {
    "trails": (("perception.observation:find_trails", none),),
    "side view": (("perception.observation:find_side_view", nothing),),
    "segments": (("perception.observation:find_segments", no_lines),),
    "discs": (("perception.classical.regions:as_disc", nothing),),
    "undersides": (("perception.classical.regions:_with_undersides", list),),
    "hidden": (("perception.classical.regions:_hidden", seen_whole),),
    "white sides": (("perception.classical.regions:white_sides", empty),),
    "black faces": (("perception.classical.regions:black_faces", second),),
    "black": (("perception.classical.regions:_black", empty),),
    "stands out": (("perception.classical.regions:_stands_out", certainly),),
    "colours": (("perception.classical.regions:_coloured_parts", whole),),
    "confidence": (("perception.classical.regions:_confidence", surely),),
    "bare boxes": (("perception.observation:is_bare", never),),
    "faults": (("perception.observation:fault_of", nothing),),
    "drawn boxes": (("perception.observation:find_boxes", none),),
    "arrows": (("perception.observation:find_arrows", none),),
    "hollow arrows": (("perception.classical.strokes:_hollow", none),),
    "shapes seen": (("stages.seeing:shape_seen", nothing),),
    "likeness": (("perception.classical.forms:log_ratio", undecided),),
    "unlike": (("perception.classical.forms:is_unlike", never), ("perception.classical.forms:is_other_kind", never)),
    "shadows": (("perception.observation:find_shadow", nothing),),
    "openings": (("perception.classical.openings:_outer_rim", nothing),),
    "facing": (("stages.motion:facing", nothing),),
}


def replaced(name: str) -> Iterator[tuple[types.ModuleType, str, object]]:
    """The modules and names that a variant replaces, and by what."""
    for where, instead in VARIANTS[name]:
        module, attribute = where.split(":")
        yield importlib.import_module(f"cow_service.{module}"), attribute, instead


@contextmanager
def without(names: Sequence[str]) -> Generator[None]:
    """Everything but some finders."""
    with ExitStack() as stack:
        for module, attribute, instead in (patch for name in names for patch in replaced(name)):
            stack.enter_context(mock.patch.object(module, attribute, instead))
        yield


@contextmanager
def watched(note: Callable[[str], None]) -> Generator[None]:
    """All finders; `note` is told the variant whenever one returns something else than what would stand in for it."""

    def watch(name: str, finder: Any, instead: Any, *args: Any, **options: Any) -> Any:
        found, other = finder(*args, **options), instead(*args, **options)
        if isinstance(found, types.GeneratorType):
            found = tuple(found)
        if pickle.dumps(found) != pickle.dumps(other):
            note(name)
        return found

    with ExitStack() as stack:
        for name in VARIANTS:
            for module, attribute, instead in replaced(name):
                finder = getattr(module, attribute)
                if callable(finder):
                    stack.enter_context(mock.patch.object(module, attribute, partial(watch, name, finder, instead)))
        yield


def body_of(meta: Mapping[str, Any], given: bool) -> dict[str, Any]:
    """What is asked of a scene besides its image."""
    body: dict[str, Any] = {"question": meta["question"], "video": False}
    if given:
        body["grounding"] = {"object": meta["object"], "bbox": meta["boxes"][meta["object"]]}
        body["objects"] = [{"object": name, "bbox": meta["boxes"][name]} for name in meta["order"]]
        body["objects"] = [thing for thing in body["objects"] if thing["object"] != meta["object"]]
    if given and meta["direction"]:
        body["motion"] = {"direction": meta["direction"]}
    return body


def outcome_of(service: Service, folder: Path, given: bool) -> str:
    """Whether a scene's answer is right, wrong or unsure; or why there is none."""
    meta = json.loads((folder / "meta.json").read_text())
    image = {"artifact": service.keep_image((folder / "image.jpg").read_bytes()).sha256}
    try:
        answer = service.answer(AnswerRequest.model_validate({"image": image, **body_of(meta, given)}))
    except CowError:
        return "refused"
    if answer.simulation is None:
        return "refused"
    return "unsure" if answer.not_sure else "right" if answer.answer == meta["answer"] else "wrong"


Folders = Mapping[str, tuple[Sequence[Path], bool]]
"""Scenes by the name of their folder, and whether boxes and direction are given."""
Outcomes = dict[str, dict[str, str]]
"""By folder and scene."""


def asked(folders: Folders, before: Callable[[str, str], object] = nothing) -> Outcomes:
    """What becomes of every scene; `before` is told of each folder and scene before it is asked."""
    outcomes: Outcomes = {}
    with tempfile.TemporaryDirectory() as data, Service(alone(Path(data))) as service:
        for name, (scenes, given) in folders.items():
            outcomes[name] = {}
            for scene in scenes:
                before(name, scene.name)
                outcomes[name][scene.name] = outcome_of(service, scene, given)
    return outcomes


def alone(data: Path) -> Settings:
    """Settings under which everything is computed in this process."""
    return Settings(data_dir=data, reader="embedded", workers=False, warmup=False)


def asked_without(names: Sequence[str], folders: Folders) -> Outcomes:
    """As `asked`, without some finders."""
    with without(names):
        return asked(folders)


def asked_watched(folders: Folders) -> tuple[Outcomes, dict[str, set[tuple[str, str]]]]:
    """As `asked`, and for each variant the folders and scenes in which its finder finds something."""
    at, found = ("", ""), {name: set[tuple[str, str]]() for name in VARIANTS}

    def begin(folder: str, scene: str) -> None:
        nonlocal at
        at = folder, scene

    with watched(lambda name: found[name].add(at)):
        outcomes = asked(folders, begin)
    for name in VARIANTS:  # a number is always looked at
        if any(not callable(getattr(module, attribute)) for module, attribute, _ in replaced(name)):
            found[name] = {(folder, scene) for folder, scenes in outcomes.items() for scene in scenes}
    return outcomes, found


def told(outcomes: Outcomes, whole: Outcomes) -> dict[str, Any]:
    """The counts per folder and of all, and where the outcome differs from that with all finders."""
    merged = {folder: scenes | outcomes.get(folder, {}) for folder, scenes in whole.items()}
    counts = {folder: Counter(scenes.values()) for folder, scenes in merged.items()}
    changed = {
        f"{folder}/{scene}": f"{whole[folder][scene]} -> {outcome}"
        for folder, scenes in merged.items()
        for scene, outcome in scenes.items()
        if outcome != whole[folder][scene]
    }
    every = sum(counts.values(), Counter[str]())
    return {"all": every, **counts, "looked at": sum(map(len, outcomes.values())), "changed": changed}


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("folders", type=Path, nargs="*")
    parser.add_argument("--given", type=Path, nargs="*", default=[], help="asked with boxes and direction")
    parser.add_argument("--variants", nargs="*", default=list(VARIANTS), choices=VARIANTS)
    parser.add_argument("--together", nargs="*", default=[], choices=VARIANTS, help="switched off at once as well")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--json", type=Path, default=None, help="write the table here")
    arguments = parser.parse_args()
    folders: Folders = {
        f"{each.name}, given" if given else each.name: (sorted(p.parent for p in each.glob("*/meta.json")), given)
        for paths, given in ((arguments.folders, False), (arguments.given, True))
        for each in paths
    }
    if not folders or not all(scenes for scenes, _ in folders.values()):
        print("Name folders that hold scenes: each a folder with image.jpg and meta.json.", file=sys.stderr)
        return 2
    variants = {name: [name] for name in arguments.variants}
    if arguments.together:
        variants[" + ".join(arguments.together)] = arguments.together
    whole, found = asked_watched(folders)
    table = {"with all": told({}, whole)}
    print("with all", table["with all"], flush=True)
    with ProcessPoolExecutor(arguments.processes, get_context("spawn")) as pool:
        tasks = {
            name: pool.submit(asked_without, off, only(folders, set().union(*(found[each] for each in off))))
            for name, off in variants.items()
        }
        for name, task in tasks.items():
            table[name] = told(task.result(), whole)
            print(name, table[name], flush=True)
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(table, indent=1) + "\n")
    return 0


def only(folders: Folders, wanted: set[tuple[str, str]]) -> Folders:
    """The scenes among some, by folder and name."""
    return {
        name: ([scene for scene in scenes if (name, scene.name) in wanted], given)
        for name, (scenes, given) in folders.items()
    }


if __name__ == "__main__":
    sys.exit(main())
