"""What a tool returns: the service's record as data without its long lists, the same as text, and pictures."""

import base64
import io
from collections.abc import Iterable, Sequence
from typing import Any

from anyio import to_thread
from mcp_types import CallToolResult, ImageContent, TextContent
from PIL import Image

from cow_service.client import AsyncClient, display
from cow_service.mcp.arguments import ARTIFACTS, ToolName
from cow_service.records import Answer, Body, Simulation
from cow_service.requests.flat import inlined

# What a model has no use for: thousands of numbers, and who made it how.
_OF_OBJECT = {"mask": True, "prior": True, "source": True, "role": True}
LEFT_OUT: dict[str, Any] = {
    "grounding": {"mask": True, "prior": True, "interventions": True, "others": {"__all__": _OF_OBJECT}},
    "motion": {
        **dict.fromkeys(("trail", "steps", "others", "gravity", "down", "metres_per_pixel", "along_arrow"), True),
        **dict.fromkeys(("depth_deviation", "speed_deviation"), True),
    },
    "trajectory": {
        **dict.fromkeys(("units", "camera", "paths", "light", "anchors", "factual", "ensemble"), True),
        "bodies": {"__all__": dict.fromkeys(Body.model_fields.keys() - {"object"}, True)},
        "contacts": {"__all__": {"point": True, "impulse": True}},
        "encounters": {"__all__": {"bbox": True, "body": True, "subject": True}},
        "placement": {"probabilities": True},
        "placed": {"__all__": {"probabilities": True}},
    },
    "frames": {"__all__": {"url": True}},
    "factual_frames": True,
    "reading": True,
    "generator": {"options": True, "revision": True, "steps": True},
    "reader": {"prompts": True, "stages": True, "revision": True},
    **dict.fromkeys(("status", "created_at", "question", "usage", "usage_total", "timings", "reused"), True),
}
LEFT_OUT_OF: dict[ToolName, dict[str, Any]] = {
    "simulate": LEFT_OUT,
    "answer": {
        **dict.fromkeys(("status", "created_at", "question", "timings", "reused", "options_source"), True),
        "simulation": LEFT_OUT,
        "reader": LEFT_OUT["reader"],
    },
}


def output_schema(tool: ToolName) -> dict[str, Any]:
    """The JSON schema of what a tool returns as data."""
    model = Simulation if tool == "simulate" else Answer
    return inlined(model.model_json_schema(mode="serialization"), LEFT_OUT_OF[tool])


async def tool_result(result: Simulation | Answer, client: AsyncClient, base_url: str | None) -> CallToolResult:
    """Downloads the pictures; `base_url` is the address of the server, where others can open it."""
    simulation = result.simulation if isinstance(result, Answer) else result
    pictures: list[ImageContent] = []
    if simulation is not None:
        names = (simulation.overlay.sha256, *(frame.sha256 for frame in simulation.frames))
        fitted = await to_thread.run_sync(fit_pictures, [await client.artifact(sha256) for sha256 in names])
        pictures = [ImageContent(data=base64.b64encode(data).decode(), mime_type=kind) for kind, data in fitted]
    tool: ToolName = "answer" if isinstance(result, Answer) else "simulate"
    data = result.model_dump(mode="json", exclude=LEFT_OUT_OF[tool])
    shown = data["simulation"] if isinstance(result, Answer) else data
    video = ""
    if simulation is not None:
        # An object that settles touches the floor many times.
        contacts = shown["trajectory"]["contacts"]
        shown["trajectory"]["contacts"] = [each for each in contacts if each["time"] > 0][: display.MAX_CONTACTS]
    if simulation is not None and simulation.video is not None:
        sha256, url = simulation.video.sha256, simulation.video.url
        video = shown["video"]["url"] = ARTIFACTS + sha256 if base_url is None else base_url + url
    text = answer_text(result, video) if isinstance(result, Answer) else simulation_text(result, video)
    return CallToolResult(content=[TextContent(text=text), *pictures], structured_content=data)


# Text


def simulation_text(simulation: Simulation, video: str) -> str:
    """What moves, how, what it meets when; which picture is which; what to mind. `video` is where the clip is."""
    narration, is_asked = simulation.narration, simulation.trajectory.outcome is not None  # else it is the story
    lines = narration.summary if is_asked else narration.agreement, *_simulation_lines(simulation, video)
    return _text(filter(None, lines), simulation.warnings, simulation.image.sha256)


def answer_text(answer: Answer, video: str) -> str:
    """The answer first, then what was imagined for it."""
    lines = [f"Answer: {display.describe_answer(answer)}."]
    if answer.reasoning:
        lines.append(f"Reasoning: {answer.reasoning}")
    lines += (f"{name.capitalize()}: {said}." for name, said in display.answer_facts(answer).items())
    if answer.simulation is not None:
        lines += ["", "Imagined:", *_simulation_lines(answer.simulation, video)]
    else:
        lines.append("Nothing was simulated: the answer is from the image alone.")
    return _text(lines, answer.warnings, answer.image.sha256)


def _text(lines: Iterable[str], warnings: Iterable[str], image: str) -> str:
    notes = (f"Note: {warning}" for warning in dict.fromkeys(warnings))
    return "\n".join([*lines, *notes, f'To ask about this image again, give image="{image}".'])


def _simulation_lines(simulation: Simulation, video: str) -> Iterable[str]:
    motion, trajectory, image = simulation.motion, simulation.trajectory, simulation.image
    box = ", ".join(f"{side:.1f}" for side in simulation.grounding.bbox)
    way = ""
    if motion.direction is not None:
        along = ", ".join(f"{part:.3g}" for part in motion.direction)
        way = f"direction [{along}] (x right, y down), {motion.speed:.1f} px/s, "
    yield motion.sentence
    yield (
        f"It is the {simulation.grounding.object} at [{box}] in the image of {image.width} x {image.height} px; "
        f"{motion.kind}, {way}law {trajectory.law}."
    )
    yield f"It {display.encounters_words(trajectory)}."
    if contacts := display.contacts_words(trajectory):
        yield f"Contacts: {contacts}."
    if simulation.narration.story:
        yield f"What happens (a hypothesis, as all of this): {simulation.narration.story}"
    if trajectory.moving_until is not None:
        yield f"Nothing moves in the image from {trajectory.moving_until:.2f} s on."
    if not all(trajectory.path.visible):
        yield f"Its centre leaves the image at {trajectory.path.visible.index(False) / trajectory.fps:.2f} s."
    frames = [f"frame {frame.index} ({frame.time:.2f} s)" for frame in simulation.frames]
    yield f"Pictures, in this order: the image with box, direction and path drawn; {', '.join(frames)}."
    if video:
        yield f"Video: {video}"
    yield f"Simulation {simulation.id}; generator {simulation.generator.name}, reader {simulation.reader.name}."


# Pictures

MAX_SIDE_PX = 1024  # models do not see more
MAX_BYTES = 500_000  # of all pictures of a result together: in base64 a third more, and clients refuse messages of 1 MB
# Tried in turn when pictures are too large, as PNGs of photographs are: quality of JPEG, scale of the sides.
_SMALLER = ((90, 1.0), (80, 1.0), (75, 0.75), (75, 0.5), (70, 0.35), (60, 0.25), (50, 0.15))
_JPEG, _PNG = "image/jpeg", "image/png"


def fit_pictures(pictures: Sequence[bytes]) -> list[tuple[str, bytes]]:
    """Media types and pictures of at most `MAX_SIDE_PX` on the longest side and `MAX_BYTES` together."""
    fitted: list[tuple[str, bytes]] = []
    for data in pictures:
        with Image.open(io.BytesIO(data)) as picture:
            kind = "JPEG" if picture.format == "JPEG" else "PNG"
            is_small = max(picture.size) <= MAX_SIDE_PX
        fitted.append((_JPEG if kind == "JPEG" else _PNG, data if is_small else _shrink(data, 1.0, kind)))
    for quality, scale in _SMALLER:
        if sum(len(data) for _, data in fitted) <= MAX_BYTES:
            break
        fitted = [(_JPEG, _shrink(picture, scale, "JPEG", quality=quality)) for picture in pictures]
    return fitted


def _shrink(data: bytes, scale: float, kind: str, **options: int) -> bytes:
    with Image.open(io.BytesIO(data)) as picture:
        small = picture.convert("RGB")
    side = scale * min(MAX_SIDE_PX, max(small.size))
    small.thumbnail((side, side), Image.Resampling.LANCZOS)
    buffer = io.BytesIO()
    small.save(buffer, kind, **options)
    return buffer.getvalue()
