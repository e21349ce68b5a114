"""Makes one item: finds its world, draws it, and writes its truth folder in one rename."""

import json
import os
import shutil
from pathlib import Path

import numpy as np
from PIL import Image

from .accept import Accepted, find_world, still
from .arrows import draw_arrow, draw_style, ends_of
from .layout import TEMPORARY, truth_folder
from .maps import depth_picture, maps_of
from .meta import FUTURE, box_of, direction_of, meta_of
from .plan import ItemKey
from .settings import Settings


def question_picture(item: Accepted, clean: Image.Image, trail: Image.Image | None) -> tuple[Image.Image, dict]:
    """The picture that is asked about, and the item's record."""
    if not item.draft.arrow:
        return trail or clean, meta_of(item, None)
    mover = item.draft.world.thing(item.draft.world.mover)
    avoid = mover.colour if item.key.family == "other" else ""
    arrow = draw_style(item.key.random("arrow"), item.draft.along, avoid)
    left, top, right, bottom = box_of(item.camera, mover, *still(mover))
    point = item.camera.project(np.array(mover.centre))
    ends = ends_of(arrow, point, direction_of(item), float(min(right - left, bottom - top)) / 2, clean.width)
    return draw_arrow(clean, arrow, ends), meta_of(item, arrow)


def write_item(folder: Path, item: Accepted, settings: Settings, threads: int) -> None:
    """Draw and write all files of an item into a folder."""
    # Blender is loaded here only: all that needs no picture works without it.
    from .studio import Studio  # noqa: PLC0415

    studio = Studio(item, settings.samples, threads)
    clean = studio.render(0)
    trail = studio.render_trail() if item.draft.trail_times else None
    picture, meta = question_picture(item, clean, trail)
    pictures = {"image": picture, "clean": clean, "background": studio.render_background()}
    pictures |= {f"future_{n}": studio.render(n) for n in FUTURE}
    write_files(folder, pictures, maps_of(item), meta, settings.quality)


def write_files(
    folder: Path, pictures: dict[str, Image.Image], maps: tuple[np.ndarray, np.ndarray], meta: dict, quality: int
) -> None:
    """Write an item's pictures, its ids and depth (metres), and its record."""
    for name, drawn in pictures.items():
        drawn.save(folder / f"{name}.jpg", quality=quality, optimize=True)
    ids, depth = maps
    Image.fromarray(ids).save(folder / "ids.png", optimize=True)
    depth_picture(depth).save(folder / "depth.png", optimize=True)
    (folder / "meta.json").write_text(json.dumps(meta, separators=(",", ":")) + "\n")


def make_item(out: Path, key: ItemKey, settings: Settings, threads: int) -> None:
    """Make an item under `out`; a folder with its final name is always complete."""
    folder = truth_folder(out, key)
    if folder.exists():
        return
    making = folder.parent / f"{TEMPORARY}{key.id}-{os.getpid()}"
    shutil.rmtree(making, ignore_errors=True)
    making.mkdir(parents=True)
    if key.family == "other":
        from .other.item import write_other  # noqa: PLC0415

        write_other(making, key, settings)
    else:
        write_item(making, find_world(key, settings.width, settings.height), settings, threads)
    try:
        making.rename(folder)
    except OSError:
        # A process of a run that was killed may have finished the same item, with the same bytes, just now.
        if not folder.exists():
            raise
        shutil.rmtree(making)
