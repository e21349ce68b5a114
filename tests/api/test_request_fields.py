"""Every field of a request changes something: two requests that differ in it alone have different results."""

from __future__ import annotations

import json
import re
import types
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Union, get_args, get_origin

import numpy as np
import pytest
from conftest import ROOT
from drawn import Image, ball, block, floor, png_bytes
from floors import TrueCamera, depth_png
from pydantic import BaseModel
from servers import data_url
from tables import rows

from cow_service.records import Answer, Estimate, ObjectPrior, PlaceRequest, Simulation
from cow_service.requests import AnswerRequest, SimulateRequest
from cow_service.requests.flat import FLAT, REQUESTS, flat_fields
from cow_service.service import Service
from cow_service.settings import Settings

pytestmark = pytest.mark.slow
RED, BLUE, GREEN = (200, 30, 30), (40, 60, 200), (40, 160, 60)
BALL, BLOCK, POST = (40, 105, 66, 131), (150, 95, 185, 131), (220, 75, 240, 115)
PICTURE = ball(block(block(floor(320, 200), POST, GREEN), BLOCK, BLUE), (53, 118), 13, RED)


def sent(image: Image) -> str:
    return data_url(png_bytes(image))


def mask_of(bbox: tuple[int, int, int, int]) -> str:
    x0, y0, x1, y1 = bbox
    mask = np.zeros((200, 320, 3), np.uint8)
    mask[y0:y1, x0:x1] = 255
    return sent(mask)


BASE: dict[str, Any] = {
    "image": sent(PICTURE), "question": "If the red ball rolls to the right, will it hit the blue block?",
    "num_frames": 9, "ensemble": 2, "frames": {"count": 1}, "video": False,
}  # fmt: skip
CAMERA = TrueCamera(focal=320, size=(320, 200))
DEPTH = {"map": data_url(depth_png(CAMERA.depth([BALL, BLOCK, POST]))), "scale": 0.001, "focal": 320}
FARTHER = data_url(depth_png(CAMERA.depth([BALL, (150, 95, 185, 115), POST])))
MOVES = {"kind": "linear", "direction": [1, 0], "speed": 200}
BLOCKS = {"object": "blue block", "bbox": BLOCK}
PATH = {"points": [[53, 118], [103, 118], [153, 118]], "fps": 2}
TWO = [PATH["points"], PATH["points"]]
PUT = {"kind": "place", "object": "green post", "relation": "next-to", "targets": ["blue block"]}
TO = {"grounding": {"object": "red ball", "bbox": BALL}, "objects": [BLOCKS, {"object": "green post", "bbox": POST}]}
STEPS = [{"direction": [0, 1], "distance": 30}, {"direction": [1, 0]}]
OTHER = {"object": "blue block", "direction": [0, 1]}
GOES = {"object": "blue block"}  # towards something
ASKED = {"relation": "touches", "target": "blue block"}
# Fields, other fields that they need, and two values of each.
CHANGES: dict[str, tuple[dict[str, Any], Any, Any]] = {
    "image": ({}, BASE["image"], sent(block(PICTURE, (100, 100, 120, 131), GREEN))),
    "question": ({}, BASE["question"], "If the red ball rolls to the left, will it hit the blue block?"),
    "options": ({}, ["Yes", "No"], ["No", "Yes", "Not sure"]),
    "grounding.bbox": ({}, BALL, BLOCK),
    "grounding.point": ({}, [53, 118], [167, 115]),
    "grounding.mask": ({}, mask_of(BALL), mask_of(BLOCK)),
    "grounding.shape": ({"grounding": {"bbox": BALL}}, "sphere", "box"),
    "grounding.size": ({"grounding": {"bbox": BALL}}, 0.02, 30),
    "grounding.stands_on": ({"grounding": {"bbox": BALL}}, "floor", "air"),
    "grounding.object": ({"grounding": {"bbox": BALL}}, "red ball", "marble"),
    "grounding.bbox_deviation": ({"grounding": {"bbox": BALL}}, None, 0.4),
    "grounding.source": ({"grounding": {"bbox": BALL}}, "request", "mllm"),
    "grounding.is_doubtful": ({"grounding": {"bbox": BALL}}, False, True),
    "motion.kind": ({"motion": {"direction": [1, 0]}}, "linear", "projectile"),
    "motion.law": ({"motion": MOVES}, "contact", "ballistic"),
    "motion.direction": ({}, [1, 0], [0, 1]),
    "motion.depth": ({"motion": MOVES}, 0, 0.5),
    "motion.direction_deviation": ({"motion": MOVES}, None, 40),
    "motion.other_direction": ({"motion": MOVES}, None, [0, 1]),
    "motion.towards": (TO, "blue block", "green post"),
    "motion.cue": ({"motion": MOVES}, None, "orientation"),
    "motion.down": ({"motion": {"kind": "fall"}}, [0, 1], [1, 0]),
    "motion.rises": ({"motion": MOVES | {"direction": [0, -1]}}, False, True),
    "motion.speed": ({"motion": MOVES}, 50, 200),
    "motion.distance": ({"motion": MOVES}, 20, 60),
    "motion.duration": ({"motion": MOVES}, 0.1, 0.4),
    "motion.until": ({"motion": MOVES}, None, "contact"),
    "motion.steps.direction": ({"motion": MOVES | {"duration": 0.2, "steps": STEPS}}, [0, 1], [-1, 0]),
    "motion.steps.depth": ({"motion": MOVES | {"duration": 0.2, "steps": STEPS}}, 0, 0.5),
    "motion.steps.distance": ({"motion": MOVES | {"duration": 0.2, "steps": STEPS}}, 30, 60),
    "motion.steps.duration": ({"motion": MOVES | {"duration": 0.2, "steps": STEPS}}, 0.01, 0.05),
    "motion.others.object": (TO | {"motion": MOVES | {"others": [OTHER]}}, "blue block", "green post"),
    "motion.others.kind": (TO | {"motion": MOVES | {"others": [OTHER]}}, "linear", "projectile"),
    "motion.others.direction": (TO | {"motion": MOVES | {"others": [OTHER]}}, [0, 1], [1, 0]),
    "motion.others.depth": (TO | {"motion": MOVES | {"others": [OTHER]}}, 0, 0.5),
    "motion.others.direction_deviation": (TO | {"motion": MOVES | {"others": [OTHER]}}, None, 40),
    "motion.others.towards": (TO | {"motion": MOVES | {"others": [GOES]}}, "green post", "red ball"),
    "motion.others.speed_deviation": (TO | {"motion": MOVES | {"others": [OTHER]}}, None, 0.5),
    "motion.others.speed": (TO | {"motion": MOVES | {"others": [OTHER]}}, 100, 300),
    "motion.metres_per_pixel": ({"motion": MOVES}, 0.001, 0.01),
    "motion.depth_deviation": ({"motion": MOVES | {"kind": "projectile"}}, 0, 20),
    "motion.speed_deviation": ({"motion": MOVES}, 0, 0.5),
    "trajectory.points": ({}, PATH["points"], [[53, 118], [103, 68], [153, 118]]),
    "trajectory.fps": ({"trajectory": PATH}, 2, 8),
    "trajectory.visible": ({"trajectory": PATH}, [True] * 3, [False] * 3),
    "trajectory.scale": ({"trajectory": PATH}, [1, 1, 1], [1, 0.5, 0.25]),
    "trajectory.tracks": ({"trajectory": PATH}, None, TWO),
    "trajectory.tracks_visible": ({"trajectory": PATH | {"tracks": TWO}}, None, [[True] * 3, [False] * 3]),
    "trajectory.anchors": ({"trajectory": PATH}, None, [[10, 10]]),
    "objects_complete": ({"objects": [BLOCKS]}, False, True),
    "objects.bbox": ({"objects": [BLOCKS]}, BLOCK, (150, 75, 185, 111)),
    "objects.point": ({"objects": [{"object": "blue block"}]}, [167, 115], [230, 95]),
    "objects.mask": ({"objects": [{"object": "blue block"}]}, mask_of(BLOCK), mask_of(POST)),
    "objects.bbox_deviation": ({"objects": [BLOCKS]}, None, 0.4),
    "objects.source": ({"objects": [BLOCKS]}, "request", "mllm"),
    "objects.is_doubtful": ({"objects": [BLOCKS]}, False, True),
    "objects.shape": ({"objects": [BLOCKS]}, "sphere", "cone"),
    "objects.size": ({"objects": [BLOCKS]}, 0.02, 30),
    "objects.stands_on": ({"objects": [BLOCKS]}, "floor", "air"),
    "objects.object": ({"objects": [BLOCKS]}, "blue block", "crate"),
    "objects.role": ({"objects": [BLOCKS]}, "target", "obstacle"),
    "interventions.kind": (TO | {"interventions": [{"kind": "remove", "object": "green post"}]}, "remove", None),
    "interventions.object": (
        TO | {"interventions": [{"kind": "remove", "object": "green post"}]}, "green post", "blue block",
    ),
    "interventions.relation": (TO | {"interventions": [PUT]}, "left-of", "behind"),
    "interventions.targets": (TO | {"interventions": [PUT]}, ["blue block"], ["red ball"]),
    "question_is_doubtful": ({}, False, True),
    "asked.form": ({"asked": ASKED}, "whether", "when"),
    "asked.relation": ({"asked": ASKED}, "touches", "covers"),
    "asked.subject": ({"asked": ASKED | {"target": "red ball"}}, None, "blue block"),
    "asked.target": ({"asked": ASKED}, "blue block", None),
    "asked.negated": ({"asked": ASKED}, False, True),
    "asked.among": (TO | {"asked": {"relation": "touches"}}, ["blue block"], ["green post"]),
    "asked.every": (TO | {"asked": {"relation": "touches", "among": ["blue block", "green post"]}}, False, True),
    "asked.partly": ({"asked": ASKED | {"relation": "covers"}}, False, True),
    "asked.within": ({"asked": ASKED, "motion": MOVES}, None, 0.01),
    "camera.focal": ({}, 200, 450),
    "camera.pitch": ({}, 10, 40),
    "camera.roll": ({"camera": {"pitch": 20}}, 0, 10),
    "depth.map": ({"depth": DEPTH}, DEPTH["map"], FARTHER),
    "depth.scale": ({"depth": DEPTH}, 0.001, 0.01),
    "depth.focal": ({"depth": DEPTH}, 320, 400),
    "depth.deviation": ({"depth": DEPTH}, 0.01, 0.1),
    "ensemble": ({}, 0, 2),
    "num_frames": ({}, 9, 12),
    "fps": ({}, 16, 24),
    "language": ({}, "en", "ja"),
    "seed": ({}, 0, 1),
    "video": ({}, False, True),
    "live": ({}, False, True),
    "frames.policy": ({"frames": {"count": 3}}, "initial", "uniform"),
    "frames.count": ({}, 1, 2),
    "frames.indices": ({}, [1], [2]),
    "frames.max_side": ({}, 64, 128),
    "frames.factual": (TO | {"interventions": [{"kind": "remove", "object": "green post"}]}, False, True),
    "imagine": ({}, "always", "never"),
    "imagine_threshold": ({"imagine": "auto"}, 0.5, 1.0),
    "baseline": ({}, False, True),
    "votes": ({}, 1, 3),
}  # fmt: skip
# One of each kind of field; the others are of the same kind as one of these.
CORE = {
    *("image", "question", "options", "language", "seed", "num_frames", "video", "ensemble", "imagine", "baseline"),
    *("votes", "grounding.mask", "grounding.size", "motion.kind", "motion.law", "motion.speed", "motion.until"),
    *("motion.steps.distance", "motion.others.speed", "motion.speed_deviation", "trajectory.points"),
    *("trajectory.scale", "objects.bbox", "objects.role", "interventions.relation", "asked.relation", "asked.among"),
    *("camera.focal", "depth.scale", "frames.indices", "frames.factual"),
}
# Tested where there is what they choose from: readers, generators, a queue, a receiver, votes, an arrow, a vehicle.
ELSEWHERE = {
    *("reader", "generator", "generator_options", "priority", "webhook", "imagine_votes"),
    *("motion.along_arrow", "motion.forward"),
}
WHOLE = {"image", "options", "speed", "distance"}  # of several forms
# What differs from run to run, and what only repeats the request.
VOLATILE = {"id", "created_at", "reading", "timings", "usage", "usage_total", "reused", "url", "prior", "note"}


def leaves(model: type[BaseModel], at: str = "") -> Iterator[str]:
    """The fields of a request by their paths, without those that are made of further fields."""
    for name, field in model.model_fields.items():
        inner = None if name in WHOLE else model_in(field.annotation)
        if inner is None:
            yield at + name
        else:
            yield from leaves(inner, f"{at}{name}.")


def model_in(annotation: Any) -> type[BaseModel] | None:
    """The model that a field holds, alone or several of it."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return None if annotation.__module__.endswith(".values") else annotation
    parts = get_args(annotation) if get_origin(annotation) in (Union, types.UnionType, tuple) else ()
    return next((found for part in parts if (found := model_in(part)) is not None), None)


def with_field(given: dict[str, Any], path: str, value: Any) -> dict[str, Any]:
    """A request with one field set, in the first of several things."""
    name, _, rest = path.partition(".")
    if not rest:
        return {key: part for key, part in given.items() if key != name} | ({} if value is None else {name: value})
    inner = given.get(name, {})
    if isinstance(inner, list):
        first = with_field(inner[0], rest, value)
        return given | {name: [first, *inner[1:]] if "kind" in first or rest != "kind" else inner[1:]}
    return given | {name: with_field(inner, rest, value)}


def told(value: Any) -> Any:
    """A result without what differs between two runs of the same."""
    if isinstance(value, dict):
        return {key: told(part) for key, part in value.items() if key not in VOLATILE}
    return [told(part) for part in value] if isinstance(value, list | tuple) else value


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    folder: Path = tmp_path_factory.mktemp("fields")
    with Service(Settings(data_dir=folder, reader="embedded")) as service:
        yield service


def test_every_field_of_a_request_is_tried() -> None:
    assert set(leaves(AnswerRequest)) == CHANGES.keys() | ELSEWHERE
    assert set(leaves(SimulateRequest)) < set(leaves(AnswerRequest))


def test_what_a_request_says_of_an_object_is_exact() -> None:
    assert PlaceRequest(bbox=BALL).prior is None
    told = PlaceRequest(bbox=BALL, size=0.2, stands_on="air").prior
    assert told == ObjectPrior(shape=None, size=Estimate(value=0.2, deviation=0), stands_on="air")


@pytest.mark.parametrize("path", rows(core={path: path for path in sorted(CORE)}, rest=sorted(CHANGES.keys() - CORE)))
def test_a_field_changes_something(path: str, results: Service) -> None:
    beside, *values = CHANGES[path]
    found: list[Simulation | Answer] = []
    for value in values:
        found.append(results.answer(AnswerRequest.model_validate(with_field(BASE | beside, path, value))))
    one, other = (told(each.model_dump(mode="json")) for each in found)
    assert one != other


def test_the_tables_of_the_docs_say_what_the_fields_are() -> None:
    """Defaults as they are, and examples that a server takes."""
    ask, correct = ((ROOT / "docs" / name).read_text() for name in ("ask.md", "correct.md"))
    table = ask.partition("| field | default | effect |")[2].partition("\n\n")[0]
    told = re.findall(r"^\| `(\w+)` \| `?([^|`]+)`? \|", table, re.MULTILINE)
    told += re.findall(r"`(\w+)`(?: times)? \(([\d.]+)\)", ask)
    assert len(told) >= 8
    for name, default in told:
        known = AnswerRequest.model_fields[name].default
        assert known is None or str(known).lower() == default.strip(), name
    rows = re.findall(r"^\| [^|]+ \| `(\w+)`[^|]* \| ([^|]+) \|", correct, re.MULTILINE)
    written = [
        (name, text) for name, row in rows for text in re.findall(r"`([{\[].*?[}\]])`", row) if "..." not in text
    ]
    examples = [(name, json.loads(text)) for name, text in written]
    assert {name for name, _ in examples} > {"grounding", "objects", "motion", "interventions", "asked"}
    for name, example in examples:
        SimulateRequest.model_validate(BASE | {name: example})


def test_flat_names_are_of_fields_and_no_two_are_alike() -> None:
    flat = [field for fields in FLAT.values() for field in fields]
    for names in ([field.option for field in flat], [field.argument for field in flat]):
        assert len({name for name in names if name}) == len([name for name in names if name])
    assert {field.path for field in flat} == {field.path for kind in REQUESTS for field in flat_fields(kind)}
