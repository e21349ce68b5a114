"""Stage 3: a small physical world, what its bodies do over time, and how sure that is."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field, model_validator

from cow_service.records.base import BBox, Point, Position, Record, State, Vector
from cow_service.records.motion import Asked, Law, Shape

EncounterKind = Literal["touches", "occludes", "occluded-by"]
MEETINGS: dict[EncounterKind, str] = {
    "touches": "touches",
    "occludes": "passes in front of",
    "occluded-by": "passes behind",
}  # what the mover does with the other object, in words
BAND_PERCENTILES = (10, 90)  # of the points over the ensemble, across and down apart: what `Path.band` lies between
Doubt = Literal["speed", "heading", "camera", "size", "place", "friction"]
"""What a world is uncertain of: `place` is how far from the camera and how high bodies are."""
CameraSource = Literal["shadow", "edges", "request", "prior"]


class CameraDeviations(Record):
    """One standard deviation of each value of a camera, in its unit."""

    focal: float = Field(ge=0, description="px.")
    pitch: float = Field(ge=0, description="Degrees.")
    roll: float = Field(ge=0, description="Degrees.")
    height: float = Field(ge=0, description="m.")


class CameraEstimate(Record):
    """The pinhole camera that took the image, as it was estimated. Its centre is the origin of all positions."""

    focal: float = Field(gt=0, description="px.")
    pitch: float = Field(description="Degrees that it looks down on the floor.")
    roll: float = Field(default=0.0, description="Degrees that the vertical leans to the left in the image.")
    height: float = Field(gt=0, description="m above the floor.")
    source: CameraSource = Field(description="What it was estimated from beside the priors.")
    deviations: CameraDeviations


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
        description="Degrees, clockwise, that it leans in the image against how the input shows it: of what was put "
        "somewhere before the motion.",
    )
    source: Literal["embedded", "mllm", "request"] = Field(description="Who says that it is there.")
    confidence: float = Field(ge=0, le=1, description="How sure it is that this is one separate thing.")


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
        description="Per frame: degrees turned in the image since the first frame, clockwise; empty: not turned"
        f"{_MINIMAL}.",
    )
    band: tuple[BBox, ...] = Field(
        default=(),
        description="Per frame: [x0, y0, x1, y1], px, the 10th and 90th percentile of the point over the ensemble; "
        f"empty without one{_MINIMAL}.",
    )
    futures: tuple[tuple[Point, ...], ...] = Field(
        default=(),
        description="Of the mover alone: the point in other worlds of the ensemble, at most 8 of them, each [x, y] per "
        f"frame, px, to 0.1 px; empty where `band` is{_MINIMAL}.",
    )
    moved_at: float | None = Field(default=None, ge=0, description="Seconds until it is set in motion; null: never.")
    tipped_at: float | None = Field(
        default=None, ge=0, description="Seconds until its upright axis leans by more than 45 degrees; null: never."
    )
    tracks: tuple[tuple[Point, ...], ...] = Field(
        default=(), description=f"Several points inside the body's mask, each [x, y] per frame, px{_MINIMAL}."
    )
    tracks_visible: tuple[tuple[bool, ...], ...] | None = Field(
        default=None, description=f"Per track and frame, where it was given: the point can be seen{_MINIMAL}."
    )


class Contact(Record):
    """Two bodies begin to touch, or a body meets the floor, in the likeliest world."""

    a: int = Field(ge=0, description="Which of `Trajectory.bodies`.")
    b: int | None = Field(description="Which of `Trajectory.bodies`; null for the floor.")
    time: float = Field(ge=0, description="Seconds.")
    point: Point = Field(description="[x, y], px.")
    impulse: float = Field(
        ge=0, description="Change of velocity of `a`, m/s: 0 where nothing is exchanged, as under the ballistic law."
    )


class Encounter(Record):
    """The mover meets another object, covers it or is covered by it. Computed: a hypothesis."""

    object: str
    bbox: BBox = Field(description="[x0, y0, x1, y1], px, of the other object at the first frame.")
    body: int | None = Field(default=None, ge=0, description="Which of `Trajectory.bodies`.")
    subject: int = Field(default=0, ge=0, description="Which of `Trajectory.bodies` meets it; 0: the mover.")
    kind: EncounterKind
    first_frame: int = Field(ge=0, description="The first clip frame of the encounter, in the likeliest world.")
    share: float | None = Field(
        default=None, ge=0, le=1, description="Of an occlusion: the largest share of what is hidden that is covered."
    )
    probability: float | None = Field(
        default=None, ge=0, le=1, description="Share of the ensemble's worlds in which it happens; null without one."
    )


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
        "value below. Null where nothing tells.",
    )
    first: str | None = Field(default=None, description="Of `which-first`: the object, null for none.")
    count: int | None = Field(default=None, description="Of `how-many`: the number.")
    time: float | None = Field(default=None, description="Seconds until it first happens, the median of the worlds.")
    time_band: tuple[float, float] | None = Field(default=None, description="Its 10th and 90th percentile, s.")
    sure: bool = Field(description="Whether the world is certain enough for an answer; else the answer is not sure.")
    robust: bool = Field(description="Whether at least 90% of the worlds give the answer.")
    depends_on: tuple[Doubt, ...] = Field(default=(), description="What the answer depends on, most first.")
    facts: str = Field(default="", description="What happens, in one sentence made of the facts.")


PlacementResult = Literal["inside", "sticks-out", "on-the-rim", "on-top", "beside", "overlaps", "falls-off", "tips"]


class Placement(Record):
    """What becomes of an object that is put somewhere."""

    object: str
    result: PlacementResult = Field(description="In the likeliest world.")
    probabilities: dict[PlacementResult, float] = Field(
        default_factory=dict, description="Share of the ensemble's worlds with each result; empty without an ensemble."
    )
    fits: float | None = Field(
        default=None,
        ge=0,
        le=1,
        description="Probability that it ends as it was meant to: inside and not held up at the rim, on top, or beside "
        "without overlapping.",
    )
    clearance: float | None = Field(
        default=None, description="Width of the opening less that of the object, as a share of the opening."
    )
    above_rim: float | None = Field(
        default=None, ge=0, le=1, description="Share of the object's height that is higher than the rim."
    )


class PlacedBefore(Placement):
    """What becomes of an object that is put somewhere before the motion."""

    body: int = Field(ge=0, description="Which of `Trajectory.bodies`: there is its new place.")
    place: str = Field(description="Where it is put, in words.")
    by_heading: bool = Field(
        default=False, description="In front of or behind the mover by the way that it goes, not as the camera sees it."
    )
    visible: float = Field(
        ge=0, le=1, description="Share of it that is seen there at the first frame: 0 behind others or off the image."
    )


class TrajectoryUnits(Record):
    """Units of `Path.states`."""

    position: Literal["m"] = "m"
    velocity: Literal["m/s"] = "m/s"
    frame: Literal["camera: x right, y down, z depth"] = "camera: x right, y down, z depth"


_OF_PATHS = ("states", "points", "visible", "scale", "tracks", "tracks_visible")


class Trajectory(Record):
    """Stage 3: what every body does over the clip, what meets what, and how sure that is.

    `bodies[0]` is the mover and `paths[0]` its path; a body without a path stays where it is.
    """

    law: Law = "ballistic"
    fps: float = Field(gt=0, description="Frames per second of the clip.")
    units: TrajectoryUnits = TrajectoryUnits()
    camera: CameraEstimate | None = Field(default=None, description="Null where nothing was estimated.")
    bodies: tuple[Body, ...] = ()
    paths: tuple[Path, ...] = Field(min_length=1, description="Of the bodies that move, the mover's first.")
    contacts: tuple[Contact, ...] = Field(default=(), description="In the order of their times.")
    light: Vector | None = Field(
        default=None,
        description="Metres that a shadow lies to the right of what casts it, and away from the camera, per metre of "
        "height above the floor; null where no shadow in the air tells.",
    )
    moving_until: float | None = Field(
        default=None, ge=0, description="Seconds from which nothing moves any more, or the mover has left the image."
    )
    anchors: tuple[Point, ...] = Field(description="Static points that hold the camera still, px.")
    encounters: tuple[Encounter, ...] = ()
    encounters_known: bool = Field(
        default=True, description="False where the surroundings could not be told apart: then nothing is listed."
    )
    ensemble: int = Field(default=0, ge=0, description="How many worlds the probabilities are counted in.")
    outcome: Outcome | None = Field(
        default=None, description="Null where the question asks for nothing that the world can tell."
    )
    placement: Placement | None = Field(
        default=None, description="Of the mover that is seen going somewhere; null where it is put nowhere."
    )
    placed: tuple[PlacedBefore, ...] = Field(
        default=(), description="What is put somewhere before the motion, in its order."
    )
    factual: Trajectory | None = Field(
        default=None,
        description="The same motion in the scene as it is, where something is taken away, or put somewhere before; "
        "null where nothing is.",
    )

    @property
    def path(self) -> Path:
        """The mover's."""
        return self.paths[0]

    @property
    def num_frames(self) -> int:
        """Of the clip."""
        return len(self.paths[0].points)

    @model_validator(mode="before")
    @classmethod
    def _read_one_path(cls, value: Any) -> Any:
        """Reads results of older versions, whose only path lay in the trajectory itself."""
        if not isinstance(value, dict) or "paths" in value or "points" not in value:
            return value
        path = {name: value[name] for name in _OF_PATHS if name in value}
        return {name: part for name, part in value.items() if name not in _OF_PATHS} | {"paths": [path]}
