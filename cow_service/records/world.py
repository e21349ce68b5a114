"""Records of stages 2 and 3: how it moves, and the small physical world that is computed from it."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field, model_validator

from cow_service.records.grounding import (
    Artifact,
    Asked,
    Cue,
    Law,
    LocatedObject,
    MotionKind,
    Position,
    Shape,
    Source,
    State,
    Until,
)
from cow_service.records.values import BBox, Point, Record, Vector


class MetresPerPixel(Record):
    """The scale of the scene at the object, and where it came from."""

    value: float = Field(gt=0, description="Metres per pixel at the object's depth.")
    source: Literal["default", "reference", "request", "depth"]
    note: str = Field(default="", description="What it is based on, in words.")


class MotionStep(Record):
    """A further leg of a motion, after the previous one has ended."""

    direction: Vector = Field(description="Unit vector in the image, px.")
    depth: float = Field(default=0.0, ge=-1, le=1, description="As `Motion.depth`.")
    distance: float | None = Field(default=None, gt=0, description="px at the depth of the first frame.")
    duration: float | None = Field(default=None, gt=0, description="s.")


class AlsoMoving(Record):
    """Another object that is set moving at the first frame."""

    object: LocatedObject
    kind: MotionKind
    direction: Vector | None = Field(default=None, description="As `Motion.direction`.")
    direction_deviation: float = Field(default=0.0, ge=0, le=90, description="As `Motion.direction_deviation`.")
    towards: LocatedObject | None = Field(default=None, description="As `Motion.towards`.")
    depth: float = Field(default=0.0, ge=-1, le=1, description="As `Motion.depth`.")
    speed: float = Field(ge=0, description="px/s at the depth of the first frame.")
    speed_deviation: float = Field(default=0.0, ge=0, le=3, description="As `Motion.speed_deviation`.")


class Motion(Record):
    """Stage 2, motion: how the object starts to move, not where it ends up."""

    kind: MotionKind
    law: Law = Field(
        default="ballistic",
        description="Physics of the motion. contact: floor, bounces, pushes, rolling, tipping; ballistic: constant "
        "velocity plus gravity, through everything.",
    )
    direction: Vector | None = Field(description="Unit vector in the image, px; null for a fall or a static object.")
    direction_deviation: float = Field(default=0.0, ge=0, le=90, description="Degrees, one standard deviation.")
    other_direction: Vector | None = Field(
        default=None,
        description="Another direction, px, that image, words or reader speak for: half of the simulated versions set "
        "out that way, and nothing is sure.",
    )
    depth: float = Field(
        default=0.0,
        ge=-1,
        le=1,
        description="Sine of the angle out of the image plane: positive away from the camera, negative towards it.",
    )
    depth_deviation: float = Field(
        default=0.0, ge=0, le=90, description="Degrees, one standard deviation of that angle."
    )
    towards: LocatedObject | None = Field(
        default=None,
        description="The object that it moves or is thrown towards, which sets the direction in the image.",
    )
    rises: bool = Field(
        default=False,
        description="For a linear motion: it leaves its support and moves through the air, as if lifted. Otherwise it "
        "moves along the floor, and away from the camera if the direction is up.",
    )
    cue: Cue
    along_arrow: bool | None = Field(default=None, description="Along the arrow, if the cue is one; else against it.")
    speed: float = Field(ge=0, description="px/s at the depth of the first frame.")
    speed_deviation: float = Field(
        default=0.0, ge=0, le=3, description="One standard deviation of the speed's natural logarithm."
    )
    distance: float | None = Field(
        default=None, gt=0, description="Stops after this distance, px at the depth of the first frame."
    )
    duration: float | None = Field(default=None, gt=0, description="Stops after this time, s.")
    until: Until | None = Field(
        default=None, description="contact: stops at its first contact; null: does not stop so."
    )
    steps: tuple[MotionStep, ...] = Field(default=(), description="Further legs; the first is this motion.")
    trail: tuple[Point, ...] = Field(
        default=(), description="[x, y], px: earlier positions of the object's centre in the image, oldest first."
    )
    others: tuple[AlsoMoving, ...] = Field(default=(), description="Other objects set moving at the same time.")
    gravity: Vector = Field(default=(0.0, 0.0), description="px/s^2.")
    down: Vector = Field(default=(0.0, 1.0), description="Unit vector: the direction of a fall in the image.")
    metres_per_pixel: MetresPerPixel
    sentence: str = Field(description="The motion in one declarative sentence: the generator's prompt.")
    source: Source


EncounterKind = Literal["touches", "occludes", "occluded-by"]
MEETINGS: dict[EncounterKind, str] = {  # what the mover does with the other object, in words
    "touches": "hits", "occludes": "passes in front of", "occluded-by": "passes behind",
}  # fmt: skip
BAND_PERCENTILES = (10, 90)  # of x and of y over the ensemble: the limits of `Path.band`
Doubt = Literal[
    "speed", "heading", "camera", "size", "place", "friction", "reading", "identity", "outline", "faint", "depth"
]  # fmt: skip
"""What a world is uncertain about. `place`: how far away and how high bodies are; `reading`: whether question and image
were read rightly; `identity`: whether objects are the named ones; `outline`: where their outlines run; `faint`: whether
something else that is seen is an object in the way; `depth`: whether the depth map fits the scene."""
CLEAR = 0.77  # confidence of a body below which no outcome that rests on it is sure
CameraSource = Literal["request", "exif", "depth", "edges", "shadow", "side-view", "prior"]


class CameraDeviations(Record):
    """One standard deviation of each value of a camera, in its unit."""

    focal: float = Field(ge=0, description="px.")
    pitch: float = Field(ge=0, description="Degrees.")
    roll: float = Field(ge=0, description="Degrees.")
    height: float = Field(ge=0, description="m.")


class CameraEstimate(Record):
    """The estimated pinhole camera. Its centre is the origin of all positions."""

    focal: float = Field(gt=0, description="Focal length, px.")
    pitch: float = Field(description="Degrees that the camera looks down.")
    roll: float = Field(default=0.0, description="Degrees that the vertical leans to the left in the image.")
    height: float = Field(gt=0, description="m above the floor.")
    source: CameraSource = Field(description="What it was estimated from, besides priors.")
    deviations: CameraDeviations


class Footprint(Record):
    """A body seen from above: to the right of the camera and ahead of it, over the floor."""

    centre: tuple[float, float] = Field(description="[right, ahead], m.")
    half_width: float = Field(ge=0, description="m, of the side that `yaw` turns.")
    half_depth: float = Field(ge=0, description="m, of the other side.")
    yaw: float = Field(description="Degrees from right to ahead, of the first side.")
    height: float = Field(ge=0, description="m, of the body.")
    covariance: tuple[float, float, float] | None = Field(
        default=None,
        description="Of the centre over the ensemble (the simulated versions): right-right, right-ahead, ahead-ahead, "
        "m^2; null without one.",
    )
    seen: float | None = Field(
        default=None, ge=0, le=1, description="Share of its pixels with a known depth; null without a depth map."
    )


class Surface(Record):
    """A plane that things stand on: the floor, or the top of a body."""

    body: int | None = Field(description="Which of `Trajectory.bodies` it is the top of; null: the floor.")
    normal: Position = Field(description="Unit vector upwards in the frame of the camera.")
    distance: float = Field(description="Height of the camera above it, m.")
    extent: BBox | None = Field(
        default=None, description="[right, ahead, right, ahead], m: its extent; null: unlimited or unknown."
    )


class DepthEstimate(Record):
    """The depth map from which a world was measured."""

    source: Literal["request", "model"] = Field(description="The request, or a model of the server.")
    scale: float | None = Field(description="Metres per unit; null: relative depth.")
    focal: float = Field(gt=0, description="px.")
    valid: float = Field(ge=0, le=1, description="Share of the pixels with a known depth.")
    deviation: float = Field(ge=0, description="Relative error: one standard deviation.")
    floor: float | None = Field(
        description="Share of floor among the pixels outside the bodies; null: the map shows no floor, or the image is "
        "a drawing without depth, and the map was not used."
    )
    mover: float = Field(ge=0, le=1, description="Share of the moving object's pixels with a known depth; 0: too few.")

    @property
    def is_of_scene(self) -> bool:
        """Whether an outcome can rest on it: it shows the floor and the moving object."""
        return self.floor is not None and self.mover > 0


class Body(Record):
    """An object of the world, as it is at the first frame."""

    object: str
    bbox: BBox = Field(description="[x0, y0, x1, y1], px.")
    shape: Shape
    size: tuple[float, float, float] = Field(description="Width, height and depth, m.")
    position: Position = Field(description="[x, y, z] of its centre in the frame of the camera, m.")
    support: str = Field(description="`floor`, `air`, or the name of the body that it stands on.")
    rotation: float = Field(
        default=0.0,
        description="Degrees clockwise by which it leans in the image, compared with the input; for objects that were "
        "put somewhere before the motion.",
    )
    footprint: Footprint | None = Field(default=None, description="Null in results of older versions.")
    source: Literal["embedded", "mllm", "request"] = Field(description="Who located it.")
    confidence: float = Field(
        ge=0,
        le=1,
        description="Confidence that this is one separate object with this outline; in doubt, the agreement (IoU) of "
        f"two ways to cut it out. Below {CLEAR} no outcome that depends on it is sure.",
    )

    @property
    def is_clear(self) -> bool:
        """Whether an outcome that depends on it can be sure."""
        return self.confidence >= CLEAR


_MINIMAL = "; not in minimal results"  # `Prefer: return=minimal`


class Path(Record):
    """What one body does, per frame of the clip."""

    body: int = Field(default=0, ge=0, description="Which of `Trajectory.bodies`.")
    states: tuple[State, ...] = Field(
        default=(), description=f"[x, y, z, vx, vy, vz] per frame: the 6-D state of the body{_MINIMAL}."
    )
    points: tuple[Point, ...] = Field(description="[x, y] per frame, px.")
    visible: tuple[bool, ...] = Field(description="Per frame: the point is inside the image.")
    scale: tuple[float, ...] = Field(
        default=(), description=f"Per frame: apparent size, 1 at the first frame{_MINIMAL}."
    )
    rotation: tuple[float, ...] = Field(
        default=(),
        description="Per frame: degrees turned clockwise in the image since the first frame; empty: not turned"
        f"{_MINIMAL}.",
    )
    turns: tuple[tuple[float, float, float, float], ...] = Field(
        default=(),
        description="Per frame: quaternion [x, y, z, w] of how its pose has turned since the first frame, about the "
        f"axes right, up and ahead over the floor; empty: not turned, and of spheres{_MINIMAL}.",
    )
    band: tuple[BBox, ...] = Field(
        default=(),
        description="Per frame: [x0, y0, x1, y1], px, the 10th and 90th percentile of the point over the ensemble; "
        f"empty without one{_MINIMAL}.",
    )
    futures: tuple[tuple[Point, ...], ...] = Field(
        default=(),
        description="Only for the moving object: its point in at most 8 other simulated versions, each [x, y] per "
        f"frame, px, to 0.1 px; empty if `band` is{_MINIMAL}.",
    )
    moved_at: float | None = Field(default=None, ge=0, description="Seconds until it starts to move; null: never.")
    tipped_at: float | None = Field(
        default=None, ge=0, description="Seconds until its upright axis leans by more than 45 degrees; null: never."
    )
    tracks: tuple[tuple[Point, ...], ...] = Field(
        default=(), description=f"Several points on the body's surface, each [x, y] per frame, px{_MINIMAL}."
    )
    tracks_visible: tuple[tuple[bool, ...], ...] | None = Field(
        default=None,
        description="Per track and frame: whether the point faces the camera and is not hidden; it may be outside the "
        f"image. Null: always{_MINIMAL}.",
    )


class StillTracks(Record):
    """Points on a body that does not move; a moving object may hide them for a while."""

    body: int = Field(ge=0, description="Which of `Trajectory.bodies`.")
    points: tuple[Point, ...] = Field(description="[x, y], px, at every frame.")
    visible: tuple[tuple[bool, ...], ...] | None = Field(
        default=None, description="Per point and frame: whether it is not hidden. Null: it never is."
    )


class Contact(Record):
    """Two bodies begin to touch, or a body touches the floor, in the likeliest version."""

    a: int = Field(ge=0, description="Which of `Trajectory.bodies`.")
    b: int | None = Field(description="Which of `Trajectory.bodies`; null for the floor.")
    time: float = Field(ge=0, description="Seconds.")
    point: Point = Field(description="[x, y], px.")
    impulse: float = Field(ge=0, description="Change of velocity of `a`, m/s; 0 if none, as under the ballistic law.")


class Encounter(Record):
    """A body touches another object, covers it or is covered by it. This is computed: a hypothesis."""

    object: str
    bbox: BBox = Field(description="[x0, y0, x1, y1], px, of the other object at the first frame.")
    body: int | None = Field(default=None, ge=0, description="Which of `Trajectory.bodies`.")
    subject: int = Field(default=0, ge=0, description="Which of `Trajectory.bodies` does so; 0: the moving object.")
    kind: EncounterKind
    first_frame: int = Field(
        ge=0, description="First frame of the encounter in the likeliest version; the last frame if it is later."
    )
    time: float | None = Field(
        default=None,
        ge=0,
        description="Seconds until it begins in the likeliest version, possibly after the end of the clip. Null in "
        "results of older versions.",
    )
    share: float | None = Field(
        default=None, ge=0, le=1, description="For an occlusion: the largest share of the object that is hidden."
    )
    probability: float | None = Field(
        default=None, ge=0, le=1, description="Share of the simulated versions in which it happens; null without any."
    )


class CandidateOutcome(Record):
    """One of the objects that a question chooses from."""

    object: str
    probability: float = Field(
        ge=0,
        le=1,
        description="Of `which`: that what is asked happens with it. Of `which-to-remove`: that what is asked does not "
        "happen without it, all others being there.",
    )
    sure: bool = Field(description="As `Outcome.sure`, for this object alone.")

    @property
    def is_meant(self) -> bool:
        """Whether the object is one of those that the question asks for, as most simulated versions have it."""
        return self.probability >= 0.5


class Outcome(Record):
    """What the question asks, as the world answers it."""

    asked: Asked
    subject: str | None = Field(
        default=None, description="The object whose encounter is asked about, where that is not the mover."
    )
    object: str | None = Field(default=None, description="The object asked about, where it was found.")
    probability: float | None = Field(
        default=None,
        ge=0,
        le=1,
        description="That what is asked happens, negation included; of `which-first`, `when` and `how-many`: of the "
        "value below; of `which` and `which-to-remove`: of what is said of all `candidates` together. Null where "
        "nothing tells.",
    )
    first: str | None = Field(default=None, description="Of `which-first`: the object, null for none.")
    count: int | None = Field(default=None, description="Of `how-many`: the number.")
    candidates: tuple[CandidateOutcome, ...] = Field(
        default=(),
        description="Of `which` and `which-to-remove`: the objects to choose from. If the question names none, of "
        "`which` all, of `which-to-remove` those that are met, at most 8, and the object in question.",
    )
    as_it_is: float | None = Field(
        default=None,
        ge=0,
        le=1,
        description="Of `which-to-remove`: the probability that what is asked happens with all objects there; below "
        "0.5 nothing has to be removed.",
    )
    time: float | None = Field(
        default=None, description="Seconds until it first happens: in the version that is shown, else the median."
    )
    time_band: tuple[float, float] | None = Field(default=None, description="Its 10th and 90th percentile, s.")
    sure: bool = Field(description="Whether the world is certain enough for an answer; else the answer is not sure.")
    robust: bool = Field(description="Whether at least 90% of the worlds give the answer.")
    depends_on: tuple[Doubt, ...] = Field(default=(), description="What the answer depends on, most first.")

    @property
    def happens(self) -> bool:
        """Whether what is asked happens, negation included, as most simulated versions have it."""
        return (self.probability or 0.0) >= 0.5

    @property
    def is_needless(self) -> bool:
        """Whether what a removal is to prevent does not happen anyway."""
        return self.as_it_is is not None and self.as_it_is < 0.5

    @property
    def of_shown(self) -> Outcome:
        """Whether it happens while all objects are there, which is what is shown, where it is asked which to remove."""
        if self.asked.form != "which-to-remove":
            return self
        asked = self.asked.model_copy(update={"form": "whether", "among": ()})
        return self.model_copy(
            update={"asked": asked, "probability": self.as_it_is, "candidates": (), "as_it_is": None}
        )


PlacementResult = Literal["inside", "sticks-out", "on-the-rim", "on-top", "beside", "overlaps", "falls-off", "tips"]


class Placement(Record):
    """What happens to an object that is put somewhere."""

    object: str
    result: PlacementResult = Field(description="In the likeliest version.")
    probabilities: dict[PlacementResult, float] = Field(
        default_factory=dict, description="Share of the simulated versions with each result; empty without any."
    )
    fits: float | None = Field(
        default=None,
        ge=0,
        le=1,
        description="Probability that it ends as intended: inside and not held up at the rim, on top, or beside "
        "without overlapping.",
    )
    clearance: float | None = Field(default=None, description="Width of the opening minus that of the object, over it.")
    above_rim: float | None = Field(default=None, ge=0, le=1, description="Share of the object's height above the rim.")


class PlacedBefore(Placement):
    """What happens to an object that is put somewhere before the motion."""

    body: int = Field(ge=0, description="Which of `Trajectory.bodies`, with its new place.")
    place: str = Field(description="Where it is put, in words.")
    by_heading: bool = Field(
        default=False, description="In front and behind are meant in the direction of motion, not of the camera."
    )
    visible: float = Field(
        ge=0, le=1, description="Share of it that is visible in the first frame; 0: behind others or outside the image."
    )


class TrajectoryUnits(Record):
    """Units of `Path.states`."""

    position: Literal["m"] = "m"
    velocity: Literal["m/s"] = "m/s"
    frame: Literal["camera: x right, y down, z depth"] = "camera: x right, y down, z depth"


_OF_PATHS = ("states", "points", "visible", "scale", "tracks", "tracks_visible")


class Trajectory(Record):
    """Stage 3, trajectory: what every body does over the clip, which bodies meet, and how sure that is.

    `bodies[0]` is the moving object and `paths[0]` its path; a body without a path does not move.
    """

    law: Law = "ballistic"
    fps: float = Field(gt=0, description="Frames per second of the clip.")
    units: TrajectoryUnits = TrajectoryUnits()
    camera: CameraEstimate | None = Field(default=None, description="Null if nothing was estimated.")
    depth: DepthEstimate | None = Field(default=None, description="Null if there was no depth map.")
    surfaces: tuple[Surface, ...] = Field(default=(), description="Surfaces that bodies stand on, the floor first.")
    bodies: tuple[Body, ...] = ()
    paths: tuple[Path, ...] = Field(min_length=1, description="Of the bodies that move, the moving object's first.")
    contacts: tuple[Contact, ...] = Field(default=(), description="In the order of time.")
    light: Vector | None = Field(
        default=None,
        description="Metres by which a shadow lies to the right of its object, and further from the camera, per metre "
        "of height above the floor; null if no shadow of an object in the air shows it.",
    )
    moving_until: float | None = Field(
        default=None, ge=0, description="Seconds until everything is at rest, or the moving object has left the image."
    )
    tracks_given: bool = Field(default=False, description="The tracks come from the request, and there are no others.")
    still_tracks: tuple[StillTracks, ...] = Field(
        default=(), description=f"Of the bodies that do not move; empty in results of older versions{_MINIMAL}."
    )
    anchors: tuple[Point, ...] = Field(description="Static points on the background that hold the camera still, px.")
    encounters: tuple[Encounter, ...] = ()
    faint: tuple[BBox, ...] = Field(
        default=(),
        description="Boxes [x0, y0, x1, y1] (px) of what may be objects, but not for certain. They are not simulated; "
        "if the path crosses one, the outcome is not sure.",
    )
    encounters_known: bool = Field(
        default=True, description="False if the objects around could not be told apart; then none is listed."
    )
    ensemble: int = Field(default=0, ge=0, description="Number of simulated versions behind the probabilities.")
    outcome: Outcome | None = Field(default=None, description="Null if the simulation cannot answer the question.")
    placement: Placement | None = Field(
        default=None, description="Result for a moving object that is put somewhere; else null."
    )
    placed: tuple[PlacedBefore, ...] = Field(
        default=(), description="Objects put somewhere before the motion, in that order."
    )
    live: Artifact | None = Field(
        default=None,
        description="JSON: the initial state of the simulated versions, for programs that run them with another aim. "
        "Null unless the request asked for it (`live`), if an object is put somewhere, and if nothing moves along a "
        "direction.",
    )
    factual: Trajectory | None = Field(
        default=None,
        description="The same motion in the unchanged scene, if an object is taken away or put elsewhere first; else "
        "null.",
    )

    @property
    def path(self) -> Path:
        """The path of the moving object."""
        return self.paths[0]

    @property
    def num_frames(self) -> int:
        """Number of frames in the clip."""
        return len(self.paths[0].points)

    @model_validator(mode="before")
    @classmethod
    def _read_older(cls, value: Any) -> Any:
        """Reads results of older versions: an outcome with its own narration, an only path in the trajectory itself."""
        if isinstance(value, dict) and isinstance(value.get("outcome"), dict) and "facts" in value["outcome"]:
            value = value | {"outcome": {name: part for name, part in value["outcome"].items() if name != "facts"}}
        if not isinstance(value, dict) or "paths" in value or "points" not in value:
            return value
        path = {name: value[name] for name in _OF_PATHS if name in value}
        return {name: part for name, part in value.items() if name not in _OF_PATHS} | {"paths": [path]}
