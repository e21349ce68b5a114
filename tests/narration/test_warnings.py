"""What a caller should know of a trajectory beside what it says: when a warning is given, and in which words."""

from __future__ import annotations

from typing import Any

import pytest
from told import BODIES, BOX, body, grounded, touch, unsure, world

from cow_service.narration.warnings import cannot_stay, warnings_of
from cow_service.records import CameraEstimate, DepthEstimate, Footprint, PlacedBefore, Trajectory
from cow_service.requests import SimulateRequest

SEEN = {"focal": 600, "pitch": 20, "height": 1.2, "deviations": {"focal": 1, "pitch": 1, "roll": 1, "height": 0.1}}
MEASURED: dict[str, Any] = {
    "camera": CameraEstimate.model_validate(SEEN | {"source": "depth"}),
    "depth": DepthEstimate(source="request", scale=1, focal=600, valid=1, deviation=0.1, floor=0.5, mover=1),
}
MAP = {"depth": {"map": "data:image/png;base64,AAAA"}}
BEGINS = {"grounding": {"bbox": BOX}}


def begins(x: float, lasts: float = 2.0) -> dict[str, Any]:
    """A path that begins beside the middle of the object, at (5, 5), and lasts as long as the clip."""
    return {"trajectory": {"points": [(5 + x, 5), (40, 5)], "fps": 1 / lasts}}


def before(name: str = "post", **values: Any) -> PlacedBefore:
    given: dict[str, Any] = {"body": 1, "place": "on the cube", "visible": 1, "result": "on-top"} | values
    return PlacedBefore(object=name, **given)


def measured(**depth: Any) -> dict[str, Any]:
    return MEASURED | {"depth": MEASURED["depth"].model_copy(update=depth)}


OUTLINE = unsure("touches", "vase", depends_on=("outline",))
UNSEEN = Footprint(centre=(0, 3), half_width=0.1, half_depth=0.1, yaw=0, height=0.1, seen=0)
CLEARER = "was not seen clearly: give its box in `objects` to get an answer that may rely on it."
NO_ANSWER = "so there is no answer from it. Leave `depth` out, or give another map."

# A request, what came of it, and the warnings.
CASES: dict[str, tuple[dict[str, Any], Trajectory, list[str]]] = {
    "nothing to remark": (begins(2.5) | BEGINS, world(), []),
    "surroundings not separated": ({}, world(encounters_known=False), [
        "The surroundings could not be separated into objects, so encounters were not computed: an empty list does "
        "not mean that nothing is hit."
    ]),
    "a path beside a motion, an object and a clip": (
        begins(2.6, lasts=2.16) | BEGINS | {"motion": {"kind": "fall"}}, world(), [
            "Both `motion` and `trajectory` were given: the object follows the trajectory; the motion only words it.",
            "The given trajectory starts 3 px from the object's centre; the first frame shows it there.",
            "The given trajectory lasts 2.16 s and the clip 2.00 s: the end of the path is not shown.",
    ]),
    "a path that ends a frame later": (begins(0, lasts=2.15), world(), []),
    "a path that ends sooner": (begins(9, lasts=1.84), world(), [
        "The given trajectory lasts 1.84 s and the clip 2.00 s: after the path ends, the object stays where it is."
    ]),
    "something faint": ({}, world(faint=((10.0, 20.0, 30.0, 50.0),)), [
        "Something else may stand at (20, 50); it is not simulated."
    ]),
    "outlines in doubt": ({}, world(OUTLINE, encounters=(touch(),), bodies=tuple(
        body(name, confidence=value) for name, value in (("ball", 0.76), ("cube", 0.5), ("vase", 0.77), ("mug", 0))
    )), [f"'ball' {CLEARER}", f"'cube' {CLEARER}"]),
    "outlines in doubt of one that is chosen from": (
        {},
        world(
            unsure("touches", None, form="which", among=("cube", "mug"), depends_on=("outline",)),
            bodies=(*BODIES[:2], body("mug", confidence=0.4), body("vase", confidence=0.4)),
        ),
        [f"'mug' {CLEARER}"],
    ),
    "outlines in doubt that nothing hangs on": (
        {}, world(unsure("touches", "vase", depends_on=("speed",)), bodies=(body("ball", confidence=0.5),)), []
    ),
    "what does not end as it is meant to": ({}, world(placed=(
        before("a", result="sticks-out", fits=0.2), before("b", result="on-the-rim"), before("c", fits=0.89),
        before("d", fits=0.9, visible=0.24), before("e", visible=0.25, by_heading=True),
    )), [
        "'a', put on the cube, goes in but sticks out.",
        "'b', put on the cube, does not go in: it stays on the rim.",
        "'c', put on the cube, ends up as intended in 89% of the simulated versions.",
        "'d', put on the cube, is hardly visible in the frames: something hides it, or it is outside the image.",
        "'e', put on the cube, was placed relative to the direction of motion, not as the camera sees it.",
    ]),
    "what makes room": ({}, world(placed=(before(),), factual=world(bodies=(
        BODIES[0], body("cube", bbox=(1.0,) * 4), body("mug", bbox=(1.0,) * 4), BODIES[3]
    ))), ["'mug' makes room for what is put there, so it does not start where the image shows it."]),
    "a depth map that shows it all": (MAP | {"camera": {"pitch": 23}}, world(**MEASURED), []),
    "a depth map without a camera": (MAP, world(**measured(floor=None) | {"camera": None}), []),
    "no depth map was given": ({}, world(camera=MEASURED["camera"]), []),
    "a depth map of the server without a floor": ({}, world(**measured(floor=None, source="model")), [
        "The depth map shows no floor for things to stand on, so there is no answer from it. Give a map as `depth`, or "
        "another picture."
    ]),
    "a depth map that was not used": (MAP, world(camera=MEASURED["camera"]), [
        "The depth map was not used: the path was given, or the law is `ballistic`."
    ]),
    "a depth map without a floor": (MAP, world(**measured(floor=None)), [
        f"The depth map shows no floor for things to stand on, {NO_ANSWER}"
    ]),
    "a depth map of a drawing": (
        MAP, world(**measured(floor=None) | {"camera": MEASURED["camera"].model_copy(update={"source": "side-view"})}),
        [f"The depth map was given for a drawing seen from the side, {NO_ANSWER}"],
    ),
    "a depth map of the server without the mover": (MAP, world(**measured(mover=0, source="model")), [
        "The depth map does not show 'ball' as something standing above the floor where the image shows it, so there "
        "is no answer from it. Give a map as `depth`, or another picture."
    ]),
    "a depth map without one thing and with another pitch": (MAP | {"camera": {"pitch": 23.1}}, world(bodies=(
        BODIES[0], body("mug", footprint=UNSEEN), body("vase", footprint=UNSEEN.model_copy(update={"seen": 1}))
    ), **MEASURED), [
        "The depth map does not show 'mug' as something standing above the floor where the image shows it.",
        "`camera.pitch` is 23.1 degrees, but the floor of the depth map says 20; the depth map is used.",
    ]),
}  # fmt: skip


@pytest.mark.parametrize("case", CASES)
def test_what_is_remarked_on(case: str) -> None:
    given, told, warnings = CASES[case]
    asked = {"image": "data:,", "question": "?", "num_frames": 21, "fps": 10} | given
    assert list(warnings_of(SimulateRequest.model_validate(asked), grounded(), told)) == warnings


def test_why_something_cannot_be_put_somewhere() -> None:
    assert cannot_stay(before(result="overlaps")) == "'post' cannot be put on the cube: there is no room for it."
    shares: dict[Any, float] = {"falls-off": 0.3, "on-top": 0.4, "tips": 0.2}
    tips = cannot_stay(before(result="tips", probabilities=shares))
    assert tips == (
        "'post' cannot be put on the cube: it tips over, or knocks something over (20% of the computed worlds)."
    )
    mostly = cannot_stay(before(result="on-top", probabilities=shares))
    assert mostly == "'post' cannot be put on the cube: it falls off (30% of the computed worlds)."
