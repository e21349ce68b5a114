"""What happens in a world, as sentences: how each body goes, what it meets, and how it ends."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from cow_service import records
from cow_service.narration.words import Phrases, capitalised, phrases_of

if TYPE_CHECKING:
    from cow_service.records import Encounter, Outcome, Path, Trajectory

BOUNCE = 0.15  # m/s of a meeting with the floor, from which it is a bounce
MOVED = 0.01  # m that a body is displaced, from which it is said to move
STILL = 0.05  # m/s: what is slower is at rest
ROLLED_ON = 0.25  # s after its last bounce, from which it is said to have rolled on
AT_REST = 1e-3  # m from where it starts, within which a body has not set out
COVERED = 0.3  # share of what is hidden, from which it counts as hidden
MAX_MET = 2  # encounters that are named one by one
SIDEWAYS = 0.7  # of the speed in depth: from that on something moves to the side
KINDS: dict[str, records.EncounterKind] = {"touches": "touches", "covers": "occludes", "covered": "occluded-by"}
OF_TARGET: tuple[records.AskedRelation, ...] = ("tips", "moves")  # what is asked about does these
OF_COVERING: tuple[records.AskedRelation, ...] = ("covers", "covered")
OF_ITSELF: tuple[records.AskedRelation, ...] = ("leaves", "lands")  # nothing else is part of these
# The template of each relation; `-at` behind it: with a time, `-not`: that it does not happen, `-none`: with anything.
EVENTS: dict[records.AskedRelation, str] = {
    "touches": "touch", "covers": "cover", "covered": "covered", "inside": "inside", "tips": "tip", "moves": "move",
    "leaves": "leave", "lands": "land",
}  # fmt: skip


def shown(mover: str, trajectory: Trajectory) -> str:
    """What a clip shows, in English: its story, without what does not happen, or happens after its end."""
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
    return Story(mover, trajectory.model_copy(update=seen), phrases_of("en"), only_what_happens=True).text()


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
        return "way-right" if x > 0 else "way-left"
    if abs(y) > abs(z):
        return "way-up" if y < 0 else "way-down"
    return "way-away" if z > 0 else "way-towards"


class Story:
    """The sentences about one trajectory, in the language of `say`."""

    def __init__(self, mover: str, trajectory: Trajectory, say: Phrases, *, only_what_happens: bool = False) -> None:
        self._trajectory, self._say, self._only_what_happens = trajectory, say, only_what_happens
        self._outcome = None if trajectory.outcome is None else trajectory.outcome.of_shown
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
        # An event has one time; where the answer is not sure, what is shown may have another than most versions.
        self._time_asked = self._outcome.time if self._outcome is not None and self._outcome.sure else None
        self._asked = self._asked_about()

    def text(self) -> str:
        """What happens in the world that is shown: a sentence for the mover, one for each other body that matters."""
        meeting = [each.subject for each in self._trajectory.encounters if each.subject and each.kind == "touches"]
        chosen: list[int] = [*([self._subject] if self._subject else []), *meeting]
        others = [body for body in dict.fromkeys(chosen) if body in self._paths or body == self._subject][:MAX_MET]
        sentences = [self._sentence(body) for body in (0, *others)]
        became = self._became()
        return self._say.templates["between"].join([*sentences, *([became] if became else [])])

    def agreement(self) -> float | None:
        """The share of the ensemble in which the first encounter of the story is so, or what becomes of what is put."""
        placement, told = self._trajectory.placement, self._told(0)
        if placement is not None:
            return placement.probabilities.get(placement.result, 0.0) if placement.probabilities else None
        return told[0].probability if told else None

    def support(self) -> list[str]:
        """What the thing that is asked about stands on, other than the floor."""
        on = "floor" if self._subject is None else self._supports[self._subject]
        return [] if on in ("floor", "air") else [on]

    def _asked_about(self) -> Encounter | None:
        """The first encounter that the question asks for."""
        outcome, body = self._outcome, self._subject
        if outcome is None or body is None or outcome.asked.relation not in KINDS:
            return None
        kind = KINDS[outcome.asked.relation]
        least = 0.0 if outcome.asked.partly or kind == "touches" else COVERED
        fitting = [
            e for e in self._trajectory.encounters if e.kind == kind and (1 if e.share is None else e.share) >= least
        ]
        own = [each for each in fitting if each.subject == body and self._is_meant(each.object)]
        if outcome.asked.target is not None:
            other = self._between(body, outcome.object, fitting) if kind == "touches" else []
            own = [each for each in own if each.object == outcome.object] or other
        return min(own, key=lambda each: each.first_frame, default=None)

    def _between(self, body: int, other: str | None, encounters: Sequence[Encounter]) -> list[Encounter]:
        """Those of a body and another thing: of two that both move, either may be the subject."""
        bodies = self._trajectory.bodies
        pair = {bodies[body].object, other} if bodies else set[str]()
        return [e for e in encounters if e.subject < len(bodies) and {bodies[e.subject].object, e.object} == pair]

    def _is_meant(self, name: str) -> bool:
        """Whether a thing is one of those asked about, where the question names several."""
        among = () if self._outcome is None else self._outcome.asked.among
        return not among or name in among

    def _told(self, body: int) -> list[Encounter]:
        """The encounters of a body that are named, in their order: what is asked about, then the first ones."""
        own = [each for each in self._trajectory.encounters if each.subject == body]
        asked = [self._asked] if self._asked is not None and body == self._asked.subject else []
        touched = {each.object for each in own if each.kind == "touches"}
        rest = [each for each in own if each.kind == "touches" or each.object not in touched]
        ordered = sorted(rest, key=lambda each: (each.kind != "touches", each.first_frame))
        chosen = asked + [each for each in ordered if not any(each is other for other in asked)]
        return sorted(chosen[:MAX_MET], key=lambda each: each.first_frame)

    def _sentence(self, body: int) -> str:
        """How one body goes, what it meets, and how it ends."""
        if body == 0 and self._trajectory.placement is not None:
            parts = [self._say("carried"), self._say("released"), self.placed()]
        else:
            met, path = self._told(body), self._paths.get(body)
            going, landing = [self._say("stays")], self._landing(body)
            if path is not None and _distance_moved(path) >= MOVED:
                times = [self._time(each) for each in met if each.kind == "touches"]
                going = self._going(path, times if landing is None or body == self._leaving else [0.0])
            told = [*((self._time(each), self._meeting(each)) for each in met), *([landing] if landing else [])]
            parts = [*going, *(words for _, words in sorted(told)), *self._missed(body, met), *self._end(body, path)]
        return self._say.sentence(self._say.name(self._names[body]), parts)

    def placed(self) -> str:
        """What becomes of the thing that is put somewhere, as a clause."""
        placement = self._trajectory.placement
        if placement is None:
            return ""
        clause = self._say(f"end-{placement.result}")
        if placement.result in ("inside", "sticks-out") and placement.above_rim:
            return self._say("above-rim", clause=clause, share=str(round(100 * placement.above_rim)))
        return clause

    def _going(self, path: Path, touches: Sequence[float]) -> list[str]:
        """How a body goes until it meets something."""
        say, body = self._say, path.body
        record = self._trajectory.bodies[body] if self._trajectory.bodies else None
        is_round = record is not None and record.shape == "sphere"
        on, first_touch, way = "rolls" if is_round else "slides", min(touches, default=math.inf), say(_direction(path))
        bounces = self._bounces(body, first_touch)
        if bounces and body == 0:
            times = {1: "one", 2: "two"}.get(len(bounces), "many")
            landed = path.states[min(round(bounces[-1] * self._trajectory.fps), len(path.states) - 1)]
            goes_on = first_touch - bounces[-1] > ROLLED_ON and math.dist(landed[:3], path.states[-1][:3]) >= MOVED
            flight = [self._flight(path)] if self._only_what_happens else []
            bouncing = say(f"bounces-{times}", count=str(len(bounces)))
            return [*flight, bouncing, *([say(f"{on}-on")] if goes_on else [])]
        if record is None:
            return [say("moves", way=way)]
        if record.support == "air":
            return [self._flight(path)]
        if not is_round and path.tipped_at is not None:
            on = "topples"
        return [say(on, way=way)]

    def _bounces(self, body: int, until: float) -> list[float]:
        """When it bounces off the floor before a time, s."""
        own = [each for each in self._trajectory.contacts if each.a == body and each.b is None]
        return [each.time for each in own if each.impulse >= BOUNCE and 0 < each.time < until]

    def _flight(self, path: Path) -> str:
        """How what nothing carries sets out."""
        x, y, _ = _way_set_out(path)
        if abs(x) >= MOVED:
            return self._say("flies", way=self._say(_direction(path)))
        return self._say("rises" if y < 0 else "falls")

    def _time(self, encounter: Encounter) -> float:
        """Seconds until an encounter begins; of the one that is asked about, the outcome's time, if sure."""
        if encounter is self._asked and self._time_asked is not None:
            return self._time_asked
        return encounter.first_frame / self._trajectory.fps if encounter.time is None else encounter.time

    def timed(self, key: str, time: float, **values: str) -> str:
        """A clause with its time, and that this is after the end of the clip, where it is."""
        clause, trajectory = self._say(key, time=self._say.seconds(time), **values), self._trajectory
        is_later = time * trajectory.fps > trajectory.num_frames - 1
        return self._say("later", clause=clause) if is_later else clause

    def _meeting(self, encounter: Encounter) -> str:
        """What a body does with another one, and when."""
        key, share = "touch-at", ""
        if encounter.kind != "touches":
            key = "in-front" if encounter.kind == "occludes" else "behind"
            share = "" if encounter.share is None or self._only_what_happens else str(round(100 * encounter.share))
            key = f"{key}-share-at" if share else f"{key}-at"
        elif (path := self._paths.get(encounter.body or 0) if encounter.body else None) is not None:
            if path.tipped_at is not None:
                key = "topple-at"
            elif _distance_moved(path) >= MOVED:
                key = "push-at"
        return self.timed(key, self._time(encounter), object=self._say.name(encounter.object), share=share)

    def _landing(self, body: int) -> tuple[float, str] | None:
        """When it falls off what it stands on or, where that is asked, lands or leaves the image, and this in words.

        None where there is nothing to say; infinity for never, which is said where it is asked.
        """
        outcome, on = self._outcome, self._supports[body]
        asked = None if outcome is None or body != self._subject else outcome.asked.relation
        if outcome is not None and body == self._leaving:
            key, time = "leave", self._time_left(body, outcome)
        elif on == "floor" or (on == "air" and asked != "lands"):
            return None
        else:
            key, time = "land" if on == "air" else "fall-off", self._time_landed(body)
            time = self._time_asked or time if asked == "lands" and time < math.inf else time
        name = self._say.name(on)
        if time == math.inf:
            return (time, self._say(f"{key}-not", object=name)) if asked in OF_ITSELF else None
        return time, self.timed(f"{key}-at", time, object=name)

    def _time_landed(self, body: int) -> float:
        """When it first meets the floor, s; infinity for never."""
        floor = (each.time for each in self._trajectory.contacts if each.a == body and each.b is None)
        return next(floor, math.inf)

    def _time_left(self, body: int, outcome: Outcome) -> float:
        """When it leaves the image, s; infinity for never."""
        if self._time_asked is not None and outcome.happens != outcome.asked.negated:
            return self._time_asked
        seen = self._paths[body].visible if body in self._paths else ()
        return seen.index(False) / self._trajectory.fps if False in seen else math.inf

    def _nothing_touched(self, body: int) -> str:
        """That it touches nothing but what it stood on, or what stood on it, all the time."""
        on, landing = self._supports[body], self._landing(body)
        if landing is not None and body != self._leaving and (on != "air" or landing[0] < math.inf):
            return self._say("touch-else")
        pairs = [(each.a, each.b) for each in self._trajectory.contacts]
        others = [self._names[b if a == body else a] for a, b in pairs if b is not None and body in (a, b)]
        names = tuple(dict.fromkeys(name for name in (on, *others) if name not in ("floor", "air")))
        return self._say("touch-but", object=self._say.names(names)) if names else self._say("touch-none")

    def _missed(self, body: int, met: Sequence[Encounter]) -> list[str]:
        """That what is asked about does not happen, or that nothing is touched."""
        outcome = self._outcome
        if not self._trajectory.encounters_known or self._only_what_happens:
            return []
        if outcome is None or outcome.asked.relation not in KINDS or (outcome.asked.target and not outcome.object):
            return [] if body or any(each.kind == "touches" for each in met) else [self._nothing_touched(body)]
        seen = [each for each in met if (each.kind, each.object) == (KINDS[outcome.asked.relation], outcome.object)]
        if self._subject != body or self._asked is not None or seen:  # of what is seen the story says how little it is
            return []
        return [self._not_met(body, outcome)]

    def _not_met(self, body: int, outcome: Outcome) -> str:
        """That what is asked about is not met, or less of it than an encounter has."""
        say = self._say
        relation, meant = outcome.asked.relation, [outcome.object] if outcome.object else outcome.asked.among
        partly = outcome.asked.partly and relation in OF_COVERING
        if partly and outcome.happens != outcome.asked.negated:
            name = say.name(outcome.object) if outcome.object else say("something")  # less than an encounter has
            return say("cover-part" if relation == "covers" else "covered-part", object=name)
        if relation == "touches" and self._supports[body] in meant:
            return say("on-from-start", object=say.name(self._supports[body]))
        if meant:
            return say(f"{EVENTS[relation]}-not", object=say.names(meant, "names-nor"))
        return self._nothing_touched(body) if relation == "touches" else say(f"{EVENTS[relation]}-none")

    def _end(self, body: int, path: Path | None) -> list[str]:
        """How it ends, where the clip shows it."""
        trajectory, until = self._trajectory, self._trajectory.moving_until
        if path is None or until is None or _distance_moved(path) < MOVED:
            return []
        last = min(math.ceil(until * trajectory.fps - 1e-6), trajectory.num_frames - 1) if body == 0 else -1
        if not path.visible[last]:
            return [] if body == self._leaving else [self._say("leave")]
        # What goes away from a camera that looks along the floor is hardly seen to move, and moves all the same.
        goes_on = bool(path.states) and math.hypot(*path.states[-1][3:]) > STILL
        if body != 0 or last == trajectory.num_frames - 1 or goes_on:
            return []
        met = [each.b for each in trajectory.contacts if each.a == body and each.time <= until]
        on_floor = met and met[-1] is None
        return [self._say("rest-floor-at" if on_floor else "rest-at", time=self._say.seconds(until))]

    def _became(self) -> str:
        """What becomes of the body whose fall or motion is asked about, as a sentence."""
        outcome, say = self._outcome, self._say
        if outcome is None or outcome.asked.relation not in OF_TARGET or (outcome.asked.target and not outcome.object):
            return ""
        key, tips = EVENTS[outcome.asked.relation], outcome.asked.relation == "tips"
        times = (
            (path.tipped_at if tips else path.moved_at, self._names[path.body]) for path in self._trajectory.paths[1:]
        )
        found = [(time, name) for time, name in times if time is not None and outcome.object in (None, name)]
        found = [(time, name) for time, name in found if self._is_meant(name)]
        if found:
            time, name = min(found, key=lambda each: each[0])
            time = time if self._time_asked is None else self._time_asked
            return say.sentence(say.name(name), [self.timed(f"{key}-at", time)])
        if outcome.asked.among:
            return ""
        if outcome.object:
            return say.sentence(say.name(outcome.object), [say(f"{key}-not")])
        return capitalised(say("stated", statement=say(f"{key}-none")))
