"""Results in words, and in a notebook: overlay, video, filmstrip and answer as HTML, or as one picture."""

from __future__ import annotations

import base64
import io
from collections.abc import Callable, Sequence
from html import escape
from typing import TYPE_CHECKING, Any

from cow_service import records
from cow_service.records import (
    MEETINGS,
    Answer,
    BackendInfo,
    Contact,
    Encounter,
    Gate,
    Outcome,
    Simulation,
    Trajectory,
    Usage,
    Verdict,
    Video,
)
from cow_service.records.world import BAND_PERCENTILES

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray
    from PIL import Image


MAX_CONTACTS = 6  # that are named


def asked_words(usage: Usage) -> str:
    """What a multimodal LLM was asked."""
    if not usage.calls:
        return "none"
    return f"{usage.calls} calls, {usage.input_tokens} tokens in, {usage.output_tokens} out"


def readiness_words(backend: BackendInfo) -> str:
    """Whether a reader or generator can be used, and what is missing where it cannot."""
    if backend.ready is None:
        return "unknown"
    return "yes" if backend.ready else f"needs {', '.join(backend.missing) or 'its weights'}"


def gate_words(gate: Gate) -> str:
    """What was answered before looking, and what came of it."""
    votes = ", ".join(f"{name} {count}" for name, count in gate.votes.items()) or "no vote"
    return f"{votes} of {gate.asked}; {gate.reason}: {'imagined' if gate.imagined else 'not imagined'}"


def band_words(trajectory: Trajectory) -> str:
    """What the band of an overlay says; empty where it has none."""
    if trajectory.law != "contact" or not trajectory.ensemble:
        return ""
    low, high = BAND_PERCENTILES
    return f"band: where {high - low}% of {trajectory.ensemble} worlds have it, across and down apart"


def worlds(probability: float) -> str:
    """A probability as people read it."""
    return f"{probability:.0%} of the worlds"


def encounter_words(encounter: Encounter, fps: float) -> str:
    """What the mover does with the other object, when, and in how many worlds."""
    sure = "" if encounter.probability is None else f" ({worlds(encounter.probability)})"
    return f"{MEETINGS[encounter.kind]} {encounter.object} at {encounter.first_frame / fps:.1f} s{sure}"


def encounters_words(trajectory: Trajectory) -> str:
    """All that the mover encounters."""
    met = [encounter_words(encounter, trajectory.fps) for encounter in trajectory.encounters]
    return ", ".join(met) or ("meets nothing" if trajectory.encounters_known else "encounters were not computed")


def first_contacts(trajectory: Trajectory) -> tuple[Contact, ...]:
    """The first contacts after the start: a thing that comes to rest touches the floor many times."""
    return tuple(contact for contact in trajectory.contacts if contact.time > 0)[:MAX_CONTACTS]


def contacts_words(trajectory: Trajectory) -> str:
    """Which two begin to touch, and when; empty where none do."""
    return ", ".join(
        f"{body_name(contact.a, trajectory)} and {body_name(contact.b, trajectory)} at {contact.time:.1f} s"
        for contact in first_contacts(trajectory)
    )


def body_name(body: int | None, trajectory: Trajectory) -> str:
    """What the body with that index is called; null is the floor."""
    return "the floor" if body is None else trajectory.bodies[body].object


def outcome_words(outcome: Outcome) -> str:
    """What the question asks, as the world answers it, and how sure that is."""
    parts = [outcome.facts.rstrip(".")] if outcome.facts else []
    value = _value(outcome)
    if value:
        parts.append(value)
    if not outcome.sure:
        parts.append("not sure")
    if outcome.depends_on:
        parts.append(f"it depends on {' and '.join(outcome.depends_on)}")
    elif outcome.robust and outcome.sure:
        parts.append("robust")
    return "; ".join(parts)


def _value(outcome: Outcome) -> str:
    sure = "" if outcome.probability is None else f", {worlds(outcome.probability)}"
    if outcome.asked.form == "which-first":
        return f"first: {outcome.first or 'none'}{sure}"
    if outcome.asked.form == "how-many":
        return "" if outcome.count is None else f"count: {outcome.count}{sure}"
    if outcome.asked.form == "when" and outcome.time is not None:
        band = "" if outcome.time_band is None else f" ({outcome.time_band[0]:.1f} to {outcome.time_band[1]:.1f} s)"
        return f"after {outcome.time:.1f} s{band}{sure}"
    if outcome.probability is None or outcome.asked.form in ("where", "what-happens"):  # the facts are the answer
        return ""
    return f"what is asked happens in {worlds(outcome.probability)}"


GetBytes = Callable[[str], bytes | None]  # the bytes of an artifact by its digest, where they are available
MAX_VIDEO_BYTES = 4 * 1024**2  # of a video that stands in the HTML: a notebook keeps it, a third larger, in its file
LARGE_PX, SMALL_PX = 260, 168  # heights: of overlay and video, and of frames
ROW_HEIGHT_PX, PICTURES_PER_ROW, GAP_PX = 240, 4, 6  # of the filmstrip
# Inherited colours, dimmed by opacity: notebooks are light or dark. Long words of callers and models break.
TEXT_STYLE = "font:14px/1.45 system-ui,sans-serif;max-width:72em;overflow-wrap:anywhere"
DIM_STYLE = "opacity:.7"
_PICTURE = "max-width:100%;border-radius:4px;display:block"
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


def describe_answer(answer: Verdict) -> str:
    """What was answered, in words."""
    if answer.answer is None:
        return "not sure"
    return answer.answer if answer.option is None else f"{answer.answer}: {answer.option}"


def simulation_html(simulation: Simulation, get: GetBytes) -> str:
    """Overlay, video, the frames side by side, and what was found, as HTML that needs nothing from the network."""
    return _block(escape(simulation.question), _body(simulation, get))


def answer_html(answer: Answer, get: GetBytes) -> str:
    """The answer, then the simulation that it was reasoned on."""
    parts = [f'<div style="font-size:16px;font-weight:600;{_LONG_TEXT}">{escape(describe_answer(answer))}</div>']
    if answer.reasoning:
        parts.append(f'<div style="{_LONG_TEXT}">{escape(answer.reasoning)}</div>')
    if sum(answer.votes.values()) > 1:
        votes = ", ".join(f"{name} {count}" for name, count in answer.votes.items())
        parts.append(f'<div style="{DIM_STYLE}">votes: {escape(votes)}</div>')
    if answer.gate is not None:
        parts.append(f'<div style="{DIM_STYLE}">before looking: {escape(gate_words(answer.gate))}</div>')
    if answer.baseline is not None:
        parts.append(f'<div style="{DIM_STYLE}">without frames: {escape(describe_answer(answer.baseline))}</div>')
    if answer.simulation is not None:
        parts.append(_body(answer.simulation, get))
        own = [warning for warning in answer.warnings if warning not in answer.simulation.warnings]
    else:
        own = list(answer.warnings)
    return _block(escape(answer.question), "".join(parts) + _warnings(own))


def filmstrip_png(simulation: Simulation, get: GetBytes) -> bytes | None:
    """Overlay and frames, a few in a row, as PNG; None where none of them has been downloaded."""
    names = [simulation.overlay.sha256, *(frame.sha256 for frame in simulation.frames)]
    pictures = [picture_of(data) for data in map(get, names) if data is not None]
    if not pictures:
        return None
    from PIL import Image  # noqa: PLC0415

    sized = [p.resize((max(1, round(p.width * ROW_HEIGHT_PX / p.height)), ROW_HEIGHT_PX)) for p in pictures]
    rows = [sized[first : first + PICTURES_PER_ROW] for first in range(0, len(sized), PICTURES_PER_ROW)]
    width = max(sum(p.width + GAP_PX for p in row) for row in rows) - GAP_PX
    strip = Image.new("RGB", (width, len(rows) * (ROW_HEIGHT_PX + GAP_PX) - GAP_PX), "white")
    for number, row in enumerate(rows):
        left = 0
        for picture in row:
            strip.paste(picture, (left, number * (ROW_HEIGHT_PX + GAP_PX)))
            left += picture.width + GAP_PX
    buffer = io.BytesIO()
    strip.save(buffer, "PNG")
    return buffer.getvalue()


def _block(heading: str, body: str) -> str:
    return f'<div style="{TEXT_STYLE}"><div style="{DIM_STYLE};{_LONG_TEXT}">{heading}</div>{body}</div>'


def _body(simulation: Simulation, get: GetBytes) -> str:
    image = simulation.image
    trajectory = simulation.trajectory
    found = "; ".join(filter(None, ("what was found", band_words(trajectory))))
    large = [_picture(get(simulation.overlay.sha256), image.width / image.height, LARGE_PX, found)]
    if simulation.video is not None:
        large.append(_video(get(simulation.video.sha256), simulation.video))
    frames = [
        _picture(get(frame.sha256), frame.width / frame.height, SMALL_PX, f"frame {frame.index}, {frame.time:.2f} s")
        for frame in simulation.frames
    ]
    shown = _row(large) + _row(frames)
    said = simulation.motion.sentence
    if simulation.encounters_known:
        said += f" It {encounters_words(trajectory)}."
    lines = [said]
    if contacts := contacts_words(trajectory):
        lines.append(f"Contacts: {contacts}.")
    if trajectory.outcome is not None and (outcome := outcome_words(trajectory.outcome)):
        lines.append(f"Outcome: {outcome}.")
    if trajectory.moving_until is not None:
        lines.append(f"Nothing moves in the image from {trajectory.moving_until:.1f} s on.")
    return shown + "".join(f"<div>{escape(text)}</div>" for text in lines) + _warnings(simulation.warnings)


def _row(figures: Sequence[str]) -> str:
    return f'<div style="display:flex;flex-wrap:wrap;gap:10px {GAP_PX}px;margin:8px 0">{"".join(figures)}</div>'


def _picture(data: bytes | None, ratio: float, height: int, caption: str) -> str:
    if data is None:
        return _figure(_placeholder("not downloaded", ratio, height), ratio, height, caption)
    media_type = "image/png" if data.startswith(b"\x89PNG") else "image/jpeg"
    source = f"data:{media_type};base64,{base64.b64encode(data).decode()}"
    style = f"max-height:{height}px;{_PICTURE}"
    return _figure(f'<img src="{source}" alt="{escape(caption)}" style="{style}">', ratio, height, caption)


def _video(data: bytes | None, video: Video) -> str:
    """The clip as a player; where it is not there, or too large for the file of a notebook, what to do instead."""
    ratio, caption = video.width / video.height, f"video, {video.num_frames / video.fps:.1f} s"
    if data is None:
        inner = _placeholder("video not downloaded", ratio, LARGE_PX)
    elif len(data) > MAX_VIDEO_BYTES:
        note = f"The video has {len(data) / 1024**2:.1f} MB, too much to be shown here: save(folder) writes it."
        inner = _placeholder(note, ratio, LARGE_PX)
    else:
        source = f"data:video/mp4;base64,{base64.b64encode(data).decode()}"
        style = f"max-height:{LARGE_PX}px;{_PICTURE}"
        inner = f'<video controls loop muted playsinline aria-label="{caption}" src="{source}" style="{style}"></video>'
    return _figure(inner, ratio, LARGE_PX, caption)


def _placeholder(text: str, ratio: float, height: int) -> str:
    size = f"height:{height - 2}px;max-width:100%;aspect-ratio:{ratio:.3f}"
    return f'<div style="{size};{_PLACEHOLDER}">{escape(text)}</div>'


def _figure(inner: str, ratio: float, height: int, caption: str) -> str:
    """A picture or a video, with words below it that are no wider."""
    said = f'<figcaption style="{DIM_STYLE}">{escape(caption)}</figcaption>'
    return f'<figure style="margin:0;max-width:{max(ratio * height, height):.0f}px">{inner}{said}</figure>'


def _warnings(warnings: Sequence[Any]) -> str:
    return "".join(f'<div style="{DIM_STYLE}">Note: {escape(str(warning))}</div>' for warning in warnings)


HEADINGS = ("role", "name", "ready", "licence", "weights", "to make it ready")
# Words break only where they are wider than their column: else those of narrow columns would.
_CELL = "padding:3px 14px 3px 0;text-align:left;vertical-align:top;overflow-wrap:break-word"


class Models(records.Models):
    """Readers and generators, what each needs, and whether it is ready.

    >>> [generator.name for generator in client.models().generators if generator.default]
    ['cutout']
    """

    def __repr__(self) -> str:
        rows = [
            (role, _name(backend), one_line("; ".join((readiness_words(backend), *_commands(backend)))))
            for role, backend in self._backends()
        ]
        widths = [max((len(row[column]) for row in rows), default=0) for column in (0, 1)]
        return "\n".join(f"{role:<{widths[0]}}  {name:<{widths[1]}}  {said}" for role, name, said in rows)

    __str__ = __repr__

    def _repr_html_(self) -> str:
        head = "".join(f'<th style="{_CELL}">{heading}</th>' for heading in HEADINGS)
        rows = ""
        for role, backend in self._backends():
            name = f'<b>{escape(_name(backend))}</b><div style="{DIM_STYLE}">{escape(backend.summary)}</div>'
            commands = "".join(f"<div><code>{escape(command)}</code></div>" for command in _commands(backend))
            words = escape(readiness_words(backend)), escape(backend.licence or ""), escape(backend.weights or "none")
            cells = "".join(f'<td style="{_CELL}">{cell}</td>' for cell in (role, name, *words, commands))
            rows += f"<tr>{cells}</tr>"
        table = f'<table style="border-collapse:collapse"><thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table>'
        table = f'<div style="overflow-x:auto">{table}</div>'
        named = escape(", ".join(self.mllms)) or "none"
        return f'<div style="{TEXT_STYLE}">{table}<div style="{DIM_STYLE}">COW_MLLM may name: {named}</div></div>'

    def _backends(self) -> list[tuple[str, BackendInfo]]:
        readers = [("reader", backend) for backend in self.readers]
        return readers + [("generator", backend) for backend in self.generators]


def _name(backend: BackendInfo) -> str:
    return one_line(backend.name) + (" (default)" if backend.default else "")


def _commands(backend: BackendInfo) -> tuple[str, ...]:
    """The commands that bring what is missing."""
    return tuple(filter(None, (backend.install, backend.pull)))


class SimulationView(Simulation):
    """A simulation as a notebook and a terminal show it."""

    def picture_bytes(self, sha256: str) -> bytes | None:
        """The bytes of a picture or the video; None where they are not available."""
        raise NotImplementedError

    def __repr__(self) -> str:
        words = one_line(f"{self.grounding.object} {encounters_words(self.trajectory)}")
        return f"<{type(self).__name__} {self.id}: {words}; {len(self.frames)} frames>"

    __str__ = __repr__

    def _repr_html_(self) -> str:
        return simulation_html(self, self.picture_bytes)

    def _repr_png_(self) -> bytes | None:
        return filmstrip_png(self, self.picture_bytes)


class AnswerView(Answer):
    """An answer as a notebook and a terminal show it."""

    simulation: SimulationView | None  # pyright: ignore[reportIncompatibleVariableOverride] - frozen: nobody assigns it

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self.id}: {one_line(describe_answer(self))}>"

    __str__ = __repr__

    def _repr_html_(self) -> str:
        return answer_html(self, (lambda _: None) if self.simulation is None else self.simulation.picture_bytes)

    def _repr_png_(self) -> bytes | None:
        return None if self.simulation is None else self.simulation._repr_png_()  # pyright: ignore[reportPrivateUsage]
