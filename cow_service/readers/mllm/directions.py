"""Lines of motion in a reply: two points, what tells of them, and whether they lead towards or away from the camera."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import cast

from cow_service.readers.mllm.boxes import BOX_KEYS, CORNER_PAIRS, POINT_KEYS
from cow_service.readers.mllm.coordinates import LEAST_LENGTH, CoordinateFrame
from cow_service.readers.mllm.priors import CameraSense, SpeedWord, read_depth_degrees, read_speed
from cow_service.readers.mllm.replies import ReplyError, fields_of, first_of, is_none, is_number, text_of, truth_of
from cow_service.records import Cue, Point

STRAIGHT = 60.0  # degrees from the image's vertical, within which a line can also lead towards or away
STEEP = 60.0  # degrees out of the image plane, from which a motion leads straight towards or away
_DIRECTION_KEYS = ("direction", "motion_direction", "line", "vector")
_CUE_WORDS: tuple[tuple[str, Cue], ...] = (
    ("arrow", "arrow"),
    ("trail", "trail"),
    ("ghost", "trail"),
    ("orient", "orientation"),
    ("front", "orientation"),
    ("facing", "orientation"),
    ("text", "text"),
    ("question", "text"),
    ("word", "text"),
    ("gravity", "gravity"),
)
_CAMERA: dict[str, CameraSense] = {
    "towards": "towards", "toward": "towards", "towards the camera": "towards", "toward the camera": "towards",
    "away": "away", "away from the camera": "away",
}  # fmt: skip


@dataclass(frozen=True)
class Line:
    """Which way the object moves, as far as the reply tells: `ends` in px of the upright image, or null."""

    ends: tuple[Point, Point] | None = None
    cue: Cue | None = None
    along_arrow: bool | None = None
    camera: CameraSense | None = None
    depth_degrees: float | None = None  # out of the image plane, positive away from the camera
    speed: SpeedWord | None = None
    warnings: tuple[str, ...] = ()


def line_in(values: Sequence[object], said: str, frame: CoordinateFrame) -> Line:
    """The one line that a reply gives. Raises `ReplyError` where it gives none, several, or one that cannot be."""
    lines = [line for value in values for line in _lines(value, frame)]
    if not lines and not values and "<" not in said and (corners := CORNER_PAIRS.search(said)):
        lines = [Line(frame.ends(list(corners.groups())))]
    if not lines:
        raise ReplyError("`direction` is missing; give two points on the line of the motion, or null")
    if any(not _same_way(line, lines[0]) for line in lines):
        raise ReplyError("several directions are given; give one")
    line = _one_depth(max(lines, key=lambda line: (line.cue is not None, line.camera is not None)))
    if line.ends is not None and line.camera is not None and not _leads(line.ends, line.camera):
        raise ReplyError(
            "`direction` and `camera` disagree; `camera` is for what moves straight towards or away from it, else null"
        )
    return line


def _lines(value: object, frame: CoordinateFrame) -> Iterator[Line]:
    if isinstance(value, list):
        held = cast("list[object]", value)
        if len(held) == 4 and all(is_number(part) for part in held):
            yield Line(frame.ends(held))
        for part in held:
            if isinstance(part, dict):
                yield from _lines(part, frame)
    fields = fields_of(value)
    if not {"start", "end"} <= set(fields) and not any(key in fields for key in _DIRECTION_KEYS):
        for key, held in fields.items():
            if isinstance(held, dict) and key not in {"others", *BOX_KEYS, *POINT_KEYS}:
                yield from _lines(cast("dict[str, object]", held), frame)
        return
    written = first_of(fields, *_DIRECTION_KEYS) if any(key in fields for key in _DIRECTION_KEYS) else value
    named = text_of(fields.get("cue")).lower()
    cue: Cue | None = next((cue for word, cue in _CUE_WORDS if word in named), None)
    camera = _CAMERA.get(text_of(fields.get("camera")).lower().strip(" ."))
    depth_degrees, depth_warnings = read_depth_degrees(fields.get("depth_degrees"), camera)
    speed, speed_warnings = read_speed(fields.get("speed"))
    yield Line(
        ends=None if named == "none" and _is_zero(written) else _ends(written, frame),
        cue=cue,
        along_arrow=truth_of(fields.get("along_arrow")),
        camera=camera,
        depth_degrees=depth_degrees,
        speed=speed,
        warnings=(*depth_warnings, *speed_warnings),
    )


def _one_depth(line: Line) -> Line:
    """The line either straight towards or away (`camera`), or at an angle (`ends` and `depth_degrees`)."""
    if line.depth_degrees is None:
        return line
    sense: CameraSense = "away" if line.depth_degrees > 0 else "towards"
    steep = abs(line.depth_degrees) >= STEEP
    if line.camera is not None:
        oblique = line.ends is not None and not steep
        return replace(line, camera=None) if oblique else replace(line, depth_degrees=None)
    if steep and (line.ends is None or _leads(line.ends, sense)):
        return replace(line, camera=sense, depth_degrees=None)
    return line


def _ends(written: object, frame: CoordinateFrame) -> tuple[Point, Point] | None:
    if is_none(written) or (isinstance(written, str) and written.strip().lower() == "unknown"):
        return None
    if isinstance(written, str) and not re.search(r"\d", written):
        raise ReplyError(f"`direction` is given in words ('{written[:40]}'); give two points as four numbers")
    return frame.ends(written)


def _is_zero(written: object) -> bool:
    """Whether a direction is no direction: a model that sees none may fill in zeros."""
    return is_none(written) or (isinstance(written, list) and all(part == 0 for part in cast("list[object]", written)))


def _same_way(one: Line, other: Line) -> bool:
    if one.ends is None or other.ends is None:
        return one.ends == other.ends and one.camera == other.camera
    return all(math.dist(a, b) <= LEAST_LENGTH for a, b in zip(one.ends, other.ends, strict=True))


def _leads(ends: tuple[Point, Point], camera: CameraSense) -> bool:
    """Whether a line in the image can be that of something that moves straight towards or away from the camera."""
    (x0, y0), (x1, y1) = ends
    down = 1 if camera == "towards" else -1
    return abs(math.degrees(math.atan2(x1 - x0, down * (y1 - y0)))) <= STRAIGHT
