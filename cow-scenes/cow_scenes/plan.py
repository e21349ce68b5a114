"""Which items a set holds: names, order and seeds. Nothing here is random."""

import hashlib
from dataclasses import dataclass

import numpy as np

from .errors import UsageError

TASKS = ("collision", "trajectory", "compatibility", "occlusion")
LEVELS = ("L1", "L2")
SUBSET_OF = {t: ("physics" if t == "trajectory" else t) for t in TASKS}
"""The dataset's configuration of each task; `physics` is the trajectory task."""

FAMILIES = ("first", "other")
"""Bullet's and Blender's scenes; MuJoCo's."""

FORMS: dict[tuple[str, str], tuple[str, ...]] = {
    ("collision", "L1"): ("slide", "remove", "car"),
    ("collision", "L2"): ("first", "car", "slide", "remove", "first"),
    ("trajectory", "L1"): ("throw", "trail", "table", "billiards"),
    ("trajectory", "L2"): ("billiards", "table", "throw", "trail"),
    ("compatibility", "L1"): ("fall", "place"),
    ("compatibility", "L2"): ("place", "fall"),
    ("occlusion", "L1"): ("slide-occlude",),
    ("occlusion", "L2"): ("slide-occlude",),
}
"""Forms of the first family in turn by item number."""

OTHER_FORMS: dict[str, tuple[str, ...]] = {
    "collision": ("slide", "towards", "remove", "slide"),
    "trajectory": ("ramp", "throw", "step", "billiards"),
    "compatibility": ("place", "fall"),
    "occlusion": ("slide-occlude",),
}
"""Forms of the second family, for both levels."""


@dataclass(frozen=True)
class ItemKey:
    """One item's name: task, level and number within both; `seed` and `family` are the set's."""

    seed: int
    task: str
    level: str
    number: int
    family: str = "first"

    @property
    def subset(self) -> str:
        """The dataset configuration the item belongs to."""
        return SUBSET_OF[self.task]

    @property
    def id(self) -> str:
        """The item's id, e.g. `Physics_Level_2_13`."""
        return f"{self.subset.capitalize()}_Level_{self.level[1]}_{self.number}"

    @property
    def forms(self) -> tuple[str, ...]:
        """The forms of this task and level; the second family's L2 begins with other ones than its L1."""
        if self.family == "first":
            return FORMS[self.task, self.level]
        forms = OTHER_FORMS[self.task]
        return forms if self.level == "L1" else (*forms[len(forms) // 2 :], *forms[: len(forms) // 2])

    @property
    def form(self) -> str:
        """The form is a function of the number, so that each form has its share."""
        return self.forms[self.number % len(self.forms)]

    @property
    def want(self) -> int:
        """Index of the wanted option, in turn per form, so that answers are balanced."""
        turn, place = divmod(self.number, len(self.forms))
        if self.form == "first":
            return (turn * self.forms.count("first") + self.forms[:place].count("first")) % 3
        return (turn + place + (self.family == "other" and self.level == "L2")) % 2

    def random(self, stream: str) -> np.random.Generator:
        """A generator of this item's own; another `stream` gives independent numbers."""
        text = f"{self.seed}/{self.task}/{self.level}/{self.number}/{stream}"
        text = text if self.family == "first" else f"{self.family}/{text}"
        return np.random.default_rng(int.from_bytes(hashlib.sha256(text.encode()).digest()[:16], "big"))


def plan_items(
    seed: int, tasks: tuple[str, ...], levels: tuple[str, ...], count: int, family: str = "first"
) -> tuple[ItemKey, ...]:
    """Spread `count` items evenly over tasks and levels; a larger count only adds items."""
    if count < 1:
        raise UsageError(f"count is {count}; ask for at least 1 item")
    if seed < 0:
        raise UsageError(f"seed is {seed}; give 0 or more")
    for name, known in ((tasks, TASKS), (levels, LEVELS), ((family,), FAMILIES)):
        for value in name:
            if value not in known:
                raise UsageError(f"{value!r} is not known; choose from {', '.join(known)}")
    groups = [(t, lv) for lv in LEVELS if lv in levels for t in TASKS if t in tasks]
    return tuple(ItemKey(seed, *groups[i % len(groups)], i // len(groups), family) for i in range(count))
