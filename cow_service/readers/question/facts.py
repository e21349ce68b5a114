"""Says what happens in a world, in one sentence made of the facts of its trajectory."""

from __future__ import annotations

import math
from collections.abc import Sequence

from cow_service.records import Contact, Encounter, EncounterKind, Outcome, Path, Trajectory

MAX_NAME = 60  # characters
BOUNCE = 0.15  # m/s of a meeting with the floor, from which it is a bounce
MOVED = 0.01  # m that a body is displaced, from which it is said to move
ROLLED_ON = 0.25  # s after its last bounce, from which it is said to have rolled on
TIPPED = 60.0  # degrees turned, from which a body that is no sphere has tipped over
COVERED = 0.3  # share of what is hidden, from which it counts as hidden
MAX_MET = 2  # encounters that are told one by one
_KINDS: dict[str, EncounterKind] = {"touches": "touches", "covers": "occludes", "covered": "occluded-by"}
_NOT_MET: dict[str, str] = {
    "touches": "does not touch {}",
    "covers": "does not hide {}",
    "covered": "is not hidden by {}",
}
_NOTHING_MET: dict[str, str] = {"touches": "touches nothing", "covers": "hides nothing", "covered": "is not hidden"}

SIDEWAYS = 0.7  # of the speed in depth: from that on something moves to the side


def facts_of(mover: str, trajectory: Trajectory) -> str:
    """One sentence: how the mover goes, what it meets, how it ends, and how many worlds agree with that.

    It tells of the likeliest world; the share of the ensemble that agrees is that of the outcome, where there is one.
    """
    met = _told(trajectory)
    parts = [*_motion(trajectory, met), *(_meeting(each, trajectory) for each in met)]
    missed = _missed(trajectory, met)
    if missed:
        parts.append(missed)
    parts += _end(trajectory)
    sentence = f"{_named(mover, 'The')} {_joined(parts)}"
    share = _agreement(trajectory, met)
    if share is None or not trajectory.ensemble:
        return f"{sentence}."
    agree = round(share * trajectory.ensemble)
    return f"{sentence}; {agree} of {trajectory.ensemble} worlds agree."


def _named(name: str, article: str) -> str:
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


def _told(trajectory: Trajectory) -> list[Encounter]:
    """The encounters that the sentence tells of, in their order: what is asked about, then the first ones."""
    outcome = trajectory.outcome
    asked = None if outcome is None else _asked_about(outcome, trajectory.encounters)
    touched = {each.object for each in trajectory.encounters if each.kind == "touches"}
    rest = [each for each in trajectory.encounters if each.kind == "touches" or each.object not in touched]
    ordered = sorted(rest, key=lambda each: (each.kind != "touches", each.first_frame))
    chosen = ([] if asked is None else [asked]) + [each for each in ordered if each is not asked]
    return sorted(chosen[:MAX_MET], key=lambda each: each.first_frame)


def _asked_about(outcome: Outcome, encounters: Sequence[Encounter]) -> Encounter | None:
    """The first encounter that the question asks for."""
    fitting = [each for each in encounters if each.kind == _KINDS[outcome.asked.relation] and _happened(each)]
    if outcome.asked.target is not None:
        fitting = [each for each in fitting if each.object == outcome.object]
    return min(fitting, key=lambda each: each.first_frame, default=None)


def _motion(trajectory: Trajectory, met: Sequence[Encounter]) -> list[str]:
    """How it goes until it meets something."""
    path, body = trajectory.path, trajectory.bodies[0] if trajectory.bodies else None
    if _displaced(path) < MOVED:
        return ["stays where it is"]
    round_body = body is not None and body.shape == "sphere"
    on = "rolls" if round_body else "slides"
    first_touch = min((_time(each, trajectory) for each in met if each.kind == "touches"), default=math.inf)
    bounces = [
        contact.time
        for contact in trajectory.contacts
        if contact.a == 0 and contact.b is None and contact.impulse >= BOUNCE and 0 < contact.time < first_touch
    ]
    if bounces:
        times = {1: "once", 2: "twice"}.get(len(bounces), f"{len(bounces)} times")
        return [f"bounces {times}", *([f"{on} on"] if first_touch - bounces[-1] > ROLLED_ON else [])]
    if body is None:
        verb = "moves"
    elif body.support == "air":
        rises = path.states[-1][1] < path.states[0][1]
        still = _across(path) < MOVED
        return [("rises" if rises else "falls") if still else f"flies {_direction(path)}"]
    else:
        verb = on
    if body is not None and not round_body and _tips(path):
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
    """The frame by which it has set out."""
    return max(1, len(path.states) // 10)


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


def _tips(path: Path) -> bool:
    return any(abs(angle) >= TIPPED for angle in path.rotation)


def _contact_with(encounter: Encounter, trajectory: Trajectory) -> Contact | None:
    pair = {0, encounter.body}
    return next((each for each in trajectory.contacts if each.b is not None and {each.a, each.b} == pair), None)


def _time(encounter: Encounter, trajectory: Trajectory) -> float:
    """Seconds until an encounter begins."""
    contact = _contact_with(encounter, trajectory) if encounter.kind == "touches" else None
    return encounter.first_frame / trajectory.fps if contact is None else contact.time


def _meeting(encounter: Encounter, trajectory: Trajectory) -> str:
    """What the mover does with another object, and when."""
    name, time = _named(encounter.object, "the"), f"{_time(encounter, trajectory):.1f} s"
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
    if body < len(trajectory.bodies) and trajectory.bodies[body].shape != "sphere" and _tips(path):
        return "and tips over "
    return "and pushes " if _displaced(path) >= MOVED else ""


def _missed(trajectory: Trajectory, met: Sequence[Encounter]) -> str:
    """That what is asked about does not happen, or that nothing is touched; empty where either is not so."""
    outcome = trajectory.outcome
    if not trajectory.encounters_known:
        return ""
    if outcome is not None and (outcome.asked.target is None or outcome.object is not None):
        if _asked_about(outcome, trajectory.encounters) is not None:
            return ""
        if outcome.asked.target is None or outcome.object is None:
            return _NOTHING_MET[outcome.asked.relation]
        return _NOT_MET[outcome.asked.relation].format(_named(outcome.object, "the"))
    return "" if any(each.kind == "touches" for each in met) else _NOTHING_MET["touches"]


def _end(trajectory: Trajectory) -> list[str]:
    """How it ends, where the clip shows it."""
    until = trajectory.moving_until
    if until is None or _displaced(trajectory.path) < MOVED:
        return []
    last = min(math.ceil(until * trajectory.fps - 1e-6), trajectory.num_frames - 1)
    if not trajectory.path.visible[last]:
        return ["leaves the image"]
    return [f"comes to rest after {until:.1f} s"] if last < trajectory.num_frames - 1 else []


def _agreement(trajectory: Trajectory, met: Sequence[Encounter]) -> float | None:
    """The share of the worlds in which what the sentence says of the question, or of its first encounter, is so."""
    outcome = trajectory.outcome
    if outcome is None or outcome.probability is None:
        return met[0].probability if met else None
    asked, first = outcome.asked, _asked_about(outcome, trajectory.encounters)
    if asked.form == "whether":
        happens = outcome.probability if not asked.negated else 1 - outcome.probability
        return happens if first is not None else 1 - happens
    if asked.form == "how-many":
        kind = _KINDS[asked.relation]
        count = len({each.object for each in trajectory.encounters if each.kind == kind and _happened(each)})
        return outcome.probability if count == outcome.count else None
    if asked.form == "which-first":
        return outcome.probability if outcome.first == (None if first is None else first.object) else None
    if first is None:
        return outcome.probability if outcome.time is None else None
    return first.probability
