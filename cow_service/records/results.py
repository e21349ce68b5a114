"""The results of a request: frames, simulation, answer; and what the service says of itself and of its jobs."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import BaseModel, Field

from cow_service.records.world import Artifact, BBox, Grounding, ImageInfo, Language, Motion, Record, Sha256, Trajectory

FramePolicy = Literal["initial", "uniform", "events"]


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
    stages: tuple[Literal["gating", "grounding", "motion", "answering"], ...] = Field(
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
    is_toy: bool = Field(default=False, description="Its weights are random: the frames mean nothing.")


class Clip(Record):
    """Stage 4: the frames chosen for reasoning, the whole clip as video where it is wanted, and the overlay."""

    frames: tuple[Frame, ...] = Field(description="The frames chosen for reasoning.")
    factual_frames: tuple[Frame, ...] = Field(
        default=(), description="The same frames of the scene as it is, where something is taken away or put elsewhere."
    )
    video: Video | None = Field(description="Null where the request said `video: false`.")
    overlay: Artifact = Field(
        description="JPEG of the input with box, point, arrow and path drawn, 1280 px at most on the longer side."
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
        default=Usage(), description="What this request cost, everything together, but not stages that are `reused`."
    )
    usage_total: Usage = Field(
        default_factory=lambda fields: fields.get("usage", Usage()),
        description="What it would have cost without reuse; of results of earlier versions, what it cost.",
    )
    timings: dict[str, float] = Field(description="Seconds per stage.")
    reused: tuple[str, ...] = Field(
        default=(), description="Stages whose cached result was used: an earlier request had asked for the same."
    )
    warnings: tuple[str, ...] = ()


HAPPENS = 0.5  # probability from which something is said to happen


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
    """What the server of a multimodal LLM refused a call with."""

    status: int = Field(description="Of its HTTP response.")
    message: str = Field(description="In its own words.")
    retry_after: float | None = Field(default=None, ge=0, description="When it may be asked again, s.")


class Problem(BaseModel):
    """Why a request failed (RFC 9457)."""

    type: str = Field(description="Stable URI; its last segment is the code.")
    title: str = Field(description="The kind of error, the same for every occurrence.")
    status: int
    detail: str = Field(description="What was wrong, with the value, and what to do where `remedy` does not say that.")
    remedy: str | None = Field(
        default=None,
        exclude_if=lambda remedy: remedy is None,
        description="What to give in the request; left out where `detail` says all.",
    )
    errors: list[ProblemField] = Field(default_factory=list[ProblemField])
    usage: Usage | None = Field(
        default=None,
        exclude_if=lambda usage: usage is None,
        description="What was asked of a multimodal LLM before it failed; left out where that was nothing.",
    )
    refusal: MllmRefusal | None = Field(
        default=None,
        exclude_if=lambda refusal: refusal is None,
        description="What the multimodal LLM refused a call with; left out where it did not.",
    )

    @property
    def code(self) -> str:
        """The last segment of the type, such as `cannot-ground`."""
        return self.type.rpartition(":")[2]


OptionsSource = Literal["request", "question-letters", "question-list", "none"]


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


GateReason = Literal["agreed", "disagreed", "not-sure", "unreadable"]


class Gate(Record):
    """What decided whether to imagine, where the request leaves that to the answers from the image alone."""

    answer: str | None = Field(
        description="The leading answer, as in `Verdict`; null where it is not sure and no option says so, or there is "
        "none."
    )
    votes: dict[str, int] = Field(description="How often each was answered, as in `Verdict`.")
    asked: int = Field(
        ge=1, description="Votes asked for; 1 where the reader gives the same answer however often it is asked."
    )
    agreement: float = Field(ge=0, le=1, description="Share of the votes asked for that the leading answer has.")
    threshold: float = Field(gt=0, le=1, description="`imagine_threshold` of the request.")
    imagined: bool = Field(
        description="Whether imagining followed; where that failed, `simulation_problem` says why, and the leading "
        "answer is taken."
    )
    reason: GateReason = Field(
        description="Why: agreed: the leading answer reached the threshold, and is the answer; disagreed: it did not, "
        "or was tied; not-sure: it is that the reader is not sure; unreadable: no vote could be read."
    )


class Answer(Verdict, Result):
    """The way from image and question to an answer: what `POST /answer` returns."""

    options: tuple[AnswerOption, ...] = Field(description="From the request or the question; empty where it is open.")
    options_source: OptionsSource = Field(
        default="none",
        description="Where they stand: in the request, in the question with letters, or there as a list without (which "
        "get A, B, C...).",
    )
    simulation: Simulation | None = Field(description="Null where nothing was imagined, or that failed.")
    simulation_problem: Problem | None = Field(default=None, description="Why imagining failed, where it did.")
    gate: Gate | None = Field(default=None, description="Of `imagine: auto`; else null.")
    baseline: Verdict | None = Field(
        description="The answer without frames, where it was asked for; of `imagine: auto`, that of the gate."
    )


VIDEO_FILE = "video.mp4"


def artifacts_of(result: Simulation | Answer) -> dict[str, Sha256]:
    """The digests of frames, overlay and video by the names of files; none of an answer without a simulation."""
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
    """The result as JSON by the names of files; beside an answer its simulation."""
    if isinstance(result, Simulation):
        return {"simulation.json": _text(result)}
    simulation = {} if result.simulation is None else documents_of(result.simulation)
    return simulation | {"answer.json": _text(result)}


def _text(record: Record) -> str:
    return record.model_dump_json(indent=2) + "\n"


BackendKind = Literal["reader", "generator", "segmenter", "detector", "depth", "inpainter"]


class BackendInfo(Record):
    """A reader, a generator or a model that sees: what it is, what it needs, whether it is ready."""

    name: str
    kind: BackendKind | None = Field(default=None, description="Null only from servers that do not tell it yet.")
    default: bool = Field(description="Used where a request names none; of models that see: used by the server.")
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
    perception: tuple[BackendInfo, ...] = Field(default=(), description="Models that the service can see with.")
    mllms: tuple[str, ...] = Field(default=(), description="Manifests of multimodal LLMs: what `COW_MLLM` may name.")


class SeenObject(Record):
    """A thing that the models of the server see."""

    bbox: BBox = Field(description="[x0, y0, x1, y1], px.")
    mask: str | None = Field(
        description="data:image/png;base64,...: white where it is; null where its outline is not certain."
    )
    score: float = Field(ge=0, le=1, description="How sure the model is of it.")
    name: str | None = Field(default=None, description="The noun under which it was looked for.")


class Look(Record):
    """What `POST /look` returns."""

    image: Sha256 = Field(description="Of the image: later looks may name it as artifact while it is kept in memory.")
    width: int
    height: int
    things: tuple[SeenObject, ...] = Field(
        description="Best first. At a point, several are things within each other; none: no two looks agree."
    )


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
    question: str | None = Field(
        default=None,
        description="The request's; in lists at most 200 characters of it, the last of them `…` where it is longer. "
        "Null for jobs of earlier versions.",
    )
    answer: str | None = Field(
        default=None,
        description="What it came to, in at most 200 characters: the answer, or of a simulation what its worlds say. "
        "Null until it has succeeded, where nothing was asked, and for jobs of earlier versions.",
    )
    given: tuple[str, ...] = Field(
        default=(),
        description="Which of `grounding`, `motion`, `trajectory`, `objects`, `interventions` and `camera` the "
        "request gave instead of leaving it to the reader.",
    )
    image: Sha256 | None = Field(
        default=None, description="The artifact that the request's image is kept as; null for jobs of earlier versions."
    )
    created_at: str = Field(description="RFC 3339, UTC.")
    finished_at: str | None = Field(default=None, description="RFC 3339, UTC.")
    position: int | None = Field(
        default=None,
        ge=0,
        description="Jobs that are taken before it, while it is queued and asked for by its id; null otherwise.",
    )
    expected_wait: float | None = Field(
        default=None, ge=0, description="Seconds until it is taken, at the rate of the last minutes; null if not known."
    )
    generator: str = Field(description="Who makes its frames.")
    result: Simulation | Answer | None = Field(default=None, description="Of a succeeded job, but not in lists.")
    problem: Problem | None = Field(default=None, description="Of a failed job.")


class AcceptedRequest(Record):
    """The request that became a job."""

    kind: JobKind = Field(description="`simulate`: of `POST /simulate`; `answer`: of `POST /answer`.")
    request: dict[str, Any] = Field(
        description="The body, which can be sent again as it stands: image and masks as artifacts, without fields that "
        "have their default, and without the webhook."
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
    """A job that is being computed: how far it is, never what was asked nor who asked."""

    id: str | None = Field(default=None, description="Null for callers who do not administer the server.")
    kind: JobKind
    stage: str | None = None
    progress: float = Field(ge=0, le=1, description="Share of the work that is done, all stages together.")
    seconds: float = Field(ge=0, description="Since it began to be computed.")


class WorkerLoad(Record):
    """What the jobs of a worker wait for just now."""

    cpu_waiting: int = Field(ge=0, description="Jobs that wait for a place on the CPU.")
    mllm_calls: int = Field(ge=0, description="Calls of an MLLM that have no reply yet.")
    mllm_limit: int = Field(ge=0, description="Calls at the same time; adapts to what the MLLM takes. 0: no MLLM.")
    mllm_waiting: int = Field(ge=0, description="Calls that wait for others to end.")


class WorkerInfo(Record):
    """What computes jobs: a worker process, or the threads of the server itself (`COW_WORKERS=0`)."""

    name: str = Field(description="Its queue and a number.")
    queue: str | None = Field(description="Whose jobs it computes; null: of all queues.")
    pid: int | None = Field(default=None, description="Null for callers who do not administer the server.")
    memory_mb: float = Field(ge=0, description="Resident memory, MB (10^6 bytes).")
    jobs_done: int = Field(ge=0)
    jobs: tuple[WorkerJob, ...] = Field(default=(), description="At hand; several where jobs wait for an MLLM.")
    gpus: tuple[GpuMemory, ...] = Field(default=(), description="That it uses.")
    load: WorkerLoad | None = Field(default=None, description="Null while that is not known.")


class ProcessInfo(Record):
    """One process on the job database: a server, or `cow worker`."""

    executor_id: str
    seen_at: str = Field(description="RFC 3339, UTC, by the clock of that process.")
    role: ProcessRole
    host: str | None = Field(default=None, description="Null for callers who do not administer the server.")
    pid: int | None = Field(default=None, description="Null for callers who do not administer the server.")
    version: str = Field(description="Of COW.")
    workflow_version: str = Field(description="Jobs of this version are taken, no others.")
    queues: dict[str, int] = Field(
        default_factory=dict, description="Queues that it takes jobs from, and how many of each at the same time."
    )
    workers: tuple[WorkerInfo, ...] = ()


class QueueInfo(Record):
    """One queue."""

    name: str
    queued: int = Field(ge=0, description="Jobs that wait.")
    running: int = Field(ge=0, description="Jobs that are computed.")
    capacity: int = Field(ge=0, description="Jobs that all processes together take at the same time.")
    oldest_seconds: float | None = Field(default=None, ge=0, description="How long the oldest of `queued` has waited.")
    jobs_per_minute: float = Field(ge=0, description="That ended, over the last five minutes.")


class Unserved(Record):
    """Jobs that wait, and that no process takes."""

    queue: str
    workflow_version: str
    jobs: int = Field(gt=0)
    reason: Literal["version", "queue"] = Field(
        description="No process has their workflow version, or none of those that have it serves their queue."
    )


class Workers(Record):
    """What `GET /workers` returns."""

    processes: tuple[ProcessInfo, ...]
    queues: tuple[QueueInfo, ...]
    unserved: tuple[Unserved, ...] = ()
