"""Frozen records that the server, the SDK and the HTTP API share.

Coordinates are pixels of the upright input image, x right, y down, (0, 0) the image's top left corner.
Times are seconds from the first frame. Records hold no pixels and do no I/O: bytes are named by their SHA-256.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

Point = tuple[float, float]
BBox = tuple[float, float, float, float]
Vector = tuple[float, float]
State = tuple[float, float, float, float, float, float]
Sha256 = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]

Source = Literal["mllm", "embedded", "request"]
MotionKind = Literal["linear", "projectile", "fall", "static"]
DIRECTED_KINDS: tuple[MotionKind, ...] = ("linear", "projectile")  # these need a direction, and have a speed
FALLING_KINDS: tuple[MotionKind, ...] = ("projectile", "fall")  # these are in the air, and gravity acts on them
Cue = Literal["arrow", "trail", "orientation", "text", "gravity", "request"]
EncounterKind = Literal["touches", "occludes", "occluded-by"]
FramePolicy = Literal["initial", "uniform", "events"]


class Record(BaseModel):
    """A frozen record; unknown fields are an error, so that a misspelt one is never ignored."""

    # Validators are built when first used: whoever imports the SDK or the command line must not wait for all of them.
    model_config = ConfigDict(frozen=True, extra="forbid", defer_build=True)


class Artifact(Record):
    """Bytes kept by the service. It names them; it does not hold them."""

    sha256: Sha256
    url: str = Field(description="Path of the bytes on the server that made them.")
    media_type: str
    size: int = Field(ge=0, description="Bytes.")


class ImageInfo(Record):
    """The input image, upright. `sha256` is that of the bytes as they were sent."""

    width: int = Field(gt=0, description="Pixels.")
    height: int = Field(gt=0, description="Pixels.")
    sha256: Sha256


class LocatedObject(Record):
    """Something in the image, in words and with its box."""

    object: str
    bbox: BBox = Field(description="[x0, y0, x1, y1], px.")


class Grounding(Record):
    """Stage 1: which object moves, and where it is. It does not say how it moves."""

    object: str = Field(description="Words that single it out.")
    point: Point = Field(description="[x, y], px: the centre of the box, or where a reader pointed that gave no box.")
    bbox: BBox = Field(description="[x0, y0, x1, y1], px.")
    mask: Artifact | None = Field(default=None, description="PNG of the image's size, white where the object is.")
    others: tuple[LocatedObject, ...] = Field(
        default=(), description="Other things that the question names, where they were found."
    )
    source: Source


class MetresPerPixel(Record):
    """The scale of the scene at the object, and where it came from."""

    value: float = Field(gt=0, description="Metres per pixel at the object's depth.")
    source: Literal["default", "reference", "request"]
    note: str = Field(default="", description="What it was taken from, in words.")


class Motion(Record):
    """Stage 2: how the object moves. It does not say where it gets to."""

    kind: MotionKind
    direction: Vector | None = Field(description="Unit vector in the image, px; null for a fall or a static object.")
    depth: float = Field(
        default=0.0,
        ge=-1,
        le=1,
        description="Sine of the angle out of the image plane: positive away from the camera, negative towards it.",
    )
    cue: Cue
    along_arrow: bool | None = Field(default=None, description="Along or against it, where the cue is an arrow.")
    speed: float = Field(ge=0, description="px/s at the depth of the first frame.")
    gravity: Vector = Field(default=(0.0, 0.0), description="px/s^2.")
    metres_per_pixel: MetresPerPixel
    sentence: str = Field(description="The motion in one declarative sentence: the generator's prompt.")
    source: Source


class Encounter(Record):
    """The mover's silhouette meets another object on its way. Computed from the image alone: a hypothesis."""

    object: str
    bbox: BBox = Field(description="[x0, y0, x1, y1], px, of the other object.")
    first_frame: int = Field(ge=0, description="The first clip frame of the encounter.")
    kind: EncounterKind


class TrajectoryUnits(Record):
    """Units of `Trajectory.states`."""

    position: Literal["m"] = "m"
    velocity: Literal["m/s"] = "m/s"
    frame: Literal["camera: x right, y down, z depth"] = "camera: x right, y down, z depth"


class Trajectory(Record):
    """Stage 3: where the object's centre is in every frame of the clip, and what it meets."""

    fps: float = Field(gt=0, description="Frames per second of the clip.")
    states: tuple[State, ...] = Field(description="[x, y, z, vx, vy, vz] per frame: the 6-D state of the object.")
    units: TrajectoryUnits = TrajectoryUnits()
    points: tuple[Point, ...] = Field(description="[x, y] per frame, px.")
    visible: tuple[bool, ...] = Field(description="Per frame: the point is inside the image.")
    scale: tuple[float, ...] = Field(description="Per frame: apparent size, 1 at the first frame.")
    tracks: tuple[tuple[Point, ...], ...] = Field(
        description="Several points inside the object's mask, each [x, y] per frame, px."
    )
    tracks_visible: tuple[tuple[bool, ...], ...] | None = Field(
        default=None, description="Per track and frame, where it was given: the point can be seen."
    )
    anchors: tuple[Point, ...] = Field(description="Static points that hold the camera still, px.")
    encounters: tuple[Encounter, ...] = ()
    encounters_known: bool = Field(
        default=True, description="False where the surroundings could not be told apart: then nothing is listed."
    )


class Frame(Record):
    """One picture of the clip."""

    index: int = Field(ge=0, description="Which frame of the clip.")
    time: float = Field(ge=0, description="Seconds.")
    url: str
    sha256: Sha256
    width: int = Field(gt=0, description="Pixels.")
    height: int = Field(gt=0, description="Pixels.")


class Video(Record):
    """The clip as H.264 in MP4."""

    url: str
    sha256: Sha256
    fps: float = Field(gt=0)
    num_frames: int = Field(gt=0)
    width: int = Field(gt=0, description="Pixels.")
    height: int = Field(gt=0, description="Pixels.")


class ReaderInfo(Record):
    """Who read the image, and what would have to be the same to read it so again."""

    name: str
    model: str | None = Field(default=None, description="The multimodal LLM, as it is served.")
    revision: str | None = None
    prompts: dict[str, int] = Field(default_factory=dict, description="Version of each prompt that it was sent.")
    stages: tuple[Literal["grounding", "motion", "answering"], ...] = Field(
        default=(), description="The stages it was asked for; the others came with the request."
    )


class Usage(Record):
    """What the multimodal LLM was asked, re-asks and failed tries that it counted included."""

    calls: int = Field(default=0, ge=0)
    input_tokens: int = Field(default=0, ge=0)
    output_tokens: int = Field(default=0, ge=0)

    def __add__(self, other: Usage) -> Usage:
        return Usage(
            calls=self.calls + other.calls,
            input_tokens=self.input_tokens + other.input_tokens,
            output_tokens=self.output_tokens + other.output_tokens,
        )


class GeneratorInfo(Record):
    """Who made the frames, and what would have to be the same to make them again."""

    name: str
    model: str | None = None
    revision: str | None = None
    seed: int
    steps: int | None = Field(default=None, description="Sampling steps; null where there are none.")
    options: dict[str, bool | int | float | str] = Field(default_factory=dict)


MEETINGS: dict[EncounterKind, str] = {
    "touches": "touches",
    "occludes": "passes in front of",
    "occluded-by": "passes behind",
}  # what the mover does with the other object, in words


class Clip(Record):
    """Stage 4: the frames chosen for reasoning, the whole clip as video where it is wanted, and the overlay."""

    frames: tuple[Frame, ...]
    video: Video | None = None
    overlay: Artifact
    generator: GeneratorInfo


class Simulation(Record):
    """The whole way from image and question to frames: what `POST /simulate` returns."""

    id: str
    status: Literal["succeeded"] = "succeeded"
    created_at: str = Field(description="RFC 3339, UTC.")
    question: str
    image: ImageInfo
    grounding: Grounding
    motion: Motion
    trajectory: Trajectory
    frames: tuple[Frame, ...] = Field(description="The frames chosen for reasoning.")
    video: Video | None = Field(description="Null where the request said `video: false`.")
    overlay: Artifact = Field(description="The input with box, point, arrow and path drawn.")
    generator: GeneratorInfo
    reader: ReaderInfo
    usage: Usage = Usage()
    timings: dict[str, float] = Field(description="Seconds per stage.")
    reused: tuple[str, ...] = Field(
        default=(), description="Stages whose result was found again: an earlier request had asked for the same."
    )
    warnings: tuple[str, ...] = ()

    @property
    def encounters_known(self) -> bool:
        """Whether an empty list of encounters means that nothing is met."""
        return self.trajectory.encounters_known


class ProblemField(BaseModel):
    """One invalid field."""

    pointer: str = Field(description="JSON Pointer (RFC 6901) into the request.")
    detail: str


class Problem(BaseModel):
    """Why a request failed (RFC 9457)."""

    type: str = Field(description="Stable URI; its last segment is the code.")
    title: str = Field(description="The kind of error, the same for every occurrence.")
    status: int
    detail: str = Field(description="What was wrong, with the value, and what to do.")
    errors: list[ProblemField] = Field(default_factory=list[ProblemField])

    @property
    def code(self) -> str:
        """The last segment of the type, such as `cannot-ground`."""
        return self.type.rpartition(":")[2]


class AnswerOption(Record):
    """One of the answers that a question offers."""

    letter: str = Field(pattern="^[A-Z]$")
    text: str


class Verdict(Record):
    """What was answered, and how sure that is. The reasoning is the answerer's own; none is made up for it."""

    answer: str | None = Field(
        description="A letter, or text for an open question; null where it is not sure and no option says so."
    )
    option: str | None = Field(default=None, description="Text of the option with that letter.")
    not_sure: bool
    reasoning: str = ""
    votes: dict[str, int] = Field(
        default_factory=dict, description="How often each was answered; `not sure` where no option says so."
    )


class Answer(Verdict):
    """The way from image and question to an answer: what `POST /answer` returns."""

    id: str
    status: Literal["succeeded"] = "succeeded"
    created_at: str = Field(description="RFC 3339, UTC.")
    question: str
    options: tuple[AnswerOption, ...] = Field(description="From the request or the question; empty where it is open.")
    image: ImageInfo
    simulation: Simulation | None = Field(description="Null where nothing was imagined, or that failed.")
    simulation_problem: Problem | None = Field(default=None, description="Why imagining failed, where it did.")
    baseline: Verdict | None = Field(description="The answer without frames, where it was asked for.")
    reader: ReaderInfo
    usage: Usage = Field(description="Of everything together: simulation, votes and baseline.")
    timings: dict[str, float] = Field(description="Seconds per stage.")
    reused: tuple[str, ...] = Field(
        default=(), description="Stages whose result was found again: an earlier request had asked for the same."
    )
    warnings: tuple[str, ...] = ()


class BackendInfo(Record):
    """A reader or generator: what it is, what it needs, whether it is ready."""

    name: str
    default: bool = Field(description="Used where a request names none.")
    ready: bool | None = Field(description="Null where nothing is known of it before it is used.")
    needs: tuple[str, ...] = Field(default=(), description="Python modules that it uses.")
    summary: str
    licence: str | None = None
    weights: str | None = Field(default=None, description="Repository of its weights; null where it has none.")
    missing: tuple[str, ...] = Field(
        default=(), description="Python modules that are not installed, and settings (COW_...) that are not set."
    )
    install: str | None = Field(default=None, description="The command that installs them.")
    pull: str | None = Field(
        default=None, description="The command that downloads its weights, where they are not here."
    )
    defaults: dict[str, bool | int | float | str] = Field(default_factory=dict)


class Models(Record):
    """What `GET /models` returns."""

    readers: tuple[BackendInfo, ...]
    generators: tuple[BackendInfo, ...]
    mllms: tuple[str, ...] = Field(default=(), description="Manifests of multimodal LLMs: what `COW_MLLM` may name.")


JobKind = Literal["simulate", "answer"]
JobStatus = Literal["queued", "running", "succeeded", "failed", "canceled"]
TERMINAL: tuple[JobStatus, ...] = ("succeeded", "failed", "canceled")


class Job(Record):
    """A request that was accepted. Once its status is succeeded, failed or canceled it never changes again."""

    id: str
    kind: JobKind
    status: JobStatus
    stage: str | None = Field(default=None, description="The stage that it is in, or was in when it ended.")
    progress: float = Field(ge=0, le=1, description="Share of the work that is done, all stages together.")
    created_at: str = Field(description="RFC 3339, UTC.")
    finished_at: str | None = Field(default=None, description="RFC 3339, UTC.")
    generator: str = Field(description="Who makes its frames.")
    result: Simulation | Answer | None = Field(default=None, description="Of a succeeded job, but not in lists.")
    problem: Problem | None = Field(default=None, description="Of a failed job.")


class JobPage(Record):
    """Some jobs, newest first."""

    jobs: tuple[Job, ...]
    next: str | None = Field(default=None, description="`cursor` of the page after this one; null on the last.")
