"""Results to share: a film with question, futures and verdict, a still picture of it for a link, a page to play with.

What has to decode a picture or a video runs in a process of its own (`make_apart`).
"""

import base64
import html
import json
import math
import os
import re
import subprocess
import sys
import tempfile
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import islice
from pathlib import Path
from string import Template

import cv2
import numpy as np
from pydantic import TypeAdapter

from cow_service.concurrency import leave_decisions_to_the_parent
from cow_service.errors import InternalError
from cow_service.media.artifacts import media_type_of
from cow_service.media.images import decode, encode_jpeg, fit_within
from cow_service.media.overlay import DARK, LIGHT, PATH, Image, in_letters_thread
from cow_service.media.video import FORMATS, animation, frames_in, write_mp4
from cow_service.records import Answer, Simulation, verdict_of

SIDES = 720, 480, 320  # px: the first whose film is small enough for a chat
PICTURE = 1280  # px, of the picture in a page
SMALL_ENOUGH = 3 * 1024**2  # bytes
CARD = 1200, 630  # px: what pages show of a link
FUTURES, VERDICT = 1.4, 2.0  # s for which the futures fade before the film, and for which the verdict stays after it
AFTER = 0.6  # s that the film goes on once nothing moves
MARGIN, LINE, LETTER, LARGE = 0.03, 1.35, 0.036, 0.052  # of the width; of a letter; of the width; of a verdict's
MOST_LINES = 3
GREY, GREEN = (170, 178, 175), (95, 208, 186)


@dataclass(frozen=True)
class Told:
    """What a film says beside its pictures."""

    question: str
    verdict: str
    worlds: int  # that were run
    agreeing: str  # how many of them agree; empty where none were counted
    share: float | None  # of the versions that agree
    futures: tuple[tuple[tuple[float, float], ...], ...]  # of the picture's width: the mover in other worlds
    path: tuple[tuple[float, float], ...]
    until: float  # s: nothing moves afterwards
    shown: int  # the frame of the still

    @staticmethod
    def of(result: Simulation | Answer, simulation: Simulation, given: str) -> "Told":
        """Of a job's result and its simulation; `given` is the direction in words, where not the question tells it."""
        trajectory, width = simulation.trajectory, simulation.image.width
        path, narration = trajectory.paths[0], simulation.narration
        share = None if trajectory.outcome is None else narration.share
        is_of_simulation = not isinstance(result, Answer) or result.reasoning == narration.summary
        agreeing = (narration.agreement if is_of_simulation else "") or narration.summary
        seen = path.points[: path.visible.index(False)] if False in path.visible else path.points
        met = [each.first_frame for each in trajectory.encounters]
        return Told(
            question=f"{result.question} (Asked of another direction: {given}.)" if given else result.question,
            verdict=verdict_of(result) or simulation.motion.sentence,
            worlds=trajectory.ensemble,
            agreeing="" if share is None else agreeing,
            share=share,
            futures=tuple(tuple((x / width, y / width) for x, y in future) for future in path.futures),
            path=tuple((x / width, y / width) for x, y in seen),
            until=trajectory.moving_until or trajectory.num_frames / trajectory.fps,
            shown=met[0] if met else min(len(seen), trajectory.num_frames) // 2,
        )


def film(video: bytes, told: Told) -> bytes:
    """An mp4: the futures fade over the first frame, the film plays, and the verdict is shown.

    It is made smaller where it would not fit into a chat (`SMALL_ENOUGH`). Its frames are read as they are needed.
    """
    made = b""
    for side in SIDES:
        first, fps = next(frames_in(video, side))
        sheet = _Sheet(first, told)
        height, width = sheet.shape
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "film.mp4"
            pictures = sheet.pictures((frame for frame, _ in frames_in(video, side)), fps)
            write_mp4(pictures, path, fps=fps, width=width, height=height)
            made = path.read_bytes()
        if len(made) <= SMALL_ENOUGH:
            break
    return made


def card(video: bytes, told: Told) -> bytes:
    """A JPEG of `CARD`: one moment with the path and other futures, question and verdict."""
    frame, _ = deque(islice(frames_in(video, SIDES[0]), told.shown + 1), maxlen=1).pop()
    sheet, canvas = _Sheet(frame, told), np.full((CARD[1], CARD[0], 3), DARK[0], np.uint8)
    sheet.draw_futures(frame, 0.5)
    _line(frame, told.path, max(2, round(frame.shape[1] / 240)))
    picture = sheet.around(frame, True)
    scale = min(CARD[0] / picture.shape[1], CARD[1] / picture.shape[0])
    size = round(picture.shape[1] * scale), round(picture.shape[0] * scale)
    x, y = (CARD[0] - size[0]) // 2, (CARD[1] - size[1]) // 2
    canvas[y : y + size[1], x : x + size[0]] = cv2.resize(picture, size, interpolation=cv2.INTER_CUBIC)
    return encode_jpeg(canvas)


class _Sheet:
    """A frame with the question above it and the verdict below."""

    def __init__(self, frame: Image, told: Told) -> None:
        self.told, (self.height, self.width) = told, frame.shape[:2]
        at_most = self.width * (1 - 2 * MARGIN)
        self.lines = in_letters_thread(_wrapped, told.question, LETTER * self.width, at_most)
        self.above = round(2 * MARGIN * self.width + LINE * LETTER * self.width * len(self.lines))  # px
        below = round(2.4 * MARGIN * self.width + LINE * (LARGE + LETTER) * self.width)
        self.shape = self.above + self.height + below, self.width

    def pictures(self, frames: Iterator[Image], fps: float) -> Iterator[Image]:
        """All of the film, one after another."""
        fading = round(FUTURES * fps) if self.told.futures else 0
        frame = next(frames)
        for number in range(fading):
            first = frame.copy()
            self.draw_futures(first, 1 - number / fading)
            yield self.around(first, False)
        yield self.around(frame, False)
        for frame in islice(frames, round((self.told.until + AFTER) * fps)):
            yield self.around(frame, False)
        told = self.around(frame, True)
        for _ in range(round(VERDICT * fps)):
            yield told

    def around(self, frame: Image, is_told: bool) -> Image:
        """A frame with its words, including the verdict if it is shown."""
        canvas = np.full((*self.shape, 3), DARK[0], np.uint8)
        canvas[self.above : self.above + self.height] = frame
        in_letters_thread(self._write, canvas, is_told)
        return canvas

    def _write(self, canvas: Image, is_told: bool) -> None:
        told, width = self.told, self.width
        margin, letter, large = MARGIN * width, LETTER * width, LARGE * width
        for place, line in enumerate(self.lines):
            _put(canvas, line, margin, margin + (place + 0.8) * LINE * letter, letter, LIGHT)
        top = self.above + self.height + margin
        if not is_told:
            waiting = f"{told.worlds} imagined futures" if told.worlds else ""
            _put(canvas, waiting, margin, top + 0.8 * LINE * large, letter, GREY)
            return
        verdict = _cut(told.verdict, large, width - 2 * margin)
        _put(canvas, verdict, margin, top + 0.8 * LINE * large, large, LIGHT, bold=True)
        line = top + LINE * large
        if told.share is not None:
            x0, x1, y = round(margin), round(margin + 0.16 * width), round(line + 0.65 * letter)
            for end, colour in ((x1, (70, 78, 76)), (round(x0 + told.share * (x1 - x0)), GREEN)):
                cv2.rectangle(canvas, (x0, y - round(letter / 5)), (end, y + round(letter / 5)), colour, -1)
            margin += 0.19 * width
        room = width - margin - MARGIN * width
        small = letter * min(1.0, max(0.7, room / max(1.0, 1.1 * _across(told.agreeing, letter))))
        _put(canvas, _cut(told.agreeing, small, room), margin, line + LINE * letter * 0.8, small, GREY)

    def draw_futures(self, frame: Image, opacity: float) -> None:
        """Other worlds' paths of the mover, translucent."""
        layer = frame.copy()
        for future in self.told.futures:
            _line(layer, future, max(1, round(frame.shape[1] / 400)))
        cv2.addWeighted(layer, opacity, frame, 1 - opacity, 0, frame)


# Of the page that is passed on as a file: each module after those that it imports.
MODULES = "app/geometry.js", "app/words.js", "live/world.js", "live/preview.js", "live/file.js", "vendor/rapier.js"
WEB = Path(__file__).parents[1] / "web"


def still(data: bytes) -> bytes:
    """A JPEG, `PICTURE` px at most, of an image or of a video's first frame."""
    is_video = media_type_of(data) == "video/mp4"
    image = next(frames_in(data))[0] if is_video else decode(data, max_megapixels=math.inf).pixels
    return encode_jpeg(fit_within(image, PICTURE))


def page(picture: bytes, world: str, simulation: Simulation, told: Told) -> bytes:
    """HTML that needs no network: the picture, a JPEG, and its worlds, computed anew while you drag the arrow.

    `world` is the JSON of `trajectory.live`.
    """
    parts = {name.rpartition("/")[2]: (WEB / name).read_text() for name in MODULES}
    parts["wasm"] = base64.b64encode((WEB / "vendor" / "rapier.wasm.gz").read_bytes()).decode()
    parts["world"] = world.replace("<", "\\u003c")  # a JSON text that ends no script
    if any(re.search(r"</script|<!--", text, re.IGNORECASE) for text in parts.values()):
        raise ValueError("A part of the page ends its own script.")
    scripts = [f'<script type="text/plain" id="{name}">{text}</script>' for name, text in parts.items()]
    words = {"question": told.question, "verdict": told.verdict}
    template = Template((WEB / "live" / "file.html").read_text())
    return template.substitute(
        {name: html.escape(text) for name, text in words.items()},
        image="data:image/jpeg;base64," + base64.b64encode(picture).decode(),
        width=simulation.image.width,
        height=simulation.image.height,
        worlds=json.loads(world)["worlds"],
        data="\n".join(scripts),
    ).encode()


def _line(canvas: Image, points: Sequence[tuple[float, float]], thickness: int) -> None:
    corners = np.clip(np.array(points) * canvas.shape[1], -20_000, 20_000).round().astype(np.int32).reshape(-1, 1, 2)
    cv2.polylines(canvas, [corners], False, PATH, thickness, cv2.LINE_AA)


def _face(text: str) -> cv2.FontFace:
    """A font that has the letters of a text."""
    return cv2.FontFace("sans" if all(ord(letter) < 0x500 for letter in text) else "uni")


def _across(text: str, letter: float) -> float:
    """Width of a text, px."""
    left, _, width, _ = cv2.getTextSize((1, 1), text, (0, 0), _face(text), round(letter), 400)
    return left + width


def _put(
    canvas: Image, text: str, x: float, y: float, letter: float, colour: tuple[int, int, int], bold: bool = False
) -> None:
    if text:
        cv2.putText(canvas, text, (round(x), round(y)), colour, _face(text), round(letter), 700 if bold else 400)


def _cut(text: str, letter: float, width: float) -> str:
    """As much of a text as fits into a width (px)."""
    if _across(text, letter * 1.08) <= width:
        return text
    while text and _across(text + "…", letter * 1.08) > width:
        text = text[:-1]
    return text.rstrip() + "…"


def _wrapped(text: str, letter: float, width: float) -> tuple[str, ...]:
    """Lines of a text, at most `MOST_LINES`, that fit into a width (px)."""
    lines, words = [""], text.split()
    if len(words) == 1:  # a script without spaces
        words = list(text)
    joint = " " if " " in text.strip() else ""
    for word in words:
        longer = f"{lines[-1]}{joint}{word}" if lines[-1] else word
        if _across(longer, letter) <= width or not lines[-1]:
            lines[-1] = longer
        else:
            lines.append(word)
    if len(lines) > MOST_LINES:
        lines = [*lines[: MOST_LINES - 1], joint.join(lines[MOST_LINES - 1 :])]
    return tuple(_cut(line, letter / 1.08, width) for line in lines)


WITH_WORDS: dict[str, Callable[[bytes, Told], bytes]] = {"film": film, "card": card}
OF_MEDIA: dict[str, Callable[[bytes], bytes]] = {
    "still": still,
    **{name: partial(animation, format=name) for name in FORMATS},
}
TOLD = TypeAdapter[Told | None](Told | None)
INHERITED = ("PATH", "PYTHONPATH", "LD_LIBRARY_PATH", "TMPDIR", "TEMP", "SYSTEMROOT")  # of the environment: no secrets
LONGEST_SECONDS = 300


def make_apart(wanted: str, data: bytes, told: Told | None = None) -> bytes:
    """What `WITH_WORDS` or `OF_MEDIA` makes of an image or video, made by a process that has nothing else.

    A decoder with a hole gives no more than that process has. Raises `InternalError` where it fails.
    """
    command = [sys.executable, "-m", __name__, wanted]
    given = TOLD.dump_json(told) + b"\n" + data
    environment = {name: os.environ[name] for name in INHERITED if name in os.environ}
    try:
        return subprocess.run(
            command, input=given, stdout=subprocess.PIPE, env=environment, timeout=LONGEST_SECONDS, check=True
        ).stdout
    except (OSError, subprocess.SubprocessError) as error:
        raise InternalError(f"The file could not be made ({type(error).__name__}); the log says more.") from error


if __name__ == "__main__":
    leave_decisions_to_the_parent()
    line, _, media = sys.stdin.buffer.read().partition(b"\n")
    words = TOLD.validate_json(line)
    made = OF_MEDIA[sys.argv[1]](media) if words is None else WITH_WORDS[sys.argv[1]](media, words)
    sys.stdout.buffer.write(made)
