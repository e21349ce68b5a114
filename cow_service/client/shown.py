"""How results look in a notebook: overlay, filmstrip and answer as HTML, or as one picture."""

from __future__ import annotations

import base64
import io
from collections.abc import Callable, Sequence
from html import escape
from typing import TYPE_CHECKING, Any

from cow_service.records import ENCOUNTERS_UNKNOWN, Answer, Frame, Simulation

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray
    from PIL import Image

Held = Callable[[str], bytes | None]  # the bytes of an artifact, where they have been downloaded
STRIP_HEIGHT = 240  # px, of the one picture
GAP = 6  # px
_TEXT = "font-family:system-ui,sans-serif;font-size:14px;line-height:1.4;max-width:60em"
_PICTURE = "max-height:240px;max-width:100%;border-radius:4px;display:block"


def picture_of(data: bytes) -> Image.Image:
    """A PNG as a PIL image, RGB."""
    from PIL import Image  # noqa: PLC0415

    with Image.open(io.BytesIO(data)) as opened:
        return opened.convert("RGB")


def stacked(pictures: Sequence[Image.Image]) -> NDArray[np.uint8]:
    """Pictures of one size as one array (pictures, height, width, 3), RGB, uint8."""
    import numpy as np  # noqa: PLC0415

    return np.stack([np.asarray(picture, dtype=np.uint8) for picture in pictures])


def met(simulation: Simulation) -> str:
    """What the mover encounters, in words."""
    fps = simulation.trajectory.fps
    told = [f"{e.kind} {e.object} at {e.first_frame / fps:.1f} s" for e in simulation.trajectory.encounters]
    return ", ".join(told) or ("meets nothing" if simulation.encounters_known else ENCOUNTERS_UNKNOWN)


def answered(answer: Answer) -> str:
    """What was answered, in words."""
    if answer.answer is None:
        return "not sure"
    return answer.answer if answer.option is None else f"{answer.answer}: {answer.option}"


def simulation_html(simulation: Simulation, held: Held) -> str:
    """The overlay, the frames side by side, and what was found, as HTML that needs nothing from the network."""
    return _block(escape(simulation.question), _body(simulation, held))


def answer_html(answer: Answer, held: Held) -> str:
    """The answer, then what was imagined for it."""
    parts = [f"<div><b>{escape(answered(answer))}</b></div>"]
    if answer.reasoning:
        parts.append(f"<div>{escape(answer.reasoning)}</div>")
    if answer.baseline is not None:
        told = answer.baseline.answer or "not sure"
        parts.append(f"<div>without frames: {escape(told)}</div>")
    if answer.simulation is not None:
        parts.append(_body(answer.simulation, held))
        own = [warning for warning in answer.warnings if warning not in answer.simulation.warnings]
    else:
        own = list(answer.warnings)
    return _block(escape(answer.question), "".join(parts) + _notes(own))


def filmstrip_png(simulation: Simulation, held: Held) -> bytes | None:
    """Overlay and frames side by side as PNG; None where none of them has been downloaded."""
    names = [simulation.overlay.sha256, *(frame.sha256 for frame in simulation.frames)]
    pictures = [picture_of(data) for data in map(held, names) if data is not None]
    if not pictures:
        return None
    from PIL import Image  # noqa: PLC0415

    sized = [p.resize((max(1, round(p.width * STRIP_HEIGHT / p.height)), STRIP_HEIGHT)) for p in pictures]
    strip = Image.new("RGB", (sum(p.width for p in sized) + GAP * (len(sized) - 1), STRIP_HEIGHT), "white")
    left = 0
    for picture in sized:
        strip.paste(picture, (left, 0))
        left += picture.width + GAP
    buffer = io.BytesIO()
    strip.save(buffer, "PNG")
    return buffer.getvalue()


def _block(heading: str, body: str) -> str:
    return f'<div style="{_TEXT}"><div style="opacity:.7">{heading}</div>{body}</div>'


def _body(simulation: Simulation, held: Held) -> str:
    pictures = [_figure(held(simulation.overlay.sha256), simulation.overlay.url, "what was found")]
    pictures += [_figure(held(frame.sha256), frame.url, _caption(frame)) for frame in simulation.frames]
    strip = f'<div style="display:flex;flex-wrap:wrap;gap:{GAP}px;margin:6px 0">{"".join(pictures)}</div>'
    said = f"{simulation.motion.sentence} It {met(simulation)}." if simulation.encounters_known else (
        f"{simulation.motion.sentence}"
    )  # fmt: skip
    return strip + f"<div>{escape(said)}</div>" + _notes(simulation.warnings)


def _caption(frame: Frame) -> str:
    return f"frame {frame.index}, {frame.time:.2f} s"


def _figure(data: bytes | None, url: str, caption: str) -> str:
    if data is None:
        inner = f'<div style="{_PICTURE};padding:2em;border:1px dashed">{escape(url)}</div>'
    else:
        coded = base64.b64encode(data).decode()
        inner = f'<img src="data:image/png;base64,{coded}" alt="{escape(caption)}" style="{_PICTURE}">'
    return f'<figure style="margin:0">{inner}<figcaption style="opacity:.7">{escape(caption)}</figcaption></figure>'


def _notes(warnings: Sequence[Any]) -> str:
    return "".join(f'<div style="opacity:.7">Note: {escape(str(warning))}</div>' for warning in warnings)
