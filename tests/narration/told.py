"""Small records of what happened, for the tests of how it is told: a clip of two seconds, and who does what in it."""

from __future__ import annotations

from typing import Any

from cow_service.records import Asked, Body, Contact, Encounter, Grounding, Outcome, Path, Trajectory

FRAMES, FPS = 21, 10.0
BOX = (0.0, 0.0, 10.0, 10.0)
NAMES = ("ball", "cube", "mug", "vase")


def path(body: int = 0, to: tuple[float, ...] = (1.0, 0.0, 0.0), *, leaves: bool = False, **values: Any) -> Path:
    """Straight on, `to` the right, down and away (m); what `leaves` is out of the image in the last five frames."""
    steps = [frame / (FRAMES - 1) for frame in range(FRAMES)]
    given = {
        "states": tuple((to[0] * s, to[1] * s, 3 + to[2] * s, 0.0, 0.0, 0.0) for s in steps),
        "points": tuple((100 * s * to[0], 0.0) for s in steps),
        "visible": (*([True] * (FRAMES - 5)), *([not leaves] * 5)),
    }
    return Path(body=body, **(given | values))


def body(name: str, support: str = "floor", **values: Any) -> Body:
    given: dict[str, Any] = {"bbox": BOX, "size": (0.1, 0.1, 0.1), "position": (0.0, 0.0, 3.0), "confidence": 1.0}
    given["shape"] = "sphere" if name == "ball" else "box"
    return Body(object=name, support=support, source="embedded", **(given | values))


BODIES = tuple(body(name) for name in NAMES)
FLIES = {"bodies": (body("ball", "air"), *BODIES[1:])}
ON_TABLE = {"bodies": (body("ball", "table"), body("table"), *BODIES[1:])}


def world(outcome: Outcome | None = None, **values: Any) -> Trajectory:
    """A ball that goes to the right, with a cube, a mug and a vase."""
    given: dict[str, Any] = {"bodies": BODIES, "paths": (path(),), "outcome": outcome}
    return Trajectory(fps=FPS, anchors=(), **(given | values))


def touch(name: str = "cube", frame: int = 11, **values: Any) -> Encounter:
    number = NAMES.index(name) if name in NAMES else 1
    return Encounter(object=name, bbox=BOX, body=number, kind="touches", first_frame=frame, **values)


def hiding(kind: Any, share: float | None, name: str = "vase") -> Encounter:
    return Encounter(object=name, bbox=BOX, body=NAMES.index(name), kind=kind, first_frame=8, share=share)


def meeting(time: float, a: int = 0, b: int | None = None, impulse: float = 1.5) -> Contact:
    """With the floor, if `b` is not given."""
    return Contact(a=a, b=b, time=time, point=(1.0, 1.0), impulse=impulse)


def asks(relation: Any, target: str | None = None, probability: float | None = 0.9, **values: Any) -> Outcome:
    """What comes of a question, which is sure; `values` are fields of the question and of the outcome."""
    question = {name: value for name, value in values.items() if name in Asked.model_fields}
    given = {"object": target, "sure": True, "robust": True, "subject": values.get("subject")}
    given |= {name: value for name, value in values.items() if name not in question}
    return Outcome(asked=Asked(relation=relation, target=target, **question), probability=probability, **given)


def unsure(relation: Any, target: str | None = None, probability: float | None = 0.9, **values: Any) -> Outcome:
    return asks(relation, target, probability, **({"sure": False, "robust": False} | values))


def grounded(name: str = "ball", *changes: tuple[str, ...]) -> Grounding:
    """With things that are taken away, each named alone, or put somewhere: a relation, the thing and its targets."""
    interventions = [
        {
            "kind": "remove" if len(change) == 1 else "place",
            "object": {"object": change[0] if len(change) == 1 else change[1], "bbox": BOX},
            "relation": None if len(change) == 1 else change[0],
            "targets": [{"object": target, "bbox": BOX} for target in change[2:]],
        }
        for change in changes
    ]
    given = {"object": name, "point": (5.0, 5.0), "bbox": BOX, "source": "embedded", "interventions": interventions}
    return Grounding.model_validate(given)
