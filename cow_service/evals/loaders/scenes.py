"""Scenes with known truth: a folder each, with image.jpg, meta.json, and pictures of what really happens."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from cow_service.evals.loaders.rows import Row, RowFault

META, IMAGE, FUTURE = "meta.json", "image.jpg", "future_*.jpg"


def scene_folders(folder: Path) -> list[Path]:
    """The folders of scenes, by name."""
    return sorted(path.parent for path in folder.glob(f"*/{META}"))


def scene_rows(folder: Path) -> Iterator[Row | RowFault]:
    """A row per scene."""
    for scene in scene_folders(folder):
        try:
            meta: Any = json.loads((scene / META).read_bytes())
        except ValueError as error:
            yield RowFault(f"{scene.name}/{META}: no whole JSON ({error}); was it written to its end?")
            continue
        if not isinstance(meta, dict) or not isinstance(meta.get("question"), str):
            yield RowFault(f"{scene.name}/{META}: must be an object with `question`, `answer`")
            continue
        image = scene / IMAGE
        yield Row(
            place=scene.name,
            id=str(meta.get("id") or scene.name),
            source_id=str(meta.get("id") or scene.name),
            image=image.read_bytes() if image.is_file() else None,
            question=meta["question"],
            answer=str(meta.get("answer") or ""),
            task=str(meta.get("task") or ""),
            level=str(meta["level"]) if meta.get("level") is not None else None,
            scene=scene.name,
            oracle=oracle_frames(scene),
        )


def oracle_frames(scene: Path) -> list[bytes]:
    """Pictures of what really happens, in the order of their numbers; empty where there are none."""
    return [path.read_bytes() for path in sorted(scene.glob(FUTURE), key=_number)]


def _number(path: Path) -> tuple[int, str]:
    digits = "".join(c for c in path.stem if c.isdigit())
    return int(digits or 0), path.name
