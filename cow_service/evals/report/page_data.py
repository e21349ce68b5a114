"""What the page shows, as compact JSON: texts, pictures and lists that come again are named by their place."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import quote

from cow_service.evals.items import Item
from cow_service.evals.observations import Observation
from cow_service.evals.report.summary import BASELINE, ArmSummary
from cow_service.evals.runs import Run

PICTURES = "pictures"
ITEMS_PER_BLOCK = 100  # items whose replies are read together, once one of them is opened

Place = Callable[[Any], int]


@dataclass
class Table:
    """Values, each once, and the place of each."""

    values: list[Any] = field(default_factory=list)
    _places: dict[Any, int] = field(default_factory=dict)

    def place(self, value: Any) -> int:
        """Of a value, which is added where it is new."""
        if value not in self._places:
            self._places[value] = len(self.values)
            self.values.append(value)
        return self._places[value]

    def known(self, value: Any) -> int | None:
        """The same, and None for none."""
        return None if value is None else self.place(value)


@dataclass(frozen=True)
class Arm:
    """One arm of one run; `against`: the place of its baseline among the arms."""

    name: str
    run: int
    arm: str
    against: int | None = None


def page_arms(runs: Sequence[Run], summaries: Sequence[ArmSummary]) -> tuple[Arm, ...]:
    """Of all runs; those without any reply too, of which there is no summary."""
    names = {(each.run, each.arm): each.name for each in summaries}
    several = len(runs) > 1
    found = [
        Arm(names.get((place, arm)) or (f"{run.info.mllm}, {arm} ({place + 1})" if several else arm), place, arm)
        for place, run in enumerate(runs)
        for arm in run.info.arms
    ]
    return tuple(Arm(each.name, each.run, each.arm, _baseline(each, found, runs)) for each in found)


def _is_baseline(arm: Arm, runs: Sequence[Run]) -> bool:
    return arm.arm == BASELINE and bool(runs[arm.run].of_arm(BASELINE))


def _baseline(arm: Arm, arms: Sequence[Arm], runs: Sequence[Run]) -> int | None:
    """As the summaries choose it: of the same run, else of the first that asked the same of the same model."""

    def asked(place: int) -> tuple[Any, ...]:
        return runs[place].info.baseline_key

    if arm.arm == BASELINE:
        return None
    same = [(each.run != arm.run, place) for place, each in enumerate(arms) if _is_baseline(each, runs)]
    return min(((far, place) for far, place in same if asked(arms[place].run) == asked(arm.run)), default=(0, None))[1]


class Pictures:
    """Addresses of pictures, relative to the page."""

    def __init__(self, folder: Path, runs: Sequence[Run], copied: bool) -> None:
        self._folder, self._copied = folder, copied
        self._files: dict[str, Path] = {}
        for run in runs:
            own = run.folder / PICTURES
            for path in sorted(own.iterdir()) if own.is_dir() else ():
                self._files.setdefault(path.stem, path)

    def address(self, digest: str) -> str | None:
        """None where the file is not there."""
        path = self._files.get(digest)
        if path is None:
            return None
        try:
            if not self._copied:
                return quote(Path(os.path.relpath(path.resolve(), self._folder.resolve())).as_posix())
        except ValueError:  # on another drive: there is no relative path
            pass
        to = self._folder / PICTURES / path.name
        if not to.exists():
            to.parent.mkdir(exist_ok=True)
            shutil.copyfile(path, to)
        return quote(f"{PICTURES}/{path.name}")


@dataclass
class Packing:
    """The tables while items are packed."""

    pictures: Table = field(default_factory=Table)
    shown: Table = field(default_factory=Table)
    reasons: Table = field(default_factory=Table)

    def item(self, item: Item, data: int, seen: Sequence[Sequence[Observation]], replies: Table) -> list[Any]:
        """An item with what came of it in each arm. The order is that of `readItem` in page/data.js."""
        return [
            data,
            item.id,
            item.row,
            item.scene,
            item.task,
            item.level,
            item.question,
            [[each.letter, each.text] for each in item.options],
            item.answer,
            item.abstain,
            self.pictures.place(item.image),
            [self.pictures.place(each) for each in item.oracle],
            [[self.observation(each, replies) for each in of_arm] for of_arm in seen],
        ]

    def observation(self, each: Observation, replies: Table) -> list[Any]:
        """The order is that of `readObservation` in page/data.js."""
        return [
            each.repeat,
            "".join(each.options),
            each.read,
            each.read_as_paper,
            replies.known(each.reply),
            self.shown.place(tuple(map(self.pictures.place, each.frames))),
            self.pictures.known(each.overlay),
            self.reasons.known(each.refusal),
            self.reasons.known(each.failure),
            None if each.probability is None else round(each.probability, 4),
            each.happens,
            round(each.seconds, 2),
            each.imaginations,
        ]


def page_data(runs: Sequence[Run], arms: Sequence[Arm], pictures: Pictures) -> tuple[dict[str, Any], list[list[str]]]:
    """What the page needs at once, and the texts of the replies in blocks of items."""
    packing, data = Packing(), Table()
    asked: dict[tuple[int, str], Item] = {}
    for run in runs:
        place = data.place(run.info.data_digest)
        for item in run.items.values():
            asked.setdefault((place, item.id), item)
    seen = _seen(runs, arms, data)
    items: list[list[Any]] = []
    blocks: list[list[str]] = []
    replies = Table()
    for place, (key, item) in enumerate(asked.items()):
        if place % ITEMS_PER_BLOCK == 0:
            replies = Table()
            blocks.append(replies.values)
        of_arms = [sorted(seen.get((key, arm), ()), key=lambda each: each.repeat) for arm in range(len(arms))]
        items.append(packing.item(item, key[0], of_arms, replies))
    names = {each.data_digest: each.data for each in (run.info for run in reversed(runs))}
    core = {
        "perBlock": ITEMS_PER_BLOCK,
        "data": [names[digest] for digest in data.values],
        "arms": [[each.name, each.against] for each in arms],
        "shown": packing.shown.values,
        "reasons": packing.reasons.values,
        "pictures": [pictures.address(each) for each in packing.pictures.values],
        "items": items,
    }
    return core, blocks


def _seen(
    runs: Sequence[Run], arms: Sequence[Arm], data: Table
) -> Mapping[tuple[tuple[int, str], int], list[Observation]]:
    """Observations by item and place of the arm."""
    places = {(each.run, each.arm): place for place, each in enumerate(arms)}
    found: dict[tuple[tuple[int, str], int], list[Observation]] = {}
    for number, run in enumerate(runs):
        of_data = data.place(run.info.data_digest)
        for each in run.observations:
            arm = places.get((number, each.arm))
            if arm is not None:
                found.setdefault(((of_data, each.item), arm), []).append(each)
    return found


def script_json(value: Any) -> str:
    """JSON that can stand in a script element: nothing in it can end the element or open another."""
    text = json.dumps(value, ensure_ascii=False, separators=(",", ":"))
    for letter in "<>&\u2028\u2029":
        text = text.replace(letter, f"\\u{ord(letter):04x}")
    return text
