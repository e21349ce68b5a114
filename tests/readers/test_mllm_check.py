"""`cow models check`: what it finds of stand-ins that are off in known ways, and that readers then go by it."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import mllm_server as say
import pytest
from command_line import cow_from_nothing
from mllm_server import MllmServer
from waiting import TIME_LIMIT

from cow_service.errors import MllmUnavailable
from cow_service.media.images import decode
from cow_service.perception.observation import look
from cow_service.readers.base import ReaderInput
from cow_service.records import MllmMeasurement
from cow_service.settings import Settings

if TYPE_CHECKING:
    from cow_service.readers.mllm.check import MllmCheck
    from cow_service.readers.mllm.reader import MllmReader

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
TRUE: dict[str, dict[str, Any]] = {
    name: json.loads((EXAMPLES / name / "meta.json").read_text())
    for name in ("ball-and-mug", "bottle-passes-cylinder", "thrown-ball")
}


def model(
    units: str = "thousandths", axes: str = "xy", size: bool = False, turned: float = 0.0, off: float = 0.0
) -> say.Reply:
    """One that sees everything, but writes places in its own way, and is off by degrees and shares of a side."""

    def reply(handler: Any) -> None:
        text = say.text_of(handler.body)
        if "Which of them shows a red bottle" in text:
            said: dict[str, Any] = {"answer": "C"}
        elif "Find out which one object" in text:
            said = {"object": "yellow ball", "others": ["blue mug"], "asked": None}
        else:
            said = placed(next(each for each in TRUE.values() if f"> {each['object']}" in text))
        handler.send(200, say.completion(json.dumps(said)))

    def placed(true: dict[str, Any]) -> dict[str, Any]:
        wide, high = true["image_size"]
        full = {"thousandths": (1000, 1000), "fractions": (1, 1), "pixels": (wide, high)}[units]

        def written(x: float, y: float) -> list[float]:
            pair = [round(x / wide * full[0], 3), round(y / high * full[1], 3)]
            return pair if axes == "xy" else pair[::-1]

        def box(x0: float, y0: float, x1: float, y1: float) -> list[float]:
            wider, higher = off * (x1 - x0), off * (y1 - y0)
            x1, y1 = x1 + wider, y1 + higher
            return written(x0, y0) + written(*((x1 - x0, y1 - y0) if size else (x1, y1)))

        (x, y), angle = true["point"], math.radians(turned)
        right, down = true["direction"]
        right, down = (
            right * math.cos(angle) - down * math.sin(angle),
            right * math.sin(angle) + down * math.cos(angle),
        )
        return {
            "objects": [
                {"bbox_2d": box(*true["boxes"][name][0]), "label": name} for name in (true["object"], true["target"])
            ],
            "start": written(x, y),
            "end": written(x + 60 * right, y + 60 * down),
            "sense": "with" if true["arrow_style"]["along"] else "against",
        }

    return reply


@pytest.fixture(scope="module")
def mllm() -> Iterator[MllmServer]:
    with say.mllm_server() as server:
        yield server


def reader_of(mllm: MllmServer, data_dir: Path) -> MllmReader:
    from cow_service.readers.mllm.reader import create

    return create(
        Settings(
            mllm="qwen3-vl-8b",
            mllm_base_url=mllm.address,
            mllm_timeout=TIME_LIMIT,
            mllm_budget=5.0,
            data_dir=data_dir,
        )
    )


def checked(mllm: MllmServer, data_dir: Path, reply: say.Reply | str) -> MllmCheck:
    mllm.say(reply)
    reader = reader_of(mllm, data_dir)
    try:
        return reader.check()
    finally:
        reader.close()


def measured(check: MllmCheck) -> MllmMeasurement:
    assert check.measured is not None
    return check.measured


def usable(check: MllmCheck) -> dict[str, bool]:
    return {finding.question: finding.usable for finding in check.findings}


def test_a_model_that_sees_everything_is_good(mllm: MllmServer, tmp_path: Path) -> None:
    check = checked(mllm, tmp_path, model())
    assert usable(check) == dict.fromkeys(("box", "direction", "sense", "JSON", "images"), True)
    assert measured(check).coordinates is None
    # Of the measurements the usual one alone is off: a few pictures show no model to be exact.
    assert measured(check).bbox_deviation == pytest.approx(0.1 / math.sqrt(7), rel=0.05)
    assert measured(check).direction_deviation == pytest.approx(20 / math.sqrt(4), rel=0.05)
    assert check.usage.calls == 5


@pytest.mark.parametrize(
    ("written", "said"),
    [
        ({"units": "pixels"}, "pixels, x first, two corners"),
        ({"units": "fractions", "axes": "yx"}, "fractions, y first, two corners"),
        ({"size": True}, "thousandths, x first, a corner, width and height"),
    ],
)
def test_other_coordinates_are_noticed_and_kept(
    written: dict[str, Any], said: str, mllm: MllmServer, tmp_path: Path
) -> None:
    check = checked(mllm, tmp_path, model(**written))
    box = check.findings[0]
    assert f"6 of 6 found, read as {said};" in box.result
    assert not box.usable, "they are not those that were asked for"
    assert usable(check)["direction"], "read in the same way"
    first = reader_of(mllm, tmp_path)
    first.keep(measured(check))
    first.close()
    reader, true = reader_of(mllm, tmp_path), TRUE["ball-and-mug"]
    assert reader.fingerprint != first.fingerprint, "results of before are not reused"
    pixels = decode((EXAMPLES / "ball-and-mug" / "image.jpg").read_bytes()).pixels
    found = reader.read(ReaderInput(pixels, true["question"], look(pixels))).reading.grounding
    reader.close()
    again = checked(mllm, tmp_path, model(**written))
    assert usable(again)["box"], "they are asked for now"
    assert measured(again) == measured(check), "and stay"
    assert found is not None
    assert found.bbox == pytest.approx(true["bbox"], abs=2)
    assert found.bbox_deviation == measured(check).bbox_deviation


def test_errors_become_spreads(mllm: MllmServer, tmp_path: Path) -> None:
    check = checked(mllm, tmp_path, model(turned=30, off=0.2))
    assert usable(check)["direction"], "it is off, and its spread says so"
    assert measured(check).direction_deviation == pytest.approx(math.sqrt((20**2 + 3 * 30**2) / 4), rel=0.05)
    edges = math.sqrt(2 * 0.2**2 / 4)
    assert measured(check).bbox_deviation == pytest.approx(math.sqrt((0.1**2 + 6 * edges**2) / 7), rel=0.1)


def test_a_model_that_points_the_wrong_way_is_as_unsure_as_can_be(mllm: MllmServer, tmp_path: Path) -> None:
    check = checked(mllm, tmp_path, model(turned=180))
    assert not usable(check)["direction"]
    assert measured(check).direction_deviation == 90, "the most that the simulation takes"


def test_what_cannot_be_used_is_a_finding(mllm: MllmServer, tmp_path: Path) -> None:
    always = json.dumps(
        {"objects": [{"bbox_2d": [10, 20, 300, 400], "label": "thing"}], "start": [1, 2], "end": [90, 2]}
    )
    assert checked(mllm, tmp_path, always).measured is None, "whatever some coordinates would make of it"
    check = checked(mllm, tmp_path, "I would rather not.")
    assert not any(usable(check).values())
    assert check.measured is None
    assert "gave no usable reply" in check.findings[-1].result
    with pytest.raises(MllmUnavailable, match="refused the key"):
        checked(mllm, tmp_path / "other", say.status(401))
    assert len(mllm.asked) == 1, "nothing else can be found out"


def test_the_command_keeps_what_it_measured(mllm: MllmServer, tmp_path: Path) -> None:
    mllm.say(model(turned=10))
    settings = {"COW_MLLM": "qwen3-vl-8b", "COW_MLLM_BASE_URL": mllm.address}
    shown = cow_from_nothing(tmp_path, "models", "check", "--save", **settings)
    assert shown.returncode == 0, shown.stdout + shown.stderr
    assert "Its server takes json_schema, max_tokens." in shown.stdout
    assert "Kept: boxes count as exact to 4% of a side" in shown.stdout
    told = json.loads(cow_from_nothing(tmp_path, "doctor", "--json", **settings).stdout)["mllm"]
    assert told["measured"]["direction_deviation"] < 20
    assert told["takes"]["output"] == "json_schema"
