"""What the tools return as data: the records of the service without the thousands of numbers of a trajectory."""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel, ConfigDict, Field

from cow_service import records
from cow_service.client.wording import body_name, first_contacts, outcome_words
from cow_service.mcp.images import ARTIFACTS
from cow_service.mcp.inputs import lean
from cow_service.records import Doubt, EncounterKind, Law, MotionKind


class Result(BaseModel):
    """Something that a tool returns; fields of the service's records that it does not have are left out."""

    model_config = ConfigDict(frozen=True, extra="ignore")


class Encounter(Result):
    """The mover meets another thing: a hypothesis, computed from the image alone."""

    object: str
    kind: EncounterKind = Field(
        description="touches; occludes: the mover passes in front of it; occluded-by: the mover passes behind it."
    )
    time_s: float = Field(description="When it begins, seconds from now.")
    frame: int = Field(description="When it begins, frame of the clip.")
    probability: float | None = Field(
        description="Share of the simulated worlds in which it happens; null where they were not counted."
    )
    share: float | None = Field(description="Of an occlusion: the largest share that is covered.")


class Contact(Result):
    """Two things begin to touch in the likeliest world."""

    a: str
    b: str = Field(description="The other thing, or `the floor`.")
    time_s: float


class Outcome(Result):
    """What the question asks, as the simulated world answers it: a hypothesis with a probability."""

    summary: str = Field(description="In words.")
    probability: float | None = Field(description="That what is asked happens, or of the value below.")
    first: str | None = Field(description="What is met first, where that is asked.")
    count: int | None = Field(description="How many, where that is asked.")
    time_s: float | None = Field(description="Seconds until it happens.")
    sure: bool = Field(description="Whether the world is certain enough for an answer.")
    robust: bool = Field(description="Whether at least 90% of the worlds give the answer.")
    depends_on: list[Doubt] = Field(description="What the answer depends on, most first.")


class Frame(Result):
    """One of the returned pictures, after the overlay and in this order."""

    index: int = Field(description="Frame of the clip.")
    time_s: float
    sha256: str
    width: int
    height: int


class Video(Result):
    """The clip as mp4."""

    sha256: str
    uri: str = Field(description="The resource that holds it.")
    url: str | None = Field(description="Its address on the COW server; null where that has none.")
    fps: float
    num_frames: int
    width: int
    height: int


class SimulateResult(Result):
    """What `simulate` returns."""

    id: str
    object: str = Field(description="What moves.")
    bbox: list[float] = Field(description="Where it is now, [x0, y0, x1, y1], pixels of the image.")
    motion: str = Field(description="How it moves, in a sentence.")
    kind: MotionKind
    direction: list[float] | None = Field(
        description="Unit vector [dx, dy], x right, y down; null for a fall or a thing that stays."
    )
    speed: float = Field(description="Pixels per second at first.")
    law: Law = Field(description="contact: floor, bounces, pushes; ballistic: straight through everything.")
    leaves_at_s: float | None = Field(description="When its centre leaves the image; null where it stays inside.")
    encounters: list[Encounter] = Field(description="What it meets on its way, in order of time.")
    encounters_known: bool = Field(description="Whether an empty list of encounters means that it meets nothing.")
    contacts: list[Contact] = Field(description="The first contacts, in order of time.")
    moving_until_s: float | None = Field(
        description="From when nothing moves in the image any more; null where it is not known or something still does."
    )
    outcome: Outcome | None = Field(description="Null where the question asks for nothing that the world can tell.")
    frames: list[Frame]
    video: Video | None
    overlay_sha256: str = Field(description="The image with box, direction and path drawn: the first picture.")
    image_sha256: str = Field(description="Give this as `image` to ask about the same image again.")
    image_width: int = Field(description="Pixels.")
    image_height: int = Field(description="Pixels.")
    generator: str
    reader: str
    warnings: list[str] = Field(description="What was assumed or could be meant otherwise.")


class Verdict(Result):
    """An answer without imagined frames, for comparison."""

    answer: str | None
    option: str | None
    not_sure: bool
    votes: dict[str, int]


class Usage(Result):
    """What the multimodal LLM of the service was asked."""

    calls: int
    input_tokens: int
    output_tokens: int


class AnswerResult(Result):
    """What `answer` returns."""

    id: str
    answer: str | None = Field(
        description="A letter, or text where the question is open; null where it is not sure and no option says so."
    )
    option: str | None = Field(description="Text of the option with that letter.")
    not_sure: bool
    reasoning: str = Field(description="The answerer's own; empty where nobody reasons.")
    votes: dict[str, int]
    gate: records.Gate | None = Field(description="Of `imagine` auto: what decided whether to imagine.")
    baseline: Verdict | None
    warnings: list[str] = Field(description="What was assumed or could be meant otherwise.")
    simulation: SimulateResult | None = Field(description="What was imagined; null where nothing was, or that failed.")
    image_sha256: str = Field(description="Give this as `image` to ask about the same image again.")
    reader: str
    usage: Usage = Field(description="What it cost.")
    usage_total: Usage = Field(description="What it would have cost if nothing had been known from earlier calls.")


def simulate_result(simulation: records.Simulation, base_url: str | None) -> SimulateResult:
    """A simulation as a tool returns it; `base_url` is the address of its server, where that has one."""
    motion, trajectory, video = simulation.motion, simulation.trajectory, simulation.video
    hidden = [not visible for visible in trajectory.path.visible]
    return SimulateResult(
        id=simulation.id,
        object=simulation.grounding.object,
        bbox=_rounded(simulation.grounding.bbox, 1),
        motion=motion.sentence,
        kind=motion.kind,
        direction=None if motion.direction is None else _rounded(motion.direction, 3),
        speed=round(motion.speed, 1),
        law=trajectory.law,
        leaves_at_s=round(hidden.index(True) / trajectory.fps, 2) if any(hidden) else None,
        encounters=[_encounter(e, trajectory.fps) for e in sorted(trajectory.encounters, key=lambda e: e.first_frame)],
        encounters_known=simulation.encounters_known,
        contacts=[_contact(contact, trajectory) for contact in first_contacts(trajectory)],
        moving_until_s=None if trajectory.moving_until is None else round(trajectory.moving_until, 2),
        outcome=None if trajectory.outcome is None else _outcome(trajectory.outcome),
        frames=[Frame(time_s=round(frame.time, 2), **frame.model_dump()) for frame in simulation.frames],
        video=None if video is None else _video(video, base_url),
        overlay_sha256=simulation.overlay.sha256,
        image_sha256=simulation.image.sha256,
        image_width=simulation.image.width,
        image_height=simulation.image.height,
        generator=simulation.generator.name,
        reader=simulation.reader.name,
        warnings=list(simulation.warnings),
    )


def answer_result(answer: records.Answer, base_url: str | None) -> AnswerResult:
    """An answer as a tool returns it."""
    own = {
        "simulation": None if answer.simulation is None else simulate_result(answer.simulation, base_url),
        "image_sha256": answer.image.sha256,
        "reader": answer.reader.name,
    }
    return AnswerResult.model_validate(answer.model_dump(exclude={"simulation"}) | own)


def output_schema(model: type[Result]) -> dict[str, Any]:
    """The JSON schema of what a tool returns."""
    return lean(model.model_json_schema(mode="serialization"))


def _encounter(encounter: records.Encounter, fps: float) -> Encounter:
    return Encounter(
        object=encounter.object,
        kind=encounter.kind,
        time_s=round(encounter.first_frame / fps, 2),
        frame=encounter.first_frame,
        probability=_maybe(encounter.probability),
        share=_maybe(encounter.share),
    )


def _contact(contact: records.Contact, trajectory: records.Trajectory) -> Contact:
    return Contact(
        a=body_name(contact.a, trajectory), b=body_name(contact.b, trajectory), time_s=round(contact.time, 2)
    )


def _outcome(outcome: records.Outcome) -> Outcome:
    return Outcome(
        summary=outcome_words(outcome),
        probability=_maybe(outcome.probability),
        first=outcome.first,
        count=outcome.count,
        time_s=_maybe(outcome.time),
        sure=outcome.sure,
        robust=outcome.robust,
        depends_on=list(outcome.depends_on),
    )


def _video(video: records.Video, base_url: str | None) -> Video:
    url = None if base_url is None else base_url + video.url
    return Video(uri=ARTIFACTS + video.sha256, url=url, **video.model_dump(exclude={"url"}))


def _maybe(value: float | None) -> float | None:
    return None if value is None else round(value, 2)


def _rounded(values: tuple[float, ...], digits: int) -> list[float]:
    return [round(value, digits) for value in values]
