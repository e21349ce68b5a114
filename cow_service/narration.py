"""Says in English what happens in a world: names, ways and places in words, and a trajectory in one sentence."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # the command line prints its help without records
    from cow_service import records
    from cow_service.records import (
        Encounter,
        Grounding,
        Intervention,
        Path,
        PlacedBefore,
        PlaceRelation,
        Trajectory,
        Vector,
    )
    from cow_service.requests import SimulateRequest

MAX_OBJECT = 200  # characters
ALONG_AXIS = 0.95  # sine of the angle out of the image plane from which only the depth is worth a word
IN_PLANE = 0.3  # and up to which it is not

# 16 sectors of 22.5 degrees, from the right, turning upwards.
_QUARTERS = (("to the right", "up"), ("up", "to the left"), ("to the left", "down"), ("down", "to the right"))
_DETERMINERS = ("the ", "a ", "an ", "this ", "that ")


def direction_words(direction: Vector | None, depth: float) -> str:
    """A direction as a short phrase, such as "to the right and slightly up"; empty where there is none.

    `direction` is in image pixels, x right, y down, of any length; `depth` as in `Motion`.
    """
    flat = ""
    if direction is not None and math.hypot(*direction) > 0 and all(map(math.isfinite, direction)):
        sector = round(math.atan2(-direction[1], direction[0]) / (math.pi / 8)) % 16
        main, side = _QUARTERS[sector // 4]
        words = (main, f"{main} and slightly {side}", f"{main} and {side}", f"{side} and slightly {main}")
        flat = words[sector % 4]
    away = "away from the camera" if depth > 0 else "towards the camera"
    if not flat or abs(depth) >= ALONG_AXIS:
        return away if abs(depth) > IN_PLANE else flat
    return f"{flat} and {away}" if abs(depth) > IN_PLANE else flat


def same_name(one: str, other: str) -> bool:
    """Whether two texts name an object alike, whatever their determiners, letters' case and spaces."""
    words = [re.findall(r"\w+", bare_name(name).lower()) for name in (one, other)]
    return words[0] == words[1] != []


def bare_name(object: str) -> str:
    """An object's name in one line, without its determiner."""
    name = " ".join(object.split())[:MAX_OBJECT].rstrip()
    determiner = next((word for word in _DETERMINERS if name.lower().startswith(word)), "")
    return name[len(determiner) :]


PREPOSITIONS: dict[PlaceRelation, str] = {
    "into": "into", "onto": "onto", "between": "between", "in-front-of": "in front of", "behind": "behind",
    "next-to": "next to", "left-of": "to the left of", "right-of": "to the right of",
}  # fmt: skip
_OTHER_WORDS: dict[str, PlaceRelation] = {
    "in": "into", "inside": "into", "on": "onto", "on top of": "onto", "beside": "next-to", "left of": "left-of",
    "right of": "right-of",
}  # fmt: skip
RELATION_WORDS: dict[str, PlaceRelation] = {
    **{name: name for name in PREPOSITIONS},
    **{words: relation for relation, words in PREPOSITIONS.items()},
    **_OTHER_WORDS,
}


SURE = 0.9  # share of the worlds: where something is as it was meant in fewer, a warning says so
HARDLY_SEEN = 0.25  # share of a thing that is seen
_WHERE: dict[PlaceRelation, str] = {"into": "in", "onto": "on"}  # of what is there; else as it is put
_DOES_NOT_STAY: dict[records.PlacementResult, str] = {
    "overlaps": "there is no room for it, and it overlaps",
    "falls-off": "it does not stay there, but falls off",
    "tips": "it does not stay there: it tips over, or tips over what it is put to",
}
_NOT_AS_MEANT: dict[records.PlacementResult, str] = {
    "sticks-out": "goes in but sticks out",
    "on-the-rim": "does not go in, but lies on the rim",
}
_ENDS: dict[records.PlacementResult, str] = {
    "inside": "goes in and stays inside",
    "sticks-out": "goes in but sticks out",
    "on-the-rim": "does not go in and stays on the rim",
    "on-top": "stays on top",
    "beside": "stays there without overlapping",
    "overlaps": "has no room there and overlaps",
    "falls-off": "falls off",
    "tips": "tips over, or tips over what it was put to",
}


def place_words(placed: Intervention) -> str:
    """Where something is put, as in: between the bowl and the cone."""
    to = " and ".join(f"the {bare_name(target.object)}" for target in placed.targets)
    return f"{PREPOSITIONS[placed.relation or 'into']} {to}"


def state_words(placed: Intervention) -> str:
    """What is where once it is put there, as in: the white mug next to the blue mug."""
    at = _WHERE.get(placed.relation or "into", "")
    where = place_words(placed)
    return f"the {bare_name(placed.object.object)} {f'{at} {where.split(maxsplit=1)[1]}' if at else where}"


def cannot_stay(placed: PlacedBefore) -> str:
    """Why something cannot be put somewhere, in a sentence."""
    faults: list[records.PlacementResult] = [result for result in _DOES_NOT_STAY if result in placed.probabilities]
    result = placed.result
    if result not in _DOES_NOT_STAY:
        result = max(faults, key=lambda fault: placed.probabilities[fault])
    share = placed.probabilities.get(result)
    sure = "" if share is None else f" ({share:.0%} of the computed worlds)"
    return f"'{placed.object}' cannot be put {placed.place}: {_DOES_NOT_STAY[result]}{sure}."


def doubts_of(placed: PlacedBefore) -> tuple[str, ...]:
    """What is in doubt of something that is put somewhere, in sentences: whether it stays there, and is seen."""
    told, where = list[str](), f"'{placed.object}', put {placed.place},"
    if placed.result in _NOT_AS_MEANT:
        told.append(f"{where} {_NOT_AS_MEANT[placed.result]}.")
    elif placed.fits is not None and placed.fits < SURE:
        told.append(f"{where} is there as it was meant in {placed.fits:.0%} of the computed worlds.")
    if placed.visible < HARDLY_SEEN:
        told.append(f"{where} is hardly to be seen in the frames: others hide it there, or it is outside the image.")
    return tuple(told)


OFF_CENTRE = 0.25  # of the object's size: a given path that begins further from its centre is remarked on


def warnings_of(request: SimulateRequest, grounding: Grounding, trajectory: Trajectory) -> tuple[str, ...]:
    """What a caller should know of a trajectory beside what it says, in sentences."""
    given, found = request.trajectory, list[str]()
    if not trajectory.encounters_known:
        found.append(
            "The surroundings could not be separated into objects, so encounters were not computed: "
            "an empty list does not mean that nothing is hit."
        )
    # Where a given path goes beside the motion, the object or the clip that were given with it.
    if given is not None and request.stated_motion is not None:
        found.append(
            "Both `motion` and `trajectory` were given: the object follows the trajectory, the motion only words it."
        )
    x0, y0, x1, y1 = grounding.bbox
    gap = 0.0 if given is None else math.dist(given.points[0], grounding.point)
    if request.grounding is not None and gap > OFF_CENTRE * max(x1 - x0, y1 - y0):
        found.append(
            f"The given trajectory begins {gap:.0f} px from the object's centre: in the first frame it is drawn there."
        )
    # A path that ends where the clip does, or a frame beside it, is of its length.
    clip = (request.num_frames - 1) / request.fps
    path = clip if given is None else (len(given.points) - 1) / given.fps
    if abs(path - clip) * request.fps > 1.5:
        happens = "its rest is not shown" if path > clip else "from its end on the object stays where it is"
        found.append(f"The given trajectory lasts {path:.2f} s and the clip {clip:.2f} s: {happens}.")
    found += _of_depth(request, grounding, trajectory)
    found += [
        f"Something may stand at ({(left + right) / 2:.0f}, {bottom:.0f}) that is too faint to tell: no world has it."
        for left, _, right, bottom in trajectory.faint
    ]
    if trajectory.outcome is not None and "outline" in trajectory.outcome.depends_on:
        outcome, met = trajectory.outcome, {each.object for each in trajectory.encounters}
        matter = {trajectory.bodies[0].object, outcome.subject, outcome.object} | met
        found += [
            f"'{body.object}' was not seen clearly: give its box for an answer that may rest on it."
            for body in trajectory.bodies
            if not body.is_clear and body.object in matter
        ]
    found += [doubt for placed in trajectory.placed for doubt in doubts_of(placed)]
    found += [
        f"'{each.object}', put {each.place}, was put there by the way in which that moves, not as the camera sees it."
        for each in trajectory.placed
        if each.by_heading
    ]
    if trajectory.factual is not None and trajectory.placed:
        put = {each.body for each in trajectory.placed}
        found += [
            f"'{body.object}' makes room for what is put there: it does not begin where the image shows it."
            for index, (body, seen) in enumerate(zip(trajectory.bodies, trajectory.factual.bodies, strict=False))
            if index not in put and body.bbox != seen.bbox
        ]
    return tuple(found)


def _of_depth(request: SimulateRequest, grounding: Grounding, trajectory: Trajectory) -> list[str]:
    """What a caller should know of how the depth map of a request was used, in sentences."""
    camera, depth = trajectory.camera, trajectory.depth
    if request.depth is None or camera is None:
        return []
    if depth is None:
        return ["The depth map was not used: the path is given, or that of the ballistic law."]
    if not depth.is_of_scene:
        if depth.floor is not None:
            why = f"does not show '{grounding.object}' where the image does, as something that rises above the floor"
        elif camera.source == "side-view":
            why = "was given for a drawing that is seen from the side"
        else:
            why = "shows no floor that things could stand on"
        given = depth.source == "request"
        remedy = "Leave `depth` out, or give another map" if given else "Give a map as `depth`, or another picture"
        return [f"The depth map {why}: nothing is answered from it. {remedy}."]
    told = [
        f"The depth map does not show '{body.object}' where the image does, as something that rises above the floor."
        for body in trajectory.bodies
        if body.footprint is not None and body.footprint.seen == 0
    ]
    pitch = None if request.camera is None else request.camera.pitch
    if pitch is not None and abs(camera.pitch - pitch) > APART:
        seen = f"the floor of the depth map is looked down on by {camera.pitch:.0f}: the map is taken"
        told.append(f"`camera.pitch` is {pitch:g} degrees, but {seen}.")
    return told


MAX_NAME = 60  # characters
BOUNCE = 0.15  # m/s of a meeting with the floor, from which it is a bounce
APART = 3.0  # degrees between two pitches of one camera
MOVED = 0.01  # m that a body is displaced, from which it is said to move
STILL = 0.05  # m/s: what is slower is at rest
ROLLED_ON = 0.25  # s after its last bounce, from which it is said to have rolled on
AT_REST = 1e-3  # m from where it starts, within which a body has not set out
COVERED = 0.3  # share of what is hidden, from which it counts as hidden
MAX_MET = 2  # encounters that are told one by one
SIDEWAYS = 0.7  # of the speed in depth: from that on something moves to the side
_KINDS: dict[str, records.EncounterKind] = {"touches": "touches", "covers": "occludes", "covered": "occluded-by"}
_NOTHING_MET = {"touches": "touches nothing", "covers": "hides nothing", "covered": "is not hidden"}
OF_TARGET: tuple[records.AskedRelation, ...] = ("tips", "moves")  # what is asked about does these
OF_ITSELF: tuple[records.AskedRelation, ...] = ("leaves", "lands")  # nothing else is part of these
# What the subject of each other relation does, and that it does not.
EVENTS: dict[records.AskedRelation, tuple[str, str]] = {
    "touches": ("touches", "does not touch"),
    "covers": ("hides", "does not hide"),
    "covered": ("is hidden by", "is not hidden by"),
    "inside": ("ends up in", "does not end up in"),
    "tips": ("is knocked over", "is not knocked over"),
    "moves": ("is set in motion", "is not set in motion"),
    "leaves": ("leaves the image", "does not leave the image"),
    "lands": ("lands on the floor", "does not land on the floor"),
}
DOUBTS: dict[records.Doubt, str] = {  # what an outcome depends on
    "speed": "how fast it moves",
    "heading": "which way it heads in depth",
    "camera": "how the camera stands",
    "size": "how large things are",
    "place": "where things are in depth",
    "friction": "how much the floor brakes",
    "outline": "where the outlines of things run",
    "identity": "whether the things are those that the question names",
    "faint": "whether something stands in the way that is too faint to tell",
    "depth": "whether the depth map shows what matters",
}


def with_facts(
    mover: str, changes: Sequence[Intervention], trajectories: Sequence[Trajectory]
) -> tuple[Trajectory, ...]:
    """The trajectories with their outcomes in words; of two, the first one's words compare both."""
    facts = [facts_of(mover, each) for each in trajectories]
    if len(trajectories) > 1:
        facts[0] = facts_of_both(changes, mover, *trajectories)
    pairs = zip(trajectories, facts, strict=True)
    outcomes = [(each, each.outcome and each.outcome.model_copy(update={"facts": said})) for each, said in pairs]
    return tuple(each.model_copy(update={"outcome": outcome}) for each, outcome in outcomes)


def facts_of(mover: str, trajectory: Trajectory) -> str:
    """One sentence: how the mover goes, what it meets, how it ends, what it sets in motion, and how many worlds agree.

    It tells of the likeliest world; the share of the ensemble that agrees is that of the outcome, where there is one.
    """
    facts = _Facts(mover, trajectory)
    share = facts.agreement()
    if share is None or not trajectory.ensemble:
        return f"{facts.sentence()}."
    return f"{facts.sentence()}; {round(share * trajectory.ensemble)} of {trajectory.ensemble} worlds agree."


def shown(mover: str, trajectory: Trajectory) -> str:
    """What a clip shows, in one sentence: as `facts_of`, without what does not happen, or happens after its end."""
    last = (trajectory.num_frames - 1) / trajectory.fps
    seen = {
        "outcome": None,
        "encounters": tuple(each for each in trajectory.encounters if each.time is None or each.time <= last),
        "contacts": tuple(each for each in trajectory.contacts if each.time <= last),
        "paths": tuple(
            path.model_copy(update={"tipped_at": None}) if (path.tipped_at or 0.0) > last else path
            for path in trajectory.paths
        ),
    }
    return f"{_Facts(mover, trajectory.model_copy(update=seen), only_what_happens=True).sentence()}."


def facts_of_both(changes: Sequence[Intervention], mover: str, changed: Trajectory, factual: Trajectory) -> str:
    """What happens where something is changed first, and in the scene as it is.

    As in: without the vase, the car slides to the right and meets the mug after 1.2 s; with it, ... Or: with the cup
    next to the mug, the car slides to the right; without that change, ...
    """
    removed = [named(each.object.object, "the") for each in changes if each.kind == "remove"]
    placed = [state_words(each) for each in changes if each.kind == "place"]
    parts = [f"{word} {' and '.join(names)}" for word, names in (("without", removed), ("with", placed)) if names]
    if placed:
        back = "without that change" if len(changes) == 1 else "without these changes"
    else:
        back = "with it" if len(removed) == 1 else "with them"
    told, otherwise = (_lowered(facts_of(mover, each).rstrip(".")) for each in (changed, factual))
    given = " and ".join(parts)
    return f"{given[0].upper()}{given[1:]}, {told}; {back}, {otherwise}."


def named(name: str, article: str) -> str:
    """A name behind an article, without its own."""
    short = bare_name(name).rstrip(".?!;:") or "object"
    if len(short) > MAX_NAME:
        short = short[:MAX_NAME].rstrip() + "\u2026"
    return f"{article} {short}"


def _lowered(clause: str) -> str:
    return clause[0].lower() + clause[1:]


def _has_happened(encounter: Encounter) -> bool:
    return encounter.kind == "touches" or encounter.share is None or encounter.share >= COVERED


def _distance_moved(path: Path) -> float:
    """The furthest that it gets from where it starts, m."""
    return max(math.dist(path.states[0][:3], state[:3]) for state in path.states)


def _way_set_out(path: Path) -> tuple[float, float, float]:
    """How far it gets to the right, down and away (m) as it sets out: later it may bounce off what it meets."""
    first, last = path.states[0], len(path.states) - 1
    still = next((i for i, state in enumerate(path.states) if math.dist(state[:3], first[:3]) > AT_REST), last)
    then = path.states[min(last, max(1, still - 1 + len(path.states) // 10))]
    return then[0] - first[0], then[1] - first[1], then[2] - first[2]


def _direction(path: Path) -> str:
    x, y, z = _way_set_out(path)
    away = math.hypot(y, z)  # a floor that is looked down on rises in the image as it leads away
    if abs(x) >= SIDEWAYS * away:
        return "to the right" if x > 0 else "to the left"
    if abs(y) > abs(z):
        return "up" if y < 0 else "down"
    return "away from the camera" if z > 0 else "towards the camera"


class _Facts:
    """The parts of a sentence about a trajectory."""

    def __init__(self, mover: str, trajectory: Trajectory, *, only_what_happens: bool = False) -> None:
        self._trajectory, self._only_what_happens = trajectory, only_what_happens
        self._outcome = trajectory.outcome
        self._names = [mover, *(body.object for body in trajectory.bodies[1:])]
        self._supports = [body.support for body in trajectory.bodies] or ["floor"]
        self._paths = {path.body: path for path in reversed(trajectory.paths)}
        # Which body it is whose encounter is asked about; None where nothing is asked or that body is not there.
        self._subject = None if self._outcome is None else 0
        if self._outcome is not None and self._outcome.subject is not None:
            others = enumerate(self._names[1:], 1)
            self._subject = next((index for index, name in others if name == self._outcome.subject), None)
        asked = None if self._outcome is None else self._outcome.asked.relation
        self._leaving = self._subject if asked == "leaves" else None
        self._asked = self._asked_about()

    def sentence(self) -> str:
        """What happens in the likeliest world: a clause for the mover, then one for each other body that matters."""
        meeting = [each.subject for each in self._trajectory.encounters if each.subject and each.kind == "touches"]
        chosen: list[int] = [*([self._subject] if self._subject else []), *meeting]
        others = [body for body in dict.fromkeys(chosen) if body in self._paths or body == self._subject][:MAX_MET]
        clauses = [self._clause(body) for body in (0, *others)]
        became = self._became()
        return "; ".join([clauses[0], *(_lowered(clause) for clause in (*clauses[1:], *([became] if became else [])))])

    def agreement(self) -> float | None:
        """The share of the worlds in which what the sentence says of the question, or of its first encounter, is so."""
        outcome, placement, first = self._outcome, self._trajectory.placement, self._asked
        if placement is not None:
            return placement.probabilities.get(placement.result, 0.0) if placement.probabilities else None
        if outcome is None or outcome.probability is None:
            told = self._told(0)
            return told[0].probability if told else None
        asked = outcome.asked
        if asked.relation not in (*_KINDS, *OF_ITSELF) or asked.within is not None or asked.partly or asked.every:
            return None
        met, kind = None if first is None else first.object, _KINDS.get(asked.relation)
        landing = self._landing(self._subject or 0) if asked.relation in OF_ITSELF else None
        happens = first is not None if landing is None else landing[0] < math.inf
        own = [e for e in self._trajectory.encounters if e.subject == self._subject and e.kind == kind]
        meant = {(each.body, each.object) for each in own if _has_happened(each) and self._is_meant(each.object)}
        agrees = outcome.probability if asked.negated != happens else 1 - outcome.probability
        agreeing = {
            "whether": agrees,
            "how-many": outcome.probability if len(meant) == outcome.count else None,
            "which-first": outcome.probability if outcome.first == met else None,
            "when": agrees,
        }
        return agreeing.get(asked.form)

    def _asked_about(self) -> Encounter | None:
        """The first encounter that the question asks for."""
        outcome, body, bodies = self._outcome, self._subject, self._trajectory.bodies
        if outcome is None or body is None or outcome.asked.relation not in _KINDS:
            return None
        kind, partly = _KINDS[outcome.asked.relation], outcome.asked.partly
        fitting = [e for e in self._trajectory.encounters if e.kind == kind and (partly or _has_happened(e))]
        own = [each for each in fitting if each.subject == body and self._is_meant(each.object)]
        if outcome.asked.target is not None:
            # Of two that both move, either may be the subject of the encounter.
            pair = {bodies[body].object, outcome.object} if bodies and kind == "touches" else None
            other = [e for e in fitting if e.subject < len(bodies) and {bodies[e.subject].object, e.object} == pair]
            own = [each for each in own if each.object == outcome.object] or other
        return min(own, key=lambda each: each.first_frame, default=None)

    def _is_meant(self, name: str) -> bool:
        """Whether a thing is one of those asked about, where the question names several."""
        among = () if self._outcome is None else self._outcome.asked.among
        return not among or name in among

    def _told(self, body: int) -> list[Encounter]:
        """The encounters of a body that are told, in their order: what is asked about, then the first ones."""
        own = [each for each in self._trajectory.encounters if each.subject == body]
        asked = [self._asked] if self._asked is not None and body == self._subject else []
        touched = {each.object for each in own if each.kind == "touches"}
        rest = [each for each in own if each.kind == "touches" or each.object not in touched]
        ordered = sorted(rest, key=lambda each: (each.kind != "touches", each.first_frame))
        chosen = asked + [each for each in ordered if not any(each is other for other in asked)]
        return sorted(chosen[:MAX_MET], key=lambda each: each.first_frame)

    def _clause(self, body: int) -> str:
        """How one body goes, what it meets, and how it ends."""
        placement = self._trajectory.placement
        if body == 0 and placement is not None:
            end = _ENDS[placement.result]
            if placement.result in ("inside", "sticks-out") and placement.above_rim:
                end = f"{end} with {round(100 * placement.above_rim)}% of its height above the rim"
            parts = ["is carried over", "is let go", end]
        else:
            met, path = self._told(body), self._paths.get(body)
            going, landing = ["stays where it is"], self._landing(body)
            if path is not None and _distance_moved(path) >= MOVED:
                times = [self._time(each) for each in met if each.kind == "touches"]
                going = self._going(path, times if landing is None or body == self._leaving else [0.0])
            told = [*((self._time(each), self._meeting(each)) for each in met), *([landing] if landing else [])]
            parts = [*going, *(words for _, words in sorted(told)), *self._missed(body, met), *self._end(body, path)]
        said = " and ".join(parts) if len(parts) < 3 else f"{', '.join(parts[:-1])} and {parts[-1]}"
        return f"{named(self._names[body], 'The')} {said}"

    def _going(self, path: Path, touches: Sequence[float]) -> list[str]:
        """How a body goes until it meets something."""
        body = path.body
        record = self._trajectory.bodies[body] if self._trajectory.bodies else None
        is_round = record is not None and record.shape == "sphere"
        on, first_touch = "rolls" if is_round else "slides", min(touches, default=math.inf)
        bounces = [
            contact.time
            for contact in self._trajectory.contacts
            if contact.a == body and contact.b is None and contact.impulse >= BOUNCE and 0 < contact.time < first_touch
        ]
        if bounces and body == 0:
            times = {1: "once", 2: "twice"}.get(len(bounces), f"{len(bounces)} times")
            landed = path.states[min(round(bounces[-1] * self._trajectory.fps), len(path.states) - 1)]
            goes_on = first_touch - bounces[-1] > ROLLED_ON and math.dist(landed[:3], path.states[-1][:3]) >= MOVED
            flight = self._flight(path) if self._only_what_happens else []
            return [*flight, f"bounces {times}", *([f"{on} on"] if goes_on else [])]
        if record is None:
            return [f"moves {_direction(path)}"]
        if record.support == "air":
            return self._flight(path)
        if not is_round and path.tipped_at is not None:
            on = "tips over and moves"
        return [f"{on} {_direction(path)}"]

    @staticmethod
    def _flight(path: Path) -> list[str]:
        """How what nothing carries sets out."""
        x, y, _ = _way_set_out(path)
        return [f"flies {_direction(path)}" if abs(x) >= MOVED else "rises" if y < 0 else "falls"]

    def _time(self, encounter: Encounter) -> float:
        """Seconds until an encounter begins."""
        return encounter.first_frame / self._trajectory.fps if encounter.time is None else encounter.time

    def _after_clip(self, time: float) -> str:
        """That something happens when the clip has ended, where it does."""
        trajectory = self._trajectory
        return " (after the clip ends)" if time * trajectory.fps > trajectory.num_frames - 1 else ""

    def _meeting(self, encounter: Encounter) -> str:
        """What a body does with another one, and when."""
        name, at = named(encounter.object, "the"), self._time(encounter)
        time, later = f"{at:.1f} s", self._after_clip(at)
        share = "" if encounter.share is None or self._only_what_happens else f"{round(100 * encounter.share)}%"
        if encounter.kind == "occludes":
            return f"passes in front of {name}{f' (hiding {share} of it)' if share else ''} from {time} on{later}"
        if encounter.kind == "occluded-by":
            return f"passes behind {name}{f' (which hides {share} of it)' if share else ''} from {time} on{later}"
        path, effect = self._paths.get(encounter.body or 0) if encounter.body else None, ""
        if path is not None and path.tipped_at is not None:
            effect = "and tips over "
        elif path is not None and _distance_moved(path) >= MOVED:
            effect = "and pushes "
        return f"meets {effect}{name} after {time}{later}"

    def _landing(self, body: int) -> tuple[float, str] | None:
        """When it falls off what it stands on or, where that is asked, lands or leaves the image, and this in words.

        None where there is nothing to tell; infinity for never, which is told where it is asked.
        """
        outcome, trajectory, on = self._outcome, self._trajectory, self._supports[body]
        asked = None if outcome is None or body != self._subject else outcome.asked.relation
        does, does_not = EVENTS["leaves" if body == self._leaving else "lands"]
        if outcome is not None and body == self._leaving:
            seen = self._paths[body].visible if body in self._paths else ()
            later = outcome.time if ((outcome.probability or 0.0) >= 0.5) != outcome.asked.negated else None
            time = seen.index(False) / trajectory.fps if False in seen else later or math.inf
        elif on == "floor" or (on == "air" and asked != "lands"):
            return None
        else:
            time = next((each.time for each in trajectory.contacts if each.a == body and each.b is None), math.inf)
            if on != "air":
                on = named(on, "the")
                does, does_not = f"falls off {on} onto the floor", f"does not fall off {on}"
        if time == math.inf:
            return (time, does_not) if asked in OF_ITSELF else None
        return time, f"{does} after {time:.1f} s{self._after_clip(time)}"

    def _nothing_touched(self, body: int) -> str:
        """That it touches nothing but what it stood on, or what stood on it, all the time."""
        nothing, on, landing = _NOTHING_MET["touches"], self._supports[body], self._landing(body)
        if landing is not None and body != self._leaving and (on != "air" or landing[0] < math.inf):
            return f"{nothing} else"
        pairs = [(each.a, each.b) for each in self._trajectory.contacts]
        others = [self._names[b if a == body else a] for a, b in pairs if b is not None and body in (a, b)]
        names = dict.fromkeys(named(name, "the") for name in (on, *others) if name not in ("floor", "air"))
        return f"{nothing} but {' and '.join(names)}" if names else nothing

    def _missed(self, body: int, met: Sequence[Encounter]) -> list[str]:
        """That what is asked about does not happen, or that nothing is touched."""
        outcome = self._outcome
        if not self._trajectory.encounters_known or self._only_what_happens:
            return []
        if outcome is None or outcome.asked.relation not in _KINDS or (outcome.asked.target and not outcome.object):
            return [] if body or any(each.kind == "touches" for each in met) else [self._nothing_touched(body)]
        if self._subject != body or self._asked is not None:
            return []
        relation, meant = outcome.asked.relation, [outcome.object] if outcome.object else outcome.asked.among
        if outcome.asked.partly and ((outcome.probability or 0.0) >= 0.5) != outcome.asked.negated:
            name = named(outcome.object, "the") if outcome.object else "something"  # less than an encounter tells of
            return [f"hides a part of {name}" if relation == "covers" else f"is partly hidden by {name}"]
        if relation == "touches" and self._supports[body] in meant:
            return [f"is on {named(self._supports[body], 'the')} from the start"]
        nothing = self._nothing_touched(body) if relation == "touches" else _NOTHING_MET[relation]
        return [f"{EVENTS[relation][1]} {' or '.join(named(each, 'the') for each in meant)}" if meant else nothing]

    def _end(self, body: int, path: Path | None) -> list[str]:
        """How it ends, where the clip shows it."""
        trajectory, until = self._trajectory, self._trajectory.moving_until
        if path is None or until is None or _distance_moved(path) < MOVED:
            return []
        last = min(math.ceil(until * trajectory.fps - 1e-6), trajectory.num_frames - 1) if body == 0 else -1
        if not path.visible[last]:
            return [] if body == self._leaving else ["leaves the image"]
        # What goes away from a camera that looks along the floor is hardly seen to move, and moves all the same.
        goes_on = bool(path.states) and math.hypot(*path.states[-1][3:]) > STILL
        if body != 0 or last == trajectory.num_frames - 1 or goes_on:
            return []
        met = [each.b for each in trajectory.contacts if each.a == body and each.time <= until]
        where = " on the floor" if met and met[-1] is None else ""
        return [f"comes to rest{where} after {until:.1f} s"]

    def _became(self) -> str:
        """What becomes of the body whose fall or motion is asked about."""
        outcome = self._outcome
        if outcome is None or outcome.asked.relation not in OF_TARGET or (outcome.asked.target and not outcome.object):
            return ""
        does, does_not = EVENTS[outcome.asked.relation]
        tips = outcome.asked.relation == "tips"
        times = (
            (path.tipped_at if tips else path.moved_at, self._names[path.body]) for path in self._trajectory.paths[1:]
        )
        found = [(time, name) for time, name in times if time is not None and outcome.object in (None, name)]
        found = [(time, name) for time, name in found if self._is_meant(name)]
        if found:
            time, name = min(found, key=lambda each: each[0])
            return f"{named(name, 'the')} {does} after {time:.1f} s{self._after_clip(time)}"
        if outcome.asked.among:
            return ""
        return f"{named(outcome.object, 'the')} {does_not}" if outcome.object else f"nothing {does}"
