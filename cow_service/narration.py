"""Says in English what happens in a world: names, ways and places in words, and a trajectory in one sentence."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # the command line prints its help without records
    from cow_service.records import (
        Contact,
        Encounter,
        EncounterKind,
        Intervention,
        Path,
        PlacedBefore,
        Placement,
        PlacementResult,
        PlaceRelation,
        Trajectory,
        Vector,
    )

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
    flat = _flat_words(direction)
    away = "away from the camera" if depth > 0 else "towards the camera"
    if not flat or abs(depth) >= ALONG_AXIS:
        return away if abs(depth) > IN_PLANE else flat
    return f"{flat} and {away}" if abs(depth) > IN_PLANE else flat


def _flat_words(direction: Vector | None) -> str:
    if direction is None or math.hypot(*direction) == 0 or not all(map(math.isfinite, direction)):
        return ""
    sector = round(math.atan2(-direction[1], direction[0]) / (math.pi / 8)) % 16
    main, side = _QUARTERS[sector // 4]
    return (main, f"{main} and slightly {side}", f"{main} and {side}", f"{side} and slightly {main}")[sector % 4]


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
_DOES_NOT_STAY: dict[PlacementResult, str] = {
    "overlaps": "there is no room for it, and it overlaps",
    "falls-off": "it does not stay there, but falls off",
    "tips": "it does not stay there: it tips over, or tips over what it is put to",
}
_NOT_AS_MEANT: dict[PlacementResult, str] = {
    "sticks-out": "goes in but sticks out",
    "on-the-rim": "does not go in, but lies on the rim",
}
_ENDS: dict[PlacementResult, str] = {
    "inside": "goes in and stays inside",
    "sticks-out": "goes in but sticks out",
    "on-the-rim": "does not go in and stays on the rim",
    "on-top": "stays on top",
    "beside": "stays there without overlapping",
    "overlaps": "has no room there and overlaps",
    "falls-off": "falls off",
    "tips": "tips over, or tips over what it was put to",
}


def placement_parts(placement: Placement) -> list[str]:
    """The parts of a sentence about it, after its name."""
    end = _ENDS[placement.result]
    if placement.result in ("inside", "sticks-out") and placement.above_rim:
        end = f"{end} with {round(100 * placement.above_rim)}% of its height above the rim"
    return ["is carried over", "is let go", end]


def placement_share(placement: Placement) -> float | None:
    """The share of the worlds with the result that is told; None without an ensemble."""
    return placement.probabilities.get(placement.result, 0.0) if placement.probabilities else None


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
    faults: list[PlacementResult] = [result for result in _DOES_NOT_STAY if result in placed.probabilities]
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


MAX_NAME = 60  # characters
BOUNCE = 0.15  # m/s of a meeting with the floor, from which it is a bounce
MOVED = 0.01  # m that a body is displaced, from which it is said to move
ROLLED_ON = 0.25  # s after its last bounce, from which it is said to have rolled on
AT_REST = 1e-3  # m from where it starts, within which a body has not set out
COVERED = 0.3  # share of what is hidden, from which it counts as hidden
MAX_MET = 2  # encounters that are told one by one
_KINDS: dict[str, EncounterKind] = {"touches": "touches", "covers": "occludes", "covered": "occluded-by"}
_NOT_MET: dict[str, str] = {
    "touches": "does not touch {}",
    "covers": "does not hide {}",
    "covered": "is not hidden by {}",
}
_NOTHING_MET: dict[str, str] = {"touches": "touches nothing", "covers": "hides nothing", "covered": "is not hidden"}
_BECOMES: dict[str, tuple[str, str]] = {
    "tips": ("is knocked over", "is not knocked over"),
    "moves": ("is set in motion", "is not set in motion"),
}
SIDEWAYS = 0.7  # of the speed in depth: from that on something moves to the side


def facts_of(mover: str, trajectory: Trajectory) -> str:
    """One sentence: how the mover goes, what it meets, how it ends, what it sets in motion, and how many worlds agree.

    It tells of the likeliest world; the share of the ensemble that agrees is that of the outcome, where there is one.
    """
    told, share = happening(mover, trajectory), _agreement(trajectory)
    if share is None or not trajectory.ensemble:
        return f"{told}."
    agree = round(share * trajectory.ensemble)
    return f"{told}; {agree} of {trajectory.ensemble} worlds agree."


def happening(mover: str, trajectory: Trajectory) -> str:
    """What happens in the likeliest world: a clause for the mover, then one for each other body that matters."""
    clauses = [_clause(mover, 0, trajectory)]
    clauses += [_clause(trajectory.bodies[body].object, body, trajectory) for body in _others_told(trajectory)]
    became = _became(trajectory)
    clauses += [became] if became else []
    first, *rest = clauses
    return "; ".join([first, *(clause[0].lower() + clause[1:] for clause in rest)])


def _clause(name: str, body: int, trajectory: Trajectory) -> str:
    """How one body goes, what it meets, and how it ends."""
    if body == 0 and trajectory.placement is not None:
        return f"{named(name, 'The')} {_joined(placement_parts(trajectory.placement))}"
    met = _told(trajectory, body)
    parts = [*_motion(trajectory, body, met), *(_meeting(each, trajectory) for each in met)]
    missed = _missed(trajectory, body, met)
    parts += [missed] if missed else []
    parts += _end(trajectory, body)
    return f"{named(name, 'The')} {_joined(parts)}"


def _others_told(trajectory: Trajectory) -> list[int]:
    """The bodies beside the mover that are told of: whose encounter is asked about, and those that touch others."""
    asked = asked_body(trajectory)
    moving = [path.body for path in trajectory.paths[1:]]
    meeting = [each.subject for each in trajectory.encounters if each.subject and each.kind == "touches"]
    chosen = list[int](dict.fromkeys([*([asked] if asked else []), *meeting]))
    return [body for body in chosen if body in moving or body == asked][:MAX_MET]


def asked_body(trajectory: Trajectory) -> int | None:
    """Which body it is whose encounter is asked about; None where nothing is asked or that body is not there."""
    if trajectory.outcome is None:
        return None
    name = trajectory.outcome.subject
    if name is None:
        return 0
    return next((i for i, body in enumerate(trajectory.bodies) if i and body.object == name), None)


def named(name: str, article: str) -> str:
    """A name behind an article, without its own."""
    words = name.split()
    if len(words) > 1 and words[0].lower() in {"the", "a", "an"}:
        words = words[1:]
    short = " ".join(words).rstrip(".?!;:") or "object"
    if len(short) > MAX_NAME:
        short = short[:MAX_NAME].rstrip() + "\u2026"
    return f"{article} {short}"


def _joined(parts: Sequence[str]) -> str:
    return " and ".join(parts) if len(parts) < 3 else f"{', '.join(parts[:-1])} and {parts[-1]}"


def _happened(encounter: Encounter) -> bool:
    return encounter.kind == "touches" or encounter.share is None or encounter.share >= COVERED


def _told(trajectory: Trajectory, body: int) -> list[Encounter]:
    """The encounters of a body that are told, in their order: what is asked about, then the first ones."""
    own = [each for each in trajectory.encounters if each.subject == body]
    asked = _asked_about(trajectory) if body == asked_body(trajectory) else None
    touched = {each.object for each in own if each.kind == "touches"}
    rest = [each for each in own if each.kind == "touches" or each.object not in touched]
    ordered = sorted(rest, key=lambda each: (each.kind != "touches", each.first_frame))
    chosen = ([] if asked is None else [asked]) + [each for each in ordered if each is not asked]
    return sorted(chosen[:MAX_MET], key=lambda each: each.first_frame)


def _asked_about(trajectory: Trajectory) -> Encounter | None:
    """The first encounter that the question asks for."""
    outcome, body = trajectory.outcome, asked_body(trajectory)
    if outcome is None or body is None or outcome.asked.relation not in _KINDS:
        return None
    kind = _KINDS[outcome.asked.relation]
    partly = outcome.asked.partly
    fitting = [each for each in trajectory.encounters if each.kind == kind and (partly or _happened(each))]
    own = [each for each in fitting if each.subject == body and _is_meant(each.object, trajectory)]
    if outcome.asked.target is not None:
        pair = {trajectory.bodies[body].object, outcome.object} if trajectory.bodies else set[str | None]()
        # Of two that both move, either may be the subject of the encounter.
        other = [each for each in fitting if kind == "touches" and {_name_of(each, trajectory), each.object} == pair]
        own = [each for each in own if each.object == outcome.object] or other
    return min(own, key=lambda each: each.first_frame, default=None)


def _is_meant(name: str, trajectory: Trajectory) -> bool:
    """Whether a thing is one of those asked about, where the question names several."""
    among = () if trajectory.outcome is None else trajectory.outcome.asked.among
    return not among or name in among


def _name_of(encounter: Encounter, trajectory: Trajectory) -> str:
    return trajectory.bodies[encounter.subject].object if encounter.subject < len(trajectory.bodies) else ""


def _path_of(trajectory: Trajectory, body: int) -> Path | None:
    return next((path for path in trajectory.paths if path.body == body), None)


def _became(trajectory: Trajectory) -> str:
    """What becomes of the body whose fall or motion is asked about."""
    outcome = trajectory.outcome
    if outcome is None or outcome.asked.relation not in _BECOMES or (outcome.asked.target and not outcome.object):
        return ""
    does, does_not = _BECOMES[outcome.asked.relation]
    by = "tipped_at" if outcome.asked.relation == "tips" else "moved_at"
    found = [
        (trajectory.bodies[path.body].object, getattr(path, by))
        for path in trajectory.paths[1:]
        if getattr(path, by) is not None and outcome.object in (None, trajectory.bodies[path.body].object)
        and _is_meant(trajectory.bodies[path.body].object, trajectory)
    ]  # fmt: skip
    if not found and outcome.asked.among:
        return ""
    if not found:
        return f"{named(outcome.object, 'the') if outcome.object else 'nothing'} {does_not if outcome.object else does}"
    name, time = min(found, key=lambda each: each[1])
    return f"{named(name, 'the')} {does} after {time:.1f} s"


def _motion(trajectory: Trajectory, body: int, met: Sequence[Encounter]) -> list[str]:
    """How a body goes until it meets something."""
    path, record = _path_of(trajectory, body), trajectory.bodies[body] if trajectory.bodies else None
    if path is None or _displaced(path) < MOVED:
        return ["stays where it is"]
    round_body = record is not None and record.shape == "sphere"
    on = "rolls" if round_body else "slides"
    first_touch = min((_time(each, trajectory) for each in met if each.kind == "touches"), default=math.inf)
    bounces = [
        contact.time
        for contact in trajectory.contacts
        if contact.a == body and contact.b is None and contact.impulse >= BOUNCE and 0 < contact.time < first_touch
    ]
    if bounces and body == 0:
        times = {1: "once", 2: "twice"}.get(len(bounces), f"{len(bounces)} times")
        return [f"bounces {times}", *([f"{on} on"] if first_touch - bounces[-1] > ROLLED_ON else [])]
    if record is None:
        verb = "moves"
    elif record.support == "air":
        rises = path.states[_set_out(path)][1] < path.states[0][1]
        still = _across(path) < MOVED
        return [("rises" if rises else "falls") if still else f"flies {_direction(path)}"]
    else:
        verb = on
    if record is not None and not round_body and path.tipped_at is not None:
        verb = "tips over and moves"
    return [f"{verb} {_direction(path)}"]


def _displaced(path: Path) -> float:
    """The furthest that it gets from where it starts, m."""
    start = path.states[0][:3]
    return max(math.dist(start, state[:3]) for state in path.states)


def _across(path: Path) -> float:
    """How far it gets to the side as it sets out, m: later it may bounce off what it meets."""
    return abs(path.states[_set_out(path)][0] - path.states[0][0])


def _set_out(path: Path) -> int:
    """The frame by which it has set out: some time after the last one in which it is where it starts."""
    last = len(path.states) - 1
    still = next((i for i, state in enumerate(path.states) if math.dist(state[:3], path.states[0][:3]) > AT_REST), last)
    return min(last, max(1, still - 1 + len(path.states) // 10))


def _direction(path: Path) -> str:
    """The way that it sets out: later it may bounce off what it meets."""
    first, then = path.states[0], path.states[_set_out(path)]
    x, y, z = (then[axis] - first[axis] for axis in range(3))
    away = math.hypot(y, z)  # a floor that is looked down on rises in the image as it leads away
    if abs(x) >= SIDEWAYS * away:
        return "to the right" if x > 0 else "to the left"
    if abs(y) > abs(z):
        return "up" if y < 0 else "down"
    return "away from the camera" if z > 0 else "towards the camera"


def _contact_with(encounter: Encounter, trajectory: Trajectory) -> Contact | None:
    pair = {encounter.subject, encounter.body}
    return next((each for each in trajectory.contacts if each.b is not None and {each.a, each.b} == pair), None)


def _time(encounter: Encounter, trajectory: Trajectory) -> float:
    """Seconds until an encounter begins."""
    contact = _contact_with(encounter, trajectory) if encounter.kind == "touches" else None
    return encounter.first_frame / trajectory.fps if contact is None else contact.time


def _meeting(encounter: Encounter, trajectory: Trajectory) -> str:
    """What the mover does with another object, and when."""
    name, time = named(encounter.object, "the"), f"{_time(encounter, trajectory):.1f} s"
    share = "" if encounter.share is None else f"{round(100 * encounter.share)}%"
    if encounter.kind == "occludes":
        hidden = f" (hiding {share} of it)" if share else ""
        return f"passes in front of {name}{hidden} from {time} on"
    if encounter.kind == "occluded-by":
        hidden = f" (which hides {share} of it)" if share else ""
        return f"passes behind {name}{hidden} from {time} on"
    return f"meets {_effect(encounter.body, trajectory)}{name} after {time}"


def _effect(body: int | None, trajectory: Trajectory) -> str:
    """What becomes of a body that is met."""
    path = next((each for each in trajectory.paths[1:] if each.body == body), None)
    if body is None or path is None:
        return ""
    if path.tipped_at is not None:
        return "and tips over "
    return "and pushes " if _displaced(path) >= MOVED else ""


def _missed(trajectory: Trajectory, body: int, met: Sequence[Encounter]) -> str:
    """That what is asked about does not happen, or that nothing is touched; empty where either is not so."""
    outcome, asked = trajectory.outcome, asked_body(trajectory)
    if not trajectory.encounters_known:
        return ""
    touched = any(each.kind == "touches" for each in met)
    if outcome is None or outcome.asked.relation not in _KINDS or (outcome.asked.target and not outcome.object):
        return "" if body or touched else _NOTHING_MET["touches"]
    if asked != body or _asked_about(trajectory) is not None:
        return ""
    if outcome.asked.partly and ((outcome.probability or 0.0) >= 0.5) != outcome.asked.negated:
        name = named(outcome.object, "the") if outcome.object else "something"  # less than an encounter tells of
        return f"hides a part of {name}" if outcome.asked.relation == "covers" else f"is partly hidden by {name}"
    meant = [outcome.object] if outcome.object else outcome.asked.among
    if not meant:
        return _NOTHING_MET[outcome.asked.relation]
    return _NOT_MET[outcome.asked.relation].format(" or ".join(named(each, "the") for each in meant))


def _end(trajectory: Trajectory, body: int) -> list[str]:
    """How it ends, where the clip shows it."""
    path, until = _path_of(trajectory, body), trajectory.moving_until
    if path is None or until is None or _displaced(path) < MOVED:
        return []
    last = min(math.ceil(until * trajectory.fps - 1e-6), trajectory.num_frames - 1) if body == 0 else -1
    if not path.visible[last]:
        return ["leaves the image"]
    if body != 0 or last == trajectory.num_frames - 1:
        return []
    met = [each.b for each in trajectory.contacts if each.a == body and each.time <= until]
    where = " on the floor" if met and met[-1] is None else ""
    return [f"comes to rest{where} after {until:.1f} s"]


def _agreement(trajectory: Trajectory) -> float | None:
    """The share of the worlds in which what the sentence says of the question, or of its first encounter, is so."""
    outcome = trajectory.outcome
    if trajectory.placement is not None:
        return placement_share(trajectory.placement)
    if outcome is None or outcome.probability is None:
        met = _told(trajectory, 0)
        return met[0].probability if met else None
    asked, first = outcome.asked, _asked_about(trajectory)
    if asked.relation not in _KINDS or asked.within is not None or asked.partly or asked.every:
        return None
    agreeing: dict[str, float | None] = {
        "whether": outcome.probability if asked.negated == (first is None) else 1 - outcome.probability,
        "how-many": outcome.probability if _count(trajectory) == outcome.count else None,
        "which-first": outcome.probability if outcome.first == (None if first is None else first.object) else None,
        "when": (outcome.probability if outcome.time is None else None) if first is None else first.probability,
    }
    return agreeing.get(asked.form)


def _count(trajectory: Trajectory) -> int:
    """How many things the body asked about meets in the way asked about."""
    outcome, body = trajectory.outcome, asked_body(trajectory)
    kind = None if outcome is None else _KINDS[outcome.asked.relation]
    own = [each for each in trajectory.encounters if each.subject == body and each.kind == kind]
    return len({(each.body, each.object) for each in own if _happened(each) and _is_meant(each.object, trajectory)})


def facts_of_both(changes: Sequence[Intervention], mover: str, changed: Trajectory, factual: Trajectory) -> str:
    """As in: without the vase, the car slides to the right and meets the mug after 1.2 s; with it, ...

    Or: with the cup next to the mug, the car slides to the right; without that change, ...
    """
    removed = [named(each.object.object, "the") for each in changes if each.kind == "remove"]
    placed = [state_words(each) for each in changes if each.kind == "place"]
    without = [f"without {' and '.join(removed)}"] if removed else []
    given = " and ".join([*without, *([f"with {' and '.join(placed)}"] if placed else [])])
    if placed:
        back = "without that change" if len(changes) == 1 else "without these changes"
    else:
        back = "with it" if len(removed) == 1 else "with them"
    told, otherwise = _within(facts_of(mover, changed)), _within(facts_of(mover, factual))
    return f"{given[0].upper()}{given[1:]}, {told}; {back}, {otherwise}."


def _within(sentence: str) -> str:
    """A sentence as a part of another one."""
    bare = sentence.rstrip(".")
    return bare[0].lower() + bare[1:]
