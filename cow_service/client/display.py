"""Results in words, and as HTML for a notebook: overlay, video, frames and answer."""

from __future__ import annotations

import base64
import io
from collections.abc import Callable, Iterable, Mapping, Sequence
from html import escape
from typing import TYPE_CHECKING

from cow_service import records

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray
    from PIL import Image


MAX_CONTACTS = 6  # that are named


def asked_words(usage: records.Usage, total: records.Usage) -> str:
    """What a multimodal LLM was asked, and what it would have been asked in total without reuse."""
    if usage != total:
        return f"{asked_words(usage, usage)}; without reuse {asked_words(total, total)}"
    return f"{usage.calls} calls, {usage.input_tokens} tokens in, {usage.output_tokens} out" if usage.calls else "none"


def readiness_words(backend: records.BackendInfo) -> str:
    """Whether a reader or generator can be used, and what is missing where it cannot."""
    if backend.ready is None:
        return "unknown"
    return "yes" if backend.ready else f"needs {', '.join(backend.missing) or 'its weights'}"


def answer_facts(answer: records.Answer) -> dict[str, str]:
    """How the votes went, and what was answered without looking; by what that is called."""

    def votes(counts: Mapping[str, int]) -> str:
        return ", ".join(f"{name} {count}" for name, count in counts.items()) or "no vote"

    facts = {"votes": votes(answer.votes)} if sum(answer.votes.values()) > 1 else {}
    if (gate := answer.gate) is not None:
        came = "imagined" if gate.imagined else "not imagined"
        facts["before looking"] = f"{votes(gate.votes)} of {gate.asked}; {gate.reason}: {came}"
    if (alone := answer.baseline) is not None:
        facts["without frames"] = f"{describe_answer(alone)}; votes {votes(alone.votes)}"
    return facts


def band_words(trajectory: records.Trajectory) -> str:
    """What the band of an overlay says; empty where it has none."""
    if trajectory.law != "contact" or not trajectory.ensemble:
        return ""
    low, high = records.BAND_PERCENTILES
    return f"band: where {high - low}% of {trajectory.ensemble} simulated versions have it, across and down apart"


def counted(probability: float, versions: int) -> str:
    """A probability as people read it."""
    if not versions:
        return f"probability {probability:.0%}"
    return f"{round(probability * versions)} of {versions} simulated versions"


def encounters_words(trajectory: records.Trajectory) -> str:
    """What the moving object encounters, when, and in how many versions."""
    met: list[str] = []
    for each in trajectory.encounters:
        sure = "" if each.probability is None else f" ({counted(each.probability, trajectory.ensemble)})"
        time = each.first_frame / trajectory.fps if each.time is None else each.time
        met.append(f"{records.MEETINGS[each.kind]} {each.object} after {time:.1f} s{sure}")
    on = trajectory.bodies[0].support if trajectory.bodies else "floor"
    nothing = "hits nothing" if on in ("floor", "air") else f"hits nothing but {on}, which it is on from the start"
    return ", ".join(met) or (nothing if trajectory.encounters_known else "encounters were not computed")


def contacts_words(trajectory: records.Trajectory) -> str:
    """Which two begin to touch, and when; empty where none do.

    Only the first few after the start: a thing that comes to rest touches the floor many times.
    """
    names: dict[int | None, str] = {None: "the floor", **{i: body.object for i, body in enumerate(trajectory.bodies)}}
    first = [contact for contact in trajectory.contacts if contact.time > 0][:MAX_CONTACTS]
    return ", ".join(f"{names[each.a]} and {names[each.b]} after {each.time:.1f} s" for each in first)


GetBytes = Callable[[str], bytes | None]  # the bytes of an artifact by its digest, where they are available
MAX_VIDEO_BYTES = 4 * 1024**2  # of a video that stands in the HTML: a notebook keeps it, a third larger, in its file
LARGE_PX, SMALL_PX = 260, 168  # heights: of overlay and video, and of frames
GAP_PX = 6  # between frames
# Inherited colours, dimmed by opacity: notebooks are light or dark. Long words of callers and models break.
TEXT_STYLE = "font:14px/1.45 system-ui,sans-serif;max-width:72em;overflow-wrap:anywhere"
DIM_STYLE = "opacity:.7"
_PLACEHOLDER = f"border:1px dashed;border-radius:4px;display:grid;place-items:center;{DIM_STYLE}"
_LONG_TEXT = "white-space:pre-wrap;max-height:14em;overflow:auto;margin:4px 0"


def picture_of(data: bytes) -> Image.Image:
    """A PNG as a PIL image, RGB."""
    from PIL import Image  # noqa: PLC0415

    with Image.open(io.BytesIO(data)) as opened:
        return opened.convert("RGB")


def stacked(pictures: Sequence[Image.Image]) -> NDArray[np.uint8]:
    """Pictures of one size as one array (pictures, height, width, 3), RGB, uint8."""
    import numpy as np  # noqa: PLC0415

    return np.stack([np.asarray(picture, dtype=np.uint8) for picture in pictures])


def one_line(text: str, most: int = 120) -> str:
    """The text on one line, cut where it is long."""
    line = " ".join(text.split())
    return line if len(line) <= most else f"{line[: most - 1]}…"


def describe_answer(answer: records.Verdict) -> str:
    """What was answered, in words."""
    if answer.answer is None:
        return "not sure"
    return answer.answer if answer.option is None else f"{answer.answer} ({answer.option})"


def simulation_html(simulation: records.Simulation, get: GetBytes) -> str:
    """Overlay, video, the frames side by side, and what was found, as HTML that needs nothing from the network."""
    said = _line(simulation.narration.summary, f"font-size:16px;font-weight:600;{_LONG_TEXT}")
    return _block(simulation.question, said + _found(simulation, get))


def answer_html(answer: records.Answer, get: GetBytes) -> str:
    """The answer, then the simulation that it was reasoned on."""
    body = _line(describe_answer(answer), f"font-size:16px;font-weight:600;{_LONG_TEXT}")
    if answer.reasoning:
        body += _line(answer.reasoning, _LONG_TEXT)
    body += "".join(_line(f"{name}: {said}", DIM_STYLE) for name, said in answer_facts(answer).items())
    shown: tuple[str, ...] = ()
    if answer.simulation is not None:
        body += _found(answer.simulation, get)
        shown = answer.simulation.warnings
    return _block(answer.question, body + _notes(warning for warning in answer.warnings if warning not in shown))


def _found(simulation: records.Simulation, get: GetBytes) -> str:
    """Pictures, and what was found."""
    image, trajectory, video = simulation.image, simulation.trajectory, simulation.video
    caption = "; ".join(filter(None, ("what was found", band_words(trajectory))))
    large = _figure(get(simulation.overlay.sha256), image.width / image.height, LARGE_PX, caption)
    if video is not None:
        data, instead = get(video.sha256), "video not downloaded"
        if data is not None and len(data) > MAX_VIDEO_BYTES:
            size = f"{len(data) / 1024**2:.1f} MB"
            data, instead = None, f"The video has {size}, too much to be shown here: save(folder) writes it."
        caption = f"video, {video.num_frames / video.fps:.1f} s"
        large += _figure(data, video.width / video.height, LARGE_PX, caption, instead)
    frames = "".join(
        _figure(get(frame.sha256), frame.width / frame.height, SMALL_PX, f"frame {frame.index}, {frame.time:.2f} s")
        for frame in simulation.frames
    )
    row = f"display:flex;flex-wrap:wrap;gap:10px {GAP_PX}px;margin:8px 0"
    met = f" It {encounters_words(trajectory)}." if simulation.encounters_known else ""
    lines = [simulation.motion.sentence + met]
    if contacts := contacts_words(trajectory):
        lines.append(f"Contacts: {contacts}.")
    if simulation.narration.story:
        lines.append(simulation.narration.story)
    if trajectory.moving_until is not None:
        lines.append(f"Nothing moves in the image from {trajectory.moving_until:.1f} s on.")
    pictures = "".join(f'<div style="{row}">{figures}</div>' for figures in (large, frames))
    return pictures + "".join(f"<div>{escape(line)}</div>" for line in lines) + _notes(simulation.warnings)


def _figure(data: bytes | None, ratio: float, height: int, caption: str, instead: str = "not downloaded") -> str:
    """A picture or a video, or a text instead, with words below it that are no wider."""
    words, style = escape(caption), f"max-height:{height}px;max-width:100%;border-radius:4px;display:block"
    if data is None:
        size = f"height:{height - 2}px;max-width:100%;aspect-ratio:{ratio:.3f}"
        inner = _line(instead, f"{size};{_PLACEHOLDER}")
    else:
        is_video = data[4:8] == b"ftyp"
        media_type = "video/mp4" if is_video else "image/png" if data.startswith(b"\x89PNG") else "image/jpeg"
        source = f'src="data:{media_type};base64,{base64.b64encode(data).decode()}" style="{style}"'
        video = f'<video controls loop muted playsinline aria-label="{words}" {source}></video>'
        inner = video if is_video else f'<img alt="{words}" {source}>'
    said = f'<figcaption style="{DIM_STYLE}">{words}</figcaption>'
    return f'<figure style="margin:0;max-width:{max(ratio * height, height):.0f}px">{inner}{said}</figure>'


def _line(text: str, style: str) -> str:
    return f'<div style="{style}">{escape(text)}</div>'


def _notes(warnings: Iterable[str]) -> str:
    return "".join(_line(f"Note: {warning}", DIM_STYLE) for warning in warnings)


def _block(heading: str, body: str) -> str:
    return f'<div style="{TEXT_STYLE}">{_line(heading, f"{DIM_STYLE};{_LONG_TEXT}")}{body}</div>'


class Models(records.Models):
    """Readers and generators, what each needs, and whether it is ready.

    >>> [generator.name for generator in client.models().generators if generator.default]
    ['cutout']
    """

    def __repr__(self) -> str:
        rows: list[tuple[str, str, str]] = []
        for role, backends in (("reader", self.readers), ("generator", self.generators)):
            for backend in backends:
                name = one_line(backend.name) + (" (default)" if backend.default else "")
                said = "; ".join(filter(None, (readiness_words(backend), backend.install, backend.pull)))
                rows.append((role, name, one_line(said)))
        widths = [max((len(row[column]) for row in rows), default=0) for column in (0, 1)]
        return "\n".join(f"{role:<{widths[0]}}  {name:<{widths[1]}}  {said}" for role, name, said in rows)

    __str__ = __repr__


class SimulationView(records.Simulation):
    """A simulation as a terminal shows it."""

    def __repr__(self) -> str:
        words = one_line(f"{self.grounding.object} {encounters_words(self.trajectory)}")
        return f"<{type(self).__name__} {self.id}: {words}; {len(self.frames)} frames>"

    __str__ = __repr__


class AnswerView(records.Answer):
    """An answer as a terminal shows it."""

    simulation: SimulationView | None  # pyright: ignore[reportIncompatibleVariableOverride] - frozen: nobody assigns it

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self.id}: {one_line(describe_answer(self))}>"

    __str__ = __repr__
