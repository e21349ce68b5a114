"""The results of a request: frames, simulation, answer; and descriptions of the service and its jobs."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import BaseModel, Field

from cow_service.records.grounding import Artifact, BBox, Grounding, ImageInfo, Language, Record, Sha256
from cow_service.records.reading import Reading
from cow_service.records.stages import ReadingStage
from cow_service.records.world import Motion, Trajectory

FramePolicy = Literal["initial", "uniform", "events"]


class Frame(Record):
    """One picture of the clip."""

    index: int = Field(ge=0, description="Number of the frame in the clip.")
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
    """The reader (the part that understands image and question), in enough detail to repeat its work."""

    name: str
    model: str | None = Field(default=None, description="Name under which the multimodal LLM is served.")
    revision: str | None = None
    prompts: dict[str, int] = Field(default_factory=dict, description="Version of each prompt sent.")
    stages: tuple[ReadingStage, ...] = Field(
        default=(), description="The stages that used the reader; the request gave the others."
    )


class Usage(Record):
    """Use of the multimodal LLM, including repeats and failed tries that it counted."""

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
    """The generator (the part that makes the frames), in enough detail to make them again."""

    name: str
    model: str | None = None
    revision: str | None = None
    seed: int
    steps: int | None = Field(default=None, description="Sampling steps; null if it has none.")
    options: dict[str, bool | int | float | str] = Field(default_factory=dict)
    is_toy: bool = Field(default=False, description="Its weights are random: the frames mean nothing.")


class Clip(Record):
    """Stage 4: the frames for reasoning, the whole clip as video if requested, and the overlay."""

    frames: tuple[Frame, ...] = Field(description="The frames chosen for reasoning.")
    factual_frames: tuple[Frame, ...] = Field(
        default=(), description="The same frames of the unchanged scene, if an object is taken away or put elsewhere."
    )
    video: Video | None = Field(description="Null where the request said `video: false`.")
    overlay: Artifact = Field(
        description="JPEG of the input with box, point, arrow and path drawn, at most 1280 px on the longer side."
    )
    generator: GeneratorInfo


class Result(Record):
    """What simulations and answers have in common."""

    id: str
    status: Literal["succeeded"] = "succeeded"
    created_at: str = Field(description="RFC 3339, UTC.")
    question: str
    image: ImageInfo
    reader: ReaderInfo
    usage: Usage = Field(
        default=Usage(), description="Total use of the multimodal LLM by this request, without `reused` stages."
    )
    usage_total: Usage = Field(
        default_factory=lambda fields: fields.get("usage", Usage()),
        description="What the use would have been without reuse; in results of earlier versions, the actual use.",
    )
    timings: dict[str, float] = Field(description="Seconds per stage.")
    reused: tuple[str, ...] = Field(default=(), description="Stages whose result was cached from an earlier request.")
    warnings: tuple[str, ...] = ()


class Narration(Record):
    """What a simulation says, in words. Everything in it is also a field of the trajectory."""

    language: Language = "en"
    answer: str = Field(
        default="",
        description="The answer in a word or two, such as Yes; of questions where, or what happens, the story. Empty "
        "where nothing is asked.",
    )
    summary: str = Field(
        default="",
        description="The answer as a sentence, and how many simulated versions agree, or why it is not sure.",
    )
    agreement: str = Field(
        default="", description="The last sentence of the summary: how many versions agree. Empty where it is not sure."
    )
    share: float | None = Field(
        default=None,
        ge=0,
        le=1,
        description="Share of the versions that agree with the summary. Null without an ensemble.",
    )
    story: str = Field(default="", description="How each object goes, what it hits, and how it ends.")


class Simulation(Clip, Result):
    """The whole way from image and question to frames: what `POST /simulate` returns."""

    grounding: Grounding
    motion: Motion
    reading: Reading | None = Field(
        default=None,
        description="What the trajectory rests on, as fields of a request. Sent back with the image and the question "
        "they give the same trajectory, and each of them can be corrected. Null in results of earlier versions.",
    )
    trajectory: Trajectory
    narration: Narration = Field(default_factory=Narration, description="Empty in results of versions before 0.2.")

    @property
    def overlay_name(self) -> str:
        """The overlay's file name. Earlier versions wrote PNGs."""
        return "overlay.png" if self.overlay.media_type == "image/png" else "overlay.jpg"

    @property
    def pictures(self) -> dict[str, Sha256]:
        """The digests of its pictures by the names of files: frames, those of the scene as it is, the overlay."""
        frames = {f"frame_{frame.index:03d}.png": frame.sha256 for frame in self.frames}
        factual = {f"factual_{frame.index:03d}.png": frame.sha256 for frame in self.factual_frames}
        return frames | factual | {self.overlay_name: self.overlay.sha256}

    @property
    def encounters_known(self) -> bool:
        """Whether an empty list of encounters means that nothing is met."""
        return self.trajectory.encounters_known


class ProblemField(BaseModel):
    """One invalid field."""

    pointer: str = Field(description="JSON Pointer (RFC 6901) into the request.")
    detail: str


class MllmRefusal(BaseModel):
    """How the server of a multimodal LLM refused a call."""

    status: int = Field(description="HTTP status of its response.")
    message: str = Field(description="What was wrong, without its own words.")
    retry_after: float | None = Field(default=None, ge=0, description="Seconds to wait before the next call.")


class Problem(BaseModel):
    """Why a request failed (RFC 9457)."""

    type: str = Field(description="Stable URI whose last segment is the error code.")
    title: str = Field(description="The kind of error, the same for every occurrence.")
    status: int
    detail: str = Field(description="What was wrong, with the value, and what to do unless `remedy` says so.")
    remedy: str | None = Field(
        default=None,
        exclude_if=lambda remedy: remedy is None,
        description="What to give in the request; omitted if `detail` says everything.",
    )
    errors: list[ProblemField] = Field(default_factory=list[ProblemField])
    usage: Usage | None = Field(
        default=None,
        exclude_if=lambda usage: usage is None,
        description="Use of the multimodal LLM before the failure; omitted if there was none.",
    )
    refusal: MllmRefusal | None = Field(
        default=None,
        exclude_if=lambda refusal: refusal is None,
        description="How the multimodal LLM refused a call; omitted if it did not.",
    )

    @property
    def code(self) -> str:
        """The last segment of the type, such as `cannot-ground`."""
        return self.type.rpartition(":")[2]


OptionsSource = Literal["request", "question-letters", "question-list", "none"]


class AnswerOption(Record):
    """One of the answers to choose from."""

    letter: str = Field(pattern="^[A-Z]$")
    text: str


class Verdict(Record):
    """An answer, and how sure it is. `reasoning` is in the words of the model that answered."""

    answer: str | None = Field(
        description="A letter, or text for an open question; null if it is not sure and no option says so."
    )
    option: str | None = Field(default=None, description="Text of the option with that letter.")
    not_sure: bool
    reasoning: str = ""
    votes: dict[str, int] = Field(
        default_factory=dict, description="How often each answer was given; `not sure` if no option says so."
    )


GateReason = Literal["agreed", "disagreed", "not-sure", "unreadable"]


class Gate(Record):
    """The decision of `imagine: auto`: whether the answers from the image alone were enough."""

    answer: str | None = Field(
        description="The leading answer, as in `Verdict`; null if it is not sure and no option says so, or there is "
        "none."
    )
    votes: dict[str, int] = Field(description="How often each answer was given, as in `Verdict`.")
    asked: int = Field(ge=1, description="Votes requested; 1 if the reader always gives the same answer.")
    agreement: float = Field(ge=0, le=1, description="The leading answer's share of the requested votes.")
    threshold: float = Field(gt=0, le=1, description="`imagine_threshold` of the request.")
    imagined: bool = Field(
        description="Whether a simulation followed. If it failed, `simulation_problem` says why, and the leading "
        "answer is used."
    )
    reason: GateReason = Field(
        description="agreed: the leading answer reached the threshold and is final; disagreed: it did not, or was "
        "tied; not-sure: the leading answer is that the reader is not sure; unreadable: no vote could be read."
    )


class Answer(Verdict, Result):
    """The way from image and question to an answer: what `POST /answer` returns."""

    options: tuple[AnswerOption, ...] = Field(description="From the request or the question; empty if it is open.")
    options_source: OptionsSource = Field(
        default="none",
        description="Where the options come from: the request, letters in the question, or a list without letters in "
        "the question (which get A, B, C...).",
    )
    simulation: Simulation | None = Field(description="Null if nothing was simulated, or the simulation failed.")
    simulation_problem: Problem | None = Field(default=None, description="Why the simulation failed, if it did.")
    gate: Gate | None = Field(default=None, description="The decision of `imagine: auto`; else null.")
    baseline: Verdict | None = Field(
        description="The answer without frames, if requested; with `imagine: auto`, that of the gate."
    )


VIDEO_FILE = "video.mp4"


def artifacts_of(result: Simulation | Answer) -> dict[str, Sha256]:
    """The digests of frames, overlay and video by file name; empty for an answer without a simulation."""
    simulation = result.simulation if isinstance(result, Answer) else result
    if simulation is None:
        return {}
    return simulation.pictures | ({} if simulation.video is None else {VIDEO_FILE: simulation.video.sha256})


def verdict_of(result: Simulation | Answer) -> str:
    """The answer in words; of a simulation that of its narration, which is empty where nothing is asked."""
    if isinstance(result, Simulation):
        return result.narration.answer
    return "Not sure" if result.answer is None else result.option or result.answer


def documents_of(result: Simulation | Answer) -> dict[str, str]:
    """The result as JSON by file name; with an answer also its simulation."""
    if isinstance(result, Simulation):
        return {"simulation.json": _text(result)}
    simulation = {} if result.simulation is None else documents_of(result.simulation)
    return simulation | {"answer.json": _text(result)}


def _text(record: Record) -> str:
    return record.model_dump_json(indent=2) + "\n"


BackendKind = Literal["reader", "generator", "finder", "segmenter", "detector", "depth", "inpainter"]


class BackendInfo(Record):
    """A reader, a generator or a vision model: what it is, what it needs, whether it is ready."""

    name: str
    kind: BackendKind | None = Field(default=None, description="Null only from servers of earlier versions.")
    default: bool = Field(description="Used if a request names none; for vision models: used by the server.")
    ready: bool | None = Field(description="Null if this is unknown until it is used.")
    needs: tuple[str, ...] = Field(default=(), description="Python modules that it uses.")
    summary: str
    licence: str | None = None
    weights: str | None = Field(default=None, description="Repository of its weights; null if it has none.")
    missing: tuple[str, ...] = Field(
        default=(), description="Python modules that are not installed, and settings (COW_...) that are not set."
    )
    install: str | None = Field(default=None, description="The command that installs them.")
    pull: str | None = Field(default=None, description="The command that downloads its weights, if they are missing.")
    defaults: dict[str, bool | int | float | str] = Field(default_factory=dict)


OutputMode = Literal["json_schema", "json_object", "prompt"]
Delivery = Literal["whole", "streamed", "declared"]


class Coordinates(Record):
    """How a family of MLLMs writes places. Nothing infers it from the size of the numbers."""

    units: Literal["thousandths", "fractions", "pixels"] = Field(
        description="Of width and height, or absolute pixels of the image as the model sees it."
    )
    axes: Literal["xy", "yx"] = Field(default="xy", description="Which of a pair of numbers comes first.")
    box_form: Literal["corners", "size"] = Field(
        default="corners", description="Whether a box is two corners, or a corner and the width and height."
    )
    box: str = Field(default="bbox_2d", description="The key under which it writes a box.")
    point: str = Field(default="point_2d", description="The key under which it writes a point.")

    @property
    def words(self) -> str:
        """Such as "pixels, x first, two corners"."""
        form = "two corners" if self.box_form == "corners" else "a corner, width and height"
        return f"{self.units}, {self.axes[0]} first, {form}"


class ServerCapabilities(Record):
    """What a server takes of a call for one model."""

    output: OutputMode = Field(
        default="json_schema", description="How a reply is held to its form; `prompt`: by the prompt alone."
    )
    token_field: Literal["max_tokens", "max_completion_tokens"] = "max_tokens"
    temperature: bool = True
    seed: bool = True
    system_role: bool = True
    delivery: Delivery = Field(
        default="whole",
        description="How it replies. `declared`: it wants `stream: true`, and replies in one piece all the same.",
    )
    images: int | None = Field(default=None, description="Per call, at most; null where no limit is known.")
    reduction: int = Field(default=0, description="Steps by which images are made smaller, so that a call is accepted.")


class MllmMeasurement(Record):
    """What `cow models check --save` has measured of a model: the readers then go by it."""

    coordinates: Coordinates | None = Field(default=None, description="Where they are not those of its family.")
    bbox_deviation: float = Field(ge=0, le=1, description="Of the edges of its boxes, one standard deviation in sides.")
    direction_deviation: float = Field(ge=0, le=90, description="Of its directions, one standard deviation, degrees.")


class MllmStatus(Record):
    """The multimodal LLM of `COW_MLLM`, as far as it is known without calling it."""

    name: str = Field(description="As it is served.")
    family: str = Field(description="Which says how it writes places.")
    takes: ServerCapabilities | None = Field(
        default=None, description="What its server takes; null where nothing was learned of that in the last week."
    )
    measured: MllmMeasurement | None = Field(default=None, description="Null before `cow models check --save`.")


class Models(Record):
    """What `GET /models` returns."""

    readers: tuple[BackendInfo, ...]
    generators: tuple[BackendInfo, ...]
    perception: tuple[BackendInfo, ...] = Field(default=(), description="Vision models.")
    mllms: tuple[str, ...] = Field(default=(), description="Multimodal LLMs that `COW_MLLM` may name.")
    mllm: MllmStatus | None = Field(default=None, description="The one that it names; null without one.")


class SeenObject(Record):
    """An object that the server's vision models see."""

    bbox: BBox = Field(description="[x0, y0, x1, y1], px.")
    mask: str | None = Field(
        description="data:image/png;base64,...: white on the object; null if its outline is uncertain."
    )
    score: float = Field(ge=0, le=1, description="Confidence of the model.")
    name: str | None = Field(default=None, description="The noun that was searched for.")


class Look(Record):
    """What `POST /look` returns."""

    image: Sha256 = Field(description="Digest of the image, for later looks while the server keeps it in memory.")
    width: int
    height: int
    things: tuple[SeenObject, ...] = Field(
        description="Best first; without a segmenter smallest first. "
        "At a point there may be several objects within each other, or none that is certain."
    )


JobKind = Literal["simulate", "answer"]
JobStatus = Literal["queued", "running", "succeeded", "failed", "canceled"]
TERMINAL: tuple[JobStatus, ...] = ("succeeded", "failed", "canceled")


class Job(Record):
    """A request that was accepted. Once its status is succeeded, failed or canceled it never changes again."""

    id: str
    kind: JobKind
    status: JobStatus
    stage: str | None = Field(default=None, description="The current stage, or the last one when the job ended.")
    progress: float = Field(ge=0, le=1, description="Share of the work that is done, all stages together.")
    question: str | None = Field(
        default=None,
        description="The question; in lists cut to 200 characters, the last of them `…`. Null for jobs of earlier "
        "versions.",
    )
    answer: str | None = Field(
        default=None,
        description="The answer, or the verdict of a simulation, in at most 200 characters. Null until the job has "
        "succeeded, if there was no question to answer, and for jobs of earlier versions.",
    )
    given: tuple[str, ...] = Field(
        default=(),
        description="Which of `grounding`, `motion`, `trajectory`, `objects`, `interventions` and `camera` the "
        "request gave instead of leaving it to the reader.",
    )
    image: Sha256 | None = Field(
        default=None, description="Artifact of the request's image; null for jobs of earlier versions."
    )
    created_at: str = Field(description="RFC 3339, UTC.")
    finished_at: str | None = Field(default=None, description="RFC 3339, UTC.")
    position: int | None = Field(
        default=None,
        ge=0,
        description="Number of jobs ahead of it, if it is queued and requested by its id; else null.",
    )
    expected_wait: float | None = Field(
        default=None, ge=0, description="Seconds until it starts, at the rate of the last minutes; null if unknown."
    )
    generator: str = Field(description="The generator of its frames.")
    result: Simulation | Answer | None = Field(default=None, description="Result of a succeeded job; not in lists.")
    problem: Problem | None = Field(default=None, description="Why the job failed.")


class AcceptedRequest(Record):
    """The request that became a job."""

    kind: JobKind = Field(description="`simulate`: of `POST /simulate`; `answer`: of `POST /answer`.")
    request: dict[str, Any] = Field(
        description="The body, ready to be sent again: image and masks as artifacts, without default values and "
        "without the webhook."
    )


class JobPage(Record):
    """Some jobs, newest first."""

    jobs: tuple[Job, ...]
    next: str | None = Field(default=None, description="`cursor` of the page after this one; null on the last.")


ProcessRole = Literal["all", "api", "worker"]


class GpuMemory(Record):
    """Memory of one GPU."""

    device: str = Field(description="Such as cuda:0.")
    allocated_mb: float = Field(ge=0, description="In use by the process, MB.")
    reserved_mb: float = Field(ge=0, description="Held by the process, MB.")
    total_mb: float = Field(ge=0, description="Of the device, MB.")


class WorkerJob(Record):
    """A running job: its progress, never its question or its owner."""

    id: str | None = Field(default=None, description="Null for callers who do not administer the server.")
    kind: JobKind
    stage: str | None = None
    progress: float = Field(ge=0, le=1, description="Share of the work that is done, all stages together.")
    seconds: float = Field(ge=0, description="Time since it started.")


class WorkerLoad(Record):
    """What the jobs of a worker are waiting for."""

    cpu_waiting: int = Field(ge=0, description="Jobs that wait for a CPU.")
    mllm_calls: int = Field(ge=0, description="Calls of a multimodal LLM without a reply yet.")
    mllm_limit: int = Field(ge=0, description="Most calls at the same time; adapts to the LLM. 0: no LLM.")
    mllm_waiting: int = Field(ge=0, description="Calls that wait for other calls to end.")


class WorkerInfo(Record):
    """What computes jobs: a worker process, or the threads of the server itself (`COW_WORKERS=0`)."""

    name: str = Field(description="Its queue and a number.")
    queue: str | None = Field(description="The queue that it takes jobs from; null: all queues.")
    pid: int | None = Field(default=None, description="Null for callers who do not administer the server.")
    memory_mb: float = Field(ge=0, description="Resident memory, MB (10^6 bytes).")
    jobs_done: int = Field(ge=0)
    jobs: tuple[WorkerJob, ...] = Field(default=(), description="Running jobs; several if jobs wait for an LLM.")
    gpus: tuple[GpuMemory, ...] = Field(default=(), description="GPUs that it uses.")
    load: WorkerLoad | None = Field(default=None, description="Null while this is unknown.")


class ProcessInfo(Record):
    """One process on the job database: a server, or `cow worker`."""

    executor_id: str
    seen_at: str = Field(description="RFC 3339, UTC, by the clock of that process.")
    role: ProcessRole
    host: str | None = Field(default=None, description="Null for callers who do not administer the server.")
    pid: int | None = Field(default=None, description="Null for callers who do not administer the server.")
    version: str = Field(description="Version of COW.")
    workflow_version: str = Field(description="Of its own jobs; it takes those of earlier versions, too.")
    queues: dict[str, int] = Field(
        default_factory=dict, description="Queues that it takes jobs from, and how many jobs of each at the same time."
    )
    workers: tuple[WorkerInfo, ...] = ()


class QueueInfo(Record):
    """One queue."""

    name: str
    queued: int = Field(ge=0, description="Jobs that wait.")
    running: int = Field(ge=0, description="Running jobs.")
    capacity: int = Field(ge=0, description="Most running jobs in all processes.")
    oldest_seconds: float | None = Field(default=None, ge=0, description="How long the oldest of `queued` has waited.")
    jobs_per_minute: float = Field(ge=0, description="Jobs ended per minute, over the last five minutes.")


class Unserved(Record):
    """Waiting jobs that no process takes."""

    queue: str
    workflow_version: str
    jobs: int = Field(gt=0)
    reason: Literal["version", "queue"] = Field(
        description="version: no process has their workflow version; queue: none of that version takes their queue."
    )


class Workers(Record):
    """What `GET /workers` returns."""

    processes: tuple[ProcessInfo, ...]
    queues: tuple[QueueInfo, ...]
    unserved: tuple[Unserved, ...] = ()
