"""The sentence that says what happens in a world."""

from __future__ import annotations

from typing import Any

import pytest

from cow_service.narration.summary import narrate
from cow_service.records import Asked, Body, Contact, Encounter, Grounding, Outcome, Path, Trajectory

FRAMES, FPS = 21, 10.0
BOX = (0.0, 0.0, 10.0, 10.0)
HIT = Asked(relation="touches", target="white cube")


def path(
    body: int = 0, *, to: tuple[float, float, float] = (1.0, 0.0, 0.0), turned: float = 0.0, leaves: bool = False
) -> Path:
    steps = [frame / (FRAMES - 1) for frame in range(FRAMES)]
    points = tuple((100 * step * to[0], 0.0) for step in steps)
    return Path(
        body=body,
        states=tuple((to[0] * s, to[1] * s, 3 + to[2] * s, 0.0, 0.0, 0.0) for s in steps),
        points=points,
        visible=(*([True] * (FRAMES - 5)), *([not leaves] * 5)),
        scale=(1.0,) * FRAMES,
        tipped_at=1.2 if turned > 45 else None,
        tracks=(points,),
    )


def body(name: str, shape: Any = "box", support: str = "floor") -> Body:
    return Body(
        object=name, bbox=BOX, shape=shape, size=(0.1, 0.1, 0.1), position=(0.0, 0.0, 3.0), support=support,
        source="embedded", confidence=1.0,
    )  # fmt: skip


def touch(name: str = "white cube", number: int = 1, frame: int = 11, probability: float | None = 0.93) -> Encounter:
    return Encounter(object=name, bbox=BOX, body=number, kind="touches", first_frame=frame, probability=probability)


def occlusion(kind: Any, share: float, name: str = "vase") -> Encounter:
    return Encounter(object=name, bbox=BOX, body=1, kind=kind, first_frame=8, share=share, probability=0.9)


def world(**values: Any) -> Trajectory:
    given: dict[str, Any] = {"bodies": (body("ball", "sphere"),), "paths": (path(),)}
    return Trajectory(fps=FPS, anchors=(), **(given | values))


def outcome(asked: Asked, probability: float, name: str | None = "white cube", **values: Any) -> Outcome:
    return Outcome(asked=asked, object=name, probability=probability, sure=True, robust=True, **values)


def grounded(name: str) -> Grounding:
    return Grounding(object=name, point=(5.0, 5.0), bbox=BOX, source="embedded")


BALL, CUBE = body("ball", "sphere"), body("white cube")
THROWN = world(
    bodies=(body("ball", "sphere", "air"), CUBE),
    contacts=(
        Contact(a=0, b=None, time=0.4, point=(1.0, 1.0), impulse=1.5),
        Contact(a=0, b=None, time=0.7, point=(1.0, 1.0), impulse=0.01),
        Contact(a=0, b=1, time=1.14, point=(1.0, 1.0), impulse=0.5),
    ),
    encounters=(touch(),),
    ensemble=100,
)
FALL, ROLLS = Asked(relation="lands"), body("ball", "sphere", "table")
STANDS = Contact(a=0, b=1, time=0.0, point=(1.0, 1.0), impulse=0.1)
FALLS = Contact(a=0, b=None, time=0.8, point=(1.0, 1.0), impulse=1.5)
COUNTED = Asked(form="how-many", relation="touches")
LEAVES = Asked(relation="leaves")


@pytest.mark.parametrize(
    ("mover", "told", "story", "summary"),
    [
        ("ball", THROWN,
         "The ball bounces once, rolls on and hits the white cube after about 1.1 s.",
         "93 of 100 simulated versions agree."),
        ("the ball", THROWN.model_copy(update={"ensemble": 0}),
         "The ball bounces once, rolls on and hits the white cube after about 1.1 s.",
         ""),
        ("A ball", THROWN.model_copy(update={"outcome": outcome(HIT, 0.9)}),
         "The ball bounces once, rolls on and hits the white cube after about 1.1 s.",
         "Yes, it hits the white cube. 90 of 100 simulated versions agree."),
        ("ball", world(), "The ball rolls to the right and hits nothing.",
         ""),
        ("ball", world(encounters_known=False), "The ball rolls to the right.",
         ""),
        ("red mug", world(bodies=(body("red mug"), body("pink vase")), paths=(path(to=(-1.0, 0.0, 0.2), leaves=True),),
                          moving_until=1.8, ensemble=200,
                          outcome=outcome(Asked(relation="touches", target="pink vase"), 0.03, "pink vase")),
         "The red mug slides to the left, misses the pink vase and leaves the image.",
         "No, it misses the pink vase. 194 of 200 simulated versions agree."),
        ("red mug", world(bodies=(body("red mug"),), ensemble=200,
                          outcome=outcome(Asked(relation="touches", target="vase", negated=True), 0.97, "vase")),
         "The red mug slides to the right and misses the vase.",
         "Yes, it misses the vase. 194 of 200 simulated versions agree."),
        ("toy car", world(bodies=(body("toy car"), body("vase")), encounters=(occlusion("occludes", 0.45),),
                          ensemble=100, outcome=outcome(Asked(relation="covers", target="vase"), 0.9, "vase")),
         "The toy car slides to the right and passes in front of the vase (hiding 45% of it) from about 0.8 s "
         "on.",
         "Yes, it hides the vase. 90 of 100 simulated versions agree."),
        ("ball", world(bodies=(body("ball", "sphere"), body("vase")), encounters=(occlusion("occluded-by", 0.1),),
                       ensemble=100, outcome=outcome(Asked(relation="covered", target="vase"), 0.02, "vase")),
         "The ball rolls to the right and passes behind the vase (which hides 10% of it) from about 0.8 s on.",
         "No, it is not hidden by the vase. 98 of 100 simulated versions agree."),
        ("ball", THROWN.model_copy(update={"outcome": outcome(HIT.model_copy(update={"within": 2.0}), 0.9, time=1.1)}),
         "The ball bounces once, rolls on and hits the white cube after about 1.1 s.",
         "Yes, it hits the white cube after about 1.1 s. 90 of 100 simulated versions agree."),
        ("ball", world(bodies=(body("ball", "sphere"), body("vase")), ensemble=100, outcome=outcome(
                           Asked(relation="covered", target="vase", partly=True, within=2.0), 0.9, "vase", time=1.1)),
         "The ball rolls to the right and is partly hidden by the vase.",
         "Yes, it is partly hidden by the vase within 2.0 s. 90 of 100 simulated versions agree."),
        ("ball", world(encounters=(occlusion("occluded-by", 0.6),)),
         "The ball rolls to the right, passes behind the vase (which hides 60% of it) from about 0.8 s on and "
         "hits nothing.",
         ""),
        ("ball", world(ensemble=100, outcome=outcome(Asked(relation="covers"), 0.05, None)),
         "The ball rolls to the right and hides nothing.",
         "No, it hides nothing. 95 of 100 simulated versions agree."),
        ("ball", world(bodies=(BALL, CUBE), encounters=(touch(),), ensemble=100,
                       outcome=outcome(Asked(relation="touches", among=("mug", "vase")), 0.02, None)),
         "The ball rolls to the right, hits the white cube after about 1.1 s and misses the mug and the vase.",
         "No, it misses the mug and the vase. 98 of 100 simulated versions agree."),
        ("ball", world(bodies=(BALL, CUBE), paths=(path(), path(1)), encounters=(touch(probability=None),)),
         "The ball rolls to the right and hits and pushes the white cube after about 1.1 s.",
         ""),
        ("ball", world(bodies=(BALL, CUBE), paths=(path(), path(1, turned=90.0)), encounters=(touch(),),
                       moving_until=1.4),
         "The ball rolls to the right, hits and knocks over the white cube after about 1.1 s and comes to rest"
         " after about 1.4 s.",
         ""),
        ("ball", world(paths=(path(to=(0.0, 0.0, 0.0)),)), "The ball stays where it is and hits nothing.",
         ""),
        ("ball", world(bodies=(body("ball", "sphere", "air"),), paths=(path(to=(0.0, 1.0, 0.0)),)),
         "The ball falls and hits nothing.",
         ""),
        ("ball", world(bodies=(BALL, CUBE, body("mug")), encounters=(touch(), touch("mug", 2, 15)), ensemble=100,
                       outcome=outcome(Asked(form="how-many", relation="touches"), 0.8, None, count=2)),
         "The ball rolls to the right, hits the white cube after about 1.1 s and hits the mug after about 1.5 "
         "s.",
         "2 objects. 80 of 100 simulated versions agree."),
        ("ball", world(bodies=(ROLLS, body("table")), contacts=(STANDS,), ensemble=100,
                       outcome=outcome(COUNTED, 0.9, None, count=0)),
         "The ball rolls to the right and hits nothing but the table.",
         "It hits nothing. 90 of 100 simulated versions agree."),
        ("ball", world(bodies=(ROLLS, body("table")), contacts=(STANDS, FALLS), ensemble=100,
                       outcome=outcome(FALL, 0.9, None)),
         "The ball rolls to the right, falls off the table onto the floor after about 0.8 s and hits nothing "
         "else.",
         "Yes, it falls off the table onto the floor. 90 of 100 simulated versions agree."),
        ("ball", world(bodies=(ROLLS, body("table"), CUBE), encounters=(touch(number=2),), contacts=(STANDS,),
                       ensemble=100, outcome=outcome(FALL.model_copy(update={"negated": True}), 0.8, None)),
         "The ball rolls to the right, hits the white cube after about 1.1 s and does not fall off the table.",
         "Yes, it does not fall off the table. 80 of 100 simulated versions agree."),
        ("ball", world(bodies=(ROLLS, body("table")), contacts=(STANDS,),
                       outcome=outcome(Asked(relation="touches", target="table"), 0.0, "table")),
         "The ball rolls to the right and is on the table from the start.",
         "No, it is on the table from the start."),
        ("ball", world(bodies=(body("ball", "sphere", "air"),), contacts=(FALLS,), outcome=outcome(FALL, 1.0, None)),
         "The ball flies to the right, lands on the floor after about 0.8 s and hits nothing else.",
         "Yes, it lands on the floor."),
        ("ball", world(paths=(path(leaves=True),), moving_until=1.8, ensemble=100, outcome=outcome(LEAVES, 0.7, None)),
         "The ball rolls to the right, leaves the image after about 1.6 s and hits nothing.",
         "Yes, it leaves the image. 70 of 100 simulated versions agree."),
        ("ball", world(ensemble=100, outcome=outcome(LEAVES, 0.1, None)),
         "The ball rolls to the right, does not leave the image and hits nothing.",
         "No, it does not leave the image. 90 of 100 simulated versions agree."),
        ("ball", world(ensemble=100, outcome=outcome(Asked(form="when", relation="touches", target="mug"), 0.1, "mug")),
         "The ball rolls to the right and misses the mug.",
         "It misses the mug. 90 of 100 simulated versions agree."),
    ],
)  # fmt: skip
def test_what_happens(mover: str, told: Trajectory, story: str, summary: str) -> None:
    narration = narrate(grounded(mover), told, "en")
    assert narration.story == story
    assert narration.summary.removeprefix(story).strip() == summary


@pytest.mark.parametrize(
    ("relation", "part"), [("covered", "is partly hidden by the vase"), ("covers", "hides a part of the vase")]
)
def test_less_than_an_encounter_is_a_part(relation: Any, part: str) -> None:
    asked = outcome(Asked(relation=relation, target="vase", partly=True), 0.9, "vase")
    told = world(bodies=(BALL, body("vase")), ensemble=100, outcome=asked)
    narration = narrate(grounded("ball"), told, "en")
    assert narration.story == f"The ball rolls to the right and {part}."
    assert narration.summary == f"Yes, it {part}. 90 of 100 simulated versions agree."


def test_no_half_of_a_version_makes_all_of_them_agree() -> None:
    """One that was misread counts half."""
    told = world(bodies=(BALL, CUBE), ensemble=50, outcome=outcome(HIT, 0.99))
    assert narrate(grounded("ball"), told, "en").agreement == "49 of 50 simulated versions agree."


def test_the_story_stays_short() -> None:
    name = "the very long name of a thing that nobody would ever want to read again in full. " * 5
    told = world(bodies=(body(name), body(name)), encounters=tuple(touch(name, 1, frame) for frame in range(9)))
    assert len(narrate(grounded(name), told, "en").story) <= 300
