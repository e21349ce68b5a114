"""How a set is made: settings that its bytes depend on, and settings that they do not."""

from dataclasses import asdict, dataclass
from importlib.metadata import version

from . import __version__
from .errors import UsageError
from .plan import LEVELS, TASKS, ItemKey, plan_items

LIBRARIES = {
    "first": ("bpy", "numpy", "pillow", "pyarrow", "pybullet"),
    "other": ("mujoco", "numpy", "pillow", "pyarrow", "pyopengl", "scikit-image"),
}
"""What the bytes of a set depend on, by family."""
FORMAT = 2
"""Version of the layout: 2 added `depth.png`, the camera in words, and an id for the table."""


@dataclass(frozen=True)
class Settings:
    """Arguments of `make`. Sizes in pixels, `samples` per pixel, `quality` of JPEG, `shard_rows` per parquet file.

    Pictures of the family `other` have sizes of their own, to which `width` is a scale: 832 is 1.
    """

    seed: int = 1
    count: int = 100
    tasks: tuple[str, ...] = TASKS
    levels: tuple[str, ...] = LEVELS
    width: int = 832
    height: int = 480
    samples: int = 8
    quality: int = 85
    shard_rows: int = 500
    family: str = "first"

    def __post_init__(self) -> None:
        """Refuse values that cannot be used."""
        bounds = {
            "width": (64, 4096), "height": (64, 4096), "samples": (1, 4096), "quality": (1, 95),
            "shard_rows": (1, 100_000),
        }  # fmt: skip
        for name, (low, high) in bounds.items():
            value = getattr(self, name)
            if not low <= value <= high:
                raise UsageError(f"--{name.replace('_', '-')} is {value}; give {low} to {high}")
        if self.family == "other" and (self.height, self.samples) != (480, 8):
            raise UsageError(
                f"--height {self.height} --samples {self.samples}: the family `other` has neither; give --width alone"
            )
        if self.family == "first" and not 1.2 <= self.width / self.height <= 2.4:
            raise UsageError(f"a picture of {self.width}x{self.height} has to have a width of 1.2 to 2.4 heights")

    def plan(self) -> tuple[ItemKey, ...]:
        """The items of the set, in the order in which they are made."""
        return plan_items(self.seed, self.tasks, self.levels, self.count, self.family)

    def record(self) -> dict:
        """What `manifest.json` says of how the set was made."""
        versions = {"cow-scenes": __version__, **{name: version(name) for name in LIBRARIES[self.family]}}
        return {"format": FORMAT, "versions": versions, "seed": self.seed, "arguments": asdict(self)}
