"""A reading that is sent back as a request gives the same trajectory, whoever read."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import mllm_server as say
import pytest
from conftest import EXAMPLES
from drawn import angle_between, ball, block, bowl, floor, png_bytes
from mllm_server import MllmServer, completion
from refusals import refused

from cow_service.records import Simulation
from cow_service.requests import SimulateRequest
from cow_service.service import Service
from cow_service.settings import Settings

RED, BLUE, GREEN = (200, 30, 30), (40, 60, 200), (40, 160, 60)
SHORT = {"video": False, "frames": {"count": 1}}
PICTURE = ball(
    block(block(floor(), (400, 190, 460, 280), BLUE), (250, 140, 290, 200), GREEN), (150, 250), 25, RED
)  # fmt: skip
BOWL = ball(bowl(floor(), (420, 240), 70, 50, BLUE), (150, 250), 20, RED)
DRAWN = {
    "words": (PICTURE, "If the red ball rolls to the right, will it hit the blue block?"),
    "a number": (PICTURE, "If the red ball rolls to the right at 2 m/s for 0.5 seconds, will it hit the blue block?"),
    "towards": (PICTURE, "If the red ball rolls towards the green block, will it touch the blue block?"),
    "removal": (PICTURE, "With the green block gone, does the red ball hit the blue block if it moves right?"),
    "placement": (BOWL, "Will the red ball fit into the blue bowl?"),
    "two": (PICTURE, "If the red ball moves right and the blue block slides left, will they collide?"),
}


def sent_back(service: Service, body: dict[str, Any]) -> tuple[Simulation, Simulation]:
    """What a request comes to, and what it comes to with its own reading."""
    first = service.simulate(SimulateRequest.model_validate(body))
    assert first.reading is not None
    said = json.loads(first.reading.model_dump_json(exclude_defaults=True))
    return first, service.simulate(SimulateRequest.model_validate(body | said))


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    with Service(Settings(data_dir=tmp_path_factory.mktemp("data"))) as one:
        yield one


@pytest.mark.parametrize("case", DRAWN)
def test_what_the_words_say_comes_back(service: Service, case: str) -> None:
    pixels, question = DRAWN[case]
    image = {"artifact": service.keep_image(png_bytes(pixels)).sha256}
    first, again = sent_back(service, {"image": image, "question": question, **SHORT})
    assert again.trajectory == first.trajectory
    assert (first.reader.stages, again.reader.stages) == (first.reader.stages, ()), "nobody is asked again"


@pytest.mark.parametrize(
    "folder", sorted(path.parent for path in EXAMPLES.glob("*/meta.json")), ids=lambda path: path.name
)
def test_what_is_read_of_a_picture_comes_back(service: Service, folder: Path) -> None:
    image = {"artifact": service.keep_image((folder / "image.jpg").read_bytes()).sha256}
    question = json.loads((folder / "meta.json").read_text())["question"]
    first, again = sent_back(service, {"image": image, "question": question, **SHORT})
    assert again.trajectory == first.trajectory


def replies(mllm: MllmServer, truth: dict[str, Any]) -> None:
    """The server says where things are, some 5% of a side off, and which way they move, 15 degrees off."""
    wide, high = truth["image_size"]

    def written(box: list[float]) -> list[int]:
        x0, y0, x1, y1 = box
        off = 0.05 * (x1 - x0)
        return [round(1000 * value) for value in ((x0 + off) / wide, y0 / high, (x1 + off) / wide, y1 / high)]

    def reply(handler: Any) -> None:
        text, (dx, dy) = mllm.text(-1), truth.get("direction") or (0, 1)
        said: dict[str, Any] = {"reasoning": ""}
        if "metres" in text:
            said |= {"metres": 0.2, "down": "bottom"}
        elif "bbox_2d" in text:
            said["objects"] = [{"bbox_2d": written(boxes[0]), "label": name} for name, boxes in truth["boxes"].items()]
            x, y = 500, 500
            said |= {"start": [x, y], "end": [round(x + 300 * (dx - 0.26 * dy)), round(y + 300 * (dy + 0.26 * dx))]}
            said["sense"] = None
        else:
            kind = {"slide": "linear"}.get(truth["motion"], truth["motion"])
            others = [name for name in truth["boxes"] if name != truth["object"]]
            said |= {"object": truth["object"], "others": others, "asked": None, "kind": kind}
        handler.send(200, completion(json.dumps(said)))

    mllm.say(reply)


@pytest.mark.parametrize("name", ["ball-and-mug", "thrown-ball", "falling-ball"])
def test_what_a_multimodal_llm_reads_comes_back(name: str, tmp_path: Path) -> None:
    """The reader `local` is of the same class."""
    truth = json.loads((EXAMPLES / name / "meta.json").read_text())
    with say.mllm_server() as mllm:
        replies(mllm, truth)
        settings = Settings(data_dir=tmp_path, mllm="qwen3-vl-8b", mllm_base_url=mllm.address, reader="mllm")
        with Service(settings) as service:
            image = {"artifact": service.keep_image((EXAMPLES / name / "image.jpg").read_bytes()).sha256}
            first, again = sent_back(service, {"image": image, "question": truth["question"], **SHORT})
    assert first.grounding.source == "mllm"
    assert first.usage.calls > 0
    assert again.trajectory == first.trajectory
    assert again.usage.calls == 0


@pytest.mark.parametrize(
    ("field", "doubt"),
    [("question_is_doubtful", True), ("grounding", {"is_doubtful": True}), ("motion", {"other_direction": [0, 1]})],
)
def test_a_doubt_that_is_sent_back_is_told(service: Service, field: str, doubt: Any) -> None:
    """The answer is not sure, and the warnings say why."""
    pixels, question = DRAWN["words"]
    body = {"image": {"artifact": service.keep_image(png_bytes(pixels)).sha256}, "question": question, **SHORT}
    first, _ = sent_back(service, body)
    assert first.reading is not None
    said = json.loads(first.reading.model_dump_json(exclude_defaults=True))
    said[field] = said[field] | doubt if isinstance(doubt, dict) else doubt
    again = service.simulate(SimulateRequest.model_validate(body | said))
    assert again.trajectory.outcome is not None
    assert not again.trajectory.outcome.sure
    assert len([warning for warning in again.warnings if "no answer is sure" in warning]) == 1


def way_of(service: Service, name: str, motion: dict[str, Any], **given: Any) -> tuple[float, float]:
    """The direction in which what moves in an example sets out, by what a request says of it."""
    folder = EXAMPLES / name
    truth = json.loads((folder / "meta.json").read_text())
    image = {"artifact": service.keep_image((folder / "image.jpg").read_bytes()).sha256}
    place = {"object": truth["object"], "bbox": truth["boxes"][truth["object"]][0]}
    body = {"image": image, "question": "What happens?", "grounding": place, "motion": motion, **SHORT, **given}
    found = service.simulate(SimulateRequest.model_validate(body)).motion.direction
    assert found is not None
    return found


@pytest.mark.parametrize(
    ("name", "motion", "is_asked"),
    [("ball-and-mug", {"along_arrow": True}, False), ("car-forward", {"forward": True}, True)],
)
def test_a_request_may_say_which_way_by_what_the_picture_shows(
    service: Service, name: str, motion: dict[str, Any], is_asked: bool
) -> None:
    """The question of one asks for the opposite of its arrow."""
    told = {"objects_complete": True}
    found, back = way_of(service, name, motion, **told), way_of(service, name, {next(iter(motion)): False}, **told)
    assert angle_between(found, (-back[0], -back[1])) < 1
    given = json.loads((EXAMPLES / name / "meta.json").read_text())
    assert angle_between(found if is_asked else back, given["direction"]) < 25


def test_an_arrow_or_a_goal_that_cannot_be_seen_is_refused(service: Service) -> None:
    for motion in ({"along_arrow": True}, {"towards": "teapot"}, {"forward": True}):
        with refused("cannot-read-direction"):
            way_of(service, "falling-ball", motion)
