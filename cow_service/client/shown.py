"""How results look in a notebook: overlay, filmstrip and answer as HTML, or as one picture."""

from __future__ import annotations

import base64
import io
from collections.abc import Callable, Sequence
from html import escape
from typing import TYPE_CHECKING, Any

from cow_service.records import MEETINGS, Answer, Frame, Simulation, Verdict

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray
    from PIL import Image

Held = Callable[[str], bytes | None]  # the bytes of an artifact, where they have been downloaded
STRIP_HEIGHT, IN_A_ROW = 240, 4  # px, of a row of the one picture; pictures
GAP = 6  # px
# Inherited colours, dimmed by opacity: notebooks are light or dark. Long words of callers and models break.
_TEXT = "font:14px/1.45 system-ui,sans-serif;max-width:72em;overflow-wrap:anywhere"
_DIM = "opacity:.7"
_PICTURE = "max-height:168px;max-width:100%;border-radius:4px;display:block"
_PLACE = f"border:1px dashed;border-radius:4px;display:grid;place-items:center;{_DIM}"
_LONG = "white-space:pre-wrap;max-height:14em;overflow:auto;margin:4px 0"


def picture_of(data: bytes) -> Image.Image:
    """A PNG as a PIL image, RGB."""
    from PIL import Image  # noqa: PLC0415

    with Image.open(io.BytesIO(data)) as opened:
        return opened.convert("RGB")


def stacked(pictures: Sequence[Image.Image]) -> NDArray[np.uint8]:
    """Pictures of one size as one array (pictures, height, width, 3), RGB, uint8."""
    import numpy as np  # noqa: PLC0415

    return np.stack([np.asarray(picture, dtype=np.uint8) for picture in pictures])


def brief(text: str, most: int = 120) -> str:
    """The text on one line, cut where it is long."""
    line = " ".join(text.split())
    return line if len(line) <= most else f"{line[: most - 1]}…"


def met(simulation: Simulation) -> str:
    """What the mover encounters, in words."""
    fps = simulation.trajectory.fps
    told = [f"{MEETINGS[e.kind]} {e.object} at {e.first_frame / fps:.1f} s" for e in simulation.trajectory.encounters]
    return ", ".join(told) or ("meets nothing" if simulation.encounters_known else "encounters were not computed")


def answered(answer: Verdict) -> str:
    """What was answered, in words."""
    if answer.answer is None:
        return "not sure"
    return answer.answer if answer.option is None else f"{answer.answer}: {answer.option}"


def simulation_html(simulation: Simulation, held: Held) -> str:
    """The overlay, the frames side by side, and what was found, as HTML that needs nothing from the network."""
    return _block(escape(simulation.question), _body(simulation, held))


def answer_html(answer: Answer, held: Held) -> str:
    """The answer, then what was imagined for it."""
    parts = [f'<div style="font-size:16px;font-weight:600;{_LONG}">{escape(answered(answer))}</div>']
    if answer.reasoning:
        parts.append(f'<div style="{_LONG}">{escape(answer.reasoning)}</div>')
    if sum(answer.votes.values()) > 1:
        told = ", ".join(f"{name} {count}" for name, count in answer.votes.items())
        parts.append(f'<div style="{_DIM}">votes: {escape(told)}</div>')
    if answer.baseline is not None:
        parts.append(f'<div style="{_DIM}">without frames: {escape(answered(answer.baseline))}</div>')
    if answer.simulation is not None:
        parts.append(_body(answer.simulation, held))
        own = [warning for warning in answer.warnings if warning not in answer.simulation.warnings]
    else:
        own = list(answer.warnings)
    return _block(escape(answer.question), "".join(parts) + _notes(own))


def filmstrip_png(simulation: Simulation, held: Held) -> bytes | None:
    """Overlay and frames, a few in a row, as PNG; None where none of them has been downloaded."""
    names = [simulation.overlay.sha256, *(frame.sha256 for frame in simulation.frames)]
    pictures = [picture_of(data) for data in map(held, names) if data is not None]
    if not pictures:
        return None
    from PIL import Image  # noqa: PLC0415

    sized = [p.resize((max(1, round(p.width * STRIP_HEIGHT / p.height)), STRIP_HEIGHT)) for p in pictures]
    rows = [sized[first : first + IN_A_ROW] for first in range(0, len(sized), IN_A_ROW)]
    width = max(sum(p.width + GAP for p in row) for row in rows) - GAP
    strip = Image.new("RGB", (width, len(rows) * (STRIP_HEIGHT + GAP) - GAP), "white")
    for number, row in enumerate(rows):
        left = 0
        for picture in row:
            strip.paste(picture, (left, number * (STRIP_HEIGHT + GAP)))
            left += picture.width + GAP
    buffer = io.BytesIO()
    strip.save(buffer, "PNG")
    return buffer.getvalue()


def _block(heading: str, body: str) -> str:
    return f'<div style="{_TEXT}"><div style="{_DIM};{_LONG}">{heading}</div>{body}</div>'


def _body(simulation: Simulation, held: Held) -> str:
    image = simulation.image
    pictures = [_figure(held(simulation.overlay.sha256), image.width / image.height, "what was found")]
    pictures += [
        _figure(held(frame.sha256), frame.width / frame.height, _caption(frame)) for frame in simulation.frames
    ]
    strip = f'<div style="display:flex;flex-wrap:wrap;gap:10px {GAP}px;margin:8px 0">{"".join(pictures)}</div>'
    said = simulation.motion.sentence
    if simulation.encounters_known:
        said += f" It {met(simulation)}."
    return strip + f"<div>{escape(said)}</div>" + _notes(simulation.warnings)


def _caption(frame: Frame) -> str:
    return f"frame {frame.index}, {frame.time:.2f} s"


def _figure(data: bytes | None, ratio: float, caption: str) -> str:
    if data is None:
        size = f"height:166px;max-width:100%;aspect-ratio:{ratio:.3f}"
        inner = f'<div style="{size};{_PLACE}">not downloaded</div>'
    else:
        coded = base64.b64encode(data).decode()
        inner = f'<img src="data:image/png;base64,{coded}" alt="{escape(caption)}" style="{_PICTURE}">'
    return f'<figure style="margin:0">{inner}<figcaption style="{_DIM}">{escape(caption)}</figcaption></figure>'


def _notes(warnings: Sequence[Any]) -> str:
    return "".join(f'<div style="{_DIM}">Note: {escape(str(warning))}</div>' for warning in warnings)
